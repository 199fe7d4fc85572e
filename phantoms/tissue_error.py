"""Error of a measured deformation against the truth, by tissue."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dvc.arrays import BoolArray
from dvc.deformation.protocol import Deformation, evaluate_on_grid
from dvc.deformation.strain import StrainField
from dvc.errors import GeometryError
from dvc.images.image import LabelMap


@dataclass(frozen=True, slots=True)
class TissueError:
    """Error in one tissue, over its voxels; reference configuration, displacement in mm, shear without unit.

    Attributes
    ----------
    tissue : str
    voxels : int
        Voxels scored.
    true_p50, true_p95 : float
        Percentiles of the true maximal shear (E_1 - E_3) / 2.
    shear_rmse, shear_bias, shear_error_p95 : float
        Root mean square and mean of found minus true maximal shear; 95th percentile of its absolute value.
    u_p50_mm, u_p95_mm : float
        Percentiles of the length of the difference between found and true displacement.
    folded : int
        Voxels with det F <= 0.
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
    labels: LabelMap, truth: Deformation, found: Deformation, where: BoolArray
) -> tuple[TissueError, ...]:
    """Compare two deformations in the voxels of each tissue; a tissue without a scored voxel is left out.

    Parameters
    ----------
    labels : LabelMap
        Tissues on the reference grid.
    truth, found : Deformation
        u and grad u in the reference configuration, LPS mm.
    where : (ni, nj, nk) bool
        Voxels to score; of these, those count where ``found`` is defined.

    Raises
    ------
    GeometryError
        If ``where`` is not on the labels' grid.
    """
    if where.shape != labels.grid.shape:
        raise GeometryError(f"The voxels to score have shape {where.shape}; the labels' grid has {labels.grid.shape}.")
    inside = where & (labels.labels > 0)
    U, true_H = evaluate_on_grid(truth, labels.grid, inside)
    u, H = evaluate_on_grid(found, labels.grid, inside)
    true, measured = StrainField.from_gradient(true_H), StrainField.from_gradient(H)
    error = measured.max_shear - true.max_shear
    distance = np.linalg.norm(u - U, axis=1)
    rows = []
    for number, tissue in labels.names.items():
        kept = (labels.labels[inside] == number) & measured.valid
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
                folded=int(np.count_nonzero(measured.jacobian[kept] <= 0)),
            )
        )
    return tuple(rows)
