"""Image values at points in space, and images carried to another grid."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.image import Grid, Image

_SLAB_VOXELS = 500_000


def fill_missing(image: Image) -> Image:
    """The image with missing voxels set to its lowest value, for engines that cannot leave voxels out."""
    missing = image.missing
    if not missing.any():
        return image
    return Image(image.grid, np.where(missing, np.nanmin(image.values), image.values))


def smoothed(image: Image, sigma_mm: float) -> Image:
    """The image blurred by a Gaussian of ``sigma_mm`` in space."""
    sigma = sigma_mm / image.grid.spacing_mm
    return Image(image.grid, gaussian_filter(image.values, sigma, mode="nearest"))


def carry(
    image: Image,
    grid: Grid,
    points_of: Callable[[FloatArray], FloatArray] | None = None,
    where: BoolArray | None = None,
    order: int = 3,
) -> Float32Array:
    """Values of ``image`` brought onto ``grid``, NaN where the image has none.

    Parameters
    ----------
    points_of : callable, optional
        Points (n, 3) LPS mm of ``grid`` to the points of the image whose values they take; the identity by
        default. NaN points give NaN.
    where : (ni, nj, nk) bool, optional
        Voxels wanted; the others are NaN.
    order : int
        1 for linear, 3 for cubic spline interpolation.
    """
    missing = image.missing
    filled = fill_missing(image)
    coefficients = (
        spline_filter(filled.values, order=order, output=np.float32, mode="mirror") if order > 1 else filled.values
    )
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
        if points_of is not None:
            points = points_of(points)
        at = image.grid.indices_of(points)
        known = np.all((at >= -1e-6) & (at <= last + 1e-6), axis=1)  # False for NaN as well
        values = np.full(len(at), np.nan, dtype=np.float32)
        values[known] = map_coordinates(
            coefficients, at[known].T, order=order, mode="mirror", prefilter=False, output=np.float32
        )
        if missing.any():
            nearest = np.rint(at[known]).astype(np.int64)
            values[np.flatnonzero(known)[missing[tuple(nearest.T)]]] = np.nan
        carried[start : start + step][wanted] = values
    return carried
