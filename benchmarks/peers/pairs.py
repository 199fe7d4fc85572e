"""The image pairs of the comparison, and the files that every peer gets of one."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.registration_accuracy import without_motion
from dvc import Grid, Image, Mask, write_image, write_labels, write_mask
from dvc.images.bias_field import without_bias_field
from dvc.images.resample import carry, fill_missing
from phantoms import Heel, HeelPair, heel_pair, motion_named

# Air left around the body: more than tissue moves, so that its true place is inside the aligned image as well.
MARGIN_MM = 10.0


# A smooth flow; one whose strain jumps at bone and skin; both together, pressed and sheared. Seeds set aside.
PAIRS = {"smooth 9000": ("smooth", 9000), "sliding 9001": ("sliding", 9001)}
PAIRS |= {"Load1 9002": ("Load1", 9002), "Load3 9003": ("Load3", 9003)}


def pair_named(name: str) -> HeelPair:
    """Make one of PAIRS, which takes most of a minute."""
    motion, seed = PAIRS[name]
    return heel_pair(seed=seed, motion=motion_named(Heel(seed), motion))


def write_pair(pair: HeelPair, folder: Path) -> None:
    """Write what the peers read: MetaImages, whose header is LPS mm as ITK has it.

    ``scan0``, ``scan1`` (as acquired), ``bone`` and ``body`` on the reference's grid are what mrstrain is given (and
    ``labels``, where it lets strain jump at borders of tissues);
    ``scan1-moved`` is scan1 with the foot's true motion taken out in its header. The others are prepared, so that every
    peer has the help that mrstrain has or finds for itself: shading removed, the foot's *true* motion taken out of the
    loaded image, and only the body's box.

    - ``reference``, ``mask``: the body's box with a margin. Beyond the scan the nearest value is repeated.
    - ``loaded``: all of its voxels, the motion taken out in the header alone (its axes are oblique).
    - ``aligned``: the same resampled by cubic splines onto the grid of ``reference``, for tools that know arrays only.
    """
    body = Mask(pair.reference.grid, pair.labels.labels > 0)
    write_image(folder / "scan0.mha", pair.reference)
    write_image(folder / "scan1.mha", pair.loaded)
    write_mask(folder / "bone.mha", pair.bone)
    write_mask(folder / "body.mha", body)
    write_labels(folder / "labels.mha", pair.labels)
    grid = _box(body)
    write_image(folder / "scan1-moved.mha", without_motion(pair.loaded, pair.foot_motion))
    unloaded, loaded = map(without_bias_field, (pair.reference, pair.loaded))
    loaded = without_motion(loaded, pair.foot_motion)
    write_image(folder / "reference.mha", _onto(unloaded, grid, order=1))
    write_image(folder / "loaded.mha", loaded)
    write_image(folder / "aligned.mha", _onto(loaded, grid, order=3))
    inside = carry(Image(body.grid, body.inside.astype(np.float32)), grid, order=1)
    write_mask(folder / "mask.mha", Mask(grid, np.nan_to_num(inside) > 0.5))


def _onto(image: Image, grid: Grid, order: int) -> Image:
    return fill_missing(Image(grid, carry(image, grid, order=order)))


def _box(body: Mask) -> Grid:
    """Grid of the body's box with the margin, on the voxels of the body's own grid carried on beyond it."""
    margin = np.ceil(MARGIN_MM / body.grid.spacing_mm).astype(int)
    hit = np.argwhere(body.inside)
    low, high = hit.min(axis=0) - margin, hit.max(axis=0) + margin
    ni, nj, nk = (int(n) for n in high - low + 1)
    return Grid((ni, nj, nk), body.grid.spacing_mm, body.grid.points_at(low.astype(np.float64)), body.grid.direction)
