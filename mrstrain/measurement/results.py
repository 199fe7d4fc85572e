"""The results of one loaded image, and the report of a series: computed below, written and wired here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.atomic_files import whole_folder
from dvc.deformation.protocol import Deformation, RigidMotion
from dvc.deformation.strain_maps import StrainMaps, strain_maps
from dvc.errors import InputError
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.noise import noise_in_air
from dvc.images.resample import carry, shows
from dvc.images.similarity import brightness_offset, local_correlation, most_similarity
from dvc.images.tissue import tissue_mask
from dvc.io.images.write import write_image
from dvc.io.result_folder import write_maps, write_mesh_results
from dvc.io.transforms.write import write_displacement_as_found, write_itk_transform
from dvc.registration.engine import Regularisation
from dvc.registration.register import Registration
from dvc.report.page import Picture, Section
from dvc.trust.error_model import ErrorModel
from dvc.trust.landmarks import target_registration_error
from dvc.trust.quality import NoiseFloor, Quality, assess, noise_floor
from dvc.trust.regions import region_statistics, write_regions_csv
from dvc.trust.verdict import Verdict
from mrstrain.measurement import page
from mrstrain.measurement.error_bars import ErrorBars, error_bars
from mrstrain.measurement.twin_check import TwinCheck
from mrstrain.records.inputs import Subject
from mrstrain.records.provenance import write_json

ITK_FILE = "transform.h5"
"""Name of the whole motion's file."""


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One loaded image's results, as the report tells them.

    Attributes
    ----------
    name : str
    section : Section
        Its part of the report.
    verdict : Verdict
    shear : dict
        Region to (median, 95th percentile) of the maximal shear.
    own_floor : NoiseFloor or None
        What this case's strain amounts to as a noise floor; meaningful for a repeat scan only.
    without_error_bars : str
        Why it has none; empty where it has.
    of_twin : str
        What the pair's twin did to them; empty where none was asked for.
    """

    name: str
    section: Section
    verdict: Verdict
    shear: dict[str, tuple[float, float]]
    own_floor: NoiseFloor | None
    without_error_bars: str = ""
    of_twin: str = ""

    def summary(self) -> list[str]:
        """The verdict with its reasons and the strain, for a person."""
        shear = ", ".join(f"{region} {p50:.3f} / {p95:.3f}" for region, (p50, p95) in self.shear.items())
        return [
            f"{self.name}: {self.verdict.words}.",
            *(f"    {reason}" for reason in self.verdict.reasons),
            f"    maximal shear, median / 95th percentile: {shear}",
            *([f"    no error bars: {self.without_error_bars}"] if self.without_error_bars else []),
            *([f"    error bars: {self.of_twin}"] if self.of_twin else []),
        ]


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """A deformation to be written: of one subject, in a mask, the bone's motion already taken out.

    Attributes
    ----------
    name : str
    subject : Subject
    tissue : Mask
    deformation : Deformation
        Of tissue relative to bone.
    bone_motion : RigidMotion
        What was taken out.
    """

    name: str
    subject: Subject
    tissue: Mask
    deformation: Deformation
    bone_motion: RigidMotion


def write_case(
    folder: Path,
    name: str,
    subject: Subject,
    found: Registration,
    record: Mapping[str, object],
    landmarks: tuple[FloatArray, FloatArray] | None,
    floor: NoiseFloor | None,
    *,
    is_repeat: bool,
    model: ErrorModel | None = None,
    twin: TwinCheck | None = None,
) -> Case:
    """Maps, quality and figures of a registered load; its folder is written whole or not at all.

    A repeat scan is judged by its own noise floor; the error bars are those of ``model``, if there is one, judged by
    the pair's ``twin``.
    """
    reference, loaded, motion = found.reference, found.loaded, found.alignment.motion
    grid = reference.grid
    measured = Measured(name, subject, found.tissue, found.deformation, motion)
    edge = float(found.displacement.spacing_mm.min())  # nearer to the scan's end it rests on half its tissue
    maps = strain_maps(found.deformation, found.tissue, lambda x: shows(loaded, motion.apply(x), edge))
    before = carry(loaded, grid)
    aligned = carry(loaded, grid, motion.apply)
    # Beyond what was found, in the air, the image is shown where the bone's motion alone puts it.
    registered = carry(loaded, grid, lambda X: motion.apply(X + np.nan_to_num(found.displacement.displacement(X))))
    both = Mask(grid, found.tissue.inside & np.isfinite(aligned) & np.isfinite(registered))  # the same voxels for both
    _, as_scanned = local_correlation(reference, before, found.tissue)
    local_rigid, rigid = local_correlation(reference, aligned, both)
    local_after, after = local_correlation(reference, registered, both)
    if is_repeat:
        floor = noise_floor(maps, _soft(measured))
    bone = found.bone if found.alignment.on == "bone" else None
    errors = None if landmarks is None else target_registration_error(found.total, *landmarks)
    noise = _noise_in_air(found)
    offset = None
    if noise and found.settings.engine.sees_brightness:
        offset = brightness_offset(reference, registered, both, noise[0])
    quality = assess(
        maps,
        found.tissue,
        bone,
        similarity=(as_scanned, rigid, after),
        most_similarity=most_similarity(reference, registered, both, noise) if noise else None,
        offset=offset,
        landmark_errors_mm=errors,
        floor=floor,
        in_bone=None if found.choice is None else found.choice.in_bone,
    )
    quality = replace(quality, verdict=with_caution(quality.verdict, found.choice))
    view = page.view_of(subject, maps)
    labels = _regions(measured)
    bars = error_bars(found, subject, maps, model, twin)
    pictures = {
        **page.agreement_pictures(view, reference, aligned, registered, local_rigid, local_after),
        **page.strain_pictures(view, subject, labels, maps, aligned, floor),
        **bars.pictures(view, reference),
    }

    def more(partial: Path) -> None:
        write_image(partial / "aligned.nii.gz", Image(grid, aligned))
        write_image(partial / "registered.nii.gz", Image(grid, registered))
        write_displacement_as_found(found.displacement, partial, motion, grid)
        write_itk_transform(partial / ITK_FILE, found.displacement, motion, grid)
        bars.write(partial, maps, quality.verdict)

    return _written(
        folder, measured, maps, quality, pictures, _alignment(found), record, more, bars, found.choice,
        note=found.settings.engine.note,
    )  # fmt: skip


def _noise_in_air(found: Registration) -> tuple[float, float] | None:
    """Of both images; None where there is no such air."""
    reference, loaded = found.reference, found.loaded
    try:
        body = Mask(reference.grid, found.tissue.inside | tissue_mask(reference).inside)
        noise = noise_in_air(reference, body), noise_in_air(loaded, tissue_mask(loaded))
    except InputError:  # no threshold finds the body
        return None
    return None if noise[0] is None or noise[1] is None else (noise[0], noise[1])


def write_measured(folder: Path, measured: Measured, record: Mapping[str, object]) -> Case:
    """Maps, quality and figures of a deformation that came without a loaded image."""
    maps = strain_maps(measured.deformation, measured.tissue)
    quality = assess(maps, measured.tissue, measured.subject.bone)
    view = page.view_of(measured.subject, maps)
    pictures = page.strain_pictures(view, measured.subject, _regions(measured), maps, None, None)
    alignment = {
        "on": "bone" if measured.subject.bone is not None else "none",
        **_motion(measured.bone_motion),
    }
    return _written(folder, measured, maps, quality, pictures, alignment, record, lambda _: None)


def with_caution(verdict: Verdict, choice: Regularisation | None) -> Verdict:
    """The verdict, lowered by one level where the engine has a doubt of its own: to "Use with care", or below."""
    if choice is None or not choice.caution:
        return verdict
    return Verdict("caution" if verdict.level == "trust" else "distrust", (*verdict.reasons, choice.caution))


def _written(
    folder: Path,
    measured: Measured,
    maps: StrainMaps,
    quality: Quality,
    pictures: Mapping[str, Picture],
    alignment: Mapping[str, object],
    record: Mapping[str, object],
    more: Callable[[Path], None],
    bars: ErrorBars | None = None,
    choice: Regularisation | None = None,
    note: str = "",
) -> Case:
    subject = measured.subject
    regions = region_statistics(_regions(measured), maps.by_quantity)
    told = quality.as_dict() | {"alignment": dict(alignment)}
    tables = [page.key_figures(quality, alignment), page.region_table(regions)]
    if choice is not None:
        told["regularisation"] = choice.as_dict()
        tables.append(page.weights_table(choice))
    if bars is not None:
        told["error_of_max_shear"] = bars.as_dict()
        tables += bars.tables()
    with whole_folder(folder) as partial:
        write_maps(partial, maps, subject.axes, quality.verdict)
        write_regions_csv(partial / "regions.csv", regions, quality.verdict)
        if subject.mesh is not None:
            told["mesh"] = write_mesh_results(partial, subject.mesh, measured.deformation, quality.verdict)
        more(partial)
        write_json(partial / "quality.json", told)
        write_json(partial / "provenance.json", record)
        (partial / "figures").mkdir()
        for stem, picture in pictures.items():
            (partial / "figures" / f"{stem}.png").write_bytes(picture.png)
    shear = {r.region: (r.median, r.p95) for r in regions if r.quantity == "max_shear" and np.isfinite(r.median)}
    section = Section(
        measured.name,
        quality.verdict,
        tuple(tables),
        tuple(pictures.values()),
        (
            *((note,) if note else ()),
            *(() if bars is None or bars.uncertainty is not None else (f"No error bars. {bars.told}",)),
            *(() if bars is None or not bars.of_twin else (f"Error bars: {bars.of_twin}",)),
        ),
    )
    without = "" if bars is None or bars.uncertainty is not None else bars.told
    of_twin = "" if bars is None else bars.of_twin
    floor = noise_floor(maps, _soft(measured))
    return Case(measured.name, section, quality.verdict, shear, floor, without, of_twin)


def _soft(measured: Measured) -> BoolArray:
    bone = measured.subject.bone
    return measured.tissue.inside if bone is None else measured.tissue.inside & ~bone.inside


def _regions(measured: Measured) -> LabelMap:
    subject, tissue = measured.subject, measured.tissue
    if subject.labels is not None:
        return subject.labels
    values = tissue.inside.astype(np.int64)
    names = {1: "tissue"}
    if subject.bone is not None:
        values = np.where(subject.bone.inside, 2, values)
        names[2] = "bone"
    return LabelMap(tissue.grid, values, names)


def _motion(motion: RigidMotion) -> dict[str, object]:
    return {
        "rotation_deg": motion.angle_deg,
        "rotation": motion.rotation.tolist(),
        "translation_lps_mm": motion.translation_mm.tolist(),
    }


def _alignment(found: Registration) -> dict[str, object]:
    alignment = found.alignment

    def plain(value: float) -> float | None:
        return value if np.isfinite(value) else None

    return {
        "on": alignment.on,
        **_motion(alignment.motion),
        "bone_shift_lps_mm": alignment.bone_shift_mm.tolist(),
        "similarity_before": plain(alignment.similarity_before),
        "similarity": plain(alignment.similarity),
        "repeatability_rms_mm": plain(alignment.repeatability_mm),
        "control_spacing_mm": found.displacement.spacing_mm.tolist(),
        "engine": found.settings.engine.family,
        "seconds": round(found.seconds, 1),
    }
