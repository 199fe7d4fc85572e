"""The B-spline against its definition, summed by brute force, and against finite differences."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.ndimage import map_coordinates, spline_filter
from scipy.spatial.transform import Rotation

from dvc import threads
from dvc.deformation.bspline import BSpline, evaluate_spline
from dvc.deformation.protocol import Composed, GridDeformation, RigidMotion, SampledDisplacement, evaluate_on_grid
from dvc.errors import GeometryError, InputError
from dvc.images.image import Grid

OBLIQUE = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
PERMUTED = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MIRROR = np.diag([1.0, 1.0, -1.0])
SHAPE = (6, 7, 8)
SPACING = np.array([4.0, 5.0, 3.0])


def random_spline(direction: np.ndarray, seed: int = 0) -> BSpline:
    control = Grid(SHAPE, SPACING, (10.0, -20.0, 30.0), direction)
    return BSpline(control, np.random.default_rng(seed).normal(size=(3, *SHAPE)))


def inside(b: BSpline, count: int, seed: int = 1) -> np.ndarray:
    indices = np.random.default_rng(seed).uniform(1.0, np.array(b.control.shape) - 2.0, size=(count, 3))
    return b.control.points_at(indices)


def cubic(t: np.ndarray) -> np.ndarray:
    """The centred cubic B-spline by truncated powers, its textbook definition."""
    weights = [1, -4, 6, -4, 1]
    return sum(w * np.maximum(t + 2 - i, 0.0) ** 3 for i, w in enumerate(weights)) / 6.0


def by_definition(b: BSpline, points: np.ndarray) -> np.ndarray:
    t = b.control.indices_of(points)
    i, j, k = (cubic(t[:, a, None] - np.arange(n)) for a, n in enumerate(b.control.shape))
    return np.einsum("ni,nj,nk,cijk->nc", i, j, k, b.coefficients_mm)


@pytest.mark.parametrize("direction", [np.eye(3), OBLIQUE, PERMUTED, OBLIQUE @ MIRROR])
def test_displacement_is_the_sum_over_all_control_points(direction: np.ndarray) -> None:
    b = random_spline(direction)
    points = inside(b, 200)
    np.testing.assert_allclose(b.displacement(points), by_definition(b, points), rtol=0, atol=1e-12)
    u, _ = b.evaluate(points)
    assert np.array_equal(u, b.displacement(points))


@pytest.mark.parametrize("direction", [np.eye(3), OBLIQUE, PERMUTED, OBLIQUE @ MIRROR])
def test_gradient_equals_differences_with_their_order(direction: np.ndarray) -> None:
    """Central differences err by the square of their step, within a knot interval, and by nothing else."""
    b = random_spline(direction)
    middle = np.random.default_rng(2).uniform(0.1, 0.9, size=(100, 3))
    knots = np.random.default_rng(3).integers(1, np.array(SHAPE) - 3, size=(100, 3))
    points = b.control.points_at(knots + middle)
    _, H = b.evaluate(points)
    errors = []
    for step in (0.2, 0.1):
        differences = np.empty_like(H)
        for axis in range(3):
            h = np.eye(3)[axis] * step
            differences[:, :, axis] = (b.displacement(points + h) - b.displacement(points - h)) / (2 * step)
        errors.append(np.abs(differences - H).max())
    assert errors[1] < 4e-3
    assert np.log2(errors[0] / errors[1]) > 1.9
    tiny = 1e-6
    for axis in range(3):
        h = np.eye(3)[axis] * tiny
        slope = (b.displacement(points + h) - b.displacement(points - h)) / (2 * tiny)
        np.testing.assert_allclose(H[:, :, axis], slope, rtol=0, atol=1e-8)


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=25, deadline=None)
def test_reproduces_linear_fields_exactly(seed: int) -> None:
    """Coefficients that are linear in space give that linear displacement, and its constant gradient."""
    rng = np.random.default_rng(seed)
    direction = Rotation.random(random_state=rng).as_matrix() @ np.diag([1.0, 1.0, rng.choice([-1.0, 1.0])])
    control = Grid((5, 6, 7), rng.uniform(0.5, 8.0, 3), rng.uniform(-100, 100, 3), direction)
    gradient, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
    coefficients = np.moveaxis(control.points() @ gradient.T + shift, -1, 0)
    b = BSpline(control, coefficients)
    points = inside(b, 20, seed)
    u, H = b.evaluate(points)
    np.testing.assert_allclose(u, points @ gradient.T + shift, rtol=0, atol=1e-10)
    np.testing.assert_allclose(H, np.broadcast_to(gradient, H.shape), rtol=0, atol=1e-10)


IMAGE_DIRECTIONS = {
    "same": np.eye(3),
    "permuted": PERMUTED,
    "flipped": np.diag([-1.0, 1.0, -1.0]),
    "left-handed": MIRROR @ PERMUTED,
    "askew": Rotation.from_euler("z", 7, degrees=True).as_matrix(),
    "slightly askew": Rotation.from_euler("z", 1e-5).as_matrix(),
}


@pytest.mark.parametrize("control_direction", [np.eye(3), OBLIQUE])
@pytest.mark.parametrize("image_direction", list(IMAGE_DIRECTIONS))
def test_grid_equals_points(control_direction: np.ndarray, image_direction: str) -> None:
    """Axis by axis or point by point: the same, over voxels that reach beyond the valid region."""
    b = random_spline(control_direction)
    direction = control_direction @ IMAGE_DIRECTIONS[image_direction]
    spacing = np.array([0.75, 0.9, 0.6])
    shape = (21, 25, 31)
    grid = Grid(shape, spacing, b.control.centre_mm - direction @ (spacing * (np.array(shape) - 1) / 2), direction)
    where = np.random.default_rng(4).random(shape) < 0.3
    where[3] = where[:, 5] = where[:, :, 7] = False
    assert isinstance(b, GridDeformation)
    u, H = evaluate_on_grid(b, grid, where)
    expected_u, expected_H = b.evaluate(grid.points(where))
    assert 0.1 < np.isnan(expected_u).any(axis=1).mean() < 0.7
    np.testing.assert_allclose(u, expected_u, rtol=0, atol=1e-12, equal_nan=True)
    np.testing.assert_allclose(H, expected_H, rtol=0, atol=1e-12, equal_nan=True)


def test_grid_without_voxels_and_with_a_wrong_mask() -> None:
    b = random_spline(np.eye(3))
    grid = Grid((4, 5, 6), (1.0, 1.0, 1.0), b.control.centre_mm)
    u, H = b.evaluate_on_grid(grid, np.zeros(grid.shape, dtype=bool))
    assert u.shape == (0, 3)
    assert H.shape == (0, 3, 3)
    with pytest.raises(InputError, match="shape"):
        b.evaluate_on_grid(grid, np.ones((5, 5, 6), dtype=bool))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_valid_region(axis: int) -> None:
    """From the second control point to the last but one, that one left out; NaN beyond, never zero."""
    b = BSpline(Grid(SHAPE, (4.0, 4.0, 4.0), (0.0, 0.0, 0.0)), np.ones((3, *SHAPE)))
    end = 4.0 * (SHAPE[axis] - 2)
    along = np.array([-1e9, 0.0, 3.999, 4.0, 4.001, end - 0.001, end, end + 0.001, 1e9, np.nan])
    points = np.full((len(along), 3), 8.0)
    points[:, axis] = along
    u, H = b.evaluate(points)
    expected = [False, False, False, True, True, True, False, False, False, False]
    assert np.isfinite(u).all(axis=1).tolist() == expected
    assert np.isfinite(H).all(axis=(1, 2)).tolist() == expected
    assert np.isfinite(b.displacement(points)).all(axis=1).tolist() == expected
    np.testing.assert_allclose(u[expected], 1.0, rtol=0, atol=1e-15)
    np.testing.assert_allclose(H[expected], 0.0, rtol=0, atol=1e-15)


def test_undefined_points_stay_undefined_in_a_chain() -> None:
    b = random_spline(np.eye(3))
    motion = RigidMotion(np.eye(3), np.array([1.0, 0.0, 0.0]))
    far = np.array([[1e3, 0.0, 0.0]])
    values = np.zeros((4, 4, 4, 3))
    values[0, 0, 0] = np.nan
    sampled = SampledDisplacement(Grid((4, 4, 4), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), values)
    for parts in ([b, motion], [motion, b], [b, motion, b], [b, b], [b, sampled]):
        u, H = Composed(parts).evaluate(far)
        assert np.isnan(u).all()
        assert np.isnan(H).all()


def test_sum() -> None:
    first, second = random_spline(OBLIQUE, 0), random_spline(OBLIQUE, 1)
    points = inside(first, 20)
    total = first.plus(second).displacement(points)
    expected = first.displacement(points) + second.displacement(points)
    np.testing.assert_allclose(total, expected, rtol=0, atol=1e-12)
    with pytest.raises(GeometryError, match="different control grids"):
        first.plus(random_spline(np.eye(3)))
    moved = Grid(SHAPE, SPACING, first.control.origin_mm + 1e-4, OBLIQUE)
    with pytest.raises(GeometryError, match="different control grids"):
        first.plus(BSpline(moved, second.coefficients_mm))


def test_refuses_what_does_not_fit() -> None:
    control = Grid((4, 4, 4), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="component first"):
        BSpline(control, np.zeros((4, 4, 4, 3)))
    with pytest.raises(InputError, match="four control points"):
        BSpline(Grid((4, 3, 4), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), np.zeros((3, 4, 3, 4)))
    given = np.zeros((3, 4, 4, 4))
    b = BSpline(control, given)
    given[0, 0, 0, 0] = 1.0  # the caller's array stays writable
    with pytest.raises(ValueError, match="read-only"):
        b.coefficients_mm[0, 0, 0, 0] = 1.0


# --- the kernel that sampled displacements share -----------------------------------------------------------


@pytest.mark.parametrize("shape", [(2, 3, 4), (5, 6, 7), (12, 4, 9)])
def test_mirrored_spline_equals_scipy(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(6)
    values = rng.normal(size=(2, *shape))
    coefficients = np.stack([spline_filter(v, order=3, mode="mirror") for v in values])
    indices = rng.uniform(-2.0, np.array(shape) + 1.0, size=(300, 3))
    found, slopes = evaluate_spline(coefficients, indices, mirror=True)
    expected = np.stack(
        [map_coordinates(c, indices.T, order=3, mode="mirror", prefilter=False) for c in coefficients], axis=1
    )
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    for axis in range(3):
        h = 1e-6 * np.eye(3)[axis]
        ahead, _ = evaluate_spline(coefficients, indices + h, mirror=True)
        behind, _ = evaluate_spline(coefficients, indices - h, mirror=True)
        np.testing.assert_allclose(slopes[:, :, axis], (ahead - behind) / 2e-6, rtol=0, atol=2e-8)


def test_mirrored_spline_interpolates_and_answers_nan_for_nan() -> None:
    values = np.random.default_rng(7).normal(size=(1, 5, 6, 7))
    coefficients = np.stack([spline_filter(v, order=3, mode="mirror") for v in values])
    corners = np.argwhere(np.ones((5, 6, 7))).astype(float)
    found, _ = evaluate_spline(coefficients, corners, mirror=True)
    np.testing.assert_allclose(found[:, 0], values[0].ravel(), rtol=0, atol=1e-12)
    found, slopes = evaluate_spline(coefficients, np.array([[np.nan, 1.0, 1.0], [np.inf, 1.0, 1.0]]), mirror=True)
    assert np.isnan(found).all()
    assert np.isnan(slopes).all()


def test_sampled_displacement_of_a_spline_comes_back() -> None:
    """A smooth displacement sampled on voxels gives back its gradient, away from the borders."""
    b = random_spline(OBLIQUE)
    grid = Grid((31, 31, 31), (0.3, 0.3, 0.3), b.control.centre_mm - OBLIQUE @ np.full(3, 4.5), OBLIQUE)
    u, _ = b.evaluate_on_grid(grid, np.ones(grid.shape, dtype=bool))
    sampled = SampledDisplacement(grid, u.reshape(*grid.shape, 3))
    points = grid.points_at(np.random.default_rng(8).uniform(9, 21, size=(50, 3)))
    found_u, found_H = sampled.evaluate(points)
    expected_u, expected_H = b.evaluate(points)
    np.testing.assert_allclose(found_u, expected_u, rtol=0, atol=2e-4)
    np.testing.assert_allclose(found_H, expected_H, rtol=0, atol=2e-3)


@pytest.mark.parametrize("direction", [np.eye(3), OBLIQUE @ MIRROR])
def test_a_uniform_strain_stays_so_up_to_the_outermost_voxels(direction: np.ndarray) -> None:
    grid = Grid((20, 17, 14), (1.0, 1.5, 0.8), (5.0, -3.0, 8.0), direction)
    gradient = np.array([[0.2, 0.1, 0.0], [-0.3, 0.1, 0.2], [0.0, 0.4, -0.1]])
    u = grid.points().reshape(*grid.shape, 3) @ gradient.T + np.array([1.0, -2.0, 3.0])
    ball = ((np.indices(grid.shape) - np.reshape([8.0, 6.0, 4.0], (3, 1, 1, 1))) ** 2).sum(axis=0) < 60.0
    for defined in (np.ones(grid.shape, dtype=bool), ball):  # the ball is cut off by three sides of the grid
        sampled = SampledDisplacement(grid, np.where(defined[..., None], u, np.nan))
        found, H = evaluate_on_grid(sampled, grid)
        known = defined.ravel()
        np.testing.assert_allclose(found[known], u.reshape(-1, 3)[known], rtol=0, atol=1e-10)
        assert np.isnan(found[~known]).all()
        # the rim of six voxels leaves 0.27**6 of the slope; without it 1.0 of it is lost at the grid's edge, and by
        # filling with the nearest value 0.5 at the ball's
        assert np.abs(H[known] - gradient).max() < 0.002


# --- threads -----------------------------------------------------------------------------------------------


def test_same_bits_on_one_and_two_threads() -> None:
    b = random_spline(np.eye(3))
    grid = Grid((20, 20, 20), (0.5, 0.5, 0.5), b.control.centre_mm - 4.0)
    where = np.ones(grid.shape, dtype=bool)
    before = threads.count()
    results = []
    try:
        for count in (1, 2):
            threads.use(count)
            results.append((*b.evaluate_on_grid(grid, where), *b.evaluate(grid.points(where))))
    finally:
        threads.use(before)
    for one, two in zip(*results, strict=True):
        assert np.array_equal(one, two, equal_nan=True)


def test_import_compiles_nothing() -> None:
    code = "import dvc.deformation.bspline as b; print(len(b._at_indices.signatures) + len(b._on_grid.signatures))"
    root = Path(__file__).resolve().parents[3]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "0"
