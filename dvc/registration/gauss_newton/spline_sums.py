"""Sums of a cubic B-spline over a tensor grid of points, and the transposed sums, axis by axis.

What a Gauss-Newton step needs of a B-spline: displacement and gradient at many points from coefficients, forces at
many points put onto coefficients, and both in one sweep for a product with the Hessian. Every result is a sum in a
fixed order, so that it is the same bit for bit on any number of threads.
"""

from collections.abc import Sequence

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
    gradient along the axes of each at the points. Without factors it is one spline. `own_blocks` are those of
    u_1 + shift u_2 and u_2, with the shift in mm.
    """

    def __init__(
        self, control: Grid, along: Sequence[FloatArray], inside: BoolArray, factors: FloatArray | None = None,
        shift: float = 0.0,
    ) -> None:  # fmt: skip
        self.control, self.shift = control, shift
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
        """The points' part of the Hessian for each control point's three coefficients with one another.

        (6 splines, mi, mj, mk): xx, xy, xz, yy, yz, zz, spline by spline; it is linear in the parts of `Stiffness` that
        are given, with cofactors as those of no strain. So for each of the `GRIDS`, finest first; for a coarser one two
        points of the last along each axis count as one in their middle.
        """
        if not self._factors.shape[2]:
            return self._own_blocks(image, volume, shear)
        of_splines = []
        # Each spline seen through its factor, products of B and grad B left out.
        for spline in range(self._factors.shape[2]):
            factor = self._factors[:, :, spline]
            if spline and self.shift:
                factor = factor - self.shift * self._factors[:, :, 0]
            a, slope = factor[:, :, 0], np.moveaxis(factor[:, :, 1:], 2, 3)
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
