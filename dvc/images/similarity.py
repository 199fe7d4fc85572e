"""How alike two images on one grid are: in local structure, beside what their noise allows, and but for an offset."""

import numpy as np
from scipy.ndimage import gaussian_filter

from dvc.arrays import BoolArray, Float32Array
from dvc.images.image import Image, Mask
from dvc.images.resample import fill_missing

_WINDOW_MM = 2.5
_BRIGHT = 75.0  # percentile of the tissue that stands for its brightness
_FEWEST = 1000  # voxels
_LEAST = 1e-5  # eigenvalue of normal equations, over their trace, below which there is no contrast
_NOISES = 1.0, 1.5  # times that in the air: parallel imaging and normalised intensities raise it in the tissue


def local_correlation(a: Image, carried: Float32Array, mask: Mask) -> tuple[Float32Array, float]:
    """Correlation in a Gaussian window (sigma 2.5 mm) of an image with another on the same grid.

    Returns
    -------
    map : (ni, nj, nk) float32
        Local correlation in the mask, NaN outside and where ``carried`` is NaN.
    pooled : float
        sum(cov) / sqrt(sum(var_a) sum(var_b)) over the mask: one figure, weighted by local structure.
    """
    (box, known), sigma = _known(a, carried, mask), _WINDOW_MM / a.grid.spacing_mm
    x = np.where(known, fill_missing(a).values[box], 0.0).astype(np.float32)
    y = np.where(known, carried[box], 0.0).astype(np.float32)
    weight = gaussian_filter(known.astype(np.float32), sigma, mode="constant")
    weight = np.where(known, np.maximum(weight, 1e-3), 1.0)

    def mean(values: Float32Array) -> Float32Array:
        return np.asarray(gaussian_filter(values, sigma, mode="constant") / weight, dtype=np.float32)

    scale_x, scale_y = max(float(x.std()), 1e-12), max(float(y.std()), 1e-12)
    x, y = x / scale_x, y / scale_y
    mx, my = mean(x), mean(y)
    vx, vy = np.maximum(mean(x * x) - mx * mx, 0.0), np.maximum(mean(y * y) - my * my, 0.0)
    cov = mean(x * y) - mx * my
    local = np.where(known, cov / np.sqrt(np.maximum(vx * vy, 1e-12)), np.nan)
    total = float(np.sqrt(vx[known].sum(dtype=np.float64) * vy[known].sum(dtype=np.float64)))
    pooled = float(cov[known].sum(dtype=np.float64)) / total if total > 0 else float("nan")
    whole = np.full(a.grid.shape, np.nan, dtype=np.float32)
    whole[box] = local
    return whole, pooled


def _known(a: Image, carried: Float32Array, mask: Mask) -> tuple[tuple[slice, ...], BoolArray]:
    """The mask's box, and the voxels of the mask in it that both images know."""
    box = mask.box()
    return box, np.isfinite(carried[box]) & mask.inside[box] & ~a.missing[box]


def most_similarity(a: Image, carried: Float32Array, mask: Mask, noise: tuple[float, float]) -> tuple[float, float]:
    """Pooled local correlation of two images of the same tissue that differ in nothing but their noise.

    sqrt((1 - s_a^2 / v_a) (1 - s_b^2 / v_b)), where s is the standard deviation of an image's noise
    (`dvc.images.noise.noise_in_air`) and v the mean local variance in the mask, in the windows of `local_correlation`;
    with the noise as given, and with half as much again.
    """
    (box, known), sigma = _known(a, carried, mask), _WINDOW_MM / a.grid.spacing_mm
    weight = np.maximum(gaussian_filter(known.astype(np.float64), sigma, mode="constant"), 1e-3)
    shares = []
    for values, s in zip((fill_missing(a).values, carried), noise, strict=True):
        x = np.where(known, values[box], 0.0).astype(np.float64)
        mean, square = (gaussian_filter(part, sigma, mode="constant") / weight for part in (x, x * x))
        shares.append(s**2 / max(float((square - mean**2)[known].mean()), 1e-12))
    as_given, more = (float(np.sqrt(np.prod([max(0.0, 1.0 - n**2 * share) for share in shares]))) for n in _NOISES)
    return as_given, more


def brightness_offset(a: Image, carried: Float32Array, mask: Mask, noise: float) -> tuple[float, float]:
    """How much of one image's brightness is an offset to the other's, and no factor of it.

    Fitted is ``carried = g(X) a + o(X)`` with g quadratic and o linear in X, by least squares in which the noise of
    ``a`` (its standard deviation, known beforehand) does not lower g (Fuller, Measurement Error Models, 1987, section
    2.2). The result is the 95th percentile of abs(o) over the mask, as a share of the tissue's brightness (75th
    percentile of ``carried``), with the noise as given and with half as much again; NaN where the mask has too few
    voxels that both know, or no contrast beyond the noise.
    """
    box, known = _known(a, carried, mask)
    at = np.argwhere(known)
    if len(at) < _FEWEST:
        return float("nan"), float("nan")
    x, y = (values[box][known].astype(np.float64) for values in (a.values, carried))
    size, bright = float(np.abs(x).max()), float(np.percentile(y, _BRIGHT))
    place = 2.0 * at / np.maximum(at.max(axis=0), 1) - 1.0
    linear = np.column_stack([np.ones(len(at)), place])
    gain = np.column_stack([linear, place**2, place * np.roll(place, 1, axis=1)])
    both = np.hstack([gain * (x / size)[:, None], linear])
    normal, right, own = both.T @ both, both.T @ y, gain.T @ gain

    def offset(factor: float) -> float:
        left, terms = normal.copy(), len(own)
        left[:terms, :terms] -= (factor * noise / size) ** 2 * own
        if not (bright > 0.0 and np.linalg.eigvalsh(left).min() > _LEAST * np.trace(left)):
            return float("nan")
        return float(np.percentile(np.abs(linear @ np.linalg.solve(left, right)[terms:]), 95)) / bright

    return offset(_NOISES[0]), offset(_NOISES[1])
