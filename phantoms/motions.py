"""Closed-form motions with exact gradient and inverse, defined in all space, bone included."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from dvc import Affine
from dvc.arrays import FloatArray, as_points, frozen
from dvc.errors import InputError

_UNIT = 1e-6


def stretched(stretches: FloatArray, centre_mm: FloatArray) -> Affine:
    """Uniform stretch along x, y and z about a centre (3,), LPS mm: F = diag(stretches); InputError unless positive.

    Examples
    --------
    >>> motion = stretched(np.array([1.1, 1.0, 1.0]), np.zeros(3))
    >>> motion.displacement(np.array([[10.0, 5.0, 0.0]])).round(9).tolist()
    [[1.0, 0.0, 0.0]]
    """
    factors = np.asarray(stretches, dtype=np.float64)
    if factors.shape != (3,) or not (np.isfinite(factors) & (factors > 0)).all():
        raise InputError(f"A stretch needs three positive factors; got {factors.tolist()}.")
    return _about(np.diag(factors), centre_mm)


def compressed(axis: int, stretch: float, centre_mm: FloatArray) -> Affine:
    """Incompressible compression along axis 0, 1 or 2 about a centre (3,), LPS mm.

    F has ``stretch`` along the axis and 1 / sqrt(stretch) across; InputError for another axis or unless it is positive.
    """
    if axis not in {0, 1, 2} or not stretch > 0:
        raise InputError(f"A compression needs an axis 0, 1 or 2 and a positive stretch; got {axis}, {stretch}.")
    factors = np.full(3, stretch**-0.5)
    factors[axis] = stretch
    return stretched(factors, centre_mm)


def sheared(direction: FloatArray, normal: FloatArray, amount: float, centre_mm: FloatArray) -> Affine:
    """Simple shear F = I + amount d (x) n about a centre (3,), LPS mm.

    InputError unless d, the direction, and n, the normal (LPS), are orthogonal unit vectors.
    """
    d, n = _frame(direction, normal)
    return _about(np.eye(3) + amount * np.outer(d, n), centre_mm)


def _about(F: FloatArray, centre_mm: FloatArray) -> Affine:
    centre = np.asarray(centre_mm, dtype=np.float64)
    return Affine(F, centre - F @ centre)


def _frame(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    a, b = frozen(first, np.float64), frozen(second, np.float64)
    if a.shape != (3,) or b.shape != (3,):
        raise InputError(f"Directions must have three components; got {a.tolist()} and {b.tolist()}.")
    if abs(a @ a - 1) > _UNIT or abs(b @ b - 1) > _UNIT or abs(a @ b) > _UNIT:
        raise InputError(f"The directions must be perpendicular unit vectors; got {a.tolist()} and {b.tolist()}.")
    return a, b


def _set_frame(motion: object, *names: str) -> None:
    """Replace two attributes of a frozen motion by perpendicular unit vectors, read-only."""
    for name, vector in zip(names, _frame(*(getattr(motion, name) for name in names)), strict=True):
        object.__setattr__(motion, name, vector)


@dataclass(frozen=True, slots=True, eq=False)
class ShearWave:
    """Simple shear whose amount varies as a cosine: u = (peak L / 2 pi) sin(2 pi n . X / L + phase) d.

    H = peak cos(2 pi n . X / L + phase) d (x) n: simple shear everywhere, det F = 1, for orthogonal d and n. Since
    n . x = n . X, the inverse is the same wave with the opposite sign.

    Parameters
    ----------
    direction, normal : (3,)
        d and n, orthogonal unit vectors.
    wavelength_mm : float
        L, mm.
    peak : float
        Largest H_dn, dimensionless; the max. shear there is peak sqrt(4 + peak^2) / 4, about half of it.
    phase : float
        Radians.

    Raises
    ------
    InputError
        If the wavelength is not positive, or the directions are not orthogonal unit vectors.
    """

    direction: FloatArray
    normal: FloatArray
    wavelength_mm: float
    peak: float
    phase: float = 0.0

    def __post_init__(self) -> None:
        _set_frame(self, "direction", "normal")
        if not (np.isfinite(self.wavelength_mm) and self.wavelength_mm > 0 and np.isfinite(self.peak)):
            raise InputError(f"A wave needs a positive wavelength in mm; got {self.wavelength_mm} and {self.peak}.")

    def _angle(self, points_mm: FloatArray) -> FloatArray:
        points = as_points(points_mm)
        return np.asarray(2.0 * np.pi * (points @ self.normal) / self.wavelength_mm + self.phase)

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm, at points X (n, 3) LPS mm."""
        size = self.peak * self.wavelength_mm / (2.0 * np.pi)
        return np.asarray(size * np.sin(self._angle(points_mm))[:, None] * self.direction)

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H (n, 3, 3) at points X (n, 3) LPS mm."""
        slope = self.peak * np.cos(self._angle(points_mm))
        return self.displacement(points_mm), slope[:, None, None] * np.outer(self.direction, self.normal)

    def inverse(self) -> Self:
        """Return the same wave with the opposite sign."""
        return replace(self, peak=-self.peak)


@dataclass(frozen=True, slots=True, eq=False)
class ShearStar:
    """Simple shear in waves whose period grows along an axis, as the star of the DIC Challenge 2.0, in 3D.

    u = A cos(2 pi y / p) d with y = n . (X - c). The period p is linear in s = a . (X - c), from the shortest at
    s = -L/2 to the longest at L/2, and constant beyond. On the middle plane, y = 0, the displacement is A everywhere.
    With d across n and a, det F = 1, and the inverse is the same star with the opposite sign.

    Parameters
    ----------
    centre_mm : (3,)
        c, LPS mm.
    along, normal : (3,)
        a and n, orthogonal unit vectors; d = a x n.
    amplitude_mm : float
        A, mm.
    shortest_mm, longest_mm, length_mm : float
        Periods at both ends, and L, mm.

    Raises
    ------
    InputError
        If a length is not positive, or the directions are not orthogonal unit vectors.

    References
    ----------
    Reu and others, DIC Challenge 2.0, Exp Mech 2022, doi:10.1007/s11340-021-00806-6.
    """

    centre_mm: FloatArray
    along: FloatArray
    normal: FloatArray
    amplitude_mm: float
    shortest_mm: float
    longest_mm: float
    length_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_mm", frozen(self.centre_mm, np.float64))
        _set_frame(self, "along", "normal")
        lengths = self.shortest_mm, self.longest_mm, self.length_mm
        if not (np.isfinite([*lengths, self.amplitude_mm]).all() and min(lengths) > 0):
            raise InputError(f"A star needs positive periods and a positive length in mm; got {lengths}.")

    @property
    def direction(self) -> FloatArray:
        """d, the direction of the displacement, a unit vector."""
        return np.cross(self.along, self.normal)

    def period_mm(self, points_mm: FloatArray) -> FloatArray:
        """Period p (n,) at points (n, 3) LPS mm."""
        return self._period(as_points(points_mm))[0]

    def _period(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The period, mm, and its slope along the axis."""
        part = (points - self.centre_mm) @ self.along / self.length_mm + 0.5
        slope = (self.longest_mm - self.shortest_mm) / self.length_mm
        inside = (part > 0.0) & (part < 1.0)
        return self.shortest_mm + slope * self.length_mm * np.clip(part, 0.0, 1.0), np.where(inside, slope, 0.0)

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm, at points X (n, 3) LPS mm."""
        return self.evaluate(points_mm)[0]

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H (n, 3, 3) at points X (n, 3) LPS mm."""
        points = as_points(points_mm)
        (period, slope), y = self._period(points), (points - self.centre_mm) @ self.normal
        angle = 2.0 * np.pi * y / period
        steep = (2.0 * np.pi / period)[:, None] * (self.normal - (y * slope / period)[:, None] * self.along)
        u = self.amplitude_mm * np.cos(angle)[:, None] * self.direction
        H = (-self.amplitude_mm * np.sin(angle))[:, None, None] * (self.direction[:, None] * steep[:, None, :])
        return u, H

    def inverse(self) -> Self:
        """Return the same star with the opposite sign."""
        return replace(self, amplitude_mm=-self.amplitude_mm)


@dataclass(frozen=True, slots=True, eq=False)
class Bending:
    """Isochoric bending of a block to an arc, in the plane of its length and its thickness.

    With Y along the length and Z along the thickness from the centre, R the radius of the fibre whose length is
    unchanged: r = sqrt(R^2 + 2 R Z), theta = Y / R; y = r sin(theta), z = r cos(theta) - R. The third coordinate is
    kept. Principal stretches are R / r and r / R: det F = 1.

    Parameters
    ----------
    centre_mm : (3,)
        Fixed point, LPS mm.
    length, thickness : (3,)
        Orthogonal unit vectors; the block bends away from ``thickness``.
    radius_mm : float
        R, mm.

    Notes
    -----
    Undefined (NaN) where Z <= -R / 2; one-to-one for |Y| < pi R.

    References
    ----------
    Rivlin, Proc R Soc A 1949, doi:10.1098/rspa.1949.0004 (flexure of an incompressible block).
    """

    centre_mm: FloatArray
    length: FloatArray
    thickness: FloatArray
    radius_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_mm", frozen(self.centre_mm, np.float64))
        _set_frame(self, "length", "thickness")
        if not (np.isfinite(self.radius_mm) and self.radius_mm > 0):
            raise InputError(f"The bending radius must be positive, mm; got {self.radius_mm}.")

    def _axes(self) -> FloatArray:
        """Columns: length, thickness, and the axis of bending."""
        return np.column_stack([self.length, self.thickness, np.cross(self.length, self.thickness)])

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm, at points X (n, 3) LPS mm; NaN where undefined."""
        return self.evaluate(points_mm)[0]

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H (n, 3, 3) at points X (n, 3) LPS mm; NaN where undefined."""
        A, R = self._axes(), self.radius_mm
        local = (as_points(points_mm) - self.centre_mm) @ A
        squared = R * R + 2.0 * R * local[:, 1]
        r = np.sqrt(np.where(squared > 0.0, squared, np.nan))
        theta = local[:, 0] / R
        sine, cosine = np.sin(theta), np.cos(theta)
        moved = np.column_stack([r * sine, r * cosine - R, local[:, 2]])
        F = np.zeros((len(local), 3, 3))
        F[:, 0, 0], F[:, 1, 0] = cosine * r / R, -sine * r / R
        F[:, 0, 1], F[:, 1, 1] = sine * R / r, cosine * R / r
        F[:, 2, 2] = 1.0
        return (moved - local) @ A.T, A @ F @ A.T - np.eye(3)

    def inverse(self) -> "_Straightening":
        """The map back: the arc made straight."""
        return _Straightening(self)


@dataclass(frozen=True, slots=True, eq=False)
class _Straightening:
    """The inverse of `Bending`."""

    bending: Bending

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        A, R = self.bending._axes(), self.bending.radius_mm
        local = (as_points(points_mm) - self.bending.centre_mm) @ A
        up = local[:, 1] + R
        r2 = local[:, 0] ** 2 + up**2
        back = np.column_stack([R * np.arctan2(local[:, 0], up), (r2 - R * R) / (2.0 * R), local[:, 2]])
        return np.asarray((back - local) @ A.T)

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        u = self.displacement(points_mm)
        _, H = self.bending.evaluate(np.asarray(points_mm) + u)
        return u, np.linalg.inv(np.eye(3) + H) - np.eye(3)

    def inverse(self) -> Bending:
        return self.bending
