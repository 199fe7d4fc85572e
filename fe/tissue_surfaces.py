"""Smooth interfaces between the tissues of a label map, and meshes that keep the volumes of the tissues."""

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
_AROUND = 2  # voxels around a point that may contain the tissue whose surface encloses it
_SHIFTS = 3
_LEAST_LEFT = 0.2  # of a cell's volume, in one shift
_HALVINGS = 6


@dataclass(frozen=True, slots=True, eq=False)
class Borders:
    """Triangles of the interfaces between tissues, and of the outer surface."""

    points_mm: FloatArray  # (n, 3) LPS
    triangles: IntArray  # (m, 3)
    sides: IntArray  # (m, 2) labels on either side; 0 is outside


def borders_of(labels: LabelMap) -> Borders:
    """Interfaces between all labels of a map: surface nets through the voxel faces, smoothed by a windowed sinc filter.

    Surface nets (S. F. Frisken 1999, doi:10.1007/10704282_102) leave no gap where three tissues meet. The filter
    (G. Taubin and others 1996, doi:10.1007/BFb0015544) smooths without shrinking.
    """
    import pyvista

    grid = labels.grid
    image = pyvista.ImageData(dimensions=grid.shape, spacing=grid.spacing_mm)
    image["labels"] = labels.labels.astype(np.int32).ravel(order="F")
    net = image.contour_labels("all", output_mesh_type="triangles", smoothing=False)  # closed at the image's edge
    if not net.n_cells:
        raise MrstrainError("The label map is empty: it has no surface or interface to mesh. Choose another file.")
    made = net.smooth_taubin(
        n_iter=_PASSES, pass_band=_PASS_BAND, non_manifold_smoothing=True, normalize_coordinates=True
    )
    points_mm = np.asarray(made.points, dtype=np.float64) @ grid.direction.T + grid.origin_mm
    triangles, sides = (np.asarray(of, dtype=np.int64) for of in (made.regular_faces, net["boundary_labels"]))
    return Borders(points_mm, triangles, sides)


def thinned(borders: Borders, off_mm: float) -> tuple[FloatArray, IntArray]:
    """Points (n, 3), LPS mm, and triangles (m, 3) of the same surfaces, with fewer triangles where they are flat.

    Nodes are removed one by one (W. J. Schroeder and others 1992, doi:10.1145/142920.134010) while the sum of the
    errors is at most ``off_mm``; the error of a step is the distance of the removed node to the new surface. Edges, and
    lines where three surfaces meet, keep all their nodes. The topology does not change.
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
    """Label of the tissue whose surface encloses each point (n, 3) LPS mm; 0 outside all tissues.

    Smoothing moves surfaces by at most a voxel. If all voxels around a point have the same label, that label is used.
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
    """Nodes (n, 3), mm, any frame, with those on the interfaces moved until each tissue has its volume (by label).

    ``cells`` (m, 4) fill a box and ``tissue`` (m,) labels them; labels without a volume, such as air, take the rest.
    A step moves the nodes along the gradients of the volumes, by one factor for each label. To first order it changes
    the volumes as required with the smallest sum of squared distances, weighted by the area of all interfaces around
    each node. A smoothed thin cord, for example, widens by the same distance all around. If a cell would be inverted or
    lose four fifths of its volume in a step, the moves of its nodes are halved, repeatedly if needed. A node moves at
    most ``farthest_mm`` in each of three steps, even if the volumes are not reached.
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
    """The moves, halved around cells that they would invert or nearly flatten."""
    moves = moves.copy()
    before = signed_volumes(points[cells])
    for _ in range(_HALVINGS):
        flat = signed_volumes((points + moves)[cells]) * np.sign(before) < _LEAST_LEFT * np.abs(before)
        if not flat.any():
            return moves
        moves[np.unique(cells[flat])] *= 0.5
    moves[np.unique(cells[flat])] = 0.0
    return moves
