"""Draws of the truth behind a strain measured at scattered points, such as the cells of a mesh."""

from collections.abc import Sequence

import numpy as np

from dvc.arrays import FloatArray
from dvc.trust.error_model import ErrorTable, GaussianField

_STEPS = 4  # of the lattice that noise is drawn on, within a correlation length


class TruthDraws:
    """Draws of the truth, as `dvc.trust.error_model.uncertainty_of` makes them on a grid.

    At points (n, 3) of the reference configuration, LPS mm: maximal shear strain, tissue and
    distance to bone, each (n,).
    """

    def __init__(
        self,
        points_mm: FloatArray,
        shear: FloatArray,
        tissue: Sequence[str],
        to_bone_mm: FloatArray,
        table: ErrorTable,
        seed: int = 1,
    ) -> None:
        self._random = np.random.default_rng(seed)
        self._shear = shear
        names = self._names = np.asarray(tissue)
        self._expected = []
        for run in range(len(table.runs)):
            bias, sd = np.empty((2, len(shear)))
            for name in np.unique(names):
                here = names == name
                bias[here], sd[here] = table.expected(str(name), shear[here], to_bone_mm[here], run)
            self._expected.append((bias, sd))
        step = table.correlation_mm / _STEPS
        index = np.rint((points_mm - points_mm.min(axis=0)) / step).astype(np.int64)
        width = np.full(3, 0.5 * table.correlation_mm / step)
        self._noise = GaussianField(tuple(int(n) + 1 for n in index.max(axis=0)), tuple(index.T), width, self._random)

    def drawn(self) -> FloatArray:
        """A truth (n,): the shear less a registration's bias, less a Gaussian field of its deviation; not below 0."""
        bias, sd = self._expected[self._random.integers(len(self._expected))]
        return np.maximum(self._shear - bias - sd * self._noise.drawn(), 0.0)

    def narrowed(self, truth: FloatArray) -> FloatArray:
        """A truth drawn (n,) whose spread in each tissue is that of the measured shear less the noise, not plus it.

        About the tissue's mean m: m + (x - m) (1 - 2 s^2 / v)^(1/2), with v the variance of x and s^2 the mean square
        of the noise's deviation, which is in x once as measured and once as drawn; uniform where noise could have made
        all of the spread.
        """
        noise = np.mean([sd**2 for _, sd in self._expected], axis=0)
        narrow = np.empty(len(truth))
        for name in np.unique(self._names):
            here = self._names == name
            mean, spread = truth[here].mean(), truth[here].var()
            kept = max(spread - 2.0 * noise[here].mean(), 0.0) / spread if spread > 0.0 else 0.0
            narrow[here] = mean + np.sqrt(kept) * (truth[here] - mean)
        return narrow
