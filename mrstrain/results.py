"""The results of one loaded image, and the report of a series: computed below, written and wired here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc import figures
from dvc.arrays import Float32Array, FloatArray
from dvc.deformation import Deformation, RigidMotion
from dvc.image import Image, LabelMap, Mask
from dvc.imagewrite import write_image
from dvc.landmarks import target_registration_error
from dvc.outputs import whole_folder, write_maps, write_mesh_results
from dvc.planes import View
from dvc.quality import NoiseFloor, Quality, assess, local_correlation, noise_floor
from dvc.regions import SHEAR_THRESHOLDS, RegionRow, region_statistics, write_regions_csv
from dvc.registration import Registration
from dvc.report import Cell, Picture, Section, Table, write_report
from dvc.resample import carry
from dvc.strainmaps import StrainMaps, strain_maps
from dvc.transformwrite import write_elastix_transform, write_itk_transform
from dvc.verdict import Verdict, worst
from mrstrain.inputs import Subject
from mrstrain.provenance import write_json

_SHEAR_SCALE = 0.5
_CLOSING = (
    Section(
        "How to read this",
        paragraphs=(
            "Displacement u(X) = x - X is that of tissue relative to its bone: the rigid motion of the bone between the "
            "scans is taken out. All maps are in the reference (unloaded) configuration, on the unloaded image's voxels; "
            "components are in LPS (x to the patient's left, y to posterior, z to superior), lengths in mm.",
            "Strain is Green-Lagrange, E = (F^T F - I)/2 with F = I + du/dX, from the analytic gradient of the cubic "
            "B-spline; maximal shear is (E1 - E3)/2, half the difference of the largest and smallest principal strain. "
            "det F is the ratio of deformed to reference volume.",
            "A verdict judges the registration, not the tissue. It cannot see everything: inside a uniform region, and "
            "along a smooth skin, an image does not show how tissue slides. Small shears are lifted by noise; a repeat "
            "scan without load (--repeat) tells by how much. Strain that jumps at a border of tissues is smeared over "
            "about one spacing of the control points (4 mm for heel-mr). Scanner distortion and creep between scans are "
            "not seen at all.",
            "Missing is NaN in every map, never zero; valid.nii.gz tells where values are. Programs built on ITK show "
            "NaN in NIfTI as zero: use the NRRD twin or the validity mask there.",
        ),
    ),
)


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
    own_floor : NoiseFloor
        What this case's strain amounts to as a noise floor; meaningful for a repeat scan only.
    """

    name: str
    section: Section
    verdict: Verdict
    shear: dict[str, tuple[float, float]]
    own_floor: NoiseFloor

    def summary(self) -> str:
        """One line for a person."""
        shear = ", ".join(f"{region} {p50:.3f} / {p95:.3f}" for region, (p50, p95) in self.shear.items())
        return f"{self.name}: {self.verdict.words}. Maximal shear, median / 95th percentile: {shear}"


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
) -> Case:
    """Maps, quality and figures of a registered load; its folder is written whole or not at all."""
    reference, loaded, motion = found.reference, found.loaded, found.alignment.motion
    grid = reference.grid
    measured = Measured(name, subject, found.tissue, found.deformation, motion)
    maps = strain_maps(found.deformation, found.tissue, lambda x: loaded.grid.contains(motion.apply(x)))
    aligned = carry(loaded, grid, motion.apply)
    registered = carry(loaded, grid, lambda X: motion.apply(X + found.bspline.displacement(X)))
    local, pooled = zip(
        *(
            local_correlation(reference, image, found.tissue)
            for image in (carry(loaded, grid, order=1), aligned, registered)
        ),
        strict=True,
    )
    bone = found.bone if found.alignment.on == "bone" else None
    errors = None if landmarks is None else target_registration_error(found.total, *landmarks)
    quality = assess(maps, found.tissue, bone, similarity=pooled, landmark_errors_mm=errors, floor=floor)
    view = _view(subject, maps)
    pictures = {
        "overlay": Picture(
            "Before and after",
            (figures.overlay.__doc__ or ""),
            figures.overlay(view, reference, aligned, registered),
        ),
        "checkerboard": Picture(
            "Checkerboard",
            (figures.checkerboard.__doc__ or ""),
            figures.checkerboard(view, reference, aligned, registered),
        ),
        **_pictures(view, measured, maps, aligned),
        "similarity": Picture(
            "Where the images agree",
            (figures.similarity_slices.__doc__ or ""),
            figures.similarity_slices(view, local[1], local[2]),
        ),
    }

    def more(partial: Path) -> None:
        write_image(partial / "aligned.nii.gz", Image(grid, aligned))
        write_image(partial / "registered.nii.gz", Image(grid, registered))
        write_elastix_transform(partial, found.bspline, motion, grid)
        write_itk_transform(partial / "transform.h5", found.bspline, motion)

    return _written(folder, measured, maps, quality, pictures, _alignment(found), record, more)


def write_measured(folder: Path, measured: Measured, record: Mapping[str, object]) -> Case:
    """Maps, quality and figures of a deformation that came without a loaded image."""
    maps = strain_maps(measured.deformation, measured.tissue)
    quality = assess(maps, measured.tissue, measured.subject.bone)
    pictures = _pictures(_view(measured.subject, maps), measured, maps, None)
    alignment = {
        "on": "bone" if measured.subject.bone is not None else "none",
        **_motion(measured.bone_motion),
    }
    return _written(folder, measured, maps, quality, pictures, alignment, record, lambda _: None)


def _written(
    folder: Path,
    measured: Measured,
    maps: StrainMaps,
    quality: Quality,
    pictures: Mapping[str, Picture],
    alignment: Mapping[str, object],
    record: Mapping[str, object],
    more: Callable[[Path], None],
) -> Case:
    subject = measured.subject
    quantities = {
        "max_shear": maps.max_shear,
        "jacobian": maps.jacobian,
        "displacement_mm": np.linalg.norm(maps.displacement_mm, axis=-1),
    }
    regions = region_statistics(_regions(measured), quantities)
    told = quality.as_dict() | {"alignment": dict(alignment)}
    with whole_folder(folder) as partial:
        write_maps(partial, maps, subject.axes)
        write_regions_csv(partial / "regions.csv", regions)
        if subject.mesh is not None:
            told["mesh"] = write_mesh_results(partial, subject.mesh, measured.deformation)
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
        (_key_figures(quality, alignment), _region_table(regions)),
        tuple(pictures.values()),
    )
    soft = measured.tissue.inside if subject.bone is None else measured.tissue.inside & ~subject.bone.inside
    return Case(measured.name, section, quality.verdict, shear, noise_floor(maps, soft))


def write_series_report(
    path: Path, cases: Sequence[Case], failures: Mapping[str, str], record: Mapping[str, object]
) -> None:
    """Write the report of a series, one self-contained page."""
    sections = [case.section for case in cases]
    sections += [
        Section(name, Verdict("distrust", (f"Not registered. {reason}",))) for name, reason in failures.items()
    ]
    verdict = worst([s.verdict for s in sections if s.verdict is not None])
    write_report(path, "Strain from MR image pairs", verdict, sections, _CLOSING, _flat(record))


def _view(subject: Subject, maps: StrainMaps) -> View:
    point = subject.lowest_bone_point_mm
    if point is None:
        kept = maps.valid if maps.valid.any() else np.ones(maps.grid.shape, dtype=bool)
        points = maps.grid.points(kept)
        point = points[int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    return View.through(maps.grid, point, maps.valid if maps.valid.any() else None)


def _pictures(view: View, measured: Measured, maps: StrainMaps, aligned: Float32Array | None) -> dict[str, Picture]:
    reference = measured.subject.reference
    labels = _regions(measured)
    bone = measured.subject.bone
    drawn = {
        "strain": Picture(
            "Maximal shear",
            (figures.strain_slices.__doc__ or "") + " Slices through the bone's lowest point along the plate's normal.",
            figures.strain_slices(view, reference, maps.max_shear, _SHEAR_SCALE, labels),
        ),
        "curves": Picture(
            "Volume above a strain",
            (figures.shear_curves.__doc__ or ""),
            figures.shear_curves(maps.max_shear, labels),
        ),
        "deformed_grid": Picture(
            "Deformed grid",
            (figures.deformed_grid.__doc__ or ""),
            figures.deformed_grid(
                view,
                reference.values if aligned is None else aligned,
                maps.displacement_mm,
                None if bone is None else bone.inside,
            ),
        ),
        "jacobian": Picture(
            "Volume ratio",
            (figures.jacobian_slices.__doc__ or ""),
            figures.jacobian_slices(view, reference, maps.jacobian),
        ),
    }
    return drawn


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
        "seconds": round(found.seconds, 1),
    }


def _key_figures(quality: Quality, alignment: Mapping[str, object]) -> Table:
    rows: list[tuple[str, Cell, str]] = [
        ("Rotation of the bone between the scans", _number(alignment["rotation_deg"]), "degrees"),
    ]
    if "bone_shift_lps_mm" in alignment:
        shift = np.asarray(alignment["bone_shift_lps_mm"], dtype=np.float64)
        rows += [
            ("Shift of the bone between the scans", float(np.linalg.norm(shift)), "mm"),
            (
                "Correlation in and around the bone, before alignment",
                _number(alignment["similarity_before"]),
                "1",
            ),
            ("Correlation in and around the bone, after alignment", _number(alignment["similarity"]), "1"),
            (
                "Two rigid fits with other samples differ by (rms over the bone)",
                _number(alignment["repeatability_rms_mm"]),
                "mm",
            ),
        ]
    if quality.similarity is not None:
        for said, value in zip(("as scanned", "after the rigid part", "after all"), quality.similarity, strict=True):
            rows.append((f"Local similarity in the tissue, {said}", float(value), "1"))
    rows += [
        ("Displacement left in the bone (truth: 0), rms", quality.bone_shift_mm, "mm"),
        ("Apparent maximal shear in the bone (truth: 0), 95th percentile", quality.bone_shear_p95, "1"),
        ("Folded voxels (det F <= 0)", quality.folded_voxels, "voxels"),
        ("Lowest det F", quality.lowest_jacobian, "1"),
        ("Tissue without a result", 100.0 * quality.undefined_fraction, "%"),
    ]
    if quality.landmark_errors_mm is not None:
        errors = quality.landmark_errors_mm
        known = errors[np.isfinite(errors)]
        rows += [
            ("Landmark error, median", float(np.median(known)) if known.size else None, "mm"),
            ("Landmark error, largest", float(known.max()) if known.size else None, "mm"),
            ("Landmarks without a result", int(errors.size - known.size), f"of {errors.size}"),
        ]
    if quality.noise_floor is not None:
        floor = quality.noise_floor
        rows += [
            ("Noise floor (repeat scan): maximal shear, median", floor.shear_p50, "1"),
            ("Noise floor (repeat scan): maximal shear, 95th percentile", floor.shear_p95, "1"),
            ("Noise floor: MAER", floor.maer, "1"),
            ("Noise floor: SDER", floor.sder, "1"),
        ]
    return Table("Key figures", ("figure", "value", "unit"), tuple(rows))


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def _region_table(regions: Sequence[RegionRow]) -> Table:
    rows = [
        (
            r.region,
            r.volume_ml,
            100.0 * r.defined_fraction,
            r.median,
            r.p90,
            r.p95,
            r.p99,
            *(r.volume_above_ml.get(t) for t in SHEAR_THRESHOLDS),
        )
        for r in regions
        if r.quantity == "max_shear"
    ]
    columns = ("region", "volume, mL", "with a result, %", "median", "p90", "p95", "p99")
    above = tuple(f"mL above {t:g}" for t in SHEAR_THRESHOLDS)
    return Table(
        "Maximal shear by region",
        columns + above,
        tuple(rows),
        "Maximal shear (E₁ − E₃)/2 of the Green-Lagrange strain, at the voxels of the unloaded image.",
    )


def _flat(record: Mapping[str, object]) -> dict[str, str]:
    shown: dict[str, str] = {}
    for name, value in record.items():
        if isinstance(value, Mapping):
            shown |= {f"{name}: {key}": _line(item) for key, item in value.items()}
        else:
            shown[name] = str(value)
    return shown


def _line(value: object) -> str:
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        return "\n".join(", ".join(str(v) for v in item.values()) for item in value)
    return str(value)
