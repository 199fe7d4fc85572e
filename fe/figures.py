"""Figures of meshes, simulations and fits; the docstring of a figure is its caption."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PolyCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from dvc import TetMesh
from dvc.arrays import FloatArray, IntArray
from dvc.report.chart import chart, colour_bar, empty, label_axes, legend
from dvc.report.drawing import Columns
from dvc.report.figures import MAX_SHEAR
from dvc.report.sheet import letters, name_sides, scale_bar, slice_panel
from dvc.report.style import FONT, GRID, INK, ON_LIGHT, RULE, TISSUES, WIDTH_IN, Look, looks
from fe.convergence import Limit
from fe.materials import MODES
from fe.mesh_file import BONE
from fe.plate import Plate
from fe.result import volume_percentiles
from fe.solution import LoadState

if TYPE_CHECKING:
    from fe.fitting import Curve, Fit  # imports SciPy's statistics: 0.2 s

_POINTS = 200
_FLAT_MM = 0.1
_TWO_COLUMNS = 4  # panels at most that stand in two columns: more in two would be taller than a printed page
_MANY = 30_000  # polygons: beyond, a PDF holds them as an image, which is then the smaller
_STEEPEST = 0.05  # smallest component of the plate's normal along the normal force at which the plate is drawn
_LEVEL = 0.1  # length of shear's part across the body below which it runs up or down
_MARGIN_MM = 7.0  # around what is drawn, for the letters
_GAP_IN, _TITLE_IN, _BAR_IN, _TALLEST_IN, _NARROWEST_IN = 0.1, 0.3, 0.66, 4.6, 5.2
_UNKNOWN = "#c9ced6"


def stress_stretch(curves: "Sequence[Curve]", fitted: "Fit") -> Figure:
    """Measured nominal stress (points) and the fitted model (lines), by kind of test.

    Dashed lines: the model is not stable there (Drucker).
    """
    figure, (axes,) = chart()
    look = looks([curve.mode for curve in curves], list(MODES))
    for curve in curves:
        low, high = fitted.reached[curve.mode]
        margin = 0.05 * (high - low)
        stretch = np.linspace(low - margin, high + margin, _POINTS)
        stress = 1000.0 * fitted.material.nominal_stress(stretch, curve.mode)
        least, greatest = fitted.stable[curve.mode]
        stable, of_test = (stretch >= least) & (stretch <= greatest), look[curve.mode]
        axes.plot(stretch, np.where(stable, stress, np.nan), label=curve.mode, **of_test.line)
        if not stable.all():
            axes.plot(stretch, np.where(stable, np.nan, stress), **of_test.line | {"linestyle": "--"})
        points = of_test.marked | {"linestyle": "none", "markerfacecolor": "white"}
        axes.plot(curve.stretch, 1000.0 * curve.stress_mpa, **points)
    axes.axhline(0.0, color=RULE, linewidth=0.8)
    label_axes(axes, "stretch, no unit", "nominal stress, kPa")
    legend(axes)
    return figure


def sagittal_slice(mesh: TetMesh, states: Sequence[LoadState]) -> Figure:
    """Maximum shear strain in a slice along the plate's normal and the shear.

    The slice goes through the point of the bone nearest to the plate. If loads have their own directions, those of the
    first load are used. Cells are cut in the reference configuration and drawn in their deformed position; the dashed
    line is the plate. The colour scale ends at the 99th percentile (by volume) over all loads.
    """
    axes = states[0].plate_axes
    assert axes is not None
    fields, middle = [], _lowest_bone_point(mesh, axes)
    for state in states:
        part = "" if state.reached == 1.0 else f" (ONLY {100 * state.reached:.0f} %)"
        title = f"{state.load.name}: {state.load}{part}"
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


def slice_sheet(
    mesh: TetMesh, fields: Sequence[Slice], axes: FloatArray, point_mm: FloatArray, largest: float | None = None
) -> Figure:
    """Fields in one slice, with one colour scale that ends at ``largest``, or the 99th percentile (by volume).

    Letters name the sides of the body: A anterior, P posterior, S superior, I inferior, R right, L left. ``axes`` (3,
    3) are those of the plate: columns are the directions of the normal force (up), of shear (to the right, or to the
    left; see `across_page`), and their cross product, LPS. ``point_mm`` (3,) lies in the slice, reference
    configuration, LPS mm.
    """
    side, axes = float(across_page(axes) @ axes[:, 1]), _on_page(axes)
    cuts = [cut(mesh, field.u_mm, axes, point_mm) for field in fields]
    if largest is None:
        shears = np.concatenate([field.max_shear for field in fields])
        known = np.isfinite(shears)
        (most,) = volume_percentiles(shears[known], np.tile(mesh.volumes_mm3, len(fields))[known], [0.99])
        largest = max(0.05, float(np.ceil(20.0 * most) / 20.0))
    norm = Normalize(0.0, largest)
    shades = colormaps["viridis"].with_extremes(bad=_UNKNOWN)
    corners = [corner for _, polygons in cuts for corner in polygons]
    figure, spots, bar = _slice_panels([field.title for field in fields], corners, axes)
    many = len(corners) > _MANY
    for spot, field, (cells, polygons) in zip(spots, fields, cuts, strict=True):
        values = np.ma.masked_invalid(field.max_shear[cells])
        how: dict[str, Any] = {"cmap": shades, "norm": norm, "edgecolors": "face", "linewidths": 0.2}
        spot.add_collection(PolyCollection(polygons, array=values, rasterized=many, **how), autolim=False)
        if field.face is not None:
            spot.axline((0.0, field.face[0]), slope=side * field.face[1], color=INK, linewidth=1.0, linestyle="--")
    colour_bar(bar, ScalarMappable(norm, shades), MAX_SHEAR, "max")
    return figure


def across_page(axes: FloatArray) -> FloatArray:
    """Direction of shear or its opposite, (3,) LPS: what points to the right of a page, as slices of images do.

    The patient's left or posterior, whichever is nearer, is on the right; superior where there is neither.

    >>> across_page(np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])).tolist()
    [0.0, 1.0, 0.0]
    """
    shear = axes[:, 1]
    level = shear[:2] if np.linalg.norm(shear[:2]) > _LEVEL else shear
    return np.where(level[np.argmax(np.abs(level))] < 0.0, -shear, shear) + 0.0


def _on_page(axes: FloatArray) -> FloatArray:
    """The plate's axes with the one across the page in place of shear."""
    return np.column_stack([axes[:, 0], across_page(axes), axes[:, 2]])


def _slice_panels(
    titles: Sequence[str], corners: Sequence[FloatArray], axes: FloatArray
) -> tuple[Figure, list[Axes], Axes]:
    """Panels for a slice, the first two axes up and across the page, around polygons; one for a colour bar below.

    They have letters and a scale bar.
    """
    every = np.concatenate(corners)
    low, high = every.min(axis=0) - _MARGIN_MM, every.max(axis=0) + _MARGIN_MM
    width_mm, height_mm = high - low
    columns = min(len(titles), 2 if len(titles) <= _TWO_COLUMNS else 3)
    rows = -(-len(titles) // columns)
    inches = min((WIDTH_IN - _GAP_IN * (columns - 1)) / columns / width_mm, _TALLEST_IN / height_mm)
    w, h = inches * width_mm, inches * height_mm
    foot = _BAR_IN + _GAP_IN
    size = max(_NARROWEST_IN, columns * (w + _GAP_IN) - _GAP_IN), rows * (h + _TITLE_IN) + foot
    figure, spots, indent = empty(size), [], (size[0] - columns * (w + _GAP_IN) + _GAP_IN) / 2
    for number, title in enumerate(titles):
        left = indent + number % columns * (w + _GAP_IN)
        bottom = foot + (rows - 1 - number // columns) * (h + _TITLE_IN)
        spot = slice_panel(figure, (left / size[0], bottom / size[1], w / size[0], h / size[1]), "white")
        spot.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        spot.spines[:].set_color(GRID)
        spot.set_title(title, pad=4, color=INK, **FONT)
        sides = map(letters, (-axes[:, 1], axes[:, 1], axes[:, 0], -axes[:, 0]))
        name_sides(spot, sides, **ON_LIGHT)
        scale_bar(spot, width_mm, **ON_LIGHT)
        spots.append(spot)
    length = 0.43 * size[0]
    at = (0.5 * (size[0] - length) / size[0], 0.45 / size[1], length / size[0], 0.13 / size[1])
    return figure, spots, figure.add_axes(at)


def _lowest_bone_point(mesh: TetMesh, axes: FloatArray) -> FloatArray:
    """Point of the bone's surface furthest along the plate's outward normal, LPS mm; the mean if there are several."""
    points = mesh.points_mm[np.unique(mesh.facets[BONE])] if BONE in mesh.facets else mesh.points_mm
    height = points @ axes[:, 0]
    return np.asarray(points[height < height.min() + _FLAT_MM].mean(axis=0))


def cut(mesh: TetMesh, u_mm: FloatArray, axes: FloatArray, point_mm: FloatArray) -> tuple[IntArray, list[FloatArray]]:
    """Cells (k,) cut by the plane of the first two axes, and the deformed polygon (3 or 4, 2) of each.

    Coordinates of polygons are along the second and the first axis, mm. ``u_mm`` (n, 3) is the displacement of the
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
    """Force of the plate over its displacement from first contact on, along the normal, and along the shear if any."""
    directions = ("normal", "shear") if any(state.load.sheared for state in states) else ("normal",)
    figure, spots = chart(len(directions), page_wide=len(directions) > 1)
    look = looks(state.load.name for state in states)
    for axis, (axes, name) in enumerate(zip(spots, directions, strict=True)):
        for state in states:
            moved, force = ([getattr(at, what)[axis] for at in state.curve] for what in ("displacement_mm", "force_n"))
            axes.plot(moved, force, label=state.load.name, **look[state.load.name].marked)
        label_axes(axes, f"{name} displacement, mm", f"{name} force, N")
    legend(spots[0])
    return figure


def forces(states: Sequence[LoadState]) -> Columns:
    """The data of `force_displacement`: a row for each converged increment."""
    steps = [(state.load.name, at) for state in states for at in state.curve]
    columns: dict[str, list[object]] = {"load": [load for load, _ in steps]}
    for axis, name in enumerate(("normal", "shear")):
        columns[f"{name}_displacement_mm"] = [float(at.displacement_mm[axis]) for _, at in steps]
        columns[f"{name}_force_n"] = [float(at.force_n[axis]) for _, at in steps]
    return columns


def mesh_slice(mesh: TetMesh, plate: Plate) -> Figure:
    """The mesh in a slice through the point of the bone nearest to the plate, coloured by tissue."""
    point, axes = _lowest_bone_point(mesh, plate.axes), _on_page(plate.axes)
    cells, corners = cut(mesh, np.zeros_like(mesh.points_mm), axes, point)
    figure, (panel,), room = _slice_panels(["Unloaded"], corners, axes)
    look = looks(mesh.regions, TISSUES)
    for name, members in mesh.regions.items():
        mine = [c for c, inside in zip(corners, np.isin(cells, members), strict=True) if inside]
        how: dict[str, Any] = {"facecolors": look[name].colour, "edgecolors": "white", "linewidths": 0.3}
        panel.add_collection(PolyCollection(mine, label=name, **how), autolim=False)
    room.set_axis_off()
    legend(panel, loc="upper center", bbox_to_anchor=(0.5, -0.01), ncols=4)
    return figure


def convergence(sizes_mm: Sequence[float], curves: Mapping[tuple[str, str], tuple[Sequence[float], Limit]]) -> Figure:
    """Quantities of each load over the cell size (cube root of the mean cell volume), divided by their limits.

    The grey line is 1. Dots lead to the limit by the order of convergence.
    """
    figure, (axes,) = chart(page_wide=True)
    of_loads, kinds = looks(load for load, _ in curves), list(dict.fromkeys(kind for _, kind in curves))
    for (load, kind), (values, limit) in curves.items():
        colour, number = of_loads[load].colour, kinds.index(kind)
        how = Look.numbered(6 * number).line | {"color": colour, "marker": Look.numbered(number).marker}
        axes.plot(sizes_mm, np.array(values) / limit.limit, label=f"{load}, {kind}", markersize=5, **how)
        h = np.linspace(0.0, min(sizes_mm), _POINTS)
        slope = (values[int(np.argmin(sizes_mm))] - limit.limit) / min(sizes_mm) ** limit.order
        axes.plot(h, 1.0 + slope * h**limit.order / limit.limit, ":", color=colour, linewidth=1.2)
    axes.axhline(1.0, color=RULE, linewidth=1.0)
    axes.set_xlim(0.0, 1.05 * max(sizes_mm))
    label_axes(axes, "cell size, mm", "value / extrapolated limit")
    legend(axes, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
