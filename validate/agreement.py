"""Cell-by-cell agreement of a simulated with a measured field, weighted by cell volume."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from dvc import Deformation
from dvc.arrays import FloatArray, IntArray
from dvc.deformation.nodal import OnMesh
from dvc.mesh import outer_faces
from validate.mapping import ALL, MappedFields

TO_BONE_MM = (0.0, 3.0, 6.0, 12.0)
"""Lower ends of the bins of distance to bone, mm."""

_FLAT, _LEAST = 1e-12, 10  # variance over mean square, below which a field is uniform; smallest number of cells
_COPLANAR_MM, _INWARD_MM = 0.3, 1.0


@dataclass(frozen=True, slots=True)
class Agreement:
    """Agreement of one quantity, "max_shear" or "u_mm", in one part of the tissue; a row of agreement.csv.

    For displacement, means, bias and limits are those of its magnitude in mm; regression and concordance pool its three
    components, so that a wrong direction shows.

    Attributes
    ----------
    slope, intercept, r2 : float
        Least-squares regression of the model on the measurement, and the squared correlation.
    rmse : float
        Root mean square of model minus measurement; for displacement, of the magnitude of the difference vector, mm.
    concordance : float
        Lin's concordance correlation coefficient (1989, doi:10.2307/2532051): 1 where both are equal.
    bias, lower, upper : float
        Mean of model minus measurement, and the limits of agreement, 1.96 standard deviations to either side (Bland
        and Altman 1986, doi:10.1016/S0140-6736(86)90837-8).
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
    of: tuple[str, str, str, str], measured: FloatArray, simulated: FloatArray, volumes_ml: FloatArray
) -> Agreement | None:
    """Agreement of fields (n,) without gaps, ``of`` a model, load, quantity and part; None for fewer than ten cells."""
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
        *of, len(measured), float(volumes_ml.sum()), x0, y0, slope, y0 - slope * x0, xy**2 / (xx * yy),
        float(np.hypot(bias, spread)), 2.0 * xy / (xx + yy + bias**2), bias, bias - 1.96 * spread, bias + 1.96 * spread,
    )  # fmt: skip


def agreements(fields: MappedFields, model: str, load: str) -> list[Agreement]:
    """Agreement of a model's maximum shear strain and displacement (mm) with the measured, cell by cell.

    Rows for all soft tissue, each tissue, and bins of distance to bone; none for a part with fewer than ten cells in
    which the measurement and all models are defined.
    """
    common, field, parts = fields.common, fields.models[model], fields.parts
    for low, high in pairwise((*TO_BONE_MM, np.inf)):
        name = f"{low:g} to {high:g} mm from bone" if np.isfinite(high) else f"over {low:g} mm from bone"
        parts[name] = common & (fields.to_bone_mm >= low) & (fields.to_bone_mm < high)
    rows = []
    for part, where in parts.items():
        volumes = fields.volumes_ml[where]
        u, v = fields.measured.u_mm[where], field.u_mm[where]
        shears, of_u = (fields.measured.max_shear[where], field.max_shear[where]), (model, load, "u_mm", part)
        rows.append(agreement((model, load, "max_shear", part), *shears, volumes))
        row = agreement(of_u, np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1), volumes)
        pooled = agreement(of_u, u.ravel(), v.ravel(), np.repeat(volumes, 3))
        if row is not None and pooled is not None:
            rmse = float(np.sqrt(volumes @ ((v - u) ** 2).sum(axis=1) / volumes.sum()))
            by_component = ("slope", "intercept", "r2", "concordance")
            rows.append(replace(row, rmse=rmse, **{name: getattr(pooled, name) for name in by_component}))
    return [row for row in rows if row is not None]


def over_loads(rows: Sequence[Agreement], model: str, quantity: str, value: str) -> str:
    """A ``value`` such as "slope" in all soft tissue, two decimals; its range if there are several loads.

    Empty if it is defined under no load.
    """
    of_all = (getattr(row, value) for row in rows if (row.model, row.quantity, row.part) == (model, quantity, ALL))
    known = [one for one in of_all if np.isfinite(one)]
    return " to ".join(dict.fromkeys(f"{end:z.2f}" for end in (min(known), max(known)))) if known else ""


def regression_told(rows: Sequence[Agreement], model: str) -> str:
    """Slope and R² of a model on the measurement under each load, cell by cell; empty if none is defined."""
    loads = dict.fromkeys(row.load for row in rows if row.model == model)
    told = []
    for name, quantity in (("displacement", "u_mm"), ("max. shear", "max_shear")):
        of = [row for row in rows if (row.model, row.quantity, row.part) == (model, quantity, ALL)]
        values = [
            f"{row.slope:z.2f} ({row.r2:z.2f})" + f" under {row.load}" * (len(loads) > 1)
            for row in of
            if np.isfinite([row.slope, row.r2]).all()
        ]
        told += [f"{name} {', '.join(values)}"] if values else []
    why = " (best by area)" * (len({row.model for row in rows}) > 1)
    means = "Slope and R² are 1 if the fields are equal; R² is near 0 if the strain is in other places than measured."
    regression = f"Cell-by-cell regression of {model}{why} on the measurement"
    return f"{regression}, slope (R²): {'; '.join(told)}. {means}" if told else ""


@dataclass(frozen=True, slots=True)
class SkinDisplacement:
    """Displacement of the skin under the plate, and volume change of the fat; a row of skin_displacement.csv.

    Attributes
    ----------
    nodes : int
        Nodes of the skin on the model's plate where both fields are defined.
    measured_mm, model_mm : float
        Mean displacement along the normal force (into the body part), mm.
    measured_along_mm, model_along_mm : float
        Magnitude of the mean tangential displacement, mm.
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


def skin_on_plate(model: OnMesh, normal: FloatArray) -> IntArray:
    """Surface nodes of a model that are coplanar, across ``normal``, in the deformed configuration.

    Of all such planes in the half of the model that faces the plate, the one with most nodes is chosen, since tissue
    may bulge past a small plate.
    """
    outside = np.unique(outer_faces(model.mesh.cells))
    height = (model.mesh.points_mm + model.u_mm)[outside] @ normal
    rising = np.sort(height[height > 0.5 * (height.min() + height.max())])
    within = np.searchsorted(rising, rising + _COPLANAR_MM, side="right") - np.arange(len(rising))
    low = rising[len(rising) - 1 - int(np.argmax(within[::-1]))]
    return np.asarray(outside[(height >= low) & (height <= low + _COPLANAR_MM)])


def skin_displacement(
    fields: MappedFields, name: str, load: str, model: OnMesh, measured: Deformation, normal: FloatArray
) -> SkinDisplacement:
    """Displacement, measured and simulated, 1 mm inside the skin on the plate.

    Parameters
    ----------
    fields : MappedFields
        With the model ``name``; gives the volume change of the fat.
    model, measured : OnMesh, Deformation
        Both relative to the bone, reference configuration, LPS mm. The skin on the plate is the part of the model's
        surface that is flat across ``normal`` in the deformed configuration.
    normal : (3,)
        The plate's outward unit normal, LPS.
    """
    inside = model.mesh.points_mm[skin_on_plate(model, normal)] - _INWARD_MM * normal
    both = measured.displacement(inside), model.displacement(inside)
    known = np.isfinite(np.concatenate(both, axis=1)).all(axis=1)
    mean = [u[known].mean(axis=0) if known.any() else np.full(3, np.nan) for u in both]
    fat = np.char.lower(fields.tissue) == "fat"
    where = fields.common & (fat if (fields.common & fat).any() else True)
    volumes = fields.volumes_ml[where] / fields.volumes_ml[where].sum()
    change = [float(volumes @ field.jacobian[where]) - 1.0 for field in (fields.measured, fields.models[name])]
    along = [float(-m @ normal) for m in mean]
    across = [float(np.linalg.norm(m - (m @ normal) * normal)) for m in mean]
    return SkinDisplacement(name, load, int(known.sum()), *along, *across, *change)
