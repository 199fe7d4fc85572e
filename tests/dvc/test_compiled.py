"""Compiled loops that are stored for the next run: what is damaged there is compiled again, and nothing else."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from pathlib import Path

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


def test_a_loop_is_compiled_again_if_a_function_that_it_calls_has_changed(tmp_path, monkeypatch):
    """numba looks at the loop's own file alone, and ran the old function for ever."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "stored"))
    monkeypatch.syspath_prepend(tmp_path)
    deep = "from dvc.compiled import njit\n\n@njit(cache=True)\ndef deep(x):\n    return {}\n"
    calls = "from dvc.compiled import njit\nfrom {0} import {0}\n\n@njit(cache=True)\ndef {1}(x):\n    return {0}(x)\n"
    (tmp_path / "middle.py").write_text(calls.format("deep", "middle"))
    (tmp_path / "outer.py").write_text(calls.format("middle", "outer"))

    def told() -> tuple[int, int]:
        for name in ("deep", "middle", "outer"):
            sys.modules.pop(name, None)
        importlib.invalidate_caches()
        outer = importlib.import_module("outer").outer
        return outer(3), sum(outer.stats.cache_hits.values())

    (tmp_path / "deep.py").write_text(deep.format("x + 1"))
    assert told() == (4, 0)
    assert told() == (4, 1)
    (tmp_path / "deep.py").write_text(deep.format("x + 10"))
    assert told() == (13, 0)
    assert told() == (13, 1)


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
