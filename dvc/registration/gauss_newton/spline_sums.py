"""Sums of a cubic B-spline over a tensor grid of points, and the transposed sums, axis by axis.

What a Gauss-Newton step needs of a B-spline: displacement and gradient at many points from coefficients, forces at
many points put onto coefficients, and both in one sweep for a product with the Hessian. Every result is a sum in a
fixed order, so that it is the same bit for bit on any number of threads.
"""

from collections.abc import Sequence
from itertools import combinations_with_replacement

import numpy as np

from dvc.arrays import BoolArray, FloatArray, frozen
from dvc.deformation.bspline import Table, spline_table
from dvc.images.image import Grid
from dvc.registration.gauss_newton import sweeps
from dvc.registration.gauss_newton.coarser_grids import GRIDS, PAIRS, coarser, paired, spread
from dvc.registration.gauss_newton.sweeps import NOTHING, Stiffness
from dvc.threads import in_parts

_ALONE = np.empty((0, 0, 0, 4, 0))  # factors of a spline that has none
_NO_STIFFNESS: Stiffness = NOTHING[4], NOTHING[5], NOTHING[3], NOTHING[3]


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
        # Of a line of points one after the other, so that the compiler takes several at once.
        self._factors = _ALONE if factors is None else np.ascontiguousarray(np.moveaxis(factors, 2, 4))
        self._along = [np.ascontiguousarray(t) for t in along]
        self.table = _table(self._along, control.shape, control.spacing_mm)

    def evaluate(self, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Give u (ni, nj, nk, 3) mm and grad u (ni, nj, nk, 3, 3) from coefficients (3 splines, mi, mj, mk)."""
        u, H = np.zeros((*self.inside.shape, 3)), np.zeros((*self.inside.shape, 3, 3))
        self._sweep(sweeps.EVALUATE, coefficients, _NO_STIFFNESS, u, H, NOTHING[5])
        return u, H

    def gathered(self, stress: FloatArray) -> FloatArray:
        """Put stresses P (ni, nj, nk, 3, 3) onto the coefficients: sum over points of P : grad B."""
        half = self._half()
        self._sweep(sweeps.GATHER, NOTHING[4], _NO_STIFFNESS, NOTHING[4], stress, half)
        return self.closed(half)

    def product(self, coefficients: FloatArray, stiffness: Stiffness) -> FloatArray:
        """Product of the points' part of the Hessian with coefficients (3 splines, mi, mj, mk)."""
        half = self._half()
        self._sweep(sweeps.PRODUCT, coefficients, stiffness, NOTHING[4], NOTHING[5], half)
        return self.closed(half)

    def own_blocks(
        self, image: FloatArray | None = None, volume: FloatArray | None = None, shear: FloatArray | None = None
    ) -> list[FloatArray]:
        """The points' part of the Hessian for each control point's own coefficients with one another.

        A symmetric matrix of them all, x, y and z of the first spline, then of the next: its upper triangle row by row,
        (6, mi, mj, mk) with one spline and (21, mi, mj, mk) with two. It is linear in the parts of `Stiffness` that are
        given, with cofactors as those of no strain. So for each of the `GRIDS`, finest first; for a coarser one two
        points of the last along each axis count as one in their middle.
        """
        splines = self._factors.shape[2]
        if not splines:
            return self._own_blocks(image, volume, shear)
        rows = list(combinations_with_replacement([(s, m) for s in range(splines) for m in range(3)], 2))
        grids: list[FloatArray] = []
        for pair in combinations_with_replacement(range(splines), 2):
            for grid, found in enumerate(self._of_pair(*pair, image, volume, shear)):
                if grid == len(grids):
                    grids.append(np.empty((len(rows), *found.shape[1:])))
                for n, ((s, m), (t, a)) in enumerate(rows):
                    if (s, t) == pair:
                        grids[grid][n] = found[PAIRS.index((min(m, a), max(m, a)))]
        return grids

    def _of_pair(
        self, s: int, t: int, image: FloatArray | None, volume: FloatArray | None, shear: FloatArray | None
    ) -> list[FloatArray]:
        """Blocks of two splines, seen through their factors, with one another; products of B and grad B are left out.

        Those of the factors' gradients are kept for a spline with itself alone: of two splines they are not symmetric.
        Without them the matrix of both stays positive.
        """
        factor, other = self._factors[:, :, s], self._factors[:, :, t]
        both = factor[:, :, 0] * other[:, :, 0]
        seen = None if image is None else image * both[..., None]
        slope = np.moveaxis(factor[:, :, 1:], 2, 3)
        if s == t and not (volume is None and shear is None) and slope.any():
            seen = np.zeros((*both.shape, 6)) if seen is None else seen
            whole, half = 0.0 if volume is None else volume, 0.0 if shear is None else 0.5 * shear
            steep = np.einsum("...a,...a->...", slope, slope)
            for entry, (m, n) in enumerate(PAIRS):
                seen[..., entry] += (whole + half) * slope[..., m] * slope[..., n] + half * steep * (m == n)
        return self._own_blocks(seen, *(None if each is None else each * both for each in (volume, shear)))

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
        in_parts(sweeps.close, out.shape[1], half, self.table[0], out)
        return out

    def _sweep(
        self, task: int, c: FloatArray, stiffness: Stiffness, u: FloatArray, H: FloatArray, half: FloatArray
    ) -> None:
        given = task, c, self.inside, self.table, self._factors, stiffness, u, H, half
        in_parts(sweeps.sweep, self.inside.shape[0], *given)

    def _half(self) -> FloatArray:
        return np.empty((self.inside.shape[0], 3 * max(self._factors.shape[2], 1), 2, *self.control.shape[1:]))


def _table(along: Sequence[FloatArray], shape: Sequence[int], spacing_mm: FloatArray) -> Table:
    """Basis functions, and their slopes per mm, at control indices along each axis."""
    rows = (spline_table(t, n) for t, n in zip(along, shape, strict=True))
    i, j, k = ((first, value, slope / h) for (first, value, slope), h in zip(rows, spacing_mm, strict=True))
    return i, j, k
