"""The picture that `init` draws: the unloaded image with its labels, or the bone, in colour, and the others beside."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Patch

from dvc import Image, LabelMap, fit_mask
from dvc.arrays import BoolArray
from dvc.errors import GeometryError
from dvc.report.chart import panels
from dvc.report.sheet import LETTERS, PLANES, UNSEEN, Plane, View, name_sides, scale_bar, window_of
from dvc.report.style import FAMILY, FONT, INK, ON_DARK, SMALL_PT, TISSUES, looks

_IN_A_ROW, _PANEL_IN = 3, (9.8, 3.3)
_TINT = 0.4  # of a label's colour over the image


@dataclass(frozen=True, slots=True)
class Labelled:
    """An image, and what is labelled on its voxels: masks by name."""

    image: Image
    regions: Mapping[str, BoolArray] = field(default_factory=dict)

    @classmethod
    def of(cls, image: Image, labels: LabelMap | None) -> Self:
        """An image with its label map, which is left out where it lies elsewhere."""
        try:
            on_image = None if labels is None else fit_mask(labels, image.grid, "label map")
        except GeometryError:
            on_image = None
        names = {} if on_image is None else on_image.names
        return cls(image, {name: on_image.labels == n for n, name in names.items() if on_image is not None and n != 0})


def overview(unloaded: Labelled, others: Mapping[str, Image]) -> Figure:
    """Middle slices of the unloaded image in three planes with its labels or bone in colour, and one of every other.

    The slices meet in the middle of what is labelled, or of the image; letters are sides of the body.
    """
    inside = [mask for mask in unloaded.regions.values() if mask.any()]
    grid = unloaded.image.grid
    middle = grid.centre_mm if not inside else grid.points(sum(inside[1:], inside[0])).mean(axis=0)
    shown = [("Load0", unloaded, plane) for plane in PLANES]
    shown += [(name, Labelled(image), PLANES[0]) for name, image in others.items()]
    figure, spots = panels(len(shown), _IN_A_ROW, _PANEL_IN)
    for axes, (name, one, plane) in zip(spots, shown, strict=True):
        at = middle if one.image.grid.contains(middle) else one.image.grid.centre_mm
        view = View.through(one.image.grid, at)
        _slice(axes, view, plane, one)
        axes.set_title(f"{name}: {view.title(plane).lower()}", loc="left", color=INK, **FONT)
    tints = [Patch(color=look.colour, label=name) for name, look in looks(unloaded.regions, TISSUES).items()]
    if tints:
        font = FontProperties(family=FAMILY, size=SMALL_PT)
        figure.legend(handles=tints, loc="outside lower center", ncols=6, frameon=False, prop=font, labelcolor=INK)
    return figure


def _slice(axes: Axes, view: View, plane: Plane, one: Labelled) -> None:
    """Draw a slice with its labels in colour, the sides of the body and a scale."""
    extent = view.extent_mm(plane)
    low, high = window_of(view, one.image.values)
    axes.imshow(view.cut(one.image.values, plane), extent=extent, cmap="gray", vmin=low, vmax=high)
    look = looks(one.regions, TISSUES)
    for name, mask in one.regions.items():
        page = view.cut(mask, plane)
        axes.imshow(np.where(page[..., None], to_rgba(look[name].colour, _TINT), 0.0), extent=extent)
    axes.set(xticks=[], yticks=[], facecolor=UNSEEN, xlim=extent[:2], ylim=extent[2:])
    name_sides(axes, LETTERS[plane], **ON_DARK)
    scale_bar(axes, extent[1] - extent[0], **ON_DARK)
