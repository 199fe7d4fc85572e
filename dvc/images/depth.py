"""Distances from the border of a mask: of voxels' faces, or finer than its voxels."""

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt
from scipy.special import ndtri

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.images.filters import gaussian
from dvc.images.image import box_of

_BLUR = 1.0  # voxels: a border of voxels' faces becomes a smooth one
_SURE = 0.03  # of the blurred mask: between that and its complement the border's distance is read off
_NEAR = 1.0  # voxels
_EVEN = 0.7  # voxels
_BESIDE = 8  # voxels around masks that are compared
_LEAST_MM = 0.05  # every voxel stays on its own side of the border
NUMBERS = {"blur": _BLUR, "sure": _SURE, "near": _NEAR, "even": _EVEN, "least_mm": _LEAST_MM}
"""Every number that determines where a border lies, for a record."""


def depth_mm(inside: BoolArray, spacing_mm: FloatArray) -> FloatArray:
    """Signed distance (ni, nj, nk) from the border of a mask (ni, nj, nk), mm, positive inside; voxels of (3,) mm.

    The border is smooth, and not made of voxels' faces. Blurred by a Gaussian of s, a plane's mask is the normal
    distribution of the distance over s, which gives the distance near the border. Further away it is that to the
    nearest place of this border.
    """
    blurred = gaussian(inside.astype(np.float64), _BLUR, "nearest")
    sure = (blurred > _SURE) & (blurred < 1.0 - _SURE)
    normal = np.stack([np.gradient(blurred, h, axis=axis)[sure] for axis, h in enumerate(spacing_mm)], axis=-1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    voxel_mm = np.linalg.norm(normal * spacing_mm, axis=-1)  # along the normal: far more across thick slices
    near_mm = _BLUR * voxel_mm * ndtri(blurred[sure])
    depth, nearest = np.where(inside, 1.0, -1.0), np.abs(near_mm) < _NEAR * voxel_mm
    if not nearest.any():  # one tissue fills everything
        return np.asarray(depth * float(np.linalg.norm(np.array(inside.shape) * spacing_mm)))
    seeds = np.zeros_like(inside)
    seeds[sure] = nearest
    border = np.argwhere(seeds) * spacing_mm - near_mm[nearest][:, None] * normal[nearest]
    to = distance_transform_edt(~seeds, sampling=spacing_mm, return_distances=False, return_indices=True)
    number = np.empty(inside.shape, dtype=np.int32)
    number[seeds] = np.arange(len(border))
    far = ~sure
    there, squares = number[tuple(to[:, far])], np.zeros(np.count_nonzero(far))
    for at, spacing, of in zip(np.ogrid[tuple(map(slice, inside.shape))], spacing_mm, border.T, strict=True):
        squares += (np.broadcast_to(at, inside.shape)[far] * spacing - of[there]) ** 2  # an axis at a time: less memory
    depth[far] *= np.sqrt(squares)
    depth[sure] = near_mm
    depth = gaussian(depth, _EVEN, "nearest")
    return np.asarray(np.where(inside, np.maximum(depth, _LEAST_MM), np.minimum(depth, -_LEAST_MM)))


def moved_mm(before: BoolArray, after: BoolArray, spacing_mm: FloatArray) -> tuple[float, float]:
    """Mean and root mean square of how far the border of a mask moved outward, mm; voxels of (3,) mm.

    At the voxels on either side of the border; (0, 0) if the mask has none.
    """
    box = box_of(before | after, (_BESIDE,) * 3)  # of which the image may be several times as large
    before, after = before[box], after[box]
    border = binary_dilation(before) & ~binary_erosion(before, border_value=1)
    if not border.any():
        return 0.0, 0.0
    off = (depth_mm(after, spacing_mm) - depth_mm(before, spacing_mm))[border]
    return float(off.mean()), float(np.sqrt((off**2).mean()))


def to_surface_mm(body: BoolArray, spacing_mm: FloatArray) -> Float32Array:
    """Distance (mm) of voxels' centres to the surface of a body of voxels: 0 inside it, infinite without one.

    The surface lies half an edge from the centre of a voxel that touches it.
    """
    if not body.any():
        return np.full(body.shape, np.inf, dtype=np.float32)
    touching = np.full(body.shape, np.inf, dtype=np.float32)
    for axis in range(body.ndim):
        ahead, behind = [slice(None)] * body.ndim, [slice(None)] * body.ndim
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        differs = body[tuple(ahead)] != body[tuple(behind)]
        half = np.where(differs, np.float32(0.5 * spacing_mm[axis]), np.float32(np.inf))
        for side in (tuple(ahead), tuple(behind)):
            np.minimum(touching[side], half, out=touching[side])
    touching[body] = np.inf
    at = np.isfinite(touching)
    if not at.any():
        return np.zeros(body.shape, dtype=np.float32)
    distance, nearest = distance_transform_edt(~at, sampling=spacing_mm, return_indices=True)
    return np.where(body, 0.0, distance + touching[tuple(nearest)]).astype(np.float32)
