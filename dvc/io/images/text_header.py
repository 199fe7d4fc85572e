"""What the text headers of NRRD and MetaImage share: numbers, units, axes, and voxels in a file beside."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import GeometryError, ImageFileError
from dvc.images.image import Grid

HEADER_LIMIT = 1 << 20
"""Bytes within which a header has to end."""

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001, "µm": 0.001, "micron": 0.001}
_LARGEST_SIZE = 2.0**63
_ORTHONORMAL = 1e-4


def header_start(path: Path) -> bytes:
    """The part of a file that its header has to lie in."""
    with path.open("rb") as file:
        return file.read(HEADER_LIMIT)


def detached_file(path: Path, name: str) -> Path:
    """Find the file beside a header that holds its voxels."""
    if name.startswith("LIST") or "%" in name:
        raise ImageFileError(f"{path}: voxels spread over several files are not read; save it as one file.")
    with suppress(OSError):  # no name that a file can have
        if (path.parent / name).is_file():
            return path.parent / name
    raise ImageFileError(f"{path}: the file of its voxels, '{name}', is not there; keep the two together.")


def numbers_in(path: Path, text: str, field: str, count: int | None = None) -> list[float]:
    """Numbers of a field, ``count`` of them; refused if it is missing or damaged."""
    try:
        numbers = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        numbers = []
    if not numbers or (count is not None and len(numbers) != count):
        raise ImageFileError(f"{path}: the header's '{field}' is missing or not a list of numbers: '{text[:60]}'.")
    return numbers


def whole_numbers(path: Path, fields: Mapping[str, str], field: str) -> list[int]:
    """Whole numbers of a field; refused if it is missing or damaged."""
    numbers = numbers_in(path, fields.get(field, ""), field)
    if not all(n.is_integer() and abs(n) < _LARGEST_SIZE for n in numbers):
        raise ImageFileError(f"{path}: the header's '{field}' must be whole numbers; got {numbers}: damaged.")
    return [int(n) for n in numbers]


def unit_of_length(path: Path, units: set[str]) -> str:
    """The one unit of length; mm where none is given."""
    known = {unit or "mm" for unit in units} or {"mm"}
    if len(known) != 1 or not known <= set(MM_PER_UNIT):
        raise ImageFileError(f"{path}: lengths in {sorted(units)}; the units that are read are mm, cm, m and um.")
    return known.pop()


def grid_of_axes(
    path: Path, shape: Sequence[int], columns: FloatArray, origin: FloatArray, *, single_precision: bool = False
) -> Grid:
    """The grid with these steps along its axes, (3, 3) by columns, and origin, LPS mm."""
    with np.errstate(over="ignore"):
        spacing = np.linalg.norm(columns, axis=0)
    if not np.isfinite(spacing).all() or np.any(spacing <= 0):
        raise ImageFileError(f"{path}: the header's voxel sizes are {spacing.tolist()} mm; all must be positive.")
    direction = columns / spacing
    if single_precision:
        left, stretch, right = np.linalg.svd(direction)
        direction = left @ right if np.abs(stretch - 1.0).max() < _ORTHONORMAL / 2 else direction
    try:
        return Grid((shape[0], shape[1], shape[2]), spacing, origin, direction)
    except GeometryError as error:
        raise ImageFileError(f"{path}: {error}") from error
