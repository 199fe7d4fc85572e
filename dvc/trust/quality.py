"""How far a registration may be trusted: folding, similarity, bone, landmarks, noise floor, and a verdict."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.deformation.strain_maps import StrainMaps
from dvc.errors import InputError
from dvc.images.image import Grid, Mask
from dvc.trust.verdict import Level, Verdict

_MORE_NOISE = 1.5  # times that in the air: parallel imaging and normalised intensities raise it in the tissue


@dataclass(frozen=True, slots=True)
class Limits:
    """Where a figure turns a verdict; each pair is (use with care, do not trust).

    The pooled local correlation depends on noise and texture; the limits were set on phantoms, where sound
    registrations at SNR 10 to 25 stay above 0.8 and failed ones below 0.6. Those of the voxels come from a
    knee's moved and noisy twin (slices of 4 mm: apparent maximal shear 0.1) and a leg's repeat scan (6 mm: 0.3).
    Unlikeness is what the similarity lacks of the most that noise leaves: it tells another person's foot. Offsets
    that rose to 7, 15 and 30 % across a phantom's foot raised the error in fat by 2, 16 and 130 %, in skin by 27, 93
    and 380 %.
    """

    similarity: tuple[float, float] = (0.7, 0.45)
    unlikeness: tuple[float, float] = (0.05, 0.09)
    offset: tuple[float, float] = (0.07, 0.12)
    bone_shift_mm: tuple[float, float] = (0.3, 0.8)
    bone_shear_p95: tuple[float, float] = (0.1, 0.25)
    lowest_jacobian: tuple[float, float] = (0.3, 0.0)
    undefined_fraction: tuple[float, float] = (0.15, 0.4)
    landmark_error_mm: tuple[float, float] = (1.0, 2.0)
    floor_shear_p95: tuple[float, float] = (0.06, 0.15)
    voxel_mm: tuple[float, float] = (2.0, 5.0)


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
            else dict(zip(("before", "after_rigid", "after_all"), map(plain, self.similarity), strict=True)),
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
            "noise_floor": None
            if floor is None
            else {
                "maer": floor.maer,
                "sder": floor.sder,
                "max_shear_p50": floor.shear_p50,
                "max_shear_p95": floor.shear_p95,
                "displacement_p95_mm": floor.displacement_p95_mm,
            },
        }


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
        if told is None:
            return None
        names = ("maer", "sder", "max_shear_p50", "max_shear_p95", "displacement_p95_mm")
        return NoiseFloor(*(float(told[name]) for name in names))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: no quality of a repeat scan ({error!r}). Register the repeat scan again.") from error


def assess(
    maps: StrainMaps,
    tissue: Mask,
    bone: Mask | None,
    *,
    similarity: tuple[float, float, float] | None = None,
    most_similarity: Callable[[float], float] | None = None,
    offset: Callable[[float], float] | None = None,
    landmark_errors_mm: FloatArray | None = None,
    floor: NoiseFloor | None = None,
    in_bone: tuple[float, float] | None = None,
    limits: Limits | None = None,
) -> Quality:
    """Judge a registration by its strain maps and the images' similarity.

    Parameters
    ----------
    bone : Mask or None
        The bone that was aligned on: what moves in it is error. None where none was.
    similarity : (before, after rigid, after all), optional
        Pooled local correlations (`dvc.images.similarity.local_correlation`); None where there are no images to
        compare.
    most_similarity : callable, optional
        What noise, and a multiple of it, leaves of the last (`dvc.images.similarity.most_similarity`). What lacks is
        not trusted where it is too much for half as much noise again.
    offset : callable, optional
        Between the registered images, as a share of brightness, at the noise and at a multiple of it
        (`dvc.images.similarity.brightness_offset`). It is not trusted where it is too much for half as much noise
        again.
    in_bone : (mm, shear), optional
        Where the maps hold the bone at rest: root mean square displacement and 95th percentile of the maximal shear
        in it before that was asked.
    """
    lines = limits or Limits()
    jacobian = maps.jacobian
    folded = int(np.count_nonzero(jacobian[maps.valid] <= 0.0))
    lowest, at = _lowest(jacobian, maps.grid)
    undefined = 1.0 - int(np.count_nonzero(maps.valid & tissue.inside)) / max(int(np.count_nonzero(tissue.inside)), 1)
    bone_shift = bone_shear = float("nan")
    if bone is not None:
        kept = bone.inside & maps.valid
        if kept.any() and in_bone is not None:
            bone_shift, bone_shear = in_bone
        elif kept.any():
            squared = (maps.displacement_mm[kept].astype(np.float64) ** 2).sum(axis=1)
            bone_shift = float(np.sqrt(squared.mean()))
            bone_shear = float(np.percentile(maps.max_shear[kept], 95))
    share = float("nan") if offset is None else offset(1.0)
    findings: list[Verdict] = []
    if bone is not None and not np.isfinite(bone_shift):
        findings.append(Verdict("caution", ("The bone has no result, so whether it stayed rigid is not known.",)))
    if similarity is None:
        findings.append(Verdict("caution", ("No images were compared: the deformation is taken as it was given.",)))
    if folded:
        place = ", ".join(f"{c:.1f}" for c in at)
        findings.append(
            Verdict(
                "distrust",
                (f"The deformation folds: det F <= 0 in {folded} voxels, lowest {lowest:.2f} at LPS ({place}) mm.",),
            )
        )
    if similarity is not None:
        _judge_below(
            findings,
            similarity[2],
            lines.similarity,
            "After registration the images agree poorly: local similarity {value:.2f} (care below {limit:.2f}).",
        )
        if most_similarity is not None:
            care, distrust = lines.unlikeness
            lacks = most_similarity(1.0) - similarity[2]
            surely = most_similarity(_MORE_NOISE) - similarity[2] > distrust
            _judge_above(
                findings,
                lacks,
                (care, -np.inf if surely else np.inf),
                "After registration the images are less alike than noise as strong as in the air would leave them: "
                "local similarity lacks {value:.2f} (care above {limit:.2f}). Is it the same foot, scanned in the same "
                "way? Parallel imaging and filters change the noise in the tissue.",
            )
        surely = offset is not None and offset(_MORE_NOISE) > lines.offset[1]
        _judge_above(
            findings,
            share,
            (lines.offset[0], -np.inf if surely else np.inf),
            "The images' brightness differs by more than a factor: by an offset of {value:.0%} of the tissue's (care "
            "above {limit:.0%}), which is taken for motion. Scan both in the same way, or take it out of the images.",
        )
        _judge_above(
            findings,
            float(maps.grid.spacing_mm.max()),
            lines.voxel_mm,
            "Slices are {value:.1f} mm apart: strain across them is hardly seen, and strain is found where there is "
            "none (care above {limit:.0f} mm). A repeat scan without load tells how much.",
        )
        if similarity[2] < similarity[1] - 0.01:
            findings.append(
                Verdict(
                    "distrust",
                    (
                        "The non-rigid registration made the images less alike: local similarity went from "
                        f"{similarity[1]:.2f} to {similarity[2]:.2f}.",
                    ),
                )
            )
    _judge_above(
        findings,
        bone_shift,
        lines.bone_shift_mm,
        "The bone, which is rigid, was deformed: {value:.2f} mm root mean square (care above {limit:.2f}).",
    )
    _judge_above(
        findings,
        bone_shear,
        lines.bone_shear_p95,
        "The bone, which is rigid, shows an apparent maximal shear of {value:.3f} (95th percentile; care "
        "above {limit:.2f}).",
    )
    if np.isfinite(lowest):
        _judge_below(
            findings,
            lowest,
            lines.lowest_jacobian,
            "Somewhere tissue is squeezed to {value:.2f} of its volume (care below {limit:.2f}).",
        )
    _judge_above(
        findings,
        undefined,
        lines.undefined_fraction,
        "{value:.0%} of the tissue has no result: it is not shown by the loaded image or not covered by the "
        "deformation (care above {limit:.0%}).",
    )
    if landmark_errors_mm is not None and np.isfinite(landmark_errors_mm).any():
        _judge_above(
            findings,
            float(np.nanmedian(landmark_errors_mm)),
            lines.landmark_error_mm,
            "Landmarks are missed by {value:.2f} mm in the median (care above {limit:.2f}).",
        )
    if floor is not None:
        _judge_above(
            findings,
            floor.shear_p95,
            lines.floor_shear_p95,
            "The repeat scan shows an apparent maximal shear of {value:.3f} (95th percentile) where there "
            "is none (care above {limit:.3f}).",
        )
    return Quality(
        similarity,
        float("nan") if most_similarity is None else most_similarity(1.0),
        share,
        folded,
        lowest,
        at,
        float(undefined),
        bone_shift,
        bone_shear,
        in_bone is not None,
        landmark_errors_mm,
        floor,
        _together(findings),
    )


def _lowest(jacobian: Float32Array, grid: Grid) -> tuple[float, tuple[float, float, float]]:
    if not np.isfinite(jacobian).any():
        return float("nan"), (float("nan"),) * 3
    index = np.unravel_index(int(np.nanargmin(jacobian)), jacobian.shape)
    x, y, z = grid.points_at(np.array(index, dtype=np.float64))
    return float(jacobian[index]), (float(x), float(y), float(z))


def _judge_above(findings: list[Verdict], value: float, limits: tuple[float, float], sentence: str) -> None:
    if np.isfinite(value) and value > limits[0]:
        told = sentence.format(value=value, limit=limits[0])
        findings.append(Verdict("distrust" if value > limits[1] else "caution", (told,)))


def _judge_below(findings: list[Verdict], value: float, limits: tuple[float, float], sentence: str) -> None:
    if not value >= limits[0]:  # NaN is judged too: no similarity could be found
        told = sentence.format(value=value, limit=limits[0])
        findings.append(Verdict("caution" if value >= limits[1] else "distrust", (told,)))


def _together(findings: list[Verdict]) -> Verdict:
    if not findings:
        return Verdict("trust", ())
    level: Level = "distrust" if any(f.level == "distrust" for f in findings) else "caution"
    return Verdict(level, tuple(r for f in findings for r in f.reasons))
