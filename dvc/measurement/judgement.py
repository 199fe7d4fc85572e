"""What a measurement is made from, how a registration is judged, and what is written of it beside the maps."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvc.arrays import Float32Array, FloatArray
from dvc.deformation.protocol import RigidMotion, displacement_on_grid
from dvc.deformation.strain_maps import StrainMaps, strain_maps
from dvc.images.depth import moved_mm
from dvc.images.image import Image, Mask
from dvc.images.resample import Carrier, shows
from dvc.images.similarity import Windows, brightness_offset, local_correlation
from dvc.io import result_folder as files
from dvc.io.images.write import write_image, write_mask
from dvc.io.transforms.write import write_displacement_as_found, write_itk_transform
from dvc.measurement.error_bars import TwinCheck
from dvc.measurement.subject import Subject
from dvc.registration.engine import Regularisation
from dvc.registration.register import Registration
from dvc.trust.assessment import Similarity, assess
from dvc.trust.error_model import ErrorModel
from dvc.trust.landmarks import target_registration_error
from dvc.trust.quality import NoiseFloor, Quality, plain
from dvc.trust.verdict import Verdict, together


@dataclass(frozen=True, slots=True, eq=False)
class CarriedImages:
    """The loaded image on the unloaded one's voxels, all (ni, nj, nk), and how well they agree."""

    aligned: Float32Array  # after the rigid part; NaN where the loaded scan does not show the place
    registered: Float32Array  # after all
    local_rigid: Float32Array  # local correlation with the unloaded image, for each of these
    local_after: Float32Array
    similarity: Similarity


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Evidence for the verdict on a registration, in addition to its two images.

    Attributes
    ----------
    landmarks : ((n, 3), (n, 3)), optional
        The same points in the unloaded and in the loaded image, LPS mm.
    noise_floor : NoiseFloor, optional
        Of a repeat scan.
    error_model : ErrorModel, optional
        Of the engine or preset that is used; by default the built-in one, if there is one.
    twin : TwinCheck, optional
        Result of registering a synthetic warp of the unloaded image by the measured displacement.
    """

    landmarks: tuple[FloatArray, FloatArray] | None = None
    noise_floor: NoiseFloor | None = None
    error_model: ErrorModel | None = None
    twin: TwinCheck | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """What a measurement was made from; one that was read from a folder has it no more."""

    subject: Subject
    tissue: Mask  # soft tissue and bone, on the unloaded image's grid
    registration: Registration | None = None  # None where the deformation was given; then there are no images, either
    images: CarriedImages | None = None


def maps_of(found: Registration) -> StrainMaps:
    """Strain where the registration sees whole tissue: nearer to the scan's end a spline sees half of it."""
    loaded, motion, edge = found.loaded, found.alignment.motion, float(found.displacement.spacing_mm.min())
    return strain_maps(found.deformation, found.tissue, lambda x: shows(loaded, motion.apply(x), edge))


def carried_images(found: Registration) -> CarriedImages:
    """Carry the loaded image to the unloaded one, and compare them."""
    reference, motion, grid = found.reference, found.alignment.motion, found.reference.grid
    loaded = Carrier(found.loaded)
    # Beyond the spline, in the air, the image is shown where the bone's motion alone puts it.
    u = np.nan_to_num(displacement_on_grid(found.displacement, grid, np.float32), copy=False)
    before = loaded.onto(grid, where=found.tissue.inside)
    aligned, registered = loaded.onto(grid, motion), loaded.onto(grid, motion, None, u)
    del u
    _, as_scanned = local_correlation(reference, before, found.tissue)
    del loaded, before
    both = Mask(grid, found.tissue.inside & np.isfinite(aligned) & np.isfinite(registered))  # the same voxels for both
    windows = Windows(both, reference.values)
    unloaded, rigid, after = (windows.structure(values) for values in (reference.values, aligned, registered))
    local_rigid, pooled_rigid = windows.correlation(unloaded, rigid)
    local_after, pooled_after = windows.correlation(unloaded, after)
    similarity = Similarity((as_scanned, pooled_rigid, pooled_after))
    in_air = [None if one is None else one.in_air for one in found.noise]
    if in_air[0] is not None and in_air[1] is not None:
        possible = windows.most_similarity(unloaded, after, (in_air[0], in_air[1]))
        similarity = replace(similarity, possible=possible)
        if found.settings.engine.sees_brightness:
            offset = brightness_offset(reference, registered, both, in_air[0])
            similarity = replace(similarity, offset=offset)
    return CarriedImages(aligned, registered, local_rigid, local_after, similarity)


def quality_of(
    found: Registration, maps: StrainMaps, similarity: Similarity, evidence: Evidence, subject: Subject
) -> Quality:
    """Quality and verdict of a registration; with doubts about the subject's labels, "Use with care" at best."""
    points, floor, choice = evidence.landmarks, evidence.noise_floor, found.choice
    bone = found.bone if found.alignment.on == "bone" else None
    errors = None if points is None else target_registration_error(found.total, *points)
    quality = assess(
        maps, found.tissue, bone, similarity=similarity, landmark_errors_mm=errors, floor=floor, in_bone=choice.in_bone,
        plate_normal=subject.pressed_along,
    )  # fmt: skip
    doubts = () if subject.from_image is None else subject.from_image.doubts
    every = [*([found.bone_doubt] if found.bone_doubt else []), *doubts]
    cautions = [Verdict("caution", (doubt,)) for doubt in every]
    return replace(quality, verdict=with_caution(together([quality.verdict, *cautions]), choice))


def with_caution(verdict: Verdict, choice: Regularisation) -> Verdict:
    """The verdict, lowered by one level where the engine has a doubt of its own: to "Use with care", or below."""
    if not choice.caution:
        return verdict
    return Verdict("caution" if verdict.level == "trust" else "distrust", (*verdict.reasons, choice.caution))


def write_images_and_transforms(folder: Path, found: Registration, images: CarriedImages) -> None:
    """Write the loaded image after the rigid part and after all, and the transforms that led there."""
    grid, motion = found.reference.grid, found.alignment.motion
    write_image(folder / files.ALIGNED, Image(grid, images.aligned))
    write_image(folder / files.REGISTERED, Image(grid, images.registered))
    if found.bone_used is not None:
        write_mask(folder / files.BONE_USED, found.bone_used)
    write_displacement_as_found(found.displacement, folder, motion, grid)
    write_itk_transform(folder / files.ITK_TRANSFORM, found.displacement, motion, grid)


def motion_as_dict(motion: RigidMotion) -> dict[str, object]:
    """The bone's rigid motion as plain values; `dvc.io.result_folder.motion_in` reads them."""
    rotation, translation = motion.rotation.tolist(), motion.translation_mm.tolist()
    return {"rotation_deg": motion.angle_deg, "rotation": rotation, "translation_lps_mm": translation}


def alignment_of(found: Registration) -> dict[str, object]:
    """The alignment as plain values: motion, how well it is known, and by what the pair was registered."""
    alignment, used = found.alignment, found.bone_used
    moved = {}
    if used is not None and found.bone is not None:
        given = found.bone.inside & found.tissue.inside
        moved = {"bone_surface_moved_mm": list(moved_mm(given, used.inside, used.grid.spacing_mm))}
    return {
        "on": alignment.on,
        **motion_as_dict(alignment.motion),
        "bone_shift_lps_mm": alignment.bone_shift_mm.tolist(),
        **plain({"similarity_before": alignment.similarity_before, "similarity": alignment.similarity}),
        "repeatability_rms_mm": plain(alignment.repeatability_mm),
        "control_spacing_mm": found.displacement.spacing_mm.tolist(),
        "engine": found.settings.engine.family,
        **moved,
        "seconds": round(found.seconds, 1),
    }
