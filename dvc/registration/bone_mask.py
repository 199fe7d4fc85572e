"""Whether a bone mask lies on the bone: its surface must follow an edge of the image, better than its mirror images.

A mask that was written in another frame (RAS read as LPS) or with a flipped axis may still cover half of the bone. The
alignment then follows soft tissue, and a strain that looks sound is measured relative to it.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np
from scipy import fft
from scipy.ndimage import distance_transform_edt

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.images.filters import gaussian
from dvc.images.image import Image, Mask
from dvc.images.resample import fill_missing

_BLUR_MM, _LEAST_BLUR = 1.0, 0.5  # of the gradient: mm, and voxels
_ENDS = 2  # voxels along the image's ends are left out: no gradient is known there
_EDGE = 0.75  # of the largest voxel edge: voxels nearer than that to the surface are its edge
_NEAR_MM = 2.5, 6.0  # distances of the voxels that it is compared with
_BETTER = 1.2  # on heels, mirror images have at most 0.87 times the sharpness of a right mask
_FOLLOWS = 1.2  # right masks of heels have 2.0 and more, those a voxel off 1.6 and more (benchmarks.bone_masks)
_CLEAR = 2.0  # a mask that follows an edge so well is not looked for elsewhere; those 5 mm off have 1.54 at the most
_LIES = 1.3  # a right mask that was mirrored has more where it belongs
_THICKEST_MM = 2.5  # across thicker slices, an edge is as wide as what it is compared with
_FROM_AIR_MM = 3.0
_SHIFTS_MM = 2.5, 12.0  # shifts that are looked for; masks a voxel too large or small fit best up to 1.8 mm away
_SHIFTED = 1.25  # times the sharpness of the mask as given: right masks have at most 1.03, those 3 mm off 1.28 and more
# Right masks of heels have 1.74 and more, also where they belong if they are beside it; those 3 mm too large have at
# most 1.27 anywhere.
_RIGHT, _FITS = 1.7, 1.5
_AS_SHARP, _ALIKE = 0.97, 0.95  # of the sharpest: the nearest such shift is told, if such shifts have one direction
_AS_FAR, _ONE_WAY = 1.5, 0.7  # times the shortest; length of the mean of their unit vectors
_STRONG = 0.95  # quantile of the gradient, above which all edges count alike
_SEEN = 0.8  # of the surface away from air and from the ends of the image
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
    moved = "" if follows >= _CLEAR else _shifted(*nearest_edges(gradient, bone, body))
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
        edgeless = follows < _FOLLOWS and image.grid.spacing_mm.max() <= _THICKEST_MM
        return moved or (_edgeless(follows) if edgeless else "")
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


def _shifted(given: float, best: float, shift_mm: FloatArray) -> str:
    if not (given < _RIGHT and best >= _FITS and best >= _SHIFTED * given) or np.linalg.norm(shift_mm) < _SHIFTS_MM[0]:
        return ""
    along = ", ".join(f"{step + 0.0:.1f}" for step in np.round(shift_mm, 1))
    return (
        f"The bone mask may be off: moved by {np.linalg.norm(shift_mm):.0f} mm (LPS: {along}), its surface would "
        f"follow the edges of the unloaded image better (sharpness {best:.2f} instead of {given:.2f}). Check it on the "
        "unloaded image."
    )


def nearest_edges(gradient: Float32Array, bone: Mask, body: Mask) -> tuple[float, float, FloatArray]:
    """Sharpness of a mask as given, that of the same mask where it is sharpest, and the shift to there (3,), LPS mm.

    Shifts of up to 12 mm are compared; of those that are about as sharp, the shortest is given. It is zero if they have
    no common direction, as of a thick cortex, whose inner edge the mask meets wherever it goes. Here the sharpness is a
    ratio of means of the gradient of the image (ni, nj, nk), per mm, on the grid of the masks, strong edges counting
    alike, more than 3 mm inside the body; NaN without a surface there. The sums for all shifts are one convolution.
    """
    grid, edges = bone.grid, bone.grid.spacing_mm
    if not bone.inside.any():
        return float("nan"), float("nan"), np.zeros(3)
    box = bone.box(int(np.ceil((_NEAR_MM[1] + _SHIFTS_MM[1]) / edges.min())) + 1)
    tissue = (body.inside | bone.inside)[box]
    deep = tissue if tissue.all() else distance_transform_edt(tissue, edges) > _FROM_AIR_MM
    if not deep.any():
        return float("nan"), float("nan"), np.zeros(3)
    values = gradient[box]
    values = np.where(deep, np.minimum(values, np.quantile(values[deep], _STRONG)), 0.0).astype(np.float32)
    at, near = _surface(bone.inside[box], edges)
    room = [
        fft.next_fast_len(n + int(np.ceil(_SHIFTS_MM[1] / e)), real=True) for n, e in zip(at.shape, edges, strict=True)
    ]

    def transformed(array: Float32Array | BoolArray) -> FloatArray:
        return np.asarray(fft.rfftn(array.astype(np.float32), room))

    seen = [transformed(values), transformed(deep)]
    sums = [[fft.irfftn(of * np.conj(transformed(where)), room) for of in seen] for where in (at, near)]
    (strength, count), (beside, others) = sums
    steps = np.meshgrid(*(fft.fftfreq(n, 1.0 / n) * e for n, e in zip(room, edges, strict=True)), indexing="ij")
    enough = (count > _SEEN * np.count_nonzero(at & deep)) & (others > 0.5) & (beside > 0.0)
    enough &= np.sqrt(np.sum(np.square(steps), axis=0)) <= _SHIFTS_MM[1]
    with np.errstate(divide="ignore", invalid="ignore"):
        sharpness = np.where(enough, strength / count * others / beside, 0.0)
    found, far_mm = float(sharpness.max()), np.sqrt(np.sum(np.square(steps), axis=0))
    best = np.unravel_index(np.argmin(np.where(sharpness >= _AS_SHARP * found, far_mm, np.inf)), sharpness.shape)
    alike = (sharpness >= _ALIKE * found) & (far_mm <= _AS_FAR * far_mm[best]) & (far_mm > 0.0)
    ways = np.mean([along[alike] / far_mm[alike] for along in steps], axis=1) if alike.any() else np.zeros(3)
    shift = grid.direction @ [float(along[best]) for along in steps]
    one_way = np.linalg.norm(ways) >= _ONE_WAY
    given = float(sharpness[0, 0, 0]) if enough[0, 0, 0] else float("nan")
    return given, float(sharpness[best]), np.asarray(shift if one_way else np.zeros(3))


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
    at, near = _surface(bone.inside[box], edges)
    if where is not None:
        at, near = at & where[box], near & where[box]
    return [_contrast(gradient[box], at, near) for gradient in gradients]


def _surface(inside: BoolArray, edges: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Voxels at the surface of a mask, and those that it is compared with."""
    depth = distance_transform_edt(inside, edges) + distance_transform_edt(~inside, edges) - 0.5 * edges.min()
    return depth <= _EDGE * edges.max(), (depth > _NEAR_MM[0]) & (depth <= _NEAR_MM[1])


def _contrast(gradient: Float32Array, at: BoolArray, near: BoolArray) -> float:
    """Median of a gradient at a surface over that near it; NaN where no voxel is at or near it."""
    if not (at.any() and near.any()):
        return float("nan")
    beside = float(np.median(gradient[near]))
    return float(np.median(gradient[at])) / beside if beside > 0.0 else 0.0
