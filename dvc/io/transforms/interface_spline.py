"""A displacement with strain discontinuities as a file of our own, as no ITK transform can hold one."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from dvc.arrays import FloatArray, IntArray, frozen
from dvc.atomic_files import whole_file
from dvc.deformation.bspline import BSpline
from dvc.deformation.interface_spline import NUMBERS, Interfaces, InterfaceSpline
from dvc.errors import InputError, MrstrainError
from dvc.images.image import Grid
from dvc.own_files import read_arrays

FILE = "spline_with_borders.npz"
"""Its name in a folder of results."""
_FORMAT = 1


def write_interface_spline(path: Path, spline: InterfaceSpline) -> None:
    """Write a displacement with strain discontinuities, LPS mm; of interfaces only the tissues' numbers are kept."""
    borders = spline.borders
    content: dict[str, Any] = {
        "format": _FORMAT, "numbers": json.dumps(NUMBERS), "control": _rows_of(spline.control),
        "smooth": spline.smooth.coefficients_mm, "jump": spline.jump.coefficients_mm,
        "voxels": _rows_of(borders.grid), "own": borders.own.astype(np.int16), "rest": borders.rest,
        "reach_mm": borders.reach_mm,
    }  # fmt: skip
    with whole_file(path) as part, part.open("wb") as file:
        np.savez_compressed(file, **content)


def read_interface_spline(path: Path | str) -> InterfaceSpline:
    """Read what `write_interface_spline` wrote."""
    try:
        file = read_arrays(Path(path))
        if int(file["format"]) != _FORMAT:
            raise ValueError(f"the format is {int(file['format'])}; {_FORMAT} is needed")
        if json.loads(str(file["numbers"])) != NUMBERS:
            raise ValueError(f"interfaces were located with {file['numbers']}, now with {NUMBERS}; register again")
        control = _grid(file["control"])
        own = frozen(file["own"], np.int64)
        if own.min() < 0 or own.max() >= own.size or not np.bincount(own.ravel()).all():
            raise ValueError("tissues are not numbered from 0 on without gaps")
        borders = _between(_grid(file["voxels"]), own, int(file["rest"]), float(file["reach_mm"]))
        return InterfaceSpline(BSpline(control, file["smooth"]), BSpline(control, file["jump"]), borders)
    except (OSError, ValueError, KeyError, TypeError, MrstrainError) as failure:
        why = f"{type(failure).__name__}: {failure}"
        what = "not a displacement with tissue interfaces written by `mrstrain register`"
        raise InputError(f"{path}: {what} ({why}).") from failure


_latest: list[Interfaces] = []
"""Loads of one study have their borders in common, which take seconds to find and room in the memory."""


def _between(grid: Grid, own: IntArray, rest: int, reach_mm: float) -> Interfaces:
    """The latest interfaces, if these are the same; otherwise computed anew."""
    for known in _latest:
        same_grid = np.array_equal(_rows_of(known.grid), _rows_of(grid))
        if same_grid and (known.rest, known.reach_mm) == (rest, reach_mm) and np.array_equal(known.own, own):
            return known
    _latest[:] = [Interfaces.between(grid, own, rest, reach_mm)]
    return _latest[0]


def _rows_of(grid: Grid) -> FloatArray:
    """A grid in rows of three numbers: shape, spacing, origin, and the three of its direction."""
    return np.vstack([grid.shape, grid.spacing_mm, grid.origin_mm, grid.direction])


def _grid(rows: FloatArray) -> Grid:
    shape, spacing, origin = rows[:3]
    return Grid((int(shape[0]), int(shape[1]), int(shape[2])), spacing, origin, rows[3:])
