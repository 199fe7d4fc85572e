"""Mesh convergence: a quantity extrapolated to an infinitely fine mesh, from meshes of several element sizes."""

from dataclasses import dataclass

import numpy as np

from dvc import TetMesh
from dvc.arrays import FloatArray
from dvc.errors import InputError

ASSUMED_ORDER = 1.0
"""Of the strain in linear cells, where meshes do not show one."""
SAFETY, SAFETY_WITHOUT_ORDER = 1.25, 3.0
"""Factors of the grid convergence index; the second where three meshes or more show no order."""
LEAST_RATIO = 1.1
"""Of the cell sizes of two meshes; below, their difference is scatter and tells no error of the mesh."""
_COVERAGE = 2.0  # of the expanded uncertainty that the index is
_ORDERS = np.linspace(0.5, 2.0, 151)  # linear cells: displacement converges with the order 2, strain with 1
_FEWEST = 3
_APART = 1.5


@dataclass(frozen=True, slots=True)
class Limit:
    """Extrapolation of a quantity to an infinitely fine mesh, f(h) = limit + slope h^order.

    Attributes
    ----------
    limit, order : float
        The order is searched from 0.5 to 2. If the values seem to converge faster than linear cells can, the order is
        set to 2, which is conservative: the limit lies further away (Eca, Hoekstra 2014,
        doi:10.1016/j.jcp.2014.01.006). Both are NaN if the observed order is below 0.5, if the values are not
        monotonic, or if they have already passed the limit.
    scatter : float
        Root mean square distance of the values from the curve; with three sizes 0, if a curve fits them exactly.
    error : float
        Of the value on the finest mesh, as a fraction of the limit.
    """

    limit: float
    order: float
    scatter: float
    error: float


def cell_size_mm(mesh: TetMesh) -> float:
    """Cell size of a mesh: the cube root of the mean cell volume, mm."""
    return float(np.cbrt(mesh.volumes_mm3.mean()))


def mesh_steps(ratio: float, order: float = ASSUMED_ORDER, safety: float = SAFETY) -> float:
    """Difference of solutions on two meshes, in standard uncertainties of the one on the finer mesh.

    From the ratio of their cell sizes, coarse over fine, above 1. The expanded uncertainty is the grid convergence
    index, safety |f_fine - f_coarse| / (ratio^order - 1) (Roache 1994, doi:10.1115/1.2910291), and the standard
    uncertainty is half of it.

    >>> round(mesh_steps(1.4), 3)  # the difference is 0.64 standard uncertainties
    0.64
    """
    return float(_COVERAGE * (ratio**order - 1.0) / safety)


def extrapolate(sizes_mm: FloatArray, values: FloatArray) -> Limit:
    """Extrapolate a quantity (n,) on meshes of three or more cell sizes (n,) (Richardson, with the observed order).

    Raises
    ------
    InputError
        If there are fewer than three sizes, or the coarsest is less than 1.5 times the finest.

    Examples
    --------
    >>> h = np.array([4.0, 2.0, 1.0])
    >>> limit = extrapolate(h, 5.0 + 0.1 * h**2)
    >>> round(limit.limit, 3), round(limit.order, 2), round(limit.error, 3)
    (5.0, 2.0, 0.02)
    """
    h, f = np.asarray(sizes_mm, dtype=np.float64), np.asarray(values, dtype=np.float64)
    if len(h) < _FEWEST or len(np.unique(h)) < len(h) or h.shape != f.shape or h.max() < _APART * h.min():
        raise InputError(
            f"Extrapolation needs at least {_FEWEST} meshes of different cell size, the coarsest at least {_APART} "
            f"times the finest; the cell sizes are {', '.join(f'{s:.2f}' for s in h)} mm. In thin tissues the tissue "
            "interfaces limit the cell size, not the edge length; use shorter edge lengths."
        )
    best = (np.inf, 0.0, 0.0)
    for order in _ORDERS:
        columns = np.column_stack([np.ones_like(h), h**order])
        coefficients, *_ = np.linalg.lstsq(columns, f, rcond=None)
        cost = float(np.sqrt(np.mean((columns @ coefficients - f) ** 2)))
        if cost < best[0] - 1e-15:
            best = cost, float(order), float(coefficients[0])
    scatter, order, limit = best
    steps = np.diff(f[np.argsort(h)])
    finest, coarsest = float(f[int(np.argmin(h))]), float(f[int(np.argmax(h))])
    steady = bool(np.all(steps >= 0.0) or np.all(steps <= 0.0))
    if order == _ORDERS[0] or not steady or (limit - finest) * (finest - coarsest) < 0.0:
        return Limit(float("nan"), float("nan"), scatter, float("nan"))
    return Limit(limit, order, scatter, (finest - limit) / limit if limit != 0.0 else float("nan"))
