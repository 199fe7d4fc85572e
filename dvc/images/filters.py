"""Filters that go along one axis after the other, on all threads: Gaussians, and the coefficients of cubic splines.

The coefficients are those of `scipy.ndimage.spline_filter`, bit for bit. Gaussians are those of
`scipy.ndimage.gaussian_filter`, in single precision, which takes a quarter to a sixth of its time. Along the first axis
neighbours are far apart in memory, so a few of its lines at a time are copied together first.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d, spline_filter1d

from dvc.arrays import Float32Array, IntArray
from dvc.compiled import njit
from dvc.threads import SMALL, in_parts

_Values = npt.NDArray[Any]
_Filter = Callable[[_Values, int, _Values], object]  # of values along an axis, into another array

_SLAB = 8  # lines of the second axis that are copied together
TRUNCATE = 4.0
"""Standard deviations at which a Gaussian ends."""
_BEYOND = {"nearest": "edge", "reflect": "symmetric", "wrap": "wrap"}  # scipy's names of modes, and NumPy's


def gaussian(values: _Values, sigma: npt.ArrayLike, mode: str = "reflect", order: npt.ArrayLike = 0) -> _Values:
    """Values (ni, nj, nk), floats, convolved with a Gaussian of ``sigma`` voxels, or with its derivatives.

    ``sigma`` and ``order`` are one number, or one an axis; ``mode`` is what lies beyond the ends, as scipy names it.
    The sums are in single precision; the result has the type of the values.
    """
    widths, orders = np.broadcast_to(sigma, 3), np.broadcast_to(order, 3)
    weights = [_weights(float(width), int(order)) for width, order in zip(widths, orders, strict=True)]

    def along(part: Float32Array, axis: int, into: Float32Array) -> None:
        if (own := weights[axis]).size == 1:
            into[:] = part
            return
        taken = _taken(part.shape[axis], own.size // 2, mode)
        if axis == 2:
            _along_lines(part, own, taken, into)
        else:
            shape = (1, part.shape[0], -1) if axis == 0 else part.shape
            _across_lines(part.reshape(shape), own, taken, into.reshape(shape))

    return _along_each_axis(values.astype(np.float32, copy=False), np.float32, along).astype(values.dtype, copy=False)


def _weights(width: float, order: int) -> Float32Array:
    """Those of scipy, (2 r + 1,), of the values from r places before to r places after."""
    if width <= 1e-15:
        return np.ones(1, np.float32)
    reach = int(TRUNCATE * width + 0.5)
    impulse = np.eye(1, 2 * reach + 1, reach)[0]
    answer = gaussian_filter1d(impulse, width, order=order, mode="constant", truncate=TRUNCATE)
    return np.ascontiguousarray(answer[::-1], np.float32)


def _taken(count: int, reach: int, mode: str) -> IntArray:
    """Index of the value that stands at each place (count + 2 reach,) from ``reach`` before the first; -1 for zero."""
    if mode == "constant":
        return np.pad(np.arange(count), reach, constant_values=-1)
    taken: IntArray = np.pad(np.arange(count), reach, mode=_BEYOND[mode])  # type: ignore[call-overload]  # literals
    return taken


@njit(nogil=True, cache=True)
def _across_lines(values: Float32Array, weights: Float32Array, taken: IntArray, into: Float32Array) -> None:
    """Weighted sums along the second axis, whole lines of the third at a time."""
    reach = weights.size // 2
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            line, onto, weight = values[i, j], into[i, j], weights[reach]
            for k in range(onto.size):
                onto[k] = weight * line[k]
            for t in range(reach):  # a line before and one after: half as many sums are written
                first, last = taken[j + t], taken[j + 2 * reach - t]
                one, other = values[i, first if first >= 0 else j], values[i, last if last >= 0 else j]
                low = weights[t] if first >= 0 else np.float32(0.0)
                high = weights[2 * reach - t] if last >= 0 else np.float32(0.0)
                for k in range(onto.size):
                    onto[k] += low * one[k] + high * other[k]


@njit(nogil=True, cache=True)
def _along_lines(values: Float32Array, weights: Float32Array, taken: IntArray, into: Float32Array) -> None:
    """Weighted sums along the last axis."""
    count, reach = values.shape[2], weights.size // 2
    longer = np.empty(taken.size, np.float32)
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            line, onto, weight = values[i, j], into[i, j], weights[reach]
            for k in range(taken.size):
                longer[k] = line[taken[k]] if taken[k] >= 0 else np.float32(0.0)
            for k in range(count):
                onto[k] = weight * line[k]
            for t in range(reach):
                one, other = longer[t : t + count], longer[2 * reach - t : 2 * reach - t + count]
                low, high = weights[t], weights[2 * reach - t]
                for k in range(onto.size):
                    onto[k] += low * one[k] + high * other[k]


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
        filtered(part, 1, between := np.empty(part.shape, dtype))
        filtered(between, 2, part)

    if values.size < SMALL:  # done before another thread is awake
        across(0, values.shape[1])
        within(0, values.shape[0])
    else:
        in_parts(across, values.shape[1])
        in_parts(within, values.shape[0])
    return found
