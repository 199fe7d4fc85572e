"""Image values at points in space, and images carried to another grid."""

from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.ndimage import distance_transform_edt, map_coordinates

from dvc.arrays import BoolArray, Float32Array, FloatArray, frozen
from dvc.images.filters import gaussian, spline_coefficients
from dvc.images.image import Grid, Image
from dvc.images.interpolation import carry_values, sample_values
from dvc.threads import in_parts


class AffineMotion(Protocol):
    """An affine motion of points, LPS mm, such as `dvc.RigidMotion`: x = matrix @ X + translation_mm."""

    @property
    def matrix(self) -> FloatArray:
        """The (3, 3) matrix."""

    @property
    def translation_mm(self) -> FloatArray:
        """The (3,) translation."""


def fill_missing(image: Image) -> Image:
    """The image with missing voxels set to their nearest known neighbour, for what cannot leave voxels out.

    A constant would be an edge that is not there, and blurring and splines would carry it into what is known.
    """
    if not (missing := image.missing).any():
        return image
    spacing = image.grid.spacing_mm
    nearest = distance_transform_edt(missing, sampling=spacing, return_distances=False, return_indices=True)
    return Image(image.grid, image.values[tuple(nearest)])


def smoothed(image: Image, sigma_mm: float) -> Image:
    """The image blurred by a Gaussian of ``sigma_mm`` in space; missing voxels stay missing."""
    sigma = sigma_mm / image.grid.spacing_mm
    values = gaussian(fill_missing(image).values, sigma, "nearest")
    return Image(image.grid, np.where(image.missing, np.float32(np.nan), values))


def thinned(image: Image, every: tuple[slice, ...]) -> Image:
    """Every so manyth voxel of an image along each axis, the first among them."""
    grid, values = image.grid, image.values[every]
    i, j, k = values.shape
    return Image(Grid((i, j, k), grid.spacing_mm * [one.step for one in every], grid.origin_mm, grid.direction), values)


def shows(image: Image, points_mm: FloatArray, margin_mm: float = 0.0) -> BoolArray:
    """Whether an image has values at points (n, 3) LPS mm, and for ``margin_mm`` around along its axes.

    That is inside its voxel centres' box, with no missing voxel beside. NaN points are not shown.
    """
    at = image.grid.indices_of(points_mm)
    margin = margin_mm / image.grid.spacing_mm - 1e-6
    known = np.all((at >= margin) & (at <= np.array(image.grid.shape) - 1 - margin), axis=1)
    if image.missing.any():
        distance = distance_transform_edt(~image.missing, sampling=image.grid.spacing_mm)
        gaps = (distance <= margin_mm).astype(np.float32)
        known[known] = map_coordinates(gaps, at[known].T, order=1, mode="nearest") <= 1e-6
    return np.asarray(known)


def carry(
    image: Image, grid: Grid, motion: AffineMotion | None = None, where: BoolArray | None = None, order: int = 3,
    displacement_mm: npt.ArrayLike | None = None,
) -> Float32Array:  # fmt: skip
    """Values of ``image`` on ``grid``, NaN where any of the eight voxels around is missing or outside.

    A voxel of the grid takes the image's value at the place where ``motion`` (default: the identity) takes its centre,
    after a ``displacement_mm`` (ni, nj, nk, 3) of the grid's voxels, LPS (NaN gives NaN), where one is given; ``where``
    (ni, nj, nk) are the voxels wanted; ``order`` is 1 for linear, 3 for cubic spline interpolation.
    """
    return Carrier(image, order).onto(grid, motion, where, displacement_mm)


def sampled(
    coefficients: Float32Array, grid: Grid, points_mm: FloatArray, motion: AffineMotion, order: int
) -> FloatArray:  # fmt: skip
    """Values (n,) of an image where a motion takes points (n, 3) LPS mm; NaN beyond its voxels' centres.

    ``coefficients`` on the image's grid are those of cubic splines with mode "mirror" (``order`` 3), or its values, to
    be interpolated linearly (1).
    """
    per_mm, values = np.ascontiguousarray(grid.index_per_mm @ motion.matrix), np.empty(len(points_mm))
    start = grid.indices_of(motion.translation_mm)
    given = frozen(coefficients, np.float32), order == 3, points_mm, per_mm, start
    in_parts(sample_values, len(values), *given, values)
    return values


class Carrier:
    """An image that is carried to other grids more than once, with its spline found once; as in `carry`."""

    def __init__(self, image: Image, order: int = 3) -> None:
        values = fill_missing(image).values
        self.image, self._cubic = image, order > 1
        self._values = frozen(spline_coefficients(values, np.float32) if self._cubic else values, np.float32)
        missing = image.missing
        self._gaps = frozen(missing if missing.any() else np.zeros((0, 0, 0)), np.float32)

    def onto(
        self, grid: Grid, motion: AffineMotion | None = None, where: BoolArray | None = None,
        displacement_mm: npt.ArrayLike | None = None,
    ) -> Float32Array:  # fmt: skip
        """Values (ni, nj, nk) on a grid; as in `carry`."""
        matrix, shift = (np.eye(3), np.zeros(3)) if motion is None else (motion.matrix, motion.translation_mm)
        per_mm = np.ascontiguousarray(self.image.grid.index_per_mm @ matrix)
        step = np.ascontiguousarray(per_mm @ (grid.direction * grid.spacing_mm))
        start = self.image.grid.indices_of(matrix @ grid.origin_mm + shift)
        # Read-only, as images are: of each kind of array a kernel is compiled anew.
        wanted = frozen(np.ones(grid.shape, dtype=bool) if where is None else where, np.bool_)
        u = np.zeros((0, 0, 0, 3)) if displacement_mm is None else displacement_mm
        carried = np.full(grid.shape, np.nan, dtype=np.float32)
        moved = frozen(u, np.float32)
        given = self._values, self._gaps, self._cubic, wanted, step, start, moved, per_mm
        in_parts(carry_values, len(wanted), *given, carried)
        return carried
