"""Response of an isotropic hyperelastic solid at a point, in the principal frame (numba kernels).

With F = U diag(s) V^T, logarithmic stretches e_i = ln s_i and their isochoric part ebar_i = e_i - sum(e) / 3,

    W(F, p) = Wbar(ebar) + p (J - 1),
    Wbar = sum_k C_k0 (I1bar - 3)^k + mu_H sum_i ebar_i^2 + sum_q 2 mu_q / alpha_q^2 (sum_i exp(alpha_q ebar_i) - 3),

I1bar = sum_i exp(2 ebar_i): Yeoh's polynomial, Hencky's quadratic form and Ogden's terms. The sum contains every
constitutive model, so one kernel serves all. A model is a vector (C10, C20, C30, mu_H, mu_1, alpha_1, mu_2, alpha_2,
...), MPa except the alphas, where mu_q is the initial shear modulus of the term. p is the pressure-like Lagrange
multiplier of the volume, MPa, positive in tension.

The first Piola-Kirchhoff stress of an isotropic solid is P = U diag(dW/ds) V^T. In the principal frame, its derivative
has only the components (R. W. Ogden, Non-Linear Elastic Deformations, 1984, section 6.1.4)

    A_iijj = d2W / ds_i ds_j,
    A_ijij + A_ijji = (W_i - W_j) / (s_i - s_j),   A_ijij - A_ijji = (W_i + W_j) / (s_i + s_j),   i != j.
"""

import numpy as np

from dvc.arrays import FloatArray
from dvc.compiled import njit

POLYNOMIAL, HENCKY, OGDEN = 0, 3, 4
"""Positions of C10, of mu_H, and of the first Ogden pair in the parameter vector of a constitutive model."""

_EQUAL = 1e-5  # relative difference of principal stretches below which the limit of the quotient is used (error 1e-10)
_SWEEPS = 30


@njit(cache=True, error_model="numpy")
def isochoric(law: FloatArray, e: FloatArray, slope: FloatArray, curvature: FloatArray) -> float:
    """Wbar (MPa) at logarithmic stretches ``e`` (3,); its derivatives go to ``slope`` (3,), ``curvature`` (3, 3)."""
    mean = (e[0] + e[1] + e[2]) / 3.0
    energy = 0.0
    slope[:] = 0.0
    curvature[:, :] = 0.0
    if law[0] != 0.0 or law[1] != 0.0 or law[2] != 0.0:
        for i in range(3):
            slope[i] = np.expm1(2.0 * (e[i] - mean))
        invariant = slope[0] + slope[1] + slope[2]  # I1bar - 3, without cancellation
        first = law[0] + 2.0 * law[1] * invariant + 3.0 * law[2] * invariant**2
        second = 2.0 * law[1] + 6.0 * law[2] * invariant
        energy += invariant * (law[0] + invariant * (law[1] + invariant * law[2]))
        for i in range(3):
            for j in range(3):
                curvature[i, j] = 4.0 * second * (slope[i] + 1.0) * (slope[j] + 1.0)
        for i in range(3):
            square = slope[i] + 1.0
            slope[i] = 2.0 * first * square
            curvature[i, i] += 4.0 * first * square
    for i in range(3):
        bar = e[i] - mean
        slope[i] += 2.0 * law[3] * bar
        curvature[i, i] += 2.0 * law[3]
        energy += law[3] * bar * bar
        for q in range(4, len(law), 2):
            mu, alpha = law[q], law[q + 1]
            if mu != 0.0:
                rise = np.expm1(alpha * bar)
                energy += 2.0 * mu / alpha**2 * rise
                slope[i] += 2.0 * mu / alpha * (rise + 1.0)
                curvature[i, i] += 2.0 * mu * (rise + 1.0)
    # ebar is e minus its mean: both derivatives are projected onto traceless tensors.
    trace = (slope[0] + slope[1] + slope[2]) / 3.0
    rows = curvature.sum(axis=1) / 3.0
    whole = rows.sum() / 3.0
    for i in range(3):
        slope[i] -= trace
    for i in range(3):
        for j in range(i, 3):
            value = curvature[i, j] - rows[i] - rows[j] + whole
            curvature[i, j] = value
            curvature[j, i] = value
    return float(energy)


@njit(cache=True, error_model="numpy")
def along(law: FloatArray, strains: FloatArray, axes: FloatArray) -> FloatArray:
    """dWbar/dt (n,) MPa at e = t ``axes`` for each t of ``strains`` (n,)."""
    slope, curvature = np.empty(3), np.empty((3, 3))
    stress = np.empty(len(strains))
    for n in range(len(strains)):
        isochoric(law, strains[n] * axes, slope, curvature)
        stress[n] = slope[0] * axes[0] + slope[1] * axes[1] + slope[2] * axes[2]
    return stress


@njit(cache=True, error_model="numpy")
def least_stiffness(law: FloatArray, strains: FloatArray) -> FloatArray:
    """Smallest eigenvalue (n,) MPa of d2Wbar/de2 at e (n, 3), for isochoric changes: Drucker's condition."""
    slope, c = np.empty(3), np.empty((3, 3))
    stiffness = np.empty(len(strains))
    for n in range(len(strains)):
        isochoric(law, strains[n], slope, c)
        # Basis (1, -1, 0) / sqrt 2, (1, 1, -2) / sqrt 6; the rows of c sum to 0.
        a = 0.5 * (c[0, 0] + c[1, 1]) - c[0, 1]
        b = 1.5 * c[2, 2]
        mixed = np.sqrt(3.0) / 2.0 * (c[0, 0] - c[1, 1])
        stiffness[n] = 0.5 * (a + b) - np.sqrt(0.25 * (a - b) ** 2 + mixed**2)
    return stiffness


@njit(inline="always", error_model="numpy")
def _product(F: FloatArray, i: int, j: int) -> float:
    return F[0, i] * F[0, j] + F[1, i] * F[1, j] + F[2, i] * F[2, j]  # type: ignore[no-any-return]


@njit(inline="always", error_model="numpy")
def _turned(V: FloatArray, p: int, q: int, at_p: float, at_q: float, off: float) -> tuple[float, float, float]:
    """Rotate columns p and q of V by the angle that eliminates the entry ``off``; its tangent, cosine and sine."""
    apart = at_q - at_p
    root = np.sqrt(apart * apart + 4.0 * off * off)
    tangent = 2.0 * off / (apart + root if apart >= 0.0 else apart - root) if root > 0.0 else 0.0
    cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for k in range(3):
        left, right = V[k, p], V[k, q]
        V[k, p], V[k, q] = cosine * left - sine * right, sine * left + cosine * right
    return tangent, cosine, sine


@njit(cache=True, error_model="numpy")
def singular_values(F: FloatArray, U: FloatArray, s: FloatArray, V: FloatArray) -> float:
    """Write U, s and V of F = U diag(s) V^T (3, 3) unless det F <= 0, by Jacobi rotations of F^T F; return det F."""
    J = (
        F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
        - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
        + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0])
    )
    if not J > 0.0:
        return float(J)
    a, b, c = _product(F, 0, 0), _product(F, 1, 1), _product(F, 2, 2)  # C = F^T F, its diagonal
    d, e, f = _product(F, 0, 1), _product(F, 0, 2), _product(F, 1, 2)  # and its entries 01, 02 and 12
    for i in range(3):
        for j in range(3):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        if d * d + e * e + f * f <= 1e-34 * (a * a + b * b + c * c):
            break
        tangent, cosine, sine = _turned(V, 0, 1, a, b, d)
        a, b, d, e, f = a - tangent * d, b + tangent * d, 0.0, cosine * e - sine * f, sine * e + cosine * f
        tangent, cosine, sine = _turned(V, 0, 2, a, c, e)
        a, c, e, d, f = a - tangent * e, c + tangent * e, 0.0, cosine * d - sine * f, sine * d + cosine * f
        tangent, cosine, sine = _turned(V, 1, 2, b, c, f)
        b, c, f, d, e = b - tangent * f, c + tangent * f, 0.0, cosine * d - sine * e, sine * d + cosine * e
    s[0], s[1], s[2] = np.sqrt(a), np.sqrt(b), np.sqrt(c)
    for i in range(3):
        scale = 1.0 / s[i]
        for k in range(3):
            U[k, i] = (F[k, 0] * V[0, i] + F[k, 1] * V[1, i] + F[k, 2] * V[2, i]) * scale
    return float(J)


@njit(cache=True, error_model="numpy")
def principal_response(
    law: FloatArray, s: FloatArray, J: float, p: float, bulk: float,
    stress: FloatArray, direct: FloatArray, swapped: FloatArray,
) -> float:  # fmt: skip
    """W(F, p) in MPa at principal stretches ``s`` (3,), with its stress and tangent in the principal frame.

    ``bulk`` is dp/dJ (MPa), 0 if pressure is a separate field. The results are written into ``stress`` (3,) = W_i;
    ``direct`` (3, 3) = A_ijij, with A_iiii on its diagonal; and ``swapped`` (3, 3, 2) = A_iijj first and A_ijji second,
    i != j.
    """
    e, slope, curvature = np.empty(3), np.empty(3), np.empty((3, 3))
    for i in range(3):
        e[i] = np.log(s[i])
    energy = isochoric(law, e, slope, curvature) + p * (J - 1.0)
    for i in range(3):
        stress[i] = (slope[i] + p * J) / s[i]
        direct[i, i] = (curvature[i, i] - slope[i] + bulk * J * J) / s[i] ** 2
    for i in range(3):
        for j in range(i + 1, 3):
            mixed = (curvature[i, j] + p * J + bulk * J * J) / (s[i] * s[j])
            if abs(s[i] - s[j]) > _EQUAL * (s[i] + s[j]):
                together = (stress[i] - stress[j]) / (s[i] - s[j])
            else:
                together = 0.5 * (direct[i, i] + direct[j, j]) - mixed
            apart = (stress[i] + stress[j]) / (s[i] + s[j])
            direct[i, j] = 0.5 * (together + apart)
            direct[j, i] = direct[i, j]
            swapped[i, j, 0] = mixed
            swapped[j, i, 0] = mixed
            swapped[i, j, 1] = 0.5 * (together - apart)
            swapped[j, i, 1] = swapped[i, j, 1]
    return float(energy)


@njit(cache=True, error_model="numpy")
def stress_and_tangent(
    law: FloatArray, bulk: float, gradients: FloatArray, energy: FloatArray, stress: FloatArray, tangent: FloatArray
) -> None:
    """As `fe.materials.Material`, MPa; the volumetric part is bulk / 2 (J - 1)^2, and all is NaN where det F <= 0."""
    U, V, s = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    principal, direct, swapped = np.empty(3), np.empty((3, 3)), np.zeros((3, 3, 2))
    for n in range(len(gradients)):
        J = singular_values(gradients[n], U, s, V)
        if not J > 0.0:
            energy[n], stress[n], tangent[n] = np.nan, np.nan, np.nan
            continue
        p = bulk * (J - 1.0)
        energy[n] = principal_response(law, s, J, p, bulk, principal, direct, swapped) - 0.5 * p * (J - 1.0)
        stress[n] = 0.0
        tangent[n] = 0.0
        for i in range(3):
            for k in range(3):
                for m in range(3):
                    stress[n, k, m] += principal[i] * U[k, i] * V[m, i]
        for k in range(3):
            for m in range(3):
                for q in range(3):
                    for r in range(3):
                        value = 0.0
                        for i in range(3):
                            for j in range(3):
                                value += direct[i, j] * U[k, i] * V[m, j] * U[q, i] * V[r, j]
                                if i != j:
                                    value += swapped[i, j, 0] * U[k, i] * V[m, i] * U[q, j] * V[r, j]
                                    value += swapped[i, j, 1] * U[k, i] * V[m, j] * U[q, j] * V[r, i]
                        tangent[n, k, m, q, r] = value
