"""Smooth surfaces between the tissues of a label map, and meshes between them that keep the tissues' volumes."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import maximum_filter

from dvc import LabelMap
from dvc.arrays import FloatArray, IntArray
from dvc.errors import MrstrainError
from dvc.mesh import FACES, signed_volumes

_PASS_BAND = 0.03  # of a windowed sinc filter: 40 steps of plain relaxation take 7 % of a thin muscle, this takes 0.1 %
_PASSES = 20
_FLAT_DEG = 15.0  # between triangles: sharper edges are kept when a surface is thinned
_AROUND = 2  # voxels around a point that may hold the tissue whose border encloses it
_SHIFTS = 3
_LEAST_LEFT = 0.2  # of a cell's volume, in one shift
_HALVINGS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Borders:
    """Triangles between tissues, and between tissue and outside."""

    points_mm: FloatArray  # (n, 3) LPS
    triangles: IntArray  # (m, 3)
    sides: IntArray  # (m, 2) labels on either side; 0 is outside


def borders_of(labels: LabelMap) -> Borders:
    """Borders between all labels of a map: surface nets through the voxels' faces, smoothed by a windowed sinc filter.

    Surface nets (S. F. Frisken 1999, doi:10.1007/10704282_102) meet where three tissues meet and leave no gap; the
    filter (G. Taubin and others 1996, doi:10.1007/BFb0015544) smooths without shrinking.
    """
    import pyvista

    grid = labels.grid
    image = pyvista.ImageData(dimensions=grid.shape, spacing=grid.spacing_mm)
    image["labels"] = labels.labels.astype(np.int32).ravel(order="F")
    net = image.contour_labels("all", output_mesh_type="triangles", smoothing=False)  # closed at the image's edge
    if not net.n_cells:
        raise MrstrainError("There is no border between tissues in the label map.")
    made = net.smooth_taubin(
        n_iter=_PASSES, pass_band=_PASS_BAND, non_manifold_smoothing=True, normalize_coordinates=True
    )
    points_mm = np.asarray(made.points, dtype=np.float64) @ grid.direction.T + grid.origin_mm
    triangles, sides = (np.asarray(of, dtype=np.int64) for of in (made.regular_faces, net["boundary_labels"]))
    return Borders(points_mm, triangles, sides)


def thinned(borders: Borders, off_mm: float) -> tuple[FloatArray, IntArray]:
    """Points (n, 3), LPS mm, and triangles (m, 3) of the same borders, with fewer triangles where they are flat.

    Nodes are taken out one by one (W. J. Schroeder and others 1992, doi:10.1145/142920.134010), as long as the errors
    on the way, each a node's distance to the surface without it, add up to no more than ``off_mm``. Lines where three
    surfaces meet, and edges, keep all their nodes; topology is kept.
    """
    import pyvista
    from vtkmodules.vtkFiltersCore import vtkDecimatePro

    whole = pyvista.PolyData.from_regular_faces(borders.points_mm, borders.triangles)
    fewer = vtkDecimatePro(
        input_data=whole, target_reduction=1.0, absolute_error=off_mm, error_is_absolute=True, accumulate_error=True,
        feature_angle=_FLAT_DEG, preserve_topology=True, splitting=False, boundary_vertex_deletion=False,
    )  # fmt: skip
    fewer.Update()
    made = pyvista.wrap(fewer.GetOutput())
    return np.asarray(made.points, dtype=np.float64), np.asarray(made.regular_faces, dtype=np.int64)


def labels_at(labels: LabelMap, borders: Borders, points_mm: FloatArray) -> IntArray:
    """Label of the tissue whose border encloses each point (n, 3) LPS mm; 0 outside all.

    Smoothing moves borders by a voxel or less: where all voxels around a point have one label, it is that.
    """
    import pyvista
    from vtkmodules.vtkFiltersModeling import vtkSelectEnclosedPoints

    voxels = np.pad(labels.labels, _AROUND + 1)
    indices = np.rint(labels.grid.indices_of(points_mm)).astype(np.int64) + _AROUND + 1
    nearest = tuple(np.clip(indices, 0, np.array(voxels.shape) - 1).T)
    near = {n: maximum_filter((voxels == n).view(np.uint8), 2 * _AROUND + 1)[nearest] > 0 for n in np.unique(voxels)}
    unsure = np.sum(list(near.values()), axis=0) > 1
    enclosing = np.where(unsure, 0, voxels[nearest])
    for label in np.unique(borders.sides[borders.sides > 0]):
        asked = np.flatnonzero(near[label] & unsure & (enclosing == 0))
        triangles = borders.triangles[(borders.sides == label).any(axis=1)]
        surface = pyvista.PolyData.from_regular_faces(borders.points_mm, triangles)
        cloud = pyvista.PolyData(points_mm[asked])
        within = vtkSelectEnclosedPoints(input_data=cloud, surface_data=surface, tolerance=1e-9)
        within.Update()
        enclosing[asked[pyvista.wrap(within.GetOutput())["SelectedPoints"] > 0]] = label
    return enclosing


def with_volumes(
    points_mm: FloatArray, cells: IntArray, tissue: IntArray, volumes_mm3: dict[int, float], farthest_mm: float
) -> FloatArray:
    """Nodes (n, 3) on the borders moved until each tissue encloses its volume, by label; mm, in any frame.

    ``cells`` (m, 4) fill a box and ``tissue`` (m,) labels them; labels without a volume, such as that of air, get the
    rest. A step moves nodes along the gradients of the volumes, by one factor for each label: the least sum over the
    nodes of the distance squared, times the area of all tissues' borders around the node, that changes the volumes as
    wanted, to first order. A smoothed thin cord gets wider by the same distance all around. Where a cell would lose
    four fifths of its volume in a step, or turn over, its nodes move by half as much, and so on. A node moves no
    farther than ``farthest_mm`` in each of three steps, even if volumes are still off then.
    """
    points = points_mm.copy()
    labels = list(volumes_mm3)
    low, high = (np.full(len(points), start) for start in (np.iinfo(int).max, np.iinfo(int).min))
    np.minimum.at(low, cells, tissue[:, None])
    np.maximum.at(high, cells, tissue[:, None])
    border = np.flatnonzero(low < high)
    for _ in range(_SHIFTS):
        corners = points[cells]
        volume = signed_volumes(corners)
        slope = np.zeros((len(labels), len(points), 3))  # of each label's volume by its nodes, mm^2
        for corner, (a, b, c) in enumerate(FACES):
            vector = np.cross(corners[:, b] - corners[:, a], corners[:, c] - corners[:, a]) / 6.0
            up = np.sign(np.einsum("ij,ij->i", vector, corners[:, corner] - corners[:, a]))
            for n, label in enumerate(labels):
                own = tissue == label
                np.add.at(slope[n], cells[own, corner], (up[:, None] * vector)[own])
        slope = slope[:, border]
        area = np.linalg.norm(slope, axis=2).sum(axis=0)
        way = slope / np.maximum(area, 1e-12)[:, None]
        missing = [volumes_mm3[label] - np.abs(volume[tissue == label]).sum() for label in labels]
        factors = np.linalg.lstsq(np.einsum("ink,jnk->ij", way, slope), np.array(missing), rcond=1e-9)[0]
        step = np.einsum("i,ink->nk", factors, way)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        moves = np.zeros_like(points)
        moves[border] = step * np.minimum(1.0, farthest_mm / np.maximum(length, 1e-12))
        points += _without_turning(points, cells, moves)
    return points


def _without_turning(points: FloatArray, cells: IntArray, moves: FloatArray) -> FloatArray:
    """The moves, halved around cells that they would turn over or all but flatten."""
    moves = moves.copy()
    before = signed_volumes(points[cells])
    for _ in range(_HALVINGS):
        flat = signed_volumes((points + moves)[cells]) * np.sign(before) < _LEAST_LEFT * np.abs(before)
        if not flat.any():
            return moves
        moves[np.unique(cells[flat])] *= 0.5
    moves[np.unique(cells[flat])] = 0.0
    return moves
