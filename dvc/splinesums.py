"""Sums of a cubic B-spline over a tensor grid of points, and the transposed sums, axis by axis.

What a Gauss-Newton step needs of a B-spline: displacement and gradient at many points from coefficients, forces at
many points put onto coefficients, and both in one sweep for a product with the Hessian. Every result is a sum in a
fixed order, so that it is the same bit for bit on any number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit, prange
from scipy.sparse import csr_array

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.bspline import spline_table
from dvc.image import Grid

_ALONE = np.empty((0, 0, 0, 0, 4))  # factors of a spline that has none
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))

Table = tuple[tuple[IntArray, ...], tuple[FloatArray, ...], tuple[FloatArray, ...]]


class SplineSums:
    """A control grid and points on a tensor grid of the same axes.

    Displacement u and force f are in components along the grid's axes; gradients are per mm along them. A
    displacement may be a sum of splines, each times a factor that is known at the points, u = a_1 u_1 + a_2 u_2 + ...:
    coefficients are then those of all splines, (3 splines, mi, mj, mk). Without factors it is one spline.

    Parameters
    ----------
    control : Grid
        Control points of the spline.
    along : three (n,) arrays
        Continuous control index of the points along each axis; inside the spline's valid region.
    inside : (ni, nj, nk) bool
        Points that count; sums at the others are zero.
    factors : (ni, nj, nk, splines, 4), optional
        Of each spline's factor the value, and the gradient along the axes, at the points.
    """

    def __init__(
        self, control: Grid, along: Sequence[FloatArray], inside: BoolArray, factors: FloatArray | None = None
    ) -> None:
        self.control = control
        self.inside = np.ascontiguousarray(inside)
        self.factors = _ALONE if factors is None else factors
        rows = [spline_table(np.ascontiguousarray(t), n) for t, n in zip(along, control.shape, strict=True)]
        slopes = [np.ascontiguousarray(r[2] / h) for r, h in zip(rows, control.spacing_mm, strict=True)]
        self.table: Table = (tuple(r[0] for r in rows), tuple(r[1] for r in rows), tuple(slopes))

    def evaluate(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Give u (ni, nj, nk, 3) mm and grad u (ni, nj, nk, 3, 3) from coefficients (3 splines, mi, mj, mk)."""
        u, H = np.zeros((*self.inside.shape, 3)), np.zeros((*self.inside.shape, 3, 3))
        _evaluate(coefficients, self.inside, *self.table, self.factors, u, H)
        return u, H

    def gathered(self, stress: FloatArray) -> FloatArray:
        """Put stresses P (ni, nj, nk, 3, 3) onto the coefficients: sum over points of P : grad B."""
        half = self._half()
        _gather(stress, self.inside, *self.table, self.factors, half)
        return self.closed(half)

    def product(self, coefficients: FloatArray, stiffness: Stiffness) -> FloatArray:
        """Product of the points' part of the Hessian with coefficients (3 splines, mi, mj, mk)."""
        half = self._half()
        _product(coefficients, self.inside, *self.table, self.factors, *stiffness, half)
        return self.closed(half)

    def diagonal(self, stiffness: Stiffness) -> FloatArray:
        """Blocks of the points' part of the Hessian on its diagonal, with cofactors taken as those of no strain.

        Returns
        -------
        (6 splines, mi, mj, mk)
            Of each control point's three coefficients with one another: xx, xy, xz, yy, yz, zz; spline by spline.
        """
        image, _, volume, shear = stiffness
        splines = self.factors.shape[3]
        if splines == 0:
            return self._diagonal(image, volume, shear)
        return np.concatenate([self._diagonal(*self._of_one(stiffness, n)) for n in range(splines)])

    def _of_one(self, stiffness: Stiffness, spline: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Matrices and weights as one spline sees them through its factor, products of B and grad B left out."""
        image, _, volume, shear = stiffness
        a, slope = self.factors[..., spline, 0], self.factors[..., spline, 1:]
        seen = image * (a * a)[..., None]
        if slope.any():
            square = np.einsum("...a,...a->...", slope, slope)
            for entry, (m, n) in enumerate(_PAIRS):
                seen[..., entry] += (volume + 0.5 * shear) * slope[..., m] * slope[..., n] + 0.5 * shear * square * (
                    m == n
                )
        return seen, volume * a * a, shear * a * a

    def _diagonal(self, image: FloatArray, volume: FloatArray, shear: FloatArray) -> FloatArray:
        first, value, slope = self.table
        # of each axis, the matrices that sum B B, B' B and B' B'
        spread = [
            [_spread(f, weights, n) for weights in (v * v, s * v, s * s)]
            for f, v, s, n in zip(first, value, slope, self.control.shape, strict=True)
        ]

        def onto(field: FloatArray, slopes: tuple[int, int, int]) -> FloatArray:
            for axis in range(3):
                moved = np.moveaxis(field, axis, 0)
                summed = spread[axis][slopes[axis]] @ moved.reshape(len(moved), -1)
                field = np.moveaxis(summed.reshape(-1, *moved.shape[1:]), 0, axis)
            return field

        volume, shear = np.where(self.inside, volume, 0.0), np.where(self.inside, shear, 0.0)
        out = np.empty((6, *self.control.shape))
        for entry, (m, a) in enumerate(_PAIRS):
            out[entry] = onto(np.where(self.inside, image[..., entry], 0.0), (0, 0, 0))
            if m == a:
                for axis in range(3):
                    weight = volume + shear if axis == m else 0.5 * shear
                    out[entry] += onto(weight, (2 * (axis == 0), 2 * (axis == 1), 2 * (axis == 2)))
            else:
                out[entry] += onto(volume + 0.5 * shear, (int(0 in {m, a}), int(1 in {m, a}), int(2 in {m, a})))
        return out

    def closed(self, half: FloatArray) -> FloatArray:
        """Sum over the first axis of what was put onto the coefficients of the other two plane by plane."""
        out = np.empty((half.shape[1], *self.control.shape))
        _close(half, self.table[0][0], self.table[1][0], self.table[2][0], out)
        return out

    def _half(self) -> FloatArray:
        return np.empty((self.inside.shape[0], 3 * max(self.factors.shape[3], 1), 2, *self.control.shape[1:]))


Stiffness = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""At each point: normal matrix N of the images (..., 6: xx, xy, xz, yy, yz, zz), cofactors of F (..., 3, 3), weights v
and w of volume and shear (...). A step d costs 1/2 (d . N d + v (cof : grad d)^2 + w |sym grad d|^2)."""


def _spread(first: IntArray, weights: FloatArray, count: int) -> csr_array:
    """Matrix (count, n) that puts values at n points onto control points, with four weights for each point."""
    rows, columns = first[:, None] + np.arange(4), np.repeat(np.arange(first.size), 4)
    return csr_array((weights.ravel(), (rows.ravel(), columns)), shape=(count, first.size))


@njit(cache=True)
def plane_sums(c: FloatArray, first: int, value: FloatArray, slope: FloatArray, plane: FloatArray) -> None:
    """Sums over the first axis for a plane of points: plane (3 splines, 2, mj, mk), values and slopes."""
    for m in range(c.shape[0]):
        for j in range(c.shape[2]):
            w, x, y, z = c[m, first, j], c[m, first + 1, j], c[m, first + 2, j], c[m, first + 3, j]
            sums, slopes = plane[m, 0, j], plane[m, 1, j]
            for k in range(c.shape[3]):  # written out, so that the compiler takes several k at once
                sums[k] = value[0] * w[k] + value[1] * x[k] + value[2] * y[k] + value[3] * z[k]
                slopes[k] = slope[0] * w[k] + slope[1] * x[k] + slope[2] * y[k] + slope[3] * z[k]


@njit(cache=True)
def _row_sums(plane: FloatArray, first: int, value: FloatArray, slope: FloatArray, row: FloatArray) -> None:
    """Sums over the second axis for a row of points: row (3 splines, 3, mk), values, slopes along two axes."""
    for m in range(plane.shape[0]):
        w, x, y, z = plane[m, 0, first], plane[m, 0, first + 1], plane[m, 0, first + 2], plane[m, 0, first + 3]
        d, e, f, g = plane[m, 1, first], plane[m, 1, first + 1], plane[m, 1, first + 2], plane[m, 1, first + 3]
        sums, by_i, by_j = row[m, 0], row[m, 1], row[m, 2]
        for k in range(plane.shape[3]):
            sums[k] = value[0] * w[k] + value[1] * x[k] + value[2] * y[k] + value[3] * z[k]
            by_i[k] = value[0] * d[k] + value[1] * e[k] + value[2] * f[k] + value[3] * g[k]
            by_j[k] = slope[0] * w[k] + slope[1] * x[k] + slope[2] * y[k] + slope[3] * z[k]


@njit(cache=True)
def _point_sums(row: FloatArray, at: int, value: FloatArray, slope: FloatArray, u: FloatArray, H: FloatArray) -> None:
    for m in range(3):
        a, x, y, z = 0.0, 0.0, 0.0, 0.0
        for r in range(4):
            b = value[r]
            a += b * row[m, 0, at + r]
            x += b * row[m, 1, at + r]
            y += b * row[m, 2, at + r]
            z += slope[r] * row[m, 0, at + r]
        u[m], H[m, 0], H[m, 1], H[m, 2] = a, x, y, z


@njit(cache=True)
def _joined_sums(
    row: FloatArray,
    at: int,
    value: FloatArray,
    slope: FloatArray,
    factors: FloatArray,
    room: tuple[FloatArray, FloatArray],
    u: FloatArray,
    H: FloatArray,
) -> None:
    """The same of splines with factors: u = sum a u_s, H = sum (a H_s + u_s grad a); room to work in for one's u, H."""
    part, slopes = room
    u[:], H[:] = 0.0, 0.0
    for s in range(factors.shape[0]):
        _point_sums(row[3 * s : 3 * s + 3], at, value, slope, part, slopes)
        for m in range(3):
            u[m] += factors[s, 0] * part[m]
            for n in range(3):
                H[m, n] += factors[s, 0] * slopes[m, n] + factors[s, n + 1] * part[m]


@njit(cache=True)
def _add_to_row(row: FloatArray, at: int, value: FloatArray, slope: FloatArray, f: FloatArray, P: FloatArray) -> None:
    for m in range(3):
        for r in range(4):
            b = value[r]
            row[m, 0, at + r] += b * f[m] + slope[r] * P[m, 2]
            row[m, 1, at + r] += b * P[m, 0]
            row[m, 2, at + r] += b * P[m, 1]


@njit(cache=True)
def _add_joined(
    row: FloatArray,
    at: int,
    value: FloatArray,
    slope: FloatArray,
    factors: FloatArray,
    room: tuple[FloatArray, FloatArray],
    f: FloatArray,
    P: FloatArray,
) -> None:
    """The transpose of `_joined_sums`: each spline gets a f + P grad a, and a P."""
    part, stress = room
    for s in range(factors.shape[0]):
        for m in range(3):
            part[m] = factors[s, 0] * f[m]
            for n in range(3):
                part[m] += factors[s, n + 1] * P[m, n]
                stress[m, n] = factors[s, 0] * P[m, n]
        _add_to_row(row[3 * s : 3 * s + 3], at, value, slope, part, stress)


@njit(cache=True)
def _add_row_to_plane(row: FloatArray, first: int, value: FloatArray, slope: FloatArray, plane: FloatArray) -> None:
    for m in range(row.shape[0]):
        sums, by_i, by_j = row[m, 0], row[m, 1], row[m, 2]
        for q in range(4):
            v, s = value[q], slope[q]
            onto, onto_slopes = plane[m, 0, first + q], plane[m, 1, first + q]
            for k in range(plane.shape[3]):
                onto[k] += v * sums[k] + s * by_j[k]
                onto_slopes[k] += v * by_i[k]


@njit(parallel=True, cache=True)
def _evaluate(
    c: FloatArray,
    inside: BoolArray,
    first: tuple[IntArray, IntArray, IntArray],
    value: tuple[FloatArray, FloatArray, FloatArray],
    slope: tuple[FloatArray, FloatArray, FloatArray],
    factors: FloatArray,
    u: FloatArray,
    H: FloatArray,
) -> None:
    alone = factors.shape[3] == 0
    for i in prange(inside.shape[0]):
        if not inside[i].any():
            continue
        plane, row = np.empty((c.shape[0], 2, c.shape[2], c.shape[3])), np.empty((c.shape[0], 3, c.shape[3]))
        plane_sums(c, first[0][i], value[0][i], slope[0][i], plane)
        room = np.empty(3), np.empty((3, 3))
        for j in range(inside.shape[1]):
            if not inside[i, j].any():
                continue
            _row_sums(plane, first[1][j], value[1][j], slope[1][j], row)
            for k in range(inside.shape[2]):
                if inside[i, j, k]:
                    at, b, d = first[2][k], value[2][k], slope[2][k]
                    if alone:
                        _point_sums(row, at, b, d, u[i, j, k], H[i, j, k])
                    else:
                        _joined_sums(row, at, b, d, factors[i, j, k], room, u[i, j, k], H[i, j, k])


@njit(parallel=True, cache=True)
def _gather(
    stress: FloatArray,
    inside: BoolArray,
    first: tuple[IntArray, IntArray, IntArray],
    value: tuple[FloatArray, FloatArray, FloatArray],
    slope: tuple[FloatArray, FloatArray, FloatArray],
    factors: FloatArray,
    half: FloatArray,
) -> None:
    alone = factors.shape[3] == 0
    for i in prange(inside.shape[0]):
        half[i] = 0.0
        if not inside[i].any():
            continue
        row, none = np.empty((half.shape[1], 3, half.shape[4])), np.zeros(3)
        room = np.empty(3), np.empty((3, 3))
        for j in range(inside.shape[1]):
            if not inside[i, j].any():
                continue
            row[:] = 0.0
            for k in range(inside.shape[2]):
                if inside[i, j, k]:
                    at, b, d = first[2][k], value[2][k], slope[2][k]
                    if alone:
                        _add_to_row(row, at, b, d, none, stress[i, j, k])
                    else:
                        _add_joined(row, at, b, d, factors[i, j, k], room, none, stress[i, j, k])
            _add_row_to_plane(row, first[1][j], value[1][j], slope[1][j], half[i])


@njit(parallel=True, cache=True)
def _product(
    c: FloatArray,
    inside: BoolArray,
    first: tuple[IntArray, IntArray, IntArray],
    value: tuple[FloatArray, FloatArray, FloatArray],
    slope: tuple[FloatArray, FloatArray, FloatArray],
    factors: FloatArray,
    image: FloatArray,
    cofactor: FloatArray,
    volume: FloatArray,
    shear: FloatArray,
    half: FloatArray,
) -> None:
    alone = factors.shape[3] == 0
    for i in prange(inside.shape[0]):
        half[i] = 0.0
        if not inside[i].any():
            continue
        plane, row = np.empty((c.shape[0], 2, c.shape[2], c.shape[3])), np.empty((c.shape[0], 3, c.shape[3]))
        back = np.empty((c.shape[0], 3, c.shape[3]))
        u, f, H, P = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
        plane_sums(c, first[0][i], value[0][i], slope[0][i], plane)
        room = np.empty(3), np.empty((3, 3))
        for j in range(inside.shape[1]):
            if not inside[i, j].any():
                continue
            _row_sums(plane, first[1][j], value[1][j], slope[1][j], row)
            back[:] = 0.0
            for k in range(inside.shape[2]):
                if not inside[i, j, k]:
                    continue
                at, b, d = first[2][k], value[2][k], slope[2][k]
                if alone:
                    _point_sums(row, at, b, d, u, H)
                else:
                    _joined_sums(row, at, b, d, factors[i, j, k], room, u, H)
                N, cof, shearing = image[i, j, k], cofactor[i, j, k], 0.5 * shear[i, j, k]
                f[0] = N[0] * u[0] + N[1] * u[1] + N[2] * u[2]
                f[1] = N[1] * u[0] + N[3] * u[1] + N[4] * u[2]
                f[2] = N[2] * u[0] + N[4] * u[1] + N[5] * u[2]
                swelling = 0.0
                for m in range(3):
                    for a in range(3):
                        swelling += cof[m, a] * H[m, a]
                swelling *= volume[i, j, k]
                for m in range(3):
                    for a in range(3):
                        P[m, a] = swelling * cof[m, a] + shearing * (H[m, a] + H[a, m])
                if alone:
                    _add_to_row(back, at, b, d, f, P)
                else:
                    _add_joined(back, at, b, d, factors[i, j, k], room, f, P)
            _add_row_to_plane(back, first[1][j], value[1][j], slope[1][j], half[i])


@njit(parallel=True, cache=True)
def _close(half: FloatArray, first: IntArray, value: FloatArray, slope: FloatArray, out: FloatArray) -> None:
    for a in prange(out.shape[1]):
        out[:, a] = 0.0
        for i in range(first.size):
            p = np.int64(a) - first[i]
            if not 0 <= p < 4:
                continue
            v, s = value[i, p], slope[i, p]
            for m in range(out.shape[0]):
                for j in range(out.shape[2]):
                    onto, sums, slopes = out[m, a, j], half[i, m, 0, j], half[i, m, 1, j]
                    for k in range(out.shape[3]):
                        onto[k] += v * sums[k] + s * slopes[k]
