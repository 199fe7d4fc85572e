"""A mesh with its materials, discretised by an element: what is assembled, and what its states mean."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from dvc import TetMesh
from dvc.arrays import FloatArray, IntArray
from fe.elements import Element, Space
from fe.materials import Materials

CROWDED = 0.4
"""det F below which a cell resists with an energy of its own, K / 3 ln(CROWDED / J)^3, so that it does not fold."""


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A mesh of m cells with its k materials, discretised by an element."""

    element: Element
    space: Space
    volumes_mm3: FloatArray  # (m,)
    inverse: FloatArray  # (m, 3, 3) reference coordinates by position, 1/mm
    vectors: FloatArray  # (k, v) of the material laws, see `fe.hyperelastic`
    shear_mpa: FloatArray  # (k,) initial
    bulk_mpa: FloatArray  # (k,)
    law: IntArray  # (m,) number of each cell's material law

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
        """The part of each material's bulk modulus (k,) that acts in each cell on its own; at most half of it."""
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

    def gradients(self, state: FloatArray) -> FloatArray:
        """H = du/dX of each cell (m, 3, 3), mean over its quadrature points, at a state of all unknowns."""
        table = np.einsum("q,qaj->aj", self.element.weights, self.element.gradients)
        u = state[: 3 * len(self.space.nodes_mm)].reshape(-1, 3)[self.space.cells]
        return np.asarray(np.einsum("mai,aj,mjk->mik", u, table, self.inverse))

    def pressures(self, state: FloatArray) -> FloatArray:
        """Pressure at each cell's corners (m, 4), MPa: the field's, and the part that acts in the cell on its own."""
        volume = np.linalg.det(np.eye(3) + self.gradients(state))
        crowded = np.log(CROWDED / np.clip(volume, 1e-12, CROWDED)) ** 2 / volume
        own = self.own_bulk_mpa[self.law] * (volume - 1.0) - self.bulk_mpa[self.law] * crowded
        return np.asarray(state[3 * len(self.space.nodes_mm) :][self.space.pressure_cells] + own[:, None])
