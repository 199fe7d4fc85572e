"""Flows of the phantom are exact: gradient, inverse, volume, borders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from dvc.deformation.protocol import Composed, Motion
from dvc.deformation.strain import StrainField
from dvc.errors import InputError
from phantoms import LOADS, Border, EllipsoidUnion, Flow, Heel, attached, pressed, sliding, swelling, under_load


def test_flow_is_a_deformation(heel: Heel) -> None:
    assert isinstance(pressed(heel), Motion)


def motions(heel: Heel) -> dict[str, Motion]:
    loads = {name: under_load(heel, name) for name in LOADS}
    others = {"sliding": sliding(heel, 4.0), "attached": attached(heel, press_mm=4.5, shear_mm=1.5)}
    return {"pressed": pressed(heel), "pressed lightly": pressed(heel, 0.3), **others} | loads


def those_and_swelling(heel: Heel) -> dict[str, Motion]:
    return motions(heel) | {"swelling": swelling(heel)}


MOTIONS = ["pressed", "pressed lightly", "sliding", "attached", *LOADS]


@pytest.mark.parametrize("name", [*MOTIONS, "swelling"])
def test_gradient_is_the_derivative_of_the_map(heel: Heel, tissue_points: np.ndarray, name: str) -> None:
    flow, h = those_and_swelling(heel)[name], 3e-4
    # Differences must not reach across a border, where the gradient jumps.
    away = np.minimum(np.abs(heel.skeleton.distance(tissue_points)), np.abs(heel.flesh.distance(tissue_points)))
    points = tissue_points[away > 0.01][:1500]
    _, H = flow.evaluate(points)
    differences = np.stack(
        [(flow.displacement(points + h * e) - flow.displacement(points - h * e)) / (2 * h) for e in np.eye(3)],
        axis=-1,
    )
    assert np.abs(H).max() > 0.05
    np.testing.assert_allclose(H, differences, atol=1e-6)


def test_both_ways_give_the_same_displacement(heel: Heel, tissue_points: np.ndarray) -> None:
    flow = pressed(heel)
    np.testing.assert_array_equal(flow.evaluate(tissue_points)[0], flow.displacement(tissue_points))


@pytest.mark.parametrize("name", [*MOTIONS, "swelling"])
def test_backward_flow_is_the_inverse(heel: Heel, tissue_points: np.ndarray, name: str) -> None:
    flow = those_and_swelling(heel)[name]
    u, H = flow.evaluate(tissue_points)
    back, H_back = flow.inverse().evaluate(tissue_points + u)
    assert np.abs(u + back).max() < 1e-6
    np.testing.assert_allclose((H_back + np.eye(3)) @ (H + np.eye(3)), np.tile(np.eye(3), (len(u), 1, 1)), atol=1e-5)


@pytest.mark.parametrize("name", MOTIONS)
def test_volume_is_kept(heel: Heel, tissue_points: np.ndarray, name: str) -> None:
    _, H = motions(heel)[name].evaluate(tissue_points)
    np.testing.assert_allclose(np.linalg.det(H + np.eye(3)), 1.0, atol=1e-5)


def test_swelling_changes_volume_and_nothing_in_bone(heel: Heel, tissue_points: np.ndarray) -> None:
    u, H = swelling(heel).evaluate(tissue_points)
    J, bone = np.linalg.det(H + np.eye(3)), heel.skeleton.distance(tissue_points) <= 0
    assert 0.88 < J.min() < 0.93
    assert 1.1 < J.max() < 1.2
    assert bone.any()
    assert not u[bone].any()
    assert not H[bone].any()


def test_runge_kutta_is_of_fourth_order(heel: Heel, tissue_points: np.ndarray) -> None:
    flow = pressed(heel)
    exact = replace(flow, steps=128).displacement(tissue_points)
    errors = [np.sqrt(np.mean((replace(flow, steps=n).displacement(tissue_points) - exact) ** 2)) for n in (8, 16, 32)]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(orders > 3.7), orders


@settings(max_examples=20, deadline=None)
@given(load=st.floats(0.0, 1.5), seed=st.integers(0, 50))
def test_bone_is_exactly_at_rest(load: float, seed: int) -> None:
    heel = Heel(seed)
    points = np.random.default_rng(seed).uniform([-20, -36, -28], [26, 38, 22], (400, 3))
    inside = points[heel.bone.distance(points) <= 0]
    u, H = pressed(heel, load).evaluate(inside)
    assert len(inside) > 20
    assert not u.any()
    assert not H.any()


def test_motion_rises_smoothly_from_the_bone(heel: Heel) -> None:
    ray = np.array([[2.0, 18.0, z] for z in np.linspace(-22.0, -32.0, 1001)])
    away = heel.bone.distance(ray)
    assert away[0] < 0
    assert away[-1] > 6
    moved = np.linalg.norm(pressed(heel).displacement(ray), axis=1)
    assert np.all(np.diff(moved) >= 0)
    assert moved[away < 0.1].max() < 1e-2
    assert moved[-1] > 1.0


@pytest.mark.parametrize(("size", "pad"), [(0.7, 12.0), (1.3, 24.0)])
def test_small_and_large_heels_are_as_exact_and_as_strained(size: float, pad: float) -> None:
    other = Heel(3, size=size, pad_mm=pad)
    points = size * np.random.default_rng(5).uniform([-32, -20, -48], [32, 46, 0], (8000, 3))
    fat = points[other.tissue_at(points) == 2]
    motion = under_load(other, "Load1")
    u, H = motion.evaluate(fat)
    assert np.abs(u + motion.inverse().displacement(fat + u)).max() < 1e-6
    np.testing.assert_allclose(np.linalg.det(H + np.eye(3)), 1.0, atol=1e-5)
    assert 0.12 < np.median(StrainField.from_gradient(H).max_shear) < 0.3


def test_strain_jumps_at_bone_and_skin_and_displacement_does_not(heel: Heel) -> None:
    """Along rays through either border of the pad: at rest beyond it, sheared right up to it, never torn."""
    slide = sliding(heel, 4.0)
    for body, outward in ((heel.skeleton, 1.0), (heel.flesh, -1.0)):
        ray = np.array([[2.0, 16.0, z] for z in np.linspace(-22.0, -44.0, 22001)])
        from_border = outward * body.distance(ray)
        at = int(np.argmin(np.abs(from_border)))
        fat, beyond = (at + 20, at - 20) if from_border[at + 20] > 0 else (at - 20, at + 20)
        u, H = slide.evaluate(ray[[fat, beyond]])
        shear = StrainField.from_gradient(H).max_shear
        assert shear[0] > 0.1
        assert shear[1] == 0.0
        assert np.abs(u[0]).max() < 0.04  # 0.02 mm from the border
        assert not u[1].any()


def test_strain_of_attached_tissue_is_largest_at_bone(heel: Heel) -> None:
    """As in finite-element models of the heel, and not in the smooth load, whose strain vanishes there."""
    points = np.random.default_rng(2).uniform([-30, -20, -48], [30, 46, 0], (60_000, 3))
    points = points[heel.tissue_at(points) == 2]
    away = heel.skeleton.distance(points)
    for motion, largest in ((attached(heel, press_mm=4.5, shear_mm=1.5), True), (pressed(heel), False)):
        shear = StrainField.from_gradient(motion.evaluate(points)[1]).max_shear
        by_distance = [
            np.percentile(shear[(away > a) & (away < b)], 95) for a, b in ((0.0, 1.0), (3.0, 5.0), (8.0, 20.0))
        ]
        assert (by_distance == sorted(by_distance, reverse=True)) == largest
        assert (by_distance[0] > 0.3) == largest


def test_smooth_border_has_no_jump(heel: Heel) -> None:
    """The same flow with borders of third order: the strain ends at zero."""
    slide = sliding(heel, 4.0)
    assert slide.skin is not None
    smooth = replace(slide, rest=replace(slide.rest, order=3), skin=replace(slide.skin, order=3))
    points = np.random.default_rng(1).uniform([-8.0, 8.0, -30.0], [12.0, 24.0, -20.0], (40_000, 3))
    near = points[np.abs(heel.skeleton.distance(points) - 0.02) < 0.02]
    sharp, soft = (StrainField.from_gradient(m.evaluate(near)[1]).max_shear.max() for m in (slide, smooth))
    assert len(near) > 50
    assert sharp > 0.1
    assert soft < 0.01


def test_composition_is_undone_in_the_opposite_order(heel: Heel) -> None:
    both = under_load(heel, "Load3")
    assert isinstance(both, Composed)
    X = np.array([[2.0, 16.0, -35.0]])
    x = X + both.displacement(X)
    wrong = Composed([part.inverse() for part in both.parts])  # type: ignore[attr-defined]
    assert np.abs(x + both.inverse().displacement(x) - X).max() < 1e-6
    assert np.abs(x + wrong.displacement(x) - X).max() > 1e-3


def test_missing_points_stay_missing(heel: Heel) -> None:
    u, H = pressed(heel).evaluate(np.array([[0.0, 15.0, -35.0], [np.nan, 0.0, 0.0]]))
    assert np.isfinite(u[0]).all()
    assert np.isnan(u[1]).all()
    assert np.isnan(H[1]).all()


def test_body_distance_is_exact_for_a_ball() -> None:
    ball = EllipsoidUnion.of([((1.0, 2.0, 3.0), (8.0, 8.0, 8.0), (10.0, 20.0, 30.0))])
    points = np.random.default_rng(0).normal(size=(50, 3)) * 6.0 + 12.0
    np.testing.assert_allclose(ball.distance(points), np.linalg.norm(points - [1.0, 2.0, 3.0], axis=1) - 8.0, atol=1e-9)


def test_refuses_bad_shapes() -> None:
    with pytest.raises(InputError, match="positive definite"):
        EllipsoidUnion(np.zeros((1, 3)), -np.eye(3)[None])
    with pytest.raises(InputError, match="forms"):
        EllipsoidUnion(np.zeros((2, 3)), np.eye(3)[None])
    body = EllipsoidUnion(np.zeros((1, 3)), np.eye(3)[None])
    with pytest.raises(InputError, match="`ramp` must be above 0"):
        Border(body, 0.0)
    rest = Border(body, 1.0)
    with pytest.raises(InputError, match="width_mm of a flow must be positive"):
        Flow(np.zeros(3), np.zeros(3), rest, np.zeros(3), np.array([1.0, 0.0, 1.0]))
    with pytest.raises(InputError, match="pivot_mm of a flow needs three"):
        Flow(np.zeros(3), np.zeros(2), rest, np.zeros(3), np.ones(3))
    with pytest.raises(InputError, match="one step"):
        Flow(np.zeros(3), np.zeros(3), rest, np.zeros(3), np.ones(3), steps=0)
