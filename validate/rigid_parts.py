"""Parts of a model that move as rigid bodies, such as a plate in the same file: no tissue, and not compared."""

import numpy as np

from dvc import TetMesh
from dvc.arrays import FloatArray
from dvc.deformation.nodal import OnMesh

_NO_STRAIN = 1e-5  # of a rigid part, in single precision
_STRAINED = 1e-3  # some part of a loaded model is strained by more


def without_rigid_parts(mesh: TetMesh, u_mm: FloatArray) -> tuple[TetMesh, FloatArray, tuple[str, ...]]:
    """A mesh and its nodes' displacement (n, 3) without regions that only move and turn; and their names.

    A region is rigid if no component of the Green-Lagrange strain exceeds 1e-5 in any of its cells. If all regions are
    rigid, or nothing is strained by more than 1e-3, nothing is left out.
    """
    F = np.eye(3) + OnMesh(mesh, u_mm).cell_gradients
    strain = np.abs(0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))).max(axis=(1, 2))
    rigid = tuple(name for name, cells in mesh.regions.items() if strain[cells].max() < _NO_STRAIN)
    if not rigid or strain.max() < _STRAINED:
        return mesh, u_mm, ()
    kept = np.ones(len(mesh.cells), dtype=bool)
    kept[np.concatenate([mesh.regions[name] for name in rigid])] = False
    used, cell = np.unique(mesh.cells[kept]), np.cumsum(kept) - 1
    node = np.full(len(mesh.points_mm), -1)
    node[used] = np.arange(len(used))
    regions = {name: cell[cells[kept[cells]]] for name, cells in mesh.regions.items() if kept[cells].any()}
    facets = {name: node[faces[(node[faces] >= 0).all(axis=1)]] for name, faces in mesh.facets.items()}
    facets = {name: faces for name, faces in facets.items() if len(faces)}
    return (
        TetMesh(mesh.points_mm[used], node[mesh.cells[kept]], regions, facets, mesh.node_ids[used]),
        u_mm[used],
        rigid,
    )
