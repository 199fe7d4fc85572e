"""The quantities by which a registration is judged: folding, similarity, bone, landmarks, noise floor."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.strain_maps import StrainMaps
from dvc.errors import InputError
from dvc.own_files import read_json
from dvc.trust.verdict import Verdict

_SIMILARITIES = ("before", "after_rigid", "after_all")


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _numbers(values: Sequence[float | None]) -> tuple[float, ...]:
    return tuple(map(_number, values))


_FIGURES: dict[str, tuple[str, Callable[[Any], object]]] = {  # fields of Quality: name and reader in quality.json
    "most_similarity": ("local_similarity_that_noise_allows", _number),
    "offset": ("offset_between_images_over_brightness", _number),
    "folded_voxels": ("folded_voxels", int),
    "lowest_jacobian": ("lowest_jacobian", _number),
    "lowest_jacobian_at_mm": ("lowest_jacobian_at_lps_mm", _numbers),
    "undefined_fraction": ("undefined_fraction_of_tissue", _number),
    "bone_shift_mm": ("bone_shift_rms_mm", _number),
    "bone_shear_p95": ("bone_shear_p95", _number),
    "bone_held": ("bone_figures_before_it_was_held_at_rest", bool),
}


@dataclass(frozen=True, slots=True)
class NoiseFloor:
    """What a repeat scan without load shows: the apparent strain where the truth is zero.

    Attributes
    ----------
    maer, sder : float
        Mean over voxels of the mean absolute value of the six components of the Green-Lagrange strain, no unit, and its
        standard deviation over voxels (Palanca et al. 2015, doi:10.1115/1.4030533).
    max_shear_p50, max_shear_p95 : float
        Median and 95th percentile of the apparent maximum shear strain (E1 - E3)/2, no unit.
    displacement_p95_mm : float
        95th percentile of the length of the apparent displacement, mm.
    """

    maer: float
    sder: float
    max_shear_p50: float
    max_shear_p95: float
    displacement_p95_mm: float

    @classmethod
    def from_dict(cls, told: Mapping[str, Any]) -> Self:
        """The noise floor in ``quality.json``."""
        return cls(**{name: float(value) for name, value in told.items()})


@dataclass(frozen=True, slots=True)
class Quality:
    """The quantities behind the verdict.

    Attributes
    ----------
    similarity : (before, after rigid, after all) or None
        Pooled local correlation of the two images in the tissue (`dvc.local_correlation`), -1 to 1, as scanned, after
        the rigid part and after all; None where no images were compared.
    most_similarity : float
        Highest value of the last of these that noise as in the air allows, 0 to 1; NaN if not known.
    offset : float
        Offset between the images as a fraction of the tissue's brightness, no unit; NaN if not known.
    folded_voxels : int
        Number of voxels with det F <= 0.
    lowest_jacobian, lowest_jacobian_at_mm : float, (x, y, z)
        Lowest det F, no unit, and the centre of its voxel, LPS mm, reference configuration; NaN without any value.
    undefined_fraction : float
        Fraction of the tissue's voxels without a value, 0 to 1.
    bone_shift_mm, bone_shear_p95 : float
        Root mean square displacement, mm, and 95th percentile of the apparent maximum shear strain (E1 - E3)/2, no
        unit, in the bone, which is rigid: the true values are zero. NaN without a bone.
    bone_held : bool
        Whether these two are from the preceding smooth spline, because the bone is rigid in the maps.
    landmark_errors_mm : (n,) or None
        Distance between each registered and each given landmark, mm; NaN where not defined. None without landmarks.
    noise_floor : NoiseFloor or None
        Apparent strain of a repeat scan; None without one.
    verdict : Verdict
        The verdict on the registration, with reasons.
    """

    similarity: tuple[float, float, float] | None
    most_similarity: float
    offset: float
    folded_voxels: int
    lowest_jacobian: float
    lowest_jacobian_at_mm: tuple[float, float, float]
    undefined_fraction: float
    bone_shift_mm: float
    bone_shear_p95: float
    bone_held: bool
    landmark_errors_mm: FloatArray | None
    noise_floor: NoiseFloor | None
    verdict: Verdict

    def as_dict(self) -> dict[str, object]:
        """Plain values for JSON; NaN becomes None."""
        alike, errors, floor, landmarks = self.similarity, self.landmark_errors_mm, self.noise_floor, self.landmarks
        return {
            "verdict": self.verdict.as_dict(),
            "local_similarity": None if alike is None else dict(zip(_SIMILARITIES, plain(alike), strict=True)),
            **{stored: plain(getattr(self, name)) for name, (stored, _) in _FIGURES.items()},
            "landmarks": None if errors is None else plain(landmarks) | {"each_mm": plain(errors.tolist())},
            "noise_floor": None if floor is None else asdict(floor),
        }

    @property
    def landmarks(self) -> dict[str, float]:
        """How many landmarks there are, how many are undefined, and median and largest error (mm) of the others."""
        errors = np.empty(0) if self.landmark_errors_mm is None else self.landmark_errors_mm
        known = errors[np.isfinite(errors)]
        median, largest = (float(np.median(known)), float(known.max())) if known.size else (np.nan, np.nan)
        return {"count": errors.size, "undefined": errors.size - known.size, "median_mm": median, "max_mm": largest}

    @classmethod
    def from_dict(cls, told: Mapping[str, Any]) -> Self:
        """The quality that `as_dict` gave; KeyError, TypeError or ValueError where something is missing."""
        alike, landmarks, floor = (told[name] for name in ("local_similarity", "landmarks", "noise_floor"))
        figures: dict[str, Any] = {name: read(told[stored]) for name, (stored, read) in _FIGURES.items()}
        figures["similarity"] = None if alike is None else _numbers([alike[name] for name in _SIMILARITIES])
        figures["landmark_errors_mm"] = None if landmarks is None else np.array(_numbers(landmarks["each_mm"]))
        figures["noise_floor"] = None if floor is None else NoiseFloor.from_dict(floor)
        return cls(**figures, verdict=Verdict(told["verdict"]["level"], tuple(told["verdict"]["reasons"])))


def plain(value: Any) -> Any:
    """A number, or several, for JSON, which knows no NaN: None stands for it."""
    if isinstance(value, Mapping):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return value if isinstance(value, int) else float(value) if np.isfinite(value) else None


def noise_floor(maps: StrainMaps, where: BoolArray) -> NoiseFloor | None:
    """The apparent strain of a repeat scan without load, whose true strain is zero.

    Parameters
    ----------
    maps : StrainMaps
        Of the second unloaded image against the first, on the grid of the first.
    where : (ni, nj, nk) bool
        Voxels to count, such as the soft tissue: of these, all where the maps are valid.

    Returns
    -------
    NoiseFloor or None
        None where no voxel is left.
    """
    kept = maps.valid & where
    if not kept.any():
        return None
    each = np.abs(maps.green_lagrange[kept]).astype(np.float64).mean(axis=1)
    length = np.linalg.norm(maps.displacement_mm[kept], axis=1)
    p50, p95 = (float(np.percentile(maps.max_shear[kept], p)) for p in (50, 95))
    return NoiseFloor(float(each.mean()), float(each.std()), p50, p95, float(np.percentile(length, 95)))


def read_noise_floor(path: Path) -> NoiseFloor | None:
    """The noise floor in the ``quality.json`` of a repeat scan, or None; InputError for another file."""
    try:
        told = read_json(path)["noise_floor"]
        return None if told is None else NoiseFloor.from_dict(told)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not the quality of a repeat scan ({error!r}). Register that scan again.") from error
