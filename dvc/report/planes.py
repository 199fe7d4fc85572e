"""Three planes through a point of a grid, cut out as they lie on the page.

Slices are shown as radiologists read them, whatever the grid's own axes: sagittal seen from the left (anterior on the
left of the page), coronal from the front and axial from below (the patient's right on the left). They are cut along the
grid's axes, never resampled; where those are oblique the titles say so.
"""

from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt

from dvc.arrays import BoolArray
from dvc.errors import GeometryError
from dvc.images.image import Grid, Mask, reordered_to_lps

Plane = Literal["sagittal", "coronal", "axial"]
Values = npt.NDArray[Any]

PLANES: tuple[Plane, ...] = ("sagittal", "coronal", "axial")
# Axes of the L, P, S grid: the one cut, the one across the page, the one up or down it.
AXES: dict[Plane, tuple[int, int, int]] = {"sagittal": (0, 1, 2), "coronal": (1, 0, 2), "axial": (2, 0, 1)}
LETTERS: dict[Plane, str] = {"sagittal": "APSI", "coronal": "RLSI", "axial": "RLAP"}  # left, right, top, bottom
OBLIQUE_DEG = 3.0
_SIDES = ("RL", "AP", "IS")  # of the axes L, P, S: against it and along it
_LEAST_SHARE = 0.3827  # cosine of 67.5 degrees: half-way between one letter and two


def letters(direction: npt.ArrayLike) -> str:
    """Side of the body to which a direction (3,) LPS points: letters of axes within 67.5 degrees of it, nearest first.

    >>> letters([0.0, -1.0, 0.0]), letters([0.0, -0.8, 0.6]), letters([0.1, 0.0, 0.99])
    ('A', 'AS', 'S')
    """
    unit = np.asarray(direction, dtype=np.float64) / np.linalg.norm(direction)
    shown = [axis for axis in np.argsort(-np.abs(unit)) if abs(unit[axis]) > _LEAST_SHARE]
    return "".join(_SIDES[axis][int(unit[axis] > 0.0)] for axis in shown)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Which slices of a grid are shown, and how much of them."""

    grid: Grid  # of every array that is drawn through this view
    index: tuple[int, int, int]  # the three slices, counted along the axes closest to L, P, S
    box: tuple[slice, slice, slice]  # the part shown, along the same axes

    @classmethod
    def through(
        cls, grid: Grid, point_mm: npt.ArrayLike, around: BoolArray | None = None, margin_mm: float = 8.0
    ) -> Self:
        """The slices nearest to a point, LPS mm, cropped to a mask and a margin around it, or the whole of them.

        GeometryError if the point lies outside the grid, or the mask has another shape.
        """
        lps = grid.toward_lps()
        point = np.asarray(point_mm, dtype=np.float64)
        if point.shape != (3,) or not bool(lps.contains(point)):
            where = f"LPS {point.tolist()} mm, lies outside the grid: {grid}"
            raise GeometryError(f"The point to be shown, {where}. Give a point inside the image.")
        nearest = np.clip(np.rint(lps.indices_of(point)), 0, np.array(lps.shape) - 1).astype(int)
        spans = [slice(0, n) for n in lps.shape]
        if around is not None and around.any():
            for axis, held in enumerate(Mask(grid, around).toward_lps().box()):
                edge = round(margin_mm / lps.spacing_mm[axis])
                low, high = min(held.start, nearest[axis]) - edge, max(held.stop - 1, nearest[axis]) + edge + 1
                spans[axis] = slice(max(0, int(low)), min(lps.shape[axis], int(high)))
        i, j, k = (int(n) for n in nearest)
        return cls(grid, (i, j, k), (spans[0], spans[1], spans[2]))

    def cut(self, values: Values, plane: Plane) -> Values:
        """The slice of an array on the grid as it lies on the page: rows downward, columns to the right."""
        at = AXES[plane][0]
        page = np.take(self.shown(values), self.index[at] - self.box[at].start, axis=at).swapaxes(0, 1)
        return np.asarray(page if plane == "axial" else page[::-1])

    def shown(self, values: Values) -> Values:
        """The part of an array inside the box, axes closest to L, P, S; GeometryError for one of another shape."""
        if values.shape[:3] != self.grid.shape:
            shapes = f"of shape {values.shape} cannot be shown on a grid of {self.grid.shape}"
            raise GeometryError(f"An array {shapes}; bring it there first.")
        return reordered_to_lps(self.grid, values)[self.box]

    def extent_mm(self, plane: Plane) -> tuple[float, float, float, float]:
        """Left, right, bottom and top of the slice, mm along the grid's axes from its first voxel's centre."""
        _, across, along = AXES[plane]
        spacing = self.grid.toward_lps().spacing_mm
        ends = [[(n - 0.5) * spacing[a] for n in (self.box[a].start, self.box[a].stop)] for a in (across, along)]
        (left, right), (low, high) = ends
        return (left, right, high, low) if plane == "axial" else (left, right, low, high)

    def title(self, plane: Plane) -> str:
        """The plane with the position of the cut, or with the tilt of oblique axes."""
        lps, cut = self.grid.toward_lps(), AXES[plane][0]
        tilt = float(np.degrees(np.arccos(np.clip(lps.direction[cut, cut], -1.0, 1.0))))
        if tilt > OBLIQUE_DEG:
            return f"{plane.capitalize()}, along image axes (tilted {tilt:.0f}°)"
        at = lps.points_at(np.array(self.index, dtype=np.float64))[cut]
        return f"{plane.capitalize()}, {'xyz'[cut]} = {at:z.0f} mm".replace("-", "\u2212")
