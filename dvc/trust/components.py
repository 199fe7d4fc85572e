"""Uncertainty of the components of a strain and a displacement, by an error table."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from dvc.arrays import BoolArray, Float32Array
from dvc.deformation.strain_maps import TENSOR_COMPONENTS, StrainMaps
from dvc.trust.error_model import ErrorTable

NORMAL, SHEAR = [0, 3, 5], [1, 2, 4]
"""Normal and shear components among xx, xy, xz, yy, yz and zz."""


@dataclass(frozen=True, slots=True)
class ComponentRow:
    """A component in one tissue: its mean over the voxels, its bias, and the uncertainty of its value in one voxel.

    Attributes
    ----------
    region : str
        Soft tissue.
    component : str
        "x", "y" or "z" of the displacement, "xx" to "zz" of the Green-Lagrange strain; LPS, reference configuration.
    unit : str
        "mm" or "1".
    mean : float
        As measured.
    bias : float
        Expected error of that mean: positive where the component is measured too large.
    voxel_standard_uncertainty : float
        Standard deviation of the error in one voxel about its bias, root mean square over the voxels.
    voxel_expanded_uncertainty : float
        Twice that (coverage factor k = 2).
    """

    region: str
    component: str
    unit: str
    mean: float
    bias: float
    voxel_standard_uncertainty: float
    voxel_expanded_uncertainty: float


@dataclass(frozen=True, slots=True, eq=False)
class ComponentUncertainty:
    """Standard uncertainty of components about their bias, (ni, nj, nk), the same for all axes; NaN where not known.

    Attributes
    ----------
    strain_bias : (ni, nj, nk)
        Expected error of the strain, as a fraction of each component: E less the fraction of it is the estimate.
    normal_strain, shear_strain : (ni, nj, nk)
        Of E_xx, E_yy and E_zz, and of E_xy, E_xz and E_yz, in LPS or any other axes.
    displacement_mm : (ni, nj, nk)
        Of u_x, u_y and u_z.
    rows : tuple of ComponentRow
        By tissue.
    """

    strain_bias: Float32Array
    normal_strain: Float32Array
    shear_strain: Float32Array
    displacement_mm: Float32Array
    rows: tuple[ComponentRow, ...]


def components_of(
    maps: StrainMaps, regions: Mapping[str, BoolArray], to_bone_mm: Float32Array, table: ErrorTable,
    wider: Mapping[str, float] = MappingProxyType({}),
) -> ComponentUncertainty | None:  # fmt: skip
    """Uncertainty of a measurement's components in soft tissues (masks by name); None where the table has none.

    ``wider`` holds factors on the uncertainty of some regions.
    """
    if not table.has_components:
        return None
    sigmas = np.full((4, *maps.grid.shape), np.nan, dtype=np.float32)
    rows = []
    for name, inside in regions.items():
        where = inside & np.isfinite(maps.max_shear)
        if not where.any():
            continue
        found = table.expected_components(name, maps.max_shear[where].astype(np.float64), to_bone_mm[where])
        found[1:] *= wider.get(name, 1.0)
        sigmas[:, where] = found
        normal, shear, displacement = np.sqrt(np.mean(found[1:] ** 2, axis=1)).tolist()
        means = maps.displacement_mm[where].mean(axis=0, dtype=np.float64).tolist()
        for component, mean in zip("xyz", means, strict=True):
            rows.append(ComponentRow(name, component, "mm", mean, 0.0, displacement, 2.0 * displacement))
        E = maps.green_lagrange[where].astype(np.float64)
        means, biases = E.mean(axis=0).tolist(), (found[0][:, None] * E).mean(axis=0).tolist()
        for number, (component, mean, bias) in enumerate(zip(TENSOR_COMPONENTS, means, biases, strict=True)):
            u = normal if number in NORMAL else shear
            rows.append(ComponentRow(name, component, "1", mean, bias, u, 2.0 * u))
    return ComponentUncertainty(sigmas[0], sigmas[1], sigmas[2], sigmas[3], tuple(rows))
