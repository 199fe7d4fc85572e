"""The standard deviation of a boundary's position, from probabilities whose boundary has a known one."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from dvc.images.image import Grid, LabelMap
from dvc.labelling.boundary_position import position_sd_mm
from dvc.labelling.tissues import TissueLabels

NAMES = {1: "fat", 2: "muscle", 3: "bone"}


@pytest.mark.parametrize("sd_mm", [0.3, 0.6, 1.2])
def test_a_ball_of_muscle_whose_surface_has_a_known_position_uncertainty(sd_mm: float) -> None:
    grid = Grid((40, 48, 36), np.array([0.9, 0.8, 1.0]), np.zeros(3))
    points = grid.points()
    depth_mm = 9.0 - np.linalg.norm(points - points.reshape(-1, 3).mean(axis=0), axis=-1)
    muscle = ndtr(depth_mm / sd_mm)
    bone = np.zeros(grid.shape, dtype=bool)
    bone[:4] = True  # exact, and its boundary is not one of soft tissues
    probability = np.stack([np.where(bone, 0.0, 1.0 - muscle), muscle * ~bone, bone])
    labels = LabelMap(grid, probability.argmax(axis=0) + 1, NAMES)
    found = position_sd_mm(TissueLabels(labels, probability.astype(np.float32)))
    assert found == {"fat": pytest.approx(sd_mm, rel=0.08), "muscle": pytest.approx(sd_mm, rel=0.08)}


@pytest.mark.parametrize("room", [0, 14])
def test_a_probability_far_from_the_boundary_does_not_count(room: int) -> None:
    """Without a limit to what is near, 2 % everywhere would make 2 mm of .5 mm, and 12 mm with more room around."""
    shape = tuple(n + 2 * room for n in (34, 36, 32))
    grid = Grid(shape, np.full(3, 0.8), np.zeros(3))
    points = grid.points()
    depth_mm = 9.0 - np.linalg.norm(points - points.reshape(-1, 3).mean(axis=0), axis=-1)
    muscle = 0.02 + 0.96 * ndtr(depth_mm / 0.5)
    probability = np.stack([1.0 - muscle, muscle]).astype(np.float32)
    labels = LabelMap(grid, probability.argmax(axis=0) + 1, {1: "fat", 2: "muscle"})
    found = position_sd_mm(TissueLabels(labels, probability))
    assert found["muscle"] == pytest.approx(0.68, abs=0.02)
    even = np.full_like(probability, 0.5)
    assert position_sd_mm(TissueLabels(labels, even + (probability - 0.5) * 1e-3))["fat"] == 1.6  # two voxels


def test_a_boundary_that_is_certain_has_none() -> None:
    grid = Grid((12, 12, 12), np.ones(3), np.zeros(3))
    labels = np.ones(grid.shape, dtype=np.int64)
    labels[6:] = 2
    certain = np.stack([labels == n for n in NAMES]).astype(np.float32)
    assert position_sd_mm(TissueLabels(LabelMap(grid, labels, NAMES), certain)) == {"fat": 0.0, "muscle": 0.0}
