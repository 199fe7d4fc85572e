"""Strain in one slice of the image under every load: the first figure of a report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.report.chart import colour_bar, empty
from dvc.report.figures import MAX_SHEAR
from dvc.report.sheet import LETTERS, Plane, name_sides, outline, scale_bar, slice_panel
from dvc.report.style import FONT, INK, ON_DARK, SMALL, WIDTH_IN

MEASURED = "measured"
_GAP_IN, _HEAD_IN, _SIDE_IN, _FOOT_IN, _TALLEST_IN = 0.06, 0.3, 0.3, 0.62, 3.2
_NARROW_IN = 4.2  # width of what a screen of 400 pixels shows
_SMALL, _SMALLEST_IN = 0.6, 1.3  # there, the unloaded image: of the size of a slice, and its largest width
_COLOURS = colormaps["viridis"]


@dataclass(frozen=True, slots=True, eq=False)
class Strip:
    """A slice of one load: the image, outlines, and the measured and simulated max. shear on its voxels."""

    load: str
    plane: Plane
    extent_mm: tuple[float, float, float, float]
    title: str
    place: str  # that the slice goes through, in words
    image: FloatArray  # rows downward, columns to the right; 0 to 1
    outlines: tuple[BoolArray, ...]
    max_shear: Mapping[str, Float32Array]  # by model, and of `MEASURED`; NaN where undefined


def strain_by_load(strips: Sequence[Strip], rows: Sequence[str], largest: float) -> Figure:
    """Maximum shear strain under each load, in one slice of the unloaded anatomy.

    Load0 is the unloaded image, or its label map if there is no image. A anterior, P posterior, S superior, I
    inferior, R right, L left. White lines are the surfaces of the body and of the bones. Grey: no result (not
    measured, or outside the mesh of a model).
    """
    # A row for each name; they are those of `Strip.max_shear`. The colours end at ``largest``.
    first, many = strips[0], len(rows) > 1
    left, right, bottom, top = first.extent_mm
    width_mm, height_mm = right - left, abs(top - bottom)
    aside_in = _HEAD_IN + _SIDE_IN if many else _GAP_IN  # between the unloaded image and the rows, for their names
    columns = len(strips) + 1
    inches = min(((WIDTH_IN - aside_in) / columns - _GAP_IN) / width_mm, _TALLEST_IN / height_mm)
    w, h = inches * width_mm, inches * height_mm
    size = aside_in + columns * (w + _GAP_IN), _HEAD_IN + len(rows) * (h + _GAP_IN) + _FOOT_IN
    figure, norm = empty(size), Normalize(0.0, largest)
    middle = _FOOT_IN + (len(rows) - 1) * (h + _GAP_IN) / 2
    unloaded = slice_panel(figure, (0.0, middle / size[1], w / size[0], h / size[1]))
    _unloaded(unloaded, first, norm)
    scale_bar(unloaded, width_mm, **ON_DARK)
    for row, name in enumerate(rows):
        low = _FOOT_IN + (len(rows) - 1 - row) * (h + _GAP_IN)
        if many:
            at = (w + _HEAD_IN + 0.12) / size[0], (low + h / 2) / size[1]
            figure.text(*at, name, rotation=90, va="center", color=INK, **FONT)
        for column, strip in enumerate(strips):
            box = (w + aside_in + column * (w + _GAP_IN)) / size[0], low / size[1], w / size[0], h / size[1]
            axes = slice_panel(figure, box)
            _paint(axes, strip, name, norm)
            if row == 0:
                axes.set_title(strip.load, color=INK, pad=4, **FONT)
    length = min(4.2, 0.6 * size[0])
    bar = figure.add_axes(((size[0] - length) / 2 / size[0], 0.42 / size[1], length / size[0], 0.12 / size[1]))
    colour_bar(bar, ScalarMappable(norm, _COLOURS), MAX_SHEAR, "max")
    return figure


def narrow_by_load(strips: Sequence[Strip], rows: Sequence[str], largest: float) -> Figure:
    """The slices of `strain_by_load` in two columns, for a narrow screen; the unloaded image is small, and last."""
    first, many = strips[0], len(rows) > 1
    shown = [(strip, name) for strip in strips for name in rows]
    columns = len(rows) if many else min(2, len(shown))
    lines = -(-len(shown) // columns)
    left, right, bottom, top = first.extent_mm
    width_mm, height_mm = right - left, abs(top - bottom)
    inches = min(((_NARROW_IN + _GAP_IN) / columns - _GAP_IN) / width_mm, _NARROW_IN / height_mm)
    w, h = inches * width_mm, inches * height_mm
    small = min(_SMALL, _SMALLEST_IN / w)
    foot_in = _HEAD_IN + max(small * h, _FOOT_IN)
    size = _NARROW_IN, lines * (h + _HEAD_IN) + foot_in
    figure, norm = empty(size), Normalize(0.0, largest)
    for number, (strip, name) in enumerate(shown):
        line, column = divmod(number, columns)
        low = size[1] - (line + 1) * (h + _HEAD_IN)
        axes = slice_panel(figure, (column * (w + _GAP_IN) / size[0], low / size[1], w / size[0], h / size[1]))
        _paint(axes, strip, name, norm)
        axes.set_title(f"{strip.load}, {name}" if many else strip.load, color=INK, pad=4, **SMALL)
        if number == 0:  # a scale would cover a third of the small image
            scale_bar(axes, width_mm, **ON_DARK)
    _unloaded(slice_panel(figure, (0.0, 0.0, small * w / size[0], small * h / size[1])), first, norm)
    at = small * w + _SIDE_IN
    bar = figure.add_axes((at / size[0], 0.42 / size[1], (size[0] - at - _SIDE_IN) / size[0], 0.12 / size[1]))
    colour_bar(bar, ScalarMappable(norm, _COLOURS), "max. shear strain, no unit", "max")
    return figure


def _unloaded(axes: Axes, strip: Strip, norm: Normalize) -> None:
    """Draw the unloaded image, with letters."""
    _paint(axes, strip, None, norm)
    axes.set_title("Load0", color=INK, pad=4, **FONT)
    name_sides(axes, LETTERS[strip.plane], **ON_DARK)


def _paint(axes: Axes, strip: Strip, name: str | None, norm: Normalize) -> None:
    """Draw a slice of the unloaded image, with the strain that was measured or that a model gives, if one is named."""
    how: dict[str, Any] = {"extent": strip.extent_mm, "origin": "upper", "aspect": "auto"}
    axes.imshow(strip.image, cmap="gray", vmin=0.0, vmax=1.0, **how)
    values: npt.NDArray[Any] | None = None if name is None else strip.max_shear.get(name)
    if values is None and name is not None:
        axes.text(0.5, 0.5, "no result", transform=axes.transAxes, ha="center", **ON_DARK, **FONT)
    elif values is not None:
        axes.imshow(np.ma.masked_invalid(values), cmap=_COLOURS, norm=norm, interpolation="nearest", **how)
    outline(axes, strip.extent_mm, strip.outlines)
