"""How alike two images on one grid are: in local structure, beside what their noise allows, and but for an offset."""

from dataclasses import dataclass

import numpy as np

from dvc.arrays import Float32Array
from dvc.images.filters import gaussian
from dvc.images.image import Image, Mask

_WINDOW_MM = 2.5
_BRIGHT = 75.0  # percentile of the tissue that stands for its brightness
_FEWEST = 1000  # voxels
_ROWS = 100_000  # of the regression at once
_LEAST = 1e-5  # eigenvalue of normal equations, over their trace, below which there is no contrast
_NOISES = 1.0, 1.5  # times that in the air: parallel imaging and normalised intensities raise it in the tissue


class Windows:
    """Gaussian windows (sigma 2.5 mm) over the voxels of a mask that each of the images ``shown`` on its grid knows."""

    def __init__(self, mask: Mask, *shown: Float32Array) -> None:
        self.shape, self.box = mask.inside.shape, mask.box()
        self.known = np.logical_and.reduce([mask.inside[self.box], *(np.isfinite(v[self.box]) for v in shown)])
        self._sigma = _WINDOW_MM / mask.grid.spacing_mm
        weight = gaussian(self.known.astype(np.float32), self._sigma, "constant")
        self._weight = np.where(self.known, np.maximum(weight, 1e-3), 1.0)

    def mean(self, values: Float32Array) -> Float32Array:
        """Local means of values in the box, zero where not known."""
        return np.asarray(gaussian(values, self._sigma, "constant") / self._weight, dtype=np.float32)

    def structure(self, image: Float32Array) -> "Structure":
        """An image (ni, nj, nk) as the windows see it."""
        seen = image[self.box].astype(np.float64)
        centre = float(seen[self.known].mean()) if self.known.any() else 0.0  # a large one would cost digits
        values = np.where(self.known, seen - centre, 0.0).astype(np.float32)
        scale = max(float(values.std()), 1e-12)
        values = values / scale
        mean = self.mean(values)
        return Structure(values, mean, np.maximum(self.mean(values * values) - mean * mean, 0.0), scale)

    def correlation(self, one: "Structure", other: "Structure") -> tuple[Float32Array, float]:
        """Local correlation of two images; as in `local_correlation`."""
        known, cov = self.known, self.mean(one.values * other.values) - one.mean * other.mean
        variances = [each.variance[known].sum(dtype=np.float64) for each in (one, other)]
        total = float(np.sqrt(np.prod(variances)))
        pooled = float(cov[known].sum(dtype=np.float64)) / total if total > 0 else float("nan")
        whole = np.full(self.shape, np.nan, dtype=np.float32)
        local = cov / np.sqrt(np.maximum(one.variance * other.variance, 1e-12))
        whole[self.box] = np.where(known, local, np.nan)
        return whole, pooled

    def most_similarity(self, one: "Structure", other: "Structure", noise: tuple[float, float]) -> tuple[float, float]:
        """Pooled local correlation of two images of the same tissue that differ in nothing but their noise.

        sqrt((1 - s_a^2 / v_a) (1 - s_b^2 / v_b)), where s is the standard deviation of an image's noise
        (`dvc.images.noise.noise_in_air`) and v its mean local variance; with the noise as given, and with half as much
        again.
        """
        variances = [float(each.variance[self.known].mean(dtype=np.float64)) * each.scale**2 for each in (one, other)]
        shares = [s**2 / max(variance, 1e-12) for s, variance in zip(noise, variances, strict=True)]
        as_given, more = (float(np.sqrt(np.prod([max(0.0, 1.0 - n**2 * share) for share in shares]))) for n in _NOISES)
        return as_given, more


@dataclass(frozen=True, slots=True, eq=False)
class Structure:
    """An image in the box of `Windows`, over its known voxels' standard deviation: its local mean and variance."""

    values: Float32Array
    mean: Float32Array
    variance: Float32Array
    scale: float


def local_correlation(a: Image, carried: Float32Array, mask: Mask) -> tuple[Float32Array, float]:
    """Correlation in a Gaussian window (sigma 2.5 mm) of an image with another on the same grid.

    Returns
    -------
    map : (ni, nj, nk) float32
        Local correlation in the mask, NaN outside and where ``carried`` is NaN.
    pooled : float
        sum(cov) / sqrt(sum(var_a) sum(var_b)) over the mask: one figure, weighted by local structure.
    """
    windows = Windows(mask, a.values, carried)
    return windows.correlation(windows.structure(a.values), windows.structure(carried))


def brightness_offset(a: Image, carried: Float32Array, mask: Mask, noise: float) -> tuple[float, float]:
    """How much of one image's brightness is an offset to the other's, and no factor of it.

    Fitted is ``carried = g(X) a + o(X)`` with g quadratic and o linear in X, by least squares in which the noise of
    ``a`` (its standard deviation, known beforehand) does not lower g (Fuller, Measurement Error Models, 1987, section
    2.2). The result is the 95th percentile of abs(o) over the mask, as a share of the tissue's brightness (75th
    percentile of ``carried``), with the noise as given and with half as much again; NaN where the mask has too few
    voxels that both know, or no contrast beyond the noise.
    """
    box = mask.box()
    known = np.isfinite(carried[box]) & mask.inside[box] & ~a.missing[box]
    at = np.argwhere(known)
    if len(at) < _FEWEST:
        return float("nan"), float("nan")
    x, y = (values[box][known].astype(np.float64) for values in (a.values, carried))
    size, bright = float(np.abs(x).max()), float(np.percentile(y, _BRIGHT))
    place = 2.0 * at / np.maximum(at.max(axis=0), 1) - 1.0
    linear = np.column_stack([np.ones(len(at)), place])
    normal, right, own = np.zeros((14, 14)), np.zeros(14), np.zeros((10, 10))
    for start in range(0, len(at), _ROWS):
        rows = slice(start, start + _ROWS)
        gain = np.column_stack([linear[rows], place[rows] ** 2, place[rows] * np.roll(place[rows], 1, axis=1)])
        both = np.hstack([gain * (x[rows] / size)[:, None], linear[rows]])
        normal += both.T @ both
        right += both.T @ y[rows]
        own += gain.T @ gain

    def offset(factor: float) -> float:
        left, terms = normal.copy(), len(own)
        left[:terms, :terms] -= (factor * noise / size) ** 2 * own
        if not (bright > 0.0 and np.linalg.eigvalsh(left).min() > _LEAST * np.trace(left)):
            return float("nan")
        return float(np.percentile(np.abs(linear @ np.linalg.solve(left, right)[terms:]), 95)) / bright

    return offset(_NOISES[0]), offset(_NOISES[1])
