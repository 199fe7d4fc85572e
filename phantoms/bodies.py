"""Rounded bodies in closed form: ellipsoids merged by a smooth minimum."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from dvc.arrays import FloatArray, frozen
from dvc.compiled import njit
from dvc.errors import InputError
from dvc.threads import in_parts
from phantoms.compiled import at_point


@dataclass(frozen=True, slots=True, eq=False)
class EllipsoidUnion:
    """A rounded body: ellipsoids merged by a smooth minimum.

    With q_i(X) = (X - c_i)^T A_i (X - c_i), the body is where

        Q(X) = -1/k ln sum_i exp(-k q_i(X)) <= 1.

    Parameters
    ----------
    centres_mm : (n, 3)
        Centres c_i, LPS mm.
    forms : (n, 3, 3)
        Symmetric positive definite A_i, 1/mm2.
    sharpness : float
        k, no unit. The larger, the closer to the plain union.

    Raises
    ------
    InputError
        If shapes do not agree, a form is not positive definite, or the sharpness is not positive.

    Examples
    --------
    >>> ball = EllipsoidUnion.of([((0.0, 0.0, 0.0), (10.0, 10.0, 10.0), (0.0, 0.0, 0.0))])
    >>> ball.distance(np.array([[12.0, 0.0, 0.0], [0.0, 9.0, 0.0]])).round(6).tolist()
    [2.0, -1.0]
    """

    centres_mm: FloatArray
    forms: FloatArray
    sharpness: float = 5.0

    def __post_init__(self) -> None:
        centres, forms = frozen(self.centres_mm, np.float64), frozen(self.forms, np.float64)
        if centres.ndim != 2 or centres.shape[1:] != (3,) or forms.shape != (len(centres), 3, 3) or not len(centres):
            raise InputError(
                f"A body needs n centres (n, 3) and n forms (n, 3, 3); got {centres.shape} and {forms.shape}."
            )
        if not self.sharpness > 0:
            raise InputError(f"The sharpness of a body must be positive; got {self.sharpness}.")
        if np.abs(forms - forms.transpose(0, 2, 1)).max() > 1e-12 or np.linalg.eigvalsh(forms).min() <= 0:
            raise InputError("Each form of a body must be symmetric and positive definite.")
        object.__setattr__(self, "centres_mm", centres)
        object.__setattr__(self, "forms", forms)

    @classmethod
    def of(
        cls, ellipsoids: Sequence[tuple[Sequence[float], Sequence[float], Sequence[float]]], sharpness: float = 5.0
    ) -> Self:
        """Merge ellipsoids, each given by centre (mm), semi-axes (mm) and turns about x, y, z (degrees)."""
        from scipy.spatial.transform import Rotation

        centres = np.array([centre for centre, _, _ in ellipsoids], dtype=np.float64)
        turns = [Rotation.from_euler("xyz", turn, degrees=True).as_matrix() for _, _, turn in ellipsoids]
        inverse = [np.diag(1.0 / np.square(axes)) for _, axes, _ in ellipsoids]
        forms = np.array([R @ form @ R.T for R, form in zip(turns, inverse, strict=True)])
        return cls(centres, 0.5 * (forms + forms.transpose(0, 2, 1)), sharpness)

    def distance(self, points_mm: FloatArray) -> FloatArray:
        """First-order distance of points (n, 3) mm to the surface, (n,) mm; negative inside, exact on the surface."""
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        out = np.empty(len(points))
        in_parts(_distances, len(points), points, self.centres_mm, self.forms, self.sharpness, out)
        return out


@at_point
def _form(A, a, b, c):  # type: ignore[no-untyped-def]
    across = A[0, 1] * a * b + A[0, 2] * a * c + A[1, 2] * b * c
    return A[0, 0] * a * a + A[1, 1] * b * b + A[2, 2] * c * c + 2.0 * across


@at_point
def distance(x, y, z, centres, forms, sharpness):  # type: ignore[no-untyped-def]
    """First-order distance (sqrt(Q) - 1) / |grad sqrt(Q)| of one point to an EllipsoidUnion, mm."""
    count = centres.shape[0]
    least = 1e300
    for i in range(count):
        least = min(least, _form(forms[i], x - centres[i, 0], y - centres[i, 1], z - centres[i, 2]))
    total, s0, s1, s2 = 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        a, b, c = x - centres[i, 0], y - centres[i, 1], z - centres[i, 2]
        A = forms[i]
        excess = sharpness * (_form(A, a, b, c) - least)
        if excess > 40.0:
            continue
        weight = np.exp(-excess)
        total += weight
        s0 += weight * (A[0, 0] * a + A[0, 1] * b + A[0, 2] * c)
        s1 += weight * (A[0, 1] * a + A[1, 1] * b + A[1, 2] * c)
        s2 += weight * (A[0, 2] * a + A[1, 2] * b + A[2, 2] * c)
    # deep inside, Q falls below zero, and the distance is known only to be large
    Q = max(least - np.log(total) / sharpness, 0.25)
    slope = np.sqrt(s0 * s0 + s1 * s1 + s2 * s2) / total  # half the gradient of Q
    root = np.sqrt(Q)
    return (root - 1.0) * root / max(slope, 1e-3)


@njit(nogil=True, cache=True)
def _distances(start, stop, points, centres, forms, sharpness, out):  # type: ignore[no-untyped-def]
    for n in range(start, stop):
        out[n] = distance(points[n, 0], points[n, 1], points[n, 2], centres, forms, sharpness)
