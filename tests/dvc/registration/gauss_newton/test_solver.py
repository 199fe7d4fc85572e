"""Conjugate gradients, and their preconditioner on control grids of several spacings."""

from __future__ import annotations

import numpy as np
import pytest

from dvc.deformation.bspline import BSpline
from dvc.images.image import Grid
from dvc.registration.gauss_newton.coarser_grids import coarser, onto_coarser, onto_finer
from dvc.registration.gauss_newton.roughness import Roughness
from dvc.registration.gauss_newton.solver import by_blocks, conjugate_gradients
from dvc.registration.gauss_newton.spline_sums import SplineSums

SHAPES = [(10, 13, 12), (11, 9, 8)]


def test_conjugate_gradients_solve_a_small_system():
    random = np.random.default_rng(7)
    root = random.normal(size=(12, 12))
    A = root @ root.T + np.eye(12)
    true = np.arange(12.0).reshape(3, 4)
    x = conjugate_gradients(
        lambda v: (A @ v.ravel()).reshape(3, 4), (A @ true.ravel()).reshape(3, 4), np.copy, 1e-10, 100
    )
    np.testing.assert_allclose(x, true, atol=1e-6)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_finer_grid_holds_the_same_displacement(shape):
    spacing = np.array([2.0, 3.0, 4.0])
    random = np.random.default_rng(1)
    coarse = random.normal(size=(3, *coarser(shape)))
    points = random.uniform(spacing, (np.array(shape) - 2) * spacing, size=(200, 3))
    wide = BSpline(Grid(coarser(shape), 2.0 * spacing, -2.0 * spacing), coarse)
    fine = BSpline(Grid(shape, spacing, np.zeros(3)), onto_finer(coarse, shape))
    np.testing.assert_allclose(fine.displacement(points), wide.displacement(points), atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
def test_forces_go_onto_the_coarser_grid_by_the_transpose(shape):
    random = np.random.default_rng(2)
    force, coarse = random.normal(size=(3, *shape)), random.normal(size=(3, *coarser(shape)))
    assert np.sum(onto_coarser(force) * coarse) == pytest.approx(np.sum(force * onto_finer(coarse, shape)), rel=1e-12)


@pytest.mark.parametrize("grid", [1, 2])
@pytest.mark.parametrize("laplacians", [1, 2])
def test_roughness_of_wider_splines(grid, laplacians):
    control = Grid((33, 34, 35), np.array([3.0, 3.2, 2.9]), np.zeros(3))
    rough = Roughness(control, ((2.0, 0.01),), laplacians)
    one = widened(control.shape, grid)
    assert np.sum(one * rough.product(one)) == pytest.approx(middle(rough.diagonals(grid)[0]), rel=1e-10)


@pytest.mark.parametrize("grid", [1, 2])
def test_blocks_of_wider_splines(grid):
    """Of points that are all alike; a sum over fewer of them is off by some hundredths."""
    control = Grid((19, 20, 21), np.array([3.0, 3.2, 2.9]), np.zeros(3))
    along = [np.arange(1.1, n - 2.0, 0.5) for n in control.shape]
    shape = tuple(a.size for a in along)
    points = SplineSums(control, along, np.ones(shape, dtype=bool))
    N, volume, shear = np.broadcast_to([3.0, 1.0, 0.5, 2.0, 0.2, 1.0], (*shape, 6)).copy(), *np.ones((2, *shape))
    unstrained = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
    one = widened(control.shape, grid)
    for parts in ((N, 0.0 * volume, 0.0 * shear), (0.0 * N, volume, 0.0 * shear), (0.0 * N, 0.0 * volume, shear)):
        found = middle(points.own_blocks(*parts)[grid][0])
        exact = np.sum(one * points.product(one, (parts[0], unstrained, *parts[1:])))
        assert found == pytest.approx(exact, rel=0.05)


def test_the_preconditioner_is_symmetric_and_positive():
    random = np.random.default_rng(3)
    shape = (10, 13, 12)
    grids = [shape, coarser(shape), coarser(coarser(shape))]
    roots = [random.normal(size=(*grid, 2, 3, 3)) for grid in grids]
    full = [root @ np.swapaxes(root, -1, -2) + np.eye(3) for root in roots]
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    blocks = [np.stack([A[..., s, m, n] for s in range(2) for m, n in pairs]) for A in full]
    preconditioned = by_blocks(blocks)
    a, b = random.normal(size=(2, 6, *shape))
    assert np.sum(a * preconditioned(b)) == pytest.approx(np.sum(b * preconditioned(a)), rel=1e-10)
    assert np.sum(a * preconditioned(a)) > 0.0
    alone = by_blocks(blocks[:1])(a)
    x = np.moveaxis(alone.reshape(2, 3, *shape), (0, 1), (-2, -1))
    np.testing.assert_allclose(
        np.einsum("...mn,...n", full[0], x), np.moveaxis(a.reshape(2, 3, *shape), (0, 1), (-2, -1))
    )


def widened(shape: tuple[int, ...], grid: int) -> np.ndarray:
    """Coefficients, of the first component, of one spline in the middle of a coarser grid."""
    grids = [shape]
    for _ in range(grid):
        grids.append(coarser(grids[-1]))
    one = np.zeros((3, *grids.pop()))
    one[0, one.shape[1] // 2, one.shape[2] // 2, one.shape[3] // 2] = 1.0
    for finer in reversed(grids):
        one = onto_finer(one, finer)
    return one


def middle(field: np.ndarray) -> float:
    i, j, k = field.shape
    return float(field[i // 2, j // 2, k // 2])
