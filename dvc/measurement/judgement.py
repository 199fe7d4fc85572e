"""What a measurement is made from, how a registration is judged, and what is written of it beside the maps."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvc.arrays import Float32Array, FloatArray
from dvc.deformation.protocol import RigidMotion, displacement_on_grid
from dvc.deformation.strain_maps import StrainMaps, strain_maps
from dvc.errors import InputError
from dvc.images.image import Image, Mask
from dvc.images.noise import noise_in_air
from dvc.images.resample import carry, shows
from dvc.images.similarity import brightness_offset, local_correlation, most_similarity
from dvc.images.tissue import tissue_mask
from dvc.io import result_folder as files
from dvc.io.images.write import write_image
from dvc.io.transforms.write import write_displacement_as_found, write_itk_transform
from dvc.measurement.error_bars import TwinCheck
from dvc.measurement.subject import Subject
from dvc.registration.engine import Regularisation
from dvc.registration.register import Registration
from dvc.trust.assessment import Similarity, assess
from dvc.trust.error_model import ErrorModel
from dvc.trust.landmarks import target_registration_error
from dvc.trust.quality import NoiseFloor, Quality, plain
from dvc.trust.verdict import Verdict


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
    """What a registration is judged by, beside its two images.

    Attributes
    ----------
    landmarks : ((n, 3), (n, 3)), optional
        Points of the unloaded image and the same of the loaded one, LPS mm.
    noise_floor : NoiseFloor, optional
        Of a repeat scan.
    error_model : ErrorModel, optional
        Of the engine or preset that is used; without one there are no error bars.
    twin : TwinCheck, optional
        What came back from a synthetic warp of the unloaded image by what was measured.
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
    reference, loaded, motion, grid = found.reference, found.loaded, found.alignment.motion, found.reference.grid
    before, aligned = carry(loaded, grid), carry(loaded, grid, motion.apply)
    # Beyond the spline, in the air, the image is shown where the bone's motion alone puts it.
    u = np.nan_to_num(displacement_on_grid(found.displacement, grid), copy=False)
    registered = carry(loaded, grid, motion.apply, displacement_mm=u)
    both = Mask(grid, found.tissue.inside & np.isfinite(aligned) & np.isfinite(registered))  # the same voxels for both
    _, as_scanned = local_correlation(reference, before, found.tissue)
    local_rigid, rigid = local_correlation(reference, aligned, both)
    local_after, after = local_correlation(reference, registered, both)
    similarity = Similarity((as_scanned, rigid, after))
    if (noise := _noise_in_air(found)) is not None:
        similarity = replace(similarity, possible=most_similarity(reference, registered, both, noise))
        if found.settings.engine.sees_brightness:
            similarity = replace(similarity, offset=brightness_offset(reference, registered, both, noise[0]))
    return CarriedImages(aligned, registered, local_rigid, local_after, similarity)


def _noise_in_air(found: Registration) -> tuple[float, float] | None:
    """Noise of both images in the air; None where there is no such air."""
    reference, loaded = found.reference, found.loaded
    try:
        body = Mask(reference.grid, found.tissue.inside | tissue_mask(reference).inside)
        noise = noise_in_air(reference, body), noise_in_air(loaded, tissue_mask(loaded))
    except InputError:  # no threshold finds the body
        return None
    return None if noise[0] is None or noise[1] is None else (noise[0], noise[1])


def quality_of(found: Registration, maps: StrainMaps, similarity: Similarity, evidence: Evidence) -> Quality:
    """Quality and verdict of a registration."""
    points, floor, choice = evidence.landmarks, evidence.noise_floor, found.choice
    bone = found.bone if found.alignment.on == "bone" else None
    errors = None if points is None else target_registration_error(found.total, *points)
    quality = assess(
        maps, found.tissue, bone, similarity=similarity, landmark_errors_mm=errors, floor=floor, in_bone=choice.in_bone
    )
    return replace(quality, verdict=with_caution(quality.verdict, choice))


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
    write_displacement_as_found(found.displacement, folder, motion, grid)
    write_itk_transform(folder / files.ITK_TRANSFORM, found.displacement, motion, grid)


def motion_as_dict(motion: RigidMotion) -> dict[str, object]:
    """The bone's rigid motion as plain values; `dvc.io.result_folder.motion_in` reads them."""
    rotation, translation = motion.rotation.tolist(), motion.translation_mm.tolist()
    return {"rotation_deg": motion.angle_deg, "rotation": rotation, "translation_lps_mm": translation}


def alignment_of(found: Registration) -> dict[str, object]:
    """The alignment as plain values: motion, how well it is known, and by what the pair was registered."""
    alignment = found.alignment
    return {
        "on": alignment.on,
        **motion_as_dict(alignment.motion),
        "bone_shift_lps_mm": alignment.bone_shift_mm.tolist(),
        **plain({"similarity_before": alignment.similarity_before, "similarity": alignment.similarity}),
        "repeatability_rms_mm": plain(alignment.repeatability_mm),
        "control_spacing_mm": found.displacement.spacing_mm.tolist(),
        "engine": found.settings.engine.family,
        "seconds": round(found.seconds, 1),
    }
