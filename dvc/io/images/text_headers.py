"""NRRD (.nrrd, .nhdr, Slicer's .seg.nrrd) and MetaImage (.mha, .mhd): a text header, then voxels, raw or compressed.

References
----------
.. [1] NRRD file format: https://teem.sourceforge.net/nrrd/format.html
.. [2] MetaImage: https://itk.org/Wiki/ITK/MetaIO/Documentation
"""

import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray, numbers
from dvc.errors import ImageFileError
from dvc.io.images.stored import StoredVolume, grid_of_axes, pick_volume, refuse_if_too_large

_HEADER_LIMIT = 1 << 20  # bytes within which a header has to end
_LARGEST_SIZE = 2.0**63
_MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "µm": 0.001, "micron": 0.001}

_NRRD_TYPES = {"float": "f4", "double": "f8"}
for _name, _size in {"char": 1, "short": 2, "int": 4, "long long": 8, "longlong": 8}.items():
    for _form in (_name, f"{_name} int", f"int{8 * _size}", f"int{8 * _size}_t"):
        _NRRD_TYPES |= {f"{_sign}{_form}": f"i{_size}" for _sign in ("", "signed ")}
        _NRRD_TYPES |= {f"{_sign}{_form}": f"u{_size}" for _sign in ("u", "unsigned ")}
_TO_LPS = {
    "left-posterior-superior": (1, 1, 1), "right-anterior-superior": (-1, -1, 1), "left-anterior-superior": (1, -1, 1),
}  # fmt: skip
_TO_LPS |= {"".join(word[0] for word in name.split("-")): signs for name, signs in _TO_LPS.items()}

_META_TYPES = {
    "MET_CHAR": "i1", "MET_UCHAR": "u1", "MET_SHORT": "i2", "MET_USHORT": "u2", "MET_INT": "i4", "MET_UINT": "u4",
    "MET_LONG": "i4", "MET_ULONG": "u4", "MET_LONG_LONG": "i8", "MET_ULONG_LONG": "u8", "MET_FLOAT": "f4",
    "MET_DOUBLE": "f8",
}  # fmt: skip
# Names that MetaImage has for the same thing, the usual one first.
_MATRIX = ("TransformMatrix", "Rotation", "Orientation")
_ORIGIN = ("Offset", "Position", "Origin")
_SPACING = ("ElementSpacing", "ElementSize")
_BYTE_ORDER = ("binarydatabyteordermsb", "elementbyteordermsb")


def nrrd_fields(path: Path) -> tuple[dict[str, str], dict[str, str], int]:
    """Fields and key/value pairs of an NRRD header, and where it ends (bytes)."""
    with path.open("rb") as file:
        start = file.read(_HEADER_LIMIT)
    if not re.match(rb"NRRD000\d\r?\n", start):
        raise ImageFileError(f"{path}: not an NRRD file (it does not start with NRRD). Export it again.")
    end = re.search(rb"\r?\n\r?\n", start)
    if end is None and path.stat().st_size >= _HEADER_LIMIT:
        raise ImageFileError(f"{path}: no empty line ends the NRRD header; the file is damaged. Export it again.")
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
            what = f"this line is not a field: '{line[:60]}'"
            raise ImageFileError(f"{path}: the NRRD header is damaged; {what}. Export it again.")
    return fields, pairs, end.end() if end else len(start)


def read_nrrd_header(
    path: Path, volume: int | None, max_bytes: int, vectors: bool, components: int = 3
) -> StoredVolume:
    """What an NRRD file holds: scalars, or with `vectors` so many `components` per voxel."""
    fields, _, end = nrrd_fields(path)
    sizes = _whole_numbers(path, fields, "sizes")
    if _whole_numbers(path, fields, "dimension") != [len(sizes)]:
        raise ImageFileError(
            f"{path}: {len(sizes)} sizes, {fields['dimension']} dimensions (header damaged). Export it again."
        )
    if len(sizes) < 3:
        raise ImageFileError(
            f"{path}: a {len(sizes)}D image of sizes {sizes}; a 3D image is needed. Give all slices in one file."
        )
    steps = _steps(path, fields)
    if len(steps) != len(sizes):
        count = f"{len(sizes)} sizes and {len(steps)} space directions"
        raise ImageFileError(f"{path}: the NRRD header gives {count}; they must be equal in number. Export it again.")
    axes = {axis: step for axis, step in enumerate(steps) if step is not None}
    others = [axis for axis, step in enumerate(steps) if step is None]
    if len(axes) != 3 or len(others) > 1:
        raise ImageFileError(f"{path}: a {len(axes)}D image of sizes {sizes}; a 3D scalar image is needed.")
    other = others[0] if others else None
    select, along = _fourth_axis(path, fields, sizes, other, volume, components if vectors else None)
    refuse_if_too_large(path, tuple(sizes), max_bytes)
    encoding = fields.get("encoding", "").lower()
    if encoding not in ("raw", "gzip", "gz"):
        raise ImageFileError(f"{path}: NRRD encoding '{encoding}' is not supported; save it as raw or gzip.")
    detached = fields.get("data file", fields.get("datafile"))
    data, start = (path, end) if detached is None else (_detached_file(path, detached), 0)
    if any(fields.get(name, "0") != "0" for name in ("line skip", "lineskip", "byte skip", "byteskip")):
        raise ImageFileError(f"{path}: NRRD files that skip lines or bytes are not supported; save it as one file.")
    kind = " ".join(fields.get("type", "").lower().split())
    if kind not in _NRRD_TYPES:
        raise ImageFileError(f"{path}: NRRD type '{kind}' is not supported; save it as numbers.")
    order = fields.get("endian", "little").lower()
    if "endian" not in fields and _NRRD_TYPES[kind][1] != "1":
        raise ImageFileError(f"{path}: the NRRD header does not give the byte order (endian); save it again.")
    if order not in ("little", "big"):
        raise ImageFileError(
            f"{path}: the header is damaged (endian is '{order}', neither little nor big). Export it again."
        )
    units = fields.get("space units", "")
    if not re.fullmatch(r'("[^"]*"\s*)*', units):
        raise ImageFileError(
            f"{path}: 'space units' are not quoted words: '{units[:60]}' (header damaged). Export it again."
        )
    unit = _unit_of_length(path, {unit.strip().lower() for unit in re.findall(r'"([^"]*)"', units)})
    to_lps_mm = np.array(_TO_LPS[fields["space"].lower()]) * _MM_PER_UNIT[unit]
    columns = np.stack([*axes.values()], axis=1) * to_lps_mm[:, None]
    origin = _vector(path, fields.get("space origin", ""), "space origin") * to_lps_mm
    grid = grid_of_axes(path, [sizes[axis] for axis in axes], columns, origin)
    dtype = np.dtype((">" if order == "big" else "<") + _NRRD_TYPES[kind])
    packed = encoding != "raw"
    return StoredVolume(data, grid, dtype, tuple(sizes), unit, start, packed, select=select, components=along)


def _fourth_axis(
    path: Path, fields: Mapping[str, str], sizes: list[int], other: int | None, volume: int | None,
    components: int | None,
) -> tuple[tuple[int, int] | None, int | None]:  # fmt: skip
    """What is kept of a fourth axis: a volume (axis, index), or a vector's ``components`` (axis)."""
    kinds = fields.get("kinds", "").split()
    kind = kinds[other].lower() if other is not None and len(kinds) == len(sizes) else ""
    count = 1 if other is None else sizes[other]
    if components is not None:
        if count != components:
            raise ImageFileError(f"{path}: {count} components per voxel; {_vectors_of(components)} are needed.")
        if kind not in ("", "none", "???", "list") and not kind.endswith("vector"):
            raise ImageFileError(f"{path}: the three values per voxel are of kind {kind}; vectors are needed.")
        return None, other
    if path.name.lower().endswith(".seg.nrrd") and count > 1:
        raise ImageFileError(
            f"{path}: the segmentation has {count} layers, so segments overlap. A label map has one label per "
            "voxel. In Slicer, export the segments to a label map, or remove the overlap."
        )
    if count > 1 and not any(word in kind for word in ("list", "domain", "time", "?", "none")) and kind:
        raise ImageFileError(f"{path}: each voxel holds {count} values (kind {kind}); a scalar image is needed.")
    index = pick_volume(path, count, volume)
    return None if other is None else (other, index), None


def _vectors_of(components: int) -> str:
    return f"vectors of {'three' if components == 3 else components}"


def _steps(path: Path, fields: Mapping[str, str]) -> list[FloatArray | None]:
    """The step (3,) along each axis in the header's space; None for an axis that is not one of space."""
    written, space = fields.get("space directions"), fields.get("space", "").lower()
    if written is None or space not in _TO_LPS:
        raise ImageFileError(
            f"{path}: the NRRD header has no supported orientation (space: '{space or 'none'}', space directions: "
            f"{'given' if written else 'none'}). Supported spaces: {sorted(_TO_LPS)}."
        )
    if not re.fullmatch(r"((none|\([^()]*\))\s*)+", written):
        raise ImageFileError(
            f"{path}: 'space directions' are not vectors: '{written[:60]}' (header damaged). Export it again."
        )
    items = re.findall(r"none|\([^()]*\)", written)
    return [None if item == "none" else _vector(path, item, "space directions") for item in items]


def _vector(path: Path, written: str, field: str) -> FloatArray:
    """The three numbers of ``(x,y,z)``."""
    if match := re.fullmatch(r"\(([^(),]*),([^(),]*),([^(),]*)\)", written):
        with suppress(ValueError):
            vector = numbers(match.groups())
            if np.isfinite(vector).all():
                return vector
    what = f"the header's '{field}' is missing or not a vector (x,y,z): '{written[:60]}'"
    raise ImageFileError(f"{path}: {what}. Export it again.")


def read_meta_header(
    path: Path, volume: int | None, max_bytes: int, vectors: bool, components: int = 3
) -> StoredVolume:
    """What a MetaImage file holds: scalars, or with `vectors` so many `components` per voxel."""
    fields, end = _meta_fields(path)
    sizes = _whole_numbers(path, fields, "dimsize")
    if len(sizes) != 3 or fields.get("ndims") != "3":
        raise ImageFileError(
            f"{path}: a {len(sizes)}D image of sizes {sizes}; a 3D image is needed. Give all slices in one file."
        )
    layout = (components, *sizes) if vectors else tuple(sizes)
    refuse_if_too_large(path, layout, max_bytes)
    pick_volume(path, 1, volume)
    channels = fields.get("elementnumberofchannels", "1")
    if vectors and channels != str(components):
        raise ImageFileError(f"{path}: {channels} components per voxel; {_vectors_of(components)} are needed.")
    if not vectors and channels != "1":
        raise ImageFileError(f"{path}: each voxel holds {channels} values; a scalar image is needed.")
    kind = fields.get("elementtype", "")
    if kind not in _META_TYPES or not _truth(path, fields, "binarydata", True):
        raise ImageFileError(f"{path}: voxels of type '{kind}', or as text, are not supported; save it as binary.")
    if _numbers_in(path, fields.get("headersize", "0"), "HeaderSize", 1) != [0.0]:
        raise ImageFileError(f"{path}: MetaImage files with a HeaderSize are not supported; save it again as .mha.")
    named = fields["elementdatafile"]
    data, start = (path, end) if named == "LOCAL" else (_detached_file(path, named), 0)
    if _META_TYPES[kind][1] != "1" and not set(_BYTE_ORDER) & set(fields):
        raise ImageFileError(f"{path}: the header does not give the byte order ({_BYTE_ORDER[0]}); save it again.")
    big = any(_truth(path, fields, name, False) for name in _BYTE_ORDER)
    matrix, spacing = _needed(path, fields, _MATRIX, 9), _needed(path, fields, _SPACING, 3)
    origin = _needed(path, fields, _ORIGIN, 3)
    unit = _unit_of_length(path, {fields.get("distanceunits", "mm").lower()})
    scale = _MM_PER_UNIT[unit]
    columns = matrix.reshape(3, 3).T * spacing  # a row of the matrix is the direction of one image axis
    grid = grid_of_axes(path, sizes, columns * scale, origin * scale)
    dtype = np.dtype((">" if big else "<") + _META_TYPES[kind])
    packed = _truth(path, fields, "compresseddata", False)
    return StoredVolume(data, grid, dtype, layout, unit, start, packed, components=0 if vectors else None)


def _meta_fields(path: Path) -> tuple[dict[str, str], int]:
    """Fields of a MetaImage header (names in lower case), and where it ends (bytes)."""
    with path.open("rb") as file:
        start = file.read(_HEADER_LIMIT)
    last = re.search(rb"^[ \t]*ElementDataFile[ \t]*=[^\r\n]*\r?\n?", start, re.MULTILINE)
    if last is None:
        raise ImageFileError(f"{path}: not a MetaImage file (its header has no ElementDataFile). Export it again.")
    lines = [line for line in start[: last.end()].decode("utf-8", errors="replace").splitlines() if line.strip()]
    damaged = [line for line in lines if "=" not in line]
    if damaged:
        line = f"this line is not a field: '{damaged[0][:60]}'"
        raise ImageFileError(f"{path}: the MetaImage header is damaged; {line}. Export it again.")
    pairs = (line.split("=", 1) for line in lines)
    return {name.strip().lower(): value.strip() for name, value in pairs}, last.end()


def _needed(path: Path, fields: Mapping[str, str], names: tuple[str, ...], count: int) -> FloatArray:
    """Numbers of a field for which the format has a default, as which a damaged line would be read."""
    written = next((fields[name.lower()] for name in names if name.lower() in fields), None)
    if written is None:
        raise ImageFileError(f"{path}: the MetaImage header has no orientation (no {names[0]}). Export it again.")
    return np.array(_numbers_in(path, written, names[0], count))


def _truth(path: Path, fields: Mapping[str, str], name: str, default: bool) -> bool:
    word = fields.get(name, str(default)).lower()
    if word not in ("true", "t", "1", "false", "f", "0"):
        raise ImageFileError(
            f"{path}: the header is damaged ('{name}' is '{word}', neither True nor False). Export it again."
        )
    return word in ("true", "t", "1")


def _detached_file(path: Path, name: str) -> Path:
    """The file beside a header that holds its voxels."""
    if name.startswith("LIST") or "%" in name:
        raise ImageFileError(f"{path}: voxels in several files are not supported; save it as one file.")
    with suppress(OSError):  # no name that a file can have
        if (path.parent / name).is_file():
            return path.parent / name
    raise ImageFileError(f"{path}: the file with the voxels, '{name}', is missing; keep both in one folder.")


def _numbers_in(path: Path, text: str, field: str, count: int | None = None) -> list[float]:
    """Numbers of a field, ``count`` of them; refused if it is missing or damaged."""
    found: list[float] = []
    with suppress(ValueError):
        found = numbers(text.replace(",", " ").split()).tolist()
    if not found or not np.isfinite(found).all() or (count is not None and len(found) != count):
        what = f"the header's '{field}' is missing or not a list of numbers: '{text[:60]}'"
        raise ImageFileError(f"{path}: {what}. Export it again.")
    return found


def _whole_numbers(path: Path, fields: Mapping[str, str], field: str) -> list[int]:
    found = _numbers_in(path, fields.get(field, ""), field)
    if not all(n.is_integer() and abs(n) < _LARGEST_SIZE for n in found):
        raise ImageFileError(
            f"{path}: the header is damaged ('{field}' must be whole numbers; got {found}). Export it again."
        )
    return [int(n) for n in found]


def _unit_of_length(path: Path, units: set[str]) -> str:
    """The one unit of length; mm where none is given."""
    known = {unit or "mm" for unit in units} or {"mm"}
    if len(known) != 1 or not known <= set(_MM_PER_UNIT):
        raise ImageFileError(f"{path}: lengths are in {sorted(units)}; supported units are mm, cm, m and um.")
    return known.pop()
