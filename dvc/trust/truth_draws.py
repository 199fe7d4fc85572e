"""Truths drawn for a measured strain by its error model: its errors are alike in neighbouring points."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.ndimage import gaussian_filter1d

from dvc.arrays import FloatArray
from dvc.images.filters import gaussian
from dvc.trust.error_model import ErrorTable

_STEPS = 4  # of the lattice that noise at scattered points is drawn on, within a correlation length
_HALF = 0.5 + 1e-6  # points half-way between nodes, as every second voxel may be, all take the upper one


class GaussianField:
    """Gaussian fields of unit variance at points (n, 3), mm, with autocorrelation exp(-(d / correlation_mm)^2).

    They are drawn at the nodes of a lattice with edges (3,), mm, from the lowest point on; each point takes the value
    of the nearest node.
    """

    def __init__(
        self, points_mm: FloatArray, edges_mm: FloatArray, correlation_mm: float, random: np.random.Generator
    ) -> None:
        self._random, self._width = random, 0.5 * correlation_mm / edges_mm
        index = np.floor((points_mm - points_mm.min(axis=0)) / edges_mm + _HALF).astype(np.int64)
        # Room around, so that the field, which is periodic, does not meet itself.
        self._shape = tuple((index.max(axis=0) + 1 + np.ceil(6.0 * self._width).astype(np.int64)).tolist())
        self._at = np.ravel_multi_index(tuple(index.T), self._shape)
        spread = 1.0
        for w in self._width:
            kernel = gaussian_filter1d(np.eye(1, 2 * int(4 * w + 1) + 1, int(4 * w + 1))[0], w, mode="constant")
            spread *= float((kernel**2).sum())
        self._scale = 1.0 / np.sqrt(spread)

    def drawn(self) -> FloatArray:
        """Draw the values at the points, (n,)."""
        smooth = gaussian(self._random.standard_normal(self._shape), self._width, "wrap")
        return np.asarray(self._scale * smooth.ravel()[self._at])


class TruthDraws:
    """Draws of the truth, as `uncertainty_of` makes them on a grid.

    At points (n, 3) of the reference configuration, mm: maximum shear strain, tissue and distance to bone, each (n,).
    Noise is drawn on a lattice with ``edges_mm`` (3,), by default a quarter of the table's correlation length.
    """

    def __init__(
        self,
        points_mm: FloatArray,
        shear: FloatArray,
        tissue: Sequence[str],
        to_bone_mm: FloatArray,
        table: ErrorTable,
        seed: int = 1,
        edges_mm: FloatArray | None = None,
    ) -> None:
        self._random = np.random.default_rng(seed)
        self._shear = shear
        names = np.asarray(tissue)
        self._tissues = {str(name): names == name for name in np.unique(names)}
        self._expected = []
        for run in range(len(table.runs)):
            bias, sd = np.empty((2, len(shear)))
            for name, here in self._tissues.items():
                bias[here], sd[here] = table.expected(name, shear[here], to_bone_mm[here], run)
            self._expected.append((bias.astype(np.float32), sd.astype(np.float32)))
        edges = np.full(3, table.correlation_mm / _STEPS) if edges_mm is None else edges_mm
        self._noise = GaussianField(points_mm, edges, table.correlation_mm, self._random)

    @cached_property
    def _variance(self) -> FloatArray:
        return np.asarray(np.mean([np.square(sd, dtype=np.float64) for _, sd in self._expected], axis=0))

    def drawn(self) -> FloatArray:
        """A truth (n,): the shear less a registration's bias, less a Gaussian field of its deviation; not below 0."""
        bias, sd = self._expected[self._random.integers(len(self._expected))]
        return np.maximum(self._shear - bias - sd * self._noise.drawn(), 0.0)

    def narrowed(self, truth: FloatArray) -> FloatArray:
        """A truth drawn (n,) whose spread in each tissue is that of the measured shear less the noise, not plus it.

        About the tissue's mean m: m + (x - m) (1 - 2 s^2 / v)^(1/2), with v the variance of x and s^2 the mean square
        of the noise's deviation, which is in x once as measured and once as drawn; uniform where noise could have made
        all of the spread. Too narrow where the strain varies as in the study, whose bias takes the noise out already.
        """
        narrow = np.empty(len(truth))
        for here in self._tissues.values():
            mean, spread = truth[here].mean(), truth[here].var()
            kept = max(spread - 2.0 * self._variance[here].mean(), 0.0) / spread if spread > 0.0 else 0.0
            narrow[here] = mean + np.sqrt(kept) * (truth[here] - mean)
        return narrow
