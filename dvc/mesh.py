"""A mesh of linear tetrahedra with named regions and facets, checked once at construction."""

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from dvc.arguments import check
from dvc.arrays import BoolArray, FloatArray, IntArray, frozen
from dvc.errors import ExtentError, GeometryError, InputError

_log = logging.getLogger("dvc.mesh")

_SMALLEST_EXTENT_MM = 1.0  # a body part in metres is 0.05 to 0.5 "mm" across
_LARGEST_EXTENT_MM = 5000.0  # a body part in mm that was declared as metres is 50,000 mm across or more
_DEGENERATE = 1e-9  # volume over the longest edge cubed; 0.118 for a regular tetrahedron
_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
FACES = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))
"""Nodes of a tetrahedron's faces; face i lies opposite to node i."""


@dataclass(frozen=True, slots=True, eq=False)
class TetMesh:
    """Linear tetrahedra in the reference configuration, LPS mm.

    Parameters
    ----------
    points_mm : (n, 3)
        Nodes, LPS mm, finite.
    cells : (m, 4) int
        Node indices of each tetrahedron. Its volume det(X1 - X0, X2 - X0, X3 - X0) / 6 is positive, in mm3.
    regions : mapping of str to (k,) int, optional
        Indices of the cells in each named region; regions may overlap and need not cover the mesh.
    facets : mapping of str to (k, 3) int, optional
        Node indices of the triangles on each named surface.
    node_ids : (n,) int, optional
        The number of each node in the numbering it came from; 0 to n - 1 by default.

    Raises
    ------
    InputError
        If a shape or a type is wrong, an index is out of range, a region is empty, or a node id is repeated.
    GeometryError
        If a coordinate is not finite, a cell has no volume, the mesh folds over itself, or its size is not
        that of a body part in mm.

    Notes
    -----
    What is provably safe is mended, and logged (logger ``dvc.mesh``): nodes that no cell uses are dropped (``node_ids``
    keeps the numbers of the others), and two nodes are swapped in cells of negative volume. Where all cells are
    negative the file merely counts the other way round. Where only some are, they are mended only if the cells on
    either side of every face lie on opposite sides of it; otherwise the tissue folds over itself, which is refused.

    Examples
    --------
    >>> corner = TetMesh([[0, 0, 0], [6, 0, 0], [0, 6, 0], [0, 0, 6]], [[0, 1, 2, 3]], {"fat": [0]})
    >>> corner.volumes_mm3.tolist(), corner.centroids_mm.tolist()
    ([36.0], [[1.5, 1.5, 1.5]])
    """

    points_mm: FloatArray
    cells: IntArray
    regions: Mapping[str, IntArray]
    facets: Mapping[str, IntArray]
    node_ids: IntArray

    def __init__(
        self, points_mm: npt.ArrayLike, cells: npt.ArrayLike, regions: Mapping[str, npt.ArrayLike] | None = None,
        facets: Mapping[str, npt.ArrayLike] | None = None, node_ids: npt.ArrayLike | None = None,
    ) -> None:  # fmt: skip
        points = checked_points(points_mm)
        tets = checked_indices("cells", cells, len(points), 4)
        if len(tets) == 0:
            raise InputError("The mesh has no tetrahedra.")
        ids = np.arange(len(points)) if node_ids is None else np.asarray(node_ids)
        if ids.shape != (len(points),) or ids.dtype.kind not in "iu" or len(np.unique(ids)) != len(ids):
            got = f"got shape {ids.shape} of {ids.dtype}, {len(np.unique(ids))} of them different"
            raise InputError(f"node_ids must be a different whole number for each of the {len(points)} nodes; {got}.")
        for name, named in (("regions", regions), ("facets", facets)):
            check(name, named, Mapping[str, IntArray] | None)
        named_cells = {n: checked_indices(f"region {n!r}", i, len(tets)) for n, i in (regions or {}).items()}
        named_facets = {n: checked_indices(f"facets {n!r}", i, len(points), 3) for n, i in (facets or {}).items()}
        for name, index in [*named_cells.items(), *named_facets.items()]:
            if len(index) == 0:
                raise InputError(f"{name!r} is empty. Leave it out, or check how the mesh was made.")
        tets = _positively_ordered(points, tets, ids)
        used = np.zeros(len(points), dtype=bool)
        used[tets] = True
        if not used.all():
            for name, index in named_facets.items():
                if not used[index].all():
                    raise InputError(f"facets {name!r} use nodes that are not in any tetrahedron.")
            _log.info(
                "%d of %d nodes are not in any tetrahedron and are removed; the first is node %d.",
                np.count_nonzero(~used), len(used), ids[np.argmin(used)],
            )  # fmt: skip
            new_index = np.cumsum(used) - 1
            points, ids, tets = points[used], ids[used], new_index[tets]
            named_facets = {name: new_index[index] for name, index in named_facets.items()}
        check_extent(points)
        object.__setattr__(self, "points_mm", frozen(points, np.float64))
        for name, indices in (("cells", tets), ("node_ids", ids)):
            object.__setattr__(self, name, frozen(indices, np.int64))
        for name, named in (("regions", named_cells), ("facets", named_facets)):
            sealed = {key: frozen(index, np.int64) for key, index in named.items()}
            object.__setattr__(self, name, MappingProxyType(sealed))

    @property
    def volumes_mm3(self) -> FloatArray:
        """Volume of each cell, (m,) mm3, positive."""
        return signed_volumes(self.points_mm[self.cells])

    @property
    def centroids_mm(self) -> FloatArray:
        """Mean of each cell's four nodes, (m, 3) LPS mm."""
        return np.asarray(self.points_mm[self.cells].mean(axis=1))

    @property
    def bounds_mm(self) -> FloatArray:
        """Least and greatest coordinates of the nodes, (2, 3) LPS mm."""
        return np.stack([self.points_mm.min(axis=0), self.points_mm.max(axis=0)])


def outer_faces(cells: IntArray) -> IntArray:
    """Faces (k, 3) of tetrahedra (m, 4) that belong to one of them alone, by their nodes in rising order."""
    different, times = np.unique(faces_of(cells), axis=0, return_counts=True)
    return np.asarray(different[times == 1])


def faces_of(cells: IntArray) -> IntArray:
    """The faces (4 m, 3) of tetrahedra (m, 4), the first of each, then the second and so on; nodes in rising order."""
    return np.sort(np.concatenate([cells[:, face] for face in FACES]), axis=1)


def repeated_rows(rows: FloatArray | IntArray) -> IntArray:
    """Indices, rising, of the rows of (n, k) that are equal to an earlier row.

    Examples
    --------
    >>> repeated_rows(np.array([[1, 2], [3, 4], [1, 2]])).tolist()
    [2]
    """
    order = np.lexsort(rows.T)
    same = (rows[order[1:]] == rows[order[:-1]]).all(axis=1)
    return np.asarray(np.sort(order[1:][same]))


def checked_points(points_mm: npt.ArrayLike) -> FloatArray:
    """Nodes (n, 3); InputError for another shape, GeometryError for a coordinate that is not finite."""
    try:
        points = np.array(points_mm, dtype=np.float64)
    except (TypeError, ValueError) as wrong:
        raise InputError(f"Nodes of a mesh must be an (n, 3) array of numbers ({wrong}).") from wrong
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise InputError(f"Nodes of a mesh must be an (n, 3) array of coordinates; got shape {points.shape}.")
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        what = f"{np.count_nonzero(bad)} of {len(points)} nodes have a coordinate that is not a finite number"
        raise GeometryError(f"{what}; the first is at index {np.argmax(bad)}.")
    return points


def checked_indices(what: str, index: npt.ArrayLike, count: int, width: int | None = None) -> IntArray:
    """Integer indices below ``count``, (k,) or (k, width); InputError for another type, shape or range."""
    try:
        array = np.asarray(index)
    except ValueError as wrong:
        raise InputError(f"{what}: indices must be an array of integers ({wrong}).") from wrong
    if array.size == 0:
        array = array.reshape((0,) if width is None else (0, width)).astype(np.int64)
    if not np.issubdtype(array.dtype, np.integer):
        raise InputError(f"{what}: indices must be integers; got {array.dtype}.")
    if array.ndim != (1 if width is None else 2) or (width is not None and array.shape[1] != width):
        wanted = "(k,)" if width is None else f"(k, {width})"
        raise InputError(f"{what}: indices must have shape {wanted}; got {array.shape}.")
    array = array.astype(np.int64)
    outside = (array < 0) | (array >= count)
    if outside.any():
        first = np.argwhere(outside)[0]
        where = f"the first is {array[tuple(first)]}, in row {first[0]}"
        raise InputError(f"{what}: {np.count_nonzero(outside)} indices are outside 0 to {count - 1}; {where}.")
    return array


def box_told(low: FloatArray, high: FloatArray) -> str:
    """A box by its lower and upper corner (3,), for messages: '-15 to 5 x 0 to 120 x 0.01 to 0.06'."""
    edges = [[f"{v:.0f}" if abs(v) >= 10.0 else f"{v:.3g}" for v in pair] for pair in zip(low, high, strict=True)]
    return " x ".join(f"{a} to {b}" for a, b in edges)


def check_extent(points_mm: FloatArray) -> None:
    """ExtentError for a mesh that is not the size of a body part in mm: its longest side is under 1 mm or over 5 m."""
    extent = float(np.ptp(points_mm, axis=0).max())
    spans = f"It spans {box_told(points_mm.min(axis=0), points_mm.max(axis=0))} (mm as read)."
    if extent < _SMALLEST_EXTENT_MM:
        raise ExtentError(
            f"The mesh is {extent:.3g} mm across, which is too small for a mesh in mm: its coordinates are "
            f"probably in metres. {spans} If so, set unit='m' (--mesh-unit m; compare: --model-unit m)."
        )
    if extent > _LARGEST_EXTENT_MM:
        raise ExtentError(
            f"The mesh is {extent / 1000:.4g} m across, which is too large for a body part: its coordinates are "
            f"probably in mm, or in a smaller unit. {spans} Set unit='mm' (--mesh-unit mm; compare: --model-unit "
            "mm), or scale the coordinates to mm."
        )


def signed_volumes(corners: FloatArray) -> FloatArray:
    """Volumes (...) of tetrahedra by corners (..., 4, 3); positive if corners 0, 1, 2 turn left, seen from corner 3."""
    a, b, c = (corners[..., i, :] - corners[..., 0, :] for i in (1, 2, 3))
    return np.asarray(np.einsum("...j,...j->...", a, np.cross(b, c)) / 6.0)


def _positively_ordered(points: FloatArray, cells: IntArray, node_ids: IntArray) -> IntArray:
    """Give every cell a positive volume, or refuse, naming nodes by ``node_ids``; see the notes of TetMesh."""
    volumes = signed_volumes(points[cells])
    longest = np.max([np.linalg.norm(points[cells[:, i]] - points[cells[:, j]], axis=1) for i, j in _EDGES], axis=0)
    flat = np.abs(volumes) <= _DEGENERATE * longest**3
    if flat.any():
        first = int(np.argmax(flat))
        raise GeometryError(
            f"{np.count_nonzero(flat)} of {len(cells)} tetrahedra are degenerate (no volume); the first is "
            f"cell {first}, nodes {node_ids[cells[first]].tolist()}, {volumes[first]:.3g} mm3. Remove these cells or "
            "remesh in the program that made the mesh."
        )
    negative = volumes < 0
    if not negative.any():
        return cells
    if not negative.all() and (overlapping := _overlapping(points, cells)).any():
        first = int(np.argmax(overlapping))
        raise GeometryError(
            f"The mesh folds over itself: {np.count_nonzero(negative)} of {len(cells)} tetrahedra are inverted "
            f"(negative volume), and {np.count_nonzero(overlapping)} overlap a neighbour across a common face. The "
            f"first is cell {first}, nodes {node_ids[cells[first]].tolist()}. Repair it in the program that made it."
        )
    _log.warning(
        "%d of %d tetrahedra have the opposite node order (negative volume); two nodes of each were swapped. Shape "
        "and position are unchanged, and no cell overlaps its neighbour.",
        np.count_nonzero(negative), len(cells),
    )  # fmt: skip
    ordered = cells.copy()
    ordered[negative, 2], ordered[negative, 3] = cells[negative, 3], cells[negative, 2]
    return ordered


def _overlapping(points: FloatArray, cells: IntArray) -> BoolArray:
    """Which cells have a face whose cells do not lie one on either side of it (or that three cells share)."""
    faces = faces_of(cells)
    opposite, owner = cells.T.ravel(), np.tile(np.arange(len(cells)), 4)
    which = np.unique(faces, axis=0, return_inverse=True)[1].ravel()
    side = np.sign(signed_volumes(points[np.column_stack([faces, opposite])]))
    shared_by = np.bincount(which)
    balance = np.bincount(which, weights=side)  # 0 where two cells lie on opposite sides
    wrong = (shared_by > 2) | ((shared_by == 2) & (balance != 0))
    return np.isin(np.arange(len(cells)), owner[wrong[which]])
