"""The surface of a bone as an MR image shows it: the outer edge of its dark rim."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy.ndimage import binary_dilation, binary_fill_holes, distance_transform_edt, label, maximum

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.images.depth import depth_mm
from dvc.images.filters import TRUNCATE, gaussian
from dvc.images.image import Image, Mask
from dvc.images.resample import fill_missing
from dvc.images.tissue import within

_REACH = 2.5  # voxels, of a surface that is moved
_BLUR_MM = 0.4
_AROUND_MM = 3.0  # standard deviation of the neighbourhood whose brightness is compared with that of a rim
_DARK_PERCENT = 5.0  # of the voxels near a surface of bone: as dark as its rim
_EDGE = 0.4  # of the step from rim to soft tissue: the rim's darkest voxels still show some of what is beside it
_RIM_MM = 1.2  # of a rim beyond its darkest part, at most, where voxels are smaller
_ONE_VOXEL = 1.05
_LEAST_STEP = 1.3  # brightness beside a rim over that of the rim: below, the image shows no surface
_MEAN_MM, _LOCAL = 6.0, 1.25  # mm and voxels: standard deviations of two means of the distance to the rim
_OF_DEEPEST = 0.5  # of the bone's greatest depth: the first mean is not of its other side, too
_THICKEST = 2.1  # over the thinnest voxel edge: in thicker slices, rims are not seen in all directions
_LEAST, _LEAST_LOCAL = 0.2, 0.5  # voxels: smaller means are noise
_CLEAR, _CLEAR_LOCAL = 1.0, 2.0  # reaches from where the dark goes on: nearer distances are left out of the means
_ROUGH_MM, _ROUGH = 4.0, 0.25  # mm and voxels: a surface farther off in this neighbourhood goes to the rim
_SHIFT = 0.25  # voxels, at most, so that a surface encloses as many voxels as its rim
_LEAST_SHARE = 0.1  # of the surface there that shows a rim: below, the distance tends to zero
NUMBERS = {
    "reach": _REACH, "blur_mm": _BLUR_MM, "around_mm": _AROUND_MM, "dark_percent": _DARK_PERCENT, "edge": _EDGE,
    "rim_mm": _RIM_MM, "one_voxel": _ONE_VOXEL, "least_step": _LEAST_STEP, "mean": [_MEAN_MM, _LEAST, _CLEAR],
    "local_mean": [_LOCAL, _LEAST_LOCAL, _CLEAR_LOCAL], "least_share": _LEAST_SHARE,
    "of_deepest": _OF_DEEPEST, "thickest": _THICKEST,
}  # fmt: skip
"""Every number that determines where a surface is moved to if no dark tissue is known, for a record."""


def reach_of(spacing_mm: FloatArray) -> float:
    """How far a surface is moved at most, mm: 2.5 times the mean voxel edge."""
    return _REACH * float(spacing_mm.mean())


def bone_to_rim(image: Image, bone: Mask, body: Mask, *, dark: BoolArray | None = None) -> tuple[Mask, float]:
    """The bone of a mask, with its surface moved by its mean distance to the outer edge of the dark rim.

    It comes with the share of the mask's surface at which this distance is known: .29 to .94 on phantom heels, about 0
    without a rim, in a cortex thicker than the surface can move, and if the mask is two voxels too small.

    The distance is averaged on the surface in a neighbourhood of 6 mm (standard deviation; less in a thin bone), which
    corrects a mask that is too large or too small, and then once more in a neighbourhood of 1.25 voxels, which corrects
    what is off in patches. The surface moves only where a mean is at least .2 and .5 voxels: an exact mask stays, which
    noise would change if each voxel went to the rim. Where the image shows no rim, and where the dark goes on beyond
    it, as in tendon, the distance is that of the neighbourhood; it is zero where a rim is far. In slices more than 2.1
    times as thick as the other voxel edges, the surface stays. ``image`` has no bias field; the bone and the ``body``,
    bone included, are on its grid. Beside what is not of the body, such as another bone, a rim is seen all the same.

    If it is given which tissue is as dark as a rim (``dark``, (ni, nj, nk)), a surface that the means moved encloses as
    many voxels as the rim does: distances from a curved surface are smooth, which alone would move it inward (by a
    quarter of a voxel at most). Then it lies at the rim itself, voxel by voxel, where it is still off by more than a
    quarter of a voxel (root mean square in a neighbourhood of 4 mm), which an exact mask hardly is. Beside that tissue,
    where a rim has no end, it stays where the means moved it. In thick slices, there is this last step alone.
    """
    spacing = image.grid.spacing_mm
    is_thick = bool(spacing.max() > _THICKEST * spacing.min())
    if is_thick and dark is None:
        return bone, 0.0
    reach_mm, edge_mm = reach_of(spacing), float(spacing.mean())
    box = bone.box(int(np.ceil((reach_mm + TRUNCATE * _AROUND_MM) / spacing.min())))
    part, given = fill_missing(Image(image.grid.part(box), image.values[box])), bone.inside[box]
    rims = _Rims.of(part.values, given, body.inside[box] & ~given, spacing)
    clear_mm = np.full(given.shape, np.inf)
    if rims.goes_on.any():
        clear_mm = distance_transform_edt(~rims.goes_on, sampling=spacing)
    depth, depth_of_rim = (depth_mm(of, spacing) for of in (given, np.where(rims.seen, rims.found, given)))
    mean_mm, shown = min(_MEAN_MM, _OF_DEEPEST * float(depth.max())), list[float]()

    def at_surface(clear: float) -> tuple[BoolArray, BoolArray]:
        """Voxels at the surface, and those of them whose distance to the rim is known."""
        surface = rims.near & (np.abs(depth) < 0.55 * edge_mm)  # beside a plane: 0.52
        return surface, surface & rims.seen & (clear_mm > clear * reach_mm)

    means = (mean_mm, _LEAST, _CLEAR), (_LOCAL * edge_mm, _LEAST_LOCAL, _CLEAR_LOCAL)
    for around_mm, least, clear in () if is_thick else means:
        surface, known = at_surface(clear)
        shown.append(float(known[surface].mean()) if surface.any() else 0.0)
        off = _mean_along(surface, known, depth_of_rim - depth, around_mm / spacing)
        moves = np.abs(off) >= least * edge_mm
        depth = depth + np.where(moves, off, 0.0)
        if dark is not None and least == _LEAST:
            there = moves & rims.near & ~rims.core & rims.seen & (clear_mm > clear * reach_mm)
            level_mm = _exceeded_by(depth[there], int(np.count_nonzero(rims.found & there)))
            depth -= np.where(moves, np.clip(level_mm, -_SHIFT * edge_mm, _SHIFT * edge_mm), 0.0)
    if dark is not None:
        seen = rims.seen & ~within(dark[box], spacing, 0.5 * reach_mm)
        surface, _ = at_surface(0.0)
        squares = _mean_along(surface, surface & seen, (depth_of_rim - depth) ** 2, _ROUGH_MM / spacing)
        depth = np.where(seen & (squares > (_ROUGH * edge_mm) ** 2), depth_of_rim, depth)
    found = bone.inside.copy()
    found[box] = np.where(rims.near & ~rims.core, depth > 0.0, given)
    return Mask(bone.grid, found), shown[0] if shown else 0.0


def _exceeded_by(values: FloatArray, count: int) -> float:
    """The value that so many of the values exceed; 0 if none or all of them should."""
    return float(np.sort(values)[len(values) - count - 1]) if 0 < count < len(values) else 0.0


def as_dark_as_rims(image: Image, bones: BoolArray, soft: BoolArray, tissues: Iterable[BoolArray]) -> BoolArray:
    """Voxels (ni, nj, nk) of those tissues that are as dark as the rims of bones in ``soft`` tissue, such as tendon."""
    spacing = image.grid.spacing_mm
    beside = within(bones, spacing, reach_of(spacing)) & within(~bones, spacing, reach_of(spacing)) & (bones | soft)
    dark = np.zeros_like(bones)
    if beside.any():
        blurred = gaussian(image.values, _BLUR_MM / spacing)
        most = _LEAST_STEP * float(np.percentile(blurred[beside], _DARK_PERCENT))
        for tissue in tissues:
            dark |= tissue & (float(np.median(blurred[tissue])) < most)
    return dark


@dataclass(frozen=True, slots=True, eq=False)
class _Rims:
    """Dark rims of bones; masks are (ni, nj, nk)."""

    found: BoolArray  # bones up to the outer edge of their rims
    core: BoolArray  # of the bones given: farther inside than their surfaces can move
    near: BoolArray  # where surfaces can move
    seen: BoolArray  # where the image shows the edge of a rim
    goes_on: BoolArray  # as dark as a rim, but beyond its greatest thickness

    @classmethod
    def of(cls, values: Float32Array, given: BoolArray, soft: BoolArray, spacing_mm: FloatArray) -> Self:
        """Rims of the bones given. A surface that is farther than the reach from one shows none.

        From inside the bones and from beyond their reach, regions grow until they meet in the darkest part of the rim.
        A bone gets the rest of the rim, up to the edge with the brighter soft tissue.
        """
        from skimage.segmentation import watershed  # takes longer to import than most registrations have time for

        reach_mm = reach_of(spacing_mm)
        inside, outside = (distance_transform_edt(of, sampling=spacing_mm) for of in (given, ~given))
        parts, count = label(given)
        of_each = maximum(inside[given], parts[given], np.arange(1, count + 1))
        deepest = np.concatenate([[0.0], np.atleast_1d(of_each)])
        core = given & (inside > np.minimum(reach_mm, 0.5 * deepest)[parts])
        blurred = gaussian(values, _BLUR_MM / spacing_mm)
        seeds = np.where(core, 1, np.where((outside > reach_mm) | ~(soft | given), 2, 0))
        # The seeds beside what is to be divided are enough.
        inner = (watershed(-blurred, seeds, mask=binary_dilation(seeds == 0)) == 1) | core
        near = (inside <= reach_mm) & (outside <= reach_mm) & (soft | given)
        beside = _mean_around(blurred, soft & (outside > reach_mm) & (outside < 2.0 * reach_mm), spacing_mm)
        dark = float(np.percentile(blurred[near], _DARK_PERCENT))
        as_dark = near & (blurred < dark + _EDGE * (beside - dark))
        known = within(as_dark, spacing_mm, reach_mm)
        thick_mm = max(_RIM_MM, _ONE_VOXEL * float(spacing_mm.mean()))
        rim = as_dark & within(inner, spacing_mm, thick_mm)
        found = (inner | rim) & (soft | given)
        joined, _ = label(found)
        found = np.isin(joined, np.unique(joined[core])) & found
        found |= binary_fill_holes(found)
        seen = near & known & (beside > _LEAST_STEP * dark)
        goes_on = as_dark & ~found & binary_dilation(found) | found & (outside > reach_mm - spacing_mm.min())
        return cls(found, core, near, seen, goes_on)


def _mean_along(surface: BoolArray, known: BoolArray, values: FloatArray, sigma: FloatArray) -> FloatArray:
    """Mean of values that are known at some voxels of a surface, around each voxel; near 0 where few are known."""
    of_all, share, total = (
        gaussian(of, sigma, "constant")
        for of in (surface.astype(np.float64), known.astype(np.float64), np.where(known, values, 0.0))
    )
    return np.asarray(total / np.maximum(np.maximum(share, _LEAST_SHARE * of_all), np.finfo(float).tiny))


def _mean_around(values: Float32Array, where: BoolArray, spacing_mm: FloatArray) -> FloatArray:
    """Mean of the values (ni, nj, nk) of some voxels in the neighbourhood of each voxel; 0 if there are none."""
    sigma = _AROUND_MM / spacing_mm
    share, total = gaussian(where.astype(np.float32), sigma), gaussian(np.where(where, values, 0.0), sigma)
    return np.asarray(total / np.maximum(share, 1e-4))
