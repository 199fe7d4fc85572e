"""Strain of linear cells averaged at nodes, which is nearer to the smooth solution than a constant in each cell."""

from __future__ import annotations

import numpy as np

from dvc import TetMesh
from dvc.arrays import FloatArray
from dvc.deformation.nodal import Locator, OnMesh


def at_corners(mesh: TetMesh, H: FloatArray) -> FloatArray:
    """Gradients of cells (m, 3, 3), averaged by volume at each region's nodes: at the cells' corners (m, 4, 3, 3)."""
    nodes = len(mesh.points_mm)
    corners = mesh.points_mm[mesh.cells]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    out = np.empty((len(H), 4, 3, 3))
    for mine in mesh.regions.values():
        there, weight = mesh.cells[mine].ravel(), np.repeat(volumes[mine], 4)
        total = np.maximum(np.bincount(there, weight, minlength=nodes), 1e-30)
        flat = np.repeat(H[mine].reshape(-1, 9), 4, axis=0) * weight[:, None]
        mean = np.stack([np.bincount(there, column, minlength=nodes) for column in flat.T], axis=1)
        out[mine] = (mean / total[:, None]).reshape(-1, 3, 3)[mesh.cells[mine]]
    return out


def located(mesh: TetMesh, points_mm: FloatArray) -> tuple[np.ndarray, FloatArray]:
    """Cell of each point, -1 outside, and the weights of its corners (n, 4)."""
    cell, at = Locator(mesh).find(points_mm)
    return cell, np.column_stack([1.0 - at.sum(axis=1), at])


class Averaged:
    """A model's displacement as it is, with its gradient averaged at nodes and linear between them."""

    def __init__(self, model: OnMesh) -> None:
        self._model, self._corners = model, at_corners(model.mesh, model.cell_gradients)

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        return self._model.displacement(points_mm)

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        cell, weights = located(self._model.mesh, points_mm)
        H = np.einsum("na,naij->nij", weights, self._corners[cell])
        H[cell < 0] = np.nan
        return self.displacement(points_mm), H
