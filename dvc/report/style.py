"""The one style of all figures: font, sizes, colours for all common kinds of colour vision, and looks.

The font is DejaVu Sans cut to the letters of Europe's languages, figures and signs (``fonts``, with its licence): a PDF
holds the font it is set in, and cutting it out of the whole one takes longer than drawing the figure. Letters that it
lacks come from DejaVu Sans itself, which comes with matplotlib.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any, Self
from zlib import crc32

from cycler import cycler
from matplotlib.font_manager import fontManager
from matplotlib.patheffects import withStroke

fontManager.addfont(str(files("dvc.report") / "fonts" / "mrstrainSans.ttf"))

WIDTH_IN = 9.8
"""Width of a page's figures; in a column of 7 inches their text of 10 pt is 7 pt."""
DPI = 120
"""Of the figures on the screen."""
FAMILY = ["mrstrain Sans", "DejaVu Sans"]
SMALL_PT = 9
FONT: dict[str, Any] = {"family": FAMILY, "fontsize": 10}
SMALL: dict[str, Any] = {"family": FAMILY, "fontsize": SMALL_PT}
"""Of numbers at an axis, legends and scale bars."""
INK = "#1c2733"
RULE, GRID = "#7d8894", "#d9dee4"
"""Greys of lines that mark a value, and of the grid."""
BAND: dict[str, Any] = {"facecolor": "#e3e7ec", "edgecolor": RULE, "linewidth": 0.8}
"""For `Axes.fill_between` and `Axes.axvspan`: a range of values, pale under the curves, with a rule at its edges."""
BOLD: dict[str, Any] = {"family": "DejaVu Sans", "weight": "bold", "fontsize": 10}
"""For letters with a rim alone, which a PDF holds as outlines."""
ON_DARK: dict[str, Any] = {"color": "white", "path_effects": [withStroke(linewidth=2.2, foreground="black")]}
ON_LIGHT: dict[str, Any] = {"color": INK, "path_effects": [withStroke(linewidth=2.2, foreground="white")]}
"""Of what is written over a picture."""

# Four of the palette of Okabe and Ito, then brown and violet: its black is the measurement's, and the contrast of its
# yellow, orange and sky blue on white is below 3:1.
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#7A4B00", "#7B2FE0")
_DASHES: tuple[Any, ...] = ("-", (0, (5.0, 1.6)), (0, (1.2, 1.2)), (0, (6.0, 1.5, 1.2, 1.5)))
_MARKERS = "os^DvPX"
_COUNT = len(_COLOURS) * len(_DASHES)
FIGURE_STYLE: dict[str, Any] = {
    "font.family": FAMILY,
    "font.size": 10,
    "axes.titlesize": 10,
    "legend.fontsize": SMALL_PT,
    "xtick.labelsize": SMALL_PT,
    "ytick.labelsize": SMALL_PT,
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK),
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(linestyle=_DASHES) * cycler(color=_COLOURS),
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.8,
    "lines.markersize": 5,
    "legend.frameon": False,
    "image.cmap": "viridis",
    "figure.constrained_layout.use": True,
}
"""The style for figures of one's own: ``matplotlib.pyplot.style.use(dvc.FIGURE_STYLE)``."""
TISSUES = ("bone", "muscle", "tendon", "skin", "fat", "ligament")
"""Tissues in the order of the looks that they always have."""


@dataclass(frozen=True, slots=True)
class Look:
    """How one thing looks wherever it is drawn: no two of 24 share colour and dashes."""

    colour: str
    dashes: Any
    marker: str

    @classmethod
    def numbered(cls, number: int) -> Self:
        """The look of a number, from 0 on; after 24 they begin anew."""
        colour, dashes = _COLOURS[number % len(_COLOURS)], _DASHES[number // len(_COLOURS) % len(_DASHES)]
        return cls(colour, dashes, _MARKERS[number % len(_MARKERS)])

    @property
    def dotted(self) -> Self:
        """The same with dots, for a variant of the thing."""
        return replace(self, dashes=_DASHES[2])

    @property
    def line(self) -> dict[str, Any]:
        """For `Axes.plot`: a line without marks."""
        return {"color": self.colour, "linestyle": self.dashes, "linewidth": 1.8}

    @property
    def marked(self) -> dict[str, Any]:
        """For `Axes.plot`: a line with marks."""
        return self.line | {"marker": self.marker, "markersize": 5}


def looks(names: Iterable[str], known: Sequence[str] = ()) -> dict[str, Look]:
    """A look for each name: the same in every figure, as far as no two names of one figure share it.

    A name has its place among the ``known`` ones, or by the number at its end (Load2), or from its letters.

    >>> tissues = looks(["heel pad", "fat"], TISSUES)
    >>> tissues["fat"] == looks(["skin", "fat"], TISSUES)["fat"], tissues["fat"] == tissues["heel pad"]
    (True, False)
    """
    found: dict[str, int] = {}
    places = {name.lower(): place for place, name in enumerate(known)}
    for name in sorted(dict.fromkeys(names), key=lambda one: one.lower() not in places):
        first = places.get(name.lower(), _place(name))
        free = (place % _COUNT for place in range(first, first + _COUNT) if place % _COUNT not in found.values())
        found[name] = next(free, first)
    return {name: Look.numbered(place) for name, place in found.items()}


def _place(name: str) -> int:
    number = re.search(r"\d{1,3}$", name)
    return max(0, int(number[0]) - 1) if number else crc32(name.encode()) % len(_COLOURS)
