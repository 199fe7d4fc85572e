"""Image values at points in space, and images carried to another grid."""

from collections.abc import Callable

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, map_coordinates, spline_filter

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.images.image import Grid, Image

_SLAB_VOXELS = 500_000


def fill_missing(image: Image) -> Image:
    """The image with missing voxels set to their nearest known neighbour, for what cannot leave voxels out.

    A constant would be an edge that is not there, and blurring and splines would carry it into what is known.
    """
    if not (missing := image.missing).any():
        return image
    spacing = image.grid.spacing_mm
    nearest = distance_transform_edt(missing, sampling=spacing, return_distances=False, return_indices=True)
    return Image(image.grid, image.values[tuple(nearest)])


def smoothed(image: Image, sigma_mm: float) -> Image:
    """The image blurred by a Gaussian of ``sigma_mm`` in space; missing voxels stay missing."""
    sigma = sigma_mm / image.grid.spacing_mm
    values = gaussian_filter(fill_missing(image).values, sigma, mode="nearest")
    return Image(image.grid, np.where(image.missing, np.float32(np.nan), values))


def thinned(image: Image, every: tuple[slice, ...]) -> Image:
    """Every so manyth voxel of an image along each axis, the first among them."""
    grid, values = image.grid, image.values[every]
    i, j, k = values.shape
    return Image(Grid((i, j, k), grid.spacing_mm * [one.step for one in every], grid.origin_mm, grid.direction), values)


def shows(image: Image, points_mm: FloatArray, margin_mm: float = 0.0) -> BoolArray:
    """Whether an image has values at points (n, 3) LPS mm, and for ``margin_mm`` around along its axes.

    That is inside its voxel centres' box, with no missing voxel beside. NaN points are not shown.
    """
    at = image.grid.indices_of(points_mm)
    margin = margin_mm / image.grid.spacing_mm - 1e-6
    known = np.all((at >= margin) & (at <= np.array(image.grid.shape) - 1 - margin), axis=1)
    if image.missing.any():
        distance = distance_transform_edt(~image.missing, sampling=image.grid.spacing_mm)
        gaps = (distance <= margin_mm).astype(np.float32)
        known[known] = map_coordinates(gaps, at[known].T, order=1, mode="nearest") <= 1e-6
    return np.asarray(known)


def carry(
    image: Image, grid: Grid, points_of: Callable[[FloatArray], FloatArray] | None = None,
    where: BoolArray | None = None, order: int = 3, displacement_mm: FloatArray | None = None,
) -> Float32Array:  # fmt: skip
    """Values of ``image`` on ``grid``, NaN where any of the eight voxels around is missing or outside.

    ``points_of`` maps points (n, 3) LPS mm of the grid to those of the image whose values they take (default: the
    identity; NaN points give NaN), after a ``displacement_mm`` (ni, nj, nk, 3) of the grid's voxels, LPS, where one is
    given; ``where`` (ni, nj, nk) are the voxels wanted; ``order`` is 1 for linear, 3 for cubic spline interpolation.
    """
    gaps = image.missing.astype(np.float32) if image.missing.any() else None
    coefficients = fill_missing(image).values
    if order > 1:
        coefficients = spline_filter(coefficients, order=order, output=np.float32, mode="mirror")
    carried = np.full(grid.shape, np.nan, dtype=np.float32)
    inside = np.ones(grid.shape, dtype=bool) if where is None else where
    step = max(1, _SLAB_VOXELS // (grid.shape[1] * grid.shape[2]))
    last = np.array(image.grid.shape) - 1
    for start in range(0, grid.shape[0], step):
        wanted = inside[start : start + step]
        if not wanted.any():
            continue
        indices = np.argwhere(wanted).astype(np.float64)
        indices[:, 0] += start
        points = grid.points_at(indices)
        if displacement_mm is not None:
            points = points + displacement_mm[start : start + step][wanted]
        at = image.grid.indices_of(points if points_of is None else points_of(points))
        known = np.all((at >= -1e-6) & (at <= last + 1e-6), axis=1)  # False for NaN as well
        values = np.full(len(at), np.nan, dtype=np.float32)
        values[known] = map_coordinates(
            coefficients, at[known].T, order=order, mode="mirror", prefilter=False, output=np.float32
        )
        if gaps is not None:
            touched = map_coordinates(gaps, at[known].T, order=1, mode="nearest") > 1e-6
            values[np.flatnonzero(known)[touched]] = np.nan
        carried[start : start + step][wanted] = values
    return carried
