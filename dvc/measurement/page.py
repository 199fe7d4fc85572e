"""Figures and tables of a measurement in a report."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from dvc.arrays import Float32Array
from dvc.deformation.strain_maps import StrainMaps
from dvc.images.image import Image, LabelMap, Mask
from dvc.measurement.error_bars import ErrorBars
from dvc.measurement.judgement import Source
from dvc.measurement.subject import Subject
from dvc.registration.engine import Regularisation
from dvc.report import figures
from dvc.report.drawing import Columns, Drawing
from dvc.report.page import LOPSIDED, Cell, Estimate, Table
from dvc.report.sheet import View
from dvc.trust.components import ComponentUncertainty
from dvc.trust.quality import NoiseFloor, Quality
from dvc.trust.regions import SHEAR_THRESHOLDS, RegionRow
from dvc.trust.twin_judgement import Judged
from dvc.trust.uncertainty import Interval

STRAIN = "Maximum shear strain"
"""Title of the picture of the strain."""
SIGMA_SCALE = 0.1
"""Upper end of the colours for the standard deviation of the maximum shear strain."""
FIXED_WEIGHTS = "The regularisation weights of a repeat scan are fixed, so that its noise floor is not smoothed away."
"""In place of the table of weights, for a repeat scan."""
_COMPONENTS = (
    "Root mean square over the voxels of the tissue: of u_x, u_y and u_z; of E_xx, E_yy and E_zz; of E_xy, E_xz and "
    "E_yz, each minus its bias. The values are the same in any coordinate system. The expanded uncertainty (k = 2) is "
    "twice as large. components.csv has means and biases."
)
_TWIN = (
    "The unloaded image was warped by the measured displacement, fresh noise was added, and the pair was registered "
    "like the real one. Its true strain is the measured strain above, so the table shows the error that the noise and "
    "texture of these images cause. Two caveats: strain that the registration smooths away is missing from the warp, "
    "which makes this error smaller than the true one; denoising removes texture, which makes it larger. Error bars of "
    "a tissue are widened by the factor where fewer voxels than expected lie within them, or where a percentile "
    "falls outside its interval. They are never narrowed."
)


def drawings_of(
    view: View, made: Source, maps: StrainMaps, floor: NoiseFloor | None, sigma: Float32Array | None, *, loaded: str
) -> dict[str, Drawing]:
    """The figures of a report, by the name of their files: agreement of the images, strain, and its uncertainty.

    The deformed grid lies over the loaded image where there is one; ``loaded`` is what readers call that image.
    """
    reference, bone, images = made.subject.reference, made.subject.bone, made.images
    labels, below, drawn = made.subject.regions(made.tissue), reference.values, dict[str, Drawing]()
    if images is not None:
        pair, below = (view, reference, images.aligned, images.registered), images.aligned
        local = view, images.local_rigid, images.local_after
        drawn["overlay"] = Drawing.of("Before and after", figures.overlay, *pair)
        drawn["checkerboard"] = Drawing.of("Checkerboard", figures.checkerboard, *pair)
        drawn["similarity"] = Drawing.of("Local similarity of the images", figures.similarity_slices, *local)
    if made.registration is not None and bone is not None and (used := made.registration.bone_used) is not None:
        shown = reference, Mask(reference.grid, bone.inside & made.tissue.inside), used
        drawn["bone_used"] = Drawing.of("Surface of the bone", figures.bone_slices, *shown)
    under = None if images is None else Image(reference.grid, images.registered)
    drawn["strain"] = strain_drawing(view, made.subject, labels, maps.max_shear, under, loaded=loaded)
    curves = maps.max_shear, labels, None if floor is None else floor.max_shear_p95
    data = _curve_columns(maps, labels)
    drawn["curves"] = Drawing.of("Strain-volume curves", figures.shear_curves, *curves, data=data)
    grid = view, below, maps.displacement_mm, None if bone is None else bone.inside
    drawn["deformed_grid"] = Drawing.of("Deformed grid", figures.deformed_grid, *grid)
    drawn["jacobian"] = Drawing.of("Volume ratio", figures.jacobian_slices, view, reference, maps.jacobian)
    if sigma is not None:
        spread = view, reference, sigma, SIGMA_SCALE
        drawn["sigma"] = Drawing.of("Standard uncertainty of the maximum shear strain", figures.sigma_slices, *spread)
    return drawn


def strain_drawing(
    view: View, subject: Subject, labels: LabelMap, max_shear: Float32Array, registered: Image | None, *,
    loaded: str, shared: float | None = None,
) -> Drawing:  # fmt: skip
    """The maximum shear strain, which fades to the images; its colours end where those of a whole report do, or fit.

    ``shared`` is the end of the colours in all maps of a report.
    """
    largest = figures.shear_scale(max_shear) if shared is None else shared
    through = "Slices through the middle of the tissue."
    if subject.bone is not None:
        through = "Slices through the point of the bone nearest to the plate."
    among = "" if shared is None else "report"
    shown, note = (max_shear, largest, labels), f"{through} {figures.scale_told(largest, among=among)}"
    drawing = Drawing.of(STRAIN, figures.strain_slices, view, subject.reference, *shown, note=note)
    if registered is None:
        return drawing
    both = {"unloaded": subject.reference, f"{loaded}, registered": registered}
    bare = {name: figures.image_slices(view, image, *shown) for name, image in both.items()}
    return replace(drawing, beneath=tuple(bare.items()))


def _curve_columns(maps: StrainMaps, labels: LabelMap) -> Columns:
    """The strain-volume curves by region."""
    curves = figures.strain_volume(maps.max_shear, labels)
    rows = [(name, *point) for name, curve in curves.items() for point in zip(*curve, strict=True)]
    names = "region", "max_shear", "volume_above_ml"
    return {name: [row[number] for row in rows] for number, name in enumerate(names)}


def key_figures(quality: Quality, alignment: Mapping[str, Any]) -> Table:
    """The figures that the verdict is based on."""
    held = "body" if alignment.get("on") == "image" else "bone"
    rows = [(f"Rotation of the {held} between the scans", alignment["rotation_deg"], "degrees")]
    if "bone_shift_lps_mm" in alignment:
        spread = f"Repeatability of the rigid alignment: largest rms difference between fits on halves of the {held}"
        spacing = " x ".join(f"{s:.3g}" for s in alignment["control_spacing_mm"])
        rows += [
            (f"Shift of the {held} between the scans", float(np.linalg.norm(alignment["bone_shift_lps_mm"])), "mm"),
            (f"Correlation in and around the {held}, before alignment", alignment["similarity_before"], ""),
            (f"Correlation in and around the {held}, after alignment", alignment["similarity"], ""),
            (spread, alignment["repeatability_rms_mm"], "mm"),
            ("Engine of the non-rigid registration", alignment["engine"], ""),
            ("Control point spacing of the B-spline", spacing, "mm"),
        ]
    if "bone_surface_moved_mm" in alignment:
        mean_mm, rms_mm = alignment["bone_surface_moved_mm"]
        rows += [
            ("Distance of the bone surface used from that of the mask, mean (positive: outward)", mean_mm, "mm"),
            ("Distance of the bone surface used from that of the mask, rms", rms_mm, "mm"),
        ]
    if quality.similarity is not None:
        each = zip(("as scanned", "after rigid alignment", "after registration"), quality.similarity, strict=True)
        rows += [(f"Local similarity in the tissue, {said}", float(value), "") for said, value in each]
        rows.append(("Local similarity expected of equal images with this noise", quality.most_similarity, ""))
    bone = "in the bone without the rigid constraint" if quality.bone_held else "in the bone"
    if held == "bone":
        rows += [
            (f"Apparent displacement {bone} (true value 0), rms", quality.bone_shift_mm, "mm"),
            (f"Apparent maximum shear strain {bone} (true value 0), 95th percentile", quality.bone_shear_p95, ""),
        ]
    rows += [
        ("Folded voxels (det F <= 0)", quality.folded_voxels, "voxels"),
        ("Lowest det F", quality.lowest_jacobian, ""),
        ("Tissue without a result", 100.0 * quality.undefined_fraction, "%"),
    ]
    if quality.landmark_errors_mm is not None:
        landmarks = quality.landmarks
        rows += [
            ("Landmark error, median", landmarks["median_mm"], "mm"),
            ("Landmark error, largest", landmarks["max_mm"], "mm"),
            ("Landmarks without a result", landmarks["undefined"], f"of {landmarks['count']}"),
        ]
    if (floor := quality.noise_floor) is not None:
        rows += [
            ("Noise floor (repeat scan): maximum shear strain, median", floor.max_shear_p50, ""),
            ("Noise floor (repeat scan): maximum shear strain, 95th percentile", floor.max_shear_p95, ""),
            ("Noise floor (repeat scan): mean absolute strain component, mean over voxels (MAER)", floor.maer, ""),
            ("Noise floor (repeat scan): mean absolute strain component, standard deviation (SDER)", floor.sder, ""),
        ]
    return Table("Key results", ("result", "value", "unit"), tuple(rows))


def weights_table(choice: Regularisation) -> Table:
    """The regularisation weights that were used, and the residual of those tried in the voxels left out of the fit."""
    columns = ("penalty on", "weight", "unit", "residual in the voxels left out, % above the lowest")
    return Table("Regularisation weights", columns, tuple(choice.rows()), choice.caption)


def region_table(regions: Sequence[RegionRow]) -> Table:
    """The maximum shear strain of every region."""

    def cells(r: RegionRow) -> tuple[Cell, ...]:
        above = (r.volume_above_ml.get(t) for t in SHEAR_THRESHOLDS)
        return r.region, r.volume_ml, 100.0 * r.defined_fraction, r.median, r.p90, r.p95, r.p99, *above

    rows = tuple(cells(r) for r in regions if r.quantity == "max_shear")
    above = (f"> {t:g}, mL" for t in SHEAR_THRESHOLDS)
    columns = ("tissue", "volume, mL", "defined, %", "median", "p90", "p95", "p99", *above)
    note = (
        "Maximum shear strain (E₁ − E₃)/2 (Green-Lagrange), and the volume in which it exceeds a value. p90: 90th "
        "percentile."
    )
    return Table("Percentiles and volumes of the maximum shear strain", columns, rows, note)


def estimates(row: RegionRow, intervals: Sequence[Interval]) -> tuple[Estimate, Estimate]:
    """Median and 95th percentile of the maximum shear strain of a region, each with its interval where it is known."""
    known = {i.statistic: (i.low, i.high) for i in intervals if i.region == row.region and not np.isnan(i.low)}
    return Estimate(row.median, known.get("median")), Estimate(row.p95, known.get("p95"))


def summary_table(regions: Sequence[RegionRow], intervals: Sequence[Interval], caveat: str = "") -> Table:
    """Median and 95th percentile of the maximum shear strain by tissue, each with its interval where it is known.

    The ``caveat``, a sentence on the intervals, stands in its note.
    """
    rows = tuple((r.region, *estimates(r, intervals)) for r in regions if r.quantity == "max_shear")
    known = any(not np.isnan(i.low) for i in intervals)
    note = f"In brackets: interval of 95 % coverage, from the error model. {LOPSIDED}" if known else ""
    if bare := dict.fromkeys(i.region for i in intervals if np.isnan(i.low)):
        note = f"{note} No interval in {', '.join(bare)}: its coverage is known to be below 90 %."
    note = f"{note} {caveat}".strip()
    return Table("Maximum shear strain by tissue", ("tissue", "median", "95th percentile"), rows, note)


def error_tables(bars: ErrorBars) -> list[Table]:
    """The intervals, and the errors in the synthetic warp."""
    tables = []
    if bars.uncertainty is not None:
        rows = tuple(
            (i.region, _words(i.statistic), i.found, i.estimate, i.low, i.high) for i in bars.uncertainty.intervals
        )
        columns = ("region", "statistic", "measured", "bias removed", "95 % interval, lower", "upper")
        tables.append(Table("Maximum shear strain with 95 % intervals", columns, rows, bars.explanation))
        if bars.uncertainty.components is not None:
            tables.append(_component_table(bars.uncertainty.components))
    if bars.twin:
        claims = bars.uncertainty is not None
        claimed = ("voxels within the error bars", "expected at least", "intervals widened, times")
        head = ("region", "error (rms)", "bias", *(claimed * claims))
        lines = tuple((row.region, row.rms_error, row.bias, *(_claimed(row) if claims else ())) for row in bars.twin)
        tables.append(Table("Check by a synthetic warp of this pair (twin)", head, lines, _TWIN))
    return tables


def _claimed(row: Judged) -> tuple[Cell, ...]:
    """Cells on what the error bars claim of a region; none without error bars."""
    if row.held is None or row.expected is None:
        return ()
    return f"{100 * row.held:.0f} %", f"{100 * row.expected:.0f} %", row.factor


def _component_table(known: ComponentUncertainty) -> Table:
    """The uncertainty of a component in one voxel, by tissue; the same along all axes."""
    of = {(row.region, row.component): row.voxel_standard_uncertainty for row in known.rows}
    columns = "region", "displacement, mm", "normal strain", "shear strain"
    regions = dict.fromkeys(row.region for row in known.rows)
    rows = [(name, of[name, "x"], of[name, "xx"], of[name, "xy"]) for name in regions]
    return Table(
        "Standard uncertainty of displacement and strain components in one voxel", columns, tuple(rows), _COMPONENTS
    )


def _words(statistic: str) -> str:
    percentiles = {"median": "median", "p90": "90th percentile", "p95": "95th percentile"}
    above = statistic.removeprefix("volume_above_").removesuffix("_ml")
    return percentiles.get(statistic, f"volume above {above}, mL")
