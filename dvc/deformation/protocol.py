"""What moves tissue: the Deformation protocol, and the deformations that need no image.

A deformation maps a point X of the reference (unloaded) configuration to x = X + u(X). It gives u in mm and its
gradient H = du/dX (H[i, j] = du_i/dX_j, no unit), both in LPS, and NaN where it is not defined: missing is never zero.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
import numpy.typing as npt
from scipy.ndimage import binary_dilation, distance_transform_edt, map_coordinates

from dvc.arrays import BoolArray, FloatArray, IntArray, as_points, frozen
from dvc.errors import InputError
from dvc.images.filters import spline_coefficients
from dvc.images.image import Grid, Mask

_T = TypeVar("_T", np.float32, np.float64)

CHUNK = 200_000
"""Points that are evaluated at once, so that memory stays that of the result."""
_RIM = 6  # voxels: what lies beyond weighs less than a thousandth in a cubic spline


@runtime_checkable
class Deformation(Protocol):
    """Displacement and its gradient at any points of the reference configuration."""

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm LPS, at points X (n, 3) LPS mm; NaN where not defined."""

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H = du/dX (n, 3, 3) at points X (n, 3) LPS mm; NaN where not defined."""


@runtime_checkable
class Motion(Deformation, Protocol):
    """A deformation whose inverse is known."""

    def inverse(self) -> "Motion":
        """The map back, from the deformed configuration to the reference."""


@runtime_checkable
class GridDeformation(Deformation, Protocol):
    """A deformation with a faster way over the voxels of a grid."""

    def evaluate_on_grid(self, grid: Grid, where: BoolArray) -> tuple[FloatArray, FloatArray]:
        """U and H at the voxels of ``grid`` in ``where``, ordered as ``np.argwhere(where)``."""


@runtime_checkable
class GridDisplacement(GridDeformation, Protocol):
    """A deformation whose displacement alone is found faster still."""

    def displacement_on_grid(self, grid: Grid) -> FloatArray:
        """U (n, 3) mm at all voxels of ``grid``, in their order."""


def in_chunks(count: int) -> Iterator[slice]:
    """The parts of so many points, each of `CHUNK` at the most."""
    return (slice(start, start + CHUNK) for start in range(0, count, CHUNK))


def evaluate_on_grid(
    deformation: Deformation, grid: Grid, where: BoolArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """U (n, 3) mm and H (n, 3, 3) at the voxels of a grid, by the fastest way the deformation has.

    Of the voxels in ``where`` (ni, nj, nk), all by default, in the order of ``np.argwhere(where)``.
    """
    inside = np.ones(grid.shape, dtype=bool) if where is None else np.asarray(where, dtype=bool)
    if isinstance(deformation, GridDeformation):
        return deformation.evaluate_on_grid(grid, inside)
    points = grid.points(inside)
    u, H = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
    for part in in_chunks(len(points)):
        u[part], H[part] = deformation.evaluate(points[part])
    return u, H


def displacement_on_grid(deformation: Deformation, grid: Grid, dtype: type[_T]) -> npt.NDArray[_T]:
    """U (ni, nj, nk, 3) mm at the voxels of a grid, in single or double precision; NaN where not defined."""
    u = np.empty((*grid.shape, 3), dtype)
    step = max(1, CHUNK // (grid.shape[1] * grid.shape[2]))  # planes at once: gradients come along, as a rule
    for start in range(0, grid.shape[0], step):
        part = grid.part((slice(start, start + step), slice(None), slice(None)))
        if isinstance(deformation, GridDisplacement):
            found = deformation.displacement_on_grid(part)
        else:
            found = evaluate_on_grid(deformation, part)[0]
        u[start : start + step] = found.reshape(*part.shape, 3)
    return u


@dataclass(frozen=True, slots=True, eq=False)
class Affine:
    """x = matrix @ X + translation_mm, defined everywhere.

    Attributes
    ----------
    matrix : (3, 3)
        F, the same everywhere; LPS.
    translation_mm : (3,)
        LPS.

    Raises
    ------
    InputError
        For other shapes, or numbers that are not finite.

    Examples
    --------
    >>> stretch = Affine(np.diag([1.2, 1.0, 1.0]), np.zeros(3))
    >>> bool(np.allclose(stretch.displacement(np.array([[10.0, 0.0, 0.0]])), [[2.0, 0.0, 0.0]]))
    True
    """

    matrix: FloatArray
    translation_mm: FloatArray
    _KIND: ClassVar[str] = "An affine map"

    def __post_init__(self) -> None:
        matrix, translation = frozen(self.matrix, np.float64), frozen(self.translation_mm, np.float64)
        if matrix.shape != (3, 3) or translation.shape != (3,):
            raise InputError(f"{self._KIND} needs a 3 x 3 matrix and a translation of three numbers, mm.")
        if not (np.isfinite(matrix).all() and np.isfinite(translation).all()):
            raise InputError(f"{self._KIND} needs finite numbers; got {matrix.tolist()} and {translation.tolist()}.")
        object.__setattr__(self, "matrix", matrix)
        object.__setattr__(self, "translation_mm", translation)

    @classmethod
    def about(cls, centre_mm: FloatArray, matrix: FloatArray, translation_mm: FloatArray) -> Self:
        """The map about a centre, then a translation: x = A (X - c) + c + t."""
        centre = np.asarray(centre_mm, dtype=np.float64)
        with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused by the class
            return cls(matrix, centre - matrix @ centre + translation_mm)

    def apply(self, points_mm: FloatArray) -> FloatArray:
        """Where the points (n, 3) mm go."""
        return np.asarray(np.asarray(points_mm) @ self.matrix.T + self.translation_mm)

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm."""
        return np.asarray(as_points(points_mm) @ (self.matrix - np.eye(3)).T + self.translation_mm)

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and the constant H (n, 3, 3)."""
        u = self.displacement(points_mm)
        return u, np.tile(self.matrix - np.eye(3), (len(u), 1, 1))

    def inverse(self) -> "Affine":
        """The map back."""
        back = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        return Affine(back, -back @ self.translation_mm)


@dataclass(frozen=True, slots=True, eq=False)
class RigidMotion(Affine):
    """x = rotation @ X + translation_mm, LPS mm: an affine map by a proper rotation.

    Raises
    ------
    InputError
        If the matrix is not orthonormal with determinant +1.
    """

    _KIND: ClassVar[str] = "A rigid motion"

    def __post_init__(self) -> None:
        Affine.__post_init__(self)
        with np.errstate(over="ignore", invalid="ignore"):
            error = np.abs(self.rotation.T @ self.rotation - np.eye(3)).max()
        if not error < 1e-6 or np.linalg.det(self.rotation) < 0:
            raise InputError(f"The matrix is not a proper rotation (R^T R differs from I by {error:.2g}).")

    @property
    def rotation(self) -> FloatArray:
        """R, (3, 3), LPS."""
        return self.matrix

    @classmethod
    def identity(cls) -> Self:
        """No motion."""
        return cls(np.eye(3), np.zeros(3))

    @property
    def angle_deg(self) -> float:
        """Angle of the rotation, 0 to 180 degrees."""
        skew = self.rotation - self.rotation.T
        sine = 0.5 * np.sqrt(skew[2, 1] ** 2 + skew[0, 2] ** 2 + skew[1, 0] ** 2)
        return float(np.degrees(np.arctan2(sine, (np.trace(self.rotation) - 1.0) / 2.0)))

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm."""
        return self.apply(points_mm) - as_points(points_mm)

    def inverse(self) -> "RigidMotion":
        """The motion back."""
        return RigidMotion(self.rotation.T, -self.rotation.T @ self.translation_mm)

    def after(self, first: "RigidMotion") -> "RigidMotion":
        """The motion ``first``, then this one."""
        return RigidMotion(self.rotation @ first.rotation, self.rotation @ first.translation_mm + self.translation_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Composed:
    """Deformations applied one after the other: the first of ``parts`` acts first.

    x = P_n(... P_2(P_1(X))), with the gradient by the chain rule: F = F_n ... F_2 F_1.
    """

    parts: tuple[Deformation, ...]

    def __init__(self, parts: Sequence[Deformation]) -> None:
        if not parts:
            raise InputError("A composition needs at least one deformation.")
        object.__setattr__(self, "parts", tuple(parts))

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm; NaN where any part is undefined."""
        x = start = as_points(points_mm)
        for part in self.parts:
            x = x + part.displacement(x)
        return np.asarray(x - start)

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H = F_n ... F_1 - I; NaN where any part is undefined."""
        start = as_points(points_mm)
        x, H = self.parts[0].evaluate(start)
        x = x + start
        for part in self.parts[1:]:
            u, step = part.evaluate(x)
            x = x + u
            H = H + step + step @ H  # (I + step)(I + H) - I without losing small H against I
        return np.asarray(x - start), H

    def inverse(self) -> Self:
        """The map back: the parts' inverses in the opposite order; InputError if a part has no known inverse."""
        back: list[Deformation] = []
        for part in reversed(self.parts):
            if not isinstance(part, Motion):
                raise InputError(f"This composition has no inverse, because its {type(part).__name__} has no inverse.")
            back.append(part.inverse())
        return type(self)(back)


@dataclass(frozen=True, slots=True, eq=False)
class Within:
    """A deformation that is defined only in a mask and up to ``margin_voxels`` (by nearest voxel) around it.

    Beyond, in air, a registration only extrapolates: NaN.
    """

    whole: Deformation
    mask: Mask
    margin_voxels: int = 1
    _near: BoolArray = field(init=False)

    def __post_init__(self) -> None:
        near = self.mask.inside
        if self.margin_voxels:
            near = binary_dilation(near, structure=np.ones((3, 3, 3), dtype=bool), iterations=self.margin_voxels)
        object.__setattr__(self, "_near", frozen(near, np.bool_))

    def _outside(self, points_mm: FloatArray) -> BoolArray:
        nearest = np.rint(self.mask.grid.indices_of(points_mm))
        outside = ~np.all((nearest >= 0) & (nearest < self.mask.grid.shape), axis=1)
        outside[~outside] = ~self._near[tuple(nearest[~outside].astype(np.int64).T)]
        return np.asarray(outside)

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm; NaN outside."""
        u = self.whole.displacement(points_mm)
        u[self._outside(points_mm)] = np.nan
        return u

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H (n, 3, 3); NaN outside."""
        u, H = self.whole.evaluate(points_mm)
        outside = self._outside(points_mm)
        u[outside], H[outside] = np.nan, np.nan
        return u, H

    def evaluate_on_grid(self, grid: Grid, where: BoolArray) -> tuple[FloatArray, FloatArray]:
        """U and H at the voxels of ``grid`` in ``where``; NaN outside."""
        u, H = evaluate_on_grid(self.whole, grid, where)
        outside = ~self._near[where] if grid is self.mask.grid else self._outside(grid.points(where))
        u[outside], H[outside] = np.nan, np.nan
        return u, H


@dataclass(frozen=True, slots=True, eq=False)
class SampledDisplacement:
    """A displacement known at voxel centres, interpolated by cubic splines.

    Parameters
    ----------
    grid : Grid
        Reference configuration, LPS mm.
    displacement_mm : (ni, nj, nk, 3)
        u at the voxel centres, LPS components. NaN marks voxels without a value.

    Notes
    -----
    The gradient is that of the interpolant. A point is undefined outside the voxel centres' box and where
    a voxel without a value lies among its eight neighbours. Before the spline is fitted, missing voxels and a rim
    around the grid are filled by reflecting the field about the nearest defined voxel, u(X) = 2 u(N) - u(2 N - X): a
    uniform strain stays what it is up to the outermost voxels. (Filled with u(N), it would be half as large there.)
    """

    grid: Grid
    displacement_mm: FloatArray
    _coefficients: FloatArray
    _undefined: BoolArray
    _shift: IntArray

    def __init__(self, grid: Grid, displacement_mm: FloatArray) -> None:
        values = np.asarray(displacement_mm, dtype=np.float64)
        if values.shape != (*grid.shape, 3):
            raise InputError(f"The displacement has shape {values.shape}, but its grid needs {(*grid.shape, 3)}.")
        if min(grid.shape) < 2:
            raise InputError(f"A displacement field needs at least two voxels along each axis; got {grid.shape}.")
        undefined = np.asarray(~np.isfinite(values).all(axis=-1))
        if undefined.all():
            raise InputError("The displacement field is undefined (NaN) at all voxels.")
        low, high = (np.array([edge(axis) for axis in np.nonzero(~undefined)]) for edge in (np.min, np.max))
        box = tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))
        values = _carried_past_borders(values[box], undefined[box], grid.spacing_mm)
        coefficients = np.stack([spline_coefficients(values[..., c], np.float64) for c in range(3)])
        object.__setattr__(self, "grid", grid)
        object.__setattr__(self, "displacement_mm", frozen(displacement_mm, np.float64))
        object.__setattr__(self, "_coefficients", frozen(coefficients, np.float64))
        object.__setattr__(self, "_undefined", frozen(undefined, np.bool_))
        object.__setattr__(self, "_shift", frozen(_RIM - low, np.int64))

    def _inside(self, indices: FloatArray) -> BoolArray:
        slack = 1e-9 * max(self.grid.shape)
        inside = np.all((indices >= -slack) & (indices <= np.array(self.grid.shape) - 1 + slack), axis=-1)
        if self._undefined.any():
            low = np.clip(np.floor(np.nan_to_num(indices)), 0, np.array(self.grid.shape) - 2).astype(np.int64)
            for corner in np.ndindex(2, 2, 2):
                i, j, k = (low + corner).T
                on_it = np.abs(indices - (low + corner)).max(axis=-1) < 1.0 - 1e-9
                inside &= ~(self._undefined[i, j, k] & on_it)
        return np.asarray(inside)

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm; NaN where not defined."""
        indices = self.grid.indices_of(as_points(points_mm))
        at = (indices + self._shift).T
        along = [map_coordinates(c, at, order=3, mode="mirror", prefilter=False) for c in self._coefficients]
        return np.where(self._inside(indices)[:, None], np.stack(along, axis=-1), np.nan)

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H = du/dX (n, 3, 3) of the interpolating spline; NaN where not defined."""
        from dvc.deformation.bspline import evaluate_spline

        indices = self.grid.indices_of(as_points(points_mm))
        u, per_index = evaluate_spline(self._coefficients, indices + self._shift, mirror=True)
        H = per_index @ self.grid.index_per_mm
        outside = ~self._inside(indices)
        u[outside], H[outside] = np.nan, np.nan
        return u, H


def _carried_past_borders(values: FloatArray, undefined: BoolArray, spacing_mm: FloatArray) -> FloatArray:
    """Values (ni, nj, nk, c) with a rim of voxels around them; it and undefined voxels filled by reflection."""
    shape = np.array(undefined.shape)
    missing = np.pad(undefined, _RIM, constant_values=True)
    filled = np.pad(values, [(_RIM, _RIM)] * 3 + [(0, 0)])
    nearest = distance_transform_edt(missing, sampling=spacing_mm, return_distances=False, return_indices=True)
    at = np.argwhere(missing)
    border = nearest[:, missing].T
    opposite = np.clip(2 * border - at, 0, shape + 2 * _RIM - 1)
    known = ~missing[tuple(opposite.T)]
    carried = filled[tuple(border.T)]
    carried[known] = 2.0 * carried[known] - filled[tuple(opposite[known].T)]
    filled[missing] = carried
    return np.asarray(filled)
