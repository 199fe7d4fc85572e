"""Constitutive models of nearly incompressible, isotropic soft tissue: neo-Hooke, Yeoh, Ogden, Hencky.

Every model is W(F) = Wbar(F J^(-1/3)) + K / 2 (J - 1)^2 with J = det F. The bulk modulus is computed from the initial
shear modulus mu0 and Poisson's ratio, K = 2 mu0 (1 + nu) / (3 (1 - 2 nu)). Units: MPa; stretches have none.

Programs define the Ogden parameters differently, so there is a constructor for each convention: `Ogden.from_ansys`,
`Ogden.from_abaqus`, `Ogden.from_febio`. In ANSYS and Abaqus, for example, the same mu and alpha give initial shear
moduli that differ by the factor alpha / 2.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from dvc.arrays import BoolArray, FloatArray, frozen
from dvc.errors import InputError
from fe.hyperelastic import HENCKY, OGDEN, POLYNOMIAL, along, least_stiffness, stress_and_tangent

HIGHEST_NU = 0.49999
"""Largest Poisson's ratio. Above it, the bulk modulus is over 50,000 times the shear modulus, and a measurement cannot
distinguish the material from an incompressible one."""

MODES: Mapping[str, tuple[float, float, float]] = {
    "uniaxial": (1.0, -0.5, -0.5),
    "equibiaxial": (1.0, 1.0, -2.0),
    "pure shear": (1.0, 0.0, -1.0),
}
"""Logarithmic stretches of an incompressible test, relative to that of the loading axis."""

_SEARCHED = float(np.log(5.0))  # stretches of 1/5 to 5 are searched for a loss of stability


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """A hyperelastic constitutive model with its parameters; made by `NeoHooke`, `Yeoh`, `Ogden` and `Hencky`.

    Attributes
    ----------
    vector : (4 + 2 n,)
        As in `fe.hyperelastic`: C10, C20, C30, mu_H, then pairs mu_q (initial shear modulus), alpha_q; MPa.
    nu : float
        Poisson's ratio at small strain.

    Raises
    ------
    InputError
        If a number is not finite, nu is not in 0 <= nu <= 0.49999, the initial shear modulus is not positive, or an
        exponent is 0.
    """

    vector: FloatArray
    nu: float
    law: ClassVar[str] = "hyperelastic"
    named: ClassVar[Mapping[str, tuple[int, float]]] = {}  # parameters by name: position in the vector, and factor

    def __post_init__(self) -> None:
        vector = frozen(self.vector, np.float64)
        object.__setattr__(self, "vector", vector)
        if not (np.isfinite(vector).all() and np.isfinite(self.nu)):
            raise InputError(f"{self.description}: all parameters must be finite.")
        if not 0.0 <= self.nu <= HIGHEST_NU:
            raise InputError(
                f"{self.description}: Poisson's ratio must be between 0 and {HIGHEST_NU}; got {self.nu:g}. For "
                "incompressible tissue use 0.4999."
            )
        if not self.shear_modulus_mpa > 0.0:
            raise InputError(
                f"{self.description}: the initial shear modulus must be positive; it is {_kpa(self.shear_modulus_mpa)}."
            )

        if not (np.abs(vector[OGDEN + 1 :: 2]) > 1e-6).all():
            raise InputError("Ogden: an exponent of 0 is not allowed; its limit is the Hencky model.")

    @property
    def moduli_mpa(self) -> dict[str, float]:
        """Parameters by name, MPa; those of Ogden terms are only in `vector`."""
        return {name: factor * float(self.vector[place]) for name, (place, factor) in self.named.items()}

    @property
    def description(self) -> str:
        """Model and parameters, as text."""
        terms = self.vector[OGDEN:].reshape(-1, 2)
        numbers = [f"{name} {_kpa(value)}" for name, value in self.moduli_mpa.items()]
        numbers += ["; ".join(f"mu0 {_kpa(mu)}, alpha {alpha:g}" for mu, alpha in terms)] if len(terms) else []
        return ", ".join([self.law, *numbers, f"nu {self.nu:g}"])

    @property
    def shear_modulus_mpa(self) -> float:
        """Initial shear modulus mu0 = 2 C10 + mu_H + sum mu_q, MPa."""
        return float(2.0 * self.vector[POLYNOMIAL] + self.vector[HENCKY] + self.vector[OGDEN::2].sum())

    @property
    def bulk_modulus_mpa(self) -> float:
        """K = 2 mu0 (1 + nu) / (3 (1 - 2 nu)), MPa."""
        return 2.0 * self.shear_modulus_mpa * (1.0 + self.nu) / (3.0 * (1.0 - 2.0 * self.nu))

    def energy(self, F: npt.ArrayLike) -> FloatArray:
        """W (n,) MPa (N mm / mm3 of the reference configuration) for F (n, 3, 3); NaN where det F <= 0."""
        return self._response(F)[0]

    def stress(self, F: npt.ArrayLike) -> FloatArray:
        """First Piola-Kirchhoff stress P = dW/dF (n, 3, 3), MPa, for F (n, 3, 3); NaN where det F <= 0."""
        return self._response(F)[1]

    def tangent(self, F: npt.ArrayLike) -> FloatArray:
        """A[i, j, k, l] = dP_ij / dF_kl (n, 3, 3, 3, 3), MPa, for F (n, 3, 3); NaN where det F <= 0."""
        return self._response(F)[2]

    def _response(self, F: npt.ArrayLike) -> tuple[FloatArray, FloatArray, FloatArray]:
        gradients = np.ascontiguousarray(F, dtype=np.float64)
        if gradients.ndim != 3 or gradients.shape[1:] != (3, 3):
            raise InputError(f"Deformation gradients must have shape (n, 3, 3); got {gradients.shape}.")
        n = len(gradients)
        response = np.empty(n), np.empty((n, 3, 3)), np.empty((n, 3, 3, 3, 3))
        stress_and_tangent(self.vector, self.bulk_modulus_mpa, gradients, *response)
        return response

    def nominal_stress(self, stretch: npt.ArrayLike, mode: str = "uniaxial") -> FloatArray:
        """Force over undeformed area (n,), MPa, of the incompressible solid at stretches (n,) of a test in `MODES`.

        For an equibiaxial test, it is the stress of one of the two axes. The true (Cauchy) stress is the stretch times
        the nominal stress.

        Examples
        --------
        >>> NeoHooke.of(mu_mpa=1.0).nominal_stress([2.0]).tolist()  # mu (stretch - 1 / stretch^2)
        [1.75]
        """
        return nominal_stress(self.vector, np.asarray(stretch, dtype=np.float64), mode)

    def is_stable(self, F: npt.ArrayLike) -> BoolArray:
        """Whether Drucker's condition holds at F (n, 3, 3): d tau : d(ln V) > 0 for every small isochoric change.

        tau is the Kirchhoff stress; False where det F <= 0.
        """
        gradients = np.asarray(F, dtype=np.float64)
        folded = np.linalg.det(gradients) <= 0.0
        strains = np.log(np.where(folded[:, None], 1.0, np.linalg.svd(gradients, compute_uv=False)))
        return np.asarray(~folded & (least_stiffness(self.vector, strains) > 0.0))

    def stable_range(self, mode: str) -> tuple[float, float]:
        """Smallest and largest stretch of a test, within 1/5 to 5, between which the model is stable (Drucker).

        Examples
        --------
        >>> NeoHooke.of(mu_mpa=0.1).stable_range("uniaxial")
        (0.2, 5.0)
        """
        axes, ends = _axes(mode), []
        for sign in (-1.0, 1.0):
            strains = sign * np.linspace(0.0, _SEARCHED, 2001)
            lost = np.flatnonzero(~(least_stiffness(self.vector, strains[:, None] * axes) > 0.0))
            ends.append(float(np.exp(strains[-1] if not len(lost) else strains[max(lost[0] - 1, 0)])))
        return round(ends[0], 6), round(ends[1], 6)


Materials = Mapping[str, Material]
"""Materials by region."""


def nominal_stress(vector: FloatArray, stretch: FloatArray, mode: str) -> FloatArray:
    """As `Material.nominal_stress`, from a parameter vector."""
    axes = _axes(mode)
    if not (stretch > 0.0).all():
        raise InputError("Stretches must be positive.")
    loaded = np.count_nonzero(axes == 1.0)  # axes that carry the load
    return np.asarray(along(vector, np.log(stretch).ravel(), axes) / (loaded * stretch.ravel())).reshape(stretch.shape)


def _axes(mode: str) -> FloatArray:
    if mode not in MODES:
        raise InputError(f"Unknown test '{mode}'; available are {', '.join(MODES)}.")
    return np.array(MODES[mode])


def _kpa(value_mpa: float) -> str:
    return f"{1000.0 * value_mpa:.4g} kPa"


def _terms(mu_mpa: npt.ArrayLike, alpha: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    moduli, exponents = frozen(np.atleast_1d(mu_mpa), np.float64), frozen(np.atleast_1d(alpha), np.float64)
    if moduli.shape != exponents.shape or moduli.ndim != 1 or not len(moduli):
        raise InputError(f"Ogden: {moduli.size} moduli and {exponents.size} exponents; their numbers must be equal.")
    return moduli, exponents


@dataclass(frozen=True, slots=True, eq=False)
class NeoHooke(Material):
    """Wbar = mu / 2 (I1bar - 3), mu the initial shear modulus, I1bar the first invariant of the isochoric F^T F."""

    law: ClassVar[str] = "neo-Hooke"
    named: ClassVar[Mapping[str, tuple[int, float]]] = {"mu": (POLYNOMIAL, 2.0)}

    @classmethod
    def of(cls, mu_mpa: float, nu: float = 0.4999) -> Self:
        """From the initial shear modulus, MPa."""
        return cls(np.array([0.5 * mu_mpa, 0.0, 0.0, 0.0]), nu)


@dataclass(frozen=True, slots=True, eq=False)
class Yeoh(Material):
    """Wbar = C10 (I1bar - 3) + C20 (I1bar - 3)^2 + C30 (I1bar - 3)^3; without C30 also called the Isihara model.

    C10 is half the initial shear modulus, I1bar the first invariant of the isochoric F^T F.
    """

    law: ClassVar[str] = "Yeoh"
    named: ClassVar[Mapping[str, tuple[int, float]]] = {"C10": (0, 1.0), "C20": (1, 1.0), "C30": (2, 1.0)}

    @classmethod
    def of(cls, c10_mpa: float, c20_mpa: float, c30_mpa: float = 0.0, nu: float = 0.4999) -> Self:
        """From the coefficients of the polynomial, MPa."""
        return cls(np.array([c10_mpa, c20_mpa, c30_mpa, 0.0]), nu)


@dataclass(frozen=True, slots=True, eq=False)
class Hencky(Material):
    """Wbar = mu sum_i ebar_i^2: linear elastic in logarithmic strain.

    It extends linear elasticity to large deformation. The Saint Venant-Kirchhoff model, which is linear in the
    Green-Lagrange strain, collapses in compression.
    """

    law: ClassVar[str] = "linear elastic (Hencky)"
    named: ClassVar[Mapping[str, tuple[int, float]]] = {"mu": (HENCKY, 1.0)}

    @classmethod
    def of(cls, mu_mpa: float, nu: float = 0.4999) -> Self:
        """From the shear modulus, MPa: Young's modulus is 2 mu (1 + nu)."""
        return cls(np.array([0.0, 0.0, 0.0, mu_mpa]), nu)


@dataclass(frozen=True, slots=True, eq=False)
class Ogden(Material):
    """Wbar = sum_q 2 mu_q / alpha_q^2 (l_1^alpha_q + l_2^alpha_q + l_3^alpha_q - 3), l the isochoric stretches.

    mu_q is the contribution of the term to the initial shear modulus. Programs define their parameters differently: use
    the constructor of the program from which your parameters come.

    Examples
    --------
    The same two numbers in three programs:

    >>> fat = {"mu_mpa": 0.0034, "alpha": 6.2}
    >>> [round(1000 * law(**fat).shear_modulus_mpa, 2) for law in (Ogden.from_ansys, Ogden.from_abaqus)]
    [10.54, 3.4]
    >>> round(1000 * Ogden.from_febio(c_mpa=0.0034, m=6.2).shear_modulus_mpa, 2)
    1.7
    """

    law: ClassVar[str] = "Ogden"

    @classmethod
    def of(cls, shear_modulus_mpa: npt.ArrayLike, alpha: npt.ArrayLike, nu: float = 0.4999) -> Self:
        """From each term's initial shear modulus (MPa) and exponent.

        Raises
        ------
        InputError
            If there is not one exponent, other than 0, for each modulus.
        """
        pairs = np.column_stack(_terms(shear_modulus_mpa, alpha))
        return cls(np.concatenate([np.zeros(OGDEN), pairs.ravel()]), nu)

    @classmethod
    def from_ansys(cls, mu_mpa: npt.ArrayLike, alpha: npt.ArrayLike, nu: float = 0.4999) -> Self:
        """W = sum mu / alpha (sum l^alpha - 3), so mu0 = mu alpha / 2."""
        numbers, exponents = _terms(mu_mpa, alpha)
        return cls.of(0.5 * numbers * exponents, exponents, nu)

    @classmethod
    def from_abaqus(cls, mu_mpa: npt.ArrayLike, alpha: npt.ArrayLike, nu: float = 0.4999) -> Self:
        """W = sum 2 mu / alpha^2 (sum l^alpha - 3), so mu0 = mu; also the convention of CalculiX."""
        return cls.of(mu_mpa, alpha, nu)

    @classmethod
    def from_febio(cls, c_mpa: npt.ArrayLike, m: npt.ArrayLike, nu: float = 0.4999) -> Self:
        """W = sum c / m^2 (sum l^m - 3), so mu0 = c / 2."""
        return cls.of(0.5 * np.asarray(c_mpa), m, nu)


def from_vector(description: str, vector_mpa: FloatArray, bulk_modulus_mpa: float) -> Material:
    """A material from its description and parameters; Poisson's ratio, to ten digits, from the bulk modulus."""
    (made,) = (one for one in (NeoHooke, Yeoh, Hencky, Ogden) if description.startswith(f"{one.law},"))
    mu, K = Material(vector_mpa, 0.0).shear_modulus_mpa, bulk_modulus_mpa
    return made(vector_mpa, round((3.0 * K - 2.0 * mu) / (6.0 * K + 2.0 * mu), 10))
