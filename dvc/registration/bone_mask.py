"""Whether a bone mask lies on the bone: its surface must follow an edge of the image, better than its mirror images.

A mask that was written in another frame (RAS read as LPS) or with a flipped axis may still cover half of the bone. The
alignment then follows soft tissue, and a strain that looks sound is measured relative to it.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy.ndimage import distance_transform_edt

from dvc.arrays import BoolArray, Float32Array
from dvc.images.filters import gaussian
from dvc.images.image import Image, Mask
from dvc.images.resample import fill_missing

_BLUR_MM, _LEAST_BLUR = 1.0, 0.5  # of the gradient: mm, and voxels
_ENDS = 2  # voxels along the image's ends are left out: no gradient is known there
_EDGE = 0.75  # of the largest voxel edge: voxels nearer than that to the surface are its edge
_NEAR_MM = 2.5, 6.0  # distances of the voxels that it is compared with
_BETTER = 1.2  # on heels, mirror images have at most 0.87 times the sharpness of a right mask
_FOLLOWS = 1.2  # right masks of heels have 2.0 and more, those a voxel off 1.6 and more (benchmarks.bone_masks)
_LIES = 1.3  # a right mask that was mirrored has more where it belongs
_THICKEST_MM = 2.5  # across thicker slices, an edge is as wide as what it is compared with
_FROM_AIR_MM = 3.0
_MORE = 1.02  # times the sharpest of those about the image's middle, one of which it is where the origin lies there
_LEAST, _MOSTLY = 500, 0.5  # voxels of the mask, and the fraction of them that lies on the image in the other frame
_TO_THE_OTHER = np.array([-1.0, -1.0, 1.0])
_AXES = ("first", "second", "third")


def mask_doubt(image: Image, bone: Mask, body: Mask) -> str:
    """Why the mask may not lie on the bone, in a sentence; empty where its surface follows an edge of the image.

    The masks are on the image's grid; the surface of the body is no edge of bone. The sharpness of a mask is the median
    of the image's gradient at its surface, over that 2.5 to 6 mm inside and outside of it. Mirror images are those
    along the voxel axes, about the image's middle, and that with the signs of L and P reversed, as of a mask in RAS
    that was read as LPS.
    """
    gradient = _gradient(image)
    follows = _inner_sharpness(gradient, bone, body)
    i, j, k = (slice(_ENDS, n - _ENDS) for n in image.grid.shape)
    gradient, bone = gradient[i, j, k], Mask(bone.grid.part((i, j, k)), bone.inside[i, j, k])
    if not bone.inside.any() or bone.inside.all():
        return ""
    # A mask on the mirrored image is as sharp as the mirrored mask on the image.
    flips = [tuple(slice(None, None, way) for way in flip) for flip in product((1, -1), repeat=3)]
    own, *of_flips = _sharpness(bone, [gradient[flip] for flip in flips])
    found = dict(zip(map(_named, flips[1:]), of_flips, strict=True))
    other, count = _in_the_other_frame(bone), np.count_nonzero(bone.inside)
    if count >= _LEAST and np.count_nonzero(other.inside) >= _MOSTLY * count:
        (sharpness,) = _sharpness(other, [gradient])
        if sharpness > _MORE * max(of_flips):
            found["with the signs of L and P reversed"] = sharpness
    best = max(found, key=lambda how: np.nan_to_num(found[how]))
    if not found[best] > max(_BETTER * own, _LIES):
        return _edgeless(follows) if follows < _FOLLOWS and image.grid.spacing_mm.max() <= _THICKEST_MM else ""
    return (
        f"The bone mask may be mirrored or in another frame (RAS for LPS): {best}, its surface would follow the edges "
        f"of the unloaded image better (sharpness {found[best]:.2f} instead of {own:.2f}). Check it on the unloaded "
        "image."
    )


def _edgeless(sharpness: float) -> str:
    return (
        "The surface of the bone mask follows no edge inside the unloaded image, as that of a bone does (sharpness "
        f"{sharpness:.2f}; use with care below {_FOLLOWS:g}). The mask may be shifted, too large, or not that of a "
        "bone. Check it on the unloaded image."
    )


def edge_sharpness(image: Image, bone: Mask, body: Mask) -> float:
    """Median gradient of an image at the surface of a bone mask, over that 2.5 to 6 mm from it.

    The masks are on its grid. Only the surface more than 3 mm inside the body counts; NaN if there is none.
    """
    return _inner_sharpness(_gradient(image), bone, body)


def _inner_sharpness(gradient: Float32Array, bone: Mask, body: Mask) -> float:
    """Sharpness of a mask on an image of such a gradient, away from the surface of the body."""
    if not bone.inside.any():
        return float("nan")
    edges = bone.grid.spacing_mm
    box = bone.box(int(np.ceil((_NEAR_MM[1] + _FROM_AIR_MM) / edges.min())) + 1)
    tissue = (body.inside | bone.inside)[box]
    deep = tissue if tissue.all() else distance_transform_edt(tissue, edges) > _FROM_AIR_MM
    return _sharpness(Mask(bone.grid.part(box), bone.inside[box]), [gradient[box]], deep)[0]


def _named(flip: tuple[slice, ...]) -> str:
    axes = " and ".join(name for name, way in zip(_AXES, flip, strict=True) if way.step < 0)
    return f"mirrored along the {axes} voxel axis"


def _in_the_other_frame(bone: Mask) -> Mask:
    """The mask with the signs of L and P reversed, as far as it lies on its grid."""
    grid, inside = bone.grid, np.zeros(bone.grid.shape, dtype=bool)
    there = np.rint(grid.indices_of(bone.points() * _TO_THE_OTHER)).astype(np.int64)
    low, high = np.maximum(there.min(axis=0), 0), np.minimum(there.max(axis=0) + 1, grid.shape)
    if (high > low).all():
        i, j, k = (slice(*ends) for ends in zip(low.tolist(), high.tolist(), strict=True))
        points = grid.part((i, j, k)).points() * _TO_THE_OTHER
        at = np.clip(np.rint(grid.indices_of(points)).astype(np.int64), 0, np.array(grid.shape) - 1)
        inside[i, j, k] = bone.inside[tuple(np.moveaxis(at, -1, 0))] & grid.contains(points)
    return Mask(grid, inside)


def _gradient(image: Image) -> Float32Array:
    """Magnitude of the gradient of an image, per mm: where voxels are long, all edges across them count alike."""
    spacing, values = image.grid.spacing_mm, fill_missing(image).values.astype(np.float32)
    blur = np.maximum(_BLUR_MM / spacing, _LEAST_BLUR)
    squared = np.zeros_like(values)
    for edge, order in zip(spacing, np.eye(3, dtype=int), strict=True):
        squared += (gaussian(values, blur, order=order) / np.float32(edge)) ** 2
    return np.sqrt(squared)


def _sharpness(bone: Mask, gradients: Sequence[Float32Array], where: BoolArray | None = None) -> list[float]:
    """Sharpness of a mask on images of such gradients, on its grid; ``where`` voxels count."""
    edges = bone.grid.spacing_mm
    box = bone.box(int(np.ceil(_NEAR_MM[1] / edges.min())) + 1)
    inside = bone.inside[box]
    depth = distance_transform_edt(inside, edges) + distance_transform_edt(~inside, edges) - 0.5 * edges.min()
    at, near = depth <= _EDGE * edges.max(), (depth > _NEAR_MM[0]) & (depth <= _NEAR_MM[1])
    if where is not None:
        at, near = at & where[box], near & where[box]
    return [_contrast(gradient[box], at, near) for gradient in gradients]


def _contrast(gradient: Float32Array, at: BoolArray, near: BoolArray) -> float:
    """Median of a gradient at a surface over that near it; NaN where no voxel is at or near it."""
    if not (at.any() and near.any()):
        return float("nan")
    beside = float(np.median(gradient[near]))
    return float(np.median(gradient[at])) / beside if beside > 0.0 else 0.0
