"""Cells of any kind as linear tetrahedra: what one evaluator of deformations needs."""

from __future__ import annotations

import logging

import numpy as np
from scipy import sparse

from dvc.arrays import FloatArray, IntArray
from dvc.errors import GeometryError
from dvc.mesh import TetMesh
from dvc.meshfile import CellBlock, MeshFile

_log = logging.getLogger("validate.split")

# A ten-node tetrahedron: four corners, and the octahedron between them around one of its diagonals.
_TETRA10 = np.array(
    [(0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3), (6, 8, 4, 5), (6, 8, 5, 9), (6, 8, 9, 7), (6, 8, 7, 4)]
)
# Faces of the others (VTK's order of corners). Each cell is cut into pyramids from its middle.
_FACES: dict[str, list[tuple[int, ...]]] = {
    "hexahedron": [(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)],
    "wedge": [(0, 1, 2), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)],
    "pyramid": [(0, 1, 2, 3), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)],
}
_FLAT = 1e-9


def linear_tetrahedra(mesh: MeshFile) -> tuple[TetMesh, sparse.csr_matrix]:
    """A mesh file's volume cells as linear tetrahedra, and a matrix that carries nodal values to its nodes.

    A quadratic tetrahedron becomes eight, through the middles of its edges. Hexahedra, wedges and pyramids are cut from
    their middle, which gets the mean of the corners, and faces along the diagonal from their lowest node, so that
    neighbours fit; of quadratic ones only the corners are used, which is said in the log (``validate.split``). Regions
    and named surfaces are kept.

    Returns
    -------
    tets : TetMesh
    carry : (nodes of tets, nodes of the file)

    Raises
    ------
    GeometryError
        If a cell is folded.
    """
    points = [mesh.points_mm]
    known = len(mesh.points_mm)
    weights = [sparse.identity(known, format="csr")]
    cells: list[IntArray] = []
    parents: list[IntArray] = []
    at = 0
    for block in mesh.blocks:
        numbers = at + np.arange(len(block.nodes))
        at += len(block.nodes)
        if block.shape == "tetra":
            children = _tetrahedra(block)
            cells.append(children.reshape(-1, 4))
            parents.append(np.repeat(numbers, children.shape[1]))
        elif block.shape in _FACES:
            if block.kind != block.shape:
                _log.warning("Of cells of kind %s only the corner nodes are used.", block.kind)
            corners = block.corners
            middle = known + np.arange(len(corners))
            row = np.repeat(np.arange(len(corners)), corners.shape[1])
            share = np.full(corners.size, 1.0 / corners.shape[1])
            weights.append(
                sparse.csr_matrix((share, (row, corners.ravel())), shape=(len(corners), len(mesh.points_mm)))
            )
            points.append(mesh.points_mm[corners].mean(axis=1))
            known += len(corners)
            triangles, of = _triangles(corners, _FACES[block.shape])
            cells.append(_outward(np.concatenate(points), triangles, middle[of], block))
            parents.append(numbers[of])
    every, parent = np.concatenate(cells), np.concatenate(parents)
    order = np.argsort(parent, kind="stable")
    starts = np.searchsorted(parent[order], np.arange(mesh.cell_count + 1))
    regions, facets = {}, {}
    flat = _surface(mesh)
    for name, index in mesh.regions.items():
        members = [order[starts[c] : starts[c + 1]] for c in index]
        if sum(map(len, members)):
            regions[name] = np.concatenate(members)
        triangles_of = [flat[c] for c in index.tolist() if c in flat]
        if triangles_of:
            facets[name] = np.concatenate(triangles_of)
    if mesh.tets is not None:  # sets of nodes; the tetrahedra's own nodes are some of the file's
        by_id = np.argsort(mesh.node_ids)
        place = by_id[np.searchsorted(mesh.node_ids, mesh.tets.node_ids, sorter=by_id)]
        facets = {name: place[rows] for name, rows in mesh.tets.facets.items()} | facets
    used = np.zeros(known, dtype=bool)
    used[every] = True
    facets = {name: kept for name, rows in facets.items() if len(kept := rows[used[rows].all(axis=1)])}
    made = TetMesh(np.concatenate(points), every, regions, facets, np.arange(known))
    return made, sparse.vstack(weights, format="csr")[made.node_ids]


def _tetrahedra(block: CellBlock) -> IntArray:
    """Children (m, c, 4) of linear or quadratic tetrahedra, the same way round as their parents."""
    if block.kind != "tetra10":
        return block.corners[:, None]
    reference = _REFERENCE10[_TETRA10]
    flip = np.linalg.det(reference[:, 1:] - reference[:, :1]) < 0.0
    ordered = np.where(flip[:, None], _TETRA10[:, [0, 1, 3, 2]], _TETRA10)
    return block.nodes[:, ordered]


_CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
_REFERENCE10 = np.concatenate(
    [_CORNERS, [_CORNERS[list(e)].mean(axis=0) for e in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]]
)


def _triangles(corners: IntArray, faces: list[tuple[int, ...]]) -> tuple[IntArray, IntArray]:
    """Triangles (k, 3) of the faces of cells (m, c), quadrangles cut from their lowest node; and their cells (k,)."""
    found, of = [], []
    numbers = np.arange(len(corners))
    for face in faces:
        nodes = corners[:, list(face)]
        if len(face) == 3:
            found.append(nodes)
            of.append(numbers)
        else:
            turned = np.take_along_axis(nodes, (np.argmin(nodes, axis=1)[:, None] + np.arange(4)) % 4, axis=1)
            found += [turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]]
            of += [numbers, numbers]
    return np.concatenate(found), np.concatenate(of)


def _outward(points: FloatArray, triangles: IntArray, middle: IntArray, block: CellBlock) -> IntArray:
    """Tetrahedra (k, 4) over triangles and cells' middles, of positive volume.

    Every triangle's normal has to point away from the middle once the faces are followed consistently; a cell where one
    does not is folded. It is found by the volumes: those of a sound cell add up to that of its faces' divergence.
    """
    tets = np.concatenate([triangles, middle[:, None]], axis=1)
    corner = points[tets]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1])
    cell = middle - middle.min()
    around = _turning(triangles, cell)
    signed = volume * around
    size = np.bincount(cell, np.abs(volume))
    folded = np.abs(np.bincount(cell, signed)) < (1.0 - _FLAT) * size
    folded |= np.bincount(cell, np.abs(volume) <= _FLAT * size[cell]) > 0
    if folded.any():
        raise GeometryError(
            f"{np.count_nonzero(folded)} {block.kind} cells are folded or flat, first that with nodes "
            f"{block.nodes[np.argmax(folded)].tolist()}. Mend the mesh where it was made."
        )
    return np.where((volume < 0.0)[:, None], tets[:, [0, 2, 1, 3]], tets)


def _turning(triangles: IntArray, cell: IntArray) -> FloatArray:
    """+1 or -1 for each triangle, so that those of a cell all turn the same way round its surface.

    Two triangles of a closed surface that share an edge turn alike if they run along it in opposite directions.
    """
    count = len(triangles)
    start, end = triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()
    owner = np.repeat(np.arange(count), 3)
    key = np.stack([cell[owner], np.minimum(start, end), np.maximum(start, end)])
    order = np.lexsort(key)
    first, second = order[0::2], order[1::2]
    same = np.where((start < end)[first] == (start < end)[second], -1.0, 1.0)
    turn = np.zeros(count)
    _, at = np.unique(cell, return_index=True)
    turn[at] = 1.0
    a, b = owner[first], owner[second]
    for _ in range(count):
        before = np.count_nonzero(turn)
        known = (turn[a] != 0.0) & (turn[b] == 0.0)
        turn[b[known]] = turn[a[known]] * same[known]
        known = (turn[b] != 0.0) & (turn[a] == 0.0)
        turn[a[known]] = turn[b[known]] * same[known]
        if np.count_nonzero(turn) == before:
            break
    return turn


def _surface(mesh: MeshFile) -> dict[int, IntArray]:
    """Triangles of each flat cell, by its number."""
    found: dict[int, IntArray] = {}
    at = 0
    for block in mesh.blocks:
        if block.shape in ("triangle", "quad"):
            ways = ((0, 1, 2),) if block.shape == "triangle" else ((0, 1, 2), (0, 2, 3))
            for number, corners in enumerate(block.corners):
                found[at + number] = corners[np.array(ways)]
        at += len(block.nodes)
    return found
