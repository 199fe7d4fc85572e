"""Displacement and strain on the voxels of a grid, and where they are defined, up to the edge of the scan."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.deformation.protocol import Deformation, evaluate_on_grid
from dvc.deformation.strain import StrainField
from dvc.images.image import Grid, Mask

TENSOR_COMPONENTS = ("xx", "xy", "xz", "yy", "yz", "zz")
_SLAB_VOXELS = 100_000
_UPPER = (np.array([0, 0, 0, 1, 1, 2]), np.array([0, 1, 2, 1, 2, 2]))


@dataclass(frozen=True, slots=True, eq=False)
class StrainMaps:
    """Fields on a reference grid; NaN where not valid. Single precision, LPS components.

    Attributes
    ----------
    grid : Grid
        Voxels, LPS mm.
    valid : (ni, nj, nk) bool
        Where the deformation is defined and lands inside the loaded image.
    displacement_mm : (ni, nj, nk, 3)
        Of tissue relative to its bone, reference configuration.
    green_lagrange : (ni, nj, nk, 6)
        E_xx, E_xy, E_xz, E_yy, E_yz, E_zz.
    max_shear : (ni, nj, nk)
        (E_1 - E_3) / 2.
    jacobian : (ni, nj, nk)
        det F.
    """

    grid: Grid
    valid: BoolArray
    displacement_mm: Float32Array
    green_lagrange: Float32Array
    max_shear: Float32Array
    jacobian: Float32Array

    @property
    def by_quantity(self) -> dict[str, Float32Array]:
        """The quantities of tables by region: max_shear, jacobian, and displacement_mm as a length."""
        length = np.linalg.norm(self.displacement_mm, axis=-1)
        return {"max_shear": self.max_shear, "jacobian": self.jacobian, "displacement_mm": length}


def strain_maps(
    deformation: Deformation, mask: Mask, seen: Callable[[FloatArray], BoolArray] | None = None
) -> StrainMaps:
    """Displacement and strain at the voxels of a mask on the reference grid: what decides where strain is defined.

    Parameters
    ----------
    deformation : Deformation
        Of tissue relative to its bone, reference configuration, LPS mm.
    mask : Mask
        Voxels where the fields are wanted.
    seen : callable, optional
        Of deformed points x (n, 3), LPS mm: whether the loaded image shows them, (n,) bool. Fields are NaN where not.
    """
    grid = mask.grid
    valid = np.zeros(grid.shape, dtype=bool)
    displacement, tensor = (np.full((*grid.shape, n), np.nan, dtype=np.float32) for n in (3, 6))
    shear, jacobian = (np.full(grid.shape, np.nan, dtype=np.float32) for _ in range(2))
    step = max(1, _SLAB_VOXELS // (grid.shape[1] * grid.shape[2]))
    for start in range(0, grid.shape[0], step):
        slab = slice(start, start + step)
        where = mask.inside[slab]
        if not where.any():
            continue
        part = grid.part((slab, slice(None), slice(None)))
        u, H = evaluate_on_grid(deformation, part, where)
        strain = StrainField.from_gradient(H)
        known = strain.valid & np.isfinite(u).all(axis=1)
        if seen is not None:
            known &= seen(part.points(where) + u)
        for field, values in (
            (displacement, u),
            (tensor, strain.green_lagrange[:, _UPPER[0], _UPPER[1]]),
            (shear, strain.max_shear),
            (jacobian, strain.jacobian),
        ):
            field[slab][where] = np.where(known.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)
        valid[slab][where] = known
    return StrainMaps(grid, valid, displacement, tensor, shear, jacobian)
