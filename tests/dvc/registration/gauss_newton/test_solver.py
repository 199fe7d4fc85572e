"""Conjugate gradients, and their preconditioner on control grids of several spacings."""

from __future__ import annotations

import numpy as np
import pytest

from dvc import threads
from dvc.deformation.bspline import BSpline
from dvc.images.image import Grid
from dvc.registration.gauss_newton.coarser_grids import coarser, on_diagonal, onto_coarser, onto_finer
from dvc.registration.gauss_newton.roughness import Roughness
from dvc.registration.gauss_newton.solver import by_blocks, conjugate_gradients
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
    roots = [random.normal(size=(*grid, 6, 6)) for grid in grids]
    full = [root @ np.swapaxes(root, -1, -2) + np.eye(6) for root in roots]
    blocks = [np.stack([A[..., m, n] for m, n in zip(*np.triu_indices(6), strict=True)]) for A in full]
    np.testing.assert_array_equal(np.moveaxis(blocks[0][on_diagonal(blocks[0])], 0, -1), full[0].diagonal(0, -2, -1))
    preconditioned = by_blocks(blocks)
    a, b = random.normal(size=(2, 6, *shape))
    assert np.sum(a * preconditioned(b)) == pytest.approx(np.sum(b * preconditioned(a)), rel=1e-10)
    assert np.sum(a * preconditioned(a)) > 0.0
    alone = np.moveaxis(by_blocks(blocks[:1])(a), 0, -1)
    np.testing.assert_allclose(np.einsum("...mn,...n", full[0], alone), np.moveaxis(a, 0, -1), atol=1e-9)


@pytest.fixture
def own() -> list[np.ndarray]:
    """Own blocks of two splines on each grid, positive definite."""
    random, shape = np.random.default_rng(4), (12, 13, 14)
    roots = [random.normal(size=(*grid, 6, 6)) for grid in (shape, coarser(shape), coarser(coarser(shape)))]
    full = [root @ np.swapaxes(root, -1, -2) + np.eye(6) for root in roots]
    return [np.stack([A[..., m, n] for m, n in zip(*np.triu_indices(6), strict=True)]) for A in full]


def test_any_number_of_threads_and_any_order_in_memory_give_the_same(own, monkeypatch):
    monkeypatch.setattr("dvc.registration.gauss_newton.solver.SMALL", 0)
    force = np.random.default_rng(5).normal(size=(6, *own[0].shape[1:]))
    found = []
    for count in (1, 3):
        threads.use(count)
        found.append(by_blocks(own)(force))
    threads.use(1)
    found.append(by_blocks([np.asfortranarray(one) for one in own])(np.asfortranarray(force)))
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])
    assert np.abs(found[0]).min() > 0.0


def two_splines(factors: np.ndarray) -> tuple[SplineSums, Stiffness]:
    """Two splines, with factors at each point, (2, 4) or (ni, nj, nk, 2, 4), and a stiffness that has all parts."""
    random, shape = np.random.default_rng(6), tuple(a.size for a in ALONG)
    root = random.normal(size=(*shape, 3, 3))
    N = (root @ np.swapaxes(root, -1, -2)).reshape(*shape, 9)[..., [0, 1, 2, 4, 5, 8]]
    sums = SplineSums(CONTROL, ALONG, random.uniform(size=shape) < 0.7, np.broadcast_to(factors, (*shape, 2, 4)).copy())
    unstrained = np.broadcast_to(np.eye(3), (*shape, 3, 3)).copy()
    return sums, (N, unstrained, *random.uniform(size=(2, *shape)))


CONTROL = Grid((9, 10, 11), np.array([3.0, 3.2, 2.9]), np.zeros(3))
ALONG = [np.arange(1.1, n - 2.0, 0.4) for n in CONTROL.shape]
ALIKE = np.array(
    [[0.8, 0.0, 0.0, 0.0], [2.5, 0.0, 0.0, 0.0]]
)  # the splines move all points alike, but for these factors
AT = 4, 5, 3  # a control point


def test_blocks_of_two_splines_that_do_the_same_are_those_of_the_product():
    sums, stiffness = two_splines(ALIKE)
    found = sums.own_blocks(stiffness[0], *stiffness[2:])[0][:, *AT]
    for (m, n), entry in zip(zip(*np.triu_indices(6), strict=True), found, strict=True):
        one = np.zeros((6, *CONTROL.shape))
        one[m, *AT] = 1.0
        assert sums.product(one, stiffness)[n, *AT] == pytest.approx(entry, rel=1e-10)


def test_blocks_of_two_splines_with_factors_that_vary():
    """Sums over all points of B B and grad B grad B, and of the factors' slopes for a spline with itself."""
    factors = np.random.default_rng(7).normal(size=(*(a.size for a in ALONG), 2, 4))
    sums, (N, _, volume, shear) = two_splines(factors)
    axes = []  # values and slopes of the control point's B-spline along each axis
    for (first, value, slope), at in zip(sums.table, AT, strict=True):
        of = at - first
        seen = (of >= 0) & (of < 4)
        rows = np.arange(first.size), np.clip(of, 0, 3)
        axes.append([np.where(seen, value[rows], 0.0), np.where(seen, slope[rows], 0.0)])
    B = np.einsum("i,j,k->ijk", axes[0][0], axes[1][0], axes[2][0])
    slopes = [np.einsum("i,j,k->ijk", *(axes[a][int(a == m)] for a in range(3))) for m in range(3)]
    grad = np.stack(slopes, axis=-1)
    image = np.empty((*B.shape, 3, 3))
    for n, (m, a) in enumerate(zip(*np.triu_indices(3), strict=True)):
        image[..., m, a] = image[..., a, m] = N[..., n]

    def resisted(g: np.ndarray) -> np.ndarray:
        """Of volume and shear, for displacements along each axis with gradient g."""
        outer, square = g[..., :, None] * g[..., None, :], np.einsum("...a,...a", g, g)[..., None, None]
        return (volume + 0.5 * shear)[..., None, None] * outer + 0.5 * shear[..., None, None] * square * np.eye(3)

    exact = np.zeros((6, 6))
    for s in range(2):
        for t in range(2):
            part = (factors[..., s, 0] * factors[..., t, 0])[..., None, None]
            part = part * (image * (B**2)[..., None, None] + resisted(grad))
            if s == t:
                part = part + (B**2)[..., None, None] * resisted(factors[..., s, 1:])
            exact[3 * s : 3 * s + 3, 3 * t : 3 * t + 3] = part[sums.inside].sum(axis=0)
    found = sums.own_blocks(N, volume, shear)[0][:, *AT]
    np.testing.assert_allclose(found, exact[np.triu_indices(6)], rtol=1e-9, atol=1e-9)


def test_two_splines_that_do_nearly_the_same_are_solved_together():
    """As away from interfaces. Blocks that know nothing of the other spline leave four times as much of the energy."""
    sums, stiffness = two_splines(ALIKE)
    rough = Roughness(sums.control, ((1e-3, 1e-5), (3e-2, 2e-2)))
    blocks = sums.own_blocks(stiffness[0], *stiffness[2:])
    for grid, own in enumerate(blocks):
        for part, on in zip(rough.diagonals(grid), on_diagonal(own).reshape(-1, 3), strict=True):
            own[on] += part
    alone = [own.copy() for own in blocks]
    for own in alone:
        own[[n for n, (a, b) in enumerate(zip(*np.triu_indices(6), strict=True)) if a < 3 <= b]] = 0.0
    x = np.random.default_rng(8).normal(size=(6, *sums.control.shape))

    def product(c: np.ndarray) -> np.ndarray:
        return sums.product(c, stiffness) + rough.product(c)

    def left(diagonals: list[np.ndarray]) -> float:
        off = conjugate_gradients(product, product(x), by_blocks(diagonals), 0.0, 20) - x
        return float(np.sum(off * product(off)))

    assert left(blocks) < 0.5 * left(alone)


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
