"""The figures by which a registration is judged: folding, similarity, bone, landmarks, noise floor."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.strain_maps import StrainMaps
from dvc.errors import InputError
from dvc.trust.verdict import Verdict

_SIMILARITIES = ("before", "after_rigid", "after_all")
_FLOOR = ("maer", "sder", "max_shear_p50", "max_shear_p95", "displacement_p95_mm")


@dataclass(frozen=True, slots=True)
class NoiseFloor:
    """What a repeat scan without load shows: the apparent strain where the truth is zero.

    Attributes
    ----------
    maer : float
        Mean over voxels of the mean absolute value of the six components of E (MAER of Palanca et al. 2015,
        doi:10.1115/1.4030533).
    sder : float
        Standard deviation over voxels of that same mean.
    shear_p50, shear_p95 : float
        Percentiles of the apparent maximal shear.
    displacement_p95_mm : float
    """

    maer: float
    sder: float
    shear_p50: float
    shear_p95: float
    displacement_p95_mm: float

    def as_dict(self) -> dict[str, float]:
        """Plain values for JSON."""
        return dict(zip(_FLOOR, astuple(self), strict=True))

    @classmethod
    def from_dict(cls, told: Mapping[str, Any]) -> NoiseFloor:
        """The noise floor of which `as_dict` told."""
        return cls(*(float(told[name]) for name in _FLOOR))


@dataclass(frozen=True, slots=True)
class Quality:
    """The figures behind the verdict.

    Attributes
    ----------
    similarity : (before, after rigid, after all) or None
        Pooled local correlation in the tissue, -1 to 1.
    most_similarity : float
        What noise as in the air lets the last of these be; NaN where that is not known.
    offset : float
        Share of the brightness that is an offset between the images (`dvc.images.similarity.brightness_offset`); NaN
        where it is not known.
    folded_voxels : int
        Voxels with det F <= 0.
    lowest_jacobian : float
    lowest_jacobian_at_mm : (x, y, z)
        LPS mm, reference configuration.
    undefined_fraction : float
        Share of the tissue without a value.
    bone_shift_mm : float
        Root mean square displacement left inside the bone, which is rigid: zero is the truth. NaN without a bone.
    bone_shear_p95 : float
        95th percentile of the apparent maximal shear inside the bone; NaN without.
    bone_held : bool
        Whether these two are of a displacement before the bone was held at rest, as it is in the maps.
    landmark_errors_mm : (n,) or None
        Distance between each registered and each given landmark.
    noise_floor : NoiseFloor or None
    verdict : Verdict
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

        def plain(value: float) -> float | None:
            return float(value) if np.isfinite(value) else None

        errors = self.landmark_errors_mm
        floor = self.noise_floor
        return {
            "verdict": self.verdict.as_dict(),
            "local_similarity": None
            if self.similarity is None
            else dict(zip(_SIMILARITIES, map(plain, self.similarity), strict=True)),
            "local_similarity_that_noise_allows": plain(self.most_similarity),
            "offset_between_images_over_brightness": plain(self.offset),
            "folded_voxels": self.folded_voxels,
            "lowest_jacobian": plain(self.lowest_jacobian),
            "lowest_jacobian_at_lps_mm": [plain(c) for c in self.lowest_jacobian_at_mm],
            "undefined_fraction_of_tissue": plain(self.undefined_fraction),
            "bone_shift_rms_mm": plain(self.bone_shift_mm),
            "bone_shear_p95": plain(self.bone_shear_p95),
            "bone_figures_before_it_was_held_at_rest": self.bone_held,
            "landmarks": None
            if errors is None
            else {
                "count": int(errors.size),
                "undefined": int(np.count_nonzero(~np.isfinite(errors))),
                "median_mm": plain(_finite(np.nanmedian, errors)),
                "max_mm": plain(_finite(np.nanmax, errors)),
                "each_mm": [plain(e) for e in errors],
            },
            "noise_floor": None if floor is None else floor.as_dict(),
        }

    @classmethod
    def from_dict(cls, told: Mapping[str, Any]) -> Quality:
        """The quality of which `as_dict` told; KeyError, TypeError or ValueError where something is missing."""

        def number(value: float | None) -> float:
            return float("nan") if value is None else float(value)

        alike, landmarks = told["local_similarity"], told["landmarks"]
        x, y, z = map(number, told["lowest_jacobian_at_lps_mm"])
        return cls(
            None if alike is None else tuple(number(alike[name]) for name in _SIMILARITIES),  # type: ignore[arg-type]
            number(told["local_similarity_that_noise_allows"]),
            number(told["offset_between_images_over_brightness"]),
            int(told["folded_voxels"]),
            number(told["lowest_jacobian"]),
            (x, y, z),
            number(told["undefined_fraction_of_tissue"]),
            number(told["bone_shift_rms_mm"]),
            number(told["bone_shear_p95"]),
            bool(told["bone_figures_before_it_was_held_at_rest"]),
            None if landmarks is None else np.array([number(each) for each in landmarks["each_mm"]]),
            None if told["noise_floor"] is None else NoiseFloor.from_dict(told["noise_floor"]),
            Verdict(told["verdict"]["level"], tuple(told["verdict"]["reasons"])),
        )


def _finite(reduce: object, values: FloatArray) -> float:
    return float(reduce(values)) if np.isfinite(values).any() else float("nan")  # type: ignore[operator]


def noise_floor(maps: StrainMaps, where: BoolArray) -> NoiseFloor | None:
    """The apparent strain of a repeat scan, in the voxels of ``where`` that are valid; None where none is."""
    kept = maps.valid & where
    if not kept.any():
        return None
    each = np.abs(maps.green_lagrange[kept]).astype(np.float64).mean(axis=1)
    shear = maps.max_shear[kept]
    length = np.linalg.norm(maps.displacement_mm[kept], axis=1)
    return NoiseFloor(
        float(each.mean()),
        float(each.std()),
        float(np.percentile(shear, 50)),
        float(np.percentile(shear, 95)),
        float(np.percentile(length, 95)),
    )


def read_noise_floor(path: Path) -> NoiseFloor | None:
    """Read the noise floor of a repeat scan from its ``quality.json``; None where it tells none.

    Raises
    ------
    InputError
        If there is no such file, or it is another.
    """
    try:
        told = json.loads(path.read_text(encoding="utf-8"))["noise_floor"]
        return None if told is None else NoiseFloor.from_dict(told)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no quality of a repeat scan ({error!r}). Register the repeat scan again.") from error
