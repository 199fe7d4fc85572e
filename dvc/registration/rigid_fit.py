"""A rigid motion between two images, by Gauss-Newton over the voxels of a mask, from a start right to a few mm.

The motion T is the one for which I1(T(X)) comes closest to g(X) I0(X) + o at voxels X, with a gain g quadratic in X.
A small motion d(X) = p + w x (X - c) of the voxels before T changes I1(T(X)) by g grad I0 . d; so the remaining
difference is regressed on the six columns of grad I0 . d, and T becomes T after d (inverse compositional; Baker and
Matthews 2004, doi:10.1023/B:VISI.0000011205.11775.fd). The images are blurred at first, by less and less.

Three things would pull a mask along its edges. The bias field that its correction leaves: the gain takes it up. Noise
in I0, which biases a regression on I0: so the gain is estimated with the mean of each voxel's six neighbours as
instrument, whose noise is independent (unless a scanner has interpolated its voxels). And the noise of a gradient
between voxels, which correlates with the noise beside it: the gradient of the unloaded image at its voxels, a
difference of two neighbours, is correlated neither with the voxel between them nor with the neighbours' mean.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Self

import numpy as np
from scipy.ndimage import binary_erosion, convolve
from scipy.spatial.transform import Rotation

from dvc import threads
from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.protocol import RigidMotion
from dvc.errors import InputError, RegistrationError
from dvc.images.filters import spline_coefficients
from dvc.images.image import Grid, Image, Mask
from dvc.images.resample import fill_missing, sampled, smoothed, thinned

_BLURS_MM = (4.0, 2.0, 1.0, 0.0)
_FINE_FROM = 1  # of these, for fits that begin near the end
_VOXELS_PER_BLUR = 1.5  # blurred images are compared at every voxel that lies so much closer than the blur
_STEPS = 40
_SMALL_MM = 1e-4  # a step that moves the voxels by less, root mean square, is the last
_SMALL_SHARE = 0.01  # or by less than this share of the blur, where it is more
_LONGEST_MM = 2.0
_LEAST_SHOWN = 0.5
_LEAST_GAIN = 0.1  # of what the images' standard deviations make it: a gain near zero would blow up what is left
_SHADED_MM = 10.0  # a mask whose voxels lie nearer to its centre, root mean square, has one gain: too small for more
_BLOCK_MM = 8.0  # halves of the mask are made of cubes of this size, like a chessboard: neighbours share noise
_BLOCK_SHARE = 0.7  # or of this share of the root mean square distance to the centre, where that is less
_LEAST_SHARE = 0.25  # a half that gets less is drawn voxel by voxel
_LEAST_VOXELS = 16
_FEW = 0.5  # of the voxels that an image shows
_ASIDE_MM = 1.5  # by which the two fits of a pair begin to either side
_FARTHEST_MM = 15.0
_NEIGHBOURS = np.where(np.abs(np.indices((3, 3, 3)) - 1).sum(axis=0) == 1, 1.0 / 6.0, 0.0)


@dataclass(frozen=True, eq=False)
class _Level:
    """Both images with one blur: the unloaded one at points of the mask, the loaded one whole."""

    blur_mm: float
    points: FloatArray  # (n, 3), LPS mm
    values: FloatArray  # (n,), I0
    places: FloatArray  # (n, 10 or 1), polynomials of place of which the gain is a sum
    shaded: FloatArray  # (n, 11 or 2), I0 times these, and 1 for the offset
    around: FloatArray  # the same of the mean of the six neighbours
    changes: FloatArray  # (n, 6), grad I0 . d for unit steps of the six unknowns
    scene: Image  # the loaded image, as coefficients of splines
    order: int  # of these splines

    def part(self, which: BoolArray) -> Self:
        """The same with some of the points, (n,)."""
        names = ("points", "values", "places", "shaded", "around", "changes")
        return self if which.all() else replace(self, **{name: getattr(self, name)[which] for name in names})

    @cached_property
    def shading(self) -> "_Regression":
        """Of the loaded image on the gain and the offset."""
        return _Regression(self.shaded, self.around)

    @cached_property
    def moving(self) -> "_Regression":
        """Of what remains on the six unknowns."""
        return _Regression(self.changes, self.changes)


class RigidFit:
    """Fits of one mask's voxels in one pair of images, from any start; the seed is that of the halves of the mask.

    The contrast of the images is one, but for an offset, and a gain that changes smoothly in place. InputError if the
    unloaded image has values at fewer than 16 of the mask's voxels, or is a single slice.
    """

    def __init__(self, reference: Image, loaded: Image, mask: Mask, seed: int) -> None:
        known = _surrounded(reference, mask)
        points = known.points()
        if min(mask.grid.shape) < 2:
            raise InputError("The unloaded image is a single slice; the rigid alignment needs a volume.")
        if len(points) < _LEAST_VOXELS:
            shown = f"Only {len(points)} voxels of the mask are in the unloaded image"
            raise InputError(f"{shown}; the rigid alignment needs at least {_LEAST_VOXELS}. Check the mask.")
        self._centre = points.mean(axis=0)
        self._radius_mm = float(np.sqrt(np.mean(np.sum((points - self._centre) ** 2, axis=1))))
        self._block_mm = max(min(_BLOCK_MM, _BLOCK_SHARE * self._radius_mm), float(mask.grid.spacing_mm.max()))
        self._random = np.random.default_rng(seed)
        # In units of the bone's own brightness: an offset beside large numbers would be lost in rounding.
        brightness = float(np.sqrt(np.mean(reference.values[known.inside].astype(np.float64) ** 2))) or 1.0
        reference, loaded = (Image(i.grid, i.values / np.float32(brightness)) for i in (reference, loaded))
        missing = loaded.missing
        self._gaps = Image(loaded.grid, missing.astype(np.float32)) if missing.any() else None
        scenes = _scenes(fill_missing(loaded))
        self._levels = [self._level(reference, known, blur, scenes[blur]) for blur in _BLURS_MM]

    def whole(self, start: RigidMotion) -> RigidMotion:
        """The motion that all of the voxels give from a start.

        RegistrationError if half of the voxels leave the loaded image, its contrast is inverted there, or the motion
        goes off by 15 mm.
        """
        motion = self._settled(start, self._levels, [np.ones(len(level.points), bool) for level in self._levels])
        if (moved_mm := apart_mm(motion, start, self._levels[0].points)) > _FARTHEST_MM:
            raise RegistrationError(
                f"The rigid fit diverged: it moved {moved_mm:.0f} mm from its starting position. Check that both "
                "images show the same body part."
            )
        return motion

    def halves(self, near: RigidMotion) -> list[tuple[RigidMotion, RigidMotion]]:
        """Pairs of motions, each from one half of the voxels, begun to either side of a motion that is near.

        One pair for each axis of the normal equations, with a division into halves of its own. Along an axis of which
        the images tell nothing the pair stays apart, or noise leads the halves to places that agree by chance alone.
        RegistrationError as in `whole`, of a half's voxels.
        """
        changes, fine = self._levels[-1].changes, self._levels[_FINE_FROM:]
        _, ways = np.linalg.eigh(np.einsum("ni,nj->ij", changes, changes))
        begun: list[tuple[RigidMotion, list[BoolArray]]] = []
        for way in _ASIDE_MM * ways.T:
            corner = self._random.uniform(0.0, 2.0 * self._block_mm, 3)
            halves = []
            for level in fine:
                blocks = np.floor((level.points - self._centre + corner) / self._block_mm).astype(int)
                half = blocks.sum(axis=1) % 2 == 0
                if not _LEAST_SHARE <= half.mean() <= 1.0 - _LEAST_SHARE:
                    half = self._random.permuted(np.arange(len(half)) % 2 == 0)
                halves.append(np.asarray(half))
            begun.append((near.after(self._step(way)), halves))
            begun.append((near.after(self._step(-way)), [~half for half in halves]))
        with ThreadPoolExecutor(threads.count()) as pool:
            fits = list(pool.map(lambda one: self._settled(one[0], fine, one[1]), begun))
        return list(zip(fits[::2], fits[1::2], strict=True))

    def _level(self, reference: Image, mask: Mask, blur_mm: float, scene: Image) -> _Level:
        box = mask.box(int(np.ceil(3.0 * blur_mm / mask.grid.spacing_mm.min())) + 2)
        inside, part = mask.inside[box], Image(mask.grid.part(box), reference.values[box])
        fixed = fill_missing(smoothed(part, blur_mm) if blur_mm else part).values.astype(np.float64)
        slopes = np.stack(list(np.gradient(fixed, *part.grid.spacing_mm)), axis=-1)
        thin = np.zeros(inside.shape, dtype=bool)
        thin[_every(part.grid, blur_mm)] = True
        enough = np.count_nonzero(inside & thin) >= _LEAST_VOXELS
        at = np.argwhere(inside & thin if enough else inside)
        points, here = part.grid.points_at(at.astype(np.float64)), tuple(at.T)
        gradient = slopes[here] @ part.grid.direction.T
        turning = np.cross(points - self._centre, gradient) / self._radius_mm
        x, y, z = ((points - self._centre) / self._radius_mm).T
        places = np.column_stack([np.ones(len(at)), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x])
        if self._radius_mm < _SHADED_MM:
            places = places[:, :1]
        mean = convolve(fixed, _NEIGHBOURS, mode="nearest")
        shaded, around = (np.column_stack([places * i[here][:, None], np.ones(len(at))]) for i in (fixed, mean))
        changes = np.hstack([gradient, turning])
        return _Level(blur_mm, points, fixed[here], places, shaded, around, changes, scene, 1 if blur_mm else 3)

    def _settled(self, motion: RigidMotion, levels: list[_Level], parts: list[BoolArray]) -> RigidMotion:
        """Where steps over some of each level's points, one level after the other, come to rest."""
        for whole, which in zip(levels, parts, strict=True):
            level, small = whole.part(which), max(_SMALL_MM, _SMALL_SHARE * whole.blur_mm)
            for _ in range(_STEPS):
                step = self._next(level, motion)
                length = float(np.linalg.norm(step))
                motion = motion.after(self._step(step * min(1.0, _LONGEST_MM / max(length, 1e-12))))
                if length < small:
                    break
        return motion

    def _next(self, level: _Level, motion: RigidMotion) -> FloatArray:
        """The next step (6,), mm: along the axes, and turns about them times the mask's radius."""
        carried = sampled(level.scene.values, level.scene.grid, level.points, motion, level.order)
        shown = ~np.isnan(carried)
        if self._gaps is not None:
            shown &= sampled(self._gaps.values, self._gaps.grid, level.points, motion, order=1) < 1e-6
        if np.count_nonzero(shown) < _LEAST_SHOWN * len(shown):
            raise RegistrationError("The bone is moved out of the loaded image.")
        level, carried = level.part(shown), carried[shown]
        values = level.values
        if not ((values - values.mean()) * (carried - carried.mean())).sum() > 0.0:
            raise RegistrationError("The contrast of the loaded image is inverted.")
        found = level.shading.of(carried)
        gain = np.einsum("ni,i->n", level.places, found[:-1])
        gain = np.maximum(gain, _LEAST_GAIN * carried.std() / values.std())
        return level.moving.of(values - (carried - found[-1]) / gain)

    def _step(self, step: FloatArray) -> RigidMotion:
        turn = Rotation.from_rotvec(step[3:] / self._radius_mm).as_matrix()
        return RigidMotion.about(self._centre, turn, step[:3])


def apart_mm(one: RigidMotion, other: RigidMotion, points: FloatArray) -> float:
    """Root mean square distance, mm, between where two motions take points (n, 3)."""
    return float(np.sqrt(np.mean(np.sum((one.apply(points) - other.apply(points)) ** 2, axis=1))))


def _surrounded(image: Image, mask: Mask) -> Mask:
    """The voxels of a mask that the image shows with all of their six neighbours; if those are few, all that it shows.

    Beside a gap or the image's end differences and means of neighbours have a voxel's own noise in them.
    """
    shown = ~image.missing
    surrounded, inside = mask.inside & binary_erosion(shown), mask.inside & shown
    few = np.count_nonzero(surrounded) < _FEW * np.count_nonzero(inside)  # of few slices most lie at an end
    return Mask(mask.grid, inside if few else surrounded)


class _Regression:
    """On columns (n, m), with instruments or by the columns themselves; sums whose bits do not depend on threads."""

    def __init__(self, columns: FloatArray, by: FloatArray) -> None:
        self._by, self._normal = by, np.einsum("ni,nj->ij", by, columns)

    def of(self, values: FloatArray) -> FloatArray:
        """Coefficients (m,) of values (n,)."""
        return np.asarray(np.linalg.lstsq(self._normal, np.einsum("ni,n->i", self._by, values), rcond=1e-9)[0])


def _scenes(loaded: Image) -> dict[float, Image]:
    """The loaded image by its blur: cubic coefficients without, and values at fewer voxels the more it is blurred."""
    scenes, now = {0.0: Image(loaded.grid, spline_coefficients(loaded.values, np.float32))}, loaded
    for before, blur in pairwise(sorted(_BLURS_MM)):
        now = smoothed(now, float(np.sqrt(blur**2 - before**2)))
        scenes[blur] = now = thinned(now, _every(now.grid, blur))
    return scenes


def _every(grid: Grid, blur_mm: float) -> tuple[slice, ...]:
    """As many of a grid's voxels as an image needs that is blurred so much."""
    return tuple(slice(None, None, max(1, int(blur_mm / _VOXELS_PER_BLUR / s))) for s in grid.spacing_mm)
