"""A made loaded image shows the deformation it was made with, and its noise stays where it is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from typer.testing import CliRunner

from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Affine, Composed, RigidMotion, SampledDisplacement, Within
from dvc.deformation.strain import StrainField
from dvc.errors import InputError
from dvc.images.image import Grid, Image, Mask
from dvc.images.noise import noise_sd, signal_to_noise
from dvc.io.images.read import read_image
from dvc.io.images.write import write_image, write_mask, write_vectors
from dvc.io.transforms.read import read_transform
from dvc.io.transforms.write import write_elastix_transform
from mrstrain.cli.app import app
from phantoms import (
    Acquisition,
    ShearWave,
    SyntheticWarp,
    heel_grid,
    labels_of,
    material_points,
    random_foot_motion,
    scan,
    synthetic_warp,
    under_load,
)

SPACING = 1.6


@pytest.fixture(scope="module")
def unloaded(heel) -> tuple[Image, Mask]:
    grid = heel_grid(SPACING).part(np.s_[6:-6, 24:, :40])  # the heel and its sole, cut off above and before
    return scan(heel, grid, snr=25.0, number=0), Mask(grid, labels_of(heel, grid).labels > 0)


def test_noise_is_found_in_air_and_without_air(unloaded: tuple[Image, Mask]) -> None:
    image, body = unloaded
    assert noise_sd(image, body) == pytest.approx(27.0, rel=0.03)
    assert signal_to_noise(image, body) == pytest.approx(25.0, rel=0.1)
    silent = Image(image.grid, np.where(body.inside, image.values, 0.0).astype(np.float32))
    assert 20.0 < noise_sd(silent, body) < 80.0  # texture counts as noise there, and more so in large voxels


def test_noise_alone_is_measured_in_tissue_too() -> None:
    """Even signal of 500, noise of 20, air set to zero: the second estimate."""
    grid = Grid((40, 40, 40), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    inside = np.zeros(grid.shape, dtype=bool)
    inside[8:32, 8:32, 8:32] = True
    values = np.where(inside, 500.0 + 20.0 * np.random.default_rng(0).standard_normal(grid.shape), 0.0)
    assert noise_sd(Image(grid, values.astype(np.float32)), Mask(grid, inside)) == pytest.approx(20.0, rel=0.05)


def test_points_are_found_back_through_a_sampled_field() -> None:
    """Of a displacement image there is no closed inverse; Newton's finds it to 1e-6 mm, or says that there is none."""
    wave = ShearWave(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]), 25.0, 0.5)
    foot = random_foot_motion(3, 1)
    grid = Grid((30, 30, 30), (2.0, 2.0, 2.0), (-29.0, -29.0, -29.0))
    X = grid.points().reshape(-1, 3)
    field = SampledDisplacement(grid, Composed([wave, foot]).displacement(X).reshape(*grid.shape, 3))
    points = np.random.default_rng(0).uniform(-18.0, 18.0, (500, 3))
    x = points + field.displacement(points)
    np.testing.assert_allclose(material_points(field, x, foot.inverse().apply(x)), points, atol=1e-6)
    assert np.isnan(material_points(field, np.array([[200.0, 0.0, 0.0]]), np.zeros((1, 3)))).all()


def sampled(grid: Grid, motion: Composed) -> np.ndarray:
    return motion.displacement(grid.points().reshape(-1, 3)).reshape(*grid.shape, 3)


def test_twin_shows_the_motion(unloaded: tuple[Image, Mask], heel) -> None:
    """Against a scan of the same heel after the same motion: alike where tissue is, unlike without the motion."""
    image, body = unloaded
    motion, foot = under_load(heel, "Load1"), random_foot_motion(2, 1)
    whole = Composed([motion, foot])
    real = scan(heel, image.grid, motion, foot, snr=None, number=7)
    for given in (whole, Within(SampledDisplacement(image.grid, sampled(image.grid, whole)), body)):
        shows_the_motion(synthetic_warp(image, body, given, Acquisition(seed=5), near=foot), image, real)


def shows_the_motion(made: SyntheticWarp, image: Image, real: Image) -> None:
    inside, air = real.values > 200.0, real.values[..., :4] <= 200.0
    inside[:, :8] = inside[..., -8:] = False  # comes from beyond the unloaded image

    def alike(values: np.ndarray) -> float:
        return float(np.corrcoef(values[inside], real.values[inside])[0, 1])

    assert made.shown > 0.9
    assert made.noise_sd == pytest.approx(27.0, rel=0.05)
    assert alike(made.image.values) > 0.8
    assert alike(image.values) < 0.65
    assert made.image.values[..., :4][air].mean() == pytest.approx(made.noise_sd * np.sqrt(np.pi / 2), rel=0.05)


def test_noise_does_not_move_with_the_tissue(unloaded: tuple[Image, Mask], heel) -> None:
    """Of the unloaded image's noise less than half its amplitude is in the twin; carried as it is, all would be."""
    image, body = unloaded
    clean = scan(heel, image.grid, snr=None, number=0)
    noise = (image.values - clean.values)[body.inside]
    still = Affine(np.eye(3), np.zeros(3))
    made = synthetic_warp(image, body, still, Acquisition(seed=5, bias_field=False))
    left = (made.image.values - clean.values)[body.inside]
    assert (noise @ left) / (noise @ noise) < 0.5
    assert left.std() < 3.0 * noise.std()


def test_a_transform_as_register_writes_it_will_do(unloaded: tuple[Image, Mask], tmp_path: Path) -> None:
    """A B-spline and a rigid motion: a composition, of which one part has no closed inverse."""
    image, body = unloaded
    control = Grid((16, 17, 17), (8.0, 8.0, 8.0), image.grid.centre_mm - 64.0)
    bspline = BSpline(control, np.random.default_rng(0).normal(scale=0.8, size=(3, *control.shape)))
    foot = random_foot_motion(2, 1)
    path = write_elastix_transform(tmp_path, bspline, foot, image.grid)[-1]
    made = synthetic_warp(image, body, read_transform(path), Acquisition(seed=1), near=foot)
    assert made.shown > 0.9
    points = body.points()[::97]
    moved = points + read_transform(path).displacement(points)
    at = np.rint(image.grid.indices_of(moved)).astype(int)
    inside = ((at >= 0) & (at < np.array(image.grid.shape))).all(axis=1)
    there = made.image.values[tuple(at[inside].T)]
    here = image.values[tuple(np.rint(image.grid.indices_of(points[inside])).astype(int).T)]
    assert np.corrcoef(there, here)[0, 1] > 0.8


def test_the_skin_keeps_its_partial_volume(unloaded: tuple[Image, Mask]) -> None:
    """At rest the twin's rim, air included, is that of the unloaded scan; cut at the mask it would be dark outside."""
    image, body = unloaded
    made = synthetic_warp(image, body, Affine(np.eye(3), np.zeros(3)), Acquisition(seed=5, bias_field=False))
    rim = binary_dilation(body.inside) & ~body.inside
    assert image.values[rim].mean() > 2.0 * made.noise_sd
    assert made.image.values[rim].mean() == pytest.approx(image.values[rim].mean(), rel=0.25)


def test_what_no_image_can_show_is_refused(unloaded: tuple[Image, Mask]) -> None:
    image, body = unloaded
    with pytest.raises(InputError, match="folds"):
        synthetic_warp(image, body, Affine(np.diag([-1.0, 1.0, 1.0]), np.zeros(3)), Acquisition(seed=1))
    with pytest.raises(InputError, match="field of view"):
        synthetic_warp(image, body, RigidMotion(np.eye(3), np.array([90.0, 0.0, 0.0])), Acquisition(seed=1))
    other = Mask(Grid(body.grid.shape, body.grid.spacing_mm, body.grid.origin_mm + 1.0), body.inside)
    with pytest.raises(InputError, match="on another grid than the unloaded image"):
        synthetic_warp(image, other, RigidMotion.identity(), Acquisition(seed=1))
    part = np.zeros(body.grid.shape, dtype=bool)
    part[:20] = True
    few = Within(Affine(np.eye(3), np.zeros(3)), Mask(body.grid, part))
    with pytest.raises(InputError, match=r"half|defined"):
        synthetic_warp(image, body, few, Acquisition(seed=1))


def test_command_writes_the_twin_and_its_truth(unloaded: tuple[Image, Mask], heel, tmp_path: Path) -> None:
    image, _ = unloaded
    write_image(tmp_path / "Load0.nii.gz", image)
    bone = labels_of(heel, image.grid).region("bone")
    write_mask(tmp_path / "bone.nii.gz", bone)
    motion, foot = under_load(heel, "Load4"), random_foot_motion(2, 1)
    u = sampled(image.grid, Composed([motion, foot]))
    write_vectors(tmp_path / "u.nii.gz", image.grid, u.astype(np.float32), ("x", "y", "z"), "u", "LPS", unit="mm")
    given = ["twin", str(tmp_path / "Load0.nii.gz"), str(tmp_path / "u.nii.gz"), "--out", str(tmp_path / "warped heel")]
    result = CliRunner().invoke(app, [*given, "--bone", str(tmp_path / "bone.nii.gz")])
    assert result.exit_code == 0, result.output
    registered = (
        f"'{tmp_path}/warped heel/twin.nii.gz' --bone {tmp_path}/bone.nii.gz --out '{tmp_path}/warped heel/results'"
    )
    told = " ".join(result.output.replace("\\\n", "").split())
    assert f"mrstrain register {tmp_path}/Load0.nii.gz {registered}" in told
    assert read_image(tmp_path / "warped heel" / "twin.nii.gz").grid.same_as(image.grid)
    found = read_image(tmp_path / "warped heel" / "truth" / "twin" / "max_shear.nii.gz", allow_missing=True).values
    fat = labels_of(heel, image.grid).region("fat").inside & np.isfinite(found)
    true = StrainField.from_gradient(motion.evaluate(image.grid.points(fat))[1]).max_shear
    # a displacement sampled every 1.6 mm blurs the jumps of the strain
    assert np.median(np.abs(found[fat] - true)) < 0.01
    assert (tmp_path / "warped heel" / "truth" / "twin" / "displacement.nii.gz").exists()


def test_where_the_unloaded_image_did_not_look_the_twin_has_no_value(unloaded: tuple[Image, Mask]) -> None:
    image, body = unloaded
    foot = RigidMotion(np.eye(3), np.array([0.0, 0.0, -3.0 * SPACING]))  # the leg's end comes into view
    own = Acquisition(seed=1, grid=image.grid)
    missing = ~np.isfinite(synthetic_warp(image, body, foot, own, near=foot, beyond_missing=True).image.values)
    assert missing[..., -3:].all()
    assert not missing[..., :-3].any()
    assert np.isfinite(synthetic_warp(image, body, foot, own, near=foot).image.values).all()
    noisier = synthetic_warp(image, body, foot, replace(own, noise_factor=2.0), near=foot)
    assert noisier.noise_sd == pytest.approx(2.0 * noise_sd(image, body), rel=1e-3)
