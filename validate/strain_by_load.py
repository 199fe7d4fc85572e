"""Measured and simulated strain in one slice of the image under every load: the first figure of a report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from dvc import Deformation, StrainField, evaluate_on_grid
from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.images.image import reordered_to_lps
from dvc.io.images.read import read_voxels
from dvc.report.chart import colour_bar, empty
from dvc.report.figures import MAX_SHEAR
from dvc.report.sheet import (
    AXES,
    LETTERS,
    PLANES,
    Plane,
    View,
    levelled,
    name_sides,
    outline,
    scale_bar,
    slice_panel,
    window_of,
)
from dvc.report.style import FONT, INK, ON_DARK, WIDTH_IN
from validate.fe_result import FeResult
from validate.load_comparison import LoadComparison

MEASURED = "measured"
_GAP_IN, _HEAD_IN, _SIDE_IN, _FOOT_IN, _TALLEST_IN = 0.06, 0.3, 0.3, 0.62, 3.2
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

    @classmethod
    def of(cls, one: LoadComparison, measured: Deformation, results: Sequence[FeResult], point_mm: FloatArray) -> Self:
        """The voxel slice through a point, LPS mm, that is closest to the plane of the plate's normal and shear."""
        labels, scanned = one.labels, one.case.image
        across = np.abs(np.cross(one.case.axes[:, 0], one.case.axes[:, 1]))
        plane = PLANES[int(np.argmax(across))]
        view = View.through(labels.grid, point_mm, labels.labels > 0)
        shown = np.zeros(labels.grid.shape)
        if scanned is not None:
            seen, voxels = read_voxels(scanned)
            shown = np.nan_to_num(voxels) if seen.same_as(labels.grid) else shown
        bones = [number for number, name in labels.names.items() if name in one.bones]
        soft = (labels.labels > 0) & ~np.isin(labels.labels, bones) & _in_slice(view, plane)
        fields: dict[str, Deformation] = {MEASURED: measured} | {r.name: r.deformation for r in results}
        pages: dict[str, Float32Array] = {}
        for name, field in fields.items():
            values = np.full(labels.grid.shape, np.nan, dtype=np.float32)
            values[soft] = StrainField.from_gradient(evaluate_on_grid(field, labels.grid, soft)[1]).max_shear
            pages[name] = view.cut(values, plane)
        masks = labels.labels > 0, np.isin(labels.labels, bones)
        return cls(
            one.load, plane, view.extent_mm(plane), view.title(plane),
            "the lowest point of the bone" if one.bones else "the middle of the mesh",
            levelled(view.cut(shown, plane), window_of(view, shown)),
            tuple(view.cut(mask, plane) for mask in masks), pages,
        )  # fmt: skip


def _in_slice(view: View, plane: Plane) -> BoolArray:
    """The voxels (ni, nj, nk) of a grid that are in the slice of a view."""
    inside, at = np.zeros(view.grid.shape, dtype=bool), AXES[plane][0]
    everywhere = [slice(None)] * 3
    everywhere[at] = slice(view.index[at], view.index[at] + 1)
    reordered_to_lps(view.grid, inside)[tuple(everywhere)] = True
    return inside


def strain_by_load(strips: Sequence[Strip], model: str, highest: float) -> Figure:
    """Maximum shear strain in one slice of the unloaded anatomy under each load: measured (top) and a model (bottom).

    On the left, the unloaded image. White lines are the surfaces of the body and of the bones. The image is grey where
    strain is not defined.
    """
    first = strips[0]
    left, right, bottom, top = first.extent_mm
    width_mm, height_mm = right - left, abs(top - bottom)
    columns, sides_in = len(strips) + 1, _HEAD_IN + _SIDE_IN
    inches = min(((WIDTH_IN - sides_in) / columns - _GAP_IN) / width_mm, _TALLEST_IN / height_mm)
    w, h = inches * width_mm, inches * height_mm
    size = sides_in + columns * (w + _GAP_IN), _HEAD_IN + 2 * (h + _GAP_IN) + _FOOT_IN
    figure, norm = empty(size), Normalize(0.0, highest)
    unloaded = slice_panel(figure, (0.0, (_FOOT_IN + (h + _GAP_IN) / 2) / size[1], w / size[0], h / size[1]))
    _paint(unloaded, first, None, norm)
    unloaded.set_title("Load0", color=INK, pad=4, **FONT)
    name_sides(unloaded, LETTERS[first.plane], **ON_DARK)
    scale_bar(unloaded, width_mm, **ON_DARK)
    begin = w + _HEAD_IN
    for row, name in enumerate((MEASURED, model)):
        low = _FOOT_IN + (1 - row) * (h + _GAP_IN)
        figure.text(
            (begin + 0.12) / size[0], (low + h / 2) / size[1], name, rotation=90, va="center", color=INK, **FONT
        )
        for column, strip in enumerate(strips):
            box = (begin + _SIDE_IN + column * (w + _GAP_IN)) / size[0], low / size[1], w / size[0], h / size[1]
            axes = slice_panel(figure, box)
            _paint(axes, strip, name, norm)
            if row == 0:
                axes.set_title(strip.load, color=INK, pad=4, **FONT)
    length = min(4.2, 0.6 * size[0])
    bar = figure.add_axes(((size[0] - length) / 2 / size[0], 0.42 / size[1], length / size[0], 0.12 / size[1]))
    colour_bar(bar, ScalarMappable(norm, _COLOURS), MAX_SHEAR, "max")
    return figure


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
