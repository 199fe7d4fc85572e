"""JSON, TOML, CSV and npz files of our own, read whole: whatever is wrong with one is a ValueError.

The libraries below raise a dozen kinds of error on a damaged file, and take some damage for numbers. Editors on Windows
put a byte order mark before a text in UTF-8 ("utf-8-sig"), which is left out.
"""

import csv
import io
import json
import math
import tomllib
import zipfile
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; OSError if it cannot be opened.

    ValueError for anything else than an object, for NaN and infinity, which JSON has not, and for whole numbers beyond
    64 bits.
    """
    try:
        return parse_json(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError as wrong:
        raise ValueError(str(wrong)) from wrong  # whose repr would quote the whole file


def parse_json(text: str) -> dict[str, Any]:
    """The object that a text of JSON holds; ValueError as `read_json`."""
    try:
        told = json.loads(text, **_NUMBERS)
    except RecursionError as endless:
        raise ValueError(_NESTED) from endless
    if not isinstance(told, dict):
        raise ValueError(f"a {type(told).__name__}, not an object")
    return told


def parse_toml(text: str) -> dict[str, Any]:
    """The tables that a text of TOML holds.

    ValueError for anything else, of which `tomllib.TOMLDecodeError` is one, and for whole numbers beyond 64 bits.
    """
    try:
        told = tomllib.loads(text)
        _refuse_large(told)
    except RecursionError as endless:
        raise ValueError(_NESTED) from endless
    return told


def _refuse_large(told: object) -> None:
    if isinstance(told, int) and not -(2**63) <= told < 2**63:
        raise ValueError("a whole number has more than 18 digits")
    for each in told.values() if isinstance(told, dict) else told if isinstance(told, list) else ():
        _refuse_large(each)


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV table with a header, each by the names of its columns; OSError if it cannot be opened.

    ValueError for a row with other than so many cells, for quotes that do not end, and for a table without a header.
    """
    try:
        head, *rows = csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig"), newline=""), strict=True)
    except csv.Error as damage:
        raise ValueError(f"{path.name}: {damage}") from damage
    except UnicodeDecodeError as wrong:
        raise ValueError(f"{path.name}: {wrong.reason} at byte {wrong.start}") from wrong
    for number, row in enumerate(rows, start=1):
        if len(row) != len(head):
            raise ValueError(f"{path.name}: row {number} has {len(row)} cells, but the header has {len(head)}")
    return [dict(zip(head, row, strict=True)) for row in rows]


_NESTED = "its brackets are nested too deeply"


def _refused(word: str) -> NoReturn:
    raise ValueError(f"{word[:40]} is no number of a file")


def _finite(digits: str) -> float:
    value = float(digits)
    return value if math.isfinite(value) else _refused(digits)


def _whole(digits: str) -> int:
    value = int(digits)
    return value if abs(value) < 2**63 else _refused(digits)


_NUMBERS: dict[str, Any] = {"parse_constant": _refused, "parse_float": _finite, "parse_int": _whole}


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an npz file by name, each read to its end so that its checksum counts.

    OSError if the file cannot be opened; ValueError if it is damaged or something else.
    """
    content = io.BytesIO(path.read_bytes())
    try:
        with zipfile.ZipFile(content) as archive:
            return {name.removesuffix(".npy"): _array(archive.read(name)) for name in archive.namelist()}
    except Exception as damage:  # what zipfile, zlib and numpy raise depends on the byte that is wrong
        raise ValueError(f"no arrays, or damaged ({type(damage).__name__}: {damage})") from damage


def _array(content: bytes) -> npt.NDArray[Any]:
    stream = io.BytesIO(content)
    array: npt.NDArray[Any] = np.lib.format.read_array(stream, allow_pickle=False)
    if stream.read(1):
        raise ValueError("an array is longer than its header tells")
    return array
