"""What a figure would be on an endlessly fine mesh, from meshes of several sizes."""

from dataclasses import dataclass

import numpy as np

from dvc import TetMesh
from dvc.arrays import FloatArray
from dvc.errors import InputError

_ORDERS = np.linspace(0.5, 2.0, 151)  # linear cells: displacement converges with the order 2, strain with 1
_FEWEST = 3
_APART = 1.5


@dataclass(frozen=True, slots=True)
class Limit:
    """A figure's value on an endlessly fine mesh, f(h) = limit + slope h^order.

    Attributes
    ----------
    limit, order : float
        The order is searched from 0.5 to 2. Figures that seem to converge faster than linear cells can are taken to do
        so with 2, which puts the limit further away (Eca, Hoekstra 2014, doi:10.1016/j.jcp.2014.01.006). Both are NaN
        where they show a lower order, do not rise or fall steadily, or have passed the limit already.
    scatter : float
        Root mean square distance of the figures from the curve; 0 with three sizes, which it goes through if it can.
    error : float
        Of the figure on the finest mesh, as a share of the limit.
    """

    limit: float
    order: float
    scatter: float
    error: float


def cell_size_mm(mesh: TetMesh) -> float:
    """Size of a mesh's cells: the cube root of their mean volume, mm."""
    return float(np.cbrt(mesh.volumes_mm3.mean()))


def extrapolate(sizes_mm: FloatArray, values: FloatArray) -> Limit:
    """Extrapolate a figure (n,) from meshes of sizes (n,), three or more (Richardson, with the order observed).

    Raises
    ------
    InputError
        If there are fewer than three sizes, or the coarsest is not 1.5 times the finest or more.

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
            f"Extrapolation needs {_FEWEST} or more meshes, the coarsest {_APART} times the size of the finest; got "
            f"cells of {', '.join(f'{s:.2f}' for s in h)} mm. Where borders lie close together they, and not the edge "
            "length asked for, set the size: ask for shorter edges."
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
