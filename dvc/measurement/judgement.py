"""A registration judged: its strain maps, how alike the images are, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dvc.arrays import Float32Array, FloatArray
from dvc.deformation.strain_maps import StrainMaps, strain_maps
from dvc.errors import InputError
from dvc.images.image import Mask
from dvc.images.noise import noise_in_air
from dvc.images.resample import carry, shows
from dvc.images.similarity import brightness_offset, local_correlation, most_similarity
from dvc.images.tissue import tissue_mask
from dvc.registration.engine import Regularisation
from dvc.registration.register import Registration
from dvc.trust.assessment import Similarity, assess
from dvc.trust.landmarks import target_registration_error
from dvc.trust.quality import NoiseFloor, Quality
from dvc.trust.verdict import Verdict


@dataclass(frozen=True, slots=True, eq=False)
class CarriedImages:
    """The loaded image on the unloaded one's voxels, all (ni, nj, nk), and how well they agree."""

    aligned: Float32Array  # after the rigid part; NaN where the loaded scan does not show the place
    registered: Float32Array  # after all
    local_rigid: Float32Array  # local correlation with the unloaded image, for each of these
    local_after: Float32Array
    similarity: Similarity


def maps_of(found: Registration) -> StrainMaps:
    """Strain where the registration sees whole tissue: nearer to the scan's end a spline sees half of it."""
    loaded, motion, edge = found.loaded, found.alignment.motion, float(found.displacement.spacing_mm.min())
    return strain_maps(found.deformation, found.tissue, lambda x: shows(loaded, motion.apply(x), edge))


def carried_images(found: Registration) -> CarriedImages:
    """Carry the loaded image to the unloaded one, and compare them."""
    reference, loaded, motion = found.reference, found.loaded, found.alignment.motion
    grid = reference.grid
    before = carry(loaded, grid)
    aligned = carry(loaded, grid, motion.apply)
    # Beyond the spline, in the air, the image is shown where the bone's motion alone puts it.
    registered = carry(loaded, grid, lambda X: motion.apply(X + np.nan_to_num(found.displacement.displacement(X))))
    both = Mask(grid, found.tissue.inside & np.isfinite(aligned) & np.isfinite(registered))  # the same voxels for both
    _, as_scanned = local_correlation(reference, before, found.tissue)
    local_rigid, rigid = local_correlation(reference, aligned, both)
    local_after, after = local_correlation(reference, registered, both)
    noise = _noise_in_air(found)
    similarity = Similarity((as_scanned, rigid, after))
    if noise is not None:
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


def quality_of(
    found: Registration,
    maps: StrainMaps,
    similarity: Similarity,
    landmarks: tuple[FloatArray, FloatArray] | None = None,
    floor: NoiseFloor | None = None,
) -> Quality:
    """Quality and verdict of a registration; ``landmarks`` ((n, 3), (n, 3)) of both images, LPS mm."""
    quality = assess(
        maps,
        found.tissue,
        found.bone if found.alignment.on == "bone" else None,
        similarity=similarity,
        landmark_errors_mm=None if landmarks is None else target_registration_error(found.total, *landmarks),
        floor=floor,
        in_bone=None if found.choice is None else found.choice.in_bone,
    )
    return replace(quality, verdict=with_caution(quality.verdict, found.choice))


def with_caution(verdict: Verdict, choice: Regularisation | None) -> Verdict:
    """The verdict, lowered by one level where the engine has a doubt of its own: to "Use with care", or below."""
    if choice is None or not choice.caution:
        return verdict
    return Verdict("caution" if verdict.level == "trust" else "distrust", (*verdict.reasons, choice.caution))
