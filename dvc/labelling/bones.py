"""Bones: what is bright inside a dark rim, apart from the other tissue."""

import numpy as np
from scipy.ndimage import binary_fill_holes, distance_transform_edt, gaussian_filter, label, median
from skimage.segmentation import watershed

from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray
from dvc.images.image import box_of
from dvc.images.tissue import within

_BLUR_MM = 0.5
_CORE_MM = 2.5  # from what is dark, and more than a slice: narrower gaps in a rim do not join bone and soft tissue
_LEAST_ML = 0.1  # of a core
# Limits of what is dark that are tried, over the one given: voxels as wide as a rim mix it with its bright sides, so a
# gap in it lets bone run into soft tissue. Under the last, dim muscle counts as dark, and fat in it has a closed rim,
# but one that is not as dark as the limit given; at least this share of a bone's rim is.
_LIMITS, _DARK_SHARE = (1.0, 1.2, 1.3), 0.6
_MORE = 1.1  # times what is known of a bone, for it to get what a brighter limit finds there
_RIM_MM = 1.5  # thickness of a dark rim beyond its darkest part, at most
_DARK_RIM = 0.6  # brightness of a rim over that of its darker side: nearly all bones below, soft tissue from .62 on


def bones_in(values: Float32Array, where: BoolArray, dark: float, spacing_mm: FloatArray) -> IntArray:
    """Bones with bright marrow in soft tissue, numbered from 1; 0 elsewhere, (ni, nj, nk).

    Their cores are parts, 0.1 mL or more, that lie 2.5 mm or more from what is dark. From the cores regions grow until
    they meet in the darkest places. The largest is the soft tissue; others are bones if the border where they meet
    their neighbours is dark, and soft tissue if it is not. Where voxels are as wide as a rim, it has gaps; what a
    brighter limit of what is dark gives there is added. The bones then get the rest of their rim.

    Parameters
    ----------
    values : (ni, nj, nk)
        Image without its bias field.
    where : (ni, nj, nk) bool
        Voxels to look at: the body without its skin and without a bone that is known.
    dark : float
        Brightness below which tissue is dark, such as cortical bone.
    spacing_mm : (3,)
        Voxel size.
    """
    bones, box = np.zeros(where.shape, dtype=np.int64), box_of(where, (1, 1, 1))
    if where.any():
        bones[box] = _bones(gaussian_filter(values, _BLUR_MM / spacing_mm)[box], where[box], dark, spacing_mm)
    return bones


def _bones(blurred: Float32Array, where: BoolArray, dark: float, spacing_mm: FloatArray) -> IntArray:
    """`bones_in` of what is blurred already, in a box around what is looked at."""
    found = np.zeros(where.shape, dtype=np.int64)
    for limit in _LIMITS:
        _add(found, _inner_bones(blurred, where, limit * dark, dark, spacing_mm))
    if not found.any():
        return found
    away, nearest = distance_transform_edt(found == 0, sampling=spacing_mm, return_indices=True)
    rim = where & (blurred <= dark) & (away <= _RIM_MM)
    bones = np.where((found > 0) | rim, found[tuple(nearest)], 0)
    holes = binary_fill_holes(bones > 0) & where & (bones == 0)
    bones[holes] = found[tuple(nearest)][holes]
    return np.asarray(bones, dtype=np.int64)


def _add(found: IntArray, others: IntArray) -> None:
    """Add bones where none was found yet, and to those of which others hold clearly more."""
    for number in range(1, int(others.max()) + 1):
        inside = others == number
        known = np.bincount(found[inside])
        known[0] = 0
        own = int(known.argmax())
        if np.count_nonzero(inside) > _MORE * known.sum():
            found[inside & (found == 0)] = own or found.max() + 1


def _inner_bones(
    blurred: Float32Array, where: BoolArray, limit: float, dark: float, spacing_mm: FloatArray
) -> IntArray:
    """Bones up to the darkest places of their rims, numbered from 1; 0 elsewhere."""
    lit = where & (blurred > limit)
    parts, count = label(lit & ~within(~lit, spacing_mm, max(_CORE_MM, float(spacing_mm.max()))))
    sizes_ml = np.bincount(parts.ravel(), minlength=count + 1) * float(np.prod(spacing_mm)) / 1000.0
    sizes_ml[0] = 0.0
    large = np.flatnonzero(sizes_ml >= _LEAST_ML)
    if large.size < 2:
        return np.zeros(where.shape, dtype=np.int64)
    numbers = np.zeros(count + 1, dtype=np.int64)
    numbers[large[np.argsort(-sizes_ml[large])]] = np.arange(1, large.size + 1)  # 1 is the soft tissue
    regions = watershed(-blurred, numbers[parts], mask=where)
    brightness, share = _rims(regions, blurred, dark)
    is_bone = (brightness < _DARK_RIM) & (share > _DARK_SHARE)
    is_bone[:2] = False
    return np.asarray(np.where(is_bone, np.cumsum(is_bone), 0)[regions], dtype=np.int64)


def _rims(regions: IntArray, values: Float32Array, dark: float) -> tuple[FloatArray, FloatArray]:
    """Rims, where regions meet: mean brightness over the median of the darker of the two, and the share that is dark.

    By the number of the region; infinite and 0 for one that meets no other.
    """
    count = int(regions.max()) + 1
    inside = regions > 0
    usual = np.concatenate([[np.inf], median(values[inside], regions[inside], np.arange(1, count))])
    total, faces, dim = np.zeros((3, count))
    for axis in range(regions.ndim):
        one, other = np.moveaxis(regions, axis, 0)[1:], np.moveaxis(regions, axis, 0)[:-1]
        at = (one != other) & (one > 0) & (other > 0)
        lines = np.moveaxis(values, axis, 0)
        sides, lowest = (one[at], other[at]), np.minimum(lines[1:][at], lines[:-1][at])
        shade = lowest / np.minimum(usual[sides[0]], usual[sides[1]])
        for side in sides:
            total += np.bincount(side, shade, count)
            dim += np.bincount(side, lowest < dark, count)
            faces += np.bincount(side, minlength=count)
    meets = np.maximum(faces, 1)
    return np.where(faces > 0, total / meets, np.inf), dim / meets
