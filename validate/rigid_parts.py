"""Parts of a model that are no tissue, such as a plate in the same file: named, or found as they are rigid."""

from collections.abc import Collection, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from dvc import TetMesh
from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.nodal import OnMesh
from dvc.errors import InputError, few

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
    kept = _all_but(mesh, rigid)
    return (*_part(mesh, u_mm, kept), rigid) if kept.any() else (mesh, u_mm, ())


def without_named_parts(mesh: TetMesh, u_mm: FloatArray, names: Sequence[str]) -> tuple[TetMesh, FloatArray]:
    """A mesh and its nodes' displacement (n, 3) without the regions of these names, in any case.

    InputError if there is no such region, or nothing else.
    """
    known = {name.casefold(): name for name in mesh.regions}
    if unknown := [name for name in names if name.casefold() not in known]:
        raise InputError(f"there is no region '{unknown[0]}' to leave out; the regions are {few(mesh.regions)}.")
    kept = _all_but(mesh, [known[name.casefold()] for name in names])
    if not kept.any():
        raise InputError("all regions are left out (leave_out), so nothing is compared. Keep those of tissue.")
    return _part(mesh, u_mm, kept)


def _all_but(mesh: TetMesh, names: Collection[str]) -> BoolArray:
    kept = np.ones(len(mesh.cells), dtype=bool)
    for name in names:
        kept[mesh.regions[name]] = False
    return kept


def _part(mesh: TetMesh, u_mm: FloatArray, kept: BoolArray) -> tuple[TetMesh, FloatArray]:
    used, cell = np.unique(mesh.cells[kept]), np.cumsum(kept) - 1
    node = np.full(len(mesh.points_mm), -1)
    node[used] = np.arange(len(used))
    regions = {name: cell[cells[kept[cells]]] for name, cells in mesh.regions.items() if kept[cells].any()}
    facets = {name: node[faces[(node[faces] >= 0).all(axis=1)]] for name, faces in mesh.facets.items()}
    facets = {name: faces for name, faces in facets.items() if len(faces)}
    return TetMesh(mesh.points_mm[used], node[mesh.cells[kept]], regions, facets, mesh.node_ids[used]), u_mm[used]


def _strained(mesh: TetMesh, u_mm: FloatArray) -> bool:
    F = np.eye(3) + OnMesh(mesh, u_mm).cell_gradients
    return bool(np.abs(0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))).max() >= _STRAINED)


def _moves_as_one(X: FloatArray, u_mm: FloatArray, rounded_mm: float) -> bool:
    if np.median(np.linalg.norm(u_mm, axis=1)) < _MOVED_MM:
        return False
    before, after = X - X.mean(axis=0), X + u_mm - (X + u_mm).mean(axis=0)
    rotation, _ = Rotation.align_vectors(after, before)
    return bool(np.abs(rotation.apply(before) - after).max() <= rounded_mm)
