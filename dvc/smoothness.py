"""Bending energy of a cubic B-spline, exact: a smooth displacement costs little, a wrinkled one much."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit, prange

from dvc.arrays import FloatArray
from dvc.bspline import spline_basis
from dvc.image import Grid

_GAUSS_POINTS = 4  # exact up to degree 7; products of two cubics have degree 6


class Bending:
    """1/2 c . B c = 1/2 integral of |D^2 u|^2 over the spline's valid region, with u in mm and lengths in mm.

    ``|D^2 u|^2 = sum_m sum_ab (d^2 u_m / dx_a dx_b)^2``. The integral is a sum of tensor products of the Gram
    matrices of B-splines along an axis, and of their first and second derivatives, which have seven diagonals.

    Parameters
    ----------
    control : Grid
        Control points; coefficients are components along its axes, or in any other orthonormal frame.
    """

    def __init__(self, control: Grid) -> None:
        self._gram = [_gram(n, float(h)) for n, h in zip(control.shape, control.spacing_mm, strict=True)]
        self._along_last = [np.ascontiguousarray(gram.T) for gram in self._gram[2]]
        ni, nj, nk = control.shape
        self._between = np.empty((ni, 3, 3, nj, nk))
        (m0, s0, c0), (m1, s1, c1), (m2, s2, c2) = [[g[:, 3] for g in gram] for gram in self._gram]

        def outer(a: FloatArray, b: FloatArray, c: FloatArray) -> FloatArray:
            return np.asarray(a[:, None, None] * b[:, None] * c)

        self.diagonal: FloatArray = (
            outer(c0, m1, m2) + outer(m0, c1, m2) + outer(m0, m1, c2)
            + 2.0 * (outer(s0, s1, m2) + outer(s0, m1, s2) + outer(m0, s1, s2))
        )  # fmt: skip

    def product(self, coefficients: FloatArray) -> FloatArray:
        """B c for coefficients (3, ni, nj, nk): the gradient of the energy."""
        out = np.empty_like(coefficients)
        _last_two_axes(coefficients, *self._gram[1], *self._along_last, self._between)
        _first_axis(self._between, *self._gram[0], out)
        return out


class Roughness:
    """Of several splines on one control grid, each its bending, and its square: ``p |D^2 u|^2 + q |u|^2`` over space.

    Parameters
    ----------
    control : Grid
    weights : sequence of (p, q)
        Of each spline. The square is counted by the coefficients', times a control cell's volume.
    """

    def __init__(self, control: Grid, weights: Sequence[tuple[float, float]] = ((1.0, 0.0),)) -> None:
        self.bending = Bending(control)
        cell_mm3 = float(np.prod(control.spacing_mm))
        self._weights = [(p, q * cell_mm3) for p, q in weights]

    @property
    def diagonals(self) -> list[FloatArray]:
        """Of each spline, what stands on the matrix' diagonal for any component, (ni, nj, nk)."""
        return [p * self.bending.diagonal + q for p, q in self._weights]

    def product(self, coefficients: FloatArray) -> FloatArray:
        """The energy's gradient for coefficients (3 splines, ni, nj, nk)."""
        out = np.empty_like(coefficients)
        for s, (p, q) in enumerate(self._weights):
            own = np.ascontiguousarray(coefficients[3 * s : 3 * s + 3])
            out[3 * s : 3 * s + 3] = p * self.bending.product(own) + q * own
        return out


def _gram(count: int, spacing_mm: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gram matrices by diagonals, (count, 7), of values, slopes and curvatures over the valid region."""
    node, weight = np.polynomial.legendre.leggauss(_GAUSS_POINTS)
    at = 0.5 * (node + 1.0)
    each = [spline_basis(float(f)) for f in at]
    curved = np.array([[1.0 - f, 3.0 * f - 2.0, 1.0 - 3.0 * f, f] for f in at])
    bases = (np.array([e[0] for e in each]), np.array([e[1] for e in each]) / spacing_mm, curved / spacing_mm**2)
    found = []
    for basis in bases:
        element = np.einsum("q,qa,qb->ab", 0.5 * weight * spacing_mm, basis, basis)
        gram = np.zeros((count, 7))
        for start in range(count - 3):
            for a in range(4):
                gram[start + a, 3 - a : 7 - a] += element[a]
        found.append(gram)
    return found[0], found[1], found[2]


@njit(parallel=True, cache=True)
def _last_two_axes(
    c: FloatArray,
    value_j: FloatArray,
    slope_j: FloatArray,
    curve_j: FloatArray,
    value_k: FloatArray,
    slope_k: FloatArray,
    curve_k: FloatArray,
    out: FloatArray,
) -> None:
    """What the first axis' values, slopes and curvatures are to be multiplied with, (ni, 3, 3, nj, nk).

    Gram matrices are (nj, 7) of the second axis, and (7, nk) of the last.
    """
    nj, nk = c.shape[2], c.shape[3]
    for i in prange(c.shape[1]):
        value, slope, curve = np.empty((nj, nk)), np.empty((nj, nk)), np.empty((nj, nk))
        line = np.zeros(nk + 6)  # with what lies beyond its ends, so that the compiler takes several k at once
        for m in range(3):
            for j in range(nj):
                line[3 : nk + 3] = c[m, i, j]
                a, b, d = value[j], slope[j], curve[j]
                a[:], b[:], d[:] = 0.0, 0.0, 0.0
                for s in range(7):
                    x, p, q, r = line[s : s + nk], value_k[s], slope_k[s], curve_k[s]
                    for k in range(nk):
                        a[k] += p[k] * x[k]
                        b[k] += q[k] * x[k]
                        d[k] += r[k] * x[k]
            for j in range(nj):
                out[i, m, :, j] = 0.0
                for s in range(max(-3, -j), min(4, nj - j)):
                    p, q, r = value_j[j, s + 3], slope_j[j, s + 3], curve_j[j, s + 3]
                    a, b, d = value[j + s], slope[j + s], curve[j + s]
                    for_value, for_slope, for_curve = out[i, m, 0, j], out[i, m, 1, j], out[i, m, 2, j]
                    for k in range(nk):
                        for_value[k] += p * d[k] + r * a[k] + 2.0 * q * b[k]
                        for_slope[k] += 2.0 * (q * a[k] + p * b[k])
                        for_curve[k] += p * a[k]


@njit(parallel=True, cache=True)
def _first_axis(between: FloatArray, value: FloatArray, slope: FloatArray, curve: FloatArray, out: FloatArray) -> None:
    ni, nj, nk = out.shape[1], out.shape[2], out.shape[3]
    for counted in prange(ni):
        i = np.int64(counted)  # numba counts without a sign
        for m in range(3):
            out[m, i] = 0.0
            for s in range(-3, 4):
                if not 0 <= i + s < ni:
                    continue
                p, q, r = value[i, s + 3], slope[i, s + 3], curve[i, s + 3]
                for j in range(nj):
                    onto = out[m, i, j]
                    a, b, d = between[i + s, m, 0, j], between[i + s, m, 1, j], between[i + s, m, 2, j]
                    for k in range(nk):
                        onto[k] += p * a[k] + q * b[k] + r * d[k]
