"""What a measurement is made from and judged by, and what is written of it beside the maps."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dvc.arrays import FloatArray
from dvc.deformation.protocol import RigidMotion
from dvc.images.image import Image, Mask
from dvc.io import result_folder as files
from dvc.io.images.write import write_image
from dvc.io.transforms.write import write_displacement_as_found, write_itk_transform
from dvc.measurement.error_bars import TwinCheck
from dvc.measurement.judgement import CarriedImages
from dvc.measurement.subject import Subject
from dvc.registration.register import Registration
from dvc.trust.error_model import ErrorModel
from dvc.trust.quality import NoiseFloor, plain


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


def write_images_and_transforms(folder: Path, found: Registration, images: CarriedImages) -> None:
    """Write the loaded image after the rigid part and after all, and the transforms that led there."""
    grid, motion = found.reference.grid, found.alignment.motion
    write_image(folder / files.ALIGNED, Image(grid, images.aligned))
    write_image(folder / files.REGISTERED, Image(grid, images.registered))
    write_displacement_as_found(found.displacement, folder, motion, grid)
    write_itk_transform(folder / files.ITK_TRANSFORM, found.displacement, motion, grid)


def motion_as_dict(motion: RigidMotion) -> dict[str, object]:
    """The bone's rigid motion as plain values; `dvc.io.result_folder.motion_in` reads them."""
    return {
        "rotation_deg": motion.angle_deg,
        "rotation": motion.rotation.tolist(),
        "translation_lps_mm": motion.translation_mm.tolist(),
    }


def alignment_of(found: Registration) -> dict[str, object]:
    """The alignment as plain values: motion, how well it is known, and by what the pair was registered."""
    alignment = found.alignment
    return {
        "on": alignment.on,
        **motion_as_dict(alignment.motion),
        "bone_shift_lps_mm": alignment.bone_shift_mm.tolist(),
        "similarity_before": plain(alignment.similarity_before),
        "similarity": plain(alignment.similarity),
        "repeatability_rms_mm": plain(alignment.repeatability_mm),
        "control_spacing_mm": found.displacement.spacing_mm.tolist(),
        "engine": found.settings.engine.family,
        "seconds": round(found.seconds, 1),
    }
