"""Mixed tetrahedra for nearly incompressible tissue, with displacement and pressure as two fields.

With W(F) the isochoric part of the constitutive model, K the bulk modulus and p the pressure (positive in tension), the
solution is a stationary point of

    integral W(F) + p (J - 1) - p^2 / (2 K) dX  -  work of the forces,

which for p = K (J - 1) is the constitutive model itself. Pressure is linear in each tetrahedron, continuous within a
tissue, and discontinuous between tissues. There are three choices of displacement:

- ``P1``: linear. Alone it is unstable, so S = tau / mu0 (M - Mbar) is subtracted, where M is the mass matrix of the
  pressure and Mbar that of its mean in the cell (Bochev, Dohrmann, Gunzburger 2006, doi:10.1137/S0036142905444482). A
  small part of the bulk modulus, c mu0, acts in each cell separately, and only the rest acts through the pressure
  field. The constitutive model is the same, and the scatter between cells is smaller.
- ``MINI``: linear and a quartic bubble (Arnold, Brezzi, Fortin 1984, doi:10.1007/BF02576171); stable.
- ``P2``: quadratic (Taylor, Hood 1973); stable, second order in the strain, and expensive.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any, Self

import numpy as np

from dvc import TetMesh
from dvc.arrays import FloatArray, IntArray
from dvc.errors import InputError
from fe.materials import Materials

DESCRIPTIONS = {
    "P1": "stabilised linear tetrahedra, displacement and pressure",
    "MINI": "linear tetrahedra with a bubble, displacement and pressure",
    "P2": "quadratic tetrahedra with straight edges, linear pressure (Taylor-Hood)",
}

CROWDED = 0.4
"""det F below which the solver adds the energy K / 3 ln(CROWDED / J)^3 to a cell, so that it does not fold."""

EDGES = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))
"""Corners of the edges of a quadratic tetrahedron, in the order of its nodes 4 to 9."""


@dataclass(frozen=True, slots=True, eq=False)
class Element:
    """A mixed tetrahedron with ``a`` displacement functions, tabulated at its q quadrature points."""

    name: str
    weights: FloatArray  # (q,) fractions of the cell's volume
    gradients: FloatArray  # (q, a, 3) of the displacement functions, by the reference coordinates (nodes 1, 2 and 3)
    pressure: FloatArray  # (q, 4) pressure functions
    stabilisation: float = 0.0  # tau, no unit; only P1 needs it
    own_volume: float = 0.0  # c, no unit; only P1 has it


def element(name: str) -> Element:
    """An element by its name, P1, MINI or P2."""
    if name not in _MADE:
        raise InputError(f"Unknown element '{name}'; available are {', '.join(_MADE)}.")
    functions, (barycentric, weights), *constants = _MADE[name]
    return Element(name, weights, np.array([functions(b) for b in barycentric]), barycentric, *constants)


_LINEAR = np.array([[-1.0, -1.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def _p1(b: FloatArray) -> FloatArray:
    return _LINEAR


def _mini(b: FloatArray) -> FloatArray:
    others = np.array([np.prod(np.delete(b, i)) for i in range(4)])
    return np.vstack([_LINEAR, 256.0 * others @ _LINEAR])


def _p2(b: FloatArray) -> FloatArray:
    corners = (4.0 * b[:, None] - 1.0) * _LINEAR
    return np.vstack([corners, [4.0 * (b[i] * _LINEAR[j] + b[j] * _LINEAR[i]) for i, j in EDGES]])


def _points(*orbits: tuple[float, tuple[float, ...]]) -> tuple[FloatArray, FloatArray]:
    """Barycentric points and weights from one point of each orbit and the weight of each of its points."""
    points, weights = [], []
    for weight, first in orbits:
        different = sorted(set(permutations(first)))
        points += different
        weights += [weight] * len(different)
    return np.array(points), np.array(weights)


_CENTRE = (0.25, 0.25, 0.25, 0.25)
_A = 0.1381966011250105  # (5 - sqrt 5) / 20
_B, _C, _D = 1.0 / 3.0, 1.0 / 11.0, 0.0665501535736643

_KEAST = _points(
    (0.1817020685825351, _CENTRE),
    (0.0361607142857143, (0.0, _B, _B, _B)),
    (0.0698714945161738, (8.0 * _C, _C, _C, _C)),
    (0.0656948493683187, (_D, _D, 0.5 - _D, 0.5 - _D)),
)  # degree 5, 15 points: P. Keast 1986, doi:10.1016/0045-7825(86)90059-9
# Displacement functions, quadrature (of degree 2 for P2), and the constants tau and c of P1.
_MADE: Mapping[str, tuple[Any, ...]] = {
    "P1": (_p1, _points((1.0, _CENTRE)), 0.5, 1.0),
    "MINI": (_mini, _KEAST),
    "P2": (_p2, _points((0.25, (_A, _A, _A, 1.0 - 3.0 * _A)))),
}


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """Positions and numbering of the unknowns of a mesh."""

    nodes_mm: FloatArray  # (n, 3) reference positions of the displacement nodes; a bubble's is its cell's centroid
    cells: IntArray  # (m, a) displacement nodes, the mesh's own four first
    pressure_cells: IntArray  # (m, 4) pressure unknowns at the corners
    pressures: int  # their number

    @classmethod
    def on(cls, mesh: TetMesh, kind: str, tissue: IntArray) -> Self:
        """The space of an element on a mesh; pressure is discontinuous between different numbers in ``tissue`` (m,)."""
        points, cells = mesh.points_mm, mesh.cells
        if kind == "P2":
            ends = np.sort(np.concatenate([cells[:, list(edge)] for edge in EDGES]), axis=1)
            edges, which = np.unique(ends, axis=0, return_inverse=True)
            middle = len(points) + which.reshape(len(EDGES), -1).T
            points = np.concatenate([points, points[edges].mean(axis=1)])
            cells = np.hstack([cells, middle])
        elif kind == "MINI":
            cells = np.hstack([cells, len(points) + np.arange(len(cells))[:, None]])
            points = np.concatenate([points, mesh.centroids_mm])
        # A corner has one pressure for each tissue that meets there.
        pairs = mesh.cells + len(mesh.points_mm) * np.asarray(tissue)[:, None]
        known, numbered = np.unique(pairs, return_inverse=True)
        return cls(points, np.ascontiguousarray(cells), numbered.reshape(pairs.shape), len(known))

    def nodes_on(self, faces: IntArray) -> IntArray:
        """Displacement nodes (k,) on triangles (n, 3) of the mesh, with those at the midpoints of edges, ascending."""
        corners = np.unique(faces)
        return np.append(corners, self.middles(edges_of(faces))) if self.cells.shape[1] == 10 else corners

    def middles(self, ends: IntArray) -> IntArray:
        """The midpoint node of each edge (k, 2) of a quadratic mesh; edges are corners in ascending order."""
        known = np.sort(np.concatenate([self.cells[:, list(edge)] for edge in EDGES]), axis=1)
        weights = np.array([len(self.nodes_mm), 1])
        keys, first = np.unique(known @ weights, return_index=True)
        return np.asarray(self.cells[:, 4:].T.ravel()[first][np.searchsorted(keys, ends @ weights)])


def edges_of(faces: IntArray) -> IntArray:
    """The edges (k, 2) of triangles (n, 3), each once, corners in ascending order."""
    return np.unique(np.sort(np.concatenate([faces[:, e] for e in ([0, 1], [1, 2], [0, 2])]), axis=1), axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A mesh of m cells with its k materials, discretised by an element."""

    element: Element
    space: Space
    volumes_mm3: FloatArray  # (m,)
    inverse: FloatArray  # (m, 3, 3) reference coordinates by position, 1/mm
    vectors: FloatArray  # (k, v) parameters of the constitutive models, see `fe.hyperelastic`
    shear_mpa: FloatArray  # (k,) initial
    bulk_mpa: FloatArray  # (k,)
    law: IntArray  # (m,) number of each cell's constitutive model

    @classmethod
    def of(cls, mesh: TetMesh, materials: Materials, element: Element) -> Self:
        """The model of a mesh; each cell is in one of the regions of ``materials``."""
        law = np.full(len(mesh.cells), -1)
        for number, region in enumerate(materials):
            law[mesh.regions[region]] = number
        assert (law >= 0).all()
        corners = mesh.points_mm[mesh.cells]
        jacobian = np.stack([corners[:, i] - corners[:, 0] for i in (1, 2, 3)], axis=2)
        length = max(len(material.vector) for material in materials.values())
        vectors = np.array([np.pad(m.vector, (0, length - len(m.vector))) for m in materials.values()])
        inverse = np.asarray(np.linalg.inv(jacobian), dtype=np.float64)
        shear = np.array([m.shear_modulus_mpa for m in materials.values()])
        bulk = np.array([m.bulk_modulus_mpa for m in materials.values()])
        return cls(element, Space.on(mesh, element.name, law), mesh.volumes_mm3, inverse, vectors, shear, bulk, law)

    @property
    def own_bulk_mpa(self) -> FloatArray:
        """The part of each material's bulk modulus (k,) that acts in each cell separately; at most half of it."""
        return np.minimum(self.element.own_volume * self.shear_mpa, 0.5 * self.bulk_mpa)

    @property
    def unknowns(self) -> int:
        """Displacements and pressures."""
        return 3 * len(self.space.nodes_mm) + self.space.pressures

    def unknowns_of_cells(self) -> IntArray:
        """Unknowns of each cell (m, 3 a + 4): its nodes' x, y, z one node after the other, then its pressures."""
        nodes = self.space.cells
        displacement = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)
        return np.hstack([displacement, 3 * len(self.space.nodes_mm) + self.space.pressure_cells])

    def in_order(self, cells: IntArray) -> Self:
        """The same model with its cells in another order (m,)."""
        numbering = self.space.cells[cells], self.space.pressure_cells[cells]
        space = Space(self.space.nodes_mm, *numbering, self.space.pressures)
        return replace(
            self, space=space, volumes_mm3=self.volumes_mm3[cells], inverse=self.inverse[cells], law=self.law[cells]
        )

    def gradients(self, state: FloatArray) -> FloatArray:
        """H = du/dX of each cell (m, 3, 3), mean over its quadrature points, at a state of all unknowns."""
        table = np.einsum("q,qaj->aj", self.element.weights, self.element.gradients)
        u = state[: 3 * len(self.space.nodes_mm)].reshape(-1, 3)[self.space.cells]
        return np.asarray(np.einsum("mai,aj,mjk->mik", u, table, self.inverse))

    def pressures(self, state: FloatArray) -> FloatArray:
        """Pressure at each cell's corners (m, 4), MPa: that of the field, and the part that acts in each cell alone."""
        volume = np.linalg.det(np.eye(3) + self.gradients(state))
        crowded = np.log(CROWDED / np.clip(volume, 1e-12, CROWDED)) ** 2 / volume
        own = self.own_bulk_mpa[self.law] * (volume - 1.0) - self.bulk_mpa[self.law] * crowded
        return np.asarray(state[3 * len(self.space.nodes_mm) :][self.space.pressure_cells] + own[:, None])
