"""Conversion of cells of any kind to linear tetrahedra, so that deformations are evaluated by one code."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from dvc import MeshFile, TetMesh
from dvc.arrays import FloatArray, IntArray
from dvc.errors import GeometryError
from dvc.io.meshes.read import CellBlock

Nodes = tuple[int, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Geometry of a kind of cell, of any order."""

    corners: FloatArray  # (c, 3) reference coordinates
    edges: tuple[Nodes, ...]  # pairs of corners, in the order of the midpoint nodes
    faces: tuple[Nodes, ...]  # corners in order around the face; quadrangles in the order of their middle nodes

    @property
    def quadrangles(self) -> tuple[Nodes, ...]:
        """Faces with four corners."""
        return tuple(face for face in self.faces if len(face) == 4)

    def around(self, face: Nodes) -> Nodes:
        """Nodes of a quadratic cell along the rim of a face: a corner, a midpoint node, and so on."""
        middle = {frozenset(edge): len(self.corners) + n for n, edge in enumerate(self.edges)}
        pairs = zip(face, (*face[1:], face[0]), strict=True)
        return tuple(n for a, b in pairs for n in (a, middle[frozenset((a, b))]))

    def weights(self, nodes: Nodes, corners: Nodes) -> FloatArray:
        """Weights of the values at ``nodes`` that give the value at the mean of ``corners``; exact if quadratic.

        They are the smallest such weights: those of serendipity elements at the middles of faces and cells.
        """

        def monomials(at: FloatArray) -> FloatArray:
            x, y, z = at.T
            return np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], axis=1)

        at = np.concatenate([self.corners, [self.corners[list(edge)].mean(axis=0) for edge in self.edges]])
        point = self.corners[list(corners)].mean(axis=0)
        return np.asarray(np.linalg.pinv(monomials(at[list(nodes)]).T) @ monomials(point[None])[0])

    def halved(self, face: Nodes) -> IntArray:
        """Triangles (k, 3) of half the size that make up a face of a quadratic cell.

        Those of a quadrangle share its middle node. Middle nodes follow the edge nodes, in the order of quadrangles.
        """
        rim = self.around(face)
        if len(face) == 3:
            a, ab, b, bc, c, ca = rim
            return np.array([(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)])
        middle = len(self.corners) + len(self.edges) + self.quadrangles.index(face)
        return np.array([(rim[i], rim[(i + 1) % 8], middle) for i in range(8)])


_SQUARE = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
_THIRDS = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]

SHAPES = {
    "tetra": Shape(
        np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]),
        ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)),
        ((0, 1, 2), (0, 1, 3), (1, 2, 3), (2, 0, 3)),
    ),
    "hexahedron": Shape(
        np.array([(x, y, z) for z in (-1.0, 1.0) for x, y in _SQUARE]),
        ((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
        ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7)),
    ),
    "wedge": Shape(
        np.array([(x, y, z) for z in (-1.0, 1.0) for x, y in _THIRDS]),
        ((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)),
        ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    ),
    "pyramid": Shape(
        np.array([*((x, y, 0.0) for x, y in _SQUARE), (0.0, 0.0, 1.0)]),
        ((0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4)),
        ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    ),
}  # fmt: skip
"""Volume cells, by meshio's names."""

_log = logging.getLogger("validate.tetrahedra")

# A ten-node tetrahedron as tetrahedra of positive volume: four at the corners, and four of the octahedron between them.
_TETRA10 = np.array(
    [(0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3), (6, 8, 4, 5), (6, 8, 5, 9), (6, 8, 9, 7), (6, 8, 7, 4)]
)
# Numbers of nodes of the quadratic cells of which all nodes are used.
_SIZES = {"tetra": (10,), "hexahedron": (20, 27), "wedge": (15, 18), "pyramid": (13, 14)}
_FLAT = 1e-9

_Faces = list[tuple[IntArray, IntArray]]  # corners (m, c) of faces of cells, and their triangles (m, k, 3)


def linear_tetrahedra(mesh: MeshFile) -> tuple[TetMesh, sparse.csr_matrix]:
    """The volume cells of a mesh file as linear tetrahedra, and a matrix that maps nodal values to their nodes.

    A quadratic tetrahedron becomes eight tetrahedra, through the midpoints of its edges. Hexahedra, wedges and pyramids
    are divided from their middle, so that neighbours match. In linear cells the middle is the mean of the corners, and
    faces are divided along the diagonal from their lowest node. Quadratic cells are divided through all their nodes
    into tetrahedra of half the cell's size; missing nodes at the middles of quadrangles and cells are interpolated with
    the shape functions of the element. Of cells with nodes in only some of these places, only the corners are used;
    this is logged (``validate.tetrahedra``). Regions and named surfaces are kept. GeometryError for a folded cell.
    """
    nodes = _Nodes(mesh.points_mm)
    cells, parents, faces = list[IntArray](), list[IntArray](), _Faces()
    for numbers, block in _numbered(mesh):
        if block.shape not in SHAPES:
            continue
        whole = block.nodes.shape[1] in _SIZES[block.shape]
        if not whole and block.kind != block.shape:
            _log.warning("Only the corner nodes of the %s cells are used.", block.kind)
        if block.shape == "tetra":
            children = block.nodes[:, _TETRA10] if whole else block.corners[:, None]
            cells.append(children.reshape(-1, 4))
            parents.append(np.repeat(numbers, children.shape[1]))
            faces += _quadratic_faces(block.nodes, SHAPES["tetra"]) if whole else _linear_faces(block)
            continue
        if whole:
            made, middle = _quadratic(block, nodes)
        else:
            corners = block.corners.shape[1]
            made, middle = _linear_faces(block), nodes.add(block.corners, np.full(corners, 1.0 / corners))
        faces += made
        triangles = np.concatenate([part.reshape(-1, 3) for _, part in made])
        of = np.concatenate([np.repeat(np.arange(len(part)), part.shape[1]) for _, part in made])
        cells.append(_outward(nodes.points, triangles, middle, of, block))
        parents.append(numbers[of])
    every, parent = np.concatenate(cells), np.concatenate(parents)
    order = np.argsort(parent, kind="stable")
    starts = np.searchsorted(parent[order], np.arange(mesh.cell_count + 1))
    regions = {
        name: np.concatenate([order[starts[c] : starts[c + 1]] for c in index])
        for name, index in mesh.regions.items()
        if any(starts[c] < starts[c + 1] for c in index)
    }
    surfaces = {name: _on_surface(corners, faces, len(mesh.points_mm)) for name, corners in _surfaces(mesh).items()}
    facets = {name: triangles for name, triangles in surfaces.items() if len(triangles)}
    tets = TetMesh(nodes.points, every, regions, facets, np.arange(len(nodes.points)))
    return tets, nodes.carry[tets.node_ids]


def _numbered(mesh: MeshFile) -> Iterator[tuple[IntArray, CellBlock]]:
    """The blocks of a file, with the numbers of their cells."""
    at = 0
    for block in mesh.blocks:
        yield at + np.arange(len(block.nodes)), block
        at += len(block.nodes)


class _Nodes:
    """Nodes of a file, and new ones between them: ``points`` (n, 3) LPS mm, and ``carry`` (n, nodes of the file)."""

    def __init__(self, points: FloatArray) -> None:
        self.points, self._own = points, points
        self.carry = sparse.identity(len(points), format="csr")

    def add(self, between: IntArray, shares: FloatArray) -> IntArray:
        """New nodes (m,) between nodes of the file (m, k), with weights ``shares`` (k,)."""
        count, before = len(between), len(self.points)
        row = np.repeat(np.arange(count), between.shape[1])
        share = sparse.csr_matrix((np.tile(shares, count), (row, between.ravel())), shape=(count, len(self._own)))
        self.carry = sparse.vstack([self.carry, share], format="csr")
        self.points = np.concatenate([self.points, share @ self._own])
        return np.arange(before, before + count)


def _linear_faces(block: CellBlock) -> _Faces:
    """Faces as triangles; quadrangles are divided from their lowest node."""
    faces: _Faces = []
    for corners in (block.corners[:, list(face)] for face in SHAPES[block.shape].faces):
        count = corners.shape[1]
        turned = np.take_along_axis(corners, (np.argmin(corners, axis=1)[:, None] + np.arange(count)) % count, axis=1)
        faces.append((corners, corners[:, None] if count == 3 else turned[:, np.array([(0, 1, 2), (0, 2, 3)])]))
    return faces


def _quadratic(block: CellBlock, nodes: _Nodes) -> tuple[_Faces, IntArray]:
    """Faces of quadratic cells as triangles of half their size, and the middles (m,) of the cells."""
    shape = SHAPES[block.shape]
    own, edged = block.nodes, len(shape.corners) + len(shape.edges)
    if own.shape[1] == edged:
        # both cells of a quadrangle share its middle node
        rims = [shape.around(face) for face in shape.quadrangles]
        rim = np.concatenate([own[:, list(r)] for r in rims])
        _, first, which = np.unique(np.sort(rim[:, ::2], axis=1), axis=0, return_index=True, return_inverse=True)
        in_face = shape.weights(rims[0], shape.quadrangles[0])
        middles = nodes.add(rim[first], in_face)[which.ravel()].reshape(len(rims), -1).T
        own = np.concatenate([own, middles], axis=1)
    if block.kind == "hexahedron27":
        return _quadratic_faces(own, shape), own[:, 26]
    in_body = shape.weights(tuple(range(edged)), tuple(range(len(shape.corners))))
    return _quadratic_faces(own, shape), nodes.add(own[:, :edged], in_body)


def _quadratic_faces(own: IntArray, shape: Shape) -> _Faces:
    return [(own[:, list(face)], own[:, shape.halved(face)]) for face in shape.faces]


def _outward(points: FloatArray, triangles: IntArray, middle: IntArray, cell: IntArray, block: CellBlock) -> IntArray:
    """Tetrahedra (k, 4) of positive volume between triangles (k, 3) and the middles (m,) of their cells (k,).

    The triangles of a cell have the same orientation on its surface. All normals must point away from the middle, or
    all towards it if the file uses the other orientation; otherwise the cell is folded. This is detected by the volume:
    the tetrahedra of a valid cell add up to the volume that its faces enclose.
    """
    tets = np.concatenate([triangles, middle[cell][:, None]], axis=1)
    corner = points[tets]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1])
    size = np.bincount(cell, np.abs(volume))
    folded = np.abs(np.bincount(cell, volume)) < (1.0 - _FLAT) * size
    folded |= np.bincount(cell, np.abs(volume) <= _FLAT * size[cell]) > 0
    if folded.any():
        raise GeometryError(
            f"{np.count_nonzero(folded)} {block.kind} cells are folded or flat; the first has the nodes "
            f"{block.nodes[np.argmax(folded)].tolist()}. Correct the mesh in the program that made it."
        )
    return np.where((volume < 0.0)[:, None], tets[:, [0, 2, 1, 3]], tets)


def _surfaces(mesh: MeshFile) -> dict[str, list[tuple[int, ...]]]:
    """Faces of each named surface, by their corners: the surface cells of a region, or triangles of a node set."""
    flat: dict[int, tuple[int, ...]] = {}
    for numbers, block in _numbered(mesh):
        if block.shape in ("triangle", "quad"):
            flat |= zip(numbers.tolist(), map(tuple, block.corners.tolist()), strict=True)
    named = {
        name: rows for name, index in mesh.regions.items() if (rows := [flat[c] for c in index.tolist() if c in flat])
    }
    if mesh.tets is not None:  # the nodes of the tetrahedra are a subset of the nodes of the file
        by_id = np.argsort(mesh.node_ids)
        place = by_id[np.searchsorted(mesh.node_ids, mesh.tets.node_ids, sorter=by_id)]
        named = {name: [tuple(r) for r in place[rows].tolist()] for name, rows in mesh.tets.facets.items()} | named
    return named


def _on_surface(corners: list[tuple[int, ...]], faces: _Faces, count: int) -> IntArray:
    """Triangles (k, 3) of the faces with these corners; a face that belongs to no cell is left out."""
    wanted = {tuple(sorted(face)) for face in corners}
    there = np.zeros(count, dtype=bool)
    there[np.concatenate([np.array(face) for face in wanted])] = True
    matching: dict[tuple[int, ...], IntArray] = {}
    for keys, triangles in faces:
        at = np.flatnonzero(there[keys].all(axis=1))
        sets = (tuple(row) for row in np.sort(keys[at], axis=1).tolist())
        matching |= {face: triangles[row] for row, face in zip(at, sets, strict=True) if face in wanted}
    return np.concatenate(list(matching.values())) if matching else np.empty((0, 3), dtype=np.int64)
