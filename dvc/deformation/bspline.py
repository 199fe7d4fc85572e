"""Cubic B-spline displacement on a control grid, evaluated exactly: the transform of elastix and ITK.

The gradient is the analytic derivative of the spline, not a difference of sampled displacements, so strain
has no error of its own from the sampling of the image.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from dvc.arrays import BoolArray, FloatArray, IntArray, as_points, frozen
from dvc.compiled import njit
from dvc.errors import GeometryError, InputError
from dvc.images.image import Grid
from dvc.images.interpolation import indices_around, spline_basis
from dvc.threads import in_parts

_SUPPORT = 4
# Lengths in control spacings: how far a voxel may lie from the place that the separable way gives it, and how
# close to a face of the valid region a point lies on it (so that the ways agree there in spite of rounding).
ALIGNED_INDEX = 1e-6
_ON_FACE = 1e-9

Axis = tuple[IntArray, FloatArray, FloatArray]
"""Of points along an axis the first control points (n,), and the spline's values and slopes there, (n, 4)."""
Table = tuple[Axis, Axis, Axis]


@dataclass(frozen=True, slots=True, eq=False)
class BSpline:
    """x = X + u(X), with u a tensor product of cubic B-splines.

    ``u(X) = sum_ijk c_ijk b(t_1 - i) b(t_2 - j) b(t_3 - k)``, where t is the continuous index of X in the
    control grid and b the centred cubic B-spline, of support 4 [1]_ [2]_.

    Parameters
    ----------
    control : Grid
        Positions of the control points, LPS mm; at least four along each axis.
    coefficients_mm : (3, ni, nj, nk)
        LPS components of the coefficients, indexed along the control grid's own axes, mm.

    Raises
    ------
    InputError
        If the coefficients do not fit the control grid, or it has fewer than four points along an axis.

    Notes
    -----
    Defined where all 4 x 4 x 4 control points of the support exist: ``1 <= t < n - 2`` along each axis,
    without the far face. This is the rule of elastix; outside, elastix returns the identity, a displacement
    of zero that was never measured, and this class NaN. (The B-spline transform of ITK includes the far face.)

    References
    ----------
    .. [1] M. Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Process. Mag.
       16(6), 22-38, 1999. doi:10.1109/79.799930
    .. [2] D. Rueckert et al., "Nonrigid registration using free-form deformations", IEEE Trans. Med.
       Imaging 18(8), 712-721, 1999. doi:10.1109/42.796284

    Examples
    --------
    Coefficients that grow linearly give a linear displacement, here a stretch of 10 % along x:

    >>> control = Grid((6, 6, 6), (4.0, 4.0, 4.0), (0.0, 0.0, 0.0))
    >>> coefficients = np.zeros((3, 6, 6, 6))
    >>> coefficients[0] = 0.1 * control.points()[..., 0]
    >>> u, H = BSpline(control, coefficients).evaluate(np.array([[10.0, 8.0, 8.0], [1.0, 8.0, 8.0]]))
    >>> u[:, 0].round(12).tolist(), H[:, 0, 0].round(12).tolist()
    ([1.0, nan], [0.1, nan])
    """

    control: Grid
    coefficients_mm: FloatArray

    def __post_init__(self) -> None:
        coefficients = frozen(self.coefficients_mm, np.float64)
        if coefficients.shape != (3, *self.control.shape):
            needed = (3, *self.control.shape)
            raise InputError(
                f"B-spline coefficients have shape {coefficients.shape}; the grid needs {needed}, component first."
            )
        if min(self.control.shape) < _SUPPORT:
            raise InputError(f"A cubic B-spline needs at least four control points per axis; got {self.control.shape}.")
        object.__setattr__(self, "coefficients_mm", coefficients)

    @property
    def spacing_mm(self) -> FloatArray:
        """Distance (3,) between the control points along their axes, mm."""
        return self.control.spacing_mm

    def turned(self, rotation: FloatArray) -> Self:
        """The same displacement of a body that is turned, with its control points, about the world's origin."""
        turned = np.einsum("ij,j...->i...", rotation, self.coefficients_mm)
        return type(self)(self.control.moved_by(rotation, np.zeros(3)), turned)

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm LPS, at points X (n, 3) LPS mm; NaN outside the valid region."""
        indices = self.control.indices_of(as_points(points_mm))
        return evaluate_spline(self.coefficients_mm, indices, mirror=False, gradient=False)[0]

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H = du/dX (n, 3, 3), LPS; NaN outside the valid region."""
        indices = self.control.indices_of(as_points(points_mm))
        u, per_index = evaluate_spline(self.coefficients_mm, indices, mirror=False)
        return u, (per_index.reshape(-1, 3) @ self.control.index_per_mm).reshape(-1, 3, 3)

    def evaluate_on_grid(self, grid: Grid, where: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate u (n, 3) mm and H (n, 3, 3) at voxels of a grid, in the order of ``np.argwhere(where)``.

        Where the grid's axes are those of the control grid, up to order and direction, the sums are done
        axis by axis; else point by point. Both give the same to rounding. InputError if the shapes differ.
        """
        where = frozen(where, np.bool_)
        if where.shape != grid.shape:
            raise InputError(f"The mask 'where' has shape {where.shape}, but the grid has shape {grid.shape}.")
        placed = indices_along_axes(self.control, grid)
        if placed is None:
            return self.evaluate(grid.points(where))
        order, along = placed
        slabs = np.concatenate([[0], np.cumsum(np.count_nonzero(where, axis=(1, 2)))])
        u, H = np.empty((slabs[-1], 3)), np.empty((slabs[-1], 3, 3))
        coefficients = np.ascontiguousarray(self.coefficients_mm.transpose(0, *(order + 1)))
        i, j, k = (spline_table(t, coefficients.shape[a + 1]) for a, t in enumerate(along))
        per_mm = np.ascontiguousarray(self.control.index_per_mm[order])
        in_parts(_on_grid, len(where), coefficients, where, slabs, (i, j, k), per_mm, u, H)
        return u, H

    def plus(self, other: Self) -> Self:
        """Add two displacements: u(X) = u_1(X) + u_2(X); GeometryError if their control grids differ."""
        if not self.control.same_as(other.control, tolerance_voxels=ALIGNED_INDEX):
            grids = (self.control, other.control)
            both = [f"{g.shape} points every {g.spacing_mm.round(4)} mm from {g.origin_mm.round(4)}" for g in grids]
            raise GeometryError(
                f"B-splines on different control grids cannot be added: {', and '.join(both)}. Register both on one "
                "reference grid with one FinalGridSpacing."
            )
        return type(self)(self.control, self.coefficients_mm + other.coefficients_mm)


def indices_along_axes(of: Grid, grid: Grid) -> tuple[IntArray, list[FloatArray]] | None:
    """For each axis of ``grid`` the axis of another grid along it, and its voxels' indices there; None if askew."""
    closeness = np.abs(of.direction.T @ grid.direction)
    order = closeness.argmax(axis=0)
    if sorted(order) != [0, 1, 2]:
        return None
    start = of.indices_of(grid.origin_mm)
    steps = of.indices_of(grid.points_at(np.eye(3))) - start  # row a: one voxel further along axis a
    along = [start[p] + steps[a, p] * np.arange(grid.shape[a]) for a, p in enumerate(order)]
    ends = np.array(list(np.ndindex(2, 2, 2)))
    true = of.indices_of(grid.points_at(ends * (np.array(grid.shape) - 1.0)))
    separable = np.stack([along[a][-ends[:, a]] for a in range(3)], axis=1)
    if np.abs(true[:, order] - separable).max() > ALIGNED_INDEX:
        return None
    return order, along


def evaluate_spline(
    coefficients: FloatArray, indices: FloatArray, *, mirror: bool, gradient: bool = True
) -> tuple[FloatArray, FloatArray]:
    """Cubic B-splines (n, c) of coefficients (c, ni, nj, nk) at continuous indices (n, 3), and their derivatives.

    These (n, c, 3) are with respect to the index; none without `gradient`. With `mirror` coefficients beyond the
    borders are those reflected at the outermost, as in mode "mirror" of `scipy.ndimage`; else NaN where the support is
    not wholly inside. NaN for an index that is not finite.
    """
    places = np.ascontiguousarray(indices, dtype=np.float64)
    values = np.empty((len(places), len(coefficients)))
    slopes = np.empty((len(places) if gradient else 0, len(coefficients), 3))
    in_parts(_at_indices, len(places), np.ascontiguousarray(coefficients), places, mirror, gradient, values, slopes)
    return values, slopes


@njit(cache=True)
def summed_spline(
    coefficients: FloatArray, at: Sequence[Sequence[int]], value: Sequence[Sequence[float]],
    slope: Sequence[Sequence[float]],
) -> tuple[float, float, float, float]:  # fmt: skip
    """The sum of 4 x 4 x 4 coefficients, or fewer, by their weights along each axis, and its slopes along these."""
    total, by_x, by_y, by_z = 0.0, 0.0, 0.0, 0.0
    for p in range(len(at[0])):
        plane, plane_y, plane_z = 0.0, 0.0, 0.0
        for q in range(len(at[1])):
            line, line_z = 0.0, 0.0
            for r in range(len(at[2])):
                coefficient = coefficients[at[0][p], at[1][q], at[2][r]]
                line += value[2][r] * coefficient
                line_z += slope[2][r] * coefficient
            plane += value[1][q] * line
            plane_y += slope[1][q] * line
            plane_z += value[1][q] * line_z
        total += value[0][p] * plane
        by_x += slope[0][p] * plane
        by_y += value[0][p] * plane_y
        by_z += value[0][p] * plane_z
    return total, by_x, by_y, by_z


@njit(cache=True)
def _supported(t: float, count: int) -> bool:
    return bool(1.0 - _ON_FACE <= t < count - 2 - _ON_FACE)  # false for NaN


@njit(cache=True)
def spline_table(t: FloatArray, count: int) -> Axis:
    """First control point (-1 where undefined), four values and four slopes for each index along an axis."""
    first = np.full(t.size, -1, np.int64)
    value, slope = np.zeros((t.size, 4)), np.zeros((t.size, 4))
    for i in range(t.size):
        if _supported(t[i], count):
            below = max(np.floor(t[i]), 1.0)
            first[i] = np.int64(below) - 1
            v, s = spline_basis(t[i] - below)
            for q in range(4):
                value[i, q], slope[i, q] = v[q], s[q]
    return first, value, slope


@njit(nogil=True, cache=True)
def _at_indices(
    start: int, stop: int, coefficients: FloatArray, indices: FloatArray, mirror: bool, gradient: bool,
    values: FloatArray, slopes: FloatArray,
) -> None:  # fmt: skip
    components, ni, nj, nk = coefficients.shape
    for n in range(start, stop):
        x, y, z = indices[n, 0], indices[n, 1], indices[n, 2]
        if mirror:
            known = np.isfinite(x) and np.isfinite(y) and np.isfinite(z)
        else:
            known = _supported(x, ni) and _supported(y, nj) and _supported(z, nk)
        if not known:
            values[n] = np.nan
            if gradient:
                slopes[n] = np.nan
            continue
        i, j, k = np.floor(x), np.floor(y), np.floor(z)
        if not mirror:
            i, j, k = max(i, 1.0), max(j, 1.0), max(k, 1.0)
        a, da = spline_basis(x - i)
        b, db = spline_basis(y - j)
        c, dc = spline_basis(z - k)
        at = indices_around(i, ni), indices_around(j, nj), indices_around(k, nk)
        for m in range(components):
            values[n, m], by_x, by_y, by_z = summed_spline(coefficients[m], at, (a, b, c), (da, db, dc))
            if gradient:
                slopes[n, m, 0], slopes[n, m, 1], slopes[n, m, 2] = by_x, by_y, by_z


@njit(nogil=True, cache=True)
def _on_grid(
    start: int, stop: int, coefficients: FloatArray, where: BoolArray, slabs: IntArray, table: Table,
    per_mm: FloatArray, u: FloatArray, H: FloatArray,
) -> None:  # fmt: skip
    """Sum over the first axis once per plane of voxels, the second once per row, the third per voxel."""
    nj, nk = where.shape[1], where.shape[2]
    mj, mk = coefficients.shape[2], coefficients.shape[3]
    i_axis, j_axis, k_axis = table
    first_i, value_i, slope_i = i_axis
    first_j, value_j, slope_j = j_axis
    first_k, value_k, slope_k = k_axis
    for i in range(start, stop):
        n = slabs[i]
        if slabs[i + 1] == n:
            continue
        if first_i[i] < 0:
            u[n : slabs[i + 1]] = np.nan
            H[n : slabs[i + 1]] = np.nan
            continue
        plane = np.zeros((3, mj, 2, mk))
        for m in range(3):
            for j in range(mj):
                for p in range(4):
                    for k in range(mk):
                        coefficient = coefficients[m, first_i[i] + p, j, k]
                        plane[m, j, 0, k] += value_i[i, p] * coefficient
                        plane[m, j, 1, k] += slope_i[i, p] * coefficient
        row = np.empty((3, mk, 3))  # value, slopes along the first and second axis
        for j in range(nj):
            if not where[i, j].any():
                continue
            start = first_j[j]
            if start >= 0:
                for m in range(3):
                    for k in range(mk):
                        v, by_i, by_j = 0.0, 0.0, 0.0
                        for q in range(4):
                            v += value_j[j, q] * plane[m, start + q, 0, k]
                            by_i += value_j[j, q] * plane[m, start + q, 1, k]
                            by_j += slope_j[j, q] * plane[m, start + q, 0, k]
                        row[m, k, 0], row[m, k, 1], row[m, k, 2] = v, by_i, by_j
            for k in range(nk):
                if not where[i, j, k]:
                    continue
                at = first_k[k]
                if start < 0 or at < 0:
                    u[n] = np.nan
                    H[n] = np.nan
                    n += 1
                    continue
                for m in range(3):
                    v, by_i, by_j, by_k = 0.0, 0.0, 0.0, 0.0
                    for r in range(4):
                        weight = value_k[k, r]
                        v += weight * row[m, at + r, 0]
                        by_i += weight * row[m, at + r, 1]
                        by_j += weight * row[m, at + r, 2]
                        by_k += slope_k[k, r] * row[m, at + r, 0]
                    u[n, m] = v
                    for x in range(3):
                        H[n, m, x] = by_i * per_mm[0, x] + by_j * per_mm[1, x] + by_k * per_mm[2, x]
                n += 1
