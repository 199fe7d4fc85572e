"""Other bones: what is bright inside a dark rim, apart from the other soft tissue."""

import numpy as np
from scipy.ndimage import binary_fill_holes, distance_transform_edt, gaussian_filter, label
from skimage.segmentation import watershed

from dvc.arrays import BoolArray, Float32Array, FloatArray

_BLUR_MM = 0.5
_CORE_MM = 1.2  # from what is dark: gaps in a rim that are narrower do not join bone and soft tissue
_LEAST_ML = 0.3
_RIM_MM = 1.5  # thickness of a dark rim beyond its darkest part, at most


def other_bones(values: Float32Array, where: BoolArray, dark: float, spacing_mm: FloatArray) -> BoolArray:
    """Bones with bright marrow in soft tissue, (ni, nj, nk).

    Their cores are the parts, 0.3 mL or more, that a dark rim separates from the largest. From the cores and the
    largest part, regions grow until they meet in the darkest part of the rim; the bones then get the rest of it.

    Parameters
    ----------
    values : (ni, nj, nk)
        Image without its bias field.
    where : (ni, nj, nk) bool
        Voxels to look at: the body without its skin and without the bone that is known.
    dark : float
        Brightness below which tissue is dark, such as cortical bone.
    spacing_mm : (3,)
        Voxel size.
    """
    blurred = gaussian_filter(values, _BLUR_MM / spacing_mm)
    lit = where & (blurred > dark)
    parts, count = label(distance_transform_edt(lit, sampling=spacing_mm) > _CORE_MM)
    sizes_ml = np.bincount(parts.ravel(), minlength=count + 1) * float(np.prod(spacing_mm)) / 1000.0
    sizes_ml[0] = 0.0
    if not (sizes_ml >= _LEAST_ML).sum() > 1:
        return np.zeros(where.shape, dtype=bool)
    largest, large = int(sizes_ml.argmax()), sizes_ml >= _LEAST_ML
    cores = np.where(parts == largest, 1, np.where(large[parts], 2, 0))
    inner = watershed(-blurred, cores, mask=where) == 2
    rim = where & ~lit & (distance_transform_edt(~inner, sampling=spacing_mm) <= _RIM_MM)
    return np.asarray(binary_fill_holes(inner | rim) & where)
