"""Conjugate gradients, and their preconditioner on control grids of several spacings."""

from __future__ import annotations

import numpy as np
import pytest

from dvc.deformation.bspline import BSpline
from dvc.images.image import Grid
from dvc.registration.gauss_newton.coarser_grids import coarser, onto_coarser, onto_finer
from dvc.registration.gauss_newton.roughness import Roughness
from dvc.registration.gauss_newton.solver import by_blocks, conjugate_gradients, with_local_jump
from dvc.registration.gauss_newton.spline_sums import SplineSums
from dvc.registration.gauss_newton.sweeps import Stiffness

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


SHIFT = 3.0
CONTROL = Grid((9, 10, 11), np.array([3.0, 3.2, 2.9]), np.zeros(3))
ALIKE = 0.8, 0.8 * SHIFT  # factors of two splines that move all points alike


def test_a_preconditioner_for_a_local_jump_is_one_for_both_splines():
    """D acts on v + L w and w: exactly inverted there, it is inverted for v and w."""
    random, shape = np.random.default_rng(4), (6, 7, 8)
    root = random.normal(size=(*shape, 2, 3, 3))
    D = root @ np.swapaxes(root, -1, -2) + np.eye(3)
    blocks = np.stack([D[..., s, m, n] for s in range(2) for m, n in zip(*np.triu_indices(3), strict=True)])
    v, w = force = random.normal(size=(2, 3, *shape))
    found = with_local_jump(by_blocks([blocks]), SHIFT)(force.reshape(6, *shape))
    x, y = np.moveaxis(found.reshape(2, 3, *shape), 1, -1)
    by_sum, by_w = (np.einsum("...mn,...n", D[..., s, :, :], of) for s, of in enumerate((x + SHIFT * y, y)))
    np.testing.assert_allclose(np.moveaxis(by_sum, -1, 0), v, atol=1e-10)
    np.testing.assert_allclose(np.moveaxis(by_w + SHIFT * by_sum, -1, 0), w, atol=1e-10)


def two_splines(shift: float) -> tuple[SplineSums, Stiffness]:
    random = np.random.default_rng(6)
    along = [np.arange(1.1, n - 2.0, 0.4) for n in CONTROL.shape]
    shape = tuple(a.size for a in along)
    factors = np.zeros((*shape, 2, 4))
    factors[..., 0] = ALIKE
    N = np.broadcast_to([3.0, 1.0, 0.5, 2.0, 0.2, 1.0], (*shape, 6)) * random.uniform(size=(*shape, 1))
    unstrained = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
    sums = SplineSums(CONTROL, along, random.uniform(size=shape) < 0.7, factors, shift)
    return sums, (N, unstrained, *random.uniform(size=(2, *shape)))


@pytest.mark.parametrize("shift", [0.0, 0.4])
def test_own_blocks_are_those_of_the_first_spline_and_a_share_of_the_second(shift):
    sums, stiffness = two_splines(shift)
    found = sums.own_blocks(stiffness[0], *stiffness[2:])[0][:, 4, 5, 3].reshape(2, 6)
    for spline, mixed in enumerate(([1.0, 0.0], [-shift, 1.0])):
        for m, row in enumerate(([0, 1, 2], [1, 3, 4], [2, 4, 5])):
            one = np.zeros((2, 3, *CONTROL.shape))
            one[:, m, 4, 5, 3] = mixed
            pushed = sums.product(one.reshape(6, *CONTROL.shape), stiffness)[:, 4, 5, 3].reshape(2, 3)
            np.testing.assert_allclose(found[spline, row], np.array(mixed) @ pushed, rtol=1e-10)


def test_two_splines_that_do_the_same_are_solved_by_what_they_do_together():
    """As away from the bone. Each spline's own blocks leave four times as much of the energy."""
    rough = Roughness(CONTROL, ((1e-3, 1e-5), (3e-2, 2e-2)))
    x = np.random.default_rng(8).normal(size=(6, *CONTROL.shape))

    def left(shift: float) -> float:
        sums, stiffness = two_splines(shift)

        def product(c: np.ndarray) -> np.ndarray:
            return sums.product(c, stiffness) + rough.product(c)

        blocks = sums.own_blocks(stiffness[0], *stiffness[2:])
        for grid, own in enumerate(blocks):
            of_v, of_w = rough.diagonals(grid)
            own[[0, 3, 5]] += of_v
            own[[6, 9, 11]] += of_w + shift**2 * of_v
        off = conjugate_gradients(product, product(x), with_local_jump(by_blocks(blocks), shift), 0.0, 20) - x
        return float(np.sum(off * product(off)))

    assert left(SHIFT) < 0.5 * left(0.0)


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
