"""MetaImage files (.mha, .mhd): a text header, then the voxels, raw or compressed.

References
----------
.. [1] MetaImage: https://itk.org/Wiki/ITK/MetaIO/Documentation
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import ImageFileError
from dvc.io.images.stored import StoredVolume, pick_volume, refuse_if_too_large
from dvc.io.images.text_header import (
    MM_PER_UNIT,
    detached_file,
    grid_of_axes,
    header_start,
    numbers_in,
    unit_of_length,
    whole_numbers,
)

_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
    "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}  # fmt: skip
# Names that the format has for the same thing, the usual one first.
_MATRIX = ("TransformMatrix", "Rotation", "Orientation")
_ORIGIN = ("Offset", "Position", "Origin")
_SPACING = ("ElementSpacing", "ElementSize")
_BYTE_ORDER = ("binarydatabyteordermsb", "elementbyteordermsb")


def meta_fields(path: Path) -> tuple[dict[str, str], int]:
    """Fields of a MetaImage header (names in lower case), and where it ends (bytes)."""
    start = header_start(path)
    last = re.search(rb"^[ \t]*ElementDataFile[ \t]*=[^\r\n]*\r?\n?", start, re.MULTILINE)
    if last is None:
        raise ImageFileError(f"{path}: not a MetaImage file (its header has no ElementDataFile). Export it again.")
    lines = [line for line in start[: last.end()].decode("utf-8", errors="replace").splitlines() if line.strip()]
    damaged = [line for line in lines if "=" not in line]
    if damaged:
        raise ImageFileError(f"{path}: a line of the MetaImage header is no field: '{damaged[0][:60]}'; it is damaged.")
    pairs = (line.split("=", 1) for line in lines)
    return {name.strip().lower(): value.strip() for name, value in pairs}, last.end()


def read_meta_header(path: Path, volume: int | None, max_bytes: int, vectors: bool) -> StoredVolume:
    """What a MetaImage file (.mha, .mhd) holds: scalars, or with `vectors` three components per voxel."""
    fields, end = meta_fields(path)
    sizes = whole_numbers(path, fields, "dimsize")
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
    if kind not in _TYPES or not _truth(path, fields, "binarydata", True):
        raise ImageFileError(f"{path}: voxels of type '{kind}', or written as text, are not read; save it as binary.")
    if numbers_in(path, fields.get("headersize", "0"), "HeaderSize", 1) != [0.0]:
        raise ImageFileError(f"{path}: MetaImage files with a HeaderSize are not read; save it again as .mha.")
    named = fields["elementdatafile"]
    data, start = (path, end) if named == "LOCAL" else (detached_file(path, named), 0)
    if np.dtype(_TYPES[kind]).itemsize > 1 and not set(_BYTE_ORDER) & set(fields):
        raise ImageFileError(f"{path}: the header does not give the byte order ({_BYTE_ORDER[0]}); save it again.")
    big = any(_truth(path, fields, name, False) for name in _BYTE_ORDER)
    matrix, spacing = _needed(path, fields, _MATRIX, 9), _needed(path, fields, _SPACING, 3)
    origin = _needed(path, fields, _ORIGIN, 3)
    unit = unit_of_length(path, {fields.get("distanceunits", "mm").lower()})
    scale = MM_PER_UNIT[unit]
    columns = matrix.reshape(3, 3).T * spacing  # a row of the matrix is the direction of one image axis
    grid = grid_of_axes(path, sizes, columns * scale, origin * scale)
    dtype = np.dtype((">" if big else "<") + _TYPES[kind])
    packed = _truth(path, fields, "compresseddata", False)
    return StoredVolume(data, grid, dtype, layout, unit, start, packed, components=0 if vectors else None)


def _needed(path: Path, fields: Mapping[str, str], names: tuple[str, ...], count: int) -> FloatArray:
    """Numbers of a field for which the format has a default, as which a damaged line would be read."""
    written = next((fields[name.lower()] for name in names if name.lower() in fields), None)
    if written is None:
        raise ImageFileError(
            f"{path}: the MetaImage header does not say how the image lies in the body (no {names[0]}). Export it "
            "again."
        )
    return np.array(numbers_in(path, written, names[0], count))


def _truth(path: Path, fields: Mapping[str, str], name: str, default: bool) -> bool:
    word = fields.get(name, str(default)).lower()
    if word not in ("true", "t", "1", "false", "f", "0"):
        raise ImageFileError(f"{path}: the header's '{name}' is '{word}', neither True nor False: damaged.")
    return word in ("true", "t", "1")
