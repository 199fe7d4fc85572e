"""Parts of a model that move as rigid bodies, such as a plate in the same file: no tissue, and not compared."""

import numpy as np
from scipy.spatial.transform import Rotation

from dvc import TetMesh
from dvc.arrays import FloatArray
from dvc.deformation.nodal import OnMesh

_MOVED_MM = 0.05  # tissue that is not loaded hardly moves
_ROUNDED = 1e-5  # of the largest displacement: what the digits of a file leave
_STRAINED = 1e-3  # some part of a loaded model is strained by more


def without_rigid_parts(mesh: TetMesh, u_mm: FloatArray) -> tuple[TetMesh, FloatArray, tuple[str, ...]]:
    """A mesh and its nodes' displacement (n, 3) without regions that only move and turn; and their names.

    A region is rigid if its nodes move by more than 0.05 mm in the median, and no further from one rigid motion than
    1e-5 of the largest displacement. If all regions are rigid, or nothing is strained by more than 1e-3 (Green-Lagrange
    strain), nothing is left out.
    """
    rounded = _ROUNDED * float(np.linalg.norm(u_mm, axis=1).max())
    nodes = {name: np.unique(mesh.cells[cells]) for name, cells in mesh.regions.items()}
    rigid = tuple(name for name, at in nodes.items() if _moves_as_one(mesh.points_mm[at], u_mm[at], rounded))
    if not rigid or not _strained(mesh, u_mm):
        return mesh, u_mm, ()
    kept = np.ones(len(mesh.cells), dtype=bool)
    kept[np.concatenate([mesh.regions[name] for name in rigid])] = False
    if not kept.any():
        return mesh, u_mm, ()
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


def _strained(mesh: TetMesh, u_mm: FloatArray) -> bool:
    F = np.eye(3) + OnMesh(mesh, u_mm).cell_gradients
    return bool(np.abs(0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))).max() >= _STRAINED)


def _moves_as_one(X: FloatArray, u_mm: FloatArray, rounded_mm: float) -> bool:
    if np.median(np.linalg.norm(u_mm, axis=1)) < _MOVED_MM:
        return False
    before, after = X - X.mean(axis=0), X + u_mm - (X + u_mm).mean(axis=0)
    rotation, _ = Rotation.align_vectors(after, before)
    return bool(np.abs(rotation.apply(before) - after).max() <= rounded_mm)
