"""Control grids with points twice as far apart, on which a solver sees long waves.

A cubic B-spline is the sum of five of half its width, so the splines of a coarser grid are among those of a finer one.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.sparse import csr_array

from dvc.arrays import FloatArray
from dvc.compiled import njit
from dvc.deformation.bspline import Table
from dvc.threads import SMALL, in_parts

GRIDS = 3
"""Control grids that a solver looks at: the given one, and each next with points twice as far apart."""
TWICE_AS_WIDE = np.array([1.0, 4.0, 6.0, 4.0, 1.0]) / 8.0
"""Coefficients of the cubic B-spline of twice the width: a sum of five."""
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Components of a symmetric 3 x 3 matrix, in the order of its six numbers: xx, xy, xz, yy, yz, zz."""


def coarser(shape: Sequence[int]) -> tuple[int, int, int]:
    """Shape of the control grid whose points are twice as far apart, and whose splines are among those of a finer one.

    Its point j lies on point 2 j - 2 of the finer grid: a cubic B-spline is the sum of five of half its width.
    """
    i, j, k = ((n - 1) // 2 + 3 for n in shape)
    return i, j, k


def onto_coarser(force: FloatArray) -> FloatArray:
    """Sum forces (n, mi, mj, mk) on splines into those on splines of twice the width: the transpose of `onto_finer`."""
    for axis, count in enumerate(coarser(force.shape[1:]), start=1):
        force = _along(axis, _summed, force, count)
    return force


def onto_finer(coefficients: FloatArray, shape: Sequence[int]) -> FloatArray:
    """The same displacement from coefficients (n, mi, mj, mk) of splines of twice the width, on the finer grid."""
    for axis, count in enumerate(shape, start=1):
        coefficients = _along(axis, _refined, coefficients, count)
    return coefficients


def _along(axis: int, kernel: Callable[..., None], given: FloatArray, count: int) -> FloatArray:
    """What a kernel makes of an array along one of its axes, which has so many places then."""
    before, here, after = given.shape[:axis], given.shape[axis], given.shape[axis + 1 :]
    out = np.empty((*before, count, *after))
    lines, found = given.reshape(-1, here, int(np.prod(after))), out.reshape(-1, count, int(np.prod(after)))
    if out.size < SMALL:
        kernel(0, len(lines), lines, found)
    else:
        in_parts(kernel, len(lines), lines, found)
    return out


@njit(nogil=True, cache=True)
def _summed(start: int, stop: int, fine: FloatArray, out: FloatArray) -> None:
    count = out.shape[1]
    padded = np.zeros((2 * count + 3, fine.shape[2]))  # beyond the finer grid there is no force
    for n in range(start, stop):
        for i in range(fine.shape[1]):
            for k in range(fine.shape[2]):
                padded[4 + i, k] = fine[n, i, k]
        for i in range(count):
            a, b, c, d, e = padded[2 * i], padded[2 * i + 1], padded[2 * i + 2], padded[2 * i + 3], padded[2 * i + 4]
            for k in range(fine.shape[2]):
                out[n, i, k] = 0.125 * (a[k] + e[k]) + 0.5 * (b[k] + d[k]) + 0.75 * c[k]


@njit(nogil=True, cache=True)
def _refined(start: int, stop: int, coarse: FloatArray, out: FloatArray) -> None:
    for n in range(start, stop):
        for i in range(out.shape[1]):
            before, here = coarse[n, i // 2], coarse[n, i // 2 + 1]
            after = coarse[n, i // 2 + 2]
            if i % 2:
                for k in range(out.shape[2]):
                    out[n, i, k] = 0.5 * (here[k] + after[k])
            else:
                for k in range(out.shape[2]):
                    out[n, i, k] = 0.125 * (before[k] + after[k]) + 0.75 * here[k]


def paired(field: FloatArray) -> FloatArray:
    """Sums over two neighbours along each of the first three axes."""
    for axis in range(3):
        even = np.moveaxis(field, axis, 0)
        out = even[0::2].copy()
        out[: len(even) // 2] += even[1::2]
        field = np.moveaxis(out, 0, axis)
    return field


def spread(
    table: Table, shape: Sequence[int], image: FloatArray | None, volume: FloatArray | None, shear: FloatArray | None
) -> FloatArray:
    """Own blocks (6, mi, mj, mk) from the parts of a stiffness (ni, nj, nk, 6 or 1) at the points of a table."""
    spread = []  # of each axis, the matrices (control points, points) that sum B B, B' B and B' B'
    for (first, v, s), count in zip(table, shape, strict=True):
        at = (first[:, None] + np.arange(4)).ravel(), np.repeat(np.arange(first.size), 4)
        size = (count, first.size)
        spread.append([csr_array((weights.ravel(), at), shape=size) for weights in (v * v, s * v, s * s)])

    def onto(field: FloatArray, slopes: Sequence[int]) -> FloatArray:
        for axis in range(3):
            moved = np.moveaxis(field, axis, 0)
            summed = spread[axis][slopes[axis]] @ moved.reshape(len(moved), -1)
            field = np.moveaxis(summed.reshape(-1, *moved.shape[1:]), 0, axis)
        return np.moveaxis(field, -1, 0)

    out = np.zeros((6, *shape)) if image is None else onto(image, (0, 0, 0))
    for entry, (m, a) in enumerate(PAIRS):
        mixed = [int(axis in {m, a}) for axis in range(3)] if m != a else [2 * (axis == m) for axis in range(3)]
        if volume is not None:
            out[entry] += onto(volume, mixed)[0]
        if shear is not None and m != a:
            out[entry] += 0.5 * onto(shear, mixed)[0]
        elif shear is not None:
            for axis in range(3):
                share = 1.0 if axis == m else 0.5
                out[entry] += share * onto(shear, [2 * (n == axis) for n in range(3)])[0]
    return np.ascontiguousarray(out)
