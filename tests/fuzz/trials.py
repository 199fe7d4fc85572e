"""A reader tried on damaged files in processes of their own, which may die."""

from __future__ import annotations

import argparse
import faulthandler
import logging
import multiprocessing
import os
import re
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

from tests.fuzz.damage import Reader, damage_one, read_or_refuse, written

_FRESH = multiprocessing.get_context("spawn")
_MEMORY = 6 << 30  # bytes of addresses; the libraries alone take 2 GiB
_PLACE = re.compile(r'File "[^"]*?((?:dvc|fe|validate|phantoms|mrstrain|tests)/[^"]*)", line (\d+)')
_HEAD = "(most recent call first)"  # of what faulthandler writes, which begins where a traceback ends


def tried(name: str, reader: Reader, asked: argparse.Namespace) -> dict[str, Path]:
    """Try a reader until its time is over: each kind of escape, and the first file that it was seen on."""
    until, found, count = time.time() + asked.seconds, dict[str, Path](), _FRESH.RawValue("q", 0)
    with tempfile.TemporaryDirectory(prefix="fuzz-") as place:
        folder, log = Path(place) / name, Path(place) / "log.txt"
        files = written(reader, folder)
        given = (reader.read, files, until, f"{name} {asked.seed}", count, asked.limit_s, log)
        while status := _status(_try, *given):
            told = log.read_text(encoding="utf-8", errors="replace")
            changed = [path for path, content in files.items() if path.read_bytes() != content]
            if not changed:
                raise RuntimeError(f"{name}: the valid files cannot be read.\n{told}")
            what, kept = _named(told, status, asked.limit_s), asked.keep / f"{name}-{count.value}"
            if what not in found:
                found[what] = kept / changed[0].relative_to(folder)
                shutil.copytree(folder, kept, dirs_exist_ok=True)
                (kept / "told.txt").write_text(f"{what}\n\n{told}", encoding="utf-8")
            changed[0].write_bytes(files[changed[0]])
            if time.time() > until:
                break
    print(f"{name}: {count.value} damaged files, {len(found)} kinds of escape", flush=True)
    return found


def read_again(read: Callable[[Path], object], path: Path, limit_s: float) -> int:
    """Read one file in the same way, and let what happens be seen; the exit status of its process."""
    return _status(_read_once, read, path, limit_s)


def _status(target: Callable[..., None], *given: Any) -> int:
    """The exit status of a call in a process of its own."""
    process = _FRESH.Process(target=target, args=given)
    process.start()
    process.join()
    return process.exitcode or 0


def _try(
    read: Callable[[Path], object], files: dict[Path, bytes], until: float, seed: str, count: Any, limit_s: float,
    log: Path,
) -> None:  # fmt: skip
    """Read damaged files until the time is over, one at least. An escape ends the process, and its file stays."""
    os.dup2(os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 2)
    for path in files:  # imports and compiled code take their time
        read_or_refuse(read, path)
    while True:
        count.value += 1
        path = damage_one(files, Random(f"{seed} {count.value}"))
        _read_once(read, path, limit_s)
        path.write_bytes(files[path])
        if time.time() > until:
            return


def _read_once(read: Callable[[Path], object], path: Path, limit_s: float) -> None:
    faulthandler.enable()
    logging.disable(logging.CRITICAL)
    with suppress(ImportError):  # not on Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    faulthandler.dump_traceback_later(limit_s, exit=True)
    read_or_refuse(read, path)
    faulthandler.cancel_dump_traceback_later()


def _named(told: str, exitcode: int | None, limit_s: float) -> str:
    """What happened and where, in a line, from the last words of a process."""
    places = _PLACE.findall(told.rpartition(_HEAD)[2])
    file, line = places[0 if _HEAD in told else -1] if places else ("unknown", "?")
    if "Timeout (" in told:
        what = f"no answer within {limit_s:g} s"
    elif _HEAD in told or not told:
        what = f"the process died ({exitcode})"
    else:
        what = told.strip().splitlines()[-1].partition(":")[0]
    return f"{what} at {file}:{line}"
