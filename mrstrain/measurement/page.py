"""What the report of a measurement says: its pictures, tables, and how to read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from dvc.arrays import Float32Array
from dvc.deformation.strain_maps import StrainMaps
from dvc.images.image import Image, LabelMap
from dvc.registration.engine import Regularisation
from dvc.report import figures
from dvc.report.page import Cell, Picture, Section, Table, caption_of, record_lines, write_report
from dvc.report.planes import View
from dvc.trust.quality import NoiseFloor, Quality
from dvc.trust.regions import SHEAR_THRESHOLDS, RegionRow
from dvc.trust.verdict import Verdict, worst
from mrstrain.records.inputs import Subject

_SHEAR_SCALE = 0.5
_CLOSING = (
    Section(
        "How to read this",
        paragraphs=(
            "Displacement u(X) = x - X is that of tissue relative to its bone: the rigid motion of the bone between "
            "the scans is taken out. All maps are in the reference (unloaded) configuration, on the unloaded image's "
            "voxels; components are in LPS (x to the patient's left, y to posterior, z to superior), lengths in mm.",
            "Strain is Green-Lagrange, E = (F^T F - I)/2 with F = I + du/dX, from the analytic gradient of the cubic "
            "B-spline; maximal shear is (E1 - E3)/2, half the difference of the largest and smallest principal strain. "
            "det F is the ratio of deformed to reference volume.",
            "A verdict judges the registration, not the tissue. It cannot see everything: inside a uniform region, and "
            "along a smooth skin, an image does not show how tissue slides. Small shears are lifted by noise; a repeat "
            "scan without load (--repeat) tells by how much. Strain that jumps at a border of tissues is smeared over "
            "about one spacing of the control points (3 to 5 mm), unless a label map told where tissues meet. "
            "Scanner distortion and creep between scans are not seen at all.",
            "A noise floor is what a repeat scan shows where there is no strain. MAER is the mean over voxels of the "
            "mean absolute value of the six strain components, SDER the standard deviation of the same.",
            "Missing is NaN in every map, never zero; valid.nii.gz tells where values are. Programs built on ITK show "
            "NaN in NIfTI as zero: use the NRRD twin or the validity mask there.",
        ),
    ),
)


def write_series_report(
    path: Path, sections: Sequence[Section], failures: Mapping[str, str], record: Mapping[str, object]
) -> None:
    """Write the report of a series, one self-contained page."""
    told = [*sections]
    told += [Section(name, Verdict("distrust", (f"Not registered. {reason}",))) for name, reason in failures.items()]
    verdict = worst([s.verdict for s in told if s.verdict is not None])
    write_report(path, "Strain from MR image pairs", verdict, told, _CLOSING, record_lines(record))


def view_of(subject: Subject, maps: StrainMaps) -> View:
    """Choose the slices through the bone's lowest point along the plate's normal, or through the tissue's middle."""
    point = subject.lowest_bone_point_mm
    if point is None:
        kept = maps.valid if maps.valid.any() else np.ones(maps.grid.shape, dtype=bool)
        points = maps.grid.points(kept)
        point = points[int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    return View.through(maps.grid, point, maps.valid if maps.valid.any() else None)


def agreement_pictures(
    view: View,
    reference: Image,
    aligned: Float32Array,
    registered: Float32Array,
    local_rigid: Float32Array,
    local_after: Float32Array,
) -> dict[str, Picture]:
    """Draw how well the images agree, after the rigid part and after all."""
    return {
        "overlay": Picture(
            "Before and after", caption_of(figures.overlay), figures.overlay(view, reference, aligned, registered)
        ),
        "checkerboard": Picture(
            "Checkerboard", caption_of(figures.checkerboard), figures.checkerboard(view, reference, aligned, registered)
        ),
        "similarity": Picture(
            "Where the images agree",
            caption_of(figures.similarity_slices),
            figures.similarity_slices(view, local_rigid, local_after),
        ),
    }


def strain_pictures(
    view: View,
    subject: Subject,
    labels: LabelMap,
    maps: StrainMaps,
    aligned: Float32Array | None,
    floor: NoiseFloor | None,
) -> dict[str, Picture]:
    """Draw strain, curves, grid and volume ratio; over the loaded image where there is one."""
    reference, bone = subject.reference, subject.bone
    drawn = {
        "strain": Picture(
            "Maximal shear",
            caption_of(figures.strain_slices) + " Slices through the bone's lowest point along the plate's normal.",
            figures.strain_slices(view, reference, maps.max_shear, _SHEAR_SCALE, labels),
        ),
        "curves": Picture(
            "Volume above a strain",
            caption_of(figures.shear_curves),
            figures.shear_curves(maps.max_shear, labels, None if floor is None else floor.shear_p95),
        ),
        "deformed_grid": Picture(
            "Deformed grid",
            caption_of(figures.deformed_grid),
            figures.deformed_grid(
                view,
                reference.values if aligned is None else aligned,
                maps.displacement_mm,
                None if bone is None else bone.inside,
            ),
        ),
        "jacobian": Picture(
            "Volume ratio",
            caption_of(figures.jacobian_slices),
            figures.jacobian_slices(view, reference, maps.jacobian),
        ),
    }
    return drawn


def key_figures(quality: Quality, alignment: Mapping[str, object]) -> Table:
    """Tell what the verdict rests on."""
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
                "",
            ),
            ("Correlation in and around the bone, after alignment", _number(alignment["similarity"]), ""),
            (
                "Spread of the rigid fits of halves of the bone (rms over the bone; largest of six pairs)",
                _number(alignment["repeatability_rms_mm"]),
                "mm",
            ),
        ]
        spacing = np.asarray(alignment["control_spacing_mm"], dtype=np.float64)
        rows.append(("Engine of the non-rigid registration", str(alignment["engine"]), ""))
        rows.append(("Spacing of the B-spline's control points", " x ".join(f"{s:.3g}" for s in spacing), "mm"))
    if quality.similarity is not None:
        for said, value in zip(("as scanned", "after the rigid part", "after all"), quality.similarity, strict=True):
            rows.append((f"Local similarity in the tissue, {said}", float(value), ""))
        rows.append(("Local similarity that noise as in the air allows, about", quality.most_similarity, ""))
    bone = "in the bone, before it was held at rest" if quality.bone_held else "left in the bone"
    rows += [
        (f"Displacement {bone} (truth: 0), rms", quality.bone_shift_mm, "mm"),
        (f"Apparent maximal shear {bone} (truth: 0), 95th percentile", quality.bone_shear_p95, ""),
        ("Folded voxels (det F <= 0)", quality.folded_voxels, "voxels"),
        ("Lowest det F", quality.lowest_jacobian, ""),
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
            ("Noise floor (repeat scan): maximal shear, median", floor.shear_p50, ""),
            ("Noise floor (repeat scan): maximal shear, 95th percentile", floor.shear_p95, ""),
            ("Noise floor: MAER", floor.maer, ""),
            ("Noise floor: SDER", floor.sder, ""),
        ]
    return Table("Key figures", ("figure", "value", "unit"), tuple(rows))


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) else None


def weights_table(choice: Regularisation) -> Table:
    """Tell the weights of the prior, and of those that were tried what they left of half of the voxels."""
    columns = ("penalty on", "weight", "unit", "residual left out, % above the least")
    return Table("Weights of the registration", columns, tuple(choice.rows()), choice.caption)


def region_table(regions: Sequence[RegionRow]) -> Table:
    """Tell the maximal shear of every region."""
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
    columns = ("region", "volume, mL", "defined, %", "median", "p90", "p95", "p99")
    above = tuple(f"> {t:g}, mL" for t in SHEAR_THRESHOLDS)
    return Table(
        "Maximal shear by region",
        columns + above,
        tuple(rows),
        "Maximal shear (E₁ − E₃)/2 of the Green-Lagrange strain, and volumes above a value.",
    )
