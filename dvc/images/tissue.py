"""Where the body is: a tissue mask made from the image, and masks widened in space."""

import numpy as np
from scipy.ndimage import binary_opening, label
from skimage.filters import threshold_otsu

from dvc.arrays import BoolArray, FloatArray, IntArray, frozen
from dvc.compiled import njit
from dvc.errors import InputError
from dvc.images.image import Image, Mask, box_of
from dvc.images.once import once_an_image
from dvc.images.resample import fill_missing, smoothed

_BLUR_MM = 1.0
_CLOSE_MM = 4.0


@once_an_image
def tissue_mask(image: Image) -> Mask:
    """The body in an MR image: largest bright part, closed over dark bone and septa, holes filled.

    Threshold: half of Otsu's on the image blurred by 1 mm. Otsu's own value separates fat from muscle rather than
    tissue from air; half of it lies above the noise of the air and below muscle.

    Raises
    ------
    InputError
        If that is less than 1 % or more than 99 % of the image: a mask has to be given then.
    """
    bright = bright_voxels(image)
    radius = np.maximum(np.rint(_CLOSE_MM / image.grid.spacing_mm / 2.0).astype(int), 0)
    closed = _closed(binary_opening(bright, structure=_ellipsoid(np.minimum(radius, 1))), radius)
    parts, count = label(closed)
    if count:
        closed = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
    filled = _filled(closed, (0, 1, 2))
    for plane in ((1, 2), (0, 2), (0, 1)):  # bone that runs out of the image is open in space only
        filled = _filled(filled, plane)
    if not 0.01 <= (share := float(filled.mean())) <= 0.99:
        taken = f"the intensity threshold selects {100 * share:.1f} % of the image"
        raise InputError(
            f"The body could not be separated from air: {taken}. Give a mask of the body, `tissue` (--tissue on the "
            "command line)."
        )
    return Mask(image.grid, filled)


@once_an_image
def bright_voxels(image: Image) -> BoolArray:
    """Voxels that are not air: above half of Otsu's threshold on the image blurred by 1 mm, (ni, nj, nk)."""
    blurred = smoothed(fill_missing(image), _BLUR_MM).values.astype(np.float64)  # bins narrower than float32 can tell
    low = float(np.percentile(blurred, 1.0))
    return frozen(blurred > low + 0.5 * (threshold_otsu(blurred) - low), np.bool_)


def widened(mask: Mask, margin_mm: float) -> Mask:
    """The mask and all voxels within ``margin_mm`` of it."""
    return Mask(mask.grid, within(mask.inside, mask.grid.spacing_mm, margin_mm))


def within(inside: BoolArray, spacing_mm: FloatArray, margin_mm: float) -> BoolArray:
    """Voxels (ni, nj, nk) whose centres lie within a distance of the centre of one that is inside.

    Exact, by the squares of distances along one axis after the other (T. Saito and J. Toriwaki 1994,
    doi:10.1016/0031-3203(94)90133-3); for margins of a few voxels faster than a distance transform.
    """
    reach = [int(margin_mm / spacing + 1e-9) for spacing in spacing_mm]
    near = np.zeros(inside.shape, dtype=bool)
    box = box_of(inside, reach)
    squares = np.where(inside[box], 0.0, np.inf)  # of the distance along the axes that were looked along, mm2
    for axis, (spacing, steps) in enumerate(zip(spacing_mm, reach, strict=True)):
        nearer = np.empty_like(squares)
        away = (np.arange(1, steps + 1) * spacing) ** 2
        _nearer(np.moveaxis(squares, axis, 0), away, np.moveaxis(nearer, axis, 0))
        squares = nearer
    near[box] = np.sqrt(squares) <= margin_mm
    return near


@njit(cache=True)
def _nearer(squares: FloatArray, away: FloatArray, nearer: FloatArray) -> None:
    """The least of each value and of those so many places before and after it along the first axis, plus ``away``."""
    n = squares.shape[0]
    for j in range(squares.shape[1]):
        for i in range(n):
            here, onto = squares[i, j], nearer[i, j]
            for k in range(squares.shape[2]):
                onto[k] = here[k]
            for d in range(1, len(away) + 1):
                for other in (i - d, i + d):
                    if 0 <= other < n:
                        there = squares[other, j]
                        for k in range(squares.shape[2]):
                            onto[k] = min(onto[k], there[k] + away[d - 1])


def _closed(mask: BoolArray, radius: IntArray) -> BoolArray:
    """Closing by an ellipsoid of radii in voxels; the mask goes on beyond its ends as it is there."""
    padded = np.pad(mask, [(int(r), int(r)) for r in radius], mode="edge")
    inner = tuple(slice(int(r), int(r) + n) for r, n in zip(radius, mask.shape, strict=True))
    offsets = np.argwhere(_ellipsoid(radius)) - radius
    return np.asarray(~_grown(~_grown(padded, offsets), offsets)[inner])


@njit(cache=True)
def _grown(inside: BoolArray, offsets: IntArray) -> BoolArray:
    """Dilation by a convex structure, given as offsets: laid at the voxels of the surface alone, which are few."""
    ni, nj, nk = inside.shape
    out = inside.copy()
    for i in range(ni):
        for j in range(nj):
            for k in range(nk):
                if not inside[i, j, k] or (
                    inside[max(i - 1, 0), j, k]
                    and inside[min(i + 1, ni - 1), j, k]
                    and inside[i, max(j - 1, 0), k]
                    and inside[i, min(j + 1, nj - 1), k]
                    and inside[i, j, max(k - 1, 0)]
                    and inside[i, j, min(k + 1, nk - 1)]
                ):
                    continue
                for n in range(len(offsets)):
                    a, b, c = i + offsets[n, 0], j + offsets[n, 1], k + offsets[n, 2]
                    if 0 <= a < ni and 0 <= b < nj and 0 <= c < nk:
                        out[a, b, c] = True
    return out


def _ellipsoid(radius: IntArray) -> BoolArray:
    axes = [np.arange(-int(r), int(r) + 1) / max(float(r), 0.5) for r in radius]
    i, j, k = np.ix_(*axes)
    return np.asarray(i**2 + j**2 + k**2 <= 1.0 + 1e-9)


def _filled(inside: BoolArray, axes: tuple[int, ...]) -> BoolArray:
    """The mask and its holes: what is outside it, and joined along these axes to none of the image's ends on them."""
    joined = np.zeros((3, 3, 3), dtype=bool)
    for axis in axes:
        np.moveaxis(joined, axis, 0)[:, 1, 1] = True
    parts, count = label(~inside, joined)
    opened = np.zeros(count + 1, dtype=bool)
    for axis in axes:
        for end in (0, -1):
            opened[np.take(parts, end, axis)] = True
    opened[0] = False  # the mask itself
    return np.asarray(~opened[parts])
