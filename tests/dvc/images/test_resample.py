"""Images carried in space: closed forms, and missing voxels that touch nothing beside them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from dvc.deformation.protocol import Affine, RigidMotion
from dvc.images.image import Grid, Image, Mask
from dvc.images.resample import carry, fill_missing, shows, smoothed
from dvc.registration.align import _scored
from mrstrain.records.provenance import file_hash

GRID = Grid((20, 18, 16), np.array([1.0, 1.5, 2.0]), np.array([-5.0, 3.0, 8.0]))


def linear(points: np.ndarray) -> np.ndarray:
    return 2.0 * points[..., 0] - points[..., 1] + 0.5 * points[..., 2] + 50.0


@pytest.mark.parametrize("order", [1, 3])
def test_a_linear_image_is_carried_exactly_and_is_nan_outside(order):
    image = Image(GRID, linear(GRID.points()))
    fine = Grid((12, 12, 12), np.full(3, 0.7), np.array([0.0, 8.0, 14.0]))
    shift = np.array([0.3, -0.4, 0.9])
    got = carry(image, fine, Affine(np.eye(3), shift), order=order)
    np.testing.assert_allclose(got, linear(fine.points() + shift), rtol=2e-3 if order == 3 else 1e-6)
    beyond = carry(image, GRID, Affine(np.eye(3), np.array([5.0, 0.0, 0.0])), order=order)
    assert np.isnan(beyond[-4:]).all()
    assert np.isfinite(beyond[:14]).all()


@pytest.mark.parametrize("order", [1, 3])
def test_an_oblique_image_is_carried_as_scipy_interpolates_it(order):
    """By a rotation and a displacement of each voxel; where that is NaN, so is the image."""
    random = np.random.default_rng(7)
    turned = Rotation.from_rotvec((0.3, -0.2, 0.5)).as_matrix()
    image = Image(Grid((15, 16, 17), (1.2, 0.9, 1.5), (2.0, -3.0, 1.0), turned), random.normal(size=(15, 16, 17)))
    grid = Grid((11, 12, 13), (1.0, 1.3, 0.8), image.grid.centre_mm - 5.0)
    motion = RigidMotion(Rotation.from_rotvec((0.1, 0.2, -0.1)).as_matrix(), np.array([1.0, 0.5, -2.0]))
    u = random.normal(size=(*grid.shape, 3))
    u[3, 4, 5] = np.nan
    got = carry(image, grid, motion, order=order, displacement_mm=u)
    at = image.grid.indices_of(motion.apply((grid.points() + u).reshape(-1, 3))).T
    expected = map_coordinates(image.values, at, order=order, mode="mirror").reshape(grid.shape)
    inside = ((at >= 0) & (np.array(image.grid.shape) - 1 >= at.T).T).all(axis=0).reshape(grid.shape)
    assert 0.3 < inside.mean() < 0.95
    assert np.array_equal(np.isfinite(got), inside)
    np.testing.assert_allclose(got[inside], expected[inside], atol=1e-5)


@pytest.mark.parametrize("order", [1, 3])
def test_a_gap_is_nan_and_bends_nothing_beside_it(order):
    values = linear(GRID.points())
    whole = carry(Image(GRID, values), GRID, Affine(np.eye(3), np.full(3, 0.4)), order=order)
    values[:6] = np.nan
    holed = Image(GRID, values)
    got = carry(holed, GRID, Affine(np.eye(3), np.full(3, 0.4)), order=order)
    assert np.isnan(got[:6]).all()
    np.testing.assert_allclose(got[9:-1, :-1, :-1], whole[9:-1, :-1, :-1], rtol=3e-3)
    seen = shows(holed, GRID.points()[2:9].reshape(-1, 3)).reshape(7, 18, 16)
    assert not seen[:4].any()
    assert seen[4:].all()


def test_gaps_are_filled_from_the_nearest_in_space():
    values = np.ones(GRID.shape)
    values[10:] = 5.0
    values[8:10] = np.nan
    filled = fill_missing(Image(GRID, values)).values
    assert (filled[8] == 1.0).all()
    assert (filled[9] == 5.0).all()
    assert np.isnan(smoothed(Image(GRID, values), 1.0).values[8:10]).all()


def test_the_search_scores_an_image_with_itself_as_one():
    random = np.random.default_rng(2)
    from scipy.ndimage import gaussian_filter

    grid = Grid((48, 48, 48), np.ones(3), np.zeros(3))
    image = Image(grid, gaussian_filter(random.normal(size=grid.shape), 4.0))
    inside = np.zeros(grid.shape, dtype=bool)
    inside[16:32, 14:34, 16:30] = True
    ((score, motion),) = _scored(image, image, Mask(grid, inside), [np.eye(3)])
    assert score == pytest.approx(1.0, abs=0.05)
    assert np.linalg.norm(motion.displacement(np.full((1, 3), 24.0))) < 4.0
    assert isinstance(motion, RigidMotion)


def test_a_hash_follows_the_voxels_that_a_header_names(tmp_path):
    (tmp_path / "a.mhd").write_text("NDims = 3\nElementDataFile = a.raw\n")
    (tmp_path / "a.raw").write_bytes(b"one")
    first = file_hash(tmp_path / "a.mhd")
    (tmp_path / "a.raw").write_bytes(b"two")
    assert file_hash(tmp_path / "a.mhd") != first
