"""Figures of curves and points: empty panels, their axes and their legend, all in the one style."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties

from dvc.report.style import DPI, FAMILY, FONT, GRID, INK, SMALL_PT, WIDTH_IN

_ONE_ROW = 5  # entries of a legend, at most


def chart(panels: int = 1, page_wide: bool = False) -> tuple[Figure, tuple[Axes, ...]]:
    """An empty figure with so many axes side by side, for curves; each a part of the page's width, or all that wide."""
    figure = empty((WIDTH_IN, 3.8) if page_wide else (0.62 * WIDTH_IN * panels, 3.9), layout="constrained")
    return figure, tuple(figure.subplots(1, panels, squeeze=False)[0])


def panels(count: int, most: int = 2, size_in: tuple[float, float] = (WIDTH_IN, 3.4)) -> tuple[Figure, list[Axes]]:
    """A figure of so many panels, at ``most`` so many in a row, each row of a width and height."""
    rows, columns = -(-count // most), min(count, most)
    figure = empty((size_in[0], size_in[1] * rows), layout="constrained")
    spots = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for spot in spots[count:]:
        spot.set_visible(False)
    return figure, spots[:count]


def empty(size_in: tuple[float, float], **how: Any) -> Figure:
    """An empty figure."""
    figure = Figure(figsize=size_in, dpi=DPI, facecolor="white", **how)
    FigureCanvasAgg(figure)
    return figure


def label_axes(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Name the axes of a panel, give it a title, and draw its grid."""
    if title:
        axes.set_title(title, color=INK, **FONT)
    axes.set_xlabel(x, color=INK, **FONT)
    axes.set_ylabel(y, color=INK, **FONT)
    axes.grid(True, color=GRID, linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    number_axes(axes)


def number_axes(axes: Axes) -> None:
    """Set the numbers at a panel's axes."""
    axes.tick_params(labelsize=SMALL_PT, labelfontfamily=FAMILY, labelcolor=INK, which="both")


def legend(axes: Axes, *, loc: Any = "best", **where: Any) -> None:
    """Give a panel its legend, if anything in it has a label; lines beneath it are hardly seen.

    With a place that is asked for, if only "best", matplotlib does not warn where a busy machine takes a second for it.
    """
    if axes.get_legend_handles_labels()[0]:
        ground = {"facecolor": "white", "edgecolor": "none", "framealpha": 0.9}
        axes.legend(prop=_legend_font(), labelcolor=INK, loc=loc, **ground, **where)


def legend_above(axes: Axes) -> None:
    """Put the legend of a panel above all panels of its figure, where it hides no line; in one row if it is short."""
    handles, labels = axes.get_legend_handles_labels()
    columns = len(labels) if len(labels) <= _ONE_ROW else _ONE_ROW - 1
    _figure_of(axes).legend(
        handles, labels, loc="outside upper center", ncols=columns, frameon=False, prop=_legend_font(), labelcolor=INK
    )


def _legend_font() -> FontProperties:
    return FontProperties(family=FAMILY, size=SMALL_PT)


def colour_bar(axes: Axes, mapped: ScalarMappable, label: str, extend: str = "neither") -> None:
    """Draw a horizontal colour bar that fills a panel."""
    bar = _figure_of(axes).colorbar(mapped, cax=axes, orientation="horizontal", extend=extend)
    bar.set_label(label, color=INK, labelpad=2, **FONT)
    axes.tick_params(labelsize=SMALL_PT, labelfontfamily=FAMILY, labelcolor=INK, length=3, pad=2)
    _as_image(bar, (*axes.get_xlim(), 0.0, 1.0))


def shared_bar(axes: Sequence[Axes], mapped: ScalarMappable, label: str) -> None:
    """Draw the vertical colour bar of several panels of a chart, beside them."""
    bar = _figure_of(axes[0]).colorbar(mapped, ax=axes, shrink=0.8, format="%g")
    bar.set_label(label, color=INK, **FONT)
    number_axes(bar.ax)


def _figure_of(axes: Axes) -> Figure:
    figure = axes.get_figure(root=True)
    assert figure is not None
    return figure


def _as_image(bar: Colorbar, extent: tuple[float, float, float, float]) -> None:
    """Put one image in the place of a horizontal bar's 256 pieces, which take a PDF longer than all the rest."""
    assert bar.solids is not None
    bar.solids.set_visible(False)
    colours = np.linspace(*extent[:2], bar.cmap.N)[None]
    bar.ax.imshow(colours, cmap=bar.cmap, norm=bar.norm, extent=extent, aspect="auto")
