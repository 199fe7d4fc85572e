"""True fields drawn for a measured displacement and strain by their error model."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.deformation.strain_maps import StrainMaps
from dvc.errors import InputError
from dvc.trust.components import NORMAL, SHEAR
from dvc.trust.error_model import ROWS, ErrorTable
from dvc.trust.truth_draws import GaussianField


@dataclass(frozen=True, slots=True, eq=False)
class TrueField:
    """A drawn true field on the voxels of the unloaded image, reference configuration, LPS; NaN where not known.

    Attributes
    ----------
    displacement_mm : (ni, nj, nk, 3)
        Of tissue relative to its bone, mm.
    green_lagrange : (ni, nj, nk, 6)
        E_xx, E_xy, E_xz, E_yy, E_yz, E_zz.
    max_shear : (ni, nj, nk)
        Maximum shear strain (E_1 - E_3) / 2. Its error is drawn by its own statistics, so it is not exactly that of
        ``green_lagrange``.
    """

    displacement_mm: Float32Array
    green_lagrange: Float32Array
    max_shear: Float32Array


class FieldDraws:
    """Draws of the truth on a measurement's voxels: in each, one registration of the study errs as it did.

    A value measured, less that registration's bias, less a Gaussian field of its standard deviation and of the error's
    correlation length; a part of a component's error is the same in all voxels of a tissue (`ErrorTable.shared`).
    Components of the strain err as an isotropic tensor does: a shear component with s, a normal one with n, and two
    normal ones with the correlation 1 - 2 (s / n)^2, or -1/2 where that is less.

    Parameters
    ----------
    maps : StrainMaps
        Fields measured.
    regions : mapping of (ni, nj, nk) bool
        Soft tissues by name; nothing is drawn elsewhere.
    to_bone_mm : (ni, nj, nk)
        Distance to bone.
    table : ErrorTable
        With the errors of components; InputError without them, or if no voxel of the tissues has a strain.
    wider : mapping, optional
        Further factors on the deviations of some regions.
    """

    def __init__(
        self, maps: StrainMaps, regions: Mapping[str, BoolArray], to_bone_mm: Float32Array, table: ErrorTable,
        *, seed: int = 1, wider: Mapping[str, float] = MappingProxyType({}),
    ) -> None:  # fmt: skip
        if not table.has_components:
            raise InputError(
                "Draws need an error model with the errors of displacement and strain components, and this one is of "
                "an older version. Make it again with `mrstrain accuracy`."
            )
        self._maps, self._table, self._wider = maps, table, wider
        self._to_bone_mm, self._regions = to_bone_mm, {n: at & np.isfinite(maps.max_shear) for n, at in regions.items()}
        self._random = np.random.default_rng(seed)
        self._at = np.any([np.zeros(maps.grid.shape, dtype=bool), *self._regions.values()], axis=0)
        if not self._at.any():
            raise InputError("True fields cannot be drawn, because there is no soft tissue whose strain is known.")
        points = np.argwhere(self._at) * maps.grid.spacing_mm
        lengths = (table.correlation_mm, *table.component_correlation_mm)
        self._noise = [GaussianField(points, maps.grid.spacing_mm, length, self._random) for length in lengths]
        self._parts = {name: inside[self._at] for name, inside in self._regions.items()}

    def drawn(self) -> TrueField:
        """Draw a true field."""
        bias, sd, shrinkage, normal, sheared, displaced = self._errors(
            int(self._random.integers(len(self._table.runs)))
        )
        maps, at = self._maps, self._at
        shear = maps.max_shear[at] - bias - sd * self._noise[0].drawn()
        E, u = maps.green_lagrange[at], maps.displacement_mm[at]
        diagonal, others = (np.stack([self._of_component(0) for _ in range(3)]) for _ in range(2))
        E = E - shrinkage[:, None] * E - isotropic(diagonal, others, normal, sheared)
        u = u - displaced[:, None] * np.stack([self._of_component(1) for _ in range(3)], axis=1)
        return TrueField(self._on_grid(u), self._on_grid(E), self._on_grid(np.maximum(shear, 0.0)))

    def _of_component(self, which: int) -> FloatArray:
        """Noise (n,) of unit variance of a component of the strain (0) or the displacement (1)."""
        noise = self._noise[1 + which].drawn()
        for name, inside in self._parts.items():
            shared = self._table.shared_of(name)[which]
            noise[inside] = np.sqrt(1.0 - shared) * noise[inside] + np.sqrt(shared) * self._random.standard_normal()
        return noise

    def _errors(self, run: int) -> FloatArray:
        """`ROWS` (6, n) of a registration of the study at the voxels."""
        table = self._table
        shear, to_bone_mm = self._maps.max_shear[self._at].astype(np.float64), self._to_bone_mm[self._at]
        found = np.empty((len(ROWS), len(shear)))
        for name, inside in self._parts.items():
            at = name, shear[inside], to_bone_mm[inside], run
            bias, sd = table.expected(*at)
            shrinkage, *deviations = table.expected_components(*at)
            wider = self._wider.get(name, 1.0)
            found[:, inside] = bias, wider * sd, shrinkage, *(wider * deviation for deviation in deviations)
        return found

    def _on_grid(self, values: FloatArray) -> Float32Array:
        field = np.full((*self._at.shape, *values.shape[1:]), np.nan, dtype=np.float32)
        field[self._at] = values
        return field


def isotropic(diagonal: FloatArray, others: FloatArray, normal: FloatArray, shear: FloatArray) -> FloatArray:
    """Noise (n, 6) of a symmetric tensor, of the deviations (n,) given of its normal and of its shear components.

    ``diagonal`` and ``others`` (3, n) are independent noise of unit variance. The statistics are the same in all axes
    where normal^2 >= 4/3 shear^2; where normal components vary less, their mean does not vary.
    """
    drawn = np.empty((len(normal), 6))
    drawn[:, SHEAR] = (shear * others).T
    mean = diagonal.mean(axis=0)
    off_mean = np.minimum(2.0 * shear**2, 1.5 * normal**2)
    of_mean = np.maximum(normal**2 - 2.0 / 3.0 * off_mean, 0.0)
    drawn[:, NORMAL] = (np.sqrt(off_mean) * (diagonal - mean) + np.sqrt(3.0 * of_mean) * mean).T
    return drawn
