"""A reader, the files that it is tried on, and the damage that they take."""

from __future__ import annotations

import gzip
import io
import re
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import NamedTuple

from dvc.errors import MrstrainError

_GZIP, _ZIP = b"\x1f\x8b", b"PK\x03\x04"
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_INSTEAD = b"nan inf -inf 1e400 1e308 -1 0 1.5 2147483648 4294967296 9223372036854775808 x [] {} null true".split()
_INSTEAD += [b"", b" ", b",", b'"', b"\n", b"\0", b"\xff", b"\xc2\xb2"]
_EXTREME = (b"\0\0\0\0", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\1\0\0\0", b"\0\0\x80\x7f")


class Reader(NamedTuple):
    """Writes valid files into a folder; reads or refuses one of them; and a pattern of those that are damaged."""

    write: Callable[[Path], object]
    read: Callable[[Path], object]
    damaged: str = "**/*"


def written(reader: Reader, folder: Path) -> dict[Path, bytes]:
    """The files of a reader that are to be damaged, in a new folder, and what they hold."""
    folder.mkdir()
    reader.write(folder)
    return {path: path.read_bytes() for path in sorted(folder.glob(reader.damaged)) if path.is_file()}


def damage_one(files: dict[Path, bytes], random: Random) -> Path:
    """Damage one of the files on disk."""
    path = random.choice(list(files))
    path.write_bytes(damaged(files[path], random))
    return path


def read_or_refuse(read: Callable[[Path], object], path: Path) -> None:
    """Read a file, which may be refused with an error of mrstrain; any other error is raised."""
    with warnings.catch_warnings(), suppress(MrstrainError):
        warnings.simplefilter("ignore")
        read(path)


def damaged(data: bytes, random: Random) -> bytes:
    """The bytes with one to three changes; what gzip or zip has packed is changed unpacked, half of the time."""
    if data.startswith(_GZIP) and random.random() < 0.5:
        return gzip.compress(damaged(gzip.decompress(data), random))
    if data.startswith(_ZIP) and random.random() < 0.5:
        with zipfile.ZipFile(io.BytesIO(data)) as packed:
            members = {name: packed.read(name) for name in packed.namelist()}
        name = random.choice(list(members))
        members[name] = damaged(members[name], random)
        with zipfile.ZipFile(again := io.BytesIO(), "w") as packed:
            for name, content in members.items():
                packed.writestr(name, content)
        return again.getvalue()
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        _change(changed, random)
    return bytes(changed)


def _change(data: bytearray, random: Random) -> None:
    """Make one change: a bit, the end, a piece, a number or a line."""
    at = random.randrange(len(data) + 1)
    piece = slice(at, at + random.choice((1, 2, 4, 8, 30, 200)))
    match random.choice(("flip", "cut", "drop", "double", "insert", "set", "number", "line")):
        case "flip":
            data[at : at + 1] = bytes(byte ^ 1 << random.randrange(8) for byte in data[at : at + 1])
        case "cut":
            del data[at:]
        case "drop":
            del data[piece]
        case "double":
            data[at:at] = data[piece]
        case "insert":
            data[at:at] = random.choice((*_INSTEAD, random.randbytes(piece.stop - at)))
        case "set":
            data[at : at + 4] = random.choice(_EXTREME)
        case "number" if found := _NUMBER.search(data, at) or _NUMBER.search(data):
            data[found.start() : found.end()] = random.choice(_INSTEAD)
        case _:
            del data[data.rfind(b"\n", 0, at) + 1 : data.find(b"\n", at) + 1 or len(data)]
