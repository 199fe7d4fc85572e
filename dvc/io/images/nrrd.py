"""NRRD and MetaImage files: a text header, then the voxels, raw or compressed.

Both headers are read here, with the same checks of length and checksum as for NIfTI: readers return garbage
for a MetaImage whose compressed voxels are damaged. Slicer's .seg.nrrd is an NRRD file with names.

References
----------
.. [1] NRRD file format: https://teem.sourceforge.net/nrrd/format.html
.. [2] MetaImage: https://itk.org/Wiki/ITK/MetaIO/Documentation
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import GeometryError, ImageFileError
from dvc.images.image import Grid
from dvc.io.images.stored import MAX_BYTES, StoredVolume, pick_volume, refuse_if_too_large

_log = logging.getLogger("dvc.images")

_HEADER_LIMIT = 1 << 20
_LARGEST_SIZE = 2.0**63
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
_SPACES = {
    "lps": "left-posterior-superior",
    "ras": "right-anterior-superior",
    "las": "left-anterior-superior",
}
_MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "µm": 0.001, "micron": 0.001}

_META_TYPES = {
    "MET_CHAR": "i1",
    "MET_UCHAR": "u1",
    "MET_SHORT": "i2",
    "MET_USHORT": "u2",
    "MET_INT": "i4",
    "MET_UINT": "u4",
    "MET_LONG": "i4",
    "MET_ULONG": "u4",
    "MET_LONG_LONG": "i8",
    "MET_ULONG_LONG": "u8",
    "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}


def nrrd_fields(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """Fields and key/value pairs of an NRRD header, and where it ends (bytes).

    Raises
    ------
    ImageFileError
        If the file is not an NRRD file or its header does not end.
    """
    start = _start(path)
    if not re.match(rb"NRRD000\d\r?\n", start):
        raise ImageFileError(f"{path}: not an NRRD file (no NRRD magic at its start). Export it again.")
    end = re.search(rb"\r?\n\r?\n", start)
    if end is None and path.stat().st_size >= _HEADER_LIMIT:
        raise ImageFileError(f"{path}: the NRRD header does not end; the file is damaged.")
    text = start[: end.start() if end else len(start)].decode("utf-8", errors="replace")
    fields: dict[str, str] = {}
    pairs: dict[str, str] = {}
    for line in text.splitlines()[1:]:
        if line.startswith("#"):
            continue
        pair, field = line.find(":="), line.find(": ")
        if pair > 0 and (field < 0 or pair < field):
            pairs[line[:pair]] = line[pair + 2 :]
        elif ":" in line:
            name, value = line.split(":", 1)
            fields[name.strip().lower()] = value.strip()
    return fields, pairs, end.end() if end else len(start)


def nrrd_shape(path: Path) -> tuple[int, ...]:
    """All sizes that the header claims, without any other check."""
    return tuple(_whole_numbers(path, nrrd_fields(path)[0], "sizes"))


def read_nrrd_header(
    path: Path, volume: int | None = None, max_bytes: int = MAX_BYTES, vectors: bool = False
) -> StoredVolume:
    """Read what an NRRD file (.nrrd, .nhdr, .seg.nrrd) holds, and where its voxels lie in LPS mm.

    With ``vectors``, a file of three components per voxel is needed in place of a scalar one.

    Raises
    ------
    ImageFileError
        If the header is damaged, claims more than ``max_bytes``, names no anatomical space, is sheared, is
        not 3D, or uses an encoding other than raw and gzip.
    """
    fields, _, end = nrrd_fields(path)
    sizes = _whole_numbers(path, fields, "sizes")
    axes, other = _nrrd_axes(path, fields, sizes)
    select = components = None
    if vectors:
        components = _component_axis(path, fields, sizes, other)
    else:
        select = _nrrd_volume(path, fields, sizes, other, volume)
    refuse_if_too_large(path, tuple(sizes), max_bytes)
    encoding = fields.get("encoding", "").lower()
    if encoding not in ("raw", "gzip", "gz"):
        raise ImageFileError(f"{path}: NRRD encoding '{encoding}' is not read; save it as raw or gzip.")
    data, start = path, end
    detached = fields.get("data file", fields.get("datafile"))
    if detached is not None:
        data, start = _detached(path, detached), 0
    skips = {
        fields.get("line skip", fields.get("lineskip", "0")),
        fields.get("byte skip", fields.get("byteskip", "0")),
    }
    if skips != {"0"}:
        raise ImageFileError(f"{path}: NRRD files that skip lines or bytes are not read; save it again, attached.")
    kind = " ".join(fields.get("type", "").lower().split())
    if kind not in _NRRD_TYPES:
        raise ImageFileError(f"{path}: NRRD type '{kind}' is not a number that is read.")
    order = fields.get("endian", "little").lower()
    if "endian" not in fields and not kind.endswith("char") and _NRRD_TYPES[kind][1] != "1":
        raise ImageFileError(f"{path}: the NRRD header does not give the byte order (endian); save it again.")
    return StoredVolume(
        path=data,
        grid=_nrrd_grid(path, fields, sizes, axes),
        dtype=np.dtype((">" if order == "big" else "<") + _NRRD_TYPES[kind]),
        layout=tuple(sizes),
        unit=_nrrd_unit(path, fields),
        file_start=start,
        compressed=encoding != "raw",
        select=select,
        components=components,
    )


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


def _nrrd_volume(
    path: Path, fields: Mapping[str, str], sizes: list[int], other: int | None, volume: int | None
) -> tuple[int, int] | None:
    """Which index of a fourth axis to keep, if there is one."""
    if other is None:
        pick_volume(path, 1, volume)
        return None
    count = sizes[other]
    if path.name.lower().endswith(".seg.nrrd") and count > 1:
        raise ImageFileError(
            f"{path}: a segmentation of {count} layers, in which segments overlap; a label map has one "
            "label per voxel. In Slicer, export the segments to a label map, or remove the overlap."
        )
    kind = _kind(fields, sizes, other)
    if count > 1 and not any(word in kind for word in ("list", "domain", "time", "?", "none")) and kind:
        raise ImageFileError(f"{path}: each voxel holds {count} values (kind {kind}); a scalar image is needed.")
    return other, pick_volume(path, count, volume)


def _component_axis(path: Path, fields: Mapping[str, str], sizes: list[int], other: int | None) -> int:
    """Find the axis of a vector's three components."""
    kind = "" if other is None else _kind(fields, sizes, other)
    if other is None or sizes[other] != 3:
        count = 1 if other is None else sizes[other]
        raise ImageFileError(f"{path}: {count} components per voxel; vectors of three are needed.")
    if kind not in ("", "none", "???", "list") and not kind.endswith("vector"):
        raise ImageFileError(f"{path}: the three values of a voxel are of kind {kind}; a vector is needed.")
    return other


def _kind(fields: Mapping[str, str], sizes: list[int], axis: int) -> str:
    kinds = fields.get("kinds", "").split()
    return kinds[axis].lower() if len(kinds) == len(sizes) else ""


def _vectors(path: Path, fields: Mapping[str, str]) -> list[FloatArray | None]:
    written = fields.get("space directions")
    space = fields.get("space", "").lower()
    if written is None or _SPACES.get(space, space) not in _TO_LPS:
        raise ImageFileError(
            f"{path}: the NRRD header does not say how the image lies in the body (space: "
            f"'{space or 'none'}', space directions: {'given' if written else 'none'}); the spaces that are "
            f"read are {sorted(_TO_LPS)}."
        )
    vectors: list[FloatArray | None] = []
    for item in re.findall(r"none|\([^)]*\)", written):
        vectors.append(None if item == "none" else np.array(_numbers(path, item.strip("()"), "space directions")))
        if item != "none" and vectors[-1] is not None and len(vectors[-1]) != 3:
            raise ImageFileError(f"{path}: a space direction {item} that does not have three components.")
    return vectors


def _nrrd_grid(path: Path, fields: Mapping[str, str], sizes: list[int], axes: list[int]) -> Grid:
    space = fields["space"].lower()
    signs = np.array(_TO_LPS[_SPACES.get(space, space)], dtype=np.float64)
    columns = np.stack([v for v in _vectors(path, fields) if v is not None], axis=1)
    origin = np.array(_numbers(path, fields.get("space origin", "").strip("()"), "space origin", 3))
    scale = _MM_PER_UNIT[_nrrd_unit(path, fields)]
    return _lps_grid(path, [sizes[a] for a in axes], columns * signs[:, None] * scale, origin * signs * scale)


def _nrrd_unit(path: Path, fields: Mapping[str, str]) -> str:
    return _unit(path, {u.strip().lower() for u in re.findall(r'"([^"]*)"', fields.get("space units", ""))})


def _unit(path: Path, units: set[str]) -> str:
    """The one unit of length; mm where none is given."""
    known = {unit or "mm" for unit in units} or {"mm"}
    if len(known) != 1 or not known <= set(_MM_PER_UNIT):
        raise ImageFileError(f"{path}: lengths in {sorted(units)}; the units that are read are mm, cm, m and um.")
    return known.pop()


def _lps_grid(path: Path, shape: list[int], columns: FloatArray, origin: FloatArray) -> Grid:
    with np.errstate(over="ignore"):
        spacing = np.linalg.norm(columns, axis=0)
    if not np.isfinite(spacing).all() or np.any(spacing <= 0):
        raise ImageFileError(f"{path}: the header's voxel sizes are {spacing.tolist()} mm; all must be positive.")
    try:
        return Grid((shape[0], shape[1], shape[2]), spacing, origin, columns / spacing)
    except GeometryError as error:
        raise ImageFileError(f"{path}: {error}") from error


def meta_fields(path: Path) -> tuple[dict[str, str], int]:
    """Fields of a MetaImage header, and where it ends (bytes).

    Raises
    ------
    ImageFileError
        If the file is not a MetaImage file or its header does not end.
    """
    start = _start(path)
    last = re.search(rb"^[ \t]*ElementDataFile[ \t]*=[^\r\n]*\r?\n?", start, re.MULTILINE)
    if last is None:
        raise ImageFileError(f"{path}: not a MetaImage file (its header has no ElementDataFile). Export it again.")
    text = start[: last.end()].decode("utf-8", errors="replace")
    lines = [line.split("=", 1) for line in text.splitlines() if "=" in line]
    return {name.strip().lower(): value.strip() for name, value in lines}, last.end()


def meta_shape(path: Path) -> tuple[int, ...]:
    """All sizes that the header claims, without any other check."""
    return tuple(_whole_numbers(path, meta_fields(path)[0], "dimsize"))


def read_meta_header(
    path: Path, volume: int | None = None, max_bytes: int = MAX_BYTES, vectors: bool = False
) -> StoredVolume:
    """Read what a MetaImage file (.mha, .mhd) holds, and where its voxels lie in LPS mm.

    With ``vectors``, a file of three components per voxel is needed in place of a scalar one.

    Raises
    ------
    ImageFileError
        If the header is damaged, claims more than ``max_bytes``, is sheared, is not a 3D image of what is needed,
        or its voxels are written as text.
    """
    fields, end = meta_fields(path)
    sizes = _whole_numbers(path, fields, "dimsize")
    if len(sizes) != 3 or fields.get("ndims") != "3":
        raise ImageFileError(f"{path}: a {len(sizes)}D image of sizes {sizes}; a 3D image is needed.")
    layout = (3, *sizes) if vectors else tuple(sizes)
    refuse_if_too_large(path, layout, max_bytes)
    pick_volume(path, 1, volume)
    channels = fields.get("elementnumberofchannels", "1")
    if vectors and channels != "3":
        raise ImageFileError(f"{path}: {channels} components per voxel; vectors of three are needed.")
    if not vectors and channels != "1":
        raise ImageFileError(f"{path}: each voxel holds {channels} values; a scalar image is needed.")
    kind = fields.get("elementtype", "")
    if kind not in _META_TYPES or not _truth(fields, "binarydata", True):
        raise ImageFileError(f"{path}: voxels of type '{kind}', or written as text, are not read; save it as binary.")
    if _numbers(path, fields.get("headersize", "0"), "HeaderSize", 1) != [0.0]:
        raise ImageFileError(f"{path}: MetaImage files with a HeaderSize are not read; save it again as .mha.")
    data, start = path, end
    if fields["elementdatafile"] != "LOCAL":
        data, start = _detached(path, fields["elementdatafile"]), 0
    big = _truth(fields, "binarydatabyteordermsb", False) or _truth(fields, "elementbyteordermsb", False)
    matrix = _first(fields, ("transformmatrix", "rotation", "orientation"), "1 0 0 0 1 0 0 0 1")
    origin = _first(fields, ("offset", "position", "origin"), "0 0 0")
    spacing = _first(fields, ("elementspacing", "elementsize"), "1 1 1")
    rows = np.array(_numbers(path, matrix, "TransformMatrix", 9)).reshape(3, 3)
    unit = _unit(path, {fields.get("distanceunits", "mm").lower()})
    scale = _MM_PER_UNIT[unit]
    # A row of the matrix is the direction of one image axis.
    columns = rows.T * np.array(_numbers(path, spacing, "ElementSpacing", 3))
    return StoredVolume(
        path=data,
        grid=_lps_grid(path, sizes, columns * scale, np.array(_numbers(path, origin, "Offset", 3)) * scale),
        dtype=np.dtype((">" if big else "<") + _META_TYPES[kind]),
        layout=layout,
        unit=unit,
        file_start=start,
        components=0 if vectors else None,
        compressed=_truth(fields, "compresseddata", False),
    )


def _first(fields: Mapping[str, str], names: tuple[str, ...], default: str) -> str:
    return next((fields[name] for name in names if name in fields), default)


def _truth(fields: Mapping[str, Any], name: str, default: bool) -> bool:
    return str(fields.get(name, default)).lower() in ("true", "t", "1")


def _start(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEADER_LIMIT)


def _detached(path: Path, name: str) -> Path:
    """Find the file beside a header that holds its voxels."""
    if name.startswith("LIST") or "%" in name:
        raise ImageFileError(f"{path}: voxels spread over several files are not read; save it as one file.")
    data = path.parent / name
    try:
        there = data.is_file()
    except OSError:  # no name that a file can have
        there = False
    if not there:
        raise ImageFileError(f"{path}: the file of its voxels, '{name}', is not there; keep the two together.")
    return data


def _numbers(path: Path, text: str, field: str, count: int | None = None) -> list[float]:
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if not numbers or (count is not None and len(numbers) != count):
        raise ImageFileError(f"{path}: the header's '{field}' is missing or not a list of numbers: '{text[:60]}'.")
    return numbers


def _whole_numbers(path: Path, fields: Mapping[str, str], field: str) -> list[int]:
    numbers = _numbers(path, fields.get(field, ""), field)
    if not all(n.is_integer() and abs(n) < _LARGEST_SIZE for n in numbers):
        raise ImageFileError(f"{path}: the header's '{field}' must be whole numbers; got {numbers}: damaged.")
    return [int(n) for n in numbers]
