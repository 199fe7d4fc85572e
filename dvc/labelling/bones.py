"""Bones: what is bright inside a dark rim, apart from the other tissue."""

import numpy as np
from scipy.ndimage import binary_fill_holes, distance_transform_edt, gaussian_filter, label
from skimage.segmentation import watershed

from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray

_BLUR_MM = 0.5
_CORE_MM = 1.2  # from what is dark, and more than a slice: narrower gaps in a rim do not join bone and soft tissue
_LEAST_ML = 0.3
_RIM_MM = 1.5  # thickness of a dark rim beyond its darkest part, at most


def bones_in(values: Float32Array, where: BoolArray, dark: float, spacing_mm: FloatArray) -> IntArray:
    """Bones with bright marrow in soft tissue, numbered from 1; 0 elsewhere, (ni, nj, nk).

    Their cores are the parts, 0.3 mL or more, that a dark rim separates from the largest. From the cores and the
    largest part, regions grow until they meet in the darkest part of the rim; the bones then get the rest of it.

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
    blurred = gaussian_filter(values, _BLUR_MM / spacing_mm)
    lit = where & (blurred > dark)
    parts, count = label(distance_transform_edt(lit, sampling=spacing_mm) > max(_CORE_MM, float(spacing_mm.max())))
    sizes_ml = np.bincount(parts.ravel(), minlength=count + 1) * float(np.prod(spacing_mm)) / 1000.0
    sizes_ml[0] = 0.0
    large = np.flatnonzero(sizes_ml >= _LEAST_ML)
    bones = np.zeros(where.shape, dtype=np.int64)
    if large.size < 2:
        return bones
    numbers = np.zeros(count + 1, dtype=np.int64)
    numbers[large[np.argsort(-sizes_ml[large])]] = np.arange(1, large.size + 1)  # 1 is the soft tissue
    regions = watershed(-blurred, numbers[parts], mask=where)
    inner = regions > 1
    away, nearest = distance_transform_edt(~inner, sampling=spacing_mm, return_indices=True)
    rim = where & ~lit & (away <= _RIM_MM)
    bones = np.where(inner | rim, regions[tuple(nearest)] - 1, 0)
    holes = binary_fill_holes(bones > 0) & where & (bones == 0)
    bones[holes] = regions[tuple(nearest)][holes] - 1
    return np.asarray(bones, dtype=np.int64)
