"""The report of a comparison: verdict first, then the table of models and loads, curves, slices and agreement."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import astuple, replace
from functools import partial
from pathlib import Path

import numpy as np

from dvc import Deformation, LabelMap, Mask, StrainField, evaluate_on_grid
from dvc.arrays import FloatArray
from dvc.io.images.read import read_voxels
from dvc.report.alike import alike
from dvc.report.drawing import Drawing
from dvc.report.figures import scale_told, shear_scale
from dvc.report.page import METHODS, Cell, Picture, Section, Table, Viewer, Volume
from dvc.report.strips import MEASURED, Strip, narrow_by_load, strain_by_load
from dvc.trust.verdict import together
from validate import figures, standards
from validate.agreement import Agreement, SkinDisplacement, over_loads
from validate.comparison_error import validation_section
from validate.curves import Area
from validate.fe_result import FeResult
from validate.load_comparison import NOTHING, LoadComparison
from validate.location import Threshold
from validate.mapping import ALL, UNNAMED, filled_from_nearest
from validate.misfit import Misfit
from validate.ranking import ALL_LOADS, Ranking, no_nearer
from validate.strip import strip_of
from validate.tables import Curve, columns_of, curves_of

_AROUND, _PANELS = 4, 4  # voxels around the tissue in the viewer; tissues whose curves are drawn, all soft tissue first
_DIFFERENCES = (  # stem of the files, quantity, its name with its unit in the columns, title
    ("differences_shear", "max_shear", "max_shear", "Differences of maximum shear strain"),
    ("differences_u", "u_mm", "displacement_mm", "Differences of displacement magnitude"),
)
_COEFFICIENTS = "coefficients"  # stem of the files
_AGREED = (
    "measured mean", "model mean", "slope", "intercept", "R²", "RMSE", "concordance", "mean difference",
    "limits, lower", "upper",
)  # fmt: skip
_CLOSING = Section(
    "How to read this",
    paragraphs=(
        "All fields are compared at the centroids of the same cells of one mesh, weighted by cell volume, in the "
        "reference configuration (that of the unloaded image). A cell in which the measurement or any model is "
        "undefined is left out for all. Strain is Green-Lagrange; the maximum shear strain is (E1 - E3)/2. "
        "Displacement is relative to the bone, LPS mm.",
        "The area between two strain-volume curves (the area validation metric, with volume in place of probability) "
        "is the integral of the absolute difference between the two volumes over the range of strain, in mL. The "
        "normalised area is divided by the volume of the tissue and the width of the range. Curves contain no "
        "information on location: two fields may have the same curve and differ everywhere. Overlap (Dice), distances "
        "of centroids, the Hausdorff distance (95th percentile) and the agreement cell by cell show where the fields "
        "differ.",
        "Intervals and the grey band have 95 % coverage. They come from the error model of the registration: "
        "truths that agree with the measurement are drawn from it, and the area between the model's curve and that of "
        "each drawn truth is computed. An interval may exclude the area as measured, because noise and "
        "smoothing shift the measured curve. Two models differ significantly if one has the smaller area in at least "
        "97.5 % of the drawn truths, whose spread is widened like the intervals.",
        "A measurement without a label map smooths strain discontinuities between soft tissues over 3 to 5 mm (one "
        "smooth spline also those at the bone), and noise increases small shear strains; a model does neither. A "
        "comparison cannot show effects that the measurement cannot detect: scanner distortion, creep during a scan, "
        "and sliding along smooth skin or within a uniform region. Strain thresholds are not injury thresholds, unless "
        "their source below gives a reason.",
    ),
)  # fmt: skip


Drawn = tuple[dict[str, Drawing], Viewer, Strip]
"""Figures of a load, by the stem of their files, its viewer, and its part of the first figure of the report."""


def drawing_of(
    loads: Sequence[LoadComparison], largest: float | None = None
) -> tuple[Callable[[LoadComparison], Drawn], float]:
    """`draw` for each of the loads, and where the colours of all their maps of the maximum shear strain end."""
    ends = largest or shear_scale(*(one.fields.measured.max_shear for one in loads))
    models = list(dict.fromkeys(name for one in loads for name in one.fields.models))
    return partial(draw, models=models, image=loads[0].case.image, largest=ends), ends


def draw(one: LoadComparison, models: Sequence[str], image: Path | None, largest: float) -> Drawn:
    """Draw a load; ``models`` are those of all loads, ``image`` is the anatomy in all viewers.

    The colours of all maps of the maximum shear strain end at ``largest``.
    """
    measured, results = one.case.read()
    fields, axes = one.fields, one.case.axes
    displacements = {r.name: _at_nodes(r, fields.mesh.points_mm) for r in results}
    tissues = [name for name in (ALL, *fields.tissues) if any(a.tissue == name for a in one.areas)][:_PANELS]
    middle = fields.mesh.bounds_mm.mean(axis=0)
    lowest = lowest_bone_point(one.labels, one.bones[0], axes) if one.bones else middle
    point, through = lowest, f"The slice goes through {_place(one)}."
    across = (fields.mesh.points_mm - point) @ axes[:, 2]
    if not across.min() < 0.0 < across.max():
        point, through = middle, f"The slice goes through the middle of the mesh, since {_place(one)} is outside of it."
    slices, through = (
        (one, measured, displacements, point, largest),
        f"{through} {scale_told(largest, among='comparison')}",
    )
    agreement = figures.agreement_bins(fields)
    drawings = {
        "curves": Drawing.of(
            "Strain-volume curves", figures.volume_strain, one, tissues, models,
            data=columns_of(curve for curve in curves_of(one) if curve.tissue in tissues),
        ),
        "slices": Drawing.of("Location of the strain", figures.slices, *slices, note=through),
        "agreement": Drawing.of(
            "Maximum shear strain, cell by cell", figures.scatter, agreement,
            data=figures.columns_of(agreement, "measured_max_shear", "simulated_max_shear"),
        ),
    }  # fmt: skip
    for stem, quantity, name, title in _DIFFERENCES:
        bins = figures.difference_bins(fields, quantity)
        data = figures.columns_of(bins, f"mean_{name}", f"difference_{name}")
        drawings[stem] = Drawing.of(title, figures.differences, bins, one, quantity, data=data)
    if (of_coefficients := standards.drawing(one, models)) is not None:
        drawings[_COEFFICIENTS] = of_coefficients
    return drawings, _viewer(one, measured, results, image, largest), strip_of(one, measured, results, lowest)


def _place(one: LoadComparison) -> str:
    """Where slices go through, in words."""
    return f"the point of the {one.bones[0]} nearest to the plate" if one.bones else "the middle of the mesh"


def lowest_bone_point(labels: LabelMap, bone: str, axes: FloatArray) -> FloatArray:
    """Point of a bone furthest along the plate's outward normal, LPS mm; the mean if there are several."""
    points = labels.region(bone).points()
    height = points @ axes[:, 0]
    return np.asarray(points[height < height.min() + 0.5 * labels.grid.spacing_mm.min()].mean(axis=0))


def _at_nodes(result: FeResult, points_mm: FloatArray) -> FloatArray:
    """A model's displacement at nodes (n, 3) of the compared mesh; as stored if that is the model's own mesh."""
    if np.array_equal(result.mesh.points_mm, points_mm):
        return result.deformation.u_mm
    return filled_from_nearest(result.deformation.displacement(points_mm), points_mm)


def _viewer(
    one: LoadComparison, measured: Deformation, results: Sequence[FeResult], scanned: Path | None, most: float
) -> Viewer:
    """Measured strain and that of the best model over an image, or over the label map, on its voxels."""
    labels = one.labels
    box = Mask(labels.grid, labels.labels > 0).box(_AROUND)
    soft = [number for number, name in labels.names.items() if name not in one.bones]
    grid, inside = labels.grid.part(box), np.isin(labels.labels[box], soft)
    names = [a.model for a in one.ranked()] or list(one.fields.models)
    model = next(r for r in results if r.name == names[0])
    shear = []
    for field in (measured, model.deformation):
        values = np.full(grid.shape, np.nan)
        values[inside] = StrainField.from_gradient(evaluate_on_grid(field, grid, inside)[1]).max_shear
        shear.append(values)
    shown = labels.labels[box].astype(np.float64)
    if scanned is not None:
        seen, voxels = read_voxels(scanned)
        shown = np.nan_to_num(voxels[box]) if seen.same_as(labels.grid) else shown
    best = " (smallest area under this load)" * (len(one.ranked()) > 1)
    return Viewer(
        "Interactive 3-D viewer",
        f"Maximum shear strain, 0 to {most:g}, in the reference configuration: measured, and simulated by {model.name}"
        f"{best}. Behind it: the registered image of the first load. Drag to move through the slices; drag with the "
        "right button to rotate. Both views move together. The viewer needs WebGL 2.",
        Volume.image("image", grid, shown, float(np.quantile(shown, 0.997)) or 1.0),
        (Volume.overlay("measured", grid, shear[0], most), Volume.overlay(model.name, grid, shear[1], most)),
    )


def load_sections(one: LoadComparison, pictures: Mapping[str, Picture], viewer: Viewer) -> list[Section]:
    """Sections of a load: amount and location of strain, agreement cell by cell, and what the standards ask for."""
    verdict = one.case.verdict
    words = [
        "Compared: {common:.1f} mL of the {mesh:.1f} mL of soft tissue in the mesh. The measurement is defined in "
        "{measured:.1f} mL of it. Volumes and percentiles under Registration are those of the whole label map.".format(
            **one.fields.coverage()
        )
    ]
    words += [] if verdict is None else [f"Verdict on the registration: {verdict.words}."]
    curves, slices, *others = (picture for stem, picture in pictures.items() if stem != _COEFFICIENTS)
    tables = _tissues(one), _location(one), _skin(one)
    doubtful = None if verdict is None or verdict.level == "trust" else verdict
    return [
        Section(one.load, doubtful, tables, (curves, slices), tuple(words), (viewer,), folded=True),
        *validation_section(one.load, one.errors, ALL),
        Section(f"{one.load}, cell by cell", None, _agreement(one), tuple(others), folded=True),
        standards.section(one, pictures.get(_COEFFICIENTS)),
    ]


def drawings_of_all(
    strips: Sequence[Strip], curves: Sequence[Curve], strains: tuple[float, float], ranking: Ranking, largest: float
) -> dict[str, Drawing]:
    """The first figures of a report, by the stem of their files: slices and curves under all loads."""
    model = ranking.areas[0].model if ranking.areas else next(n for n in strips[0].max_shear if n != MEASURED)
    informative = ranking.areas and ALL_LOADS not in ranking.uninformative
    only = sum(not area.levelled for area in ranking.areas) == 1
    best = "the only model" if only else "the best match over all loads" if informative else "a model"
    note = f"Measured, and simulated by {model}, {best}. {strips[0].title}, through {strips[0].place}. "
    note += scale_told(largest, among="comparison")
    slices, of_all = (strips, (MEASURED, model), largest), [curve for curve in curves if curve.tissue == ALL]
    first = Drawing.of("Measured and simulated strain", strain_by_load, *slices, note=note)
    return {
        "slices_by_load": replace(first, narrow=narrow_by_load(*slices)),
        "curves_by_load": Drawing.of(
            "Strain-volume curves, all soft tissue", figures.curves_by_load, of_all, strains, data=columns_of(of_all)
        ),
    }  # fmt: skip


def overview(
    loads: Sequence[LoadComparison], ranking: Ranking, warnings: Sequence[Misfit], told: Sequence[str],
    pictures: Sequence[Picture],
) -> Section:  # fmt: skip
    """The first part of the report: what is ``told`` in sentences, figures, areas, and ``warnings`` about models."""
    slips = together(odd.verdict for odd in warnings) if warnings else None
    areas = (_areas(loads, ranking),)
    return Section("Models and loads", slips, areas, tuple(pictures), alike(told), pictures_first=True)


def _head(one: LoadComparison) -> str:
    """A load's name, with its verdict if that is not trust, and with what makes its areas useless."""
    verdict = one.case.verdict
    told = [] if verdict is None or verdict.level == "trust" else [verdict.words.lower()]
    told += ["not informative"] * one.hardly_strained
    return f"{one.load} ({', '.join(told)})" if told else one.load


def closing_sections(
    thresholds: Sequence[Threshold], methods: Sequence[str], more: Sequence[Section] = ()
) -> list[Section]:
    """Explanation of a comparison, sources of its thresholds, ``more``, and a methods text if there are paragraphs."""
    rows = tuple((t.max_shear, t.source) for t in thresholds)
    sources = Section("Strain thresholds", None, (Table("Thresholds", ("maximum shear strain", "source"), rows),))
    return [_CLOSING, sources, *more, *([Section(METHODS, paragraphs=tuple(methods))] if methods else [])]


def shown(area: Area) -> str:
    """An area in mL, with its 95 % interval if the measurement uncertainty is known."""
    known = not np.isnan(area.low_ml)
    return f"{area.best_ml:.2f}" + (f" ({area.low_ml:.2f} to {area.high_ml:.2f})" if known else "")


def _ranks(ranking: Ranking, model: str) -> str:
    """Rank of a model over all loads: a range if not distinguishable from neighbours, a dash if not ranked."""
    ranks = "–".join(str(rank) for rank in dict.fromkeys(ranking.rank(model) or ("–",)))
    worse = ALL_LOADS not in ranking.uninformative and model in no_nearer(ranking.areas, ranking.nothing)
    return ranks + f", no better than {NOTHING}" * worse


def area_rows(areas: Iterable[Area], ranking: Ranking, loads: Sequence[str]) -> list[tuple[str, ...]]:
    """Name, rank, and areas of all soft tissue under the loads or `ALL_LOADS`, of each model; `NOTHING` comes last."""
    cells = {(a.model, a.load): shown(a) for a in (*ranking.areas, ranking.nothing, *areas) if a.tissue == ALL}
    models = [name for name in dict.fromkeys(model for model, _ in cells) if name != NOTHING]
    return [
        (name, _ranks(ranking, name), *(cells.get((name, load), "–") for load in loads)) for name in (*models, NOTHING)
    ]


def _areas(loads: Sequence[LoadComparison], ranking: Ranking) -> Table:
    low, high = loads[0].criteria.strains
    levelled = any(area.levelled for area in ranking.areas)
    *rows, nothing = area_rows(
        [a for one in loads for a in one.areas], ranking, [ALL_LOADS, *(one.load for one in loads)]
    )
    of_all = [row for one in loads for row in one.agreements]
    followed = [[over_loads(of_all, row[0], "max_shear", value) or "–" for value in ("slope", "r2")] for row in rows]
    return Table(
        f"Area between measured and simulated strain-volume curves, all soft tissue, strain {low:g} to {high:g}, mL",
        ("model", "rank", ALL_LOADS, *(_head(one) for one in loads), "slope", "R²"),
        tuple((*row, *of_model) for row, of_model in zip(rows, followed, strict=True)),
        "Best model over all loads first; a rank such as 1–2 means that models are not distinguishable. If the "
        "measurement uncertainty is known, areas are estimates with noise and smoothing removed, with 95 % intervals. "
        "Areas as measured and areas by tissue are given below and in areas.csv."
        + " The sum over all loads includes those that are not informative." * bool(ranking.uninformative)
        + " Models of a forward-model comparison are last, with their area as measured." * levelled
        + " Slope and R² (range over the loads): regression of the model's maximum shear strain on the measured one, "
        "cell by cell. Slope: simulated change per unit of measured change; R²: fraction of the simulated variation "
        "that follows the measurement. Measurement noise lowers both."
        + " Last row: a model that predicts zero strain everywhere; models that are not 5 % better are marked.",
        ((*nothing, "–", "–"),),
    )  # fmt: skip


def _tissues(one: LoadComparison) -> Table:
    def cells(areas: Iterable[Area]) -> tuple[tuple[Cell, ...], ...]:
        return tuple((a.model, a.tissue, a.ml, 100.0 * a.share, *astuple(a)[5:]) for a in areas)

    return Table(
        "Area between measured and simulated strain-volume curves, by tissue",
        ("model", "tissue", "as measured, mL", "normalised, %", "estimate, mL", "95 % interval, lower", "upper",
         "perfect model, mL"),
        cells(a for a in one.areas if a.model != NOTHING),
        "As measured: with the noise and smoothing of the measurement. Estimate and interval: corrected for both by "
        "the error model. Perfect model: the area that noise (and, if given, errors of the inputs) would cause; an "
        "interval whose lower end is smaller begins at 0, because a perfect model is not excluded. Areas of tissues "
        "do not add up to that of all soft tissue, in which over- and underestimates cancel."
        + f" {UNNAMED}: tissue of the mesh whose name is not in the label map and that lies outside all labels."
        * any(a.tissue == UNNAMED for a in one.areas),
        cells(a for a in one.areas if a.model == NOTHING),
    )  # fmt: skip


def _location(one: LoadComparison) -> Table:
    rows = tuple(
        (o.model, o.threshold, _ranged(o.measured_ml, o.measured_low_ml, o.measured_high_ml), o.model_ml,
         f"{o.measured_clusters} / {o.model_clusters}", f"{_ranged(o.measured_mean)} / {_ranged(o.model_mean)}",
         _ranged(o.dice, o.dice_low, o.dice_high),
         _ranged(o.centroids_mm, o.centroids_low_mm, o.centroids_high_mm), o.largest_mm,
         _ranged(o.hausdorff95_mm, o.hausdorff95_low_mm, o.hausdorff95_high_mm))
        for o in one.overlaps
    )  # fmt: skip
    perfect: dict[float, tuple[Cell, ...]] = {
        o.threshold: ("perfect model", o.threshold, "", "", "", "", _ranged(o.dice_perfect),
                      _ranged(o.centroids_perfect_mm), "", _ranged(o.hausdorff95_perfect_mm))
        for o in one.overlaps
        if not np.isnan(o.measured_low_ml)
    }  # fmt: skip
    known = (
        "In brackets: 95 % intervals with the bias and noise of the measurement removed; the value as measured may lie "
        "outside. Below the line: values that a perfect model would get from noise alone; an interval that includes "
        "them is extended to perfect agreement (1, or 0 mm). "
        if perfect
        else "The measurement uncertainty is unknown, so there are no intervals. "
    )
    return Table(
        "Tissue above a strain threshold: volume and location",
        ("model", "above", "measured, mL", "model, mL", "clusters", "mean max. shear", "Dice",
         "distance of centroids, mm", "of largest clusters, mm", "Hausdorff distance, mm"),
        rows,
        known + f"Clusters: connected cells above the threshold of at least {one.criteria.least_ml:g} mL. Their number "
        "and mean maximum shear strain are given as measured / model. Centroids: of all clusters together, and of the "
        "largest clusters. Hausdorff distance: 95th percentile.",
        tuple(perfect.values()),
    )  # fmt: skip


def _ranged(value: float, low: float = np.nan, high: float = np.nan) -> str:
    """A value with its interval, if there is one."""
    if np.isnan(value):
        return "–"
    return f"{value:.3g}" if np.isnan(low) else f"{value:.3g} ({low:.2g}–{high:.2g})"


def _agreement(one: LoadComparison) -> tuple[Table, ...]:
    """Agreement cell by cell: by tissue, and, where there is bone, by distance to bone."""
    names, tissues = {"max_shear": "max. shear", "u_mm": "u, mm"}, (ALL, *one.fields.tissues)
    rows: list[tuple[Cell, ...]] = [(a.model, names[a.quantity], a.part, *_rounded(a, 6)) for a in one.agreements]
    by_distance = Table(
        "Agreement by distance to bone", ("model", "quantity", "distance to bone", *_AGREED),
        tuple((*row[:2], str(row[2]).removesuffix(" from bone"), *row[3:]) for row in rows if row[2] not in tissues),
        "In all soft tissue, as above.",
    )  # fmt: skip
    return (
        Table(
            "Agreement cell by cell",
            ("model", "quantity", "tissue", *_AGREED),
            tuple(row for row in rows if row[2] in tissues),
            "Maximum shear strain and displacement u: means, regression of the model on the measurement, Lin's "
            "concordance, and Bland-Altman limits of agreement. For displacement, regression and concordance pool the "
            "three components, RMSE is that of the difference vector, and the other values are of the magnitude. All "
            "values are as measured and have no intervals.",
        ),
        *((by_distance,) if one.bones else ()),
    )


def _rounded(row: Agreement | SkinDisplacement, first: int) -> tuple[float, ...]:
    """Values of a row from the ``first`` on; rounding errors of zero, and its sign, are removed."""
    return tuple(round(figure, 9) + 0.0 for figure in astuple(row)[first:])


def _skin(one: LoadComparison) -> Table:
    return Table(
        "Skin under the plate, and volume change of the fat",
        ("model", "contact nodes", "normal, measured, mm", "normal, model, mm", "tangential, measured, mm",
         "tangential, model, mm", "volume change of fat, measured, %", "model, %"),
        tuple(
            (t.model, t.nodes, *_rounded(t, 3)[:4], *(100.0 * change for change in _rounded(t, 3)[4:]))
            for t in one.skin
        ),
        "Mean displacement 1 mm below the surface of the skin, over the nodes that touch the plate in each model: "
        "normal to the plate, positive towards the body, and tangential. Volume change: mean of det F - 1.",
    )  # fmt: skip
