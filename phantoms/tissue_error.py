"""Error of a measured deformation against the truth, by tissue."""

from dataclasses import dataclass

import numpy as np

from dvc import Deformation, LabelMap, StrainField, evaluate_on_grid
from dvc.arrays import BoolArray
from dvc.errors import GeometryError


@dataclass(frozen=True, slots=True)
class TissueError:
    """Error in one tissue over its voxels; reference configuration, displacement in mm, max. shear dimensionless.

    Attributes
    ----------
    voxels, folded : int
        Voxels compared, and those with det F <= 0.
    true_p50, true_p95 : float
        Percentiles of the true maximum shear strain (E_1 - E_3) / 2.
    shear_rmse, shear_bias, shear_error_p95 : float
        Root mean square and mean of measured minus true max. shear; 95th percentile of its absolute value.
    u_p50_mm, u_p95_mm : float
        Percentiles of the length of the difference between measured and true displacement.
    """

    tissue: str
    voxels: int
    true_p50: float
    true_p95: float
    shear_rmse: float
    shear_bias: float
    shear_error_p95: float
    u_p50_mm: float
    u_p95_mm: float
    folded: int


def errors_by_tissue(
    labels: LabelMap, truth: Deformation, measured: Deformation, where: BoolArray
) -> tuple[TissueError, ...]:
    """Compare two deformations in the voxels of each tissue; tissues without such a voxel are left out.

    Parameters
    ----------
    labels : LabelMap
        Tissues on the reference grid.
    truth, measured : Deformation
        u and grad u in the reference configuration, LPS mm.
    where : (ni, nj, nk) bool
        Voxels to compare, as far as ``measured`` is defined there.

    Raises
    ------
    GeometryError
        If ``where`` is not on the labels' grid.
    """
    if where.shape != labels.grid.shape:
        raise GeometryError(
            f"The voxels to compare have shape {where.shape}; the labels' grid has {labels.grid.shape}."
        )
    inside = where & (labels.labels > 0)
    true_u, true_H = evaluate_on_grid(truth, labels.grid, inside)
    u, H = evaluate_on_grid(measured, labels.grid, inside)
    true, strain = StrainField.from_gradient(true_H), StrainField.from_gradient(H)
    error = strain.max_shear - true.max_shear
    distance = np.linalg.norm(u - true_u, axis=1)
    rows = []
    for number, tissue in labels.names.items():
        kept = (labels.labels[inside] == number) & strain.valid
        if not kept.any():
            continue
        rows.append(
            TissueError(
                tissue=tissue,
                voxels=int(np.count_nonzero(kept)),
                true_p50=float(np.median(true.max_shear[kept])),
                true_p95=float(np.percentile(true.max_shear[kept], 95)),
                shear_rmse=float(np.sqrt(np.mean(error[kept] ** 2))),
                shear_bias=float(error[kept].mean()),
                shear_error_p95=float(np.percentile(np.abs(error[kept]), 95)),
                u_p50_mm=float(np.median(distance[kept])),
                u_p95_mm=float(np.percentile(distance[kept], 95)),
                folded=int(np.count_nonzero(strain.jacobian[kept] <= 0)),
            )
        )
    return tuple(rows)
