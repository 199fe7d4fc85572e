"""Cubic B-splines and linear interpolation between voxels, compiled: the weights, and values at any index."""

import numpy as np

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.compiled import njit

Four = tuple[int, int, int, int]
"""Places of the four coefficients along an axis whose B-splines are not zero at a point."""
Weights = tuple[float, float, float, float]
"""Values or slopes of these four B-splines at the point."""

_ROUNDING = 1e-6  # voxels


@njit(cache=True)
def spline_basis(f: float) -> tuple[Weights, Weights]:
    """Values and slopes of the four cubic B-splines that are not zero at a fraction f of an interval."""
    g = 1.0 - f
    value = (g * g * g / 6.0, 2.0 / 3.0 - f * f * (1.0 - 0.5 * f), 2.0 / 3.0 - g * g * (1.0 - 0.5 * g), f * f * f / 6.0)
    slope = (-0.5 * g * g, f * (1.5 * f - 2.0), g * (2.0 - 1.5 * g), 0.5 * f * f)
    return value, slope


@njit(cache=True)
def _reflected(index: int, count: int) -> int:
    """Reflect an index beyond the borders about the outermost until it is inside."""
    if count == 1:
        return 0
    period = 2 * (count - 1)
    inside = index % period
    return period - inside if inside >= count else inside


@njit(cache=True)
def indices_around(below: float, count: int) -> Four:
    """The four coefficients along an axis that reach the interval above an index, reflected beyond the borders."""
    first = int(below) - 1
    if first >= 0 and first + 4 <= count:
        return first, first + 1, first + 2, first + 3
    a, b = _reflected(first, count), _reflected(first + 1, count)
    return a, b, _reflected(first + 2, count), _reflected(first + 3, count)


@njit(cache=True)
def _single(weights: Weights) -> Weights:
    """The weights in single precision."""
    a, b, c, d = weights
    return np.float32(a), np.float32(b), np.float32(c), np.float32(d)  # type: ignore[return-value]


@njit(cache=True)
def cubic_at(image: Float32Array, x: float, y: float, z: float) -> float:
    """The cubic spline of coefficients (ni, nj, nk) at a finite index, from sums in single precision."""
    i, j, k = np.floor(x), np.floor(y), np.floor(z)
    a, b, c = _single(spline_basis(x - i)[0]), _single(spline_basis(y - j)[0]), _single(spline_basis(z - k)[0])
    (ni, nj, nk), (first_i, first_j, first_k) = image.shape, (int(i) - 1, int(j) - 1, int(k) - 1)
    total = np.float32(0.0)
    if min(first_i, first_j, first_k) < 0 or first_i + 4 > ni or first_j + 4 > nj or first_k + 4 > nk:
        rows, columns, beside = indices_around(i, ni), indices_around(j, nj), indices_around(k, nk)
        for p in range(4):
            for q in range(4):
                row = image[rows[p], columns[q]]
                line = c[0] * row[beside[0]] + c[1] * row[beside[1]] + c[2] * row[beside[2]] + c[3] * row[beside[3]]
                total += a[p] * b[q] * line
        return np.float64(total)
    sums = np.float32(0.0), np.float32(0.0), np.float32(0.0), np.float32(0.0)
    around = image[first_i : first_i + 4, first_j : first_j + 4, first_k : first_k + 4]
    for p in range(4):  # written out, so that the compiler takes the four of a row at once
        near, w = around[p], a[p]
        s = b[0] * near[0, 0] + b[1] * near[1, 0] + b[2] * near[2, 0] + b[3] * near[3, 0]
        t = b[0] * near[0, 1] + b[1] * near[1, 1] + b[2] * near[2, 1] + b[3] * near[3, 1]
        u = b[0] * near[0, 2] + b[1] * near[1, 2] + b[2] * near[2, 2] + b[3] * near[3, 2]
        v = b[0] * near[0, 3] + b[1] * near[1, 3] + b[2] * near[2, 3] + b[3] * near[3, 3]
        sums = sums[0] + w * s, sums[1] + w * t, sums[2] + w * u, sums[3] + w * v
    return np.float64(c[0] * sums[0] + c[1] * sums[1] + c[2] * sums[2] + c[3] * sums[3])


@njit(cache=True)
def _between(x: float, count: int) -> tuple[int, int, float]:
    """The voxels on either side of an index along an axis, and its share of the second; the ends where it is beyond."""
    inside = min(max(x, 0.0), count - 1.0)
    low = int(inside)
    return low, min(low + 1, count - 1), inside - low


@njit(cache=True)
def _linear_at(image: Float32Array, x: float, y: float, z: float) -> float:
    """Values (ni, nj, nk) between voxels, at a continuous index."""
    i, after_i, a = _between(x, image.shape[0])
    j, after_j, b = _between(y, image.shape[1])
    k, after_k, c = _between(z, image.shape[2])
    low = (1.0 - b) * ((1.0 - c) * image[i, j, k] + c * image[i, j, after_k])
    low += b * ((1.0 - c) * image[i, after_j, k] + c * image[i, after_j, after_k])
    high = (1.0 - b) * ((1.0 - c) * image[after_i, j, k] + c * image[after_i, j, after_k])
    high += b * ((1.0 - c) * image[after_i, after_j, k] + c * image[after_i, after_j, after_k])
    return float((1.0 - a) * low + a * high)


@njit(nogil=True, cache=True)
def sample_values(
    begin: int,
    end: int,
    image: Float32Array,
    cubic: bool,
    points: FloatArray,
    per_mm: FloatArray,
    start: FloatArray,
    values: FloatArray,
) -> None:
    """Values at points (n, 3) mm, whose indices in the image are ``start + per_mm @ point``; NaN beyond its voxels."""
    ni, nj, nk = image.shape
    for n in range(begin, end):
        a, b, c = points[n, 0], points[n, 1], points[n, 2]
        x = start[0] + per_mm[0, 0] * a + per_mm[0, 1] * b + per_mm[0, 2] * c
        y = start[1] + per_mm[1, 0] * a + per_mm[1, 1] * b + per_mm[1, 2] * c
        z = start[2] + per_mm[2, 0] * a + per_mm[2, 1] * b + per_mm[2, 2] * c
        if 0.0 <= x <= ni - 1 and 0.0 <= y <= nj - 1 and 0.0 <= z <= nk - 1:
            values[n] = cubic_at(image, x, y, z) if cubic else _linear_at(image, x, y, z)
        else:
            values[n] = np.nan


@njit(nogil=True, cache=True)
def carry_values(
    begin: int, end: int, image: Float32Array, gaps: Float32Array, cubic: bool, where: BoolArray, step: FloatArray,
    start: FloatArray, displacement: Float32Array, per_mm: FloatArray, carried: Float32Array,
) -> None:  # fmt: skip
    """Values of an image at the voxels ``where`` of a grid (ni, nj, nk), NaN where not known, into the last array.

    Voxel (i, j, k) lies at the image's index ``start + step @ (i, j, k) + per_mm @ u``, u its displacement (ni, nj, nk,
    3), mm. ``gaps`` is 1 at missing voxels, and empty where none is missing; so is a displacement that is zero.
    """
    ni, nj, nk = image.shape
    for i in range(begin, end):
        for j in range(where.shape[1]):
            for k in range(where.shape[2]):
                if not where[i, j, k]:
                    continue
                x = start[0] + step[0, 0] * i + step[0, 1] * j + step[0, 2] * k
                y = start[1] + step[1, 0] * i + step[1, 1] * j + step[1, 2] * k
                z = start[2] + step[2, 0] * i + step[2, 1] * j + step[2, 2] * k
                if displacement.shape[0] > 0:
                    u = displacement[i, j, k]
                    x += per_mm[0, 0] * u[0] + per_mm[0, 1] * u[1] + per_mm[0, 2] * u[2]
                    y += per_mm[1, 0] * u[0] + per_mm[1, 1] * u[1] + per_mm[1, 2] * u[2]
                    z += per_mm[2, 0] * u[0] + per_mm[2, 1] * u[1] + per_mm[2, 2] * u[2]
                shown = -_ROUNDING <= x <= ni - 1 + _ROUNDING and -_ROUNDING <= y <= nj - 1 + _ROUNDING
                if not (shown and -_ROUNDING <= z <= nk - 1 + _ROUNDING):  # NaN is not shown, either
                    continue
                if gaps.shape[0] > 0 and _linear_at(gaps, x, y, z) > _ROUNDING:
                    continue
                carried[i, j, k] = cubic_at(image, x, y, z) if cubic else _linear_at(image, x, y, z)
