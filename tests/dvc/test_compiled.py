"""Compiled loops that are stored for the next run: what is damaged there is compiled again, and nothing else."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba.core.caching
import pytest

from dvc.compiled import njit

SOURCE = """
from dvc.compiled import njit

@njit(cache=True)
def twice(x):
    return 2 * x
"""


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "stored"))
    (tmp_path / "kernels.py").write_text(SOURCE)
    return tmp_path / "kernels.py"


def hits(module: Path) -> int:
    """Import the module as another process would, and call its loop; how many of two kinds of arguments were stored."""
    spec = importlib.util.spec_from_file_location("kernels", module)
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    assert (made.twice(2), made.twice(1.5)) == (4, 3.0)
    return sum(made.twice.stats.cache_hits.values())


def files(module: Path, ending: str) -> list[Path]:
    return sorted((module.parent / "stored").rglob(f"*.{ending}"))


@pytest.mark.parametrize(("ending", "left"), [("nbi", 0), ("nbc", 1)])
@pytest.mark.parametrize("damage", ["cut", "flipped", "empty"])
def test_a_damaged_one_is_compiled_again(module, ending, left, damage):
    assert hits(module) == 0
    assert hits(module) == 2
    place = files(module, ending)[0]
    whole = bytearray(place.read_bytes())
    whole[len(whole) // 2] ^= 1
    place.write_bytes({"cut": whole[: len(whole) // 2], "flipped": whole, "empty": b""}[damage])
    others = {path: path.read_bytes() for path in files(module, "nbc") if path != place}
    assert hits(module) == left
    assert hits(module) == 2
    if ending == "nbc":
        assert {path: path.read_bytes() for path in others} == others


def test_code_for_other_arguments_is_not_taken(module):
    """Of two processes that store at once, one may name a file in the index, and the other write it."""
    assert hits(module) == 0
    one, other = files(module, "nbc")
    other.write_bytes(one.read_bytes())
    assert hits(module) == 1
    assert hits(module) == 2


@pytest.fixture
def calls(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Any]:
    """Three files whose functions call one another; imports the outermost as another process would."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "stored"))
    monkeypatch.syspath_prepend(tmp_path)
    source = "from dvc.compiled import njit\nfrom {0} import {0}\n\n@njit(cache=True)\ndef {1}(x):\n    return {0}(x)\n"
    for name, used in (("middle", "deep"), ("outer", "middle")):
        (tmp_path / f"{name}.py").write_text(source.format(used, name))

    def imported() -> Any:
        for name in ("deep", "middle", "outer"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        return importlib.import_module("outer").outer

    return imported


def deep(folder: Path, body: str) -> None:
    (folder / "deep.py").write_text(
        f"from dvc.compiled import njit\n\n@njit(cache=True)\ndef deep(x):\n    return {body}\n"
    )


def told(outer: Any) -> tuple[int, int]:
    """The result for 3, and whether stored code gave it."""
    return outer(3), sum(outer.stats.cache_hits.values())


def test_a_loop_is_compiled_again_if_a_function_that_it_calls_has_changed(calls, tmp_path):
    """numba looks at the loop's own file alone, and ran the old function for ever."""
    deep(tmp_path, "x + 1")
    assert told(calls()) == (4, 0)
    assert told(calls()) == (4, 1)
    deep(tmp_path, "x + 10")
    assert told(calls()) == (13, 0)
    assert told(calls()) == (13, 1)


def test_a_file_that_changes_or_goes_after_its_import_is_the_one_that_was_imported(calls, tmp_path):
    deep(tmp_path, "x + 1")
    outer = calls()
    deep(tmp_path, "x + 10")
    assert told(outer) == (4, 0)
    assert told(outer := calls()) == (13, 0)
    (tmp_path / "deep.py").unlink()
    assert outer(2.5) == 12.5


def test_where_nothing_can_be_stored_it_is_compiled_for_each_run(module, monkeypatch):
    """A package folder and a home folder that are both read-only, as in many containers."""
    monkeypatch.setattr(numba.core.caching.CacheImpl, "_locator_classes", [])
    assert hits(module) == 0
    assert not files(module, "nbi")


def test_what_a_full_disk_does_not_take_is_used_as_it_is(module, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    assert hits(module) == 0
    assert hits(module) == 0
    assert files(module, "nb*") == []


def test_without_a_store_a_loop_is_compiled_as_ever():
    assert njit(nogil=True)(lambda x: x + 1)(1) == 2
