"""Slices in three planes through a point of a grid, and the page they are drawn on: panels at one scale, letters, bars.

Slices are shown as radiologists read them, whatever the grid's own axes: sagittal seen from the left (anterior on the
left of the page), coronal from the front and axial from below (the patient's right on the left). They are cut along the
grid's axes, never resampled; where those are oblique the titles say so.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from dvc.arrays import BoolArray, FloatArray
from dvc.errors import GeometryError
from dvc.images.image import Grid, Mask, reordered_to_lps
from dvc.report.chart import colour_bar, empty
from dvc.report.style import BOLD, FONT, INK, ON_DARK, SMALL, WIDTH_IN

Plane = Literal["sagittal", "coronal", "axial"]
Values = npt.NDArray[Any]

PLANES: tuple[Plane, ...] = ("sagittal", "coronal", "axial")
# Axes of the L, P, S grid: the one cut, the one across the page, the one up or down it.
AXES: dict[Plane, tuple[int, int, int]] = {"sagittal": (0, 1, 2), "coronal": (1, 0, 2), "axial": (2, 0, 1)}
LETTERS: dict[Plane, str] = {"sagittal": "APSI", "coronal": "RLSI", "axial": "RLAP"}  # left, right, top, bottom
OBLIQUE_DEG = 3.0
_SIDES = ("RL", "AP", "IS")  # of the axes L, P, S: against it and along it
_LEAST_SHARE = 0.3827  # cosine of 67.5 degrees: half-way between one letter and two
UNSEEN = (0.16, 0.18, 0.30)  # a voxel without a value: neither black, which is dark tissue, nor a colour
_GAP_IN, _TITLE_IN, _BAR_IN, _LEAST_WIDTH_IN, _BESIDE_IN = 0.10, 0.26, 0.62, 5.2, 0.2
_MARK = "#FFD54A"


def letters(direction: npt.ArrayLike) -> str:
    """Side of the body to which a direction (3,) LPS points: letters of axes within 67.5 degrees of it, nearest first.

    >>> letters([0.0, -1.0, 0.0]), letters([0.0, -0.8, 0.6]), letters([0.1, 0.0, 0.99])
    ('A', 'AS', 'S')
    """
    unit = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    shown = [axis for axis in np.argsort(-np.abs(unit)) if abs(unit[axis]) > _LEAST_SHARE]
    return "".join(_SIDES[axis][int(unit[axis] > 0.0)] for axis in shown)


def tilt_deg(grid: Grid, plane: Plane) -> float:
    """Angle between the plane and the grid's slices that are shown for it, degrees; 0 if it is negligible."""
    cut = AXES[plane][0]
    tilt = float(np.degrees(np.arccos(np.clip(grid.toward_lps().direction[cut, cut], -1.0, 1.0))))
    return tilt if tilt > OBLIQUE_DEG else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Which slices of a grid are shown, and how much of them."""

    grid: Grid  # of every array that is drawn through this view
    index: tuple[int, int, int]  # the three slices, counted along the axes closest to L, P, S
    box: tuple[slice, slice, slice]  # the part shown, along the same axes

    @classmethod
    def through(
        cls, grid: Grid, point_mm: npt.ArrayLike | None, around: BoolArray | None = None, margin_mm: float = 8.0
    ) -> Self:
        """The slices nearest to a point, LPS mm, cropped to a mask and a margin around it, or the whole of them.

        Without a point, through the voxel of the mask, or of the grid, that is nearest to the mean of all of them.
        GeometryError if the point lies outside the grid, or the mask has another shape.
        """
        lps = grid.toward_lps()
        if point_mm is None:
            points = grid.points(around if around is not None and around.any() else np.ones(grid.shape, dtype=bool))
            point_mm = points[int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
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
        if tilt := tilt_deg(self.grid, plane):
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
        self.figure = empty((width, height))
        self.rows: list[dict[Plane, Axes]] = []
        indent, top = (width - inches * sum(widths) - gaps) / 2, height
        for title in titles:
            if title:
                at = (indent / width, (top - 0.8 * _TITLE_IN) / height)
                self.figure.text(*at, title, color=INK, **FONT)
            left, top = indent, top - strip
            row: dict[Plane, Axes] = {}
            for plane, w, h in zip(planes, widths, heights, strict=True):
                box = (left / width, (top - h * inches) / height, w * inches / width, h * inches / height)
                row[plane] = slice_panel(self.figure, box)
                self.figure.text(box[0], box[1] + box[3] + 0.04 / height, view.title(plane), color=INK, **SMALL)
                left += w * inches + _GAP_IN
            top -= inches * max(heights)
            self.rows.append(row)
        length = min(4.2, 0.6 * width)
        left = min(indent + _BESIDE_IN, (width - length) / 2)  # on the left, where a narrow screen shows it
        self._bar = (left / width, 0.42 / height, length / width, 0.13 / height)

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
        colour_bar(self.figure.add_axes(self._bar), ScalarMappable(norm, shades), label, extend=extend)

    def finished(self) -> Figure:
        """Add letters, marks and the scale bar, and return the figure."""
        spacing = self.view.grid.toward_lps().spacing_mm
        for row in self.rows:
            for number, (plane, axes) in enumerate(row.items()):
                left, right, bottom, top = self.view.extent_mm(plane)
                axes.set(xlim=(left, right), ylim=(bottom, top))
                _, across, along = AXES[plane]
                at = [self.view.index[a] * spacing[a] for a in (across, along)]
                x, y = (at[0] - left) / (right - left), (at[1] - bottom) / (top - bottom)
                ends = (0.0, 0.035), (0.965, 1.0)
                marks = [[(x, a), (x, b)] for a, b in ends] + [[(a, y), (b, y)] for a, b in ends]
                how: dict[str, Any] = {"colors": _MARK, "linewidths": 1.2, "transform": axes.transAxes}
                axes.add_collection(LineCollection(marks, **how), autolim=False)
                name_sides(axes, LETTERS[plane], (_beside(x), _beside(y)), **ON_DARK)
                if number == 0:
                    scale_bar(axes, right - left, **ON_DARK)
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


def slice_panel(figure: Figure, box: tuple[float, float, float, float], ground: str = "black") -> Axes:
    """A panel without axes for a slice, in a box (left, bottom, width, height) of the figure."""
    axes = figure.add_axes(box, facecolor=ground)
    axes.xaxis.set_visible(False)
    axes.yaxis.set_visible(False)
    return axes


def name_sides(axes: Axes, sides: Iterable[str], middle: tuple[float, float] = (0.5, 0.5), **how: Any) -> None:
    """Write letters of the sides of the body at a panel's left, right, top and bottom, there at its middle or so."""
    x, y = middle
    left_right = (0.015, y, "left", "center"), (0.985, y, "right", "center")
    spots = *left_right, (x, 0.985, "center", "top"), (x, 0.015, "center", "bottom")
    for side, (at, height, ha, va) in zip(sides, spots, strict=True):
        axes.text(at, height, side, ha=ha, va=va, zorder=9, transform=axes.transAxes, **how, **BOLD)


def scale_bar(axes: Axes, width_mm: float, **how: Any) -> None:
    """Draw a bar of a round length in the lower left corner of a panel that is so wide."""
    length = scale_length_mm(width_mm)
    ends, how = [0.03, 0.03 + length / width_mm], how | {"transform": axes.transAxes}
    axes.plot(ends, [0.035, 0.035], linewidth=2.5, solid_capstyle="butt", **how)
    axes.text(0.03, 0.05, f"{length:g} mm", va="bottom", **how, **SMALL)


def _beside(mark: float) -> float:
    """The middle of a side, 0 to 1, or a place beside it where a mark stands there."""
    return 0.5 if abs(mark - 0.5) > 0.05 else 0.42


def scale_length_mm(width_mm: float) -> float:
    """A round length, mm, of at most a third of a panel.

    >>> [scale_length_mm(w) for w in (14.0, 100.0)]
    [2.0, 20.0]
    """
    return max((n for n in (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0) if n <= width_mm / 3), default=1.0)


def window_of(view: View, image: Values) -> tuple[float, float]:
    """The values drawn black and white: the 0.5th and 99.7th percentile of the three slices."""
    known = np.concatenate([view.cut(image, plane).ravel() for plane in PLANES])
    known = known[np.isfinite(known)]
    low, high = np.percentile(known, (0.5, 99.7)) if known.size else (0.0, 1.0)
    return float(low), float(high if high > low else low + 1.0)


def levelled(page: Values, window: tuple[float, float]) -> FloatArray:
    """A page scaled to 0 to 1 within a window; NaN stays."""
    return np.clip((np.asarray(page, dtype=np.float64) - window[0]) / (window[1] - window[0]), 0.0, 1.0)
