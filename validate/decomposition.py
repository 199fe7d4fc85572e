"""Image decomposition in 3D (CWA 16799:2014): fields on the cells of one tissue as a few orthonormal coefficients.

The functions are polynomials of rising total degree, made orthonormal on the cells of the tissue, weighted by volume
(as the adaptive geometric moment descriptors of Christian and others 2021 are on the points of a surface). The
degree rises until the residual of the measured field's reconstruction is accepted.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from math import comb
from typing import Self

import numpy as np
from numpy.polynomial.legendre import legvander

from dvc.arrays import FloatArray
from validate.extrapolation import LEVELLED
from validate.location import CellGraph

MOST_DEGREE = 10
"""Largest total degree of the polynomials: 286 functions."""

_CELLS_EACH = 10  # cells of the tissue for each function at least, so that functions do not follow single cells
_DEPENDENT = 1e-5  # of its length, below which a polynomial is one of the earlier ones on these cells
_APART, _LEAST = 3.0, 0.003  # times the residual, and fraction of the volume, from which on cells are a cluster
_EXACT = 1e-9  # of the field, below which a residual is rounding
_COVERED = 2.0  # coverage factor of an expanded uncertainty


@dataclass(frozen=True, slots=True, eq=False)
class TissueBasis:
    """Functions on the cells of a tissue, orthonormal by volume: sum over cells of w f_i f_j is 1 for i = j, else 0.

    A coefficient has the unit of the field, the first is its mean, and the squares of all add up to its mean square. No
    error of a field changes a coefficient by more than the root mean square of the error (Cauchy and Schwarz).

    Attributes
    ----------
    scaled : (n, k)
        The functions in the cells (n,), times the square root of w.
    weights : (n,)
        w, volume of each cell over that of all.
    degree : int
        Largest total degree of the polynomials.
    """

    scaled: FloatArray
    weights: FloatArray
    degree: int

    @classmethod
    def of(cls, points_mm: FloatArray, volumes_ml: FloatArray, degree: int) -> Self:
        """All functions up to a total degree, on cells with centroids (n, 3), mm, and volumes (n,)."""
        *_, last = islice(cls.rising(points_mm, volumes_ml), degree + 1)
        return last

    @classmethod
    def rising(cls, points_mm: FloatArray, volumes_ml: FloatArray) -> Iterator[Self]:
        """Bases of total degree 0, 1, 2 ..., each the one before with more functions.

        They end at `MOST_DEGREE`, or where a further one would have more than a function for ten cells. All polynomials
        of a total degree are in them, so what they can show does not depend on the axes.
        """
        weights = volumes_ml / volumes_ml.sum()
        low, high = points_mm.min(axis=0), points_mm.max(axis=0)
        inside = 2.0 * (points_mm - low) / np.maximum(high - low, 1e-12) - 1.0
        along, root = [legvander(x, MOST_DEGREE) for x in inside.T], np.sqrt(weights)
        room = np.empty((len(points_mm), comb(MOST_DEGREE + 3, 3)), order="F")  # one place for all bases
        made = room[:, :0]
        for degree in range(MOST_DEGREE + 1):
            orders = [(i, j, degree - i - j) for i in range(degree + 1) for j in range(degree + 1 - i)]
            products = [along[0][:, i] * along[1][:, j] * along[2][:, k] * root for i, j, k in orders]
            further = np.stack([one / np.linalg.norm(one) for one in products], axis=1)
            for _ in range(2):  # the second time for what rounding left
                further = _orthonormal(further - made @ (made.T @ further))
            if degree and _CELLS_EACH * (made.shape[1] + further.shape[1]) > len(points_mm):
                return
            known, made = made.shape[1], room[:, : made.shape[1] + further.shape[1]]
            made[:, known:] = further
            yield cls(made, weights, degree)

    @property
    def functions(self) -> FloatArray:
        """The functions in the cells, (n, k)."""
        return np.asarray(self.scaled / np.sqrt(self.weights)[:, None])

    def coefficients(self, values: FloatArray) -> FloatArray:
        """Coefficients (k,) of a field (n,), or (m, k) of fields (m, n)."""
        return np.asarray((np.sqrt(self.weights) * values) @ self.scaled)

    def field(self, coefficients: FloatArray) -> FloatArray:
        """Field (n,) of coefficients (k,)."""
        return np.asarray(self.scaled @ coefficients / np.sqrt(self.weights))


def _orthonormal(columns: FloatArray) -> FloatArray:
    """Columns (n, m) made orthonormal one after the other (Gram and Schmidt), without those the earlier ones can show.

    Each keeps its direction as far as it can. Eigenvectors of the products of columns would not: those of columns that
    are nearly orthonormal lie anywhere, as rounding has it, and all coefficients with them.
    """
    products = columns.T @ columns
    made = np.zeros((len(products), 0))  # in terms of the columns
    for column in np.eye(len(products)):
        further = column
        for _ in range(2):  # the second time for what rounding left
            further = further - made @ (made.T @ (products @ further))
        square = float(further @ products @ further)
        if square > _DEPENDENT**2:
            made = np.column_stack([made, further / np.sqrt(square)])
    return np.asarray(columns @ made)


@dataclass(frozen=True, slots=True, eq=False)
class Reconstruction:
    """A field (n,) as coefficients (k,) of a basis, and what they leave.

    Attributes
    ----------
    residual : float
        Volume-weighted root mean square of field minus reconstruction, u_rec.
    clusters : int
        Groups of connected cells with at least 0.3 % of the tissue's volume whose residual exceeds 3 u_rec.
    """

    coefficients: FloatArray
    residual: float
    clusters: int

    @classmethod
    def of(cls, values: FloatArray, basis: TissueBasis, cells: CellGraph) -> "Reconstruction":
        """Decompose a field (n,) and put it together again; ``cells`` are those of the basis."""
        coefficients = basis.coefficients(values)
        rest = values - basis.field(coefficients)
        residual = float(np.sqrt(basis.weights @ rest**2))
        if residual <= _EXACT * float(np.sqrt(basis.weights @ values**2)):
            return cls(coefficients, residual, 0)
        far, least_ml = np.abs(rest) > _APART * residual, _LEAST * float(cells.volumes_ml.sum())
        return cls(coefficients, residual, len(cells.clusters(far, np.abs(rest), least_ml)))

    def accepted(self, uncertainty: float) -> bool:
        """Whether the residual is within the measurement's uncertainty, and nowhere in clusters, as the guide asks."""
        return self.residual <= uncertainty and self.clusters == 0


@dataclass(frozen=True, slots=True, eq=False)
class Decomposition:
    """Measured and simulated field of one tissue in coefficients of one basis, which the measured field decides.

    Attributes
    ----------
    degree : int
        Total degree of the polynomials: the least at which the measured field is accepted, or the largest.
    measured : Reconstruction
        Of the measured field.
    models : mapping of name to Reconstruction
        Of the simulated fields.
    u_cal : float
        Standard uncertainty of the measured field, root mean square over the tissue.
    estimate, spread : (k,)
        Mean of the coefficients of the true fields drawn, which removes the bias of the measurement, and their standard
        uncertainty: the measurement uncertainty, propagated to each coefficient.
    """

    degree: int
    measured: Reconstruction
    models: Mapping[str, Reconstruction]
    u_cal: float
    estimate: FloatArray
    spread: FloatArray

    @property
    def accepted(self) -> bool:
        """Whether the measured field is reconstructed as the guide asks; see `Reconstruction.accepted`."""
        return self.measured.accepted(self.u_cal)

    @property
    def guide_band(self) -> float:
        """Half the width of the guide's band about the line of equal coefficients, 2 (u_cal^2 + u_rec^2)^(1/2)."""
        return _COVERED * float(np.hypot(self.u_cal, self.measured.residual))

    @property
    def band(self) -> FloatArray:
        """Expanded uncertainty (k,) of each coefficient, twice the ``spread``."""
        return _COVERED * self.spread


def decompose(
    measured: FloatArray, models: Mapping[str, FloatArray], cells: CellGraph, u_cal: float, truths: FloatArray,
    widening: float = 1.0,
) -> Decomposition:  # fmt: skip
    """Decompose fields (n,) on the cells of one tissue, by the least degree at which the measured one is accepted.

    Parameters
    ----------
    measured : (n,)
        Measured field, such as the maximum shear strain.
    models : mapping of name to (n,)
        Simulated fields in the same cells.
    cells : CellGraph
        The cells of the tissue, LPS mm, reference configuration.
    u_cal : float
        Standard uncertainty of the measured field, root mean square over the tissue, in its unit.
    truths : (m, n)
        True fields drawn from the measurement's error model; see `dvc.trust.truth_draws.TruthDraws`.
    widening : float
        Factor on intervals of draws; see `dvc.trust.error_model.ErrorTable`.

    References
    ----------
    CWA 16799:2014, Validation of computational solid mechanics models.
    Christian and others, R Soc Open Sci 2021 (adaptive geometric moment descriptors: the functions).
    """
    for basis in TissueBasis.rising(cells.points_mm, cells.volumes_ml):
        found = Reconstruction.of(measured, basis, cells)
        if found.accepted(u_cal):
            break
    of_models = {name: Reconstruction.of(values, basis, cells) for name, values in models.items()}
    drawn = basis.coefficients(truths)
    spread = widening * drawn.std(axis=0, ddof=1)
    return Decomposition(basis.degree, found, of_models, u_cal, drawn.mean(axis=0), spread)


def probability_of_representation(
    measured: FloatArray, simulated: FloatArray, expanded: FloatArray | float
) -> float:  # fmt: skip
    """Probability that predictions represent the measurement within its uncertainty, 0 to 1.

    The sum of the coefficients' errors (k,) that are within the ``expanded`` uncertainty, (k,) or one for all, over the
    sum of all errors: each error is weighted by its size. 1 if no error exceeds its uncertainty.

    References
    ----------
    Dvurecenska, Graham, Patelli and Patterson, R Soc Open Sci 2018, doi:10.1098/rsos.180687.

    Examples
    --------
    >>> round(probability_of_representation(np.array([3.0, 1.0, 0.0]), np.array([3.1, 1.3, 0.1]), 0.2), 9)
    0.4
    """
    error = np.abs(simulated - measured)
    total = float(error.sum())
    return float(error[error <= expanded].sum() / total) if total > 0.0 else 1.0


@dataclass(frozen=True, slots=True)
class Representation:
    """How well a model represents the measured maximum shear strain of one tissue; a row of decomposition.csv.

    Attributes
    ----------
    coefficients, degree : int
        Functions of the basis, and the total degree of their polynomials.
    u_cal, u_rec, clusters : float, float, int
        Standard uncertainty of the measurement, strain; residual of its reconstruction, and clusters of it; see
        `Reconstruction`.
    model_u_rec, model_clusters : float, int
        Residual and clusters of the model's field.
    in_band, probability : int, float
        Coefficients of the model within the expanded uncertainty of each measured one, bias removed, and
        `probability_of_representation` (0 to 1) with it.
    in_guide_band, guide_probability : int, float
        The same with the one uncertainty that the guide gives to all coefficients, 2 (u_cal^2 + u_rec^2)^(1/2), as
        measured.
    """

    model: str
    load: str
    tissue: str
    coefficients: int
    degree: int
    u_cal: float
    u_rec: float
    clusters: int
    model_u_rec: float
    model_clusters: int
    in_band: int
    probability: float
    in_guide_band: int
    guide_probability: float

    @property
    def accepted(self) -> bool:
        """Whether the measured field is reconstructed as the guide asks: u_rec within u_cal, and no cluster."""
        return self.u_rec <= self.u_cal and self.clusters == 0


def representation(of: tuple[str, str, str], by: Decomposition) -> Representation:
    """The row ``of`` a model, load and tissue; no bias is removed for a levelled model, which has it too."""
    measured, model = by.measured, by.models[of[0]].coefficients
    centre = measured.coefficients if of[0].endswith(LEVELLED) else by.estimate
    guide = measured.coefficients, np.full(len(model), by.guide_band)
    (inside, probability), (in_guide, by_guide) = (
        (int(np.count_nonzero(np.abs(model - at) <= band)), probability_of_representation(at, model, band))
        for at, band in ((centre, by.band), guide)
    )
    return Representation(
        *of, len(model), by.degree, by.u_cal, measured.residual, measured.clusters, by.models[of[0]].residual,
        by.models[of[0]].clusters, inside, probability, in_guide, by_guide,
    )  # fmt: skip
