"""Figures of meshes, simulations and fits; the docstring of a figure is its caption."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from dvc import TetMesh
from dvc.arrays import FloatArray, IntArray
from dvc.atomic_files import whole_file
from dvc.report.figures import REGION_COLOURS
from dvc.report.sheet import FONT, INK, WIDTH_IN, chart, label_axes, letters, panels, png_bytes
from fe.convergence import Limit
from fe.mesh_file import BONE
from fe.plate import Plate
from fe.result import volume_percentiles
from fe.solution import LoadState

if TYPE_CHECKING:
    from fe.fitting import Curve, Fit  # imports SciPy's statistics: 0.2 s

_POINTS = 200
_FLAT_MM = 0.1
_STEEPEST = 0.05  # smallest component of the plate's normal along the normal force at which the plate is drawn
_MARGIN_MM = 7.0  # around the mesh, for the letters
_UNKNOWN = "#c9ced6"


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG."""
    with whole_file(path) as part:
        part.write_bytes(png_bytes(figure))


def stress_stretch(curves: "Sequence[Curve]", fitted: "Fit") -> Figure:
    """Measured nominal stress (points) and the fitted model (lines), by kind of test.

    Dashed lines: the model is not stable there (Drucker).
    """
    figure, (axes,) = chart()
    for curve, colour in zip(curves, cycle(REGION_COLOURS), strict=False):
        low, high = fitted.reached[curve.mode]
        margin = 0.05 * (high - low)
        stretch = np.linspace(low - margin, high + margin, _POINTS)
        stress = 1000.0 * fitted.material.nominal_stress(stretch, curve.mode)
        least, greatest = fitted.stable[curve.mode]
        stable = (stretch >= least) & (stretch <= greatest)
        axes.plot(stretch, np.where(stable, stress, np.nan), color=colour, linewidth=1.8, label=curve.mode)
        if not stable.all():
            axes.plot(stretch, np.where(stable, np.nan, stress), color=colour, linewidth=1.8, linestyle="--")
        axes.plot(curve.stretch, 1000.0 * curve.stress_mpa, "o", color=colour, markersize=4, markerfacecolor="white")
    axes.axhline(0.0, color="#9aa5b1", linewidth=0.8)
    label_axes(axes, "stretch", "nominal stress, kPa")
    axes.legend(fontsize=9, frameon=False)
    return figure


def sagittal_slice(mesh: TetMesh, states: Sequence[LoadState]) -> Figure:
    """Maximum shear strain in a slice through the lowest point of the bone, along the plate's normal and the shear.

    If loads have their own directions, those of the first load are used. Cells are cut in the unloaded configuration
    and drawn in their deformed position; the dashed line is the plate. The colour scale ends at the 99th percentile
    (by volume) over all loads.
    """
    axes = states[0].plate_axes
    assert axes is not None
    fields, middle = [], _lowest_bone_point(mesh, axes)
    for state in states:
        title = f"{state.load.name}: {state.load}{'' if state.reached == 1.0 else f' (ONLY {state.reached:.0%})'}"
        fields.append(Slice(title, state.u_mm, state.strain.max_shear, _along_plate(mesh, state, axes, middle)))
    return slice_sheet(mesh, fields, axes, middle)


def _along_plate(
    mesh: TetMesh, state: LoadState, axes: FloatArray, on_slice_mm: FloatArray
) -> tuple[float, float] | None:
    """Height of the plate at shear coordinate 0 of the slice, and its slope; None if it cannot be drawn as a line."""
    assert state.plate_axes is not None
    on_plate = ((mesh.points_mm + state.u_mm)[state.on_plate] @ axes).mean(axis=0)
    turned = Rotation.from_rotvec(state.plate.turn_deg, degrees=True).as_matrix()[:, 0]
    normal = axes.T @ state.plate_axes @ turned
    if abs(normal[0]) < _STEEPEST:
        return None
    off = np.array([0.0, 0.0, float(on_slice_mm @ axes[:, 2])]) - on_plate
    return float(-(off @ normal) / normal[0]), float(-normal[1] / normal[0])


@dataclass(frozen=True, slots=True, eq=False)
class Slice:
    """A field on a mesh that is drawn in a slice; the ``face`` of a plate is a dashed line."""

    title: str
    u_mm: FloatArray  # (n, 3) displacement of the mesh's nodes, LPS: cells are drawn in their deformed position
    max_shear: FloatArray  # (m,) of the cells; NaN is drawn grey
    face: tuple[float, float] | None = None  # height along the normal force at shear coordinate 0; slope


def slice_sheet(mesh: TetMesh, fields: Sequence[Slice], axes: FloatArray, point_mm: FloatArray) -> Figure:
    """Fields in one slice, with one colour scale that ends at the 99th percentile (by volume).

    Letters name the sides of the body: A anterior, P posterior, S superior, I inferior, R right, L left. ``axes`` (3,
    3) are those of the plate: columns are the directions of the normal force, of shear, and their cross product, LPS.
    ``point_mm`` (3,) lies in the slice, reference configuration, LPS mm.
    """
    cuts = [cut(mesh, field.u_mm, axes, point_mm) for field in fields]
    corners = np.concatenate([corner for _, polygons in cuts for corner in polygons])
    low, high = corners.min(axis=0) - _MARGIN_MM, corners.max(axis=0) + _MARGIN_MM
    shears = np.concatenate([field.max_shear for field in fields])
    known = np.isfinite(shears)
    (most,) = volume_percentiles(shears[known], np.tile(mesh.volumes_mm3, len(fields))[known], [0.99])
    largest = max(0.05, float(np.ceil(20.0 * most) / 20.0))
    tall = 0.9 + (WIDTH_IN / min(len(fields), 2) - 1.0) * float((high[1] - low[1]) / (high[0] - low[0]))
    figure, spots = panels(len(fields), size_in=(WIDTH_IN, tall))
    shades = colormaps["viridis"].with_extremes(bad=_UNKNOWN)
    how: dict[str, Any] = {"cmap": shades, "norm": Normalize(0.0, largest), "edgecolors": "face", "linewidths": 0.2}
    for spot, field, (cells, polygons) in zip(spots, fields, cuts, strict=True):
        drawn = PolyCollection(polygons, array=np.ma.masked_invalid(field.max_shear[cells]), **how)
        spot.add_collection(drawn)
        spot.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
        if field.face is not None:
            spot.axline((0.0, field.face[0]), slope=field.face[1], color=INK, linewidth=1.0, linestyle="--")
        label_axes(spot, "along the shear, mm", "along the normal force, mm", field.title)
        for x, y, ha, va, direction in (
            (0.01, 0.5, "left", "center", -axes[:, 1]), (0.99, 0.5, "right", "center", axes[:, 1]),
            (0.5, 0.01, "center", "bottom", -axes[:, 0]), (0.5, 0.99, "center", "top", axes[:, 0]),
        ):  # fmt: skip
            side, at = letters(direction), spot.transAxes
            spot.text(x, y, side, weight="bold", color=INK, transform=at, ha=ha, va=va, **FONT)
    bar = figure.colorbar(drawn, ax=spots, shrink=0.8, extend="max")
    bar.set_label("max. shear strain", color=INK, **FONT)
    return figure


def _lowest_bone_point(mesh: TetMesh, axes: FloatArray) -> FloatArray:
    """Point of the bone's surface furthest along the plate's outward normal, LPS mm; the mean if there are several."""
    points = mesh.points_mm[np.unique(mesh.facets[BONE])] if BONE in mesh.facets else mesh.points_mm
    height = points @ axes[:, 0]
    return np.asarray(points[height < height.min() + _FLAT_MM].mean(axis=0))


def cut(mesh: TetMesh, u_mm: FloatArray, axes: FloatArray, point_mm: FloatArray) -> tuple[IntArray, list[FloatArray]]:
    """Cells (k,) cut by the plane of the plate's first two axes, and the deformed polygon (3 or 4, 2) of each.

    Coordinates of polygons are along the shear and the normal force, mm. ``u_mm`` (n, 3) is the displacement of the
    mesh's nodes, LPS. The other parameters are as in `slice_sheet`.
    """
    height = (mesh.points_mm - point_mm) @ axes[:, 2]
    height = np.where(height == 0.0, 1e-9, height)
    now = (mesh.points_mm + u_mm) @ axes[:, [1, 0]]
    sides = height[mesh.cells] > 0.0
    cells = np.flatnonzero(sides.any(axis=1) & ~sides.all(axis=1))
    polygons = []
    for nodes, side in zip(mesh.cells[cells], sides[cells], strict=True):
        # in order around the section, so that the polygon does not cross itself
        pairs = [(a, b) for a in nodes[side] for b in nodes[~side]]
        if len(pairs) == 4:
            pairs = [pairs[0], pairs[1], pairs[3], pairs[2]]
        share = [height[a] / (height[a] - height[b]) for a, b in pairs]
        polygons.append(np.array([(1 - s) * now[a] + s * now[b] for (a, b), s in zip(pairs, share, strict=True)]))
    return cells, polygons


def force_displacement(states: Sequence[LoadState]) -> Figure:
    """Force of the plate over its displacement from first contact on, along the normal (left) and the shear (right)."""
    figure, spots = chart(2)
    for axes, axis, name in zip(spots, (0, 1), ("normal", "shear"), strict=True):
        for state, colour in zip(states, cycle(REGION_COLOURS), strict=False):
            moved, force = ([getattr(at, what)[axis] for at in state.curve] for what in ("displacement_mm", "force_n"))
            axes.plot(moved, force, marker=".", label=state.load.name, linewidth=1.8, color=colour)
        label_axes(axes, f"{name} displacement, mm", f"{name} force, N")
    spots[0].legend(fontsize=9, frameon=False)
    return figure


def mesh_slice(mesh: TetMesh, plate: Plate) -> Figure:
    """The mesh in a slice through the lowest point of the bone, coloured by tissue."""
    figure, (panel,) = chart()
    cells, corners = cut(mesh, np.zeros_like(mesh.points_mm), plate.axes, _lowest_bone_point(mesh, plate.axes))
    for (name, members), colour in zip(mesh.regions.items(), cycle(REGION_COLOURS), strict=False):
        mine = [c for c, inside in zip(corners, np.isin(cells, members), strict=True) if inside]
        panel.add_collection(PolyCollection(mine, facecolors=colour, edgecolors="white", linewidths=0.3, label=name))
    panel.autoscale_view()
    panel.set_aspect("equal")
    label_axes(panel, "along the shear, mm", "along the normal force, mm")
    panel.legend(fontsize=9, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def convergence(sizes_mm: Sequence[float], curves: Mapping[str, tuple[Sequence[float], Limit]]) -> Figure:
    """Quantities over the cell size (cube root of the mean cell volume), each divided by its extrapolated limit.

    The grey line is 1.
    """
    figure, (axes,) = chart()
    for (name, (values, limit)), colour in zip(curves.items(), cycle(REGION_COLOURS), strict=False):
        style = "-" if "travel" in name else "--"
        axes.plot(sizes_mm, np.array(values) / limit.limit, style, marker="o", color=colour, linewidth=1.6, label=name)
        h = np.linspace(0.0, min(sizes_mm), _POINTS)
        slope = (values[int(np.argmin(sizes_mm))] - limit.limit) / min(sizes_mm) ** limit.order
        axes.plot(h, 1.0 + slope * h**limit.order / limit.limit, ":", color=colour, linewidth=1.2)
    axes.axhline(1.0, color="#9aa5b1", linewidth=1.0)
    axes.set_xlim(0.0, 1.05 * max(sizes_mm))
    label_axes(axes, "cell size, mm", "value / extrapolated limit")
    axes.legend(fontsize=8, frameon=False)
    return figure
