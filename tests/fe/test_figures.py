"""Slices of meshes lie on the page as slices of images do: the patient's left, or posterior, is on the right."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes

from dvc.mesh import TetMesh
from fe import Plate
from fe.figures import Slice, mesh_slice, slice_sheet
from tests.blocks import block

UP, ANTERIOR, LEFT = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0)
SEEN = [
    (UP, ANTERIOR, "APSI"), (UP, LEFT, "RLSI"), (ANTERIOR, LEFT, "RLAP"), (ANTERIOR, UP, "ISAP"),
    (UP, (0.0, -0.6, 0.8), "APSI"),
]  # fmt: skip
"""The force of a plate, a direction of shear, and the sides of the slice: left, right, top and bottom."""


def sides(axes: Axes) -> str:
    return "".join(text.get_text() for text in axes.texts[:4])


def halves(normal: np.ndarray, across: np.ndarray) -> tuple[TetMesh, np.ndarray]:
    """A block cut in two where ``across``, (3,) LPS, passes its middle; how far its cells lie along it."""
    box = block((6, 6, 6), (12.0, 12.0, 12.0))
    along = (box.points_mm[box.cells].mean(axis=1) - 6.0) @ across
    regions = {"skin": np.flatnonzero(along < 0.0), "fat": np.flatnonzero(along >= 0.0)}
    return TetMesh(box.points_mm, box.cells, regions, {}), along


@pytest.mark.parametrize("way", [1.0, -1.0])
@pytest.mark.parametrize(("normal", "shear", "letters"), SEEN)
def test_a_slice_lies_as_radiologists_read_it_whichever_way_the_plate_shears(
    normal: tuple[float, ...], shear: tuple[float, ...], letters: str, way: float
) -> None:
    plate = Plate(-np.array(normal), way * np.array(shear))
    right = {"L": LEFT, "P": (0.0, 1.0, 0.0), "S": UP}[letters[1]]
    mesh, along = halves(np.array(normal), np.array(right))
    still, middle = np.zeros_like(mesh.points_mm), np.full(3, 6.0)
    face = 5.0 - 0.5 * middle @ plate.axes[:, 1], 0.5  # rises with the shear
    panel = slice_sheet(mesh, [Slice("one", still, 0.1 + 0.01 * along, face)], plate.axes, middle).axes[0]
    assert sides(panel) == letters
    (cells,) = panel.collections
    x = [path.vertices[:, 0].mean() for path in cells.get_paths()]
    assert np.corrcoef(x, cells.get_array())[0, 1] > 0.95
    (line,) = [one for one in panel.lines if one.get_linestyle() == "--"]
    assert line.get_slope() == pytest.approx(0.5 * np.sign(plate.axes[:, 1] @ right))  # type: ignore[attr-defined]
    whole = mesh_slice(mesh, plate).axes[0]
    assert sides(whole) == letters
    middles = {of.get_label(): np.mean([p.vertices[:, 0].mean() for p in of.get_paths()]) for of in whole.collections}
    assert middles["skin"] < middles["fat"]


@pytest.mark.parametrize(("count", "columns"), [(1, 1), (2, 2), (4, 2), (5, 3), (7, 3)])
def test_many_slices_stand_in_three_columns_so_that_they_fit_on_a_printed_page(count: int, columns: int) -> None:
    plate = Plate(-np.array(UP), np.array(ANTERIOR))
    mesh, along = halves(np.array(UP), np.array(LEFT))
    field = Slice("one", np.zeros_like(mesh.points_mm), 0.1 + 0.01 * along)
    figure = slice_sheet(mesh, [field] * count, plate.axes, np.full(3, 6.0))
    spots = [axes for axes in figure.axes if axes.get_title() == "one"]
    assert len(spots) == count
    assert len({round(axes.get_position().x0, 4) for axes in spots}) == columns
    width, height = figure.get_size_inches()
    assert height < 1.3 * width or count < 3
