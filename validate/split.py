"""Cells of any kind as linear tetrahedra: what one evaluator of deformations needs."""

from __future__ import annotations

import logging

import numpy as np

from dvc.arrays import FloatArray, IntArray
from dvc.errors import GeometryError
from dvc.mesh import TetMesh, outer_faces
from dvc.meshfile import CellBlock, MeshFile

_log = logging.getLogger("validate.split")

# Tetrahedra by the places of their corners in the cell's own list of nodes (VTK's order).
_CHILDREN = {
    "tetra": [(0, 1, 2, 3)],
    "tetra10": [(0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3), (6, 8, 4, 5), (6, 8, 5, 9), (6, 8, 9, 7),
                (6, 8, 7, 4)],
    "hexahedron": [(0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)],
    "wedge": [(0, 1, 2, 5), (0, 1, 5, 4), (0, 4, 5, 3)],
    "pyramid": [(0, 1, 2, 4), (0, 2, 3, 4)],
}  # fmt: skip


def linear_tetrahedra(mesh: MeshFile) -> tuple[TetMesh, IntArray]:
    """A mesh file's volume cells as linear tetrahedra, and for each of its nodes that of the file (n,).

    A quadratic tetrahedron becomes eight, through the middles of its edges; of other quadratic cells only the corners
    are used, which is said in the log (``validate.split``). Regions and named surfaces are kept.

    Raises
    ------
    GeometryError
        If a cell is folded.
    """
    cells: list[IntArray] = []
    first = np.zeros(mesh.cell_count + 1, dtype=np.int64)  # of each cell's children
    at = 0
    for block in mesh.blocks:
        children = _CHILDREN.get(block.kind) or _CHILDREN.get(block.shape)
        count = 0 if children is None else len(children)
        first[at + 1 : at + 1 + len(block.nodes)] = count
        at += len(block.nodes)
        if children is None:
            continue
        if block.kind not in _CHILDREN:
            _log.warning("Of cells of kind %s only the corner nodes are used.", block.kind)
        cells.append(_oriented(mesh.points_mm, block, np.array(children)))
    first = np.cumsum(first)
    every = np.concatenate(cells)
    regions, facets = {}, {}
    flat = _triangles(mesh)
    for name, index in mesh.regions.items():
        members = [np.arange(first[c], first[c + 1]) for c in index if first[c + 1] > first[c]]
        if members:
            regions[name] = np.concatenate(members)
        triangles = [flat[c] for c in index.tolist() if c in flat]
        if triangles:
            facets[name] = np.concatenate(triangles)
    if mesh.tets is not None:  # sets of nodes; the tetrahedra's own nodes are some of the file's
        order = np.argsort(mesh.node_ids)
        place = order[np.searchsorted(mesh.node_ids, mesh.tets.node_ids, sorter=order)]
        facets = {name: place[rows] for name, rows in mesh.tets.facets.items()} | facets
    used = np.zeros(len(mesh.points_mm), dtype=bool)
    used[every] = True
    facets = {name: rows[used[rows].all(axis=1)] for name, rows in facets.items()}
    made = TetMesh(
        mesh.points_mm, every, regions, {n: r for n, r in facets.items() if len(r)}, np.arange(len(mesh.points_mm))
    )
    return made, made.node_ids


def _oriented(points: FloatArray, block: CellBlock, children: IntArray) -> IntArray:
    tets = block.nodes[:, children]  # (m, children, 4)
    corner = points[tets]
    volume = np.linalg.det(corner[:, :, 1:] - corner[:, :, :1])
    if block.shape != "tetra":  # the order of a tetrahedron's nodes is judged with its neighbours', by TetMesh
        sign = np.sign(volume)
        mixed = np.abs(sign.sum(axis=1)) < len(children)
        if mixed.any():
            raise GeometryError(
                f"{np.count_nonzero(mixed)} {block.kind} cells are folded or flat, first that with nodes "
                f"{block.nodes[np.argmax(mixed)].tolist()}. Mend the mesh where it was made."
            )
        swapped = tets[:, :, [0, 1, 3, 2]]
        tets = np.where((volume < 0.0)[:, :, None], swapped, tets)
    elif len(children) > 1:  # children as the parent: the same way round
        reference = _REFERENCE10[children]
        flip = np.linalg.det(reference[:, 1:] - reference[:, :1]) < 0.0
        tets = np.where(flip[None, :, None], tets[:, :, [0, 1, 3, 2]], tets)
    return np.asarray(tets.reshape(-1, 4))


_CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
_REFERENCE10 = np.concatenate(
    [_CORNERS, [_CORNERS[list(e)].mean(axis=0) for e in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]]
)


def _triangles(mesh: MeshFile) -> dict[int, IntArray]:
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


def outer_nodes(mesh: TetMesh) -> IntArray:
    """Nodes on the outside of a mesh."""
    return np.unique(outer_faces(mesh.cells))
