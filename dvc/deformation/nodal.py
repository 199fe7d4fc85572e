"""A deformation given at the nodes of a tetrahedral mesh, evaluated at any points."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dvc.arrays import FloatArray, IntArray, as_points, frozen
from dvc.compiled import njit
from dvc.errors import InputError
from dvc.mesh import TetMesh
from dvc.threads import in_parts

_TOLERANCE = 1e-9  # of a barycentric coordinate: points on a face belong to the cells on either side
_CELLS_PER_BIN = 2.0

_Bins = tuple[FloatArray, float, IntArray, IntArray, IntArray, FloatArray]
"""Lowest corner (3,) of the bins, their width and number along each axis, the first of each bin's members, the members'
cells, and the first corner (m, 3) of each cell; mm."""


class Locator:
    """Finds the cells of a mesh in which points lie."""

    def __init__(self, mesh: TetMesh) -> None:
        corners = mesh.points_mm[mesh.cells]
        jacobian = np.stack([corners[:, i] - corners[:, 0] for i in (1, 2, 3)], axis=2)
        self.inverse = np.asarray(np.linalg.inv(jacobian), dtype=np.float64)
        lower, upper = corners.min(axis=1), corners.max(axis=1)
        low = lower.min(axis=0)
        extent = upper.max(axis=0) - low
        width = float(np.cbrt(extent.prod() * _CELLS_PER_BIN / len(mesh.cells)))
        shape = np.floor(extent / width).astype(np.int64) + 1
        first = np.floor((lower - low) / width).astype(np.int64)
        last = np.minimum(np.floor((upper - low) / width).astype(np.int64), shape - 1)
        starts, members = _binned(first, last, shape)
        self._bins = low, width, shape, starts, members, corners[:, 0]

    def find(self, points_mm: npt.ArrayLike) -> tuple[IntArray, FloatArray]:
        """Cell of each point (n,), -1 outside the mesh, and its reference coordinates in it (n, 3).

        Where a point lies on a face, edge or node, the cell with the lowest number is taken.
        """
        points = as_points(points_mm)
        cells, inside = np.full(len(points), -1), np.full((len(points), 3), np.nan)
        in_parts(_find, len(points), points, self._bins, self.inverse, cells, inside)
        return cells, inside


@dataclass(frozen=True, slots=True, eq=False)
class OnMesh:
    """Displacements `u_mm` (n, 3) of a mesh's nodes as a `Deformation`: linear in each cell, with its gradient.

    Reference configuration, LPS mm. InputError if there is not one finite displacement for each node.
    """

    mesh: TetMesh
    u_mm: FloatArray
    _locator: Locator = field(init=False, repr=False)

    def __post_init__(self) -> None:
        u = frozen(self.u_mm, np.float64)
        if u.shape != self.mesh.points_mm.shape or not np.isfinite(u).all():
            raise InputError(
                f"The displacement needs three finite numbers for each of the {len(self.mesh.points_mm)} nodes; "
                f"got shape {u.shape} with {np.count_nonzero(~np.isfinite(u))} values that are not finite."
            )
        object.__setattr__(self, "u_mm", u)
        object.__setattr__(self, "_locator", Locator(self.mesh))

    @property
    def cell_gradients(self) -> FloatArray:
        """H = du/dX of each cell, (m, 3, 3)."""
        u = self.u_mm[self.mesh.cells]
        steps = np.stack([u[:, i] - u[:, 0] for i in (1, 2, 3)], axis=2)
        return np.asarray(steps @ self._locator.inverse)

    def cells_at(self, points_mm: FloatArray) -> IntArray:
        """Cell of the mesh in which each point (n, 3) LPS mm lies, (n,); -1 outside."""
        return self._locator.find(points_mm)[0]

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X) (n, 3) mm at points X (n, 3) LPS mm; NaN outside the mesh."""
        return self.evaluate(points_mm)[0]

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H (n, 3, 3) at points X (n, 3) LPS mm; NaN outside the mesh."""
        cells, at = self._locator.find(points_mm)
        u = self.u_mm[self.mesh.cells[cells]]
        weights = np.concatenate([1.0 - at.sum(axis=1, keepdims=True), at], axis=1)
        outside = cells < 0
        H = self.cell_gradients[cells]
        H[outside] = np.nan
        return np.einsum("na,nai->ni", weights, u), H


@njit(cache=True)
def _binned(first: IntArray, last: IntArray, shape: IntArray) -> tuple[IntArray, IntArray]:
    """Cells whose box touches each bin, in rising order: starts (bins + 1,) and members."""
    starts = np.zeros(shape[0] * shape[1] * shape[2] + 1, dtype=np.int64)
    for filling in range(2):
        if filling:
            starts = np.cumsum(starts)
            members = np.empty(starts[-1], dtype=np.int64)
            at = starts[:-1].copy()
        for n in range(len(first)):
            for i in range(first[n, 0], last[n, 0] + 1):
                for j in range(first[n, 1], last[n, 1] + 1):
                    for k in range(first[n, 2], last[n, 2] + 1):
                        bin_ = (i * shape[1] + j) * shape[2] + k
                        if filling:
                            members[at[bin_]] = n
                            at[bin_] += 1
                        else:
                            starts[bin_ + 1] += 1
    return starts, members


@njit(nogil=True, cache=True)
def _find(
    start: int, stop: int, points: FloatArray, bins: _Bins, inverse: FloatArray, cells: IntArray, inside: FloatArray
) -> None:
    low, width, shape, starts, members, origin = bins
    for n in range(start, stop):
        bin_, known = 0, True
        for axis in range(3):
            place = np.floor((points[n, axis] - low[axis]) / width)
            if not (0.0 <= place < shape[axis]):
                known = False
                break
            bin_ = bin_ * shape[axis] + int(place)
        if not known:
            continue
        for m in range(starts[bin_], starts[bin_ + 1]):
            cell = members[m]
            x, y, z = points[n, 0] - origin[cell, 0], points[n, 1] - origin[cell, 1], points[n, 2] - origin[cell, 2]
            a = inverse[cell, 0, 0] * x + inverse[cell, 0, 1] * y + inverse[cell, 0, 2] * z
            b = inverse[cell, 1, 0] * x + inverse[cell, 1, 1] * y + inverse[cell, 1, 2] * z
            c = inverse[cell, 2, 0] * x + inverse[cell, 2, 1] * y + inverse[cell, 2, 2] * z
            if min(a, b, c, 1.0 - a - b - c) >= -_TOLERANCE:
                cells[n] = cell
                inside[n, 0], inside[n, 1], inside[n, 2] = a, b, c
                break
