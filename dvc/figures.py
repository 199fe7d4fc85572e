"""Figures of a registration, each as PNG bytes: three planes through a point, and curves.

All panels of a figure share one scale, so a length is the same everywhere. How slices lie on the page: `dvc.planes`.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps, patheffects
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, Normalize, TwoSlopeNorm
from matplotlib.figure import Figure
from scipy.ndimage import map_coordinates

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.image import Image, LabelMap
from dvc.planes import AXES, LETTERS, PLANES, Plane, View
from dvc.regions import volume_above

# Okabe and Ito's palette, told apart by all common kinds of colour vision.
REGION_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_WIDTH_IN, _DPI = 11.0, 110
_SHADOW = [patheffects.withStroke(linewidth=2.0, foreground="black")]
_CHECK_MM = 12.0
_LINE_MM = 5.0


def overlay(view: View, reference: Image, rigid: Float32Array, registered: Float32Array) -> bytes:
    """Unloaded image in green, loaded in magenta: after the rigid alignment (above) and after all (below).

    Where both agree the picture is grey; colour is disagreement.
    """
    return _two_rows(view, reference, rigid, registered, _fused)


def checkerboard(view: View, reference: Image, rigid: Float32Array, registered: Float32Array) -> bytes:
    """Fields of 12 mm in turn from the unloaded and the loaded image: borders must run through."""
    return _two_rows(view, reference, rigid, registered, _checks)


def strain_slices(
    view: View, reference: Image, max_shear: Float32Array, largest: float, outline: LabelMap | None = None
) -> bytes:
    """Maximal shear (E1 - E3)/2 over the unloaded image, reference configuration; plain MR where undefined."""
    norm = Normalize(0.0, largest)
    figure, axes = _panels(view, 1, colour_bar=True)
    for ax, plane in zip(axes[0], PLANES, strict=True):
        _grey(ax, view, plane, reference.values)
        drawn = ax.imshow(
            view.cut(max_shear, plane),
            cmap=colormaps["viridis"],
            norm=norm,
            extent=view.extent_mm(plane),
            alpha=0.85,
        )
        _outlines(ax, view, plane, outline)
        _dress(ax, view, plane)
    bar = figure.colorbar(drawn, ax=axes[0].tolist(), fraction=0.025, pad=0.01, extend="max")
    bar.set_label("maximal shear (E₁ − E₃)/2")
    return _png(figure)


def jacobian_slices(view: View, reference: Image, jacobian: Float32Array) -> bytes:
    """Volume ratio det F over the unloaded image: blue shrinks, brown grows, red folds (det F <= 0)."""
    norm = TwoSlopeNorm(1.0, 0.7, 1.3)
    figure, axes = _panels(view, 1, colour_bar=True)
    for ax, plane in zip(axes[0], PLANES, strict=True):
        _grey(ax, view, plane, reference.values)
        page = view.cut(jacobian, plane)
        drawn = ax.imshow(page, cmap=colormaps["BrBG_r"], norm=norm, extent=view.extent_mm(plane), alpha=0.8)
        folded = np.where(page <= 0.0, 1.0, np.nan)
        ax.imshow(folded, cmap=ListedColormap(["red"]), extent=view.extent_mm(plane), vmin=0, vmax=1)
        _dress(ax, view, plane)
    bar = figure.colorbar(drawn, ax=axes[0].tolist(), fraction=0.025, pad=0.01, extend="both")
    bar.set_label("volume ratio det F")
    return _png(figure)


def deformed_grid(view: View, aligned: Float32Array, displacement_mm: Float32Array, bone: BoolArray | None) -> bytes:
    """Material lines, 5 mm apart when unloaded, over the loaded image; in-plane displacement, relative to bone."""
    planes: tuple[Plane, ...] = ("sagittal", "coronal")
    figure, axes = _panels(view, 1, planes=planes)
    lps = view.grid.toward_lps()
    for ax, plane in zip(axes[0], planes, strict=True):
        _grey(ax, view, plane, aligned)
        _, across, along = AXES[plane]
        left, right, low, high = view.extent_mm(plane)
        page = view.cut(displacement_mm, plane)[::-1] @ lps.direction
        u, v = page[..., across], page[..., along]
        h, w = lps.spacing_mm[across], lps.spacing_mm[along]

        def moved(
            a: FloatArray,
            b: FloatArray,
            u: Any = u,
            v: Any = v,
            left: float = left,
            low: float = low,
            h: float = h,
            w: float = w,
        ) -> tuple[FloatArray, FloatArray]:
            at = np.stack([(b - low) / w - 0.5, (a - left) / h - 0.5])
            return (
                a + map_coordinates(u, at, order=1, cval=np.nan),
                b + map_coordinates(v, at, order=1, cval=np.nan),
            )

        fine = 0.5
        for at in np.arange(left + _LINE_MM / 2, right, _LINE_MM):
            b = np.arange(low, high, fine)
            ax.plot(*moved(np.full_like(b, at), b), color="#F0E442", linewidth=0.9)
        for at in np.arange(low + _LINE_MM / 2, high, _LINE_MM):
            a = np.arange(left, right, fine)
            ax.plot(*moved(a, np.full_like(a, at)), color="#F0E442", linewidth=0.9)
        if bone is not None:
            _contour(ax, view, plane, bone, "#56B4E9")
        _dress(ax, view, plane)
    return _png(figure)


def shear_curves(max_shear: Float32Array, labels: LabelMap) -> bytes:
    """Volume of each region whose maximal shear exceeds a value, mL: exact step curves, no bins."""
    figure = Figure(figsize=(7.5, 4.2), dpi=_DPI)
    FigureCanvasAgg(figure)
    ax = figure.subplots()
    at = np.linspace(0.0, 0.6, 601)
    voxel_ml = labels.grid.voxel_volume_mm3 / 1000.0
    for colour, (label, name) in zip(_cycled(len(labels.names)), labels.names.items(), strict=True):
        values = max_shear[labels.labels == label]
        if np.isfinite(values).any():
            ax.plot(
                at,
                np.maximum(volume_above(values, voxel_ml, at), 1e-4),
                label=name,
                color=colour,
                linewidth=1.8,
            )
    ax.set(
        yscale="log",
        ylim=(1e-2, None),
        xlim=(0.0, 0.6),
        xlabel="maximal shear (E₁ − E₃)/2",
        ylabel="volume above, mL",
    )
    ax.grid(alpha=0.25)
    ax.legend(frameon=False)
    return _png(figure)


def similarity_slices(view: View, rigid: Float32Array, registered: Float32Array) -> bytes:
    """Local correlation of the loaded with the unloaded image: after the rigid alignment (above), after all (below)."""
    figure, axes = _panels(view, 2, colour_bar=True)
    for row, values in zip(axes, (rigid, registered), strict=True):
        for ax, plane in zip(row, PLANES, strict=True):
            ax.set_facecolor("black")
            drawn = ax.imshow(
                view.cut(values, plane),
                cmap=colormaps["cividis"],
                vmin=0,
                vmax=1,
                extent=view.extent_mm(plane),
            )
            _dress(ax, view, plane)
    bar = figure.colorbar(drawn, ax=axes.ravel().tolist(), fraction=0.025, pad=0.01, extend="min")
    bar.set_label("local correlation")
    return _png(figure)


def _two_rows(view: View, reference: Image, rigid: Float32Array, registered: Float32Array, join: Any) -> bytes:
    figure, axes = _panels(view, 2)
    for row, loaded, said in zip(axes, (rigid, registered), ("after rigid alignment", "after all"), strict=True):
        for ax, plane in zip(row, PLANES, strict=True):
            a = _levelled(view.cut(reference.values, plane), reference.values)
            b = _levelled(view.cut(loaded, plane), loaded)
            ax.imshow(join(a, b, view, plane), extent=view.extent_mm(plane), vmin=0, vmax=1, cmap="gray")
            _dress(ax, view, plane)
        row[0].text(
            0.02,
            0.02,
            said,
            transform=row[0].transAxes,
            color="white",
            fontsize=10,
            va="bottom",
            path_effects=_SHADOW,
        )
    return _png(figure)


def _fused(a: FloatArray, b: FloatArray, _view: View, _plane: Plane) -> FloatArray:
    return np.stack([b, a, b], axis=-1)


def _checks(a: FloatArray, b: FloatArray, view: View, plane: Plane) -> FloatArray:
    _, across, along = AXES[plane]
    spacing = view.grid.toward_lps().spacing_mm
    row, column = np.indices(a.shape)
    odd = (row * spacing[along] // _CHECK_MM + column * spacing[across] // _CHECK_MM) % 2 == 1
    return np.where(odd, b, a)


def _levelled(page: npt.NDArray[Any], whole: npt.NDArray[Any]) -> FloatArray:
    low, high = np.nanpercentile(whole[::3, ::3, ::3], [1.0, 99.5])
    return np.asarray(np.clip(np.nan_to_num((page - low) / max(high - low, 1e-12)), 0.0, 1.0), dtype=np.float64)


def _panels(
    view: View, rows: int, planes: tuple[Plane, ...] = PLANES, colour_bar: bool = False
) -> tuple[Figure, npt.NDArray[Any]]:
    extents = [view.extent_mm(p) for p in planes]
    widths = [abs(e[1] - e[0]) for e in extents]
    heights = [abs(e[3] - e[2]) for e in extents]
    scale = (_WIDTH_IN - (1.0 if colour_bar else 0.0)) / sum(widths)
    figure = Figure(figsize=(_WIDTH_IN, rows * (max(heights) * scale + 0.35)), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, len(planes), squeeze=False, gridspec_kw={"width_ratios": widths})
    return figure, axes


def _grey(ax: Axes, view: View, plane: Plane, values: Float32Array) -> None:
    ax.imshow(_levelled(view.cut(values, plane), values), cmap="gray", vmin=0, vmax=1, extent=view.extent_mm(plane))


def _outlines(ax: Axes, view: View, plane: Plane, labels: LabelMap | None) -> None:
    if labels is None:
        return
    for colour, label in zip(_cycled(len(labels.names)), labels.names, strict=True):
        _contour(ax, view, plane, labels.labels == label, colour)


def _contour(ax: Axes, view: View, plane: Plane, inside: BoolArray, colour: str) -> None:
    page = view.cut(inside, plane).astype(np.float64)
    if page.any() and not page.all():
        ax.contour(page, levels=[0.5], colors=[colour], linewidths=0.8, extent=view.extent_mm(plane), origin="upper")


def _dress(ax: Axes, view: View, plane: Plane) -> None:
    """Title, anatomical letters and a scale bar; no ticks."""
    left, right, bottom, top = view.extent_mm(plane)
    ax.set(xticks=[], yticks=[], xlim=(left, right), ylim=(bottom, top), aspect="equal")
    ax.set_title(view.title(plane), fontsize=10)
    style: dict[str, Any] = {
        "transform": ax.transAxes,
        "color": "white",
        "fontsize": 10,
        "path_effects": _SHADOW,
        "zorder": 10,
    }
    a, b, c, d = LETTERS[plane]
    ax.text(0.02, 0.5, a, ha="left", va="center", **style)
    ax.text(0.98, 0.5, b, ha="right", va="center", **style)
    ax.text(0.5, 0.98, c, ha="center", va="top", **style)
    ax.text(0.5, 0.02, d, ha="center", va="bottom", **style)
    width = abs(right - left)
    ax.plot(
        [0.95 - 20.0 / width, 0.95],
        [0.06, 0.06],
        transform=ax.transAxes,
        color="white",
        linewidth=2.5,
        zorder=10,
    )
    ax.text(0.95 - 10.0 / width, 0.075, "20 mm", ha="center", va="bottom", **(style | {"fontsize": 8}))


def _cycled(count: int) -> list[str]:
    return [REGION_COLOURS[n % len(REGION_COLOURS)] for n in range(count)]


def _png(figure: Figure, metadata: Mapping[str, str] | None = None) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata=dict(metadata or {"Software": "mrstrain"}))
    return stream.getvalue()
