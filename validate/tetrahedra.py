"""Cells of any kind as linear tetrahedra: what one evaluator of deformations needs."""

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
    edges: tuple[Nodes, ...]  # pairs of corners, in the order of the nodes in their middles
    faces: tuple[Nodes, ...]  # corners going around, seen from outside; quadrangles in the order of their middles

    @property
    def quadrangles(self) -> tuple[Nodes, ...]:
        """Faces with four corners."""
        return tuple(face for face in self.faces if len(face) == 4)

    def around(self, face: Nodes) -> Nodes:
        """Nodes of a quadratic cell along the rim of a face: a corner, the middle of an edge, and so on."""
        middle = {frozenset(edge): len(self.corners) + n for n, edge in enumerate(self.edges)}
        pairs = zip(face, (*face[1:], face[0]), strict=True)
        return tuple(n for a, b in pairs for n in (a, middle[frozenset((a, b))]))

    def weights(self, nodes: Nodes, corners: Nodes) -> FloatArray:
        """Weights with which values at ``nodes`` give that at the mean of ``corners``, exact for every quadratic field.

        The least ones that do so: those of the serendipity elements in the middles of their faces and bodies.
        """

        def monomials(at: FloatArray) -> FloatArray:
            x, y, z = at.T
            return np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], axis=1)

        at = np.concatenate([self.corners, [self.corners[list(edge)].mean(axis=0) for edge in self.edges]])
        point = self.corners[list(corners)].mean(axis=0)
        return np.asarray(np.linalg.pinv(monomials(at[list(nodes)]).T) @ monomials(point[None])[0])

    def halved(self, face: Nodes) -> IntArray:
        """Triangles (k, 3) of half its size that make up a face of a quadratic cell.

        A quadrangle's have its middle in common: the nodes after those of the edges, in the order of the quadrangles.
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

# A ten-node tetrahedron, in cells of positive volume: four corners, and the octahedron between them around a diagonal.
_TETRA10 = np.array(
    [(0, 4, 6, 7), (4, 1, 5, 8), (6, 5, 2, 9), (7, 8, 9, 3), (6, 8, 4, 5), (6, 8, 5, 9), (6, 8, 9, 7), (6, 8, 7, 4)]
)
# Numbers of nodes of the quadratic cells that are taken whole.
_SIZES = {"tetra": (10,), "hexahedron": (20, 27), "wedge": (15, 18), "pyramid": (13, 14)}
_FLAT = 1e-9

_Faces = list[tuple[IntArray, IntArray]]  # corners (m, c) of faces of cells, and the triangles (m, k, 3) they became


def linear_tetrahedra(mesh: MeshFile) -> tuple[TetMesh, sparse.csr_matrix]:
    """A mesh file's volume cells as linear tetrahedra, and a matrix that carries nodal values to its nodes.

    A quadratic tetrahedron becomes eight, through the middles of its edges. Hexahedra, wedges and pyramids are cut from
    their middle, and so that neighbours fit: linear ones with the mean of the corners as middle, and faces along the
    diagonal from their lowest node; quadratic ones through all their nodes, and those that the middles of quadrangles
    and of the cell lack by the element's own interpolation, into tetrahedra of half the cell's size. Kinds with nodes
    in some of these places only are taken by their corners, which is said in the log (``validate.tetrahedra``). Regions
    and named surfaces are kept. A folded cell is refused with a `GeometryError`.
    """
    nodes = _Nodes(mesh.points_mm)
    cells, parents, faces = list[IntArray](), list[IntArray](), _Faces()
    for numbers, block in _numbered(mesh):
        if block.shape not in SHAPES:
            continue
        whole = block.nodes.shape[1] in _SIZES[block.shape]
        if not whole and block.kind != block.shape:
            _log.warning("Of cells of kind %s only the corner nodes are used.", block.kind)
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
    """The blocks of a file, each with the numbers of its cells."""
    at = 0
    for block in mesh.blocks:
        yield at + np.arange(len(block.nodes)), block
        at += len(block.nodes)


class _Nodes:
    """A file's nodes, and new ones between them: ``points`` (n, 3) LPS mm, and ``carry`` (n, nodes of the file)."""

    def __init__(self, points: FloatArray) -> None:
        self.points, self._own = points, points
        self.carry = sparse.identity(len(points), format="csr")

    def add(self, between: IntArray, shares: FloatArray) -> IntArray:
        """New nodes (m,) between the file's own (m, k), by shares (k,)."""
        count, before = len(between), len(self.points)
        row = np.repeat(np.arange(count), between.shape[1])
        share = sparse.csr_matrix((np.tile(shares, count), (row, between.ravel())), shape=(count, len(self._own)))
        self.carry = sparse.vstack([self.carry, share], format="csr")
        self.points = np.concatenate([self.points, share @ self._own])
        return np.arange(before, before + count)


def _linear_faces(block: CellBlock) -> _Faces:
    """Faces as triangles, quadrangles cut from their lowest node."""
    faces: _Faces = []
    for corners in (block.corners[:, list(face)] for face in SHAPES[block.shape].faces):
        count = corners.shape[1]
        turned = np.take_along_axis(corners, (np.argmin(corners, axis=1)[:, None] + np.arange(count)) % count, axis=1)
        faces.append((corners, corners[:, None] if count == 3 else turned[:, np.array([(0, 1, 2), (0, 2, 3)])]))
    return faces


def _quadratic(block: CellBlock, nodes: _Nodes) -> tuple[_Faces, IntArray]:
    """Faces of quadratic cells as triangles of half their size, and the cells' middles (m,)."""
    shape = SHAPES[block.shape]
    own, edged = block.nodes, len(shape.corners) + len(shape.edges)
    if own.shape[1] == edged:
        # the middle of a quadrangle is one node for both its cells
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
    """Tetrahedra (k, 4) of positive volume over triangles (k, 3) around the middles (m,) of the cells (k,) they are of.

    The triangles of a cell have the same sense around its surface. The normals of all have to point away from the
    middle, or of all towards it if the file counts the other way round; a cell where one does not is folded, which its
    volume shows: tetrahedra of a valid cell add up to the volume that its faces enclose.
    """
    tets = np.concatenate([triangles, middle[cell][:, None]], axis=1)
    corner = points[tets]
    volume = np.linalg.det(corner[:, 1:] - corner[:, :1])
    size = np.bincount(cell, np.abs(volume))
    folded = np.abs(np.bincount(cell, volume)) < (1.0 - _FLAT) * size
    folded |= np.bincount(cell, np.abs(volume) <= _FLAT * size[cell]) > 0
    if folded.any():
        raise GeometryError(
            f"{np.count_nonzero(folded)} {block.kind} cells are folded or flat, first that with nodes "
            f"{block.nodes[np.argmax(folded)].tolist()}. Mend the mesh where it was made."
        )
    return np.where((volume < 0.0)[:, None], tets[:, [0, 2, 1, 3]], tets)


def _surfaces(mesh: MeshFile) -> dict[str, list[tuple[int, ...]]]:
    """Faces of each named surface, by their corners: the flat cells of a region, or triangles of a set of nodes."""
    flat: dict[int, tuple[int, ...]] = {}
    for numbers, block in _numbered(mesh):
        if block.shape in ("triangle", "quad"):
            flat |= zip(numbers.tolist(), map(tuple, block.corners.tolist()), strict=True)
    named = {
        name: rows for name, index in mesh.regions.items() if (rows := [flat[c] for c in index.tolist() if c in flat])
    }
    if mesh.tets is not None:  # the tetrahedra's own nodes are some of the file's
        by_id = np.argsort(mesh.node_ids)
        place = by_id[np.searchsorted(mesh.node_ids, mesh.tets.node_ids, sorter=by_id)]
        named = {name: [tuple(r) for r in place[rows].tolist()] for name, rows in mesh.tets.facets.items()} | named
    return named


def _on_surface(corners: list[tuple[int, ...]], faces: _Faces, count: int) -> IntArray:
    """Triangles (k, 3) that the faces with these corners became; a face that no cell has is left out."""
    wanted = {tuple(sorted(face)) for face in corners}
    there = np.zeros(count, dtype=bool)
    there[np.concatenate([np.array(face) for face in wanted])] = True
    matching: dict[tuple[int, ...], IntArray] = {}
    for keys, triangles in faces:
        at = np.flatnonzero(there[keys].all(axis=1))
        sets = (tuple(row) for row in np.sort(keys[at], axis=1).tolist())
        matching |= {face: triangles[row] for row, face in zip(at, sets, strict=True) if face in wanted}
    return np.concatenate(list(matching.values())) if matching else np.empty((0, 3), dtype=np.int64)
