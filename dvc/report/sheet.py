"""Slices in three planes through a point of a grid, and the page they are drawn on: panels at one scale, letters, bars.

Slices are shown as radiologists read them, whatever the grid's own axes: sagittal seen from the left (anterior on the
left of the page), coronal from the front and axial from below (the patient's right on the left). They are cut along the
grid's axes, never resampled; where those are oblique the titles say so.
"""

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from dvc.arrays import BoolArray, FloatArray
from dvc.errors import GeometryError
from dvc.images.image import Grid, Mask, reordered_to_lps

Plane = Literal["sagittal", "coronal", "axial"]
Values = npt.NDArray[Any]

PLANES: tuple[Plane, ...] = ("sagittal", "coronal", "axial")
# Axes of the L, P, S grid: the one cut, the one across the page, the one up or down it.
AXES: dict[Plane, tuple[int, int, int]] = {"sagittal": (0, 1, 2), "coronal": (1, 0, 2), "axial": (2, 0, 1)}
LETTERS: dict[Plane, str] = {"sagittal": "APSI", "coronal": "RLSI", "axial": "RLAP"}  # left, right, top, bottom
OBLIQUE_DEG = 3.0
_SIDES = ("RL", "AP", "IS")  # of the axes L, P, S: against it and along it
_LEAST_SHARE = 0.3827  # cosine of 67.5 degrees: half-way between one letter and two
DPI = 120
WIDTH_IN = 9.8
INK = "#1c2733"
UNSEEN = (0.16, 0.18, 0.30)  # a voxel without a value: neither black, which is dark tissue, nor a colour
SHADOW = [patheffects.withStroke(linewidth=2.2, foreground="black")]
FONT: dict[str, Any] = {"family": "DejaVu Sans", "fontsize": 10}
_GAP_IN, _TITLE_IN, _BAR_IN, _LEAST_WIDTH_IN = 0.10, 0.26, 0.62, 5.2
_MARK = "#FFD54A"


def letters(direction: npt.ArrayLike) -> str:
    """Side of the body to which a direction (3,) LPS points: letters of axes within 67.5 degrees of it, nearest first.

    >>> letters([0.0, -1.0, 0.0]), letters([0.0, -0.8, 0.6]), letters([0.1, 0.0, 0.99])
    ('A', 'AS', 'S')
    """
    unit = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    shown = [axis for axis in np.argsort(-np.abs(unit)) if abs(unit[axis]) > _LEAST_SHARE]
    return "".join(_SIDES[axis][int(unit[axis] > 0.0)] for axis in shown)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Which slices of a grid are shown, and how much of them."""

    grid: Grid  # of every array that is drawn through this view
    index: tuple[int, int, int]  # the three slices, counted along the axes closest to L, P, S
    box: tuple[slice, slice, slice]  # the part shown, along the same axes

    @classmethod
    def through(
        cls, grid: Grid, point_mm: npt.ArrayLike, around: BoolArray | None = None, margin_mm: float = 8.0
    ) -> Self:
        """The slices nearest to a point, LPS mm, cropped to a mask and a margin around it, or the whole of them.

        GeometryError if the point lies outside the grid, or the mask has another shape.
        """
        lps = grid.toward_lps()
        point = np.asarray(point_mm, dtype=np.float64)
        if point.shape != (3,) or not bool(lps.contains(point)):
            where = f"LPS {point.tolist()} mm, is outside the image ({grid})"
            raise GeometryError(f"The point to show, {where}. Choose a point inside.")
        nearest = np.clip(np.rint(lps.indices_of(point)), 0, np.array(lps.shape) - 1).astype(int)
        spans = [slice(0, n) for n in lps.shape]
        if around is not None and around.any():
            for axis, held in enumerate(Mask(grid, around).toward_lps().box()):
                edge = round(margin_mm / lps.spacing_mm[axis])
                low, high = min(held.start, nearest[axis]) - edge, max(held.stop - 1, nearest[axis]) + edge + 1
                spans[axis] = slice(max(0, int(low)), min(lps.shape[axis], int(high)))
        i, j, k = (int(n) for n in nearest)
        return cls(grid, (i, j, k), (spans[0], spans[1], spans[2]))

    def cut(self, values: Values, plane: Plane) -> Values:
        """The slice of an array on the grid as it lies on the page: rows downward, columns to the right."""
        at = AXES[plane][0]
        page = np.take(self.shown(values), self.index[at] - self.box[at].start, axis=at).swapaxes(0, 1)
        return np.asarray(page if plane == "axial" else page[::-1])

    def shown(self, values: Values) -> Values:
        """The part of an array inside the box, axes closest to L, P, S; GeometryError for one of another shape."""
        if values.shape[:3] != self.grid.shape:
            shapes = f"of shape {values.shape} cannot be shown on a grid of shape {self.grid.shape}"
            raise GeometryError(f"An array {shapes}; resample it to that grid first.")
        return reordered_to_lps(self.grid, values)[self.box]

    def extent_mm(self, plane: Plane) -> tuple[float, float, float, float]:
        """Left, right, bottom and top of the slice, mm along the grid's axes from its first voxel's centre."""
        _, across, along = AXES[plane]
        spacing = self.grid.toward_lps().spacing_mm
        ends = [[(n - 0.5) * spacing[a] for n in (self.box[a].start, self.box[a].stop)] for a in (across, along)]
        (left, right), (low, high) = ends
        return (left, right, high, low) if plane == "axial" else (left, right, low, high)

    def title(self, plane: Plane) -> str:
        """The plane with the position of the cut, or with the tilt of oblique axes."""
        lps, cut = self.grid.toward_lps(), AXES[plane][0]
        tilt = float(np.degrees(np.arccos(np.clip(lps.direction[cut, cut], -1.0, 1.0))))
        if tilt > OBLIQUE_DEG:
            return f"{plane.capitalize()}, along image axes (tilted {tilt:.0f}°)"
        at = lps.points_at(np.array(self.index, dtype=np.float64))[cut]
        return f"{plane.capitalize()}, {'xyz'[cut]} = {at:z.0f} mm".replace("-", "\u2212")


class Sheet:
    """Rows of slices at one scale, with letters, a scale bar, and yellow marks where the other planes cut.

    A title stands above each row, if it is not empty; the planes are its columns; ``bar`` keeps room for a colour bar.
    """

    def __init__(self, view: View, titles: Sequence[str], planes: Sequence[Plane] = PLANES, bar: bool = False) -> None:
        self.view = view
        sizes = [(right - left, abs(top - bottom)) for left, right, bottom, top in map(view.extent_mm, planes)]
        widths, heights = zip(*sizes, strict=True)
        gaps = _GAP_IN * (len(planes) - 1)
        tallest = 4.6 if len(titles) == 1 else 3.6
        inches = min((WIDTH_IN - gaps) / sum(widths), tallest / max(heights))  # per mm, everywhere
        width = max(_LEAST_WIDTH_IN, inches * sum(widths) + gaps)
        strip = _TITLE_IN * (2 if any(titles) else 1)
        height = len(titles) * (inches * max(heights) + strip) + (_BAR_IN if bar else 0.0) + 0.04
        self.figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white")
        FigureCanvasAgg(self.figure)
        self.rows: list[dict[Plane, Axes]] = []
        indent, top = (width - inches * sum(widths) - gaps) / 2, height
        for title in titles:
            if title:
                at = (indent / width, (top - 0.8 * _TITLE_IN) / height)
                self.figure.text(*at, title, weight="bold", color=INK, **FONT)
            left, top = indent, top - strip
            row: dict[Plane, Axes] = {}
            for plane, w, h in zip(planes, widths, heights, strict=True):
                box = (left / width, (top - h * inches) / height, w * inches / width, h * inches / height)
                row[plane] = self.figure.add_axes(box, xticks=[], yticks=[], facecolor="black")
                row[plane].set_title(view.title(plane), loc="left", pad=3, color=INK, fontsize=9.5)
                left += w * inches + _GAP_IN
            top -= inches * max(heights)
            self.rows.append(row)
        length = min(4.2, 0.6 * width)
        self._bar = ((width - length) / 2 / width, 0.42 / height, length / width, 0.13 / height)

    def paint(self, plane: Plane, axes: Axes, page: Values, **how: Any) -> None:
        """Lay a page down; whatever follows is drawn over it."""
        axes.imshow(page, extent=self.view.extent_mm(plane), origin="upper", aspect="equal", **how)

    def grey(self, plane: Plane, axes: Axes, image: Values, window: tuple[float, float]) -> None:
        """Lay down a slice of an MR image."""
        shades = colormaps["gray"].with_extremes(bad=UNSEEN)
        page = np.ma.masked_invalid(self.view.cut(image, plane))
        self.paint(plane, axes, page, cmap=shades, vmin=window[0], vmax=window[1])

    def colours(self, plane: Plane, axes: Axes, values: Values, shades: Colormap, norm: Normalize) -> None:
        """Lay down a slice of a scalar in colour; where it is NaN, what lies below stays plain."""
        page = np.ma.masked_invalid(self.view.cut(values, plane))
        self.paint(plane, axes, page, cmap=shades, norm=norm, alpha=0.85, interpolation="nearest")

    def outlines(self, plane: Plane, axes: Axes, pages: Iterable[BoolArray], colour: str = "white") -> None:
        """Draw the borders of masks, given as pages of this plane, as thin lines."""
        outline(axes, self.view.extent_mm(plane), pages, colour)

    def bar(self, shades: Colormap, norm: Normalize, label: str, extend: str = "neither") -> None:
        """Draw the one colour bar of the sheet, below the panels."""
        axes, scale = self.figure.add_axes(self._bar), ScalarMappable(norm, shades)
        bar = self.figure.colorbar(scale, cax=axes, orientation="horizontal", extend=extend)
        bar.set_label(label, color=INK, labelpad=2, **FONT)
        bar.ax.tick_params(labelsize=9, length=3, pad=2)

    def png(self) -> bytes:
        """Finish the sheet and return the file's bytes."""
        return png_bytes(self.finished())

    def finished(self) -> Figure:
        """Add letters, marks and the scale bar, and return the figure."""
        spacing = self.view.grid.toward_lps().spacing_mm
        for row in self.rows:
            for number, (plane, axes) in enumerate(row.items()):
                left, right, bottom, top = self.view.extent_mm(plane)
                axes.set(xlim=(left, right), ylim=(bottom, top))
                white: dict[str, Any] = {"color": "white", "path_effects": SHADOW, "transform": axes.transAxes}
                _, across, along = AXES[plane]
                marks = [float(self.view.index[a] * spacing[a]) for a in (across, along)]
                for mark, line in zip(marks, (axes.axvline, axes.axhline), strict=True):
                    for low, high in ((0.0, 0.035), (0.965, 1.0)):
                        line(mark, low, high, color=_MARK, linewidth=1.2)
                x, y = _beside((marks[0] - left) / (right - left)), _beside((marks[1] - bottom) / (top - bottom))
                sides = (0.012, y, "left", "center"), (0.988, y, "right", "center")
                spots = *sides, (x, 0.988, "center", "top"), (x, 0.012, "center", "bottom")
                for letter, (x, y, ha, va) in zip(LETTERS[plane], spots, strict=True):
                    axes.text(x, y, letter, ha=ha, va=va, weight="bold", zorder=9, **white, **FONT)
                if number == 0:
                    scale_bar(axes, right - left)
        return self.figure


def outline(
    axes: Axes, extent_mm: tuple[float, float, float, float], pages: Iterable[BoolArray], colour: str = "white"
) -> None:
    """Draw the borders of masks, given as pages that fill an extent (left, right, bottom, top), as thin lines."""
    left, right, bottom, top = extent_mm
    for page in pages:
        if page.any() and not page.all() and min(page.shape) > 1:
            rows, columns = page.shape
            x = left + (np.arange(columns) + 0.5) * (right - left) / columns
            y = top + (np.arange(rows) + 0.5) * (bottom - top) / rows
            axes.contour(x, y, page.astype(float), levels=[0.5], colors=[colour], linewidths=0.9)


def scale_bar(axes: Axes, width_mm: float) -> None:
    """Draw a bar of a round length in the lower left corner of a panel that is so wide."""
    white: dict[str, Any] = {"color": "white", "path_effects": SHADOW, "transform": axes.transAxes}
    length = scale_length_mm(width_mm)
    axes.plot([0.03, 0.03 + length / width_mm], [0.035, 0.035], linewidth=2.5, solid_capstyle="butt", **white)
    axes.text(0.03, 0.05, f"{length:g} mm", va="bottom", fontsize=9, **white)


def _beside(mark: float) -> float:
    """The middle of a side, 0 to 1, or a place beside it where a mark stands there."""
    return 0.5 if abs(mark - 0.5) > 0.05 else 0.42


def scale_length_mm(width_mm: float) -> float:
    """A round length, mm, of at most a third of a panel.

    >>> [scale_length_mm(w) for w in (14.0, 100.0)]
    [2.0, 20.0]
    """
    return max((n for n in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0) if n <= width_mm / 3), default=1.0)


def chart(panels: int = 1, page_wide: bool = False) -> tuple[Figure, tuple[Axes, ...]]:
    """An empty figure with so many axes side by side, for curves; each a part of the page's width, or all that wide."""
    size = (WIDTH_IN, 3.8) if page_wide else (0.62 * WIDTH_IN * panels, 3.9)
    figure = Figure(figsize=size, dpi=DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    return figure, tuple(np.atleast_1d(figure.subplots(1, panels)))


def panels(count: int, most: int = 2, size_in: tuple[float, float] = (WIDTH_IN, 3.4)) -> tuple[Figure, list[Axes]]:
    """A figure of so many panels, at ``most`` so many in a row, each row of a width and height."""
    rows, columns = -(-count // most), min(count, most)
    figure = Figure(figsize=(size_in[0], size_in[1] * rows), dpi=DPI, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
    spots = list(figure.subplots(rows, columns, squeeze=False).ravel())
    for spot in spots[count:]:
        spot.set_visible(False)
    return figure, spots[:count]


def label_axes(axes: Axes, x: str, y: str, title: str = "") -> None:
    """Name the axes of a panel, give it a title, and draw its grid."""
    axes.set_title(title, color=INK, **FONT)
    axes.set_xlabel(x, color=INK, **FONT)
    axes.set_ylabel(y, color=INK, **FONT)
    axes.grid(True, color="#d9dee4", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)


def png_bytes(figure: Figure) -> bytes:
    """A figure as a PNG file's bytes; equal figures give equal bytes."""
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=DPI, metadata={"Software": None})
    return file.getvalue()


def window_of(view: View, image: Values) -> tuple[float, float]:
    """The values drawn black and white: the 0.5th and 99.7th percentile of what is shown."""
    known = view.shown(image)
    known = known[np.isfinite(known)]
    low, high = np.percentile(known, (0.5, 99.7)) if known.size else (0.0, 1.0)
    return float(low), float(high if high > low else low + 1.0)


def levelled(page: Values, window: tuple[float, float]) -> FloatArray:
    """A page scaled to 0 to 1 within a window; NaN stays."""
    return np.clip((np.asarray(page, dtype=np.float64) - window[0]) / (window[1] - window[0]), 0.0, 1.0)
