"""How rough a displacement is: a weight on detail, and less of it where a displacement has been seen to have detail.

The measure is the Laplacian of a cubic B-spline's coefficients, which sees detail of the control points' own size, the
noise's, as sharply as any, where the spline's own second derivatives let it pass. Applied twice, times l^4 with
l = h / sqrt(2) and h between control points (their mean over the axes), it counts as much as once at a wavelength of
4 h, less above and more below; a homogeneous elastic body in equilibrium, whose displacement is biharmonic, then costs
nothing away from the control grid's faces.
"""

from collections.abc import Sequence
from typing import Self

import numpy as np
from scipy.ndimage import gaussian_filter

from dvc.arrays import FloatArray
from dvc.compiled import njit
from dvc.images.image import Grid
from dvc.registration.gauss_newton.coarser_grids import TWICE_AS_WIDE, coarser
from dvc.threads import SMALL, in_parts

_NEAR_MM = 4.0  # Gaussian over which the square of a Laplacian is averaged
_LEAST = 0.05  # of its mean: where there is none, the weight still is finite
_POWER = -0.5  # between a weight that is the same everywhere (0) and one that takes that square for the truth (-1)
_SMALLEST = 1e-3  # share of a neighbourhood: where less is tissue, the mean of all counts
_STRAIGHT = 1e-20  # of the square that the largest coefficient would have alone: rounding's, and no curvature
REST = 1e-5
"""Of |u|^2 beside the Laplacian's square, 1/mm4: air, which nothing else holds, stays near rest or a first guess. It
outweighs waves longer than 11 cm, or 4 cm where the Laplacian counts twice (control points every 3.2 mm)."""
NUMBERS = {"near_mm": _NEAR_MM, "least": _LEAST, "power": _POWER, "rest": REST}
"""The numbers that decide what it is, for a record."""


class Roughness:
    """Of several splines on one control grid, ``1/2 int (p c |Δ u|^2 + q |u|^2)``, or with ``l^4 |Δ Δ u|^2``.

    `weights` are (p, q) of each spline, `laplacians` 1 or 2, `here` (ni, nj, nk) the weight c at the control points, 1
    by default. Coefficients are in mm, in any orthonormal frame; |u|^2 is their square, times a control cell's volume.
    The Laplacian is one of differences between coefficients. On the control grid's faces it leaves out the direction
    along which there is no neighbour; the fields that cost nothing (but q) are then at most linear along each axis.
    """

    def __init__(
        self, control: Grid, weights: Sequence[tuple[float, float]] = ((1.0, REST),), laplacians: int = 1,
        here: FloatArray | None = None,
    ) -> None:  # fmt: skip
        self.control, self._own, self._times = control, weights, laplacians
        cell_mm3 = float(np.prod(control.spacing_mm))
        self._weights = [(p, q * cell_mm3) for p, q in weights]
        length_mm = float(control.spacing_mm.mean()) / np.sqrt(2.0)
        scale = cell_mm3 * length_mm ** (4 * (laplacians - 1))
        self._here = np.full(control.shape, scale) if here is None else scale * here
        self._laplacian = [_second_differences(n, h) for n, h in zip(control.shape, control.spacing_mm, strict=True)]
        self._transposed = [np.stack([np.roll(high, 1), on, np.roll(low, -1)]) for low, on, high in self._laplacian]

    def diagonals(self, grid: int = 0) -> list[FloatArray]:
        """Each spline's part of the matrix' diagonal, (ni, nj, nk), for any component; exact where c is even.

        On a coarser grid, with points 2 or 4 times as far apart, it is that of splines which are sums of these.
        """
        here, alone = self._here, np.ones(1)  # one coefficient of 1 mm, along an axis and far from any face
        for _ in range(grid):
            sizes = zip(coarser(here.shape), here.shape, strict=True)
            here = here[np.ix_(*(np.clip(2 * np.arange(m) - 2, 0, n - 1) for m, n in sizes))]
            alone = np.convolve(np.insert(alone, range(1, alone.size), 0.0), TWICE_AS_WIDE)
        alone = np.pad(alone, 2 * self._times)
        one = alone[:, None, None] * alone[:, None] * alone
        rough = one[None]
        for _ in range(self._times):
            rough = _summed(rough, [_second_differences(alone.size, h) for h in self.control.spacing_mm])
        square, own = float((rough**2).sum()), float((one**2).sum())
        return [p * square * here + q * own for p, q in self._weights]

    def held(self, coefficients: FloatArray) -> FloatArray:
        """The gradient of the part with q alone, for coefficients (3 splines, ni, nj, nk)."""
        return np.concatenate(
            [q * c for (_, q), c in zip(self._weights, np.split(coefficients, len(self._weights)), strict=True)]
        )

    def product(self, coefficients: FloatArray) -> FloatArray:
        """The energy's gradient for coefficients (3 splines, ni, nj, nk)."""
        out = coefficients
        for _ in range(self._times):
            out = _summed(out, self._laplacian)
        out *= self._here
        for _ in range(self._times):
            out = _summed(out, self._transposed)
        for s, (p, q) in enumerate(self._weights):
            out[3 * s : 3 * s + 3] *= p
            out[3 * s : 3 * s + 3] += q * coefficients[3 * s : 3 * s + 3]
        return out

    def following(self, coefficients: FloatArray, tissue: FloatArray) -> Self:
        """The same with a weight c that is smaller where a displacement is curved, and larger where it is straight.

        c is one over the root of the mean of |Δ u|^2 over the tissue nearby (a Gaussian of 4 mm; in units of the mean
        over all tissue, to which .05 is added); over all tissue its geometric mean is 1. Of several splines the squares
        are summed with their weights p. Where there is no curvature but rounding's, c is 1. The displacement is given
        by its coefficients (3 splines, ni, nj, nk), the tissue by its share (ni, nj, nk), 0 to 1, at control points.
        """
        square = (_summed(coefficients, self._laplacian) ** 2).reshape(-1, 3, *tissue.shape).sum(axis=1)
        curved = sum(p * each for (p, _), each in zip(self._own, square, strict=True))
        all_of_it = float(tissue.sum())
        mean = float((tissue * curved).sum()) / max(all_of_it, _SMALLEST)
        largest = float(np.abs(coefficients).max() * (2.0 / self.control.spacing_mm**2).sum()) ** 2
        if mean <= _STRAIGHT * largest:
            return type(self)(self.control, self._own, self._times)
        share, weighed = (gaussian_filter(f, _NEAR_MM / self.control.spacing_mm) for f in (tissue, tissue * curved))
        nearby = (weighed + _SMALLEST * mean) / (share + _SMALLEST)
        here = (nearby / mean + _LEAST) ** _POWER
        here /= np.exp((tissue * np.log(here)).sum() / all_of_it)
        return type(self)(self.control, self._own, self._times, here)


def _second_differences(count: int, spacing_mm: float) -> FloatArray:
    """Second differences, 1/mm2, none at the ends: each row's entries below, on and above the diagonal, (3, count)."""
    rows = np.repeat([[1.0], [-2.0], [1.0]], count, axis=1) / spacing_mm**2
    rows[:, [0, -1]] = 0.0
    return rows


def _summed(coefficients: FloatArray, along: Sequence[FloatArray]) -> FloatArray:
    """The sum of three tridiagonal matrices, each applied along its own axis of (m, ni, nj, nk)."""
    out = np.empty_like(coefficients)
    if out.size < SMALL:
        _three_axes(0, out.shape[1], coefficients, along[0], along[1], along[2], out)
    else:
        in_parts(_three_axes, out.shape[1], coefficients, along[0], along[1], along[2], out)
    return out


@njit(nogil=True, cache=True)
def _three_axes(
    start: int, stop: int, c: FloatArray, di: FloatArray, dj: FloatArray, dk: FloatArray, out: FloatArray
) -> None:
    ni, nj, nk = c.shape[1], c.shape[2], c.shape[3]
    for i in range(start, stop):
        before_i, after_i = i - (i > 0), i + (i < ni - 1)
        for m in range(c.shape[0]):
            for j in range(nj):
                here, onto = c[m, i, j], out[m, i, j]
                w, x = c[m, before_i, j], c[m, after_i, j]
                y, z = c[m, i, max(j - 1, 0)], c[m, i, min(j + 1, nj - 1)]
                middle = di[1, i] + dj[1, j]
                for k in range(nk):  # written out, so that the compiler takes several k at once
                    onto[k] = di[0, i] * w[k] + di[2, i] * x[k] + dj[0, j] * y[k] + dj[2, j] * z[k]
                    onto[k] += (middle + dk[1, k]) * here[k]
                for k in range(1, nk):
                    onto[k] += dk[0, k] * here[k - 1]
                for k in range(nk - 1):
                    onto[k] += dk[2, k] * here[k + 1]
