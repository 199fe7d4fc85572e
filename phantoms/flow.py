"""Flows of soft tissue around constrained bone and, optionally, inside a constrained skin."""

from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np

from dvc.arrays import FloatArray, as_points, frozen
from dvc.compiled import njit
from dvc.errors import InputError
from dvc.threads import in_parts
from phantoms.bodies import EllipsoidUnion
from phantoms.compiled import at_point

_NOTHING = 27.0  # exp(-27) = 2e-12: a rise is complete beyond
_NO_GRADIENT = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@at_point
def _rise(x, y, z, parts, numbers, side, q):  # type: ignore[no-untyped-def]
    """Return chi = 1 - exp(-t^order), t = side (sqrt(Q) - 1) / ramp, its gradient, and its Hessian (xx xy xz yy yz zz).

    side is 1 outside the body and -1 inside it; on the other side chi is 0. q is room to work in.
    """
    sharpness, ramp, order, end, below = numbers[0], numbers[1], numbers[2], numbers[3], numbers[4]
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    all_of_it = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    count = parts.shape[0]
    least = 1e300
    for i in range(count):
        a, b, c = x - parts[i, 0], y - parts[i, 1], z - parts[i, 2]
        across = parts[i, 4] * a * b + parts[i, 5] * a * c + parts[i, 7] * b * c
        q[i] = parts[i, 3] * a * a + parts[i, 6] * b * b + parts[i, 8] * c * c + 2.0 * across
        least = min(least, q[i])
    if side > 0.0:
        if least <= 1.0:  # Q is below the least q
            return nothing
        if least - below >= (1.0 + end * ramp) ** 2:
            return all_of_it
    elif least <= max(0.0, 1.0 - end * ramp) ** 2:
        return all_of_it
    total, g0, g1, g2 = 0.0, 0.0, 0.0, 0.0
    h00, h01, h02, h11, h12, h22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        excess = sharpness * (q[i] - least)
        if excess > _NOTHING:
            continue
        a, b, c = x - parts[i, 0], y - parts[i, 1], z - parts[i, 2]
        d0 = 2.0 * (parts[i, 3] * a + parts[i, 4] * b + parts[i, 5] * c)
        d1 = 2.0 * (parts[i, 4] * a + parts[i, 6] * b + parts[i, 7] * c)
        d2 = 2.0 * (parts[i, 5] * a + parts[i, 7] * b + parts[i, 8] * c)
        weight = np.exp(-excess)
        total += weight
        g0 += weight * d0
        g1 += weight * d1
        g2 += weight * d2
        h00 += weight * (2.0 * parts[i, 3] - sharpness * d0 * d0)
        h01 += weight * (2.0 * parts[i, 4] - sharpness * d0 * d1)
        h02 += weight * (2.0 * parts[i, 5] - sharpness * d0 * d2)
        h11 += weight * (2.0 * parts[i, 6] - sharpness * d1 * d1)
        h12 += weight * (2.0 * parts[i, 7] - sharpness * d1 * d2)
        h22 += weight * (2.0 * parts[i, 8] - sharpness * d2 * d2)
    Q = least - np.log(total) / sharpness
    if Q < 0.01:  # near the middle of a body: nothing outside has risen there, everything inside has
        return nothing if side > 0.0 else all_of_it
    root = np.sqrt(Q)
    t = side * (root - 1.0) / ramp
    if t <= 0.0:
        return nothing
    if t >= end:
        return all_of_it
    # By the chain rule from Q to t to chi.
    tail = np.exp(-t * t) if order == 2.0 else np.exp(-t * t * t)
    power = 2.0 * t if order == 2.0 else 3.0 * t * t
    slope = 2.0 if order == 2.0 else 6.0 * t
    dt = side * 0.5 / (root * ramp)
    ddt = -side * 0.25 / (Q * root * ramp)
    dchi = power * tail
    ddchi = (slope - power * power) * tail
    c1 = dchi * dt
    c2 = ddchi * dt * dt + dchi * ddt + c1 * sharpness
    g0, g1, g2, c3 = g0 / total, g1 / total, g2 / total, c1 / total
    return (
        1.0 - tail, c1 * g0, c1 * g1, c1 * g2,
        c2 * g0 * g0 + c3 * h00, c2 * g0 * g1 + c3 * h01, c2 * g0 * g2 + c3 * h02,
        c2 * g1 * g1 + c3 * h11, c2 * g1 * g2 + c3 * h12, c2 * g2 * g2 + c3 * h22,
    )  # fmt: skip


@at_point
def _velocity(x, y, z, rest, skin, window, plate, pivot, keeps, q):  # type: ignore[no-untyped-def]
    """Velocity at a point, and the rows of its gradient; q is room to work in."""
    still = (0.0, 0.0, 0.0), _NO_GRADIENT
    # The window w = exp(-s / 2), its gradient w * e, its Hessian w * (e e^T - diag(f)).
    f0, f1, f2 = window[1, 0], window[1, 1], window[1, 2]
    e0, e1, e2 = (window[0, 0] - x) * f0, (window[0, 1] - y) * f1, (window[0, 2] - z) * f2
    s = e0 * e0 / f0 + e1 * e1 / f1 + e2 * e2 / f2
    if s > 2.0 * _NOTHING:
        return still
    chi, g0, g1, g2, h00, h01, h02, h11, h12, h22 = _rise(x, y, z, rest[0], rest[1], 1.0, q)
    if chi == 0.0:
        return still
    if skin[0].shape[0]:
        k, j0, j1, j2, k00, k01, k02, k11, k12, k22 = _rise(x, y, z, skin[0], skin[1], -1.0, q)
        if k == 0.0:
            return still
        h00 = chi * k00 + 2.0 * g0 * j0 + k * h00
        h01 = chi * k01 + g0 * j1 + g1 * j0 + k * h01
        h02 = chi * k02 + g0 * j2 + g2 * j0 + k * h02
        h11 = chi * k11 + 2.0 * g1 * j1 + k * h11
        h12 = chi * k12 + g1 * j2 + g2 * j1 + k * h12
        h22 = chi * k22 + 2.0 * g2 * j2 + k * h22
        g0, g1, g2 = chi * j0 + k * g0, chi * j1 + k * g1, chi * j2 + k * g2
        chi *= k

    # psi = chi w
    w = np.exp(-0.5 * s)
    c0, c1, c2 = plate[0], plate[1], plate[2]
    if not keeps:
        g0, g1, g2 = w * (g0 + chi * e0), w * (g1 + chi * e1), w * (g2 + chi * e2)
        moved = chi * w * c0, chi * w * c1, chi * w * c2
        return moved, (c0 * g0, c0 * g1, c0 * g2, c1 * g0, c1 * g1, c1 * g2, c2 * g0, c2 * g1, c2 * g2)
    h00 = w * (h00 + 2.0 * g0 * e0 + chi * (e0 * e0 - f0))
    h11 = w * (h11 + 2.0 * g1 * e1 + chi * (e1 * e1 - f1))
    h22 = w * (h22 + 2.0 * g2 * e2 + chi * (e2 * e2 - f2))
    h01 = w * (h01 + g0 * e1 + g1 * e0 + chi * e0 * e1)
    h02 = w * (h02 + g0 * e2 + g2 * e0 + chi * e0 * e2)
    h12 = w * (h12 + g1 * e2 + g2 * e1 + chi * e1 * e2)
    g0, g1, g2 = w * (g0 + chi * e0), w * (g1 + chi * e1), w * (g2 + chi * e2)

    r0, r1, r2 = x - pivot[0], y - pivot[1], z - pivot[2]
    along = 0.5 * (g0 * c0 + g1 * c1 + g2 * c2)
    share = chi * w + 0.5 * (g0 * r0 + g1 * r1 + g2 * r2)
    moved = c0 * share - r0 * along, c1 * share - r1 * along, c2 * share - r2 * along
    # Rows of L = c (x) (3 g + H r) / 2 - r (x) (H c) / 2 - I (g . c) / 2
    m0 = 1.5 * g0 + 0.5 * (h00 * r0 + h01 * r1 + h02 * r2)
    m1 = 1.5 * g1 + 0.5 * (h01 * r0 + h11 * r1 + h12 * r2)
    m2 = 1.5 * g2 + 0.5 * (h02 * r0 + h12 * r1 + h22 * r2)
    n0 = 0.5 * (h00 * c0 + h01 * c1 + h02 * c2)
    n1 = 0.5 * (h01 * c0 + h11 * c1 + h12 * c2)
    n2 = 0.5 * (h02 * c0 + h12 * c1 + h22 * c2)
    return moved, (
        c0 * m0 - r0 * n0 - along, c0 * m1 - r0 * n1, c0 * m2 - r0 * n2,
        c1 * m0 - r1 * n0, c1 * m1 - r1 * n1 - along, c1 * m2 - r1 * n2,
        c2 * m0 - r2 * n0, c2 * m1 - r2 * n1, c2 * m2 - r2 * n2 - along,
    )  # fmt: skip


@at_point
def _grown(L, M):  # type: ignore[no-untyped-def]
    """L + L M, of matrices by their rows."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = L
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = M
    return (
        a0 + a0 * b0 + a1 * b3 + a2 * b6, a1 + a0 * b1 + a1 * b4 + a2 * b7, a2 + a0 * b2 + a1 * b5 + a2 * b8,
        a3 + a3 * b0 + a4 * b3 + a5 * b6, a4 + a3 * b1 + a4 * b4 + a5 * b7, a5 + a3 * b2 + a4 * b5 + a5 * b8,
        a6 + a6 * b0 + a7 * b3 + a8 * b6, a7 + a6 * b1 + a7 * b4 + a8 * b7, a8 + a6 * b2 + a7 * b5 + a8 * b8,
    )  # fmt: skip


@at_point
def _plus(A, share, B):  # type: ignore[no-untyped-def]
    """A + share B, of matrices by their rows."""
    a0, a1, a2, a3, a4, a5, a6, a7, a8 = A
    b0, b1, b2, b3, b4, b5, b6, b7, b8 = B
    return (
        a0 + share * b0, a1 + share * b1, a2 + share * b2, a3 + share * b3, a4 + share * b4,
        a5 + share * b5, a6 + share * b6, a7 + share * b7, a8 + share * b8,
    )  # fmt: skip


@njit(nogil=True, cache=True)
def _carry(start, stop, points, rest, skin, window, plate, pivot, keeps, steps, u, F1):  # type: ignore[no-untyped-def]
    """Runge-Kutta 4 on x' = v(x) and, with it, on (F - I)' = grad v F.

    Numbers of one point are no arrays: these took two thirds of the time.
    """
    h = 1.0 / steps
    nodes, shares = (0.0, 0.5 * h, 0.5 * h, h), (h / 6.0, h / 3.0, h / 3.0, h / 6.0)
    q = np.zeros(max(rest[0].shape[0], skin[0].shape[0]))
    gradient = F1.shape[0] > 0
    for n in range(start, stop):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        u0, u1, u2, M = 0.0, 0.0, 0.0, _NO_GRADIENT  # F - I
        for _ in range(steps):
            d0, d1, d2, v0, v1, v2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            K, dM = _NO_GRADIENT, _NO_GRADIENT
            moving = False
            for stage in range(4):
                to, share = nodes[stage], shares[stage]
                (v0, v1, v2), L = _velocity(
                    x + u0 + to * v0, y + u1 + to * v1, z + u2 + to * v2, rest, skin, window, plate, pivot, keeps, q
                )
                d0, d1, d2 = d0 + share * v0, d1 + share * v1, d2 + share * v2
                moving = moving or v0 != 0.0 or v1 != 0.0 or v2 != 0.0
                if gradient:
                    K = _grown(L, _plus(M, to, K))
                    dM = _plus(dM, share, K)
            if not moving:
                break  # a point of a stationary flow that is at rest stays at rest
            u0, u1, u2 = u0 + d0, u1 + d1, u2 + d2
            M = _plus(M, 1.0, dM)
        u[n, 0], u[n, 1], u[n, 2] = u0, u1, u2
        if gradient:
            for i in range(3):
                for j in range(3):
                    F1[n, i, j] = M[3 * i + j]


@dataclass(frozen=True, slots=True, eq=False)
class Border:
    """A surface behind which tissue is constrained.

    Parameters
    ----------
    body : EllipsoidUnion
        Body with that surface.
    ramp : float
        Thickness of the layer over which the motion rises, in units of the body's radius; positive.
    order : {2, 3}
        The velocity's potential rises as 1 - exp(-t^order), t = 0 at the surface and 1 at the end of the ramp.
        With 3 the strain is zero at the surface; with 2 it is discontinuous: tissue is sheared right up to it.
    """

    body: EllipsoidUnion
    ramp: float
    order: Literal[2, 3] = 3

    def __post_init__(self) -> None:
        if not self.ramp > 0 or self.order not in {2, 3}:
            raise InputError(f"`ramp` must be above 0 and `order` 2 or 3; got {self.ramp} and {self.order}.")

    def _numbers(self) -> tuple[FloatArray, FloatArray]:
        """Per ellipsoid its centre and its form's xx, xy, xz, yy, yz, zz, (n, 9); then five numbers.

        Sharpness, ramp, order, the t at which the rise is complete, and how far Q may be below the least q.
        """
        body = self.body
        upper = body.forms[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        parts = np.ascontiguousarray(np.concatenate([body.centres_mm, upper], axis=1))
        end, below = _NOTHING ** (1.0 / self.order), np.log(len(parts)) / body.sharpness
        return parts, np.array([body.sharpness, self.ramp, float(self.order), end, below])


_NO_BORDER = (np.zeros((0, 9)), np.ones(5))


@dataclass(frozen=True, slots=True, eq=False)
class Flow:
    """A flow, by default isochoric, that carries tissue near a plate with it, around a constrained body.

    The velocity is v = curl(psi a), a(x) = c x (x - o) / 2, of which curl a = c:

        v = psi c + [c (grad psi . r) - r (grad psi . c)] / 2,   r = x - o,

    so that div v = 0 exactly, v = c where psi = 1 and v = 0 where psi = 0. A flow that changes volume has v = psi c and
    div v = c . grad psi: tissue is compressed in front of the moving part and expanded behind it. psi is the product of
    a rise from the constrained body (`Border`), another from the inner surface of a constrained skin, if there is one,
    and a Gaussian window around the sole, which ends the motion upward and forward. Points follow v for one unit of
    time by Runge-Kutta 4 with fixed steps; F follows dF/dt = (grad v) F by the same scheme, so that it is the
    derivative of the discrete map itself. No point crosses a border, so u and F are exact up to it on either side.

    Parameters
    ----------
    plate_mm : (3,)
        c, plate displacement, LPS mm.
    pivot_mm : (3,)
        o, centre of the plate contact, LPS mm.
    rest : Border
        Nothing moves inside its body.
    centre_mm, width_mm : (3,)
        Centre of the window and its standard deviation along each axis, LPS mm.
    skin : Border, optional
        Nothing moves outside its body.
    steps : int
        Runge-Kutta steps.
    keeps_volume : bool
        Whether the flow is isochoric.

    Raises
    ------
    InputError
        If a number is not finite, or the widths or the steps are not positive.
    """

    plate_mm: FloatArray
    pivot_mm: FloatArray
    rest: Border
    centre_mm: FloatArray
    width_mm: FloatArray
    skin: Border | None = None
    steps: int = 10
    keeps_volume: bool = True

    def __post_init__(self) -> None:
        for name in ("plate_mm", "pivot_mm", "centre_mm", "width_mm"):
            vector = frozen(getattr(self, name), np.float64)
            if vector.shape != (3,) or not np.isfinite(vector).all():
                raise InputError(f"The {name} of a flow needs three finite components; got {vector.tolist()}.")
            object.__setattr__(self, name, vector)
        if not (self.width_mm > 0).all():
            raise InputError(f"The width_mm of a flow must be positive; got {self.width_mm.tolist()}.")
        if self.steps < 1:
            raise InputError(f"A flow needs at least one step; got {self.steps}.")

    def _follow(self, points_mm: FloatArray, gradient: bool) -> tuple[FloatArray, FloatArray]:
        points = as_points(points_mm)
        window = np.array([self.centre_mm, self.width_mm**-2.0])
        skin = _NO_BORDER if self.skin is None else self.skin._numbers()
        u, H = np.zeros((len(points), 3)), np.zeros((len(points) if gradient else 0, 3, 3))
        in_parts(
            _carry, len(points), points, self.rest._numbers(), skin, window, self.plate_mm, self.pivot_mm,
            self.keeps_volume, self.steps, u, H,
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

    def inverse(self) -> Self:
        """Return the backward flow."""
        return replace(self, plate_mm=-self.plate_mm)
