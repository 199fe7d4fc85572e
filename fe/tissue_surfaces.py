"""Smooth surfaces between the tissues of a label map, and meshes between them that keep the tissues' volumes."""

from dataclasses import dataclass

import numpy as np

from dvc import LabelMap
from dvc.arrays import FloatArray, IntArray
from dvc.errors import MrstrainError
from dvc.mesh import FACES, signed_volumes

_PASS_BAND = 0.03  # of a windowed sinc filter: 40 steps of plain relaxation take 7 % of a thin muscle, this takes 0.1 %
_PASSES = 20
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
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkSurfaceNets3D, vtkWindowedSincPolyDataFilter

    grid = labels.grid
    padded = np.pad(labels.labels.astype(np.int32), 1)  # closed at the image's edge
    present = [int(v) for v in np.unique(padded) if v > 0]
    image = vtkImageData(dimensions=padded.shape, spacing=grid.spacing_mm, origin=-grid.spacing_mm)
    image.GetPointData().SetScalars(numpy_to_vtk(padded.ravel(order="F"), deep=True))
    nets = vtkSurfaceNets3D(input_data=image, number_of_labels=len(present), smoothing=False)
    for number, label in enumerate(present):
        nets.SetLabel(number, label)
    nets.SetOutputMeshTypeToTriangles()
    smooth = vtkWindowedSincPolyDataFilter(
        input_connection=nets.output_port, number_of_iterations=_PASSES, pass_band=_PASS_BAND,
        non_manifold_smoothing=True, boundary_smoothing=True, normalize_coordinates=True,
    )  # fmt: skip
    smooth.Update()
    net, made = nets.GetOutput(), smooth.GetOutput()
    if not made.GetNumberOfPolys():
        raise MrstrainError("There is no border between tissues in the label map.")
    own = vtk_to_numpy(made.GetPoints().GetData()).astype(np.float64)
    return Borders(
        own @ grid.direction.T + grid.origin_mm,
        vtk_to_numpy(made.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(np.int64),
        vtk_to_numpy(net.GetCellData().GetArray("BoundaryLabels")).astype(np.int64),
    )


def labels_at(borders: Borders, points_mm: FloatArray) -> IntArray:
    """Label of the tissue that encloses each point (n, 3) LPS mm; 0 outside all."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkFiltersModeling import vtkSelectEnclosedPoints

    def points_of(values: FloatArray) -> vtkPolyData:
        data, points = vtkPolyData(), vtkPoints()
        points.SetData(numpy_to_vtk(np.ascontiguousarray(values), deep=True))
        data.SetPoints(points)
        return data

    enclosing = np.zeros(len(points_mm), dtype=np.int64)
    for label in np.unique(borders.sides[borders.sides > 0]):
        triangles = borders.triangles[(borders.sides == label).any(axis=1)]
        starts, corners = np.arange(0, 3 * len(triangles) + 1, 3), triangles.ravel()
        surface, cells = points_of(borders.points_mm), vtkCellArray()
        cells.SetData(numpy_to_vtkIdTypeArray(starts, deep=True), numpy_to_vtkIdTypeArray(corners, deep=True))
        surface.SetPolys(cells)
        within = vtkSelectEnclosedPoints(input_data=points_of(points_mm), surface_data=surface, tolerance=1e-9)
        within.Update()
        enclosing[vtk_to_numpy(within.GetOutput().GetPointData().GetArray("SelectedPoints")) > 0] = label
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
