"""Filters that go along one axis after the other, on all threads: Gaussians, and the coefficients of cubic splines.

Values are those of `scipy.ndimage.gaussian_filter` and `spline_filter`, bit for bit. Along the first axis neighbours
are far apart in memory, so a few of its lines at a time are copied together first.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d, spline_filter1d

from dvc.threads import SMALL, in_parts

_Values = npt.NDArray[Any]
_Filter = Callable[[_Values, int, _Values], object]  # of values along an axis, into an array that may be the same

_SLAB = 8  # lines of the second axis that are copied together


def gaussian(values: _Values, sigma: npt.ArrayLike, mode: str = "reflect", order: npt.ArrayLike = 0) -> _Values:
    """Values (ni, nj, nk), floats, convolved with a Gaussian of ``sigma`` voxels, or with its derivatives.

    ``sigma`` and ``order`` are one number, or one an axis; ``mode`` is what lies beyond the ends, as scipy names it.
    """
    widths, orders = np.broadcast_to(sigma, 3), np.broadcast_to(order, 3)

    def along(part: _Values, axis: int, into: _Values) -> None:
        if widths[axis] > 1e-15:
            gaussian_filter1d(part, float(widths[axis]), axis, int(orders[axis]), into, mode)
        elif into is not part:
            into[:] = part

    return _along_each_axis(values, values.dtype, along)


def spline_coefficients(values: _Values, dtype: npt.DTypeLike) -> _Values:
    """Coefficients (ni, nj, nk) of the cubic B-splines that go through values, which are mirrored beyond the ends."""
    return _along_each_axis(values, dtype, lambda part, axis, into: spline_filter1d(part, 3, axis, into, "mirror"))


def _along_each_axis(values: _Values, dtype: npt.DTypeLike, filtered: _Filter) -> _Values:
    found = np.empty(values.shape, dtype)

    def across(start: int, stop: int) -> None:
        for first in range(start, stop, _SLAB):
            lines = slice(first, min(first + _SLAB, stop))
            part = np.ascontiguousarray(values[:, lines])
            filtered(part, 0, into := np.empty(part.shape, dtype))
            found[:, lines] = into

    def within(start: int, stop: int) -> None:
        part = found[start:stop]
        filtered(part, 1, part)
        filtered(part, 2, part)

    if values.size < SMALL:  # done before another thread is awake
        across(0, values.shape[1])
        within(0, values.shape[0])
    else:
        in_parts(across, values.shape[1])
        in_parts(within, values.shape[0])
    return found
