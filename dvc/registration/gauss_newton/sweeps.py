"""The compiled loops of `dvc.registration.gauss_newton.spline_sums`: planes, strips and lines of points.

One axis of B-splines after the other, the second last, so that its sums run along whole lines of points. The compiler
takes several numbers at once where a loop counts from zero, over views cut to what is inside, and writes to one array.
"""

from pathlib import Path

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.compiled import njit
from dvc.deformation.bspline import Axis, Table

Stiffness = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""At each point: normal matrix N of the images (..., 6: xx, xy, xz, yy, yz, zz), cofactors of F (..., 3, 3), weights v
and w of volume and shear (...). A step d costs 1/2 (d . N d + v (cof : grad d)^2 + w |sym grad d|^2)."""


EVALUATE, GATHER, PRODUCT = range(3)
NOTHING = tuple(np.empty((0,) * n) for n in range(6))
"""Arrays of no size, by their number of axes: what a task of `sweep` does not need."""


def stored() -> bool:
    """Whether a run on this machine has compiled and stored these loops before, or none can be stored."""
    place, source, first = sweep.stats.cache_path, Path(__file__), sweep.py_func.__code__.co_firstlineno
    if place is None:
        return True
    index = Path(place).glob(f"{source.stem}.sweep-{first}.*.nbi")  # numba's name of it
    return any(file.stat().st_mtime > source.stat().st_mtime for file in index)


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


@njit(cache=True, _nrt=False)
def _strip_sums(plane: FloatArray, last: Axis, ends: tuple[int, int], strip: FloatArray) -> None:
    """Sums over the last axis for a plane of points: strip (3 splines, 3, mj, nk), values, slopes along i and k.

    Before those over the second axis, which then run along whole lines of points.
    """
    start, stop = ends
    first, value, slope = last[0][start:stop], last[1][start:stop], last[2][start:stop]
    for m in range(plane.shape[0]):
        for j in range(plane.shape[2]):
            sums, slopes = plane[m, 0, j], plane[m, 1, j]
            u, by_i, by_k = strip[m, 0, j, start:stop], strip[m, 1, j, start:stop], strip[m, 2, j, start:stop]
            for k in range(u.size):
                at, a, b, c, d = first[k], value[k, 0], value[k, 1], value[k, 2], value[k, 3]
                w, x, y, z = sums[at], sums[at + 1], sums[at + 2], sums[at + 3]
                u[k] = a * w + b * x + c * y + d * z
                by_i[k] = a * slopes[at] + b * slopes[at + 1] + c * slopes[at + 2] + d * slopes[at + 3]
                by_k[k] = slope[k, 0] * w + slope[k, 1] * x + slope[k, 2] * y + slope[k, 3] * z


@njit(cache=True, _nrt=False)
def _line_sums(
    strip: FloatArray, first: int, value: FloatArray, slope: FloatArray, ends: tuple[int, int], line: FloatArray
) -> None:
    """Sums over the second axis for a line of points: line (3 splines, 4, nk), of each component value and slopes."""
    start, stop = ends
    for m in range(strip.shape[0]):
        for to, of in enumerate((0, 1, 0, 2)):
            weights = slope if to == 2 else value
            a, b, c, d = weights[0], weights[1], weights[2], weights[3]
            w, x = strip[m, of, first, start:stop], strip[m, of, first + 1, start:stop]
            y, z = strip[m, of, first + 2, start:stop], strip[m, of, first + 3, start:stop]
            onto = line[m, to, start:stop]
            for k in range(onto.size):  # one sum alone, or the compiler would not take several k at once
                onto[k] = a * w[k] + b * x[k] + c * y[k] + d * z[k]


@njit(cache=True, _nrt=False)
def _add_line_to_strip(
    line: FloatArray, first: int, value: FloatArray, slope: FloatArray, ends: tuple[int, int], strip: FloatArray
) -> None:
    """The transpose of `_line_sums`."""
    start, stop = ends
    for m in range(line.shape[0]):
        f, x, y, z = line[m, 0, start:stop], line[m, 1, start:stop], line[m, 2, start:stop], line[m, 3, start:stop]
        for q in range(4):
            v, s = value[q], slope[q]
            onto, onto_i = strip[m, 0, first + q, start:stop], strip[m, 1, first + q, start:stop]
            onto_k = strip[m, 2, first + q, start:stop]
            for k in range(f.size):
                onto[k] += v * f[k] + s * y[k]
            for k in range(x.size):
                onto_i[k] += v * x[k]
            for k in range(z.size):
                onto_k[k] += v * z[k]


@njit(cache=True, _nrt=False)
def _add_strip_to_plane(strip: FloatArray, last: Axis, ends: tuple[int, int], plane: FloatArray) -> None:
    """The transpose of `_strip_sums`."""
    start, stop = ends
    first, value, slope = last[0][start:stop], last[1][start:stop], last[2][start:stop]
    for m in range(strip.shape[0]):
        for j in range(strip.shape[2]):
            f, x, z = strip[m, 0, j, start:stop], strip[m, 1, j, start:stop], strip[m, 2, j, start:stop]
            sums, slopes = plane[m, 0, j], plane[m, 1, j]
            for k in range(f.size):
                at, here, by_i, by_k = first[k], f[k], x[k], z[k]
                for r in range(4):
                    sums[at + r] += value[k, r] * here + slope[k, r] * by_k
                    slopes[at + r] += value[k, r] * by_i


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
def _span(inside: BoolArray) -> tuple[int, int]:
    """The ends of what all lines of a plane have inside; equal where none has anything."""
    start, stop = inside.shape[1], 0
    for j in range(inside.shape[0]):
        first, end = _ends(inside[j])
        if first < end:
            start, stop = min(start, first), max(stop, end)
    return min(start, stop), stop


@njit(cache=True, _nrt=False)
def _clear(line: FloatArray, inside: BoolArray, ends: tuple[int, int]) -> None:
    """Leave out the points of a line (3, 4, nk) that are not inside."""
    for k in range(ends[0], ends[1]):
        if not inside[k]:
            for m in range(3):
                for n in range(4):
                    line[m, n, k] = 0.0


@njit(cache=True, _nrt=False)
def _taken(stress: FloatArray, ends: tuple[int, int], line: FloatArray) -> None:
    """Stresses (nk, 3, 3) as a line (3, 4, nk) without forces."""
    for k in range(ends[0], ends[1]):
        for m in range(3):
            line[m, 0, k] = 0.0
            for n in range(3):
                line[m, n + 1, k] = stress[k, m, n]


@njit(cache=True, _nrt=False)
def _given(line: FloatArray, inside: BoolArray, ends: tuple[int, int], u: FloatArray, H: FloatArray) -> None:
    """Displacement (nk, 3) and its gradient (nk, 3, 3) of the points of a line (3, 4, nk) that are inside."""
    for k in range(ends[0], ends[1]):
        if inside[k]:
            for m in range(3):
                u[k, m] = line[m, 0, k]
                for n in range(3):
                    H[k, m, n] = line[m, n + 1, k]


@njit(cache=True, _nrt=False)
def _join(line: FloatArray, factors: FloatArray, ends: tuple[int, int], joined: FloatArray) -> None:
    """Of splines with factors the sums at a line of points: u = sum a u_s, H = sum (a H_s + u_s grad a)."""
    start, stop = ends
    for m in range(3):
        for to in range(4):
            onto = joined[m, to, start:stop]
            onto[:] = 0.0
            for s in range(factors.shape[0]):
                u, own = line[3 * s + m, 0, start:stop], line[3 * s + m, to, start:stop]
                a, slope = factors[s, 0, start:stop], factors[s, to, start:stop]
                if to:
                    for k in range(onto.size):
                        onto[k] += a[k] * own[k] + slope[k] * u[k]
                else:
                    for k in range(onto.size):
                        onto[k] += a[k] * own[k]


@njit(cache=True, _nrt=False)
def _split(joined: FloatArray, factors: FloatArray, ends: tuple[int, int], line: FloatArray) -> None:
    """The transpose of `_join`: each spline gets a f + P grad a, and a P."""
    start, stop = ends
    for m in range(3):
        for s in range(factors.shape[0]):
            a, each = factors[s, 0, start:stop], line[3 * s + m, 0, start:stop]
            for to in range(4):
                given, own = joined[m, to, start:stop], line[3 * s + m, to, start:stop]
                for k in range(given.size):
                    own[k] = a[k] * given[k]
            for to in range(1, 4):
                given, slope = joined[m, to, start:stop], factors[s, to, start:stop]
                for k in range(given.size):
                    each[k] += slope[k] * given[k]


@njit(cache=True, _nrt=False)
def _load(line: FloatArray, stiffness: Stiffness, ends: tuple[int, int]) -> None:
    """At a line (3, 4, nk) of points, in place: from u and H to the force and the stress that resist them."""
    start, stop = ends
    image, cofactor = stiffness[0][start:stop], stiffness[1][start:stop]
    volume, shear = stiffness[2][start:stop], stiffness[3][start:stop]
    u, ux, uy, uz = line[0, 0, start:stop], line[0, 1, start:stop], line[0, 2, start:stop], line[0, 3, start:stop]
    v, vx, vy, vz = line[1, 0, start:stop], line[1, 1, start:stop], line[1, 2, start:stop], line[1, 3, start:stop]
    w, wx, wy, wz = line[2, 0, start:stop], line[2, 1, start:stop], line[2, 2, start:stop], line[2, 3, start:stop]
    for k in range(u.size):
        N, C, g = image[k], cofactor[k], 0.5 * shear[k]
        x, y, z = u[k], v[k], w[k]
        u[k] = N[0] * x + N[1] * y + N[2] * z
        v[k] = N[1] * x + N[3] * y + N[4] * z
        w[k] = N[2] * x + N[4] * y + N[5] * z
        p = volume[k] * (
            C[0, 0] * ux[k] + C[0, 1] * uy[k] + C[0, 2] * uz[k]
            + C[1, 0] * vx[k] + C[1, 1] * vy[k] + C[1, 2] * vz[k]
            + C[2, 0] * wx[k] + C[2, 1] * wy[k] + C[2, 2] * wz[k]
        )  # fmt: skip
        xy, xz, yz = g * (uy[k] + vx[k]), g * (uz[k] + wx[k]), g * (vz[k] + wy[k])
        ux[k] = p * C[0, 0] + g * (ux[k] + ux[k])
        uy[k], vx[k] = p * C[0, 1] + xy, p * C[1, 0] + xy
        uz[k], wx[k] = p * C[0, 2] + xz, p * C[2, 0] + xz
        vy[k] = p * C[1, 1] + g * (vy[k] + vy[k])
        vz[k], wy[k] = p * C[1, 2] + yz, p * C[2, 1] + yz
        wz[k] = p * C[2, 2] + g * (wz[k] + wz[k])


@njit(nogil=True, cache=True)
def sweep(
    start: int, stop: int, task: int, c: FloatArray, inside: BoolArray, table: Table, factors: FloatArray,
    stiffness: Stiffness, u: FloatArray, H: FloatArray, half: FloatArray,
) -> None:  # fmt: skip
    """One of three tasks, plane by plane and over whole lines of points; one loop, as each takes seconds to compile.

    EVALUATE: the displacement u (ni, nj, nk, 3), mm, and its gradient H (ni, nj, nk, 3, 3) of coefficients c at the
    points that are inside. GATHER: sums of stresses H : grad B over these points, onto the coefficients of the last two
    axes, half (ni, 3 splines, 2, mj, mk). PRODUCT: of the points' part of the Hessian with c, onto the same. Arrays
    that a task does not need are `NOTHING`.
    """
    first, second, last = table
    image, cofactor, volume, shear = stiffness
    alone, splines = factors.shape[2] == 0, 3 * max(factors.shape[2], 1)
    mj, nk = half.shape[3] if task == GATHER else c.shape[2], inside.shape[2]
    for i in range(start, stop):
        if task != EVALUATE:
            half[i] = 0.0
        span = _span(inside[i])
        if span[0] == span[1]:
            continue
        strip, line = np.zeros((splines, 3, mj, nk)), np.empty((splines, 4, nk))
        back = strip if task == GATHER else np.zeros((splines, 3, mj if task == PRODUCT else 0, nk))
        joined = line if alone else np.empty((3, 4, nk))
        if task != GATHER:
            plane = np.empty((splines, 2, mj, c.shape[3]))
            plane_sums(c, first[0][i], first[1][i], first[2][i], plane)
            _strip_sums(plane, last, span, strip)
        for j in range(inside.shape[1]):
            ends = _ends(inside[i, j])
            if ends[0] == ends[1]:
                continue
            if task == GATHER:
                _taken(H[i, j], ends, joined)
            else:
                _line_sums(strip, second[0][j], second[1][j], second[2][j], ends, line)
                if not alone:
                    _join(line, factors[i, j], ends, joined)
            if task == EVALUATE:
                _given(joined, inside[i, j], ends, u[i, j], H[i, j])
                continue
            if task == PRODUCT:
                _load(joined, (image[i, j], cofactor[i, j], volume[i, j], shear[i, j]), ends)
            _clear(joined, inside[i, j], ends)
            if not alone:
                _split(joined, factors[i, j], ends, line)
            _add_line_to_strip(line, second[0][j], second[1][j], second[2][j], ends, back)
        if task != EVALUATE:
            _add_strip_to_plane(back, last, span, half[i])


@njit(nogil=True, cache=True)
def close(start: int, stop: int, half: FloatArray, axis: Axis, out: FloatArray) -> None:
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
