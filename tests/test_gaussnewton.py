"""The Gauss-Newton engine: its sums and its prior against closed forms, and what it finds on pairs of known motion."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.bspline import BSpline
from dvc.deformation import Affine, evaluate_on_grid
from dvc.descent import Level, Weights, cofactors, conjugate_gradients
from dvc.errors import InputError, ParameterError, RegistrationError
from dvc.gaussnewton import USUAL_BENDING, GaussNewton, _level, control_grid, fit, spline_through
from dvc.image import Grid, Image, Mask
from dvc.imagefile import read_image
from dvc.imagewrite import write_image, write_mask
from dvc.kinematics import StrainField
from dvc.labels import read_mask
from dvc.presets import load_preset
from dvc.registration import Settings, register
from dvc.resample import smoothed
from dvc.smoothness import Bending
from dvc.splinesums import SplineSums
from dvc.transformfile import read_transform
from dvc.transformwrite import write_elastix_transform
from mrstrain.registering import register as run
from mrstrain.registering import settings_of
from mrstrain.registeringone import register_one

GRID = Grid((40, 44, 36), np.array([1.0, 1.0, 1.2]), np.array([-20.0, 5.0, 3.0]))

# Were the second scan's voxels at the same places, every displacement would smooth its noise and so seem better.
_TURN = Rotation.from_rotvec([3.0, -2.0, 4.0], degrees=True).as_matrix()
TURNED = GRID.moved_by(_TURN, GRID.centre_mm - _TURN @ GRID.centre_mm)


def texture(points: np.ndarray) -> np.ndarray:
    """A smooth pattern without a period, known everywhere; wavelengths of 8 mm and more."""
    random = np.random.default_rng(8)
    waves = random.normal(size=(40, 3))
    waves *= (2.0 * np.pi / random.uniform(8.0, 20.0, 40) / np.linalg.norm(waves, axis=1))[:, None]
    return 3.0 + np.cos(points @ waves.T + random.uniform(0.0, 6.3, 40)).sum(axis=-1) / np.sqrt(40.0)


def pair_of(motion: Affine, noise: float = 0.0) -> tuple[Image, Image]:
    """Textures before and after an affine motion, I1(x) = I0(motion^-1 x), the second on a grid turned by 5 degrees."""
    return scanned(texture(GRID.points()), motion.inverse().apply(TURNED.points().reshape(-1, 3)), noise)


def scanned(first: np.ndarray, seen_at: np.ndarray, noise: float) -> tuple[Image, Image]:
    """Two images with noise: values on GRID, and the texture at places (n, 3), one for each voxel of TURNED."""
    random = np.random.default_rng(2)
    second = texture(seen_at).reshape(GRID.shape)
    first, second = (values + noise * random.standard_normal(GRID.shape) for values in (first, second))
    return Image(GRID, first.astype(np.float32)), Image(TURNED, second.astype(np.float32))


def everything() -> Mask:
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[4:-4, 4:-4, 4:-4] = True
    return Mask(GRID, inside)


def found_by(motion: Affine, noise: float = 0.0, **options: float | None) -> tuple[BSpline, np.ndarray]:
    fixed, moving = pair_of(motion, noise)
    chosen = replace(GaussNewton(spacing_mm=5.0, bending=3.0, volume=0.0), **options)  # type: ignore[arg-type]
    return fit(fixed, moving, everything(), everything(), None, chosen)[0], GRID.points(everything().inside)


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
    c, cof = spline.coefficients_mm, cofactors(F)
    u, H = points.evaluate(c)
    sym = 0.5 * (H + np.swapaxes(H, -1, -2))
    cost = np.einsum("...a,...ab,...b", u, N, u) + volume * np.einsum("...ab,...ab", cof, H) ** 2
    cost = (cost + shear * np.einsum("...ab,...ab", sym, sym))[points.inside].sum()
    assert np.sum(c * points.product(c, (packed, cof, volume, shear))) == pytest.approx(cost, rel=1e-12)
    unstrained = (packed, np.broadcast_to(np.eye(3), cof.shape).copy(), volume, shear)
    blocks = points.diagonal(unstrained)[:, 2, 2, 3]
    for m, entries in enumerate(([0, 1, 2], [1, 3, 4], [2, 4, 5])):
        one = np.zeros_like(c)
        one[m, 2, 2, 3] = 1.0
        np.testing.assert_allclose(blocks[entries], points.product(one, unstrained)[:, 2, 2, 3], rtol=1e-10)
        assert blocks[entries][m] > 0.01


def test_cofactors_are_det_times_inverse_transpose():
    F = np.eye(3) + 0.3 * np.random.default_rng(5).normal(size=(20, 3, 3))
    expected = np.linalg.det(F)[:, None, None] * np.swapaxes(np.linalg.inv(F), -1, -2)
    np.testing.assert_allclose(cofactors(F), expected, atol=1e-12)


def test_bending_of_a_quadratic_displacement_is_its_closed_form():
    """u = (a x y, b z^2, 0): |D^2 u|^2 = 2 a^2 + 4 b^2, times the volume of the valid region."""
    a, b = 0.01, -0.02
    control = Grid((8, 9, 10), np.array([3.0, 4.0, 5.0]), np.array([1.0, 2.0, 3.0]))
    i, j, k = np.meshgrid(*(np.arange(n) for n in control.shape), indexing="ij")
    x, y, z = 3.0 * i, 4.0 * j, 5.0 * k
    c = np.stack([a * x * y, b * (z**2 - 25.0 / 3.0), 0.0 * x])  # the cubic spline of k^2 - 1/3 is t^2
    energy = np.sum(c * Bending(control).product(c))
    assert energy == pytest.approx((2.0 * a**2 + 4.0 * b**2) * (5 * 3.0) * (6 * 4.0) * (7 * 5.0), rel=1e-10)


def test_an_affine_displacement_does_not_bend_and_the_diagonal_is_the_matrix_own():
    control = Grid((6, 7, 8), np.array([3.0, 4.0, 5.0]), np.zeros(3))
    bending = Bending(control)
    u = control.points() @ np.array([[0.1, 0.2, 0.0], [-0.3, 0.0, 0.1], [0.0, 0.2, 0.3]])
    assert np.abs(bending.product(np.moveaxis(u, -1, 0).copy())).max() < 1e-12
    one = np.zeros((3, *control.shape))
    one[2, 0, 3, 5] = 1.0
    assert bending.product(one)[2, 0, 3, 5] == pytest.approx(bending.diagonal[0, 3, 5], rel=1e-12)


@pytest.fixture(scope="module")
def level() -> Level:
    fixed, moving = pair_of(Affine(np.eye(3), np.array([0.4, -0.3, 0.2])))
    inside, bone = everything().inside, np.zeros(GRID.shape, dtype=bool)
    bone[10:20, 12:24, 10:22] = True
    return Level(fixed, moving, inside, inside & ~bone, bone, control_grid(GRID, np.full(3, 5.0)))


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
    assert level.prior(level.at(rotated(level)), Weights(1.0, 1.0, 1.0)) < 1e-9


@pytest.mark.parametrize("weights", [Weights(2.0, 0.0, 0.0), Weights(0.0, 3.0, 0.0), Weights(0.0, 0.0, 4.0)])
def test_the_priors_gradient_is_that_of_its_energy(level, weights):
    random = np.random.default_rng(6)
    c = rotated(level) + 0.3 * random.normal(size=(3, *level.control.shape))
    d = random.normal(size=c.shape)
    h = 1e-5
    difference = (level.prior(level.at(c + h * d), weights) - level.prior(level.at(c - h * d), weights)) / (2.0 * h)
    assert np.sum(level.prior_gradient(level.at(c), weights) * d) == pytest.approx(difference, rel=1e-6)


def test_the_images_force_is_the_derivative_of_their_residual(level):
    """Central differences of the fixed image are not quite the derivative: within 5 %."""
    true = spline_through(Affine(np.eye(3), np.array([0.4, -0.3, 0.2])), level.control)
    bump = np.zeros_like(true)
    bump[0, 3:8, 3:8, 3:7], bump[2, 4:8, 2:6, 3:7] = 0.3, -0.2
    c, h = true + bump, 1e-3
    difference = (level.at(c + h * bump).images.square - level.at(c - h * bump).images.square) / (2.0 * h)
    assert -2.0 * np.sum(level.at(c).images.force * bump) == pytest.approx(difference, rel=0.05)


def test_conjugate_gradients_solve_a_small_system():
    random = np.random.default_rng(7)
    root = random.normal(size=(12, 12))
    A = root @ root.T + np.eye(12)
    true = np.arange(12.0).reshape(3, 4)
    unit = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])[:, None]
    x = conjugate_gradients(lambda v: (A @ v.ravel()).reshape(3, 4), (A @ true.ravel()).reshape(3, 4), unit, 1e-10, 100)
    np.testing.assert_allclose(x, true, atol=1e-6)


def test_a_spline_through_a_cubic_deformation_is_that_deformation():
    control = control_grid(GRID, np.full(3, 6.0))
    finer = control_grid(GRID, np.full(3, 3.0))
    coarse = BSpline(control, np.random.default_rng(9).normal(size=(3, *control.shape)))
    fine = BSpline(finer, spline_through(coarse, finer))
    X = GRID.points(everything().inside)[::97]
    assert np.abs(fine.displacement(X) - coarse.displacement(X)).max() < 0.05  # of 0.6; the knots are not the same
    with pytest.raises(InputError, match="not defined anywhere"):
        spline_through(coarse, Grid(finer.shape, finer.spacing_mm, finer.origin_mm + 500.0))


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
    bspline, _ = fit(fixed, shaded, everything(), everything(), None, GaussNewton(5.0, 3.0, 0.0))
    assert rms(bspline.displacement(GRID.points(everything().inside)) - SHIFT) < GAIN_MM


def test_what_bends_is_smoothed_less_than_what_does_not():
    def chosen(height_mm: float) -> float:
        X = GRID.points()
        wave = np.zeros_like(X)
        wave[..., 0] = height_mm * np.sin(2.0 * np.pi * X[..., 1] / 15.0)
        images = scanned(texture(X + wave), TURNED.points().reshape(-1, 3), 0.1)
        choice = fit(*images, everything(), everything(), None, GaussNewton(5.0, volume=0.0))[1]
        assert min(v for _, v in choice.tried) == 1.0
        return choice.weights.bending

    assert 0.3 < chosen(1.0) < 5.0  # found to 0.17 mm root mean square at a weight of 1, to 0.20 at 10
    assert chosen(0.0) > 20.0  # found to 0.04 mm at 30, to 0.12 at 1


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
    padded = residual(Level(smoothed(fixed, 1.6), smoothed(moving, 1.6), inside, inside, nothing, control))
    assert used < 1e-5
    assert padded > 20.0 * used


def test_missing_voxels_count_for_nothing():
    fixed, moving = pair_of(Affine(np.eye(3), SHIFT))
    hole, gap = fixed.values.copy(), moving.values.copy()
    hole[10:16, 10:16, 10:16], gap[20:27, 18:25, 14:20] = np.nan, np.nan
    options = GaussNewton(5.0, 3.0, 0.0)
    bspline, _ = fit(Image(GRID, hole), Image(TURNED, gap), everything(), everything(), None, options)
    assert rms(bspline.displacement(GRID.points(everything().inside)) - SHIFT) < 0.02


@pytest.mark.parametrize(
    ("given", "told"),
    [({"spacing_mm": 0.0}, "above 0 mm"), ({"bending": -1.0}, "bending"), ({"volume": float("nan")}, "volume")],
)
def test_senseless_parameters_are_refused(given, told):
    with pytest.raises(ParameterError, match=told):
        GaussNewton(**given)


FAT, FAT_MM, BONE = 0.06, 0.2, 0.02
OURS = Settings(gauss_newton=GaussNewton(bending=4.0))


@pytest.fixture(scope="module")
def registered(small_pair, worker):
    return register(small_pair.reference, small_pair.loaded, bone=small_pair.bone, settings=OURS, worker=worker)


def shear_error(pair, deformation, tissue: str) -> tuple[float, float]:
    """RMS error of the maximal shear and median error of the displacement (mm), where the loaded image shows it."""
    inside = pair.labels.region(tissue).inside
    grid = pair.reference.grid
    U, true_H = evaluate_on_grid(pair.deformation, grid, inside)
    u, H = evaluate_on_grid(deformation, grid, inside)
    seen = pair.loaded.grid.contains(pair.foot_motion.apply(grid.points(inside) + U))
    error = StrainField.from_gradient(H).max_shear - StrainField.from_gradient(true_H).max_shear
    return float(np.sqrt(np.mean(error[seen] ** 2))), float(np.median(np.linalg.norm(u - U, axis=1)[seen]))


def test_a_pressed_heel_is_measured(registered, small_pair):
    """Voxels of 1.6 mm, control points every 3.2 mm. No registration at all: .15 in fat, 0.7 mm."""
    shear, u_mm = shear_error(small_pair, registered.bspline, "fat")
    assert shear < FAT
    assert u_mm < FAT_MM
    assert shear_error(small_pair, registered.bspline, "bone")[0] < BONE
    assert registered.choice.weights.bending == 4.0


def test_its_spline_goes_through_an_elastix_file_unchanged(registered, small_pair, tmp_path):
    motion, grid = registered.alignment.motion, small_pair.reference.grid
    last = write_elastix_transform(tmp_path, registered.bspline, motion, grid)[-1]
    X = small_pair.labels.region("fat").points()[::50]
    np.testing.assert_allclose(
        read_transform(last).displacement(X), registered.total.displacement(X), atol=1e-6, equal_nan=True
    )


def test_a_start_is_where_it_begins_and_is_corrected_against_the_images(worker):
    """Images of one texture, 19 mm apart: two wavelengths and more, which no search from nothing finds."""
    far = np.array([14.0, -10.0, 9.0])
    fixed, near = pair_of(Affine(np.eye(3), SHIFT), 0.05)
    moving = Image(TURNED.moved_by(np.eye(3), far), near.values)
    options = Settings(gauss_newton=GaussNewton(5.0, 3.0, 0.0), align_on="none")
    control = control_grid(GRID, np.full(3, 5.0))
    start = BSpline(control, spline_through(Affine(np.eye(3), far), control))
    X = GRID.points(everything().inside)

    def off(begun_at: BSpline | None) -> float:
        found = register(fixed, moving, tissue=everything(), settings=options, start=begun_at, worker=worker)
        return rms(found.bspline.displacement(X) - SHIFT - far)

    assert off(start) < 0.25 * np.linalg.norm(SHIFT)
    assert off(None) > 3.0


def test_any_number_of_threads_gives_the_same_bits(tmp_path):
    fixed, moving = pair_of(Affine(np.eye(3) * 1.03, np.array([1.0, -0.6, 0.3])), noise=0.05)
    np.savez(tmp_path / "pair.npz", fixed=fixed.values, moving=moving.values)
    script = f"""
import hashlib, numpy as np
from dvc.gaussnewton import GaussNewton, fit
from dvc.image import Grid, Image, Mask
pair = np.load({str(tmp_path / "pair.npz")!r})
grid = Grid({GRID.shape}, np.array({GRID.spacing_mm.tolist()}), np.array({GRID.origin_mm.tolist()}))
inside = np.zeros(grid.shape, dtype=bool)
inside[4:-4, 4:-4, 4:-4] = True
mask = Mask(grid, inside)
found, choice = fit(Image(grid, pair["fixed"]), Image(grid, pair["moving"]), mask, mask, None, GaussNewton(5.0))
print(hashlib.sha256(found.coefficients_mm.tobytes()).hexdigest(), choice.weights.bending)
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


@pytest.fixture(scope="module")
def written(tmp_path_factory, small_pair) -> Path:
    folder = tmp_path_factory.mktemp("own-engine")
    write_image(folder / "Load0.nii.gz", small_pair.reference)
    write_image(folder / "Load1.nii.gz", small_pair.loaded)
    write_mask(folder / "bone.nii.gz", small_pair.bone)
    results = run(
        folder / "Load0.nii.gz", [folder / "Load1.nii.gz"], out=folder / "out", bone=folder / "bone.nii.gz",
        threads=1,
    )  # fmt: skip
    assert not results.failures
    return folder


def test_quality_and_provenance_tell_the_engine_and_how_its_weight_was_chosen(written):
    quality = json.loads((written / "out" / "Load1" / "quality.json").read_text())
    told = quality["regularisation"]
    assert told["rule"].startswith("bending by cross-validation")
    assert len(told["tried"]) >= 3
    assert min(t["left_out_over_best"] for t in told["tried"]) == 1.0
    assert 0.05 < told["weights"]["bending"] < 1000.0
    assert "Error model of gauss-newton" in quality["error_of_max_shear"]["source"]
    record = json.loads((written / "out" / "Load1" / "provenance.json").read_text())
    assert record["parameters"]["engine"] == "gauss-newton"
    assert record["parameters"]["gauss_newton"]["volume"] == GaussNewton().volume
    assert record["parameters"]["stages"] == []
    assert "gauss-newton" in (written / "out" / "report.html").read_text()


def test_error_bars_are_the_engines_own(written):
    assert (written / "out" / "Load1" / "sigma_max_shear.nii.gz").exists()
    assert json.loads((written / "out" / "Load1" / "error_model.json").read_text())["preset"] == "gauss-newton"


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"engine": "gauss-newton", "preset": "bone-rigid"}, "elastix"),
        ({"engine": "elastix", "bending": 3.0}, "gauss-newton"),
        ({"preset": "heel-mr", "parameters": ["mine.txt"]}, "not both"),
        ({"engine": "ants"}, "there are elastix and gauss-newton"),
    ],
)
def test_what_belongs_to_the_other_engine_is_refused_first(written, tmp_path, given, told):
    with pytest.raises(ParameterError, match=told):
        run(
            written / "Load0.nii.gz", [written / "Load1.nii.gz"], out=tmp_path / "o", bone=written / "bone.nii.gz",
            **given,
        )  # fmt: skip
    assert not (tmp_path / "o").exists()


def test_a_repeat_scan_is_smoothed_no_more_than_a_load(written, tmp_path, monkeypatch):
    """Chosen for a pair without strain the weight is the greatest, and the floor would be far below a load's noise."""
    used = {}

    def never(reference, loaded, *, settings, **_):
        used[float(loaded.values[0, 0, 0])] = settings.gauss_newton
        raise RegistrationError("enough")

    for module in ("registering", "registeringone"):
        monkeypatch.setattr(f"mrstrain.{module}.register_pair", never)
    load0, load1 = read_image(written / "Load0.nii.gz"), read_image(written / "Load1.nii.gz")
    for number, name in ((1.0, "Load1"), (2.0, "again")):
        values = load1.values.copy()
        values[0, 0, 0] = number
        write_image(tmp_path / f"{name}.nii.gz", Image(load1.grid, values))
    write_mask(tmp_path / "labels.nii.gz", read_mask(written / "bone.nii.gz", load0.grid))
    with pytest.raises(RegistrationError):
        run(
            written / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "o", bone=written / "bone.nii.gz",
            repeat=tmp_path / "again.nii.gz", workers=1, threads=1,
        )  # fmt: skip
    assert used == {1.0: GaussNewton(), 2.0: GaussNewton(bending=USUAL_BENDING)}
    used.clear()
    with pytest.raises(RegistrationError):
        register_one(
            written / "Load0.nii.gz", tmp_path / "again.nii.gz", out=tmp_path / "repeat",
            labels=tmp_path / "labels.nii.gz", names=None, bone=written / "bone.nii.gz",
        )  # fmt: skip
    assert used == {2.0: GaussNewton(bending=USUAL_BENDING)}
    assert Settings.of("heel-mr").of_repeat() == Settings.of("heel-mr")


def test_our_own_engine_is_used_unless_something_of_elastix_is_asked_for(tmp_path):
    (tmp_path / "mine.txt").write_text(load_preset("heel-mr").text)
    assert settings_of(None, None).gauss_newton == GaussNewton()
    assert settings_of(None, None, bending=2.0).gauss_newton == GaussNewton(bending=2.0)
    for engine, preset, files, name in (
        (None, "heel-mr", [], "heel-mr"),
        ("elastix", None, [], "heel-mr"),
        (None, None, [tmp_path / "mine.txt"], "mine.txt"),
    ):
        chosen = settings_of(engine, preset, files)
        assert (chosen.engine, chosen.name) == ("elastix", name)
