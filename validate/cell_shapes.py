"""Shapes of cells by their nodes (VTK's order): faces as triangles, and interpolated mid-face and mid-cell nodes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvc.arrays import FloatArray, IntArray

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

    @property
    def edged(self) -> int:
        """Number of corners and edges: the nodes that every quadratic cell of this shape has."""
        return len(self.corners) + len(self.edges)

    def around(self, face: Nodes) -> Nodes:
        """Nodes of a quadratic cell along the rim of a face: a corner, the middle of an edge, and so on."""
        middle = {frozenset(edge): len(self.corners) + n for n, edge in enumerate(self.edges)}
        pairs = zip(face, (*face[1:], face[0]), strict=True)
        return tuple(n for a, b in pairs for n in (a, middle[frozenset((a, b))]))

    @property
    def nodes(self) -> FloatArray:
        """Reference coordinates of corners and middles of edges."""
        return np.concatenate([self.corners, [self.corners[list(edge)].mean(axis=0) for edge in self.edges]])

    def weights(self, nodes: Nodes, corners: Nodes) -> FloatArray:
        """Weights with which ``nodes`` give the value at the mean of ``corners``."""
        return weights(self.nodes[list(nodes)], self.corners[list(corners)].mean(axis=0))

    def halved(self, face: Nodes) -> IntArray:
        """Triangles (k, 3) of half its size that make up a face of a quadratic cell.

        A quadrangle's have its middle in common: node number `edged` and on, in the order of the quadrangles.
        """
        rim = self.around(face)
        if len(face) == 3:
            a, ab, b, bc, c, ca = rim
            return np.array([(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)])
        middle = self.edged + self.quadrangles.index(face)
        return np.array([(rim[i], rim[(i + 1) % 8], middle) for i in range(8)])


def weights(nodes: FloatArray, point: FloatArray) -> FloatArray:
    """Weights (n,) by which values at nodes (n, 3) give that at a point (3,), exact for every quadratic field.

    The least ones that do so: those of the serendipity elements in the middles of their faces and bodies.
    """

    def monomials(at: FloatArray) -> FloatArray:
        x, y, z = at.T
        return np.stack([np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], axis=1)

    return np.asarray(np.linalg.pinv(monomials(nodes).T) @ monomials(point[None])[0])


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
