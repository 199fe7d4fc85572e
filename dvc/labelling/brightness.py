"""Two tissues of different brightness, such as fat and muscle, in regions with short borders."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion, gaussian_filter
from scipy.special import ndtr
from skimage.filters import threshold_otsu

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.labelling.total_variation import with_short_borders

_BLUR_MM = 1.2  # before the two levels are found: more than the noise and the texture of a tissue
_BORDER_MM = 0.64  # weight of a border's area, against the volume on its wrong side
_LEAST_SEPARATION = 0.7  # share of the variance between both tissues; 0.64 for one tissue with normal texture
_SPREAD = 0.12  # standard deviation of the division's brightness about the middle, in steps between both levels
_ITERATIONS, _CONVERGED = 200, 2e-4


@dataclass(frozen=True, slots=True)
class Levels:
    """Median brightness of the darker and the brighter of two tissues, and the brightness that separates them."""

    darker: float
    brighter: float
    middle: float


def two_levels(values: Float32Array, where: BoolArray, spacing_mm: FloatArray) -> Levels | None:
    """Two levels of brightness by Otsu's threshold on the image blurred by 1.2 mm; None where there is only one.

    Parameters
    ----------
    values : (ni, nj, nk)
        Image without its bias field.
    where : (ni, nj, nk) bool
        Voxels of both tissues.
    spacing_mm : (3,)
        Voxel size.
    """
    whole = binary_erosion(where)  # without voxels that show a part of something else
    if not whole.any():
        return None
    within, sigma = whole.astype(np.float32), _BLUR_MM / spacing_mm
    share = gaussian_filter(within, sigma)[whole]
    blurred = (gaussian_filter(values * within, sigma)[whole] / share).astype(np.float64)
    if not np.ptp(blurred) > 0.0:
        return None
    middle = float(threshold_otsu(blurred))
    bright = blurred > middle
    apart = float(blurred[bright].mean() - blurred[~bright].mean())
    if not apart**2 * bright.mean() * (1.0 - bright.mean()) > _LEAST_SEPARATION * blurred.var():
        return None
    return Levels(float(np.median(blurred[~bright])), float(np.median(blurred[bright])), middle)


def brighter_share(
    values: Float32Array, where: BoolArray, levels: Levels, spacing_mm: FloatArray, border_mm: float = _BORDER_MM,
    beside: float = 0.0,
) -> FloatArray:  # fmt: skip
    """Probability of the brighter of two tissues, (ni, nj, nk); a half outside ``where``.

    Divided at a half, this is the division with the least sum of voxels on the wrong side of the middle, each counted
    by how far it is from there, and area of the border (total variation; A. Chambolle 2005, doi:10.1007/11585978_10).
    Borders count by voxels, in all directions alike. ``beside`` stands for the brightness outside ``where``, from -1
    (the darker tissue) to 1 (the brighter one): thin layers there, dark by the skin's part of their voxels, follow it.
    """
    told = np.where(where, np.clip((values - levels.middle) / (levels.brighter - levels.darker), -1.0, 1.0), beside)
    weight = border_mm / float(spacing_mm.mean())
    smooth = with_short_borders(told, weight, _CONVERGED, _ITERATIONS)
    return np.where(where, ndtr(smooth / _SPREAD), 0.5)
