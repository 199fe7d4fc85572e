"""The Gauss-Newton engine's sums, prior and steps against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.deformation.bspline import BSpline
from dvc.deformation.interface_spline import Interfaces
from dvc.deformation.protocol import Affine, RigidMotion, evaluate_on_grid
from dvc.errors import InputError
from dvc.images.image import Grid, Image, LabelMap
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.fit import control_grid, spline_through
from dvc.registration.gauss_newton.image_term import ImagePair
from dvc.registration.gauss_newton.level import Level, Weights, _share_at, strained
from dvc.registration.gauss_newton.roughness import Roughness
from dvc.registration.gauss_newton.spline_sums import SplineSums
from dvc.registration.gauss_newton.with_interfaces import _Stage
from tests.dvc.deformation.test_interface_spline import scanned
from tests.textures import GRID, TURNED, everything, pair_of


@pytest.fixture(scope="module")
def sums() -> tuple[SplineSums, BSpline]:
    """A spline with random coefficients and the sums over some voxels of a small grid."""
    grid = Grid((9, 8, 10), np.array([1.0, 1.1, 0.9]), np.zeros(3))
    control = control_grid(grid, np.array([3.0, 3.5, 4.0]))
    random = np.random.default_rng(1)
    at, step = control.indices_of(grid.origin_mm), grid.spacing_mm / control.spacing_mm
    along = [a + s * np.arange(n) for a, s, n in zip(at, step, grid.shape, strict=True)]
    inside = random.uniform(size=grid.shape) < 0.7
    return SplineSums(control, along, inside), BSpline(control, random.normal(size=(3, *control.shape)))


def test_sums_are_those_of_the_spline(sums):
    points, spline = sums
    u, H = points.evaluate(spline.coefficients_mm)
    grid = Grid((9, 8, 10), np.array([1.0, 1.1, 0.9]), np.zeros(3))
    true_u, true_H = evaluate_on_grid(spline, grid, points.inside)
    np.testing.assert_allclose(u[points.inside], true_u, atol=1e-12)
    np.testing.assert_allclose(H[points.inside], true_H, atol=1e-12)
    assert not H[~points.inside].any()


@pytest.mark.parametrize("interfaces", [False, True])
def test_a_block_is_compared_if_any_voxel_of_it_is(interfaces):
    """At its first voxel, where strain is taken with interfaces, a block may lie outside the mask."""
    grid = Grid((8, 8, 8), np.ones(3), np.zeros(3))
    image = Image(grid, np.random.default_rng(1).uniform(size=grid.shape).astype(np.float32))
    inside = np.ones(grid.shape, dtype=bool)
    inside[2, 4, 6], inside[4:6, 4:6, 4:6] = False, False
    meet = Interfaces.of(LabelMap(grid, np.ones(grid.shape, dtype=int), {1: "fat"}), None, 3.0)
    control = control_grid(grid, np.full(3, 4.0))
    pair = ImagePair(image, image, inside, control, np.full(3, 2), interfaces=meet if interfaces else None)
    assert pair.blocks.inside[1, 2, 3]
    assert not pair.blocks.inside[2, 2, 2]
    assert pair.blocks.inside.sum() == 4**3 - 1
    assert pair.share(inside)[1, 2, 3] == (0.0 if interfaces else 7.0)


def test_gathering_is_the_transpose_of_evaluating(sums):
    points, spline = sums
    stress = np.random.default_rng(3).normal(size=(*points.inside.shape, 3, 3)) * points.inside[..., None, None]
    H = points.evaluate(spline.coefficients_mm)[1]
    assert np.sum(points.gathered(stress) * spline.coefficients_mm) == pytest.approx(np.sum(stress * H), rel=1e-12)


def test_product_and_diagonal_are_those_of_the_quadratic_form(sums):
    points, spline = sums
    random = np.random.default_rng(4)
    shape = points.inside.shape
    root = random.normal(size=(*shape, 3, 3))
    N = root @ np.swapaxes(root, -1, -2)
    packed = np.stack([N[..., 0, 0], N[..., 0, 1], N[..., 0, 2], N[..., 1, 1], N[..., 1, 2], N[..., 2, 2]], axis=-1)
    F = np.eye(3) + 0.2 * random.normal(size=(*shape, 3, 3))
    volume, shear = random.uniform(size=shape), random.uniform(size=shape)
    c, cof = spline.coefficients_mm, strained(F - np.eye(3))[1]
    u, H = points.evaluate(c)
    sym = 0.5 * (H + np.swapaxes(H, -1, -2))
    cost = np.einsum("...a,...ab,...b", u, N, u) + volume * np.einsum("...ab,...ab", cof, H) ** 2
    cost = (cost + shear * np.einsum("...ab,...ab", sym, sym))[points.inside].sum()
    assert np.sum(c * points.product(c, (packed, cof, volume, shear))) == pytest.approx(cost, rel=1e-12)
    unstrained = (packed, np.broadcast_to(np.eye(3), cof.shape).copy(), volume, shear)
    blocks = points.own_blocks(unstrained[0], *unstrained[2:])[0][:, 2, 2, 3]
    for m, entries in enumerate(([0, 1, 2], [1, 3, 4], [2, 4, 5])):
        one = np.zeros_like(c)
        one[m, 2, 2, 3] = 1.0
        np.testing.assert_allclose(blocks[entries], points.product(one, unstrained)[:, 2, 2, 3], rtol=1e-10)
        assert blocks[entries][m] > 0.01


def test_cofactors_are_det_times_inverse_transpose():
    F = np.eye(3) + 0.3 * np.random.default_rng(5).normal(size=(20, 3, 3))
    expected = np.linalg.det(F)[:, None, None] * np.swapaxes(np.linalg.inv(F), -1, -2)
    whole, cofactor, J, pulled = strained(F - np.eye(3))
    np.testing.assert_allclose(whole, F, atol=1e-15)
    np.testing.assert_allclose(cofactor, expected, atol=1e-12)
    np.testing.assert_allclose(J, np.linalg.det(F), atol=1e-12)
    upright = J > 0.2  # flatter ones are taken as less flat
    assert upright.any()
    np.testing.assert_allclose(pulled[upright], np.swapaxes(np.linalg.inv(F[upright]), -1, -2), atol=1e-10)


@pytest.fixture(scope="module")
def level() -> Level:
    pair = pair_of(Affine(np.eye(3), np.array([0.4, -0.3, 0.2])))
    inside, bone = everything().inside, np.zeros(GRID.shape, dtype=bool)
    bone[10:20, 12:24, 10:22] = True
    roughness = Roughness(control_grid(GRID, np.full(3, 5.0)), ((1.0, 0.0),))
    return Level(pair, inside, inside & ~bone, bone, roughness)


def rotated(level: Level) -> np.ndarray:
    """Coefficients of a rotation by 20 degrees."""
    turn = Rotation.from_rotvec([10.0, -15.0, 8.0], degrees=True).as_matrix()
    return spline_through(Affine(turn, np.zeros(3)), level.control)


def test_the_prior_of_a_stretch_is_its_closed_form(level):
    """F = diag(1.1, 1, 0.95): J = 1.045 and E = diag(0.105, 0, -0.04875)."""
    c = spline_through(Affine(np.diag([1.1, 1.0, 0.95]), np.zeros(3)), level.control)
    state = level.at(c)
    mm3 = GRID.voxel_volume_mm3
    bone = 10 * 12 * 12 * mm3
    soft = everything().inside.sum() * mm3 - bone
    assert level.prior(state, Weights(7.0, 0.0, 0.0)) == pytest.approx(0.0, abs=1e-9)
    assert level.prior(state, Weights(0.0, 2.0, 0.0)) == pytest.approx(soft * 0.045**2, rel=1e-6)
    assert level.prior(state, Weights(0.0, 0.0, 2.0)) == pytest.approx(bone * (0.105**2 + 0.04875**2), rel=1e-6)


def test_a_rotation_costs_nothing(level):
    assert level.prior(level.at(rotated(level)), Weights(1.0, 1.0, 1.0, 1.0)) < 1e-9


def test_a_prior_about_a_first_guess_is_least_there(level):
    random = np.random.default_rng(8)
    guess, c, d = random.normal(size=(3, 3, *level.control.shape))
    inside, weights = everything().inside, Weights(2.0, 0.0, 0.0)
    held = Roughness(level.control, ((0.0, 1.0),))  # nothing but the distance
    about = Level(pair_of(Affine(np.eye(3), np.zeros(3))), inside, inside, np.zeros_like(inside), held, rest=guess)
    mm3 = float(np.prod(level.control.spacing_mm))
    assert about.prior(about.at(c), weights) == pytest.approx(mm3 * np.sum((c - guess) ** 2), rel=1e-10)
    assert np.sum(about.prior_gradient(about.at(c), weights) * d) == pytest.approx(
        2.0 * mm3 * np.sum((c - guess) * d), rel=1e-10
    )


@pytest.mark.parametrize(
    "weights", [Weights(2.0, 0.0, 0.0), Weights(0.0, 3.0, 0.0), Weights(0.0, 0.0, 4.0), Weights(0, 0, 0, 5.0)]
)
def test_the_priors_gradient_is_that_of_its_energy(level, weights):
    random = np.random.default_rng(6)
    c = rotated(level) + 0.3 * random.normal(size=(3, *level.control.shape))
    d = random.normal(size=c.shape)
    h = 1e-5
    difference = (level.prior(level.at(c + h * d), weights) - level.prior(level.at(c - h * d), weights)) / (2.0 * h)
    assert np.sum(level.prior_gradient(level.at(c), weights) * d) == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("turn_deg", [(0.0, 0.0, 0.0), (10.0, -15.0, 8.0)], ids=["shifted", "turned"])
def test_the_images_force_is_the_derivative_of_their_residual(turn_deg):
    """Central differences of the fixed image are not quite the derivative: within 5 %. They turn with what turns."""
    turn = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    motion = Affine(turn, GRID.centre_mm - turn @ GRID.centre_mm + [0.4, -0.3, 0.2])
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[10:-10, 10:-10, 10:-10] = True
    roughness = Roughness(control_grid(GRID, np.full(3, 5.0)))
    level = Level(pair_of(motion), inside, inside, np.zeros_like(inside), roughness)
    true = spline_through(motion, level.control)
    for axis in range(3):
        bump = np.zeros_like(true)
        bump[axis, 3:8, 3:8, 3:7] = 0.3
        c, h = true + bump, 1e-3
        difference = (level.at(c + h * bump).images.square - level.at(c - h * bump).images.square) / (2.0 * h)
        assert -2.0 * np.sum(level.at(c).images.force * bump) == pytest.approx(difference, rel=0.05)


def test_the_other_half_is_what_is_left_out(level):
    c = rotated(level)
    whole, first, second = (level.at(c, halves).images for halves in (-1, 0, 1))
    assert np.isnan(whole.left_out)
    assert first.left_out == pytest.approx(second.square / second.count, rel=1e-12)
    assert second.left_out == pytest.approx(first.square / first.count, rel=1e-12)
    assert first.count + second.count == whole.count


def test_coarser_grids_bring_a_step_further_in_a_quarter_of_the_iterations(monkeypatch):
    motion = np.array([0.4, -0.3, 0.2])
    pair, inside = pair_of(Affine(np.eye(3), motion)), everything().inside
    roughness = Roughness(control_grid(GRID, np.full(3, 2.0)), laplacians=2)

    def left_mm(most: int, grids: int) -> float:
        """Root mean square distance from the translation that is the solution."""
        monkeypatch.setattr("dvc.registration.gauss_newton.spline_sums.GRIDS", grids)
        level = Level(pair, inside, inside, np.zeros_like(inside), roughness)
        state = level.at(np.zeros((3, *level.control.shape)))
        step = level.step(state, Weights(30.0, 30.0, 0.0), 1e-3, (1e-9, most))
        off = level.pair.blocks.evaluate(step)[0][level.pair.blocks.inside] - motion
        return float(np.sqrt((off**2).mean()))

    assert left_mm(10, grids=3) < 0.5 * left_mm(40, grids=1)  # 0.03 and 0.13 mm


@pytest.mark.parametrize("known", [True, False])
def test_at_the_bone_alone_the_solver_sees_the_splines_together(known):
    """After ten iterations 0.080 mm are left, 0.085 if it does not; in a layer as thin as skin, that is no gain."""
    fixed, moving, body, labels = scanned(skin=0.0)
    bone = labels.region("bone")
    pair = AlignedPair.of(fixed, moving, RigidMotion.identity(), body, bone, labels if known else None)

    def moved(most: int, other: bool = False) -> np.ndarray:
        level = _Stage(pair, bone, control_grid(fixed.grid, np.full(3, 3.2)), None).whole
        assert level.pair.blocks.shift == (0.0 if known else pytest.approx(3.2))
        if other:
            level.pair.blocks.shift = 3.2 if known else 0.0
        state = level.at(np.zeros((6, *level.control.shape)))
        step = level.step(state, Weights(3.0, 300.0, 0.0), 1e-3, (1e-9, most))
        return level.pair.blocks.evaluate(step)[0][level.pair.blocks.inside]

    solved = moved(300)
    left, left_by_other = (np.sqrt(((moved(10, other) - solved) ** 2).mean()) for other in (False, True))
    assert left < 0.97 * left_by_other


def test_a_spline_through_a_cubic_deformation_is_that_deformation():
    control = control_grid(GRID, np.full(3, 6.0))
    finer = control_grid(GRID, np.full(3, 3.0))
    coarse = BSpline(control, np.random.default_rng(9).normal(size=(3, *control.shape)))
    fine = BSpline(finer, spline_through(coarse, finer))
    X = GRID.points(everything().inside)[::97]
    assert np.abs(fine.displacement(X) - coarse.displacement(X)).max() < 0.05  # of 0.6; the knots are not the same
    with pytest.raises(InputError, match="not defined anywhere"):
        spline_through(coarse, Grid(finer.shape, finer.spacing_mm, finer.origin_mm + 500.0))


def test_the_share_of_tissue_at_control_points_is_the_same_in_any_frame():
    """A half space: whole inside, a half on its border, nothing outside the image."""
    mask = np.zeros((12, 10, 8), dtype=bool)
    mask[:6] = True
    grid = Grid(mask.shape, np.full(3, 0.8), np.array([1.0, -2.0, 3.0]))
    control = Grid((6, 5, 4), np.full(3, 1.6), grid.origin_mm + 0.4)  # in the middles of cells of voxels
    share = _share_at(control, mask, grid)
    np.testing.assert_allclose(share[:, 1, 1], [1.0, 1.0, 1.0, 0.0, 0.0, 0.0], atol=1e-12)
    shifted = Grid(control.shape, control.spacing_mm, control.origin_mm + np.array([0.8, 0.0, 0.0]))
    np.testing.assert_allclose(_share_at(shifted, mask, grid)[:, 1, 1], [1.0, 1.0, 0.5, 0.0, 0.0, 0.0], atol=1e-12)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    turned = [Grid(g.shape, g.spacing_mm, turn @ g.origin_mm, turn) for g in (control, grid)]
    np.testing.assert_allclose(_share_at(turned[0], mask, turned[1]), share, atol=1e-12)


def test_a_step_is_not_cut_short_for_tissue_that_no_image_shows(monkeypatch):
    """Beyond the end of the moving image only the prior says where tissue goes, and that may be far."""
    fixed, moving = pair_of(Affine(np.eye(3), np.zeros(3)))
    end = 16
    moving = Image(TURNED.part((slice(None), slice(None), slice(0, end))), moving.values[:, :, :end])
    inside = everything().inside
    level = Level(
        (fixed, moving), inside, inside, np.zeros_like(inside), Roughness(control_grid(GRID, np.full(3, 5.0)))
    )
    step = np.zeros((3, *level.control.shape))
    step[2, :, :, -3:] = 20.0
    monkeypatch.setattr(level, "step", lambda *_: step)
    found = level.descend(0.0 * step, Weights(1e-9, 0.0, 0.0), steps=1, stop_mm=0.0)
    np.testing.assert_array_equal(found.coefficients, step)
