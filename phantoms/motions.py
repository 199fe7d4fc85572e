"""Motions with an exact gradient and inverse: incompressible flows around a body at rest.

A flow carries every point for one unit of time along a stationary velocity v. Where div v = 0, volume is
kept. Following the same velocity backwards is the inverse map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit, prange

from dvc.arrays import FloatArray, frozen
from dvc.errors import InputError

_BLOCK = 256


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
        cls,
        ellipsoids: Sequence[tuple[Sequence[float], Sequence[float], Sequence[float]]],
        sharpness: float = 5.0,
    ) -> EllipsoidUnion:
        """Merge ellipsoids, each given by centre (mm), semi-axes (mm) and turns about x, y, z (degrees)."""
        from scipy.spatial.transform import Rotation

        centres = np.array([centre for centre, _, _ in ellipsoids], dtype=np.float64)
        turns = [Rotation.from_euler("xyz", turn, degrees=True).as_matrix() for _, _, turn in ellipsoids]
        forms = np.array(
            [R @ np.diag(1.0 / np.square(axes)) @ R.T for R, (_, axes, _) in zip(turns, ellipsoids, strict=True)]
        )
        return cls(centres, 0.5 * (forms + forms.transpose(0, 2, 1)), sharpness)

    def distance(self, points_mm: FloatArray) -> FloatArray:
        """Distance to the surface to first order, (n,) mm, negative inside; exact on the surface itself."""
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        return np.asarray(_distances(points, self.centres_mm, self.forms, self.sharpness))


@njit(cache=True)
def distance(x, y, z, centres, forms, sharpness):  # type: ignore[no-untyped-def]
    """First-order distance (sqrt(Q) - 1) / |grad sqrt(Q)| of one point to an EllipsoidUnion, mm."""
    count = centres.shape[0]
    total, s0, s1, s2 = 0.0, 0.0, 0.0, 0.0
    least = 1e300
    for i in range(count):
        a, b, c = x - centres[i, 0], y - centres[i, 1], z - centres[i, 2]
        A = forms[i]
        g0 = A[0, 0] * a + A[0, 1] * b + A[0, 2] * c
        g1 = A[0, 1] * a + A[1, 1] * b + A[1, 2] * c
        g2 = A[0, 2] * a + A[1, 2] * b + A[2, 2] * c
        q = a * g0 + b * g1 + c * g2
        if q < least:  # keep the sums relative to the smallest q, so that no exponential overflows
            scale = np.exp(-sharpness * (least - q))
            total, s0, s1, s2 = total * scale, s0 * scale, s1 * scale, s2 * scale
            least = q
        weight = np.exp(-sharpness * (q - least))
        total += weight
        s0 += weight * g0
        s1 += weight * g1
        s2 += weight * g2
    # deep inside, Q falls below zero; the distance there is only known to be large
    Q = max(least - np.log(total) / sharpness, 0.25)
    slope = np.sqrt(s0 * s0 + s1 * s1 + s2 * s2) / total  # half the gradient of Q
    root = np.sqrt(Q)
    return (root - 1.0) * root / max(slope, 1e-3)


@njit(parallel=True, cache=True)
def _distances(points, centres, forms, sharpness):  # type: ignore[no-untyped-def]
    out = np.empty(points.shape[0])
    for n in prange(points.shape[0]):
        out[n] = distance(points[n, 0], points[n, 1], points[n, 2], centres, forms, sharpness)
    return out


@njit(cache=True)
def _velocity(p, centres, forms, sharpness, ramp, window, plate, pivot, v, L, g, H, q):  # type: ignore[no-untyped-def]
    """Write the velocity at p into v and its gradient into L; g, H and q are room to work in."""
    v[:] = 0.0
    L[:, :] = 0.0
    # The window w = exp(-s / 2), its gradient w * e, its Hessian w * (e e^T - diag(f)).
    f0, f1, f2 = window[1, 0] ** -2, window[1, 1] ** -2, window[1, 2] ** -2
    e0, e1, e2 = (window[0, 0] - p[0]) * f0, (window[0, 1] - p[1]) * f1, (window[0, 2] - p[2]) * f2
    s = e0 * e0 / f0 + e1 * e1 / f1 + e2 * e2 / f2
    if s > 80.0:
        return
    w = np.exp(-0.5 * s)

    count = centres.shape[0]
    least = 1e300
    for i in range(count):
        a, b, c = p[0] - centres[i, 0], p[1] - centres[i, 1], p[2] - centres[i, 2]
        A = forms[i]
        q[i] = A[0, 0] * a * a + A[1, 1] * b * b + A[2, 2] * c * c
        q[i] += 2.0 * (A[0, 1] * a * b + A[0, 2] * a * c + A[1, 2] * b * c)
        least = min(least, q[i])
    if least <= 1.0:
        return
    chi, c1, c2 = 1.0, 0.0, 0.0
    # beyond t = 3 the cutoff differs from 1 by 2e-12
    if least - np.log(count) / sharpness < (1.0 + 3.0 * ramp) ** 2:
        total = 0.0
        g[:] = 0.0
        H[:, :] = 0.0
        for i in range(count):
            excess = sharpness * (q[i] - least)
            if excess > 40.0:
                continue
            a, b, c = p[0] - centres[i, 0], p[1] - centres[i, 1], p[2] - centres[i, 2]
            A = forms[i]
            d0 = 2.0 * (A[0, 0] * a + A[0, 1] * b + A[0, 2] * c)
            d1 = 2.0 * (A[0, 1] * a + A[1, 1] * b + A[1, 2] * c)
            d2 = 2.0 * (A[0, 2] * a + A[1, 2] * b + A[2, 2] * c)
            weight = np.exp(-excess)
            total += weight
            g[0] += weight * d0
            g[1] += weight * d1
            g[2] += weight * d2
            H[0, 0] += weight * (2.0 * A[0, 0] - sharpness * d0 * d0)
            H[0, 1] += weight * (2.0 * A[0, 1] - sharpness * d0 * d1)
            H[0, 2] += weight * (2.0 * A[0, 2] - sharpness * d0 * d2)
            H[1, 1] += weight * (2.0 * A[1, 1] - sharpness * d1 * d1)
            H[1, 2] += weight * (2.0 * A[1, 2] - sharpness * d1 * d2)
            H[2, 2] += weight * (2.0 * A[2, 2] - sharpness * d2 * d2)
        Q = least - np.log(total) / sharpness
        if Q <= 1.0:
            return
        for i in range(3):
            g[i] /= total
        for i in range(3):
            for j in range(i, 3):
                H[i, j] = H[i, j] / total + sharpness * g[i] * g[j]
        root = np.sqrt(Q)
        t = (root - 1.0) / ramp
        # chi = 1 - exp(-t^3) as a function of Q: first and second derivative by the chain rule
        tail = np.exp(-(t**3))
        chi = 1.0 - tail
        dt = 0.5 / (root * ramp)
        ddt = -0.25 / (Q * root * ramp)
        dchi = 3.0 * t * t * tail
        ddchi = (6.0 * t - 9.0 * t**4) * tail
        c1 = dchi * dt
        c2 = ddchi * dt * dt + dchi * ddt
        for i in range(3):
            for j in range(i, 3):
                H[i, j] = c2 * g[i] * g[j] + c1 * H[i, j]
        for i in range(3):
            g[i] *= c1
    else:
        g[:] = 0.0
        H[:, :] = 0.0

    # psi = chi w
    H[0, 0] = w * (H[0, 0] + 2.0 * g[0] * e0 + chi * (e0 * e0 - f0))
    H[1, 1] = w * (H[1, 1] + 2.0 * g[1] * e1 + chi * (e1 * e1 - f1))
    H[2, 2] = w * (H[2, 2] + 2.0 * g[2] * e2 + chi * (e2 * e2 - f2))
    H[0, 1] = w * (H[0, 1] + g[0] * e1 + g[1] * e0 + chi * e0 * e1)
    H[0, 2] = w * (H[0, 2] + g[0] * e2 + g[2] * e0 + chi * e0 * e2)
    H[1, 2] = w * (H[1, 2] + g[1] * e2 + g[2] * e1 + chi * e1 * e2)
    H[1, 0], H[2, 0], H[2, 1] = H[0, 1], H[0, 2], H[1, 2]
    g[0] = w * (g[0] + chi * e0)
    g[1] = w * (g[1] + chi * e1)
    g[2] = w * (g[2] + chi * e2)
    psi = chi * w

    r0, r1, r2 = p[0] - pivot[0], p[1] - pivot[1], p[2] - pivot[2]
    along = g[0] * plate[0] + g[1] * plate[1] + g[2] * plate[2]
    out = g[0] * r0 + g[1] * r1 + g[2] * r2
    for i in range(3):
        r = p[i] - pivot[i]
        v[i] = plate[i] * (psi + 0.5 * out) - 0.5 * r * along
        for j in range(3):
            Hr = H[j, 0] * r0 + H[j, 1] * r1 + H[j, 2] * r2
            Hc = H[j, 0] * plate[0] + H[j, 1] * plate[1] + H[j, 2] * plate[2]
            L[i, j] = plate[i] * (1.5 * g[j] + 0.5 * Hr) - 0.5 * r * Hc
        L[i, i] -= 0.5 * along


@njit(parallel=True, cache=True)
def _carry(points, centres, forms, sharpness, ramp, window, plate, pivot, steps, gradient):  # type: ignore[no-untyped-def]
    """Runge-Kutta 4 on x' = v(x) and, with it, on (F - I)' = grad v F."""
    count = points.shape[0]
    u = np.zeros((count, 3))
    F1 = np.zeros((count if gradient else 0, 3, 3))
    h = 1.0 / steps
    nodes = np.array([0.0, 0.5 * h, 0.5 * h, h])
    shares = np.array([h / 6.0, h / 3.0, h / 3.0, h / 6.0])
    for block in prange((count + _BLOCK - 1) // _BLOCK):
        v, L, g, H = np.zeros(3), np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3))
        p, du, q = np.zeros(3), np.zeros(3), np.zeros(centres.shape[0])
        M, K, dM = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
        for n in range(block * _BLOCK, min(count, (block + 1) * _BLOCK)):
            for _ in range(steps):
                du[:] = 0.0
                dM[:, :] = 0.0
                v[:] = 0.0
                K[:, :] = 0.0
                moving = False
                for stage in range(4):
                    for i in range(3):
                        p[i] = points[n, i] + u[n, i] + nodes[stage] * v[i]
                    if gradient:
                        for i in range(3):
                            for j in range(3):
                                M[i, j] = F1[n, i, j] + nodes[stage] * K[i, j]
                    _velocity(p, centres, forms, sharpness, ramp, window, plate, pivot, v, L, g, H, q)
                    for i in range(3):
                        du[i] += shares[stage] * v[i]
                        moving = moving or v[i] != 0.0
                    if gradient:
                        for i in range(3):
                            for j in range(3):
                                K[i, j] = L[i, j] + L[i, 0] * M[0, j] + L[i, 1] * M[1, j] + L[i, 2] * M[2, j]
                                dM[i, j] += shares[stage] * K[i, j]
                if not moving:
                    break  # a point of a stationary flow that is at rest stays at rest
                for i in range(3):
                    u[n, i] += du[i]
                if gradient:
                    for i in range(3):
                        for j in range(3):
                            F1[n, i, j] += dM[i, j]
    return u, F1


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """An incompressible flow that moves what lies near a plate with it, around a body at rest.

    The velocity is v = curl(psi a), a(x) = c x (x - o) / 2, of which curl a = c:

        v = psi c + [c (grad psi . r) - r (grad psi . c)] / 2,   r = x - o,

    so that div v = 0 exactly, v = c where psi = 1 and v = 0 where psi = 0. psi is the product of a cutoff
    that is 0 in the body at rest and rises as 1 - exp(-t^3), t = (sqrt(Q) - 1) / ramp, outside it, and of a
    Gaussian window around the sole, which ends the motion upward and forward. Points follow v for one unit of time by
    Runge-Kutta 4 with fixed steps; F follows dF/dt = (grad v) F by the same scheme, which makes it the
    derivative of the discrete map itself.

    Parameters
    ----------
    plate_mm : (3,)
        c, the plate's displacement, LPS mm.
    pivot_mm : (3,)
        o, the middle of the plate's contact, LPS mm.
    rest : EllipsoidUnion
        The body that does not move.
    ramp : float
        Thickness of the layer over which motion rises from the body, in units of the body's radius.
    centre_mm, width_mm : (3,)
        Of the window, LPS mm: its middle, and its standard deviation along each axis.
    steps : int
        Runge-Kutta steps.

    Raises
    ------
    InputError
        If a number is not finite, or the widths, the ramp or the steps are not positive.
    """

    plate_mm: FloatArray
    pivot_mm: FloatArray
    rest: EllipsoidUnion
    ramp: float
    centre_mm: FloatArray
    width_mm: FloatArray
    steps: int = 10

    def __post_init__(self) -> None:
        for name in ("plate_mm", "pivot_mm", "centre_mm", "width_mm"):
            vector = frozen(getattr(self, name), np.float64)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                raise InputError(f"A flow's {name} needs three finite components; got {vector.tolist()}.")
            object.__setattr__(self, name, vector)
        if not (self.width_mm > 0).all():
            raise InputError(f"A flow's width_mm must be positive; got {self.width_mm.tolist()}.")
        if not self.ramp > 0 or self.steps < 1:
            raise InputError(f"A flow needs ramp > 0 and steps >= 1; got {self.ramp} and {self.steps}.")

    def _follow(self, points_mm: FloatArray, gradient: bool) -> tuple[FloatArray, FloatArray]:
        points = np.ascontiguousarray(points_mm, dtype=np.float64).reshape(-1, 3)
        window = np.array([self.centre_mm, self.width_mm])
        body = self.rest
        u, H = _carry(
            points, body.centres_mm, body.forms, body.sharpness, self.ramp, window,
            self.plate_mm, self.pivot_mm, self.steps, gradient,
        )  # fmt: skip
        lost = ~np.isfinite(points).all(axis=-1)
        u[lost] = np.nan
        if gradient:
            H[lost] = np.nan
        return u, H

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        """u(X), (n, 3) mm, at points X (n, 3) LPS mm."""
        return self._follow(points_mm, False)[0]

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        """u(X) (n, 3) mm and H = F - I (n, 3, 3) of the discrete map at points X (n, 3) LPS mm."""
        return self._follow(points_mm, True)

    def inverse(self) -> Flow:
        """Return the backward flow."""
        return replace(self, plate_mm=-self.plate_mm)
