"""Noise of a magnitude MR image: its standard deviation, and the signal-to-noise ratio of the tissue."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from dvc.errors import InputError
from dvc.images.image import Image, Mask
from dvc.images.tissue import tissue_mask, widened

_RAYLEIGH_MEDIAN = np.sqrt(2.0 * np.log(2.0))
_AIR_MM = 4.0
_LEAST = 1000
_NORMAL_MAD = 0.6745


def noise_sd(image: Image, tissue: Mask) -> float:
    """Standard deviation of the noise in either channel, in the image's own unit.

    From the air, more than 4 mm from the tissue, where a magnitude image of noise alone follows the Rayleigh
    distribution: its median is sigma sqrt(2 ln 2) (Gudbjartsson and Patz, Magn Reson Med 1995,
    doi:10.1002/mrm.1910340618). Where the scanner has set the air to zero, or none is in view, from the tissue's finest
    diagonal differences (Haar wavelets; median absolute deviation; Donoho and Johnstone, Biometrika 1994,
    doi:10.1093/biomet/81.3.425), which texture raises and a scanner's filter lowers. InputError as `noise_in_air`.
    """
    in_air = noise_in_air(image, tissue)
    return _finest_differences(image, tissue) if in_air is None else in_air


def _finest_differences(image: Image, tissue: Mask) -> float:
    """The noise that the tissue's finest diagonal differences tell, as in `noise_sd`."""
    finest = np.where(tissue.inside, image.values, np.nan)[tissue.box()].astype(np.float64)
    for axis in range(3):
        if finest.shape[axis] > 1:
            finest = np.diff(finest, axis=axis) / np.sqrt(2.0)
    return float(np.nanmedian(np.abs(finest)) / _NORMAL_MAD) if np.isfinite(finest).any() else 0.0


def noise_in_air(image: Image, tissue: Mask) -> float | None:
    """Standard deviation of the noise in either channel, in the image's own unit, from the air alone, as in `noise_sd`.

    None where the scanner has set the air to zero, or under 1000 voxels of it are in view; InputError for a mask that
    is empty or not on the image's grid. Parallel imaging has more noise in the tissue than this.
    """
    if not tissue.grid.same_as(image.grid) or not tissue.inside.any():
        raise InputError("The noise estimate needs a non-empty tissue mask on the grid of the image.")
    air = image.values[~image.missing & ~widened(tissue, _AIR_MM).inside]
    air = air[air > 0] if np.count_nonzero(air > 0) > 0.9 * max(air.size, 1) else air[:0]
    return float(np.median(air) / _RAYLEIGH_MEDIAN) if air.size >= _LEAST and np.ptp(air) > 0 else None


def signal_to_noise(image: Image, tissue: Mask) -> float:
    """Ratio of the tissue's 75th percentile to the noise's standard deviation; infinite without noise.

    In a heel the 75th percentile is that of fat, the brightest of its tissues and the most abundant.
    """
    return Noise.of(image, tissue).snr


@dataclass(frozen=True, slots=True)
class Noise:
    """Noise of a magnitude image: standard deviation in the air (`noise_in_air`), and `signal_to_noise` (no unit)."""

    in_air: float | None
    snr: float

    @classmethod
    def of(cls, image: Image, tissue: Mask, body: Mask | None = None) -> Self:
        """The noise of an image: the signal is a tissue's, and the air lies beside the body, by default that tissue."""
        in_air = noise_in_air(image, body or tissue)
        sigma = _finest_differences(image, tissue) if in_air is None else in_air
        level = float(np.percentile(image.values[tissue.inside & ~image.missing], 75))
        return cls(in_air, level / sigma if sigma > 0 else float("inf"))


def noise_of(reference: Image, loaded: Image, tissue: Mask) -> tuple[Noise, Noise | None]:
    """The noise of both images of a pair; None for a loaded one in which no threshold finds the body.

    The air of the unloaded image is what lies beside the whole body, of which the given tissue may be a part; where no
    threshold finds that body, its noise in the air is not known.
    """

    def body_in(image: Image) -> Mask | None:
        try:
            return tissue_mask(image)
        except InputError:
            return None

    seen, other = body_in(reference), body_in(loaded)
    of_loaded = None if other is None else Noise.of(loaded, other)
    if seen is None:
        return replace(Noise.of(reference, tissue), in_air=None), of_loaded
    return Noise.of(reference, tissue, Mask(reference.grid, tissue.inside | seen.inside)), of_loaded
