"""The section of a report on standard metrics: image decomposition (CWA 16799), modified area validation metric."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from dvc.report.chart import label_axes, legend_above, panels
from dvc.report.drawing import Columns, Drawing
from dvc.report.page import Cell, Picture, Section, Table
from dvc.report.style import BAND, INK
from validate.decomposition import Decomposition, Representation
from validate.figures import model_looks
from validate.load_comparison import NOTHING, LoadComparison

_PANELS = 4  # tissues that are drawn, the largest first


def drawing(one: LoadComparison, models: Sequence[str]) -> Drawing | None:
    """The coefficients of one load; None where the measurement uncertainty is unknown."""
    if not one.decompositions:
        return None
    return Drawing.of(
        "Coefficients of the strain", coefficients, one.decompositions, models, data=columns_of(one.decompositions)
    )


def coefficients(decompositions: Mapping[str, Decomposition], models: Sequence[str]) -> Figure:
    """Coefficients of the maximum shear strain in each tissue: simulated over measured, bias removed.

    On the line both are equal. The grey band has the width that CWA 16799 gives to all coefficients. Bars are
    the expanded uncertainty of each measured coefficient: a model represents those whose bar reaches the line.
    """
    tissues = list(decompositions)[:_PANELS]
    figure, spots = panels(len(tissues))
    look = model_looks(models)
    for axes, tissue in zip(spots, tissues, strict=True):
        by = decompositions[tissue]
        of_models = {name: found.coefficients for name, found in by.models.items() if name in look}
        shown = np.concatenate([by.estimate, *of_models.values()])
        line = np.array([shown.min() - by.guide_band, shown.max() + by.guide_band])
        edges = line - by.guide_band, line + by.guide_band
        axes.fill_between(line, *edges, **BAND, label="band of CWA 16799")
        axes.plot(line, line, color=INK, linewidth=0.9)
        for name, values in of_models.items():
            colour = look[name].colour
            axes.hlines(values, by.estimate - by.band, by.estimate + by.band, color=colour, linewidth=0.6)
            axes.plot(by.estimate, values, **look[name].marked | {"linestyle": "none", "markersize": 3, "label": name})
        axes.set(xlim=line, ylim=line)
        label_axes(axes, "measured coefficient, no unit", "simulated coefficient, no unit", tissue)
    legend_above(spots[0])
    return figure


def columns_of(decompositions: Mapping[str, Decomposition]) -> Columns:
    """A row for each coefficient of each model and tissue; the first is that of the mean."""
    head = ("tissue", "model", "number", "measured", "estimate", "expanded_uncertainty", "simulated")
    rows = [
        (tissue, name, number, *values)
        for tissue, by in decompositions.items()
        for name, of in by.models.items()
        for number, values in enumerate(
            zip(by.measured.coefficients, by.estimate, by.band, of.coefficients, strict=True), start=1
        )
    ]
    return dict(zip(head, zip(*rows, strict=True), strict=True))


def section(one: LoadComparison, picture: Picture | None) -> Section:
    """The folded section of one load, the answer first."""
    tables = (*((_representations(one),) if one.decompositions else ()), _model_forms(one))
    pictures = () if picture is None else (picture,)
    return Section(f"{one.load}, standard metrics (CWA 16799, MAVM)", None, tables, pictures, answer(one), folded=True)


def answer(one: LoadComparison) -> tuple[str, ...]:
    """Sentences on the best model in the largest tissue."""
    if not one.decompositions:
        return (
            "The measurement has no error model, so its uncertainty is unknown and fields are not decomposed: it is "
            "not known whether a model represents the measurement within its uncertainty.",
        )
    names = [a.model for a in one.ranked()] or list(one.fields.models)
    tissue = next(iter(one.decompositions))
    rows = {r.model: r for r in one.representations if r.tissue == tissue}
    best, nothing = rows[names[0]], rows[NOTHING]
    return (
        f"In {tissue}, the largest tissue, the probability that the model represents the measurement is "
        f"{100.0 * best.probability:.0f} % for {best.model} and {100.0 * nothing.probability:.0f} % for no "
        "deformation; similar values mean that this metric does not distinguish them. "
        f"{best.in_band} of the {best.coefficients} coefficients of {best.model} lie within their uncertainty. "
        "The probability can differ from this share, because coefficients are weighted by the size of their error.",
        _accepted(best),
        f"CWA 16799 gives one uncertainty to all coefficients; with it, the probability is "
        f"{100.0 * best.guide_probability:.0f} % for {best.model} and {100.0 * nothing.guide_probability:.0f} % for no "
        "deformation. In three dimensions, this uncertainty is larger than most coefficients, so the probability "
        "above, with an uncertainty for each coefficient, is more informative.",
    )


def _accepted(of: Representation) -> str:
    functions = f"The measured strain in {of.tissue} was reconstructed from {of.coefficients} coefficients"
    clusters = f"{of.clusters} cluster{'' if of.clusters == 1 else 's'} above three times the residual"
    figures = f"residual {of.u_rec:.3f}, measurement uncertainty {of.u_cal:.3f}, {clusters}"
    if of.accepted:
        return f"{functions}, which CWA 16799 accepts ({figures})."
    what = "The probability applies only to the part of the strain that these coefficients represent."
    return f"{functions}, which CWA 16799 does not accept ({figures}). {what}"


def _representations(one: LoadComparison) -> Table:
    def cells(nothing: bool) -> tuple[tuple[Cell, ...], ...]:
        return tuple(
            (r.model, r.tissue, f"{100.0 * r.probability:.0f}", f"{r.in_band} / {r.coefficients}", r.u_rec, r.u_cal,
             r.clusters, "yes" if r.accepted else "no", r.model_u_rec, f"{100.0 * r.guide_probability:.0f}")
            for r in one.representations if (r.model == NOTHING) == nothing
        )  # fmt: skip

    return Table(
        "Image decomposition, by tissue",
        ("model", "tissue", "probability, %", "within uncertainty", "residual", "uncertainty", "clusters", "accepted",
         "residual of the model", "probability by CWA 16799, %"),
        cells(nothing=False),
        "Probability that the simulated maximum shear strain represents the measured one within its uncertainty "
        "(Dvurecenska and others 2018), from coefficients of orthonormal functions on the tissue's cells. Within "
        "uncertainty: coefficients within the expanded uncertainty of each. Accepted: the residual of the measured "
        "field is within the measurement uncertainty, and no cluster of cells with more than three times the residual "
        "fills 0.3 % of the tissue.",
        cells(nothing=True),
    )  # fmt: skip


def _model_forms(one: LoadComparison) -> Table:
    def cells(nothing: bool) -> tuple[tuple[Cell, ...], ...]:
        return tuple(
            (m.model, m.tissue, *(round(v, 4) for v in (m.measured_mean, m.mean, m.low, m.high, m.d_plus, m.d_minus)))
            for m in one.model_forms if (m.model == NOTHING) == nothing
        )  # fmt: skip

    return Table(
        "Modified area validation metric, by tissue",
        ("model", "tissue", "measured mean", "model mean", "lower", "upper", "d+", "d−"),
        cells(nothing=False),
        "Over all strains, as measured: d+ is the area between the distributions where the measured maximum shear "
        "strain is larger, d− where it is smaller (Voyles and Roy 2015). Lower, upper: interval of the mean, from "
        "model mean − d− to model mean + d+; that of a percentile is found in the same way. These intervals "
        "have no stated coverage; that of the mean contains the measured mean by construction. The factor "
        "for few samples is not used, because cells are not samples.",
        cells(nothing=True),
    )
