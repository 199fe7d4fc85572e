"""The report of a comparison: verdict first, then the table of models and loads, curves, slices and agreement."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from dvc.arrays import FloatArray
from dvc.deformation.protocol import Deformation, evaluate_on_grid
from dvc.deformation.strain import StrainField
from dvc.images.image import LabelMap, Mask
from dvc.io.images.read import read_voxels
from dvc.io.result_folder import REGISTERED
from dvc.report.page import Cell, Picture, Section, Table, caption_of
from dvc.report.viewer import Viewer, Volume
from dvc.trust.verdict import Verdict
from mrstrain.comparison.methods import METHODS
from validate import figures
from validate.comparison import NOTHING, Comparison, Total
from validate.curves import Area
from validate.fe_result import FeResult
from validate.location import Threshold
from validate.mapping import ALL, filled_from_nearest

_AROUND = 4  # voxels around the tissue in the viewer
_PANELS = 4  # tissues whose curves are drawn, all soft tissue first
_AGREED = ("measured", "model", "slope", "intercept", "R²", "RMSE", "concordance", "bias", "limits from", "to")
_CLOSING = Section(
    "How to read this",
    paragraphs=(
        "All fields are compared at the centroids of the same cells of one mesh, with the cells' volumes as weights, "
        "in the reference (unloaded) configuration; cells in which the measurement or a model is not defined are left "
        "out for all. Strain is Green-Lagrange, maximal shear (E1 - E3)/2. Displacement is that of tissue relative "
        "to its bone, LPS mm.",
        "The area between two volume-strain curves is the integral of the difference of volumes above a strain over "
        "the range of strain, in mL; its share is divided by the tissue's volume and the width of the range. Curves "
        "carry no place: two fields may have one curve and differ everywhere. Overlap (Dice), distances of centroids, "
        "the Hausdorff distance (95th percentile) and the agreement cell by cell tell where.",
        "Intervals and the grey band come from the error model of the registration: truths are drawn that could lie "
        "behind the measured field, and the model's area to each is taken. Where an interval does not hold the area "
        "as found, noise and smoothing have moved the measured curve. Two models are told apart where the area of one "
        "is the smaller in 97.5 % of the draws, widened as the intervals are.",
        "A measurement without a label map smears strain that jumps at a border of tissues over about 4 mm, and noise "
        "lifts small shears; a model does neither. What the measurement cannot see, no comparison can: scanner "
        "distortion, creep during a scan, tissue that slides along a smooth skin or inside a uniform region. Levels of "
        "strain are no thresholds of injury unless the table of thresholds says so and why.",
    ),
)  # fmt: skip


class Judged(Protocol):
    """A measurement with the verdict on its registration."""

    @property
    def verdict(self) -> Verdict | None:
        """None where it has none."""
        ...


def pictures_of(
    one: Comparison,
    measured: Deformation,
    results: Sequence[FeResult],
    labels: LabelMap,
    bones: Sequence[str],
    axes: FloatArray,
    strains: tuple[float, float],
    colours: Sequence[str],
) -> dict[str, Picture]:
    """Draw a load's figures, by the stem of their files; ``colours`` names the models in the order of their colours."""
    found = one.found
    displacements = {r.name: _at_nodes(r, found.mesh.points_mm) for r in results}
    told = [name for name in found.tissues if any(a.tissue == name for a in one.areas)]
    curves = figures.volume_strain(found, one.bands, strains, (ALL, *told)[:_PANELS], colours)
    point = lowest_bone_point(labels, bones[0], axes)
    across = (found.mesh.points_mm - point) @ axes[:, 2]
    through = f"It goes through the lowest point of {bones[0]}."
    if not across.min() < 0.0 < across.max():
        point = found.mesh.bounds_mm.mean(axis=0)
        through = (
            f"The lowest point of {bones[0]} lies beside the mesh: the slice goes through the mesh's middle instead."
        )
    slices = figures.slices(found, measured, displacements, axes, point)
    apart = caption_of(figures.differences)
    return {
        "curves": Picture("Volume above a strain", caption_of(figures.volume_strain), curves),
        "slices": Picture("Where the strain lies", f"{caption_of(figures.slices)} {through}", slices),
        "agreement": Picture("Maximal shear, cell by cell", caption_of(figures.scatter), figures.scatter(found)),
        "differences_shear": Picture(
            "Differences of maximal shear", apart, figures.differences(found, one.agreements, "max_shear")
        ),
        "differences_u": Picture(
            "Differences of the displacement's length", apart, figures.differences(found, one.agreements, "u_mm")
        ),
    }


def lowest_bone_point(labels: LabelMap, bone: str, axes: FloatArray) -> FloatArray:
    """Where a bone lies furthest along the plate's outward normal, LPS mm; the middle of a flat one."""
    points = labels.grid.points(np.isin(labels.labels, [n for n, name in labels.names.items() if name == bone]))
    height = points @ axes[:, 0]
    return np.asarray(points[height < height.min() + 0.5 * labels.grid.spacing_mm.min()].mean(axis=0))


def _at_nodes(result: FeResult, points_mm: FloatArray) -> FloatArray:
    """A model's displacement at the nodes of the compared mesh; its own nodes' where that is its mesh."""
    if result.mesh.points_mm.shape == points_mm.shape and np.array_equal(result.mesh.points_mm, points_mm):
        return result.deformation.u_mm
    return filled_from_nearest(result.deformation.displacement(points_mm), points_mm)


def viewer_of(
    one: Comparison,
    measured: Deformation,
    results: Sequence[FeResult],
    labels: LabelMap,
    bones: Sequence[str],
    folder: Path,
) -> Viewer:
    """The measured strain and that of the nearest model over the image, on the label map's voxels.

    The image is the loaded one as registered, which lies on the unloaded anatomy, where the measurement has it.
    """
    box = Mask(labels.grid, labels.labels > 0).box(_AROUND)
    soft = [number for number, name in labels.names.items() if name not in bones]
    grid, inside = labels.grid.part(box), np.isin(labels.labels[box], soft)
    names = [a.model for a in one.ranked()] or list(one.found.models)
    model = next(r for r in results if r.name == names[0])
    shear = []
    for field in (measured, model.deformation):
        values = np.full(grid.shape, np.nan)
        values[inside] = StrainField.from_gradient(evaluate_on_grid(field, grid, inside)[1]).max_shear
        shear.append(values)
    scanned = folder / REGISTERED
    seen, voxels = read_voxels(scanned) if scanned.is_file() else (None, np.empty(0))
    if seen is not None and seen.same_as(labels.grid):
        shown = np.nan_to_num(voxels[box])
    else:
        shown = labels.labels[box].astype(np.float64)
    most = max(0.05, float(np.ceil(20.0 * np.nanquantile(shear[0], 0.99)) / 20.0))
    return Viewer(
        "To turn and to scroll",
        f"Maximal shear, 0 to {most:g}, in the unloaded configuration: measured, and by {model.name}. Drag to move "
        "through the slices, with the right button to turn; both follow. Needs WebGL 2.",
        Volume.of("image", grid, shown, float(np.quantile(shown, 0.997)) or 1.0),
        (Volume.of("measured", grid, shear[0], most), Volume.of(model.name, grid, shear[1], most)),
    )


def page_sections(
    shown: Sequence[tuple[Comparison, Judged, Mapping[str, Picture], Viewer]],
    summed: Total,
    notes: Sequence[str],
    strange: Sequence[str],
    strains: tuple[float, float],
) -> list[Section]:
    """The report's parts: models and loads first, with what is ``strange`` about a model, then each load."""
    heads = {
        one.load: one.load
        if measurement.verdict is None or measurement.verdict.level == "trust"
        else f"{one.load} ({measurement.verdict.words.lower()})"
        for one, measurement, _, _ in shown
    }
    slips = Verdict("caution", tuple(strange)) if strange else None
    table = _areas([one for one, _, _, _ in shown], heads, summed, strains)
    sections = [Section("Models and loads", slips, (table,), (), (*summed.told, *notes))]
    for one, measurement, drawn, viewer in shown:
        verdict = measurement.verdict
        covered = one.found.coverage()
        told = (
            f"Compared: {covered['common']:.1f} mL of the mesh's {covered['mesh']:.1f} mL of soft tissue; the "
            f"measurement is defined in {covered['measured']:.1f} mL."
        )
        judged = () if verdict is None else (f"Its registration is judged: {verdict.words}.",)
        doubtful = verdict if verdict is not None and verdict.level != "trust" else None
        first = tuple(drawn[stem] for stem in ("curves", "slices"))
        cells = tuple(picture for stem, picture in drawn.items() if stem not in ("curves", "slices"))
        sections.append(
            Section(
                one.load, doubtful, (_tissues(one), _location(one), _travel(one)), first, (told, *judged), (viewer,)
            )
        )
        sections.append(Section(f"{one.load}, cell by cell", None, (_agreement(one), _by_distance(one)), cells))
    return sections


def closing_sections(thresholds: Sequence[Threshold], methods: Sequence[str]) -> list[Section]:
    """How a comparison is read, where its levels of strain come from, and paragraphs for a methods section."""
    sources = Section(
        "Levels of strain",
        None,
        (Table("Thresholds", ("maximal shear", "source"), tuple((t.max_shear, t.source) for t in thresholds)),),
    )
    return [_CLOSING, sources, Section(METHODS, paragraphs=tuple(methods))]


def shown(area: Area) -> str:
    """An area as people read it: with the interval that the measurement's error leaves, where that is known."""
    known = not np.isnan(area.low_ml)
    return f"{area.best_ml:.2f}" + (f" ({area.low_ml:.2f} to {area.high_ml:.2f})" if known else "")


def _areas(done: Sequence[Comparison], heads: Mapping[str, str], summed: Total, strains: tuple[float, float]) -> Table:
    areas = {(a.model, a.load): a for one in done for a in one.areas if a.tissue == ALL}
    sums = {a.model: a for a in (*summed.areas, summed.nothing)}
    names = [*sums, *dict.fromkeys(model for model, _ in areas if model not in sums)]
    rows: dict[str, tuple[Cell, ...]] = {}
    for name in names:
        cells = ["–" if (area := areas.get((name, one.load))) is None else shown(area) for one in done]
        place = summed.place(name)
        told = "–" if place is None else "–".join(str(p) for p in dict.fromkeys(place))
        rows[name] = (name, told, *cells, shown(sums[name]) if name in sums else "–")
    nothing = rows.pop(NOTHING)
    return Table(
        f"Area between the volume-strain curves of soft tissue, strains {strains[0]:g} to {strains[1]:g}, mL",
        ("model", "place", *(heads[one.load] for one in done), "all loads"),
        tuple(rows.values()),
        "The nearest model over all loads first; a place is a range where the measurement does not tell which of "
        "several models is nearer. Where the measurement's error is known, the area is the median over truths that "
        "could lie behind it, with a 95 % interval; areas as found, and by tissue, stand below and in areas.csv. "
        "Levelled models come last, with their area as found. Below the line: the area of a model that predicts no "
        "strain at all.",
        (nothing,),
    )


def _tissues(one: Comparison) -> Table:
    def told(areas: Iterable[Area]) -> tuple[tuple[Cell, ...], ...]:
        return tuple(
            (a.model, a.tissue, a.ml, 100.0 * a.share, a.estimate_ml, a.low_ml, a.high_ml, a.floor_ml) for a in areas
        )

    return Table(
        "Area between the curves, by tissue",
        ("model", "tissue", "as found, mL", "share, %", "estimate, mL", "95 % from", "to", "a perfect model's"),
        told(a for a in one.areas if a.model != NOTHING),
        "As found: with the measurement's noise and smoothing. Estimate and interval: these taken out. A perfect "
        "model's: what noise alone would give; an interval that reaches it begins at 0.",
        told(a for a in one.areas if a.model == NOTHING),
    )


def _location(one: Comparison) -> Table:
    rows = tuple(
        (o.model, o.threshold, _ranged(o.measured_ml, o.measured_low_ml, o.measured_high_ml), o.model_ml,
         f"{o.measured_clusters} / {o.model_clusters}", f"{_ranged(o.measured_mean)} / {_ranged(o.model_mean)}",
         _ranged(o.dice, o.dice_low, o.dice_high),
         _ranged(o.centroids_mm, o.centroids_low_mm, o.centroids_high_mm), o.largest_mm,
         _ranged(o.hausdorff95_mm, o.hausdorff95_low_mm, o.hausdorff95_high_mm))
        for o in one.overlaps
    )  # fmt: skip
    perfect: dict[float, tuple[Cell, ...]] = {
        o.threshold: ("perfect", o.threshold, "", "", "", "", _ranged(o.dice_perfect),
                      _ranged(o.centroids_perfect_mm), "", _ranged(o.hausdorff95_perfect_mm))
        for o in one.overlaps
        if not np.isnan(o.measured_low_ml)
    }  # fmt: skip
    known = (
        "In brackets 95 % intervals with the measurement's bias and noise taken out, so that one need not hold the "
        "figure as found; below the line what noise alone leaves of a perfect model: an interval that reaches it goes "
        "on to 1, or to 0 mm. "
        if perfect
        else "The measurement's error is not known: no intervals. "
    )
    return Table(
        "Tissue above a strain: how much, and where",
        ("model", "above", "measured, mL", "model, mL", "clusters", "mean shear", "Dice", "centroids, mm",
         "largest, mm", "Hausdorff, mm"),
        rows,
        known + "In clusters, connected parts of at least the least volume: their number and mean shear, measured / "
        "model's; distances of the centroids of all together, and of the largest; Hausdorff distance at its 95th "
        "percentile.",
        tuple(perfect.values()),
    )  # fmt: skip


def _ranged(value: float, low: float = np.nan, high: float = np.nan) -> str:
    """A figure with its interval, where there is one."""
    if np.isnan(value):
        return "–"
    return f"{value:.3g}" if np.isnan(low) else f"{value:.3g} ({low:.2g}–{high:.2g})"


def _agreement(one: Comparison) -> Table:
    rows = _rows_of(one, [ALL, *one.found.tissues])
    return Table(
        "Agreement cell by cell",
        ("model", "quantity", "tissue", *_AGREED),
        rows,
        "Of maximal shear and displacement u: means, regression of the model on the measurement, Lin's concordance, "
        "Bland and Altman's limits. Of displacements: lengths, but for regression and concordance (the three "
        "components together) and RMSE (of the difference). All as found, "
        "without intervals: the error model tells of maximal shear, and there is none of displacement.",
    )  # fmt: skip


def _by_distance(one: Comparison) -> Table:
    known = (ALL, *one.found.tissues)
    return Table(
        "Agreement by distance to bone",
        ("model", "quantity", "where", *_AGREED),
        _rows_of(one, [a.part for a in one.agreements if a.part not in known]),
        "In all soft tissue, as above.",
    )


def _rows_of(one: Comparison, parts: Sequence[str]) -> tuple[tuple[Cell, ...], ...]:
    return tuple(
        (a.model, {"max_shear": "shear", "u_mm": "u, mm"}[a.quantity], a.part, a.measured_mean,
         a.model_mean, a.slope, a.intercept, a.r2, a.rmse, a.concordance, a.bias, a.lower, a.upper)
        for a in one.agreements
        if a.part in parts
    )  # fmt: skip


def _travel(one: Comparison) -> Table:
    rows = tuple(
        (t.model, t.nodes, t.measured_mm, t.model_mm, t.measured_along_mm, t.model_along_mm,
         100.0 * t.measured_volume_change, 100.0 * t.model_volume_change)
        for t in one.travels
    )  # fmt: skip
    return Table(
        "Skin under the plate, and volume of the fat",
        ("model", "nodes", "inward, measured, mm", "model, mm", "across, measured, mm", "model, mm",
         "fat's volume, measured, %", "model, %"),
        rows,
        "Mean displacement 1 mm inside the skin on the model's plate, against the plate's outward normal and across "
        "it; mean det F - 1.",
    )  # fmt: skip
