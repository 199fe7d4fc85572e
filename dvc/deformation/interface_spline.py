"""Displacements whose gradient jumps where tissues meet: a smooth B-spline, and another that is counted by depth.

Strain is smooth inside a tissue, but not across its border: fat that shears along stiff skin or along bone does so
right up to them. One B-spline for all carries that strain over the border, as far as its control points lie apart.
"""

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.ndimage import distance_transform_edt

from dvc import threads
from dvc.arrays import BoolArray, FloatArray, IntArray, as_points, different_and_places, frozen
from dvc.compiled import njit
from dvc.deformation.bspline import ALIGNED_INDEX, BSpline, indices_along_axes, summed_spline
from dvc.deformation.protocol import CHUNK, in_chunks
from dvc.errors import GeometryError, InputError
from dvc.images.depth import NUMBERS as OF_DEPTH, depth_mm
from dvc.images.filters import spline_coefficients
from dvc.images.image import Grid, LabelMap, Mask
from dvc.images.interpolation import indices_around, spline_basis
from dvc.threads import in_parts

_GAP_MM = 3.0  # from a tissue: what has no label there belongs to it
_PLANES = 16  # of voxels whose factors are computed at once
NUMBERS = OF_DEPTH | {"gap_mm": _GAP_MM}
"""Every number that determines the position of an interface, for a record."""


@dataclass(frozen=True, slots=True, eq=False)
class Interfaces:
    """Where tissues meet, and the two factors of a displacement that follow from it.

    With b the distance (mm) from the rigid bone and d the depth of a point below the border of its own tissue,

        m = tanh(b / L),   psi = m L tanh(d / L).

    m is 0 in the bone, psi on every border with another tissue (not with the air), and their gradients jump there.
    """

    grid: Grid
    depth: FloatArray  # (tissues, ni, nj, nk), spline coefficients of the depth in each, mm: positive in it
    own: IntArray  # (ni, nj, nk), number of the tissue of each voxel; in the air that of the nearest
    rest: int  # number of the rigid bone; -1 without one
    reach_mm: float  # L

    @classmethod
    def of(cls, labels: LabelMap, bone: Mask | None, reach_mm: float, body: Mask | None = None) -> Self:
        """Interfaces of the tissues in a label map; L is about the spacing of the control points.

        A bone that does not move counts as a tissue of its own, whatever its labels are. Voxels of the body without a
        label belong to the nearest tissue (but that bone) within 3 mm, and to a tissue of their own beyond.
        GeometryError if bone or body are on another grid; InputError if no voxel has a label, or L is not above zero.
        """
        for name, mask in (("bone", bone), ("body", body)):
            if mask is not None and not mask.grid.same_as(labels.grid):
                raise GeometryError(f"The {name} is not on the grid of the label map; resample it with fit_mask.")
        if not (np.isfinite(reach_mm) and reach_mm > 0):
            raise InputError(f"The reach of an interface (reach_mm) must be above 0 mm; got {reach_mm}.")
        values = labels.labels if bone is None else np.where(bone.inside, -1, labels.labels)  # -1: bone at rest
        if not values.any():
            raise InputError("The label map has no labelled tissue in the registered part of the image.")
        spacing = labels.grid.spacing_mm
        if body is not None and (unknown := body.inside & (values == 0)).any():
            filled = np.where(unknown, values.max() + 1, values)
            if (values > 0).any():
                gap_mm, nearest = distance_transform_edt(values <= 0, sampling=spacing, return_indices=True)
                filled = np.where(unknown & (gap_mm <= _GAP_MM), values[tuple(nearest)], filled)
            values = filled
        if not values.all():
            to = distance_transform_edt(values == 0, sampling=spacing, return_distances=False, return_indices=True)
            values = values[tuple(to)]
        tissues, own = different_and_places(values)
        rest = int(np.flatnonzero(tissues == -1)[0]) if bool((tissues == -1).any()) else -1
        return cls.between(labels.grid, frozen(own, np.int64), rest, float(reach_mm))

    @classmethod
    def between(cls, grid: Grid, own: IntArray, rest: int, reach_mm: float) -> Self:
        """Interfaces between tissues that are numbered from 0 on; parameters as the attributes."""

        def coefficients(number: int) -> FloatArray:
            return np.asarray(spline_coefficients(depth_mm(own == number, grid.spacing_mm), np.float64))

        count = int(own.max()) + 1
        with ThreadPoolExecutor(threads.count()) as pool:
            found = list(pool.map(coefficients, range(1 if count == 2 else count)))
        if count == 2:  # one ends where the other begins
            found.append(-found[0])
        depth = np.stack(found)
        return cls(grid, frozen(depth, np.float64), own, rest, reach_mm)

    @property
    def of_bone_alone(self) -> bool:
        """Whether the surface of a rigid bone is the only one."""
        return self.rest >= 0 and len(self.depth) == 2

    def turned(self, rotation: FloatArray) -> Self:
        """The borders of a body that is turned about the world's origin."""
        return replace(self, grid=self.grid.moved_by(rotation, np.zeros(3)))

    def at_voxels(self, where: BoolArray, every: Iterable[int] = (1, 1, 1), gradient: bool = True) -> FloatArray:
        """Factors at every so many voxels along each axis, ``where`` (mi, mj, mk) of these; zero at the others.

        (mi, mj, mk, 2, 4): of m and psi the value, and the gradient along the grid's axes; without gradient
        (mi, mj, mk, 2, 1). On a border the gradient is that of the voxel's own side.
        """
        out = np.zeros((*where.shape, 2, 4 if gradient else 1))
        along = tuple(step * np.arange(n) for step, n in zip(every, where.shape, strict=True))
        for start in range(0, len(out), _PLANES):  # of all at once, depths and slopes would take twice as much as these
            planes = slice(start, start + _PLANES)
            some, here = frozen(where[planes], np.bool_), (along[0][planes], *along[1:])
            own, depth, slope = self._depths(some, np.arange(3), here, gradient, corners=1)
            slope /= self.grid.spacing_mm
            out[planes][some] = self._factors(depth[0], slope[0], -depth[1], -slope[1], own)
        return out

    def at(self, points_mm: FloatArray, gradient: bool = True) -> FloatArray:
        """Factors at points (n, 3) LPS mm, (n, 2, 4): value and gradient in LPS, or (n, 2, 1) without the gradient."""
        indices = self.grid.indices_of(np.asarray(points_mm, dtype=np.float64))
        found = _room_for(len(indices), gradient)
        in_parts(_depths_at, len(indices), self.depth, self.own, self.rest, indices, gradient, *found)
        return self._of_depths(*found)

    def on_grid(self, grid: Grid, where: BoolArray, gradient: bool = True) -> FloatArray:
        """Factors at voxels of a grid, as from `at`, in the order of ``np.argwhere(where)``.

        Voxels whose centres are those of the interfaces' own grid, or of its continuation, take a fraction of the time.
        """
        placed = indices_along_axes(self.grid, grid)
        if placed is None or any(np.abs(t - np.rint(t)).max() > ALIGNED_INDEX for t in placed[1]):
            return self.at(grid.points(where), gradient)
        order, along = np.argsort(placed[0]), tuple(np.rint(t).astype(np.int64) for t in placed[1])
        if self.of_bone_alone and not gradient:  # beside the bone, its distance is also the depth of the tissue
            inside = _at_whole_indices(self.depth[self.rest], [along[axis] for axis in order]).transpose(placed[0])
            m = np.tanh(np.maximum(-inside[where], 0.0) / self.reach_mm)
            return np.stack([m, self.reach_mm * m**2], axis=-1)[..., None]
        return self._of_depths(*self._depths(frozen(where, np.bool_), order, along, gradient, corners=8))

    def _depths(
        self, where: BoolArray, order: IntArray, along: Sequence[IntArray], gradient: bool, corners: int
    ) -> tuple[IntArray, FloatArray, FloatArray]:
        """Tissue, depths and slopes by index of voxels, as `_depths_at_voxels`."""
        begun = np.concatenate([[0], np.cumsum(np.count_nonzero(where, axis=(1, 2)))])
        found = _room_for(int(begun[-1]), gradient)
        given = self.depth, self.own, self.rest, order, tuple(along), where, begun, gradient, corners
        in_parts(_depths_at_voxels, len(where), *given, *found)
        return found

    def _of_depths(self, own: IntArray, depth: FloatArray, slope: FloatArray) -> FloatArray:
        """Factors at points from the depths there; their slopes are by index."""
        slope = slope @ self.grid.index_per_mm
        return self._factors(depth[0], slope[0], -depth[1], -slope[1], own)

    def _factors(
        self, depth: FloatArray, slope: FloatArray, away: FloatArray, away_slope: FloatArray, own: IntArray
    ) -> FloatArray:
        """Factors from depth d and distance b from the bone, and their gradients, if there are slopes."""
        L = self.reach_mm
        m, psi = np.tanh(np.maximum(away, 0.0) / L), L * np.tanh(np.maximum(depth, 0.0) / L)
        out = np.empty((*m.shape, 2, 4 if slope.size else 1))
        out[..., 0, 0], out[..., 1, 0] = m, m * psi
        if slope.size:
            m_slope = ((1.0 - m**2) / L)[..., None] * away_slope
            psi_slope = (1.0 - (psi / L) ** 2)[..., None] * slope
            out[..., 0, 1:] = m_slope
            out[..., 1, 1:] = m[..., None] * psi_slope + psi[..., None] * m_slope
        if self.rest >= 0:
            out[own == self.rest] = 0.0
        return out


def _at_whole_indices(coefficients: FloatArray, along: Sequence[IntArray]) -> FloatArray:
    """A spline (mi, mj, mk) of coefficients (ni, nj, nk), mirrored beyond their ends, at whole indices of each axis."""
    for axis, index in enumerate(along):
        last = coefficients.shape[axis] - 1
        mirrored = (np.abs((index + step + last) % max(2 * last, 1) - last) for step in (-1, 0, 1))
        before, at, after = (coefficients.take(each, axis) for each in mirrored)
        coefficients = (before + 4.0 * at + after) / 6.0
    return coefficients


def _room_for(count: int, gradient: bool) -> tuple[IntArray, FloatArray, FloatArray]:
    """Arrays for each point's own tissue, its depths (2, n) and their slopes (2, n, 3), or none of these."""
    return np.empty(count, dtype=np.int64), np.empty((2, count)), np.zeros((2, count if gradient else 0, 3))


@njit(nogil=True, cache=True)
def _deepest(  # type: ignore[no-untyped-def]
    n, depth, own, rest, at, values, slopes, gradient, corners, tissue, value, slope
):  # fmt: skip
    """Point n: the tissue of the voxels around it that it lies deepest in; depths and slopes as `_depths_at`.

    There are eight ``corners``; if one, it is the voxel before the point along each axis. ``at`` are the indices of
    coefficients along each axis, the second that of the voxel before the point; ``values`` and ``slopes`` are the
    weights of these coefficients.
    """
    tissue[n], value[:, n] = 0, -np.inf
    tried = -1
    for corner in range(corners):
        number = own[at[0][1 + (corner >> 2)], at[1][1 + (corner >> 1 & 1)], at[2][1 + (corner & 1)]]
        if number == tried or (corner and number == tissue[n]):
            continue
        tried = number
        mm, by_x, by_y, by_z = summed_spline(depth[number], at, values, slopes)
        if mm > value[0, n]:
            tissue[n], value[0, n] = number, mm
            if gradient:
                slope[0, n, 0], slope[0, n, 1], slope[0, n, 2] = by_x, by_y, by_z
    if rest >= 0:
        value[1, n], by_x, by_y, by_z = summed_spline(depth[rest], at, values, slopes)
        if gradient:
            slope[1, n, 0], slope[1, n, 1], slope[1, n, 2] = by_x, by_y, by_z


@njit(nogil=True, cache=True)
def _depths_at(
    start: int, stop: int, depth: FloatArray, own: IntArray, rest: int, indices: FloatArray, gradient: bool,
    tissue: IntArray, value: FloatArray, slope: FloatArray,
) -> None:  # fmt: skip
    """Each point's own tissue, the depth (2, n) in it and in the bone at rest, and their slopes (2, n, 3) by index.

    A tissue that none of the eight voxels around a point belongs to is not its own. Without a bone, or a number for an
    index, its depth is -inf.
    """
    ni, nj, nk = own.shape
    for n in range(start, stop):
        x, y, z = indices[n, 0], indices[n, 1], indices[n, 2]
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            tissue[n], value[0, n], value[1, n] = 0, np.nan, -np.inf
            continue
        i, j, k = np.floor(x), np.floor(y), np.floor(z)
        a, da = spline_basis(x - i)
        b, db = spline_basis(y - j)
        c, dc = spline_basis(z - k)
        at = indices_around(i, ni), indices_around(j, nj), indices_around(k, nk)
        _deepest(n, depth, own, rest, at, (a, b, c), (da, db, dc), gradient, 8, tissue, value, slope)


@njit(nogil=True, cache=True)
def _depths_at_voxels(
    start: int, stop: int, depth: FloatArray, own: IntArray, rest: int, order: IntArray,
    along: tuple[IntArray, IntArray, IntArray], where: BoolArray, begun: IntArray, gradient: bool, corners: int,
    tissue: IntArray, value: FloatArray, slope: FloatArray,
) -> None:  # fmt: skip
    """As `_depths_at`, at whole indices, where splines have three coefficients along each axis.

    With one of the ``corners`` a voxel's own tissue is its own; with eight, that of a neighbour may be.

    ``along`` are the indices of voxels ``where`` (ni, nj, nk), in the order of these axes; ``order`` is the place of
    each axis of the interfaces among them; ``begun[i]`` voxels lie before the slab i.
    """
    shape, (four_values, four_slopes) = own.shape, spline_basis(0.0)
    v, s = four_values[:3], four_slopes[:3]
    values, slopes = (v, v, v), (s, s, s)
    for i in range(start, stop):
        n = begun[i]
        for j in range(where.shape[1]):
            for k in range(where.shape[2]):
                if not where[i, j, k]:
                    continue
                index = along[0][i], along[1][j], along[2][k]
                x, y, z = index[order[0]], index[order[1]], index[order[2]]
                at = (
                    indices_around(x, shape[0])[:3], indices_around(y, shape[1])[:3], indices_around(z, shape[2])[:3],
                )  # fmt: skip
                _deepest(n, depth, own, rest, at, values, slopes, gradient, corners, tissue, value, slope)
                n += 1


@dataclass(frozen=True, slots=True, eq=False)
class InterfaceSpline:
    """x = X + u(X), u = m v + psi w: two cubic B-splines v (mm) and w, and the factors of `Interfaces`.

    u is continuous, and zero in the rigid bone. Its gradient H = m grad v + v (x) grad m + psi grad w + w (x) grad psi
    is discontinuous at interfaces: between two tissues that may both move, by 2 m w (x) n, n the normal of the
    interface. Exactly on an interface, H is that of either side, by rounding.

    Parameters
    ----------
    smooth, jump : BSpline
        v and w on one control grid, LPS.
    borders : Interfaces
        Where m and psi come from.

    Raises
    ------
    GeometryError
        If the control grids differ.
    """

    smooth: BSpline
    jump: BSpline
    borders: Interfaces

    def __post_init__(self) -> None:
        if not self.smooth.control.same_as(self.jump.control, tolerance_voxels=1e-6):
            raise GeometryError("The two splines of an interface spline must have the same control grid.")

    @property
    def control(self) -> Grid:
        """Control points of both splines."""
        return self.smooth.control

    @property
    def spacing_mm(self) -> FloatArray:
        """Distance (3,) between the control points along their axes, mm."""
        return self.control.spacing_mm

    @property
    def bone(self) -> Mask | None:
        """The rigid bone up to where strain may be discontinuous, with the air nearest to it; None without one."""
        borders = self.borders
        return None if borders.rest < 0 else Mask(borders.grid, borders.own == borders.rest)

    def turned(self, rotation: FloatArray) -> Self:
        """The same displacement of a body that is turned, with its borders, about the world's origin."""
        return type(self)(self.smooth.turned(rotation), self.jump.turned(rotation), self.borders.turned(rotation))

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm LPS, at points X (n, 3) LPS mm; NaN outside the splines' valid region."""
        points = as_points(points_mm)
        u = np.zeros((len(points), 3))
        for some in in_chunks(len(points)):
            here, factors = points[some], self.borders.at(points[some], gradient=False)
            for f, spline in enumerate((self.smooth, self.jump)):
                u[some] += factors[:, f, 0, None] * spline.displacement(here)
        return u

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H = du/dX (n, 3, 3), LPS; NaN outside the splines' valid region."""
        points = as_points(points_mm)
        u, H = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
        for some in in_chunks(len(points)):
            here = points[some]
            factors = self.borders.at(here)
            u[some], H[some] = _joined(factors, self.smooth.evaluate(here), self.jump.evaluate(here))
        return u, H

    def evaluate_on_grid(self, grid: Grid, where: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Evaluate u (n, 3) mm and H (n, 3, 3) at voxels of a grid; order and errors as in `BSpline`."""
        if where.shape != grid.shape:
            raise InputError(f"The mask 'where' has shape {where.shape}, but the grid has shape {grid.shape}.")
        step = max(1, CHUNK // (grid.shape[1] * grid.shape[2]))  # planes at once: memory stays that of the result
        found = []
        for start in range(0, grid.shape[0], step):
            box = (slice(start, start + step), slice(None), slice(None))
            here, part = grid.part(box), where[box]
            smooth, jump = (spline.evaluate_on_grid(here, part) for spline in (self.smooth, self.jump))
            found.append(_joined(self.borders.on_grid(here, part), smooth, jump))
        return np.concatenate([u for u, _ in found]), np.concatenate([H for _, H in found])

    def displacement_on_grid(self, grid: Grid) -> FloatArray:
        """Displacement (n, 3) mm at all voxels of a grid, in their order; much faster than with the gradient."""
        every = np.ones(grid.shape, dtype=bool)
        factors = self.borders.on_grid(grid, every, gradient=False)
        v, w = (spline.evaluate_on_grid(grid, every)[0] for spline in (self.smooth, self.jump))
        return np.asarray(factors[:, 0] * v + factors[:, 1] * w)


def _joined(
    factors: FloatArray, smooth: tuple[FloatArray, FloatArray], jump: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Join u and H of both splines at the same points."""
    u, H = np.empty_like(smooth[0]), np.empty_like(smooth[1])
    in_parts(_join, len(u), factors, *smooth, *jump, u, H)
    return u, H


@njit(nogil=True, cache=True)
def _join(
    start: int, stop: int, factors: FloatArray, v: FloatArray, v_gradient: FloatArray, w: FloatArray,
    w_gradient: FloatArray, u: FloatArray, H: FloatArray,
) -> None:  # fmt: skip
    """Write u = m v + psi w and its gradient (n, 3, 3) from the factors (n, 2, 4) and both splines."""
    for n in range(start, stop):
        m, psi = factors[n]
        for i in range(3):
            u[n, i] = m[0] * v[n, i] + psi[0] * w[n, i]
            for j in range(3):
                by_v = m[0] * v_gradient[n, i, j] + v[n, i] * m[1 + j]
                H[n, i, j] = by_v + (psi[0] * w_gradient[n, i, j] + w[n, i] * psi[1 + j])
