"""Pictures and tables of a measurement in a report."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from dvc.arrays import Float32Array
from dvc.deformation.strain_maps import StrainMaps
from dvc.measurement.error_bars import ErrorBars
from dvc.measurement.judgement import Source
from dvc.registration.engine import Regularisation
from dvc.report import figures
from dvc.report.page import Cell, Picture, Table, shown
from dvc.report.sheet import View
from dvc.trust.error_model import Interval
from dvc.trust.quality import NoiseFloor, Quality
from dvc.trust.regions import SHEAR_THRESHOLDS, RegionRow

SHEAR_SCALE, SIGMA_SCALE = 0.5, 0.1
"""Upper ends of the colours for maximum shear strain and its standard deviation."""
_TWIN = (
    "The unloaded image was moved by what was measured, its noise drawn anew, and the pair registered as the real one: "
    "its true strain is the one above. What came back tells what the noise and texture of these images cost. Strain "
    "that a registration smooths away before it is measured does not come back, which makes the twin's error smaller "
    "than the true one; what denoising takes of the texture makes it larger. A tissue in which fewer voxels lie within "
    "the claimed error than are expected of any registration, or a percentile does not come back within its interval, "
    "has its error bars made wider by the factor; none are made narrower."
)


def pictures_of(
    view: View, made: Source, maps: StrainMaps, floor: NoiseFloor | None, sigma: Float32Array | None
) -> dict[str, Picture]:
    """The figures of a report, by the name of their file: agreement of the images, strain, and its uncertainty.

    The deformed grid lies over the loaded image where there is one.
    """
    reference, bone, images = made.subject.reference, made.subject.bone, made.images
    labels, below, drawn = made.subject.regions(made.tissue), reference.values, dict[str, Picture]()
    if images is not None:
        pair, below = (view, reference, images.aligned, images.registered), images.aligned
        local = view, images.local_rigid, images.local_after
        drawn["overlay"] = Picture.drawn("Before and after", figures.overlay, *pair)
        drawn["checkerboard"] = Picture.drawn("Checkerboard", figures.checkerboard, *pair)
        drawn["similarity"] = Picture.drawn("Where the images agree", figures.similarity_slices, *local)
    strain = view, reference, maps.max_shear, SHEAR_SCALE, labels
    through = "Slices through the bone's lowest point along the plate's normal."
    drawn["strain"] = Picture.drawn("Maximum shear strain", figures.strain_slices, *strain, note=through)
    curves = maps.max_shear, labels, None if floor is None else floor.max_shear_p95
    drawn["curves"] = Picture.drawn("Volume above a strain", figures.shear_curves, *curves)
    grid = view, below, maps.displacement_mm, None if bone is None else bone.inside
    drawn["deformed_grid"] = Picture.drawn("Deformed grid", figures.deformed_grid, *grid)
    drawn["jacobian"] = Picture.drawn("Volume ratio", figures.jacobian_slices, view, reference, maps.jacobian)
    if sigma is not None:
        spread = view, reference, sigma, SIGMA_SCALE
        drawn["sigma"] = Picture.drawn("Uncertainty of the maximum shear strain", figures.sigma_slices, *spread)
    return drawn


def key_figures(quality: Quality, alignment: Mapping[str, Any]) -> Table:
    """What the verdict rests on."""
    rows = [("Rotation of the bone between the scans", alignment["rotation_deg"], "degrees")]
    if "bone_shift_lps_mm" in alignment:
        spread = "Spread of the rigid fits of halves of the bone (rms over the bone; largest of six pairs)"
        spacing = " x ".join(f"{s:.3g}" for s in alignment["control_spacing_mm"])
        rows += [
            ("Shift of the bone between the scans", float(np.linalg.norm(alignment["bone_shift_lps_mm"])), "mm"),
            ("Correlation in and around the bone, before alignment", alignment["similarity_before"], ""),
            ("Correlation in and around the bone, after alignment", alignment["similarity"], ""),
            (spread, alignment["repeatability_rms_mm"], "mm"),
            ("Engine of the non-rigid registration", alignment["engine"], ""),
            ("Spacing of the B-spline's control points", spacing, "mm"),
        ]
    if quality.similarity is not None:
        each = zip(("as scanned", "after the rigid part", "after all"), quality.similarity, strict=True)
        rows += [(f"Local similarity in the tissue, {said}", float(value), "") for said, value in each]
        rows.append(("Local similarity that noise as in the air allows, about", quality.most_similarity, ""))
    bone = "in the bone, before it was held at rest" if quality.bone_held else "left in the bone"
    rows += [
        (f"Displacement {bone} (truth: 0), rms", quality.bone_shift_mm, "mm"),
        (f"Apparent maximum shear strain {bone} (truth: 0), 95th percentile", quality.bone_shear_p95, ""),
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
            ("Noise floor: mean absolute strain component (MAER), mean over voxels", floor.maer, ""),
            ("Noise floor: standard deviation of the same (SDER)", floor.sder, ""),
        ]
    return Table("Key figures", ("figure", "value", "unit"), tuple(rows))


def weights_table(choice: Regularisation) -> Table:
    """The weights of the prior, and what those that were tried left of half of the voxels."""
    columns = ("penalty on", "weight", "unit", "residual left out, % above the least")
    return Table("Weights of the registration", columns, tuple(choice.rows()), choice.caption)


def region_table(regions: Sequence[RegionRow]) -> Table:
    """The maximum shear strain of every region."""

    def cells(r: RegionRow) -> tuple[Cell, ...]:
        above = (r.volume_above_ml.get(t) for t in SHEAR_THRESHOLDS)
        return r.region, r.volume_ml, 100.0 * r.defined_fraction, r.median, r.p90, r.p95, r.p99, *above

    rows = tuple(cells(r) for r in regions if r.quantity == "max_shear")
    above = (f"> {t:g}, mL" for t in SHEAR_THRESHOLDS)
    columns = ("region", "volume, mL", "defined, %", "median", "p90", "p95", "p99", *above)
    note = "Maximum shear strain (E₁ − E₃)/2 (Green-Lagrange), and volumes above a value."
    return Table("Maximum shear strain by region", columns, rows, note)


def short_table(regions: Sequence[RegionRow], intervals: Sequence[Interval]) -> Table:
    """Median and 95th percentile of the maximum shear strain by region, each with its interval where it is known."""
    known = {(i.region, i.figure): f"{shown(i.low)} to {shown(i.high)}" for i in intervals}

    def own(region: str, figure: str) -> tuple[str, ...]:
        return (known.get((region, figure), "–"),) if known else ()

    interval = ("95 % interval",) * bool(known)
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (r.region, r.volume_ml, r.median, *own(r.region, "median"), r.p95, *own(r.region, "p95"))
        for r in regions
        if r.quantity == "max_shear"
    )
    columns = ("region", "volume, mL", "median", *interval, "95th percentile", *interval)
    return Table("Maximum shear strain", columns, rows)


def summary_table(regions: Sequence[RegionRow], intervals: Sequence[Interval]) -> Table:
    """Median and 95th percentile of the maximum shear strain by tissue, each with its interval where it is known."""
    known = {(i.region, i.figure): f" ({shown(i.low)} to {shown(i.high)})" for i in intervals}
    rows = tuple(
        (r.region, *(shown(getattr(r, figure)) + known.get((r.region, figure), "") for figure in ("median", "p95")))
        for r in regions
        if r.quantity == "max_shear"
    )
    return Table("Maximum shear strain", ("tissue", "median", "95th percentile"), rows)


def error_tables(bars: ErrorBars) -> list[Table]:
    """The intervals, and what came back from the twin."""
    tables = []
    if bars.uncertainty is not None:
        rows = tuple((i.region, _words(i.figure), i.found, i.low, i.high) for i in bars.uncertainty.intervals)
        columns = ("region", "figure", "as found", "95 % from", "to")
        tables.append(Table("Maximum shear strain with its error", columns, rows, bars.told))
    if bars.twin:
        claims = bars.uncertainty is not None
        head = ("region", "error (rms)", "bias", *(("within the claim", "expected, at least", "wider") * claims))
        beside = ((f"{row.held:.0%}", f"{row.expected:.0%}", row.factor) if claims else () for row in bars.twin)
        lines = tuple((row.region, row.rms_error, row.bias, *more) for row, more in zip(bars.twin, beside, strict=True))
        tables.append(Table("The twin of this pair, measured again", head, lines, _TWIN))
    return tables


def _words(figure: str) -> str:
    percentiles = {"median": "median", "p90": "90th percentile", "p95": "95th percentile"}
    above = figure.removeprefix("volume_above_").removesuffix("_ml")
    return percentiles.get(figure, f"volume above {above}, mL")
