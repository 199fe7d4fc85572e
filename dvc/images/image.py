"""Images on a grid in space: Grid, Image, Mask, LabelMap; LPS mm, indexed ``values[i, j, k]`` along the grid's axes."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self, TypeVar

import numpy as np
import numpy.typing as npt

from dvc.arguments import check
from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray, different, frozen
from dvc.errors import GeometryError, InputError, few
from dvc.images.bone_names import is_bones_name

_T = TypeVar("_T", bound=np.generic)

_ORTHONORMAL_TOLERANCE = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """A regular grid of voxel centres in LPS space.

    The centre of voxel ``(i, j, k)`` lies at ``X = origin_mm + direction @ (spacing_mm * (i, j, k))``.

    Parameters
    ----------
    shape : (3,) int
        Number of voxels along each grid axis.
    spacing_mm : (3,)
        Distance between voxel centres along each grid axis, mm, positive.
    origin_mm : (3,)
        Centre of voxel (0, 0, 0), LPS mm.
    direction : (3, 3)
        Columns are the unit vectors of the grid axes in LPS; orthonormal, either handedness.

    Raises
    ------
    GeometryError
        If an axis has no voxel, a spacing is not positive and finite, or the axes are not orthonormal.

    Examples
    --------
    >>> grid = Grid((4, 4, 4), (1.0, 1.0, 2.0), (0.0, 0.0, 0.0))
    >>> grid.points()[1, 0, 3].tolist()
    [1.0, 0.0, 6.0]
    >>> grid.indices_of([[1.0, 0.0, 6.0]]).tolist()
    [[1.0, 0.0, 3.0]]
    """

    shape: tuple[int, int, int]
    spacing_mm: FloatArray
    origin_mm: FloatArray
    direction: FloatArray = field(default_factory=lambda: np.eye(3))

    def __post_init__(self) -> None:
        shape = tuple(int(n) for n in self.shape)
        if len(shape) != 3 or min(shape) < 1:
            raise GeometryError(f"A grid needs three axes of at least one voxel; got shape {shape}.")
        given = self.spacing_mm, self.origin_mm, self.direction
        spacing, origin, direction = (frozen(each, np.float64) for each in given)
        if spacing.shape != (3,) or not np.all(np.isfinite(spacing)) or np.any(spacing <= 0):
            raise GeometryError(f"Voxel spacing must be three positive lengths in mm; got {spacing.tolist()}.")
        if origin.shape != (3,) or not np.all(np.isfinite(origin)):
            raise GeometryError(f"The grid's origin must be three finite coordinates in mm; got {origin.tolist()}.")
        if direction.shape != (3, 3) or not np.all(np.isfinite(direction)):
            raise GeometryError("The direction of the grid must be a finite 3 x 3 matrix.")
        skew = float(np.abs(direction.T @ direction - np.eye(3)).max())
        if skew > _ORTHONORMAL_TOLERANCE:
            raise GeometryError(
                f"The axes of the grid are not perpendicular unit vectors (largest deviation {skew:.2g}): the affine "
                "is sheared, or the spacing is wrong. Resample the image to a regular grid first."
            )
        for name, value in (("shape", shape), ("spacing_mm", spacing), ("origin_mm", origin), ("direction", direction)):
            object.__setattr__(self, name, value)

    @property
    def affine(self) -> FloatArray:
        """The (4, 4) matrix from voxel indices to LPS mm."""
        affine = np.eye(4)
        affine[:3, :3] = self.direction * self.spacing_mm
        affine[:3, 3] = self.origin_mm
        return affine

    @property
    def index_per_mm(self) -> FloatArray:
        """Derivative (3, 3) of the voxel indices by LPS mm."""
        return np.asarray(np.linalg.inv(self.direction) / self.spacing_mm[:, None])

    @property
    def voxel_volume_mm3(self) -> float:
        """Volume of one voxel, mm3."""
        return float(np.prod(self.spacing_mm))

    @property
    def centre_mm(self) -> FloatArray:
        """Centre of the grid, LPS mm."""
        return np.asarray(self.origin_mm + self.direction @ (self.spacing_mm * (np.array(self.shape) - 1) / 2.0))

    def points(self, where: BoolArray | None = None) -> FloatArray:
        """Voxel centres in LPS mm: (ni, nj, nk, 3), or (n, 3) for the voxels of the mask ``where``."""
        if where is not None:
            return self.points_at(np.argwhere(where).astype(np.float64))
        return self.points_at(np.moveaxis(np.indices(self.shape, dtype=np.float64), 0, -1))

    def points_at(self, indices: FloatArray) -> FloatArray:
        """LPS mm of continuous voxel indices (..., 3)."""
        return np.asarray((np.asarray(indices, dtype=np.float64) * self.spacing_mm) @ self.direction.T + self.origin_mm)

    def indices_of(self, points_mm: FloatArray) -> FloatArray:
        """Continuous voxel indices (..., 3) of points in LPS mm."""
        inverse = np.linalg.inv(self.direction)
        return np.asarray(((np.asarray(points_mm) - self.origin_mm) @ inverse.T) / self.spacing_mm)

    def contains(self, points_mm: FloatArray) -> BoolArray:
        """Whether points in LPS mm lie inside the grid's box, which ends half a voxel beyond its centres."""
        indices = self.indices_of(points_mm)
        return np.asarray(np.all((indices >= -0.5) & (indices <= np.array(self.shape) - 0.5), axis=-1))

    def corners(self) -> FloatArray:
        """The eight outer corners of the grid's box, (8, 3) LPS mm."""
        return self.points_at(np.indices((2, 2, 2)).reshape(3, 8).T * np.array(self.shape) - 0.5)

    def bounds_mm(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner of the axis-aligned LPS box around the grid, mm."""
        corners = self.corners()
        return corners.min(axis=0), corners.max(axis=0)

    def same_as(self, other: Self, tolerance_voxels: float = 0.02) -> bool:
        """Whether two grids have the same shape and place their corner voxels within a fraction of a voxel.

        Headers written by different programs differ in the last digits; that is the same grid.
        """
        if self.shape != other.shape:
            return False
        shift = self.indices_of(other.corners()) - self.indices_of(self.corners())
        return bool(np.abs(shift).max() <= tolerance_voxels)

    def axes_to_lps(self) -> tuple[tuple[int, int, int], tuple[bool, bool, bool]]:
        """Axis of the grid to use as first, second, third, and whether to reverse it, to come closest to L, P, S."""
        closeness = np.abs(self.direction)
        order = [-1, -1, -1]
        for _ in range(3):
            world, axis = np.unravel_index(int(np.argmax(closeness)), (3, 3))
            order[int(world)] = int(axis)
            closeness[world, :] = closeness[:, axis] = -1.0
        flips = tuple(bool(self.direction[w, a] < 0) for w, a in enumerate(order))
        return (order[0], order[1], order[2]), (flips[0], flips[1], flips[2])

    def toward_lps(self) -> Self:
        """The same voxels with axes ordered and flipped to run closest to L, P, S."""
        order, flips = self.axes_to_lps()
        axes, start, signs = list(order), np.zeros(3), np.where(flips, -1.0, 1.0)
        ni, nj, nk = (self.shape[axis] for axis in axes)
        start[axes] = np.where(flips, [ni - 1, nj - 1, nk - 1], 0)
        return type(self)((ni, nj, nk), self.spacing_mm[axes], self.points_at(start), self.direction[:, axes] * signs)

    def moved_by(self, rotation: FloatArray, translation_mm: FloatArray) -> Self:
        """The grid carried by the rigid motion x -> rotation @ x + translation_mm."""
        return replace(self, origin_mm=rotation @ self.origin_mm + translation_mm, direction=rotation @ self.direction)

    def part(self, box: tuple[slice, slice, slice]) -> Self:
        """The grid of a box of voxels, given by slices without a step."""
        start, stop = np.array([cut.indices(n)[:2] for cut, n in zip(box, self.shape, strict=True)]).T
        return replace(self, shape=tuple(stop - start), origin_mm=self.points_at(start))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self})"

    def __str__(self) -> str:
        """Shape, spacing and bounding box, for messages."""
        low, high = self.bounds_mm()
        box = ", ".join(f"{axis} {a:z.1f} to {b:z.1f}" for axis, a, b in zip("xyz", low, high, strict=True))
        spacing = " x ".join(f"{s:.4g}" for s in self.spacing_mm)
        return f"{' x '.join(map(str, self.shape))} voxels of {spacing} mm; {box} mm (LPS)"


def _on(grid: Grid, what: str, values: npt.ArrayLike, kind: type[_T]) -> npt.NDArray[_T]:
    """Values as a read-only array, one for each voxel of the grid."""
    check("grid", grid, Grid)
    array = frozen(values, kind)
    if array.shape != grid.shape:
        raise GeometryError(f"{what} has shape {array.shape}, but its grid has shape {grid.shape}; they must be equal.")
    return array


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Image:
    """A scalar image on a grid; single precision, as scanners give it.

    Attributes
    ----------
    grid : Grid
        LPS mm, in the frame of the scan.
    values : (ni, nj, nk) float32
        Grey values; NaN at missing voxels.

    Raises
    ------
    GeometryError, InputError
        If values and grid differ in shape, or a value is infinite.
    """

    grid: Grid
    values: Float32Array = field(repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", _on(self.grid, "The image", self.values, np.float32))
        if np.isinf(self.values).any():
            raise InputError("The image has infinite values; set them to NaN (missing) or repair them.")

    @property
    def missing(self) -> BoolArray:
        """Voxels without a value."""
        return np.isnan(self.values)

    def toward_lps(self) -> Self:
        """The same image with its axes closest to L, P, S; values are reordered, never resampled."""
        return replace(self, grid=self.grid.toward_lps(), values=reordered_to_lps(self.grid, self.values))


@dataclass(frozen=True, slots=True, eq=False)
class Mask:
    """A set of voxels on a grid.

    Attributes
    ----------
    grid : Grid
        LPS mm.
    inside : (ni, nj, nk) bool
        Which voxels belong to it.

    Raises
    ------
    GeometryError, InputError
        If voxels and grid differ in shape; for values that are neither 0 nor 1.
    """

    grid: Grid
    inside: BoolArray = field(repr=False)

    def __post_init__(self) -> None:
        given = np.asarray(self.inside)
        if given.dtype.kind in "iuf" and not ((given == 0) | (given == 1)).all():
            kind = "grey values. Apply a threshold: Mask(grid, values > level)"
            if given.dtype.kind != "f":
                kind = "labels. Select one: Mask(grid, labels == number), or label_map.region(name)"
            raise InputError(f"A mask must have only 0 and 1; these are {kind}.")
        object.__setattr__(self, "inside", _on(self.grid, "The mask", self.inside, np.bool_))

    def box(self, around: int = 0) -> tuple[slice, slice, slice]:
        """Slices of the smallest box that holds the mask, and ``around`` voxels beside it; empty for an empty mask."""
        return box_of(self.inside, (around,) * 3)

    @property
    def volume_mm3(self) -> float:
        """Volume of the mask, mm3."""
        return float(np.count_nonzero(self.inside)) * self.grid.voxel_volume_mm3

    def points(self) -> FloatArray:
        """Centres of the mask's voxels, (n, 3) LPS mm."""
        return self.grid.points(self.inside)

    def toward_lps(self) -> Self:
        """The same mask with its axes closest to L, P, S."""
        return replace(self, grid=self.grid.toward_lps(), inside=reordered_to_lps(self.grid, self.inside))


def box_of(inside: BoolArray, around: Sequence[int]) -> tuple[slice, slice, slice]:
    """As `Mask.box` of an array (ni, nj, nk), with as many voxels beside it along each axis."""
    hits = [np.flatnonzero(inside.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    if not hits[0].size:
        return (slice(0, 0),) * 3
    ends = ((int(hit[0]) - beside, int(hit[-1]) + 1 + beside) for hit, beside in zip(hits, around, strict=True))
    i, j, k = (slice(max(low, 0), min(high, n)) for (low, high), n in zip(ends, inside.shape, strict=True))
    return i, j, k


@dataclass(frozen=True, slots=True, eq=False)
class LabelMap:
    """Regions on a grid, each an integer with a name.

    Attributes
    ----------
    grid : Grid
        LPS mm.
    labels : (ni, nj, nk) int
        Number of the region of each voxel; 0 is background and has no name.
    names : mapping of int to str
        Name of each number.

    Raises
    ------
    GeometryError, InputError
        If labels and grid differ in shape; if a label is no whole number, is negative or has no name, or two labels
        share a name.
    """

    grid: Grid
    labels: IntArray = field(repr=False)
    names: Mapping[int, str]

    def __post_init__(self) -> None:
        given = np.asarray(self.labels)
        if given.dtype.kind == "f" and not (given == np.rint(given)).all():
            raise InputError("Labels must be whole numbers. Resample label maps only by nearest neighbour.")
        object.__setattr__(self, "labels", _on(self.grid, "The label map", self.labels, np.int64))
        present = different(self.labels).tolist()
        if present and present[0] < 0:
            raise InputError(f"Labels must not be negative; found {present[0]}.")
        if nameless := [v for v in present if v != 0 and v not in self.names]:
            raise InputError(f"Labels without a name: {nameless}. Names given: {dict(self.names)}.")
        if twice := sorted(name for name, count in Counter(self.names.values()).items() if count > 1):
            raise InputError(f"Region names must be unique; used for several labels: {twice}.")
        object.__setattr__(self, "names", dict(self.names))

    def region(self, name: str) -> Mask:
        """The mask of one region; InputError if no label has this name, with the names there are."""
        label = next((label for label, known in self.names.items() if known == name), None)
        if label is None:
            raise self.no_region(name)
        return Mask(self.grid, self.labels == label)

    def no_region(self, name: str) -> InputError:
        """The error for a name that no label has."""
        listed = few(sorted(self.names.values())) or "none"
        bones = [known for known in self.names.values() if is_bones_name(known)]
        likely = f" Did you mean '{bones[0]}'?" if is_bones_name(name) and len(bones) == 1 else ""
        unnamed = all(known.startswith("label-") for known in self.names.values())
        told = " No table of names was given (names; --names on the command line), so labels are named by number."
        return InputError(f"The label map has no region '{name}'; it has {listed}.{told if unnamed else likely}")

    def toward_lps(self) -> Self:
        """The same label map with its axes closest to L, P, S."""
        return replace(self, grid=self.grid.toward_lps(), labels=reordered_to_lps(self.grid, self.labels))


def reordered_to_lps(grid: Grid, values: npt.NDArray[_T]) -> npt.NDArray[_T]:
    """A view of values on ``grid`` (leading three axes) reordered to ``grid.toward_lps()``."""
    order, flips = grid.axes_to_lps()
    turned = values.transpose((*order, *range(3, values.ndim)))
    return turned[tuple(slice(None, None, -1 if f else 1) for f in flips)]
