"""Filters that go along one axis after the other, on all threads: Gaussians, and the coefficients of cubic splines.

Values are those of `scipy.ndimage.gaussian_filter` and `spline_filter`, bit for bit. Along the first axis neighbours
are far apart in memory, so a part is copied together first.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d, spline_filter1d

from dvc.threads import in_parts

Axiswise = Callable[[npt.NDArray[Any], int], npt.NDArray[Any]]
"""Values filtered along one axis."""


def gaussian(
    values: npt.NDArray[Any], sigma: npt.ArrayLike, mode: str = "reflect", order: npt.ArrayLike = 0
) -> npt.NDArray[Any]:
    """Values (ni, nj, nk), floats, convolved with a Gaussian of ``sigma`` voxels, or with its derivatives.

    ``sigma`` and ``order`` are one number, or one an axis; ``mode`` is what lies beyond the ends, as scipy names it.
    """
    widths, orders = np.broadcast_to(sigma, 3), np.broadcast_to(order, 3)

    def along(part: npt.NDArray[Any], axis: int) -> npt.NDArray[Any]:
        if widths[axis] <= 1e-15:
            return part
        return np.asarray(gaussian_filter1d(part, float(widths[axis]), axis, int(orders[axis]), mode=mode))

    return _along_each_axis(values, along)


def spline_coefficients(values: npt.NDArray[Any], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Coefficients (ni, nj, nk) of the cubic B-splines that go through values, which are mirrored beyond the ends."""
    return _along_each_axis(
        values.astype(dtype, copy=False), lambda part, axis: spline_filter1d(part, 3, axis, dtype, "mirror")
    )


def _along_each_axis(values: npt.NDArray[Any], filtered: Axiswise) -> npt.NDArray[Any]:
    found = np.empty(values.shape, values.dtype)

    def across(start: int, stop: int) -> None:
        found[:, start:stop] = filtered(np.ascontiguousarray(values[:, start:stop]), 0)

    def within(start: int, stop: int) -> None:
        found[start:stop] = filtered(filtered(found[start:stop], 1), 2)

    in_parts(across, values.shape[1])
    in_parts(within, values.shape[0])
    return found
