"""Skin: a layer at the surface of the body, darker than the tissue below it, whose thickness varies slowly."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.ndimage import binary_dilation, distance_transform_edt, gaussian_filter
from scipy.special import ndtr

from dvc.arrays import BoolArray, FloatArray
from dvc.images.depth import depth_mm
from dvc.images.image import Image, Mask

_DEPTHS_MM = np.arange(-2.0, 8.01, 0.5)  # of a profile, below the surface of the body
_THICK_MM = np.arange(0.3, 5.01, 0.1)  # tried
_SHIFTS = np.linspace(-1.0, 1.0, 17)  # tried, of the surface, in voxels
_BLUR = 0.5  # voxels, standard deviation of an edge in a profile
_WIDE_MM = 5.0  # standard deviation of the neighbourhood whose profile is fitted
_BLOCK_MM = 2.5
_VARIES_MM = 0.4  # standard deviation of the thickness over the body
_LEVEL_WEIGHT = 0.02  # of what the levels are in the whole body, as a share of a profile
_AT_ONCE = 8192  # profiles: for memory
_AWAY = 4  # voxels from the body: only air
_LEAST_DEPTHS = 5  # with values, of a profile: more than what is fitted
_LEAST_CONTRAST = 0.15  # between skin and what is below it, as a share of the brightness of the latter
_LEAST_SPREAD = 0.25  # voxels, of the border: where a voxel's centre lies is not known better from its brightness


@dataclass(frozen=True, slots=True, eq=False)
class Skin:
    """Where skin ends, below the surface of the body; all (ni, nj, nk), mm.

    Attributes
    ----------
    depth_mm
        Depth of each voxel below the surface of the body; negative outside.
    border_mm
        Depth of the inner border of skin, near each voxel.
    spread_mm
        Standard deviation of that depth.
    """

    depth_mm: FloatArray
    border_mm: FloatArray
    spread_mm: FloatArray

    @classmethod
    def of(cls, image: Image, body: Mask, without: BoolArray) -> Self | None:
        """Skin of a body, or None where the image shows no darker layer at its surface.

        The mean brightness in a neighbourhood of 5 mm (standard deviation), as a function of the depth below the
        surface, is compared with profiles of air, a layer, and what is below it, with edges as sharp as voxels show
        them. Thickness and brightness vary about those of the whole body.

        Parameters
        ----------
        image : Image
            Without its bias field.
        body : Mask
            On the image's grid.
        without : (ni, nj, nk) bool
            Voxels that are left out: those without a value, and bone, which is as dark as skin and may lie close
            below it.
        """
        spacing = image.grid.spacing_mm
        depth = depth_mm(body.inside, spacing)
        outside = ~binary_dilation(body.inside, iterations=_AWAY) & ~without
        profiles = _Profiles.of(image, depth, ~without)
        voxel = float(spacing.mean())
        values, weights = profiles.pooled()
        if not outside.any() or np.count_nonzero(weights) < _LEAST_DEPTHS:
            return None  # the image shows no surface
        air = float(np.median(image.values[outside]))
        whole = _fitted(values - air, weights, voxel, None)
        skin, below = whole.levels[0]
        if not _LEAST_CONTRAST * below < below - skin < below:
            return None
        values, weights = profiles.smoothed()
        local = _fitted(values - air, weights, voxel, whole)
        border, spread = (profiles.at_voxels(one, image.grid.shape) for one in (local.border_mm, local.spread_mm))
        return cls(depth, border, np.hypot(spread, _LEAST_SPREAD * voxel))

    @property
    def probability(self) -> FloatArray:
        """Probability (ni, nj, nk) that a voxel is less deep than the border; 1 outside the body."""
        return np.asarray(ndtr((self.border_mm - self.depth_mm) / self.spread_mm))


@dataclass(frozen=True, slots=True, eq=False)
class _Profiles:
    """Sums of brightness, and how many voxels, by depth in blocks of voxels: (i, j, k, depths)."""

    sums: FloatArray
    counts: FloatArray
    block: tuple[int, ...]  # voxels of a block along each axis
    spacing_mm: FloatArray

    @classmethod
    def of(cls, image: Image, depth: FloatArray, known: BoolArray) -> Self:
        """Profiles of the voxels that are known; each counts for the two depths beside its own, by its distance."""
        spacing, step = image.grid.spacing_mm, _DEPTHS_MM[1] - _DEPTHS_MM[0]
        block = tuple(int(max(1, round(_BLOCK_MM / s))) for s in spacing)
        shape = tuple(-(-n // b) for n, b in zip(image.grid.shape, block, strict=True))
        near = np.argwhere(known & (depth > _DEPTHS_MM[0]) & (depth < _DEPTHS_MM[-1]))
        place = np.ravel_multi_index(tuple((near // block).T), shape)
        at = (depth[tuple(near.T)] - _DEPTHS_MM[0]) / step
        first = at.astype(np.int64)
        values = image.values[tuple(near.T)].astype(np.float64)
        size, many = int(np.prod(shape)), len(_DEPTHS_MM)
        sums, counts = np.zeros(size * many), np.zeros(size * many)
        for bin_, share in ((first, 1.0 - (at - first)), (first + 1, at - first)):
            index = place * many + bin_
            counts += np.bincount(index, share, size * many)
            sums += np.bincount(index, share * values, size * many)
        return cls(sums.reshape(*shape, many), counts.reshape(*shape, many), block, spacing)

    def pooled(self) -> tuple[FloatArray, FloatArray]:
        """The one profile of all blocks (1, depths), and its weights."""
        sums, counts = (one.reshape(-1, len(_DEPTHS_MM)).sum(axis=0) for one in (self.sums, self.counts))
        return _profile(sums[None], counts[None])

    def smoothed(self) -> tuple[FloatArray, FloatArray]:
        """The profile around each block (blocks, depths), and its weights."""
        sigma = (*(_WIDE_MM / (np.array(self.block) * self.spacing_mm)), 0.0)
        both = (gaussian_filter(one, sigma, mode="constant", truncate=3.0) for one in (self.sums, self.counts))
        seen = self.counts.any(axis=-1, keepdims=True)
        return _profile(*((one * seen).reshape(-1, len(_DEPTHS_MM)) for one in both))

    def at_voxels(self, values: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Values of blocks (n,), NaN where there are none, at voxels; each block has that of the nearest with one."""
        blocks = values.reshape(self.counts.shape[:3])
        lacking = np.isnan(blocks)
        size = np.array(self.block) * self.spacing_mm
        nearest = distance_transform_edt(lacking, sampling=size, return_distances=False, return_indices=True)
        filled = blocks[tuple(nearest)]
        for n, b in zip(shape, self.block, strict=True):  # linear along one axis, which goes last, after the other
            count = filled.shape[0]
            at = np.clip((np.arange(n) - 0.5 * (b - 1)) / b, 0.0, count - 1.0)
            weights = np.maximum(0.0, 1.0 - np.abs(at[:, None] - np.arange(count)))
            filled = np.tensordot(filled, weights, axes=(0, 1))
        return np.asarray(filled)


def _profile(sums: FloatArray, counts: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean brightness by depth, and weights from 0 to 1: less where few voxels have that depth."""
    typical = counts.max(axis=1, keepdims=True)
    weights = np.where(typical > 1e-3, counts / (counts + 0.1 * np.maximum(typical, 1e-3)), 0.0)
    return np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0.0), weights


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    border_mm: FloatArray  # (n,), NaN where a profile has no values
    spread_mm: FloatArray
    thickness_mm: FloatArray
    levels: FloatArray  # (n, 2), of skin and of what is below it, above the air


def _fitted(values: FloatArray, weights: FloatArray, voxel_mm: float, whole: "_Fit | None") -> _Fit:
    """Fit profiles (n, depths) above the air: mean over the thicknesses tried, by how likely they are."""
    known = (weights > 0.0).sum(axis=1) >= _LEAST_DEPTHS
    y, w = values[known], weights[known]
    parts = [slice(first, first + _AT_ONCE) for first in range(0, max(1, len(y)), _AT_ONCE)]
    found = [_best_levels(y[part], w[part], voxel_mm, whole) for part in parts]
    cost, shift, *levels = (np.concatenate(each) for each in zip(*found, strict=True))
    # Where no profile fits, such as over bone close to skin, the thickness is that of the whole body.
    own = cost.min(axis=1) / max(1.0, float(w.sum(axis=1).mean()) - 4.0)
    odds = cost / (2.0 * np.maximum(own, np.median(own)) + 1e-12)[:, None]
    if whole is not None:
        odds += 0.5 * ((_THICK_MM - whole.thickness_mm[0]) / _VARIES_MM) ** 2
    likely = np.exp(odds.min(axis=1, keepdims=True) - odds)
    likely /= likely.sum(axis=1, keepdims=True)
    border = shift + _THICK_MM
    mean = (likely * border).sum(axis=1)
    spread = np.sqrt((likely * (border - mean[:, None]) ** 2).sum(axis=1))

    def everywhere(some: FloatArray) -> FloatArray:
        out = np.full(len(values), np.nan)
        out[known] = some
        return out

    thickness = likely @ _THICK_MM
    best = np.stack([(likely * level).sum(axis=1) for level in levels], axis=-1)
    return _Fit(everywhere(mean), everywhere(spread), everywhere(thickness), best)


def _best_levels(
    y: FloatArray, w: FloatArray, voxel_mm: float, whole: "_Fit | None"
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The best shift of the surface for each profile (n, depths) and each thickness that is tried, (n, thicknesses).

    Cost (sum of squares, of brightness), shift (mm), and the brightness of skin and of what is below it.
    """
    wy, cost = w * y, np.full((len(y), len(_THICK_MM)), np.inf)
    shift, level_of_skin, level_below = (np.zeros(cost.shape) for _ in range(3))
    usual, hold = (np.zeros(2), 1e-6) if whole is None else (whole.levels[0], _LEVEL_WEIGHT)
    total = np.einsum("nd,nd->n", wy, y)[:, None] + hold * (usual @ usual)
    for e in _SHIFTS * voxel_mm:
        # Normal equations of the two levels, for all profiles and thicknesses at once.
        depths = _DEPTHS_MM[:, None] - e
        b = ndtr((depths - _THICK_MM) / (_BLUR * voxel_mm))
        a = ndtr(depths / (_BLUR * voxel_mm)) - b
        aa, ab, bb, ya, yb = w @ a**2 + hold, w @ (a * b), w @ b**2 + hold, wy @ a, wy @ b
        ya += hold * usual[0]
        yb += hold * usual[1]
        determinant = aa * bb - ab**2
        skin, below = (bb * ya - ab * yb) / determinant, (aa * yb - ab * ya) / determinant
        left = total - skin * ya - below * yb
        better = left < cost
        for kept, new in ((cost, left), (shift, e), (level_of_skin, skin), (level_below, below)):
            np.copyto(kept, new, where=better)
    return cost, shift, level_of_skin, level_below
