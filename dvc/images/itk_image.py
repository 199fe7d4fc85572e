"""Grids and their values as images of ITK and back: the one place where the two conventions meet.

Both are LPS mm. ITK keeps its arrays with the last axis first, and the components of a voxel last.
"""

from typing import Any

import numpy as np
import numpy.typing as npt
import SimpleITK as sitk

from dvc.images.image import Grid

Values = npt.NDArray[Any]
Reals = npt.NDArray[np.floating[Any]]


def to_sitk(grid: Grid, values: Values) -> sitk.Image:
    """Values (ni, nj, nk) or (ni, nj, nk, components) on a grid as an image of SimpleITK."""
    image = sitk.GetImageFromArray(_axes_reversed(values), isVector=values.ndim == 4)
    image.SetSpacing(grid.spacing_mm.tolist())
    image.SetOrigin(grid.origin_mm.tolist())
    image.SetDirection(grid.direction.ravel().tolist())
    return image


def to_itk(grid: Grid, values: Values, itk: Any) -> Any:
    """Values (ni, nj, nk) on a grid as an image of ``itk``, the module, which takes seconds to import."""
    image = itk.image_from_array(_axes_reversed(values))
    image.SetSpacing(grid.spacing_mm.tolist())
    image.SetOrigin(grid.origin_mm.tolist())
    image.SetDirection(itk.matrix_from_array(np.array(grid.direction)))
    return image


def from_sitk(image: sitk.Image) -> tuple[Grid, Reals]:
    """Grid and values (ni, nj, nk) or (ni, nj, nk, components) of a SimpleITK image of real numbers."""
    ni, nj, nk = image.GetSize()
    direction = np.reshape(image.GetDirection(), (3, 3))
    grid = Grid((ni, nj, nk), np.array(image.GetSpacing()), np.array(image.GetOrigin()), direction)
    return grid, np.moveaxis(sitk.GetArrayFromImage(image), (0, 1, 2), (2, 1, 0))


def _axes_reversed(values: Values) -> Values:
    return np.ascontiguousarray(np.moveaxis(values, (0, 1, 2), (2, 1, 0)))
