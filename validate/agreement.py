"""Agreement of a simulated with a measured field, cell by cell; every figure is weighted by volume."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.deformation.nodal import OnMesh
from dvc.deformation.protocol import Deformation
from dvc.mesh import outer_faces
from validate.mapping import ALL, Mapped

TO_BONE_MM = (0.0, 3.0, 6.0, 12.0)
"""Lower ends of the bins of distance to bone, mm."""

_FLAT = 1e-12  # variance over mean square
_LEAST = 10  # cells below which nothing is told
_COPLANAR_MM = 0.3
_INWARD_MM = 1.0


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of one quantity in one part of the tissue.

    Attributes
    ----------
    model, load, quantity, part : str
        The quantity is "max_shear" or "u_mm": means, bias and limits of the displacement's length; regression and
        concordance of its three components together, so that a wrong direction shows.
    cells : int
    volume_ml : float
    measured_mean, model_mean : float
    slope, intercept : float
        Least squares of the model on the measurement.
    r2 : float
        Square of the correlation.
    rmse : float
        Root mean square of model minus measurement; for the displacement of the difference vector's length, mm.
    concordance : float
        Lin's coefficient (1989, doi:10.2307/2532051): 1 where both are equal.
    bias, lower, upper : float
        Mean of model minus measurement, and that -+ 1.96 standard deviations (Bland and Altman 1986,
        doi:10.1016/S0140-6736(86)90837-8).
    """

    model: str
    load: str
    quantity: str
    part: str
    cells: int
    volume_ml: float
    measured_mean: float
    model_mean: float
    slope: float
    intercept: float
    r2: float
    rmse: float
    concordance: float
    bias: float
    lower: float
    upper: float


def agreement(
    model: str,
    load: str,
    quantity: str,
    part: str,
    measured: FloatArray,
    simulated: FloatArray,
    volumes_ml: FloatArray,
    rmse: float | None = None,
) -> Agreement | None:
    """Agreement of two fields (n,) without gaps; None for fewer than ten cells.

    Examples
    --------
    >>> x = np.linspace(0.0, 1.0, 20)
    >>> found = agreement("a", "Load1", "max_shear", "fat", x, 2.0 * x + 0.1, np.ones(20))
    >>> round(found.slope, 9), round(found.intercept, 9), round(found.r2, 9), round(found.bias, 9)
    (2.0, 0.1, 1.0, 0.6)
    """
    if len(measured) < _LEAST:
        return None
    weight = volumes_ml / volumes_ml.sum()
    x0, y0 = float(weight @ measured), float(weight @ simulated)
    x, y = measured - x0, simulated - y0
    xx, yy, xy = float(weight @ x**2), float(weight @ y**2), float(weight @ (x * y))
    if min(xx, yy) <= _FLAT * max(x0**2, y0**2):  # a uniform field: only rounding varies
        xx = yy = xy = float("nan")
    slope = xy / xx
    spread = float(np.sqrt(weight @ (y - x) ** 2))
    bias = y0 - x0
    return Agreement(
        model, load, quantity, part, len(measured), float(volumes_ml.sum()), x0, y0, slope, y0 - slope * x0,
        xy**2 / (xx * yy),
        float(np.hypot(bias, spread)) if rmse is None else rmse,
        2.0 * xy / (xx + yy + bias**2),
        bias, bias - 1.96 * spread, bias + 1.96 * spread,
    )  # fmt: skip


def agreements(found: Mapped, model: str, load: str) -> list[Agreement]:
    """Agreement of maximal shear and displacement in all soft tissue, each tissue, and by distance to bone."""
    common, field = found.common, found.models[model]
    parts: dict[str, BoolArray] = {ALL: common}
    parts |= {tissue: common & (found.tissue == tissue) for tissue in found.tissues}
    ends = (*TO_BONE_MM[1:], np.inf)
    for low, high in zip(TO_BONE_MM, ends, strict=True):
        told = f"{low:g} to {high:g} mm from bone" if np.isfinite(high) else f"over {low:g} mm from bone"
        parts[told] = common & (found.to_bone_mm >= low) & (found.to_bone_mm < high)
    rows = []
    for part, where in parts.items():
        volumes = found.volumes_ml[where]
        u, v = found.measured.u_mm[where], field.u_mm[where]
        apart = float(np.sqrt(volumes @ ((v - u) ** 2).sum(axis=1) / volumes.sum())) if where.any() else 0.0
        rows.append(
            agreement(model, load, "max_shear", part, found.measured.max_shear[where], field.max_shear[where], volumes)
        )
        lengths = agreement(
            model, load, "u_mm", part, np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1), volumes, apart
        )
        vectors = agreement(model, load, "u_mm", part, u.ravel(), v.ravel(), np.repeat(volumes, 3))
        if lengths is not None and vectors is not None:
            rows.append(
                replace(
                    lengths,
                    slope=vectors.slope,
                    intercept=vectors.intercept,
                    r2=vectors.r2,
                    concordance=vectors.concordance,
                )
            )
    return [row for row in rows if row is not None]


@dataclass(frozen=True, slots=True)
class Travel:
    """Displacement of the skin under the plate, and change of the tissues' volume.

    Attributes
    ----------
    model, load : str
    nodes : int
        Of the skin under the model's plate at which both are defined.
    measured_mm, model_mm : float
        Mean displacement along the plate's normal force (towards the foot).
    measured_along_mm, model_along_mm : float
        Mean displacement across it, length.
    measured_volume_change, model_volume_change : float
        Mean of det F - 1 over the fat, or over all tissue where no fat is compared.
    """

    model: str
    load: str
    nodes: int
    measured_mm: float
    model_mm: float
    measured_along_mm: float
    model_along_mm: float
    measured_volume_change: float
    model_volume_change: float


def sole_under_plate(model: OnMesh, normal: FloatArray) -> IntArray:
    """Nodes on the outside of a model that lie on one plane across ``normal`` once it is deformed.

    The plane with most nodes, in the half of the model towards the plate: tissue may bulge past a small plate.
    """
    outside = np.unique(outer_faces(model.mesh.cells))
    height = (model.mesh.points_mm + model.u_mm)[outside] @ normal
    rising = np.sort(height[height > 0.5 * (height.min() + height.max())])
    within = np.searchsorted(rising, rising + _COPLANAR_MM, side="right") - np.arange(len(rising))
    low = rising[len(rising) - 1 - int(np.argmax(within[::-1]))]
    return np.asarray(outside[(height >= low) & (height <= low + _COPLANAR_MM)])


def travel(found: Mapped, name: str, load: str, model: OnMesh, measured: Deformation, normal: FloatArray) -> Travel:
    """Compare how far the plate took the skin on it, by the mean displacement 1 mm inside the skin.

    Parameters
    ----------
    normal : (3,)
        The plate's outward unit normal, LPS.
    """
    nodes = sole_under_plate(model, normal)
    inside = model.mesh.points_mm[nodes] - _INWARD_MM * normal
    both = measured.displacement(inside), model.displacement(inside)
    known = np.isfinite(both[0]).all(axis=1) & np.isfinite(both[1]).all(axis=1)
    moved = [u[known] for u in both]
    mean = [m.mean(axis=0) if known.any() else np.full(3, np.nan) for m in moved]
    fat = np.char.lower(found.tissue) == "fat"
    where = found.common & (fat if (found.common & fat).any() else True)
    volumes = found.volumes_ml[where] / found.volumes_ml[where].sum()
    change = [float(volumes @ field.jacobian[where]) - 1.0 for field in (found.measured, found.models[name])]
    along = [float(-m @ normal) for m in mean]
    across = [float(np.linalg.norm(m - (m @ normal) * normal)) for m in mean]
    return Travel(name, load, int(known.sum()), along[0], along[1], across[0], across[1], change[0], change[1])
