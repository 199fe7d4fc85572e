"""How far a registration may be trusted: a verdict by its strain maps, the images' similarity, and more evidence."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dvc.arrays import Float32Array, FloatArray
from dvc.deformation.strain_maps import StrainMaps
from dvc.images.image import Grid, Mask
from dvc.trust.plate_motion import displacement_along_normal, moves_away, moves_away_alone
from dvc.trust.quality import NoiseFloor, Quality
from dvc.trust.verdict import Verdict, together

_NOISIER = " if it is exceeded at 1.5 times this noise, too"
# Where a quantity lowers the verdict: use with care, do not trust. If the second limit is the lower, it must lie above.
# Beside the limits: decimals and unit of the quantity in the sentence that tells of it.
# The pooled local correlation depends on noise and texture; the limits were set on phantoms, where sound registrations
# at SNR 10 to 25 stay above 0.8 and failed ones below 0.6. Those of the voxels come from a warp of a knee with added
# noise (slices of 4 mm: apparent maximum shear strain 0.1) and a leg's repeat scan (6 mm: 0.3). Unlikeness is what the
# similarity lacks of the most that noise leaves: it reveals another person's foot. Offsets that rose to 7, 15 and 30 %
# across a phantom's foot raised the error in fat by 2, 16 and 130 %, in skin by 27, 93 and 380 %.
_LIMITS = {
    "similarity": (0.7, 0.45, 2, "",
        "The registered images agree poorly: local similarity {value} ({limits})."),
    "unlikeness": (0.05, 0.09, 2, "", "The registered images differ more than their noise explains: local similarity "
        "is {value} below the highest value that the noise measured in the air allows "
        f"({{limits}}{_NOISIER}). Check that both images show the same subject, scanned with the same protocol. "
        "Parallel imaging and filters change the noise in the tissue."),
    "offset": (0.07, 0.12, 0, "%", "The images differ by an offset in brightness, {value} of the tissue's brightness "
        f"({{limits}}{_NOISIER}). The registration takes it for motion. Scan both with the same protocol, or remove "
        "the offset from the images."),
    "voxel_mm": (2.0, 5.0, 1, " mm", "Slices are {value} apart ({limits}). Strain across slices is hardly resolved, "
        "and apparent strain appears where there is none."),
    "bone_shift_mm": (0.3, 0.8, 2, " mm",
        "The bone, which is rigid, shows an apparent displacement of {value} (root mean square; {limits}). Check that "
        "the mask is that of the bone on the unloaded image."),
    "bone_shear_p95": (0.1, 0.25, 3, "", "The bone, which is rigid, shows an apparent maximum shear strain of {value} "
        "(95th percentile; {limits}). Do not use the strain next to bone."),
    "lowest_jacobian": (0.3, 0.0, 2, "", "The lowest volume ratio is {value}: tissue is compressed to this fraction of "
        "its volume ({limits}). Look there, at LPS ({place}) mm; at the edge of the body it is seldom real."),
    "undefined_fraction": (0.15, 0.4, 0, "%", "{value} of the tissue has no result: the loaded image does not show it, "
        "or the deformation does not cover it ({limits}). Use a larger field of view, or a smaller mask of the body."),
    "landmark_error_mm": (1.0, 2.0, 2, " mm", "The median landmark error is {value} ({limits}). Check those with "
        "the largest errors: they may be misplaced."),
    "floor_shear_p95": (0.06, 0.15, 3, "", "The repeat scan, without strain, shows an apparent maximum shear strain of "
        "{value} (95th percentile; {limits}). Interpret no strain below it; more averages or larger voxels "
        "lower it."),
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """How alike the two images are.

    Attributes
    ----------
    found : (before, after rigid, after all)
        Pooled local correlations (`dvc.local_correlation`).
    possible, offset : (noise as in the air, 1.5 times that noise)
        The highest correlation that this noise allows (`dvc.images.similarity.most_similarity`), and the offset between
        the registered images as a fraction of the brightness (`dvc.images.similarity.brightness_offset`); NaN where not
        known. The verdict is "Do not trust" only where the limit is exceeded at 1.5 times the noise, too.
    """

    found: tuple[float, float, float]
    possible: tuple[float, float] = (np.nan, np.nan)
    offset: tuple[float, float] = (np.nan, np.nan)


def assess(
    maps: StrainMaps,
    tissue: Mask,
    bone: Mask | None,
    *,
    similarity: Similarity | None = None,
    landmark_errors_mm: FloatArray | None = None,
    floor: NoiseFloor | None = None,
    in_bone: tuple[float, float] | None = None,
    plate_normal: FloatArray | None = None,
) -> Quality:
    """Assess a registration by its strain maps, the similarity of the images, and further evidence.

    Parameters
    ----------
    maps : StrainMaps
        Displacement (mm) and strain on the unloaded image's grid, reference configuration (`dvc.strain_maps`).
    tissue : Mask
        Soft tissue and bone, on the same grid; the fraction without a result counts in the verdict.
    bone : Mask or None
        The bone that was aligned on, on the same grid; any motion in it is an error. None without a bone.
    similarity : Similarity, optional
        None without images to compare; the verdict is then "Use with care" at best.
    landmark_errors_mm : (n,), optional
        Distance between each registered and each given landmark, mm; NaN where not defined
        (`dvc.target_registration_error`).
    floor : NoiseFloor, optional
        Of a repeat scan without load (`dvc.noise_floor`).
    in_bone : (mm, no unit), optional
        For maps with a rigid bone: root mean square displacement and 95th percentile of the maximum shear strain in the
        bone before it was made rigid.
    plate_normal : (3,), optional
        Unit direction, LPS, from the body to a plate that presses on it: the tissue between it and the bone must move
        towards the bone. Without it, and with images (``similarity``), no tissue may move away from the bone on one
        side by over 1 mm while none moves towards it by as much.

    Returns
    -------
    Quality
        The quantities, and the verdict: "distrust" or "caution" if one exceeds its limit, with a sentence for each such
        quantity that gives its value and limits; otherwise "trust".
    """
    lowest, at = _lowest(maps.jacobian, maps.grid)
    known = int(np.count_nonzero(maps.valid & tissue.inside))
    bone_shift, bone_shear = _in_bone(maps, bone, in_bone)
    quality = Quality(
        similarity=None if similarity is None else similarity.found,
        most_similarity=np.nan if similarity is None else similarity.possible[0],
        offset=np.nan if similarity is None else similarity.offset[0],
        folded_voxels=int(np.count_nonzero(maps.jacobian[maps.valid] <= 0.0)),
        lowest_jacobian=lowest,
        lowest_jacobian_at_mm=at,
        undefined_fraction=float(1.0 - known / max(int(np.count_nonzero(tissue.inside)), 1)),
        bone_shift_mm=bone_shift,
        bone_shear_p95=bone_shear,
        bone_held=in_bone is not None,
        landmark_errors_mm=landmark_errors_mm,
        noise_floor=floor,
        verdict=Verdict("trust"),
    )
    findings = []
    if bone is not None and not np.isfinite(bone_shift):
        findings.append(Verdict("caution", ("The bone has no result, so it is not known whether it stayed rigid.",)))
    if similarity is None:
        findings.append(Verdict("caution", ("No images were compared; the given deformation is not checked.",)))
    if quality.folded_voxels:
        least = _apart(lowest, (0.0,), 2)
        folds = f"The deformation folds (det F <= 0) in {quality.folded_voxels} voxels; the lowest det F is {least}"
        findings.append(Verdict("distrust", (f"{folds}, at LPS ({_place(at)}) mm.",)))
    if similarity is not None:
        findings += _unlike(similarity, quality, float(maps.grid.spacing_mm.max()))
    for name in ("bone_shift_mm", "bone_shear_p95", "lowest_jacobian", "undefined_fraction"):
        if np.isfinite(value := getattr(quality, name)):
            findings += _judged(name, value, place=_place(at))
    findings += _judged("landmark_error_mm", quality.landmarks["median_mm"])
    if floor is not None:
        findings += _judged("floor_shear_p95", floor.max_shear_p95)
    if bone is not None and plate_normal is not None:
        findings += moves_away(displacement_along_normal(maps, tissue, bone, plate_normal))
    elif bone is not None and similarity is not None:
        findings += moves_away_alone(maps, tissue, bone)
    return replace(quality, verdict=together(findings))


def _in_bone(maps: StrainMaps, bone: Mask | None, told: tuple[float, float] | None) -> tuple[float, float]:
    """Root mean square displacement (mm) and 95th percentile of maximum shear strain in the bone; NaN without one."""
    if bone is None or not (kept := maps.valid & bone.inside).any():
        return np.nan, np.nan
    if told is not None:
        return told
    squared = (maps.displacement_mm[kept].astype(np.float64) ** 2).sum(axis=1)
    return float(np.sqrt(squared.mean())), float(np.percentile(maps.max_shear[kept], 95))


def _lowest(jacobian: Float32Array, grid: Grid) -> tuple[float, tuple[float, float, float]]:
    """Lowest det F, and the centre of its voxel, LPS mm."""
    if not np.isfinite(jacobian).any():
        return np.nan, (np.nan,) * 3
    index = np.unravel_index(int(np.nanargmin(jacobian)), jacobian.shape)
    x, y, z = grid.points_at(np.array(index)).tolist()
    return float(jacobian[index]), (x, y, z)


def _unlike(similarity: Similarity, quality: Quality, slice_mm: float) -> list[Verdict]:
    """Findings from the images: their similarity, their brightness, and the distance of their slices (mm)."""
    _, rigid, after = similarity.found
    findings = _judged("similarity", after)
    lacking, surely = (possible - after for possible in similarity.possible)
    findings += _judged("unlikeness", lacking, surely > _LIMITS["unlikeness"][1])
    findings += _judged("offset", quality.offset, similarity.offset[1] > _LIMITS["offset"][1])
    more = "" if quality.noise_floor is not None else " A repeat scan without load measures how much."
    findings += [Verdict(one.level, (f"{one.reasons[0]}{more}",)) for one in _judged("voxel_mm", slice_mm)]
    if after < rigid - 0.01:
        told = "The non-rigid registration made the images less similar: local similarity fell from"
        findings.append(Verdict("distrust", (f"{told} {rigid:z.2f} to {after:z.2f}.",)))
    return findings


def _place(at_mm: tuple[float, float, float]) -> str:
    return ", ".join(f"{c:z.1f}" for c in at_mm)


def _judged(name: str, value: float, distrusted: bool | None = None, place: str = "") -> list[Verdict]:
    """A quantity beside its limits: a finding, or none. ``distrusted``: decided by more than the second limit."""
    care, distrust, decimals, unit, sentence = _LIMITS[name]
    falling = care > distrust
    # NaN: a similarity that is not known counts as none; of the others, what is not finite is not known.
    if value >= care if falling else not (np.isfinite(value) and value > care):
        return []
    if distrusted is None:
        distrusted = not value >= distrust if falling else value > distrust
    scale, side = 100.0 if unit == "%" else 1.0, "below" if falling else "above"
    near = [limit * scale for limit in (care, distrust)]
    limits = f"limits: 'Use with care' {side} {near[0]:g}{unit}, 'Do not trust' {side} {near[1]:g}{unit}"
    told = _apart(value * scale, near, decimals) + unit
    reason = sentence.format(value=told, limits=limits, place=place)
    return [Verdict("distrust" if distrusted else "caution", (reason,))]


def _apart(value: float, limits: Sequence[float], decimals: int) -> str:
    """A number with so many decimals, or as many more as it takes to differ from its limits.

    >>> _apart(0.06004, (0.06, 0.15), 3), _apart(0.06, (0.06, 0.15), 3), _apart(-0.0001, (0.3, 0.0), 2)
    ('0.06004', '0.060', '-0.0001')
    """
    different = (d for d in range(decimals, 12) if f"{value:z.{d}f}" not in (f"{limit:z.{d}f}" for limit in limits))
    return f"{value:z.{next(different, decimals)}f}"
