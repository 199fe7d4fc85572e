"""Figures of a comparison: PNG bytes, with the docstring as caption, and matplotlib figures for interactive use."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dvc import Deformation
from dvc.arrays import FloatArray
from dvc.report.figures import REGION_COLOURS
from dvc.report.sheet import INK, WIDTH_IN, chart, label_axes, panels, png_bytes
from fe.figures import Slice, slice_sheet
from validate.curves import Area
from validate.load_comparison import LoadComparison
from validate.mapping import ALL, MappedFields, filled_from_nearest
from validate.tables import LOWER, UPPER, Curve, curves_of

_POINTS, _COLUMNS, _BINS, _BAND = 601, 3, 60, "#b8bfc9"


def volume_strain(one: LoadComparison, tissues: Sequence[str], colours: Sequence[str]) -> bytes:
    """Volume of tissue in which the maximum shear strain exceeds a value: measured (black) and models, same cells.

    The grey band contains the true curve in 95 % of cases, according to the error model of the measurement. Areas are
    computed between the dotted lines.
    """
    curves = curves_of(one, np.linspace(0.0, 1.5 * one.criteria.strains[1], _POINTS))
    return png_bytes(_curves([c for c in curves if c.tissue in tissues], "tissue", one.criteria.strains, colours))


def _curves(curves: Iterable[Curve], by: str, strains: tuple[float, float], colours: Sequence[str]) -> Figure:
    """Curves, one panel for each load or tissue."""
    by_panel: dict[str, dict[str, Curve]] = {}
    for curve in curves:
        by_panel.setdefault(getattr(curve, by), {})[curve.field] = curve
    figure, spots = panels(len(by_panel))
    for axes, (title, of) in zip(spots, by_panel.items(), strict=True):
        at = of["measured"].max_shear
        if LOWER in of:
            edges = of[LOWER].volume_above_ml, of[UPPER].volume_above_ml
            axes.fill_between(at, *edges, color=_BAND, linewidth=0, label="95 % band of the true curve")
        for name in (name for name in ("measured", *colours) if name in of):
            colour, width = ("black", 2.2) if name == "measured" else (_colour(colours.index(name)), 1.5)
            axes.plot(at, of[name].volume_above_ml, color=colour, linewidth=width, label=name)
        for edge in strains:
            axes.axvline(edge, color="#9aa5b1", linewidth=0.9, linestyle=":")
        axes.set(xlim=(0.0, at[-1]), ylim=(0.0, None))
        label_axes(axes, "maximum shear strain", "volume above this strain, mL", title)
    spots[0].legend(fontsize=9, frameon=False)
    return figure


def _colour(number: int) -> str:
    return REGION_COLOURS[number % (len(REGION_COLOURS) - 1)]


def curves_by_load(curves: Sequence[Curve], strains: tuple[float, float]) -> Figure:
    """Strain-volume curves of one tissue, measured (black) and simulated, one panel for each load.

    The grey band contains the true curve in 95 % of cases. Areas are computed between the dotted lines.
    """
    models = [name for name in dict.fromkeys(c.field for c in curves) if name not in ("measured", LOWER, UPPER)]
    return _curves(curves, "load", strains, models)


def all_loads(curves: Sequence[Curve], strains: tuple[float, float]) -> bytes:
    """Volume of tissue in which the maximum shear strain exceeds a value, for each load: measured (black), simulated.

    The grey band contains the true curve in 95 % of cases. Areas are computed between the dotted lines.
    """
    return png_bytes(curves_by_load(curves, strains))


def areas_by_load(areas: Sequence[Area]) -> Figure:
    """Area between strain-volume curves by load and model: estimate with 95 % interval, or as measured if unknown."""
    models, loads = (list(dict.fromkeys(getattr(a, of) for a in areas)) for of in ("model", "load"))
    figure, (axes,) = chart()
    width = 0.6 / len(models)
    for number, model in enumerate(models):
        rows = [a for a in areas if a.model == model]
        at = [loads.index(a.load) + (number - 0.5 * (len(models) - 1)) * width for a in rows]
        axes.plot(at, [a.best_ml for a in rows], "o", color=_colour(number), label=model)
        axes.vlines(at, [a.low_ml for a in rows], [a.high_ml for a in rows], color=_colour(number), linewidth=1.8)
    axes.set_xticks(range(len(loads)), loads)
    axes.set(xlim=(-0.5, len(loads) - 0.5), ylim=(0.0, None))
    label_axes(axes, "", "area between strain-volume curves, mL")
    axes.legend(fontsize=9, frameon=False)
    return figure


def _by_model(count: int) -> tuple[Figure, list[Axes]]:
    """Square panels."""
    columns = min(count, _COLUMNS)
    width = WIDTH_IN if columns > 1 else 0.62 * WIDTH_IN
    return panels(count, columns, (width, width / columns))


def slices(one: LoadComparison, measured: Deformation, u_mm: Mapping[str, FloatArray], point_mm: FloatArray) -> bytes:
    """Maximum shear strain in a slice, measured and simulated, on the deformed tissue.

    The slice contains the plate's normal and the direction of shear. All panels show the same cells with one colour
    scale; grey is undefined. Nodes outside the measurement are drawn with the displacement of the nearest node inside.
    Letters name the sides of the body: A anterior, P posterior, S superior, I inferior, R right, L left.
    """
    return png_bytes(slice_sheet(one.fields.mesh, slice_panels(one.fields, measured, u_mm), one.case.axes, point_mm))


def slice_panels(fields: MappedFields, measured: Deformation, u_mm: Mapping[str, FloatArray]) -> list[Slice]:
    """Panels of `slices`: the measurement, then each model, with its displacement (n, 3) at the mesh's nodes."""
    u = filled_from_nearest(measured.displacement(fields.mesh.points_mm), fields.mesh.points_mm)
    measured_panel = Slice("measured", u, fields.measured.max_shear)
    return [measured_panel] + [Slice(name, u_mm[name], field.max_shear) for name, field in fields.models.items()]


def scatter(fields: MappedFields) -> bytes:
    """Simulated over measured maximum shear strain, cell by cell; darker is more volume (logarithmic).

    On the line, both are equal.
    """
    figure, spots = _by_model(len(fields.models))
    where = fields.common
    x, volumes = fields.measured.max_shear[where], fields.volumes_ml[where]
    most = max(0.1, *(float(np.quantile(f.max_shear[where], 0.995)) for f in fields.by_name.values()))
    for spot, (name, field) in zip(spots, fields.models.items(), strict=True):
        y, ranges = field.max_shear[where], ((0.0, most), (0.0, most))
        spot.hist2d(x, y, bins=_BINS, range=ranges, weights=volumes, norm="log", cmap="Blues")
        spot.plot([0.0, most], [0.0, most], color=INK, linewidth=0.9)
        spot.set_aspect("equal")
        label_axes(spot, "measured", "simulated", name)
    return png_bytes(figure)


def differences(one: LoadComparison, quantity: str) -> bytes:
    """Bland-Altman plot: simulated minus measured over the mean of both, cell by cell; darker is more volume.

    The solid line is the mean difference, dashed lines are the limits of agreement, 1.96 standard deviations away.
    """
    fields, where, unit = one.fields, one.fields.common, "" if quantity == "max_shear" else ", mm"
    limits = [row for row in one.agreements if (row.quantity, row.part) == (quantity, ALL)]
    figure, spots = _by_model(max(1, len(limits)))
    for spot, row in zip(spots, limits, strict=False):
        x, y = (
            field.max_shear[where] if quantity == "max_shear" else np.linalg.norm(field.u_mm[where], axis=1)
            for field in (fields.measured, fields.models[row.model])
        )
        spot.hist2d(0.5 * (x + y), y - x, bins=_BINS, weights=fields.volumes_ml[where], norm="log", cmap="Blues")
        for height, style in ((row.bias, "-"), (row.lower, "--"), (row.upper, "--")):
            spot.axhline(height, color=INK, linewidth=0.9, linestyle=style)
        label_axes(spot, f"mean of both{unit}", f"simulated - measured{unit}", row.model)
    return png_bytes(figure)


def over_subjects(shares: Mapping[str, Mapping[str, float]], models: Sequence[str]) -> bytes:
    """Normalised area between strain-volume curves of each subject (points) by model; the bar is the mean.

    Lines connect the models of one subject.
    """
    figure, (axes,) = chart()
    subjects = list(dict.fromkeys(s for model in models for s in shares[model]))
    for number, subject in enumerate(subjects):
        points = [(at, 100.0 * shares[m][subject]) for at, m in enumerate(models) if subject in shares[m]]
        colour = REGION_COLOURS[number % len(REGION_COLOURS)]
        axes.plot(*zip(*points, strict=True), "o-", color=colour, linewidth=0.8, markersize=4, label=subject)
    for at, model in enumerate(models):
        mean = 100.0 * float(np.mean(list(shares[model].values())))
        axes.plot([at - 0.25, at + 0.25], [mean, mean], color=INK, linewidth=2.5)
    axes.set_xticks(range(len(models)), list(models), rotation=30, ha="right")
    axes.set_ylim(bottom=0.0)
    label_axes(axes, "", "normalised area, %")
    if len(subjects) <= len(REGION_COLOURS):
        axes.legend(fontsize=8, frameon=False)
    return png_bytes(figure)
