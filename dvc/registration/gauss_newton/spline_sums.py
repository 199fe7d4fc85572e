"""Sums of a cubic B-spline over a tensor grid of points, and the transposed sums, axis by axis.

What a Gauss-Newton step needs of a B-spline: displacement and gradient at many points from coefficients, forces at
many points put onto coefficients, and both in one sweep for a product with the Hessian. Every result is a sum in a
fixed order, so that it is the same bit for bit on any number of threads.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numba import njit

from dvc.arrays import BoolArray, FloatArray, frozen
from dvc.deformation.bspline import Axis, Table, spline_table
from dvc.images.image import Grid
from dvc.registration.gauss_newton.coarser_grids import GRIDS, PAIRS, coarser, paired, spread
from dvc.threads import in_parts

_ALONE = np.empty((0, 0, 0, 0, 4))  # factors of a spline that has none

Stiffness = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""At each point: normal matrix N of the images (..., 6: xx, xy, xz, yy, yz, zz), cofactors of F (..., 3, 3), weights v
and w of volume and shear (...). A step d costs 1/2 (d . N d + v (cof : grad d)^2 + w |sym grad d|^2)."""


class SplineSums:
    """A control grid, and points at control indices `along` each of its axes, of which those `inside` count.

    Displacement u and force f are in components along the grid's axes; gradients are per mm along them. A displacement
    may be a sum of splines, each times a factor that is known at the points, u = a_1 u_1 + a_2 u_2 + ...: coefficients
    are then those of all splines, (3 splines, mi, mj, mk), and `factors` (ni, nj, nk, splines, 4) are the value and the
    gradient along the axes of each at the points. Without factors it is one spline.
    """

    def __init__(
        self, control: Grid, along: Sequence[FloatArray], inside: BoolArray, factors: FloatArray | None = None
    ) -> None:
        self.control = control
        self.inside = frozen(inside, np.bool_)
        self.factors = _ALONE if factors is None else factors
        self._along = [np.ascontiguousarray(t) for t in along]
        self.table = _table(self._along, control.shape, control.spacing_mm)

    def evaluate(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Give u (ni, nj, nk, 3) mm and grad u (ni, nj, nk, 3, 3) from coefficients (3 splines, mi, mj, mk)."""
        u, H = np.zeros((*self.inside.shape, 3)), np.zeros((*self.inside.shape, 3, 3))
        in_parts(_evaluate, len(u), coefficients, self.inside, self.table, self.factors, u, H)
        return u, H

    def gathered(self, stress: FloatArray) -> FloatArray:
        """Put stresses P (ni, nj, nk, 3, 3) onto the coefficients: sum over points of P : grad B."""
        half = self._half()
        in_parts(_gather, len(half), stress, self.inside, self.table, self.factors, half)
        return self.closed(half)

    def product(self, coefficients: FloatArray, stiffness: Stiffness) -> FloatArray:
        """Product of the points' part of the Hessian with coefficients (3 splines, mi, mj, mk)."""
        half = self._half()
        in_parts(_product, len(half), coefficients, self.inside, self.table, self.factors, stiffness, half)
        return self.closed(half)

    def own_blocks(
        self, image: FloatArray | None = None, volume: FloatArray | None = None, shear: FloatArray | None = None
    ) -> list[FloatArray]:
        """The points' part of the Hessian for each control point's three coefficients with one another.

        (6 splines, mi, mj, mk): xx, xy, xz, yy, yz, zz, spline by spline; it is linear in the parts of `Stiffness` that
        are given, with cofactors as those of no strain. So for each of the `GRIDS`, finest first; for a coarser one two
        points of the last along each axis count as one in their middle.
        """
        if not self.factors.shape[3]:
            return self._own_blocks(image, volume, shear)
        of_splines = []
        for factor in np.moveaxis(self.factors, 3, 0):  # each spline seen through it, products of B and grad B left out
            a, slope = factor[..., 0], factor[..., 1:]
            square = a * a
            seen = None if image is None else image * square[..., None]
            if slope.any() and not (volume is None and shear is None):
                seen = np.zeros((*a.shape, 6)) if seen is None else seen
                whole, half = 0.0 if volume is None else volume, 0.0 if shear is None else 0.5 * shear
                steep = np.einsum("...a,...a->...", slope, slope)
                for entry, (m, n) in enumerate(PAIRS):
                    seen[..., entry] += (whole + half) * slope[..., m] * slope[..., n] + half * steep * (m == n)
            parts = (None if each is None else each * square for each in (volume, shear))
            of_splines.append(self._own_blocks(seen, *parts))
        return [np.concatenate(grid) for grid in zip(*of_splines, strict=True)]

    def _own_blocks(
        self, image: FloatArray | None, volume: FloatArray | None, shear: FloatArray | None
    ) -> list[FloatArray]:
        found, along, shape = [], self._along, tuple(self.control.shape)
        parts = [each if each is None else each[..., None] for each in (volume, shear)]
        fields = [each if each is None else np.where(self.inside[..., None], each, 0.0) for each in (image, *parts)]
        for grid in range(GRIDS):
            if grid:
                along = [0.5 * np.array([t[n : n + 2].mean() for n in range(0, t.size, 2)]) + 1.0 for t in along]
                fields, shape = [each if each is None else paired(each) for each in fields], coarser(shape)
            table = _table(along, shape, 2**grid * self.control.spacing_mm)
            found.append(spread(table, shape, *fields))
        return found

    def closed(self, half: FloatArray) -> FloatArray:
        """Sum over the first axis of what was put onto the coefficients of the other two plane by plane."""
        out = np.empty((half.shape[1], *self.control.shape))
        in_parts(_close, out.shape[1], half, self.table[0], out)
        return out

    def _half(self) -> FloatArray:
        return np.empty((self.inside.shape[0], 3 * max(self.factors.shape[3], 1), 2, *self.control.shape[1:]))


def _table(along: Sequence[FloatArray], shape: Sequence[int], spacing_mm: FloatArray) -> Table:
    """Basis functions, and their slopes per mm, at control indices along each axis."""
    rows = (spline_table(t, n) for t, n in zip(along, shape, strict=True))
    i, j, k = ((first, value, slope / h) for (first, value, slope), h in zip(rows, spacing_mm, strict=True))
    return i, j, k


def stored() -> bool:
    """Whether a run on this machine has compiled and stored these loops before, or none can be stored."""
    place, source, first = _product.stats.cache_path, Path(__file__), _product.py_func.__code__.co_firstlineno
    if place is None:
        return True
    index = Path(place).glob(f"{source.stem}._product-{first}.*.nbi")  # numba's name of it
    return any(file.stat().st_mtime > source.stat().st_mtime for file in index)


# The sweeps: planes, rows and lines of the grid, one axis of B-splines after the other.


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
def _add_row_to_plane(row: FloatArray, first: int, value: FloatArray, slope: FloatArray, plane: FloatArray) -> None:
    for m in range(row.shape[0]):
        sums, by_i, by_j = row[m, 0], row[m, 1], row[m, 2]
        for q in range(4):
            v, s = value[q], slope[q]
            onto, onto_slopes = plane[m, 0, first + q], plane[m, 1, first + q]
            for k in range(plane.shape[3]):
                onto[k] += v * sums[k] + s * by_j[k]
                onto_slopes[k] += v * by_i[k]


@njit(cache=True)
def _ends(inside: BoolArray) -> tuple[int, int]:
    """First point of a line that is inside, and the one after its last; equal where none is."""
    start, stop = 0, inside.size
    while start < stop and not inside[start]:
        start += 1
    while start < stop and not inside[stop - 1]:
        stop -= 1
    return start, stop


@njit(cache=True)
def _line_sums(row: FloatArray, last: Axis, ends: tuple[int, int], line: FloatArray) -> None:
    """Sums over the last axis for a line of points: line (3 splines, 4, nk), of each component value and slopes."""
    first, value, slope = last
    for m in range(row.shape[0]):
        sums, by_i, by_j = row[m, 0], row[m, 1], row[m, 2]
        u, x, y, z = line[m, 0], line[m, 1], line[m, 2], line[m, 3]
        for k in range(ends[0], ends[1]):  # written out, so that the compiler takes several k at once
            at, a, b, c, d = first[k], value[k, 0], value[k, 1], value[k, 2], value[k, 3]
            u[k] = a * sums[at] + b * sums[at + 1] + c * sums[at + 2] + d * sums[at + 3]
            x[k] = a * by_i[at] + b * by_i[at + 1] + c * by_i[at + 2] + d * by_i[at + 3]
            y[k] = a * by_j[at] + b * by_j[at + 1] + c * by_j[at + 2] + d * by_j[at + 3]
            p, q, r, s = slope[k, 0], slope[k, 1], slope[k, 2], slope[k, 3]
            z[k] = p * sums[at] + q * sums[at + 1] + r * sums[at + 2] + s * sums[at + 3]


@njit(cache=True)
def _join(line: FloatArray, factors: FloatArray, ends: tuple[int, int], joined: FloatArray) -> None:
    """Of splines with factors the sums at a line of points: u = sum a u_s, H = sum (a H_s + u_s grad a)."""
    for m in range(3):
        u, x, y, z = joined[m, 0], joined[m, 1], joined[m, 2], joined[m, 3]
        u[:], x[:], y[:], z[:] = 0.0, 0.0, 0.0, 0.0
        for s in range(factors.shape[1]):
            each, by_i, by_j, by_k = line[3 * s + m, 0], line[3 * s + m, 1], line[3 * s + m, 2], line[3 * s + m, 3]
            for k in range(ends[0], ends[1]):
                a = factors[k, s, 0]
                u[k] += a * each[k]
                x[k] += a * by_i[k] + factors[k, s, 1] * each[k]
                y[k] += a * by_j[k] + factors[k, s, 2] * each[k]
                z[k] += a * by_k[k] + factors[k, s, 3] * each[k]


@njit(cache=True)
def _split(joined: FloatArray, factors: FloatArray, ends: tuple[int, int], line: FloatArray) -> None:
    """The transpose of `_join`: each spline gets a f + P grad a, and a P."""
    for m in range(3):
        f, x, y, z = joined[m, 0], joined[m, 1], joined[m, 2], joined[m, 3]
        for s in range(factors.shape[1]):
            each, by_i, by_j, by_k = line[3 * s + m, 0], line[3 * s + m, 1], line[3 * s + m, 2], line[3 * s + m, 3]
            for k in range(ends[0], ends[1]):
                a = factors[k, s, 0]
                each[k] = a * f[k] + factors[k, s, 1] * x[k] + factors[k, s, 2] * y[k] + factors[k, s, 3] * z[k]
                by_i[k], by_j[k], by_k[k] = a * x[k], a * y[k], a * z[k]


@njit(cache=True)
def _load(line: FloatArray, stiffness: Stiffness, ends: tuple[int, int]) -> None:
    """At a line (3, 4, nk) of points, in place: from u and H to the force and the stress that resist them."""
    image, cofactor, volume, shear = stiffness
    u, v, w = line[0], line[1], line[2]
    for k in range(ends[0], ends[1]):
        N, C, g = image[k], cofactor[k], 0.5 * shear[k]
        x, y, z = u[0, k], v[0, k], w[0, k]
        u[0, k] = N[0] * x + N[1] * y + N[2] * z
        v[0, k] = N[1] * x + N[3] * y + N[4] * z
        w[0, k] = N[2] * x + N[4] * y + N[5] * z
        p = volume[k] * (
            C[0, 0] * u[1, k] + C[0, 1] * u[2, k] + C[0, 2] * u[3, k]
            + C[1, 0] * v[1, k] + C[1, 1] * v[2, k] + C[1, 2] * v[3, k]
            + C[2, 0] * w[1, k] + C[2, 1] * w[2, k] + C[2, 2] * w[3, k]
        )  # fmt: skip
        xy, xz, yz = g * (u[2, k] + v[1, k]), g * (u[3, k] + w[1, k]), g * (v[3, k] + w[2, k])
        u[1, k] = p * C[0, 0] + g * (u[1, k] + u[1, k])
        u[2, k], v[1, k] = p * C[0, 1] + xy, p * C[1, 0] + xy
        u[3, k], w[1, k] = p * C[0, 2] + xz, p * C[2, 0] + xz
        v[2, k] = p * C[1, 1] + g * (v[2, k] + v[2, k])
        v[3, k], w[2, k] = p * C[1, 2] + yz, p * C[2, 1] + yz
        w[3, k] = p * C[2, 2] + g * (w[3, k] + w[3, k])


@njit(cache=True)
def _add_line_to_row(line: FloatArray, inside: BoolArray, last: Axis, ends: tuple[int, int], row: FloatArray) -> None:
    """The transpose of `_line_sums`, for the points that are inside."""
    first, value, slope = last
    for n in range(0, row.shape[0], 3):
        a, b, c = row[n], row[n + 1], row[n + 2]
        for k in range(ends[0], ends[1]):
            if not inside[k]:
                continue
            at = first[k]
            f, fx, fy, fz = line[n, 0, k], line[n, 1, k], line[n, 2, k], line[n, 3, k]
            g, gx, gy, gz = line[n + 1, 0, k], line[n + 1, 1, k], line[n + 1, 2, k], line[n + 1, 3, k]
            h, hx, hy, hz = line[n + 2, 0, k], line[n + 2, 1, k], line[n + 2, 2, k], line[n + 2, 3, k]
            for r in range(4):
                v, s = value[k, r], slope[k, r]
                a[0, at + r] += v * f + s * fz
                a[1, at + r] += v * fx
                a[2, at + r] += v * fy
                b[0, at + r] += v * g + s * gz
                b[1, at + r] += v * gx
                b[2, at + r] += v * gy
                c[0, at + r] += v * h + s * hz
                c[1, at + r] += v * hx
                c[2, at + r] += v * hy


@njit(nogil=True, cache=True)
def _evaluate(
    start: int,
    stop: int,
    c: FloatArray,
    inside: BoolArray,
    table: Table,
    factors: FloatArray,
    u: FloatArray,
    H: FloatArray,
) -> None:
    """The displacement u (ni, nj, nk, 3), mm, and its gradient H (ni, nj, nk, 3, 3) at the points that are inside."""
    first, second, last = table
    alone = factors.shape[3] == 0
    for i in range(start, stop):
        if not inside[i].any():
            continue
        plane, row = np.empty((c.shape[0], 2, c.shape[2], c.shape[3])), np.empty((c.shape[0], 3, c.shape[3]))
        line = np.empty((c.shape[0], 4, inside.shape[2]))
        joined = line if alone else np.empty((3, 4, inside.shape[2]))
        plane_sums(c, first[0][i], first[1][i], first[2][i], plane)
        for j in range(inside.shape[1]):
            ends = _ends(inside[i, j])
            if ends[0] == ends[1]:
                continue
            _row_sums(plane, second[0][j], second[1][j], second[2][j], row)
            _line_sums(row, last, ends, line)
            if not alone:
                _join(line, factors[i, j], ends, joined)
            for k in range(ends[0], ends[1]):
                if inside[i, j, k]:
                    for m in range(3):
                        u[i, j, k, m] = joined[m, 0, k]
                        for a in range(3):
                            H[i, j, k, m, a] = joined[m, a + 1, k]


@njit(nogil=True, cache=True)
def _gather(
    start: int, stop: int, stress: FloatArray, inside: BoolArray, table: Table, factors: FloatArray, half: FloatArray
) -> None:
    """Sums of P : grad B over the points that are inside, onto the last two axes' coefficients, plane by plane."""
    _, second, last = table
    alone = factors.shape[3] == 0
    for i in range(start, stop):
        half[i] = 0.0
        if not inside[i].any():
            continue
        row, line = np.empty((half.shape[1], 3, half.shape[4])), np.empty((half.shape[1], 4, inside.shape[2]))
        joined = line if alone else np.empty((3, 4, inside.shape[2]))
        for j in range(inside.shape[1]):
            ends = _ends(inside[i, j])
            if ends[0] == ends[1]:
                continue
            for m in range(3):
                joined[m, 0] = 0.0
                for k in range(ends[0], ends[1]):
                    for a in range(3):
                        joined[m, a + 1, k] = stress[i, j, k, m, a]
            if not alone:
                _split(joined, factors[i, j], ends, line)
            row[:] = 0.0
            _add_line_to_row(line, inside[i, j], last, ends, row)
            _add_row_to_plane(row, second[0][j], second[1][j], second[2][j], half[i])


@njit(nogil=True, cache=True)
def _product(
    start: int,
    stop: int,
    c: FloatArray,
    inside: BoolArray,
    table: Table,
    factors: FloatArray,
    stiffness: Stiffness,
    half: FloatArray,
) -> None:
    """Product of the points' part of the Hessian with coefficients, whole lines of points at once."""
    first, second, last = table
    image, cofactor, volume, shear = stiffness
    alone = factors.shape[3] == 0
    for i in range(start, stop):
        half[i] = 0.0
        if not inside[i].any():
            continue
        plane, row = np.empty((c.shape[0], 2, c.shape[2], c.shape[3])), np.empty((c.shape[0], 3, c.shape[3]))
        back, line = np.empty_like(row), np.empty((c.shape[0], 4, inside.shape[2]))
        joined = line if alone else np.empty((3, 4, inside.shape[2]))
        plane_sums(c, first[0][i], first[1][i], first[2][i], plane)
        for j in range(inside.shape[1]):
            ends = _ends(inside[i, j])
            if ends[0] == ends[1]:
                continue
            _row_sums(plane, second[0][j], second[1][j], second[2][j], row)
            _line_sums(row, last, ends, line)
            if not alone:
                _join(line, factors[i, j], ends, joined)
            _load(joined, (image[i, j], cofactor[i, j], volume[i, j], shear[i, j]), ends)
            if not alone:
                _split(joined, factors[i, j], ends, line)
            back[:] = 0.0
            _add_line_to_row(line, inside[i, j], last, ends, back)
            _add_row_to_plane(back, second[0][j], second[1][j], second[2][j], half[i])


@njit(nogil=True, cache=True)
def _close(start: int, stop: int, half: FloatArray, axis: Axis, out: FloatArray) -> None:
    """Sums over the first axis: from planes (ni, m, 2, mj, mk) to coefficients (m, mi, mj, mk)."""
    first, value, slope = axis
    for a in range(start, stop):
        out[:, a] = 0.0
        for i in range(first.size):
            p = a - first[i]
            if not 0 <= p < 4:
                continue
            v, s = value[i, p], slope[i, p]
            for m in range(out.shape[0]):
                for j in range(out.shape[2]):
                    onto, sums, slopes = out[m, a, j], half[i, m, 0, j], half[i, m, 1, j]
                    for k in range(out.shape[3]):
                        onto[k] += v * sums[k] + s * slopes[k]
