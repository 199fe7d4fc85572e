"""Figures of a comparison; the docstring of each is its caption."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from dvc import Deformation
from dvc.arrays import FloatArray
from dvc.report.chart import chart, label_axes, legend, legend_above, panels, shared_bar
from dvc.report.drawing import Columns
from dvc.report.style import BAND, INK, WIDTH_IN, Look, looks
from fe import published_names
from fe.figures import Slice, slice_sheet
from validate.curves import Area
from validate.extrapolation import LEVELLED
from validate.load_comparison import LoadComparison
from validate.mapping import ALL, MappedFields, filled_from_nearest
from validate.tables import LOWER, UPPER, Curve, curves_of

_POINTS, _COLUMNS, _BINS, _NAMED = 601, 3, 60, 16
_MAX_SHEAR = "maximum shear strain, no unit"


def model_looks(models: Iterable[str]) -> dict[str, Look]:
    """A look for each model: the published material sets have theirs in every figure; a levelled model is dotted."""
    names = list(models)
    sets = [name for name in published_names() if not name.endswith("-as-published")]
    plain = looks((name.removesuffix(LEVELLED) for name in names), sets)
    own = {name: plain[name.removesuffix(LEVELLED)] for name in names}
    return {name: look.dotted if name.endswith(LEVELLED) else look for name, look in own.items()}


def volume_strain(one: LoadComparison, tissues: Sequence[str], models: Sequence[str]) -> Figure:
    """Volume of tissue in which the maximum shear strain exceeds a value: measured (black) and models, same cells.

    Grey: 95 % band of the true curve, if the measurement uncertainty is known. The area metric is computed
    between the two dotted lines.
    """
    curves = curves_of(one, np.linspace(0.0, 1.5 * one.criteria.strains[1], _POINTS))
    return _curves([c for c in curves if c.tissue in tissues], "tissue", one.criteria.strains, models)


def _curves(curves: Iterable[Curve], by: str, strains: tuple[float, float], models: Sequence[str]) -> Figure:
    """Curves, one panel for each load or tissue."""
    by_panel: dict[str, dict[str, Curve]] = {}
    for curve in curves:
        by_panel.setdefault(getattr(curve, by), {})[curve.field] = curve
    figure, spots = panels(len(by_panel))
    look = model_looks(models)
    for axes, (title, of) in zip(spots, by_panel.items(), strict=True):
        at = of["measured"].max_shear
        if LOWER in of:
            edges = of[LOWER].volume_above_ml, of[UPPER].volume_above_ml
            axes.fill_between(at, *edges, **BAND, label="95 % band of the true curve")
        for name in (name for name in ("measured", *models) if name in of):
            how = {"color": "black", "linewidth": 2.4} if name == "measured" else look[name].line
            axes.plot(at, of[name].volume_above_ml, label=name, **how)
        for edge in strains:
            axes.axvline(edge, color=INK, linewidth=1.1, linestyle=":")
        axes.set(xlim=(0.0, at[-1]), ylim=(0.0, None))
        label_axes(axes, _MAX_SHEAR, "volume above this strain, mL", title)
    legend_above(spots[0])
    return figure


def curves_by_load(curves: Sequence[Curve], strains: tuple[float, float]) -> Figure:
    """Strain-volume curves, measured (black) and simulated, one panel for each load.

    Grey: 95 % band of the true curve, if the measurement uncertainty is known. The area metric is computed between the
    two dotted lines.
    """
    models = [name for name in dict.fromkeys(c.field for c in curves) if name not in ("measured", LOWER, UPPER)]
    return _curves(curves, "load", strains, models)


def areas_by_load(areas: Sequence[Area]) -> Figure:
    """Area between strain-volume curves by load and model: estimate with 95 % interval, or as measured if unknown."""
    models, loads = (list(dict.fromkeys(getattr(a, of) for a in areas)) for of in ("model", "load"))
    figure, (axes,) = chart()
    look, width = model_looks(models), 0.6 / len(models)
    for number, model in enumerate(models):
        rows = [a for a in areas if a.model == model]
        at = [loads.index(a.load) + (number - 0.5 * (len(models) - 1)) * width for a in rows]
        of = look[model]
        axes.plot(at, [a.best_ml for a in rows], **of.marked | {"linestyle": "none", "label": model})
        axes.vlines(at, [a.low_ml for a in rows], [a.high_ml for a in rows], color=of.colour, linewidth=1.8)
    axes.set_xticks(range(len(loads)), loads)
    axes.set(xlim=(-0.5, len(loads) - 0.5), ylim=(0.0, None))
    label_axes(axes, "", "area between strain-volume curves, mL")
    legend(axes)
    return figure


def slices(
    one: LoadComparison, measured: Deformation, u_mm: Mapping[str, FloatArray], point_mm: FloatArray, largest: float
) -> Figure:
    """Maximum shear strain in a slice, measured and simulated, on the deformed tissue.

    The slice contains the plate's normal and the direction of shear. All panels show the same cells. Grey: no result.
    Nodes outside the measurement are drawn with the displacement of the nearest node inside. Letters name the sides of
    the body: A anterior, P posterior, S superior, I inferior, R right, L left.
    """
    return slice_sheet(one.fields.mesh, slice_panels(one.fields, measured, u_mm), one.case.axes, point_mm, largest)


def slice_panels(fields: MappedFields, measured: Deformation, u_mm: Mapping[str, FloatArray]) -> list[Slice]:
    """Panels of `slices`: the measurement, then each model, with its displacement (n, 3) at the mesh's nodes."""
    u = filled_from_nearest(measured.displacement(fields.mesh.points_mm), fields.mesh.points_mm)
    measured_panel = Slice("measured", u, fields.measured.max_shear)
    return [measured_panel] + [Slice(name, u_mm[name], field.max_shear) for name, field in fields.models.items()]


@dataclass(frozen=True, slots=True, eq=False)
class Bins:
    """Volume of tissue, mL (x, y), by two figures of a cell, in squares of equal size."""

    x: FloatArray  # edges
    y: FloatArray
    volume_ml: FloatArray

    @classmethod
    def of(
        cls, x: FloatArray, y: FloatArray, volumes_ml: FloatArray, reach: tuple[tuple[float, float], ...] | None = None
    ) -> Self:
        """Cells (n,) in their squares, over all or within a range of each figure."""
        volume, edges, up = np.histogram2d(x, y, bins=_BINS, range=reach, weights=volumes_ml)
        return cls(edges, up, volume)

    def columns(self, x: str, y: str) -> dict[str, list[float]]:
        """The middle of each square that holds any tissue, by the names of the figures, and its volume."""
        i, j = np.nonzero(self.volume_ml)
        middles = (0.5 * (edges[1:] + edges[:-1]) for edges in (self.x, self.y))
        named = {name: of[at].tolist() for name, of, at in zip((x, y), middles, (i, j), strict=True)}
        return named | {"volume_ml": self.volume_ml[i, j].tolist()}


def agreement_bins(fields: MappedFields) -> dict[str, Bins]:
    """Measured and simulated maximum shear strain by model."""
    where = fields.common
    x, volumes = fields.measured.max_shear[where], fields.volumes_ml[where]
    most = max(0.1, *(float(np.quantile(f.max_shear[where], 0.995)) for f in fields.by_name.values()))
    reach = ((0.0, most), (0.0, most))
    return {name: Bins.of(x, field.max_shear[where], volumes, reach) for name, field in fields.models.items()}


def difference_bins(fields: MappedFields, quantity: str) -> dict[str, Bins]:
    """Mean and difference of simulated and measured strain, or of the length of the displacement, by model."""
    where, made = fields.common, dict[str, Bins]()
    for name, field in fields.models.items():
        x, y = (
            of.max_shear[where] if quantity == "max_shear" else np.linalg.norm(of.u_mm[where], axis=1)
            for of in (fields.measured, field)
        )
        made[name] = Bins.of(0.5 * (x + y), y - x, fields.volumes_ml[where])
    return made


def columns_of(bins: Mapping[str, Bins], x: str, y: str) -> Columns:
    """The squares of all models one below the other."""
    each = {name: of.columns(x, y) for name, of in bins.items()}
    models = [name for name, columns in each.items() for _ in columns["volume_ml"]]
    joined = {key: [value for columns in each.values() for value in columns[key]] for key in (x, y, "volume_ml")}
    return {"model": models, **joined}


def scatter(bins: Mapping[str, Bins]) -> Figure:
    """Simulated over measured maximum shear strain, cell by cell; darker is more volume (logarithmic).

    On the line, both are equal.
    """
    figure, spots = _binned(bins)
    for spot, (name, of) in zip(spots, bins.items(), strict=True):
        spot.plot([0.0, of.x[-1]], [0.0, of.x[-1]], color=INK, linewidth=0.9)
        spot.set_aspect("equal")
        label_axes(spot, "measured max. shear, no unit", "simulated max. shear, no unit", name)
    return figure


def differences(bins: Mapping[str, Bins], one: LoadComparison, quantity: str) -> Figure:
    """Bland-Altman plot: simulated minus measured over the mean of both, cell by cell; darker is more volume.

    The solid line is the mean difference, dashed lines are the limits of agreement, 1.96 standard deviations away.
    """
    limits = {row.model: row for row in one.agreements if (row.quantity, row.part) == (quantity, ALL)}
    unit, what = ("no unit", "max. shear") if quantity == "max_shear" else ("mm", "displacement")
    figure, spots = _binned(bins)
    for spot, name in zip(spots, bins, strict=True):
        if name in limits:
            row = limits[name]
            for height, style in ((row.bias, "-"), (row.lower, "--"), (row.upper, "--")):
                spot.axhline(height, color=INK, linewidth=0.9, linestyle=style)
        label_axes(spot, f"mean {what}, {unit}", f"simulated − measured, {unit}", name)
    return figure


def _binned(bins: Mapping[str, Bins]) -> tuple[Figure, list[Axes]]:
    """A square panel for each model, all in the colours of one scale of volume."""
    columns = min(len(bins), _COLUMNS)
    width = WIDTH_IN if columns > 1 else 0.62 * WIDTH_IN
    figure, spots = panels(len(bins), columns, (width, width / columns))
    volumes = np.concatenate([of.volume_ml[of.volume_ml > 0.0] for of in bins.values()])
    norm, shades = LogNorm(volumes.min(), volumes.max()), colormaps["cividis_r"]
    for spot, of in zip(spots, bins.values(), strict=True):
        shown = np.ma.masked_equal(of.volume_ml.T, 0.0)
        extent = (of.x[0], of.x[-1], of.y[0], of.y[-1])
        how: dict[str, Any] = {"cmap": shades, "norm": norm, "interpolation": "nearest", "zorder": 1.0}
        spot.imshow(shown, origin="lower", extent=extent, aspect="auto", **how)  # above the grid
    shared_bar(spots, ScalarMappable(norm, shades), "volume in a square, mL")
    return figure, spots


def over_subjects(shares: Mapping[str, Mapping[str, float]], models: Sequence[str]) -> Figure:
    """Normalised area between strain-volume curves of each subject (points) by model; the bar is the mean.

    Lines connect the models of one subject.
    """
    figure, (axes,) = chart(page_wide=True)
    subjects = list(dict.fromkeys(s for model in models for s in shares[model]))
    for subject, look in looks(subjects).items():
        points = [(at, 100.0 * shares[m][subject]) for at, m in enumerate(models) if subject in shares[m]]
        axes.plot(*zip(*points, strict=True), label=subject, **look.marked | {"linewidth": 0.8, "markersize": 4})
    for at, model in enumerate(models):
        mean = 100.0 * float(np.mean(list(shares[model].values())))
        axes.plot([at - 0.25, at + 0.25], [mean, mean], color=INK, linewidth=2.5)
    axes.set_xticks(range(len(models)), list(models), rotation=30, ha="right")
    axes.set_ylim(bottom=0.0)
    label_axes(axes, "", "normalised area, %")
    if len(subjects) <= _NAMED:
        legend(axes, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
