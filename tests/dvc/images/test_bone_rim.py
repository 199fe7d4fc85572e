"""The surface of a bone is placed at its dark rim, and stays where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion

from dvc.images.bone_rim import bone_to_rim
from dvc.images.depth import depth_mm
from dvc.images.image import Grid, Image, Mask

GRID = Grid((48, 48, 48), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
FROM_CENTRE = GRID.points().reshape(48, 48, 48, 3) - 23.5
RADIUS = np.linalg.norm(FROM_CENTRE, axis=-1)
BONE, BODY = RADIUS < 15.0, RADIUS < 21.0
LEFT = FROM_CENTRE[..., 0] > 4.0  # has a rim in both images
RIGHT = FROM_CENTRE[..., 0] < -4.0


def ball(rim: np.ndarray, snr: float = 14.0) -> Image:
    """A ball of bone in bright tissue, its outer 1.5 mm dark where ``rim`` says so."""
    values = np.where(BODY, 1.0, 0.0)
    values[BONE & (RADIUS > 13.5) & rim] = 0.15
    noise = np.random.default_rng(0).normal(0.0, 1.0 / snr, values.shape)
    return Image(GRID, np.abs(values + noise).astype(np.float32))


def off_mm(image: Image, mask: np.ndarray, side: np.ndarray) -> float:
    """How far the surface found lies from the true one on one side, root mean square, mm."""
    found = bone_to_rim(image, Mask(GRID, mask), Mask(GRID, BODY)).inside
    true = depth_mm(BONE, GRID.spacing_mm)
    error = depth_mm(found, GRID.spacing_mm) - true
    return float(np.sqrt(np.mean(error[(np.abs(true) < 0.5) & side] ** 2)))


@pytest.mark.parametrize("drawn", [BONE, binary_dilation(BONE), binary_erosion(BONE)], ids=["exact", "large", "small"])
@pytest.mark.parametrize("rim", [np.ones_like(BONE), FROM_CENTRE[..., 0] > 0.0], ids=["all around", "half"])
def test_the_surface_lies_at_the_rim_wherever_the_mask_was_drawn(drawn: np.ndarray, rim: np.ndarray) -> None:
    """A mask that is off by a voxel is off by .8 mm or more."""
    assert off_mm(ball(rim), drawn, LEFT) < 0.25


def test_a_surface_without_a_rim_stays() -> None:
    """Where the other half has one, it moved by 1 mm, as far as the darkest noise."""
    half, none = FROM_CENTRE[..., 0] > 0.0, np.zeros_like(BONE)
    assert off_mm(ball(half), BONE, RIGHT) < 0.05
    assert off_mm(ball(none, snr=8.0), BONE, np.ones_like(BONE)) == 0.0
