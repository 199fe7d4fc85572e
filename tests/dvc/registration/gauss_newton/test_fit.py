"""The Gauss-Newton engine: what it finds on pairs of known motion."""

from __future__ import annotations

import os
import subprocess
import sys
import weakref
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Affine, evaluate_on_grid
from dvc.deformation.strain import StrainField
from dvc.errors import ParameterError
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.resample import smoothed
from dvc.io.transforms.read import read_transform
from dvc.io.transforms.write import write_elastix_transform
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.choice import Choice
from dvc.registration.gauss_newton.engine import GaussNewton
from dvc.registration.gauss_newton.first_run import _tiny_pair
from dvc.registration.gauss_newton.fit import USUAL_VOLUME, _level, choose, control_grid, fit, spline_through
from dvc.registration.gauss_newton.level import Level, State, Weights
from dvc.registration.gauss_newton.roughness import Roughness
from dvc.registration.gauss_newton.with_interfaces import fit_with_interfaces
from dvc.registration.register import Settings, register
from tests.textures import GRID, TURNED, everything, pair_of, scanned, texture


def pair_in(where: Mask, fixed: Image, moving: Image, **more: object) -> AlignedPair:
    return AlignedPair(fixed, moving, where, where, **more)  # type: ignore[arg-type]


def found_by(motion: Affine, noise: float = 0.0, **options: float | None) -> tuple[BSpline, np.ndarray]:
    fixed, moving = pair_of(motion, noise)
    chosen = replace(GaussNewton(spacing_mm=5.0, bending=3.0, volume=0.0), **options)  # type: ignore[arg-type]
    return fit(pair_in(everything(), fixed, moving), chosen)[0], GRID.points(everything().inside)


GAIN_MM = 0.1
SHIFT = np.array([1.3, -0.6, 0.7])


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def test_a_shift_is_found():
    bspline, X = found_by(Affine(np.eye(3), SHIFT), noise=0.0)
    assert rms(bspline.displacement(X) - SHIFT) < 0.01


def test_an_affine_motion_and_its_gradient_are_found():
    matrix = np.eye(3) + np.array([[0.05, 0.12, 0.0], [0.0, -0.04, 0.06], [0.03, 0.0, 0.02]])
    motion = Affine(matrix, np.array([0.5, 0.3, -0.8]) - (matrix - np.eye(3)) @ GRID.centre_mm)
    bspline, X = found_by(motion, noise=0.0)
    u, H = bspline.evaluate(X)
    assert rms(u - motion.displacement(X)) < 0.01
    assert rms(H - matrix + np.eye(3)) < 0.004


def test_images_may_differ_by_a_smooth_gain():
    fixed, moving = pair_of(Affine(np.eye(3), SHIFT), 0.05)
    ramp = 1.3 + 0.001 * (TURNED.points()[..., 0] - GRID.centre_mm[0])
    shaded = Image(TURNED, (moving.values * ramp).astype(np.float32))
    bspline, _ = fit(pair_in(everything(), fixed, shaded), GaussNewton(5.0, 3.0, 0.0))
    assert rms(bspline.displacement(GRID.points(everything().inside)) - SHIFT) < GAIN_MM


def test_what_bends_is_smoothed_less_than_what_does_not():
    def chosen(height_mm: float) -> float:
        X = GRID.points()
        wave = np.zeros_like(X)
        wave[..., 0] = height_mm * np.sin(2.0 * np.pi * X[..., 1] / 15.0)
        images = scanned(texture(X + wave), TURNED.points().reshape(-1, 3), 0.1)
        choice = fit(pair_in(everything(), *images), GaussNewton(5.0, volume=0.0))[1]
        assert min(v for _, v in choice.tried) == 1.0
        return choice.weights.bending

    assert 0.3 < chosen(1.0) < 5.0  # found to 0.12 mm root mean square at 0.45, to 0.17 at 3 and 0.15 at 0.1
    assert chosen(0.0) > 20.0  # found to 0.03 mm at 30, to 0.08 at 1


def test_levels_and_states_that_are_done_with_are_let_go(monkeypatch):
    made, held, lower = weakref.WeakSet(), [], Level.lower

    def counted(level: Level, state: State, weights: Weights):
        made.update((level, state))
        held.append(len(made))
        return lower(level, state, weights)

    monkeypatch.setattr(Level, "lower", counted)
    for engine in (fit, fit_with_interfaces):
        engine(_tiny_pair(), GaussNewton())
        assert max(held) > 2  # while a weight is chosen
        assert held[-2:] == [2, 2]  # the last two steps, on all voxels, hold their own level and state alone


class Residuals:
    """In place of a level: what is left out, by the power of the root of ten that a weight of 3 is multiplied by."""

    def __init__(self, left: dict[int, float]) -> None:
        self._left = left

    def at(self, coefficients, halves):
        return None

    def lower(self, state, weights):
        left_out = self._left[round(2.0 * np.log10(weights.rigidity / 3.0))]
        return SimpleNamespace(images=SimpleNamespace(left_out=left_out)), 0.0


@pytest.mark.parametrize(
    ("left", "margin", "power"),
    [
        ({-2: 1.4, -1: 1.1, 0: 1.0, 1: 1.1, 2: 1.4}, None, 0.0),
        ({-1: 1.3, 0: 1.0, 1: 0.9, 2: 1.0}, None, 1.0),
        ({-1: 1.3, 0: 1.0, 1: 1.0, 2: 1.3}, None, 0.5),  # between two that are alike
        ({-1: 1.3, 0: 1.0, 1: 0.9, 2: 0.95}, None, 1.0 + 0.5 * (1.0 - 0.95) / (1.0 - 1.8 + 0.95)),
        ({-1: 1.1, 0: 1.0, 1: 1.0001, 2: 1.0002, 3: 1.0009}, 3e-4, 2.0),
        ({-1: 1.1, 0: 1.0, 1: 1.0009, 2: 1.0001}, 3e-4, 0.0),  # raised for as long as
        ({-1: 1.0, 0: 1.0, 1: 1.0, 2: 1.0, 3: 1.0}, 3e-4, 3.0),  # the images do not tell
        ({-2: 1.0, -1: 0.9, 0: 1.0, 1: 1.1}, 3e-4, -1.0),
        ({-1: 0.99995, 0: 1.0, 1: 1.0002, 2: 1.0004}, 3e-4, 1.0),  # a step down that takes less than a quarter
        ({-2: 0.9999, -1: 0.9999, 0: 1.0, 1: 1.00025}, 3e-4, 0.0),
        ({-1: 1.1, 0: 1.0, 1: 0.9, 2: 0.9002, 3: 0.95}, 3e-4, 2.0),  # more than the least, which lies above
    ],
)
def test_a_weight_is_chosen_by_what_is_left_out(left, margin, power):
    level = Residuals(left)
    found = choose(level, np.zeros(1), Weights(3.0, 300.0, 3.0), "rigidity", (-2, 3), margin)
    assert 2.0 * np.log10(found.weights.rigidity / 3.0) == pytest.approx(power, abs=1e-9)
    assert min(v for _, v in found.tried) == 1.0


def swollen(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Displacement and det F of a hump of 3 mm whose volume changes by up to 23 %."""
    away = points - GRID.centre_mm
    hump = 3.0 * np.exp(-0.5 * (away**2).sum(axis=-1) / 8.0**2)
    return hump[..., None] * np.array([1.0, 0.0, 0.0]), 1.0 - hump * away[..., 0] / 64.0


def swollen_pair() -> tuple[Image, Image]:
    seen = TURNED.points().reshape(-1, 3)
    at = seen
    for _ in range(40):
        at = seen - swollen(at)[0]
    return scanned(texture(GRID.points()), at, 0.1)


def test_a_change_of_volume_that_the_images_ask_for_is_found():
    where = everything()
    X = GRID.points(where.inside)
    _, true = swollen(X)

    def share(**options: float) -> tuple[float, Choice]:
        bspline, choice = fit(pair_in(where, *swollen_pair()), GaussNewton(5.0, 3.0, **options))
        J = np.linalg.det(bspline.evaluate(X)[1] + np.eye(3))
        return float(((J - 1.0) * (true - 1.0)).sum() / ((true - 1.0) ** 2).sum()), choice

    kept, by_hand = share(volume=USUAL_VOLUME)
    freed, by_rule = share()
    assert kept < 0.1  # found: 0.04
    assert freed > 0.75  # found: 0.84
    assert not by_hand.frees_volume
    assert by_rule.frees_volume
    assert "the images indicate volume changes" in str(by_rule.as_dict()["change_of_volume"])
    assert "was fixed at 300/mm3" in by_hand.volume_told
    tissue = LabelMap(GRID, np.ones(GRID.shape, dtype=np.int16), {1: "fat"})  # and so it is where interfaces are known
    _, at_interfaces = fit_with_interfaces(pair_in(where, *swollen_pair(), labels=tissue), GaussNewton(5.0, 3.0))
    assert at_interfaces.frees_volume
    assert at_interfaces.weights.volume == 0.0
    assert at_interfaces.weights.volume_gradient == by_rule.weights.volume_gradient > 0.0


@pytest.mark.parametrize("spacing_mm", [(1.0, 1.0, 2.6), (2.0, 2.0, 2.0)])
def test_in_large_voxels_volume_is_kept_whatever_the_images_show(spacing_mm):
    """Loads then look like swelling: on phantom heels, the test gives .08 and .07 for voxels of 2 mm."""
    grid = replace(GRID, spacing_mm=np.array(spacing_mm))
    where = Mask(grid, np.ones(grid.shape, dtype=bool))
    fixed, moving = (replace(image, grid=grid) for image in swollen_pair())
    bspline, choice = fit(pair_in(where, fixed, moving), GaussNewton(2.5 * max(spacing_mm), 3.0))
    J = np.linalg.det(bspline.evaluate(grid.points(where.inside))[1] + np.eye(3))
    assert np.percentile(np.abs(J - 1.0), 95) < 0.04
    assert not choice.frees_volume
    assert "in voxels this large, a volume change cannot be told from noise" in choice.volume_told
    assert choice.as_dict()["change_of_volume"]["asked"] is None
    _, by_hand = fit(pair_in(where, fixed, moving), GaussNewton(2.5 * max(spacing_mm), 3.0, USUAL_VOLUME))
    assert "was fixed at 300/mm3" in by_hand.volume_told


def test_where_volume_is_kept_the_rule_changes_nothing():
    shear = np.eye(3) + np.array([[0.0, 0.12, 0.0], [0.0, 0.0, 0.06], [0.0, 0.0, 0.0]])
    motion = Affine(shear, GRID.centre_mm - shear @ GRID.centre_mm)
    pair = pair_in(everything(), *pair_of(motion, 0.1))
    found, choice = fit(pair, GaussNewton(5.0, 3.0))
    same, _ = fit(pair, GaussNewton(5.0, 3.0, USUAL_VOLUME))
    assert choice.asked is not None
    assert not choice.frees_volume
    assert GaussNewton().text == GaussNewton(volume=USUAL_VOLUME).text
    np.testing.assert_array_equal(found.coefficients_mm, same.coefficients_mm)


def test_where_a_blurred_image_shows_its_padding_it_is_not_used():
    """At the true motion the residual is nothing, up to the end of what the second scan shows."""
    motion = Affine(np.eye(3), np.array([1.0, -2.0, 3.0]))
    fixed, moving = pair_of(motion)
    end = GRID.shape[2] - 8
    moving = Image(TURNED.part((slice(None), slice(None), slice(0, end))), moving.values[:, :, :end])
    control = control_grid(GRID, np.full(3, 6.0))
    true = spline_through(motion, control)
    inside = everything().inside

    def residual(level: Level) -> float:
        return level.at(true).variance

    nothing = np.zeros_like(inside)
    used = residual(_level((fixed, moving), inside, inside, nothing, control, 1.6))
    blurred = smoothed(fixed, 1.6), smoothed(moving, 1.6)
    padded = residual(Level(blurred, inside, inside, nothing, Roughness(control)))
    assert used < 1e-5
    assert padded > 20.0 * used


def test_missing_voxels_count_for_nothing():
    fixed, moving = pair_of(Affine(np.eye(3), SHIFT))
    hole, gap = fixed.values.copy(), moving.values.copy()
    hole[10:16, 10:16, 10:16], gap[20:27, 18:25, 14:20] = np.nan, np.nan
    pair = pair_in(everything(), Image(GRID, hole), Image(TURNED, gap))
    bspline, _ = fit(pair, GaussNewton(5.0, 3.0, 0.0))
    assert rms(bspline.displacement(GRID.points(everything().inside)) - SHIFT) < 0.02


@pytest.mark.parametrize(
    ("given", "told"),
    [({"spacing_mm": 0.0}, "above 0 mm"), ({"bending": -1.0}, "bending"), ({"volume": float("nan")}, "volume")],
)
def test_senseless_parameters_are_refused(given, told):
    with pytest.raises(ParameterError, match=told):
        GaussNewton(**given)


FAT, FAT_MM, BONE = 0.06, 0.2, 0.02
OURS = Settings(GaussNewton(bending=4.0, volume=300.0))


@pytest.fixture(scope="module")
def registered(small_pair, worker):
    return register(small_pair.reference, small_pair.loaded, bone=small_pair.bone, settings=OURS, worker=worker)


def shear_error(pair, deformation, tissue: str) -> tuple[float, float]:
    """RMS error of the max. shear and median error of the displacement (mm), where the loaded image shows it."""
    inside = pair.labels.region(tissue).inside
    grid = pair.reference.grid
    U, true_H = evaluate_on_grid(pair.deformation, grid, inside)
    u, H = evaluate_on_grid(deformation, grid, inside)
    seen = pair.loaded.grid.contains(pair.foot_motion.apply(grid.points(inside) + U))
    error = StrainField.from_gradient(H).max_shear - StrainField.from_gradient(true_H).max_shear
    return float(np.sqrt(np.mean(error[seen] ** 2))), float(np.median(np.linalg.norm(u - U, axis=1)[seen]))


def test_a_pressed_heel_is_measured(registered, small_pair):
    """Voxels of 1.6 mm, control points every 3.2 mm. No registration at all: .15 in fat, 0.7 mm."""
    shear, u_mm = shear_error(small_pair, registered.displacement, "fat")
    assert shear < FAT
    assert u_mm < FAT_MM
    assert shear_error(small_pair, registered.displacement, "bone")[0] < BONE
    assert registered.choice.weights.bending == 4.0


def test_its_spline_goes_through_an_elastix_file_unchanged(registered, small_pair, tmp_path):
    motion, grid = registered.alignment.motion, small_pair.reference.grid
    last = write_elastix_transform(tmp_path, registered.displacement, motion, grid)[-1]
    X = small_pair.labels.region("fat").points()[::50]
    np.testing.assert_allclose(
        read_transform(last).displacement(X), registered.total.displacement(X), atol=1e-6, equal_nan=True
    )


def test_a_start_is_where_it_begins_and_is_corrected_against_the_images(worker):
    """Images of one texture, 19 mm apart: two wavelengths and more, which no search from nothing finds."""
    far = np.array([14.0, -10.0, 9.0])
    fixed, near = pair_of(Affine(np.eye(3), SHIFT), 0.05)
    moving = Image(TURNED.moved_by(np.eye(3), far), near.values)
    options = Settings(GaussNewton(5.0, 3.0, 0.0), align_on="none")
    control = control_grid(GRID, np.full(3, 5.0))
    start = BSpline(control, spline_through(Affine(np.eye(3), far), control))
    X = GRID.points(everything().inside)

    def off(begun_at: BSpline | None) -> float:
        found = register(fixed, moving, tissue=everything(), settings=options, start=begun_at, worker=worker)
        return rms(found.displacement.displacement(X) - SHIFT - far)

    assert off(start) < 0.25 * np.linalg.norm(SHIFT)
    assert off(None) > 3.0


def test_any_number_of_threads_gives_the_same_bits(tmp_path):
    fixed, moving = pair_of(Affine(np.eye(3) * 1.03, np.array([1.0, -0.6, 0.3])), noise=0.05)
    np.savez(tmp_path / "pair.npz", fixed=fixed.values, moving=moving.values)
    script = f"""
import hashlib, numpy as np
from dvc.registration.align import align
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.fit import Parameters, fit
from dvc.images.image import Grid, Image, Mask
pair = np.load({str(tmp_path / "pair.npz")!r})
grid = Grid({GRID.shape}, np.array({GRID.spacing_mm.tolist()}), np.array({GRID.origin_mm.tolist()}))
inside = np.zeros(grid.shape, dtype=bool)
inside[4:-4, 4:-4, 4:-4] = True
mask = Mask(grid, inside)
pair = AlignedPair(Image(grid, pair["fixed"]), Image(grid, pair["moving"]), mask, mask)
found, choice = fit(pair, Parameters(5.0))
on = align(pair.fixed, pair.moving, mask, "image", 1)
of_both = found.coefficients_mm.tobytes() + on.motion.rotation.tobytes() + on.motion.translation_mm.tobytes()
print(hashlib.sha256(of_both).hexdigest(), choice.weights.bending, on.similarity, on.repeatability_mm)
"""
    told = []
    for threads in ("1", "3"):
        names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")
        environment = {**os.environ, **dict.fromkeys(names, threads)}
        done = subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True
        )
        told.append(done.stdout)
    assert told[0] == told[1]
    assert len(told[0]) > 64
