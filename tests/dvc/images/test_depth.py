"""Depth below the border of a mask: planes and a ball, on voxels of every shape."""

import numpy as np
import pytest

from dvc import Grid
from dvc.images.depth import depth_mm, moved_mm

VOXELS = [(1.0, 1.0, 1.0), (0.8, 0.8, 1.6), (0.5, 0.5, 2.0), (0.625, 0.625, 4.0), (0.3, 0.3, 3.0)]


@pytest.mark.parametrize("spacing_mm", VOXELS)
@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_depth_below_a_plane_between_two_slices(spacing_mm: tuple[float, ...], axis: int, sign: float) -> None:
    """Across thick slices as well, whose centres lie far from the plane, compared with voxels along the others."""
    grid = Grid((24, 24, 24), spacing_mm, np.zeros(3))
    true = sign * (grid.points() - grid.centre_mm)[..., axis]
    off = depth_mm(true > 0.0, grid.spacing_mm) - true
    assert np.abs(off[2:-2, 2:-2, 2:-2]).max() < 0.1 * spacing_mm[axis]


@pytest.mark.parametrize("spacing_mm", [(1.0, 1.0, 1.0), (0.8, 0.8, 1.6)])
def test_depth_below_the_surface_of_a_ball_is_finer_than_voxels(spacing_mm: tuple[float, ...]) -> None:
    size = np.round(52.0 / np.array(spacing_mm)).astype(int)
    grid = Grid(tuple(size), spacing_mm, np.zeros(3))
    true = 20.0 - np.linalg.norm(grid.points() - grid.centre_mm, axis=-1)
    depth = depth_mm(true > 0.0, grid.spacing_mm)
    assert np.array_equal(depth > 0.0, true > 0.0)
    off = (depth - true)[np.abs(true) < 6.0]
    assert np.sqrt((off**2).mean()) < 0.18 * np.mean(spacing_mm)  # 0.29 if borders were the voxels' faces


@pytest.mark.parametrize("spacing_mm", [(1.0, 1.0, 1.0), (0.6, 0.6, 1.2)])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_slab_that_grew_by_a_voxel_moved_by_its_edge(spacing_mm: tuple[float, ...], axis: int) -> None:
    index = np.moveaxis(np.broadcast_to(np.arange(24), (24, 24, 24)), 2, axis)
    before, after = (abs(index - 11.5) < half for half in (4.0, 5.0))
    assert moved_mm(before, after, np.array(spacing_mm)) == pytest.approx([spacing_mm[axis]] * 2, rel=0.05)
    assert moved_mm(after, before, np.array(spacing_mm)) == pytest.approx(
        [-spacing_mm[axis], spacing_mm[axis]], rel=0.05
    )
    assert moved_mm(before, before, np.array(spacing_mm)) == (0.0, 0.0)


def test_nothing_moves_where_there_is_no_border() -> None:
    full = np.ones((6, 6, 6), dtype=bool)
    assert moved_mm(full, full, np.ones(3)) == (0.0, 0.0)
    assert moved_mm(~full, ~full, np.ones(3)) == (0.0, 0.0)


def test_a_mask_that_fills_the_image_has_no_border_in_it() -> None:
    inside = np.ones((6, 6, 6), dtype=bool)
    assert depth_mm(inside, np.ones(3)).min() > 10.0
    assert depth_mm(~inside, np.ones(3)).max() < -10.0
