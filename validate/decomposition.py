"""Image decomposition in 3D (CWA 16799:2014): fields on the cells of one tissue as a few orthonormal coefficients.

The functions are polynomials of rising total degree, made orthonormal on the cells of the tissue, weighted by volume
(as the adaptive geometric moment descriptors of Christian and others 2021 are on the points of a surface). So many are
taken as the measured field needs: until the residual of its reconstruction is accepted.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.legendre import legvander
from scipy.linalg import qr

from dvc.arrays import FloatArray
from validate.location import CellGraph

MOST_DEGREE = 8
"""Largest total degree of the polynomials: 165 functions."""

_CELLS_EACH = 10  # cells of the tissue for each function at least, so that functions do not follow single cells
_DEPENDENT = 1e-6  # of its length, below which a polynomial is one of the earlier ones on these cells
_APART, _LEAST = 3.0, 0.003  # times the residual, and fraction of the volume, from which on cells are a cluster
_EXACT = 1e-9  # of the field, below which a residual is rounding
_COVERED = 2.0  # coverage factor of an expanded uncertainty


@dataclass(frozen=True, slots=True, eq=False)
class TissueBasis:
    """Functions on the cells of a tissue, orthonormal by volume: sum over cells of v f_i f_j / sum of v is 1 or 0.

    A coefficient has the unit of the field, the first is its mean, and the squares of all add up to its mean square. No
    error of a field changes a coefficient by more than the root mean square of the error (Cauchy and Schwarz).

    Attributes
    ----------
    functions : (n, k)
        In the cells (n,).
    weights : (n,)
        Volume of each cell over that of all.
    degree : int
        Largest total degree of the polynomials.
    """

    functions: FloatArray
    weights: FloatArray
    degree: int

    @classmethod
    def of(cls, points_mm: FloatArray, volumes_ml: FloatArray, degree: int) -> "TissueBasis":
        """All functions up to a total degree, on cells with centroids (n, 3), mm, and volumes (n,)."""
        *_, last = (basis for basis, _ in zip(rising_bases(points_mm, volumes_ml), range(degree + 1), strict=False))
        return last

    def coefficients(self, values: FloatArray) -> FloatArray:
        """Coefficients (k,) of a field (n,)."""
        return np.asarray(self.functions.T @ (self.weights * values))

    def field(self, coefficients: FloatArray) -> FloatArray:
        """Field (n,) of coefficients (k,)."""
        return np.asarray(self.functions @ coefficients)


def rising_bases(points_mm: FloatArray, volumes_ml: FloatArray) -> Iterator[TissueBasis]:
    """Bases of total degree 0, 1, 2 ... on the cells of a tissue, each the one before with more functions.

    They end at `MOST_DEGREE`, or where a further one would have more than a function for ten cells. All polynomials of
    a total degree are in them, so what they can show does not depend on the axes.
    """
    weights = volumes_ml / volumes_ml.sum()
    root = np.sqrt(weights)[:, None]
    low, high = points_mm.min(axis=0), points_mm.max(axis=0)
    inside = 2.0 * (points_mm - low) / np.maximum(high - low, 1e-12) - 1.0
    along = [legvander(x, MOST_DEGREE) for x in inside.T]
    made = np.zeros((len(points_mm), 0))
    for degree in range(MOST_DEGREE + 1):
        orders = [(i, j, degree - i - j) for i in range(degree + 1) for j in range(degree + 1 - i)]
        products = [along[0][:, i] * along[1][:, j] * along[2][:, k] for i, j, k in orders]
        further = root * np.stack(products, axis=1)
        length = np.linalg.norm(further, axis=0)
        for _ in range(2):  # the second time for what rounding left
            further = further - made @ (made.T @ further)
        columns, triangle, _ = qr(further / length, mode="economic", pivoting=True)
        kept = np.abs(np.diag(triangle)) > _DEPENDENT
        columns = columns[:, : len(kept)][:, kept]
        columns -= made @ (made.T @ columns)
        if degree and _CELLS_EACH * (made.shape[1] + columns.shape[1]) > len(points_mm):
            return
        made = np.hstack([made, columns])
        yield TissueBasis(made / root, weights, degree)


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
    measurement_uncertainty : float
        Standard uncertainty of the measured field, root mean square over the tissue, u_cal.
    """

    degree: int
    measured: Reconstruction
    models: Mapping[str, Reconstruction] = field(default_factory=dict)
    measurement_uncertainty: float = float("nan")

    @property
    def accepted(self) -> bool:
        """Whether the measured field is reconstructed as the guide asks; see `Reconstruction.accepted`."""
        return self.measured.accepted(self.measurement_uncertainty)

    @property
    def uncertainty(self) -> float:
        """Standard uncertainty of a measured coefficient: u(s) = (u_cal^2 + u_rec^2)^(1/2)."""
        return float(np.hypot(self.measurement_uncertainty, self.measured.residual))

    @property
    def expanded(self) -> float:
        """Half the width of the band about the line of equal coefficients, 2 u(s)."""
        return _COVERED * self.uncertainty


def decompose(
    measured: FloatArray, models: Mapping[str, FloatArray], cells: CellGraph, uncertainty: float
) -> Decomposition:
    """Decompose fields (n,) on the cells of one tissue, by the least degree at which the measured one is accepted.

    Parameters
    ----------
    measured : (n,)
        Measured field, such as the maximum shear strain.
    models : mapping of name to (n,)
        Simulated fields in the same cells.
    cells : CellGraph
        The cells of the tissue, LPS mm, reference configuration.
    uncertainty : float
        Standard uncertainty of the measured field, root mean square over the tissue, in its unit.

    References
    ----------
    CWA 16799:2014, Validation of computational solid mechanics models.
    Christian, Dean, Dvurecenska, Middleton and Patterson, R Soc Open Sci 2021, doi:10.1098/rsos.210916 (functions).
    """
    found: tuple[TissueBasis, Reconstruction] | None = None
    for basis in rising_bases(cells.points_mm, cells.volumes_ml):
        found = basis, Reconstruction.of(measured, basis, cells)
        if found[1].accepted(uncertainty):
            break
    assert found is not None
    of_models = {name: Reconstruction.of(values, found[0], cells) for name, values in models.items()}
    return Decomposition(found[0].degree, found[1], of_models, uncertainty)


def probability_of_representation(measured: FloatArray, simulated: FloatArray, expanded: float) -> float:
    """Probability that predictions represent the measurement within its uncertainty, 0 to 1.

    The share of the coefficients' errors that are not larger than the ``expanded`` uncertainty in the sum of all
    errors: each error counts by its size. 1 where no error is larger.

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
    u_cal, u_rec : float
        Standard uncertainty of the measurement, and residual of its reconstruction, strain.
    clusters : int
        Clusters of residuals of the measured field; see `Reconstruction`.
    model_u_rec, model_clusters : float, int
        The same for the model's field.
    in_band : int
        Coefficients of the model that are within 2 (u_cal^2 + u_rec^2)^(1/2) of the measured ones.
    probability : float
        As `probability_of_representation`, 0 to 1.
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

    @property
    def accepted(self) -> bool:
        """Whether the measured field is reconstructed as the guide asks: u_rec within u_cal, and no cluster."""
        return self.u_rec <= self.u_cal and self.clusters == 0

    @property
    def within(self) -> bool:
        """Whether all coefficients lie in the band: the guide's own acceptance of a model."""
        return self.in_band == self.coefficients


def representation(of: tuple[str, str, str], by: Decomposition) -> Representation:
    """The row ``of`` a model, load and tissue."""
    measured, model = by.measured, by.models[of[0]]
    inside = int(np.count_nonzero(np.abs(model.coefficients - measured.coefficients) <= by.expanded))
    probability = probability_of_representation(measured.coefficients, model.coefficients, by.expanded)
    return Representation(
        *of, len(measured.coefficients), by.degree, by.measurement_uncertainty, measured.residual, measured.clusters,
        model.residual, model.clusters, inside, probability,
    )  # fmt: skip
