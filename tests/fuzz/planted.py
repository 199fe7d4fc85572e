"""Readers that are broken, each in one of the ways that are looked for."""

from __future__ import annotations

import os
import time
from pathlib import Path

VALID = b"valid 1.0\n" * 4


def write(folder: Path) -> None:
    (folder / "a.txt").write_bytes(VALID)


def raises(path: Path) -> None:
    if path.read_bytes() != VALID:
        raise ValueError("not one of ours")


def hangs(path: Path) -> None:
    if path.read_bytes() != VALID:
        time.sleep(60.0)


def dies(path: Path) -> None:
    if path.read_bytes() != VALID:
        os.abort()
