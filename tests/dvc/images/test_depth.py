"""Depth below the border of a mask: planes and a ball, on voxels of every shape."""

import numpy as np
import pytest

from dvc import Grid
from dvc.images.depth import depth_mm

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


def test_a_mask_that_fills_the_image_has_no_border_in_it() -> None:
    inside = np.ones((6, 6, 6), dtype=bool)
    assert depth_mm(inside, np.ones(3)).min() > 10.0
    assert depth_mm(~inside, np.ones(3)).max() < -10.0
