"""Waiting for what other processes do."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from subprocess import Popen

from filelock import FileLock, Timeout


def under_way(records: Path, stage: str) -> bool:
    """Whether a worker holds the stage's lock, and the stage has no record yet."""
    lock = records / f"{stage}.lock"
    if not lock.is_file():
        return False
    try:
        with FileLock(lock, timeout=0):
            return False
    except Timeout:
        return not (records / f"{stage}.json").exists()


def wait_for(condition: Callable[[], bool], process: Popen, limit_s: float = 300.0) -> None:
    """Wait until a condition holds, while a process runs."""
    began = time.monotonic()
    while not condition():
        assert process.poll() is None, "it ended before"
        assert time.monotonic() - began < limit_s, "it took too long"
        time.sleep(0.2)
