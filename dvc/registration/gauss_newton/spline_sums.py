"""Sums of a cubic B-spline over a tensor grid of points, and the transposed sums, axis by axis.

What a Gauss-Newton step needs of a B-spline: displacement and gradient at many points from coefficients, forces at
many points put onto coefficients, and both in one sweep for a product with the Hessian. Every result is a sum in a
fixed order, so that it is the same bit for bit on any number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.deformation.bspline import spline_table
from dvc.images.image import Grid
from dvc.registration.gauss_newton.spline_kernels import close, evaluate, gather, product

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
        evaluate(coefficients, self.inside, *self.table, self.factors, u, H)
        return u, H

    def gathered(self, stress: FloatArray) -> FloatArray:
        """Put stresses P (ni, nj, nk, 3, 3) onto the coefficients: sum over points of P : grad B."""
        half = self._half()
        gather(stress, self.inside, *self.table, self.factors, half)
        return self.closed(half)

    def product(self, coefficients: FloatArray, stiffness: Stiffness) -> FloatArray:
        """Product of the points' part of the Hessian with coefficients (3 splines, mi, mj, mk)."""
        half = self._half()
        product(coefficients, self.inside, *self.table, self.factors, *stiffness, half)
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
        close(half, self.table[0][0], self.table[1][0], self.table[2][0], out)
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
