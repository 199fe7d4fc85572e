"""NRRD files: a text header, then the voxels, raw or compressed. Slicer's .seg.nrrd is an NRRD file with names.

References
----------
.. [1] NRRD file format: https://teem.sourceforge.net/nrrd/format.html
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import ImageFileError
from dvc.io.images.stored import StoredVolume, pick_volume, refuse_if_too_large
from dvc.io.images.text_header import (
    HEADER_LIMIT,
    MM_PER_UNIT,
    detached_file,
    grid_of_axes,
    header_start,
    unit_of_length,
    whole_numbers,
)

_INTEGERS = {"char": "1", "short": "2", "int": "4", "long long": "8", "longlong": "8"}
_NRRD_TYPES: dict[str, str] = {"float": "f4", "double": "f8"}
for _name, _size in _INTEGERS.items():
    for _form in (_name, f"{_name} int"):
        _NRRD_TYPES |= {_form: f"i{_size}", f"signed {_form}": f"i{_size}", f"unsigned {_form}": f"u{_size}"}
for _bits in (8, 16, 32, 64):
    for _form in (f"int{_bits}", f"int{_bits}_t"):
        _NRRD_TYPES |= {_form: f"i{_bits // 8}", f"u{_form}": f"u{_bits // 8}"}
_NRRD_TYPES |= {"uchar": "u1", "ushort": "u2", "uint": "u4", "ulonglong": "u8"}

_TO_LPS = {
    "left-posterior-superior": (1, 1, 1),
    "right-anterior-superior": (-1, -1, 1),
    "left-anterior-superior": (1, -1, 1),
}
_TO_LPS |= {"".join(word[0] for word in name.split("-")): signs for name, signs in _TO_LPS.items()}


def nrrd_fields(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """Fields and key/value pairs of an NRRD header, and where it ends (bytes)."""
    start = header_start(path)
    if not re.match(rb"NRRD000\d\r?\n", start):
        raise ImageFileError(f"{path}: not an NRRD file (no NRRD magic at its start). Export it again.")
    end = re.search(rb"\r?\n\r?\n", start)
    if end is None and path.stat().st_size >= HEADER_LIMIT:
        raise ImageFileError(f"{path}: the NRRD header does not end; the file is damaged.")
    text = start[: end.start() if end else len(start)].decode("utf-8", errors="replace")
    fields: dict[str, str] = {}
    pairs: dict[str, str] = {}
    for line in text.splitlines()[1:]:
        if line.startswith("#") or not line.strip():
            continue
        pair, field = line.find(":="), line.find(": ")
        if pair > 0 and (field < 0 or pair < field):
            pairs[line[:pair]] = line[pair + 2 :]
        elif ":" in line:
            name, value = line.split(":", 1)
            fields[name.strip().lower()] = value.strip()
        else:
            raise ImageFileError(f"{path}: a line of the NRRD header is no field: '{line[:60]}'; it is damaged.")
    return fields, pairs, end.end() if end else len(start)


def read_nrrd_header(path: Path, volume: int | None, max_bytes: int, vectors: bool) -> StoredVolume:
    """What an NRRD file (.nrrd, .nhdr, .seg.nrrd) holds: scalars, or with `vectors` three components per voxel."""
    fields, _, end = nrrd_fields(path)
    sizes = whole_numbers(path, fields, "sizes")
    if whole_numbers(path, fields, "dimension") != [len(sizes)]:
        raise ImageFileError(f"{path}: {len(sizes)} sizes in {fields['dimension']} dimensions; the header is damaged.")
    axes, other = _nrrd_axes(path, fields, sizes)
    select, components = _fourth_axis(path, fields, sizes, other, volume, vectors)
    refuse_if_too_large(path, tuple(sizes), max_bytes)
    encoding = fields.get("encoding", "").lower()
    if encoding not in ("raw", "gzip", "gz"):
        raise ImageFileError(f"{path}: NRRD encoding '{encoding}' is not read; save it as raw or gzip.")
    detached = fields.get("data file", fields.get("datafile"))
    data, start = (path, end) if detached is None else (detached_file(path, detached), 0)
    if any(fields.get(name, "0") != "0" for name in ("line skip", "lineskip", "byte skip", "byteskip")):
        raise ImageFileError(f"{path}: NRRD files that skip lines or bytes are not read; save it again, attached.")
    kind = " ".join(fields.get("type", "").lower().split())
    if kind not in _NRRD_TYPES:
        raise ImageFileError(f"{path}: NRRD type '{kind}' is not a number that is read.")
    order = fields.get("endian", "little").lower()
    if "endian" not in fields and not kind.endswith("char") and _NRRD_TYPES[kind][1] != "1":
        raise ImageFileError(f"{path}: the NRRD header does not give the byte order (endian); save it again.")
    if order not in ("little", "big"):
        raise ImageFileError(f"{path}: the byte order (endian) is '{order}', neither little nor big: damaged.")
    unit = _nrrd_unit(path, fields)
    to_lps_mm = np.array(_TO_LPS[fields["space"].lower()]) * MM_PER_UNIT[unit]
    columns = np.stack([v for v in _vectors(path, fields) if v is not None], axis=1) * to_lps_mm[:, None]
    origin = _vector(path, fields.get("space origin", ""), "space origin") * to_lps_mm
    grid = grid_of_axes(path, [sizes[a] for a in axes], columns, origin)
    dtype = np.dtype((">" if order == "big" else "<") + _NRRD_TYPES[kind])
    packed = encoding != "raw"
    return StoredVolume(data, grid, dtype, tuple(sizes), unit, start, packed, select=select, components=components)


def _nrrd_axes(path: Path, fields: Mapping[str, str], sizes: list[int]) -> tuple[list[int], int | None]:
    """Find the three axes in space, and a fourth that is not, if there is one."""
    if len(sizes) < 3:
        raise ImageFileError(f"{path}: a {len(sizes)}D image of sizes {sizes}; a 3D image is needed.")
    vectors = _vectors(path, fields)
    if len(vectors) != len(sizes):
        raise ImageFileError(f"{path}: the NRRD header gives {len(sizes)} sizes and {len(vectors)} space directions.")
    axes = [a for a, vector in enumerate(vectors) if vector is not None]
    others = [a for a, vector in enumerate(vectors) if vector is None]
    if len(axes) != 3 or len(others) > 1:
        raise ImageFileError(f"{path}: a {len(axes)}D image of sizes {sizes}; a 3D scalar image is needed.")
    return axes, others[0] if others else None


def _fourth_axis(
    path: Path, fields: Mapping[str, str], sizes: list[int], other: int | None, volume: int | None, vectors: bool
) -> tuple[tuple[int, int] | None, int | None]:
    """What is kept of a fourth axis: a volume (axis, index), or a vector's three components (axis)."""
    kinds = fields.get("kinds", "").split()
    kind = kinds[other].lower() if other is not None and len(kinds) == len(sizes) else ""
    count = 1 if other is None else sizes[other]
    if vectors:
        if count != 3:
            raise ImageFileError(f"{path}: {count} components per voxel; vectors of three are needed.")
        if kind not in ("", "none", "???", "list") and not kind.endswith("vector"):
            raise ImageFileError(f"{path}: the three values of a voxel are of kind {kind}; a vector is needed.")
        return None, other
    if path.name.lower().endswith(".seg.nrrd") and count > 1:
        raise ImageFileError(
            f"{path}: a segmentation of {count} layers, in which segments overlap; a label map has one "
            "label per voxel. In Slicer, export the segments to a label map, or remove the overlap."
        )
    if count > 1 and not any(word in kind for word in ("list", "domain", "time", "?", "none")) and kind:
        raise ImageFileError(f"{path}: each voxel holds {count} values (kind {kind}); a scalar image is needed.")
    index = pick_volume(path, count, volume)
    return None if other is None else (other, index), None


def _vectors(path: Path, fields: Mapping[str, str]) -> list[FloatArray | None]:
    written = fields.get("space directions")
    space = fields.get("space", "").lower()
    if written is None or space not in _TO_LPS:
        raise ImageFileError(
            f"{path}: the NRRD header does not say how the image lies in the body (space: '{space or 'none'}', space "
            f"directions: {'given' if written else 'none'}); the spaces that are read are {sorted(_TO_LPS)}."
        )
    if not re.fullmatch(r"((none|\([^()]*\))\s*)+", written):
        raise ImageFileError(f"{path}: the header's 'space directions' are no vectors: '{written[:60]}'; damaged.")
    items = re.findall(r"none|\([^()]*\)", written)
    return [None if item == "none" else _vector(path, item, "space directions") for item in items]


def _vector(path: Path, written: str, field: str) -> FloatArray:
    """The three numbers of ``(x,y,z)``."""
    if match := re.fullmatch(r"\(([^(),]*),([^(),]*),([^(),]*)\)", written):
        with suppress(ValueError):
            return np.array([float(part) for part in match.groups()])
    raise ImageFileError(f"{path}: the header's '{field}' is missing or not a vector (x,y,z): '{written[:60]}'.")


def _nrrd_unit(path: Path, fields: Mapping[str, str]) -> str:
    written = fields.get("space units", "")
    if not re.fullmatch(r'("[^"]*"\s*)*', written):
        raise ImageFileError(f"{path}: the header's 'space units' are no words in quotes: '{written[:60]}'; damaged.")
    return unit_of_length(path, {unit.strip().lower() for unit in re.findall(r'"([^"]*)"', written)})
