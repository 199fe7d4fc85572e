"""Alignment and registration on a phantom whose motion is known, and what must be refused."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Composed, RigidMotion, evaluate_on_grid
from dvc.deformation.strain import StrainField
from dvc.errors import InputError, ParameterError, RegistrationError
from dvc.images.bias_field import without_bias_field
from dvc.images.image import Grid, Image, Mask
from dvc.images.resample import carry, shows
from dvc.images.tissue import tissue_mask
from dvc.registration.align import Alignment, align, motion_of
from dvc.registration.elastix.engine import Elastix
from dvc.registration.elastix.presets import Preset, load_preset
from dvc.registration.gauss_newton.engine import GaussNewton
from dvc.registration.register import Registration, Settings, register
from phantoms import heel_pair

slow = partial(pytest.param, marks=pytest.mark.full_size)
COARSE_MM = 0.1  # at voxels of 1.6 mm; the full size, 0.8 mm, is held to 0.05 mm and 0.05 degrees below
QUICK = {
    "MaximumNumberOfIterations": ("100",),
    "NumberOfSpatialSamples": ("2000",),
    "FinalGridSpacingInPhysicalUnits": ("6.0",),
}


def quick(**changes: tuple[str, ...]) -> Settings:
    preset = load_preset("heel-mr")
    return Settings(Elastix((Preset("quick", preset.text, preset.parameters | QUICK | changes),)))


def few() -> Settings:
    """Iterations that begin: where the displacement that they would find is not looked at."""
    return quick(MaximumNumberOfIterations=("20",))


def rms_over(mask: Mask, a: RigidMotion, b: RigidMotion) -> float:
    X = mask.points()
    return float(np.sqrt(np.mean(np.sum((a.apply(X) - b.apply(X)) ** 2, axis=1))))


@pytest.fixture(scope="session")
def found(small_pair, worker, computed_once):
    given = {"bone": small_pair.bone, "settings": quick(), "worker": worker}
    return computed_once("by-elastix", lambda: register(small_pair.reference, small_pair.loaded, **given))


def test_the_bones_motion_is_found(found, small_pair):
    assert rms_over(small_pair.bone, found.alignment.motion, small_pair.foot_motion) < COARSE_MM
    assert found.alignment.similarity > 0.9
    assert found.alignment.repeatability_mm < COARSE_MM  # of two halves, which know half as much each


def test_strain_is_that_of_the_tissue_relative_to_its_bone(found, small_pair):
    grid = small_pair.reference.grid
    fat = small_pair.labels.region("fat").inside
    U, true_H = evaluate_on_grid(small_pair.deformation, grid, fat)
    seen = small_pair.loaded.grid.contains(small_pair.foot_motion.apply(grid.points(fat) + U))
    u, H = evaluate_on_grid(found.displacement, grid, fat)
    distance = np.linalg.norm(u - U, axis=1)[seen]
    error = (StrainField.from_gradient(H).max_shear - StrainField.from_gradient(true_H).max_shear)[seen]
    # No registration at all would leave a median of 0.7 mm and a root mean square of 0.15.
    assert np.median(distance) < 0.45
    assert np.sqrt(np.mean(error**2)) < 0.09
    assert np.isfinite(distance).all()


def test_the_total_motion_holds_the_bones_motion_as_well(found, small_pair):
    X = small_pair.bone.points()[::50]
    whole = X + found.total.displacement(X)
    apart = found.alignment.motion.apply(X + found.displacement.displacement(X))
    np.testing.assert_allclose(whole, apart, atol=1e-9)


def test_same_seed_same_result_bit_for_bit_other_seed_another(tiny_pair, worker):
    def registered(seed: int) -> Registration:
        settings = replace(quick(MaximumNumberOfIterations=("2",)), seed=seed, align_on="none")
        given = {"tissue": Mask(tiny_pair.labels.grid, tiny_pair.labels.labels > 0), "worker": worker}
        return register(tiny_pair.reference, tiny_pair.loaded, settings=settings, **given)

    one, again, other = (registered(seed).displacement.coefficients_mm for seed in (1, 1, 2))
    np.testing.assert_array_equal(again, one)
    assert np.abs(other - one).max() > 1e-6


@pytest.mark.full_size  # other orders of the voxels: test_any_frame
def test_an_image_stored_in_another_orientation_gives_the_same_result(found, small_pair, worker):
    loaded = small_pair.loaded
    turned_grid = Grid(
        (loaded.grid.shape[2], loaded.grid.shape[0], loaded.grid.shape[1]),
        loaded.grid.spacing_mm[[2, 0, 1]],
        loaded.grid.points_at(np.array([0.0, loaded.grid.shape[1] - 1.0, 0.0])),
        loaded.grid.direction[:, [2, 0, 1]] * np.array([1.0, 1.0, -1.0]),
    )
    turned = Image(turned_grid, loaded.values[:, ::-1].transpose(2, 0, 1))
    np.testing.assert_array_equal(turned.toward_lps().values, loaded.values)
    again = register(small_pair.reference, turned, bone=small_pair.bone, settings=quick(), worker=worker)
    np.testing.assert_allclose(again.displacement.coefficients_mm, found.displacement.coefficients_mm, atol=1e-9)


@pytest.mark.full_size
def test_a_start_is_where_elastix_begins(found, small_pair, worker):
    """In one iteration at each resolution nothing is found; what is there was there at the start."""
    few = quick(MaximumNumberOfIterations=("1",))
    begun = from_start(found.displacement, few, small_pair, worker)
    assert begun.control.same_as(found.displacement.control)
    assert off(begun, small_pair) < 0.4  # .20 at the start, .27 after an iteration, .69 from nothing


@pytest.mark.full_size
def test_a_start_of_elastix_is_corrected_against_the_images(found, small_pair, worker):
    """Chained: the start's B-spline and the correction add up to one on the same control points."""
    bare = from_start(None, quick(MaximumNumberOfIterations=("1",)), small_pair, worker)
    assert off(bare, small_pair) > 0.6  # .69
    wrong = replace(found.displacement, coefficients_mm=1.3 * found.displacement.coefficients_mm)
    mended = from_start(wrong, quick(), small_pair, worker)
    assert off(wrong, small_pair) > 1.2 * off(mended, small_pair)
    assert off(mended, small_pair) < off(found.displacement, small_pair) + 0.1


def from_start(start: BSpline | None, settings: Settings, pair, worker) -> BSpline:
    given = {"bone": pair.bone, "settings": settings, "start": start, "worker": worker}
    return register(pair.reference, pair.loaded, **given).displacement


def off(bspline: BSpline, pair) -> float:
    """Median distance to the true displacement in fat, mm."""
    X = pair.labels.region("fat").points()[::7]
    return float(np.median(np.linalg.norm(bspline.displacement(X) - pair.deformation.displacement(X), axis=1)))


def test_without_a_bone_the_whole_image_can_be_aligned(tiny_pair, worker):
    settings = Settings(GaussNewton(bending=4.0, volume=300.0), align_on="image")
    found = register(tiny_pair.reference, tiny_pair.repeat, settings=settings, worker=worker)
    assert found.alignment.on == "image"
    assert rms_over(tiny_pair.bone, found.alignment.motion, tiny_pair.foot_motion) < 2.5 * COARSE_MM
    assert rms_over(tiny_pair.bone, RigidMotion.identity(), tiny_pair.foot_motion) > 1.5


@pytest.mark.full_size
@pytest.mark.parametrize("seed", [11, 12])
def test_row_9_a_foot_moved_by_20_mm_and_15_degrees_is_found(seed):
    random = np.random.default_rng(seed)
    axis, way = random.normal(size=(2, 3))
    rotation = Rotation.from_rotvec(np.radians(15.0) * axis / np.linalg.norm(axis)).as_matrix()
    motion = RigidMotion.about(np.array([0.0, 5.0, 0.0]), rotation, 20.0 * way / np.linalg.norm(way))
    pair = heel_pair(seed=seed, foot_motion=motion)
    found = aligned(pair.reference, pair.loaded, pair.bone)
    assert rms_over(pair.bone, found.motion, motion) < 0.03  # elastix, in its place: 0.05
    assert found.motion.after(motion.inverse()).angle_deg < 0.03


def test_row_9_another_centre_is_no_obstacle(small_pair):
    far = RigidMotion(np.eye(3), np.array([300.0, -150.0, 800.0]))
    moved = Image(small_pair.loaded.grid.moved_by(far.rotation, far.translation_mm), small_pair.loaded.values)
    found = aligned(small_pair.reference, moved, small_pair.bone)
    assert rms_over(small_pair.bone, found.motion, far.after(small_pair.foot_motion)) < COARSE_MM


def aligned(reference: Image, loaded: Image, bone: Mask) -> Alignment:
    return align(without_bias_field(reference), without_bias_field(loaded), bone, "bone", 1)


@pytest.mark.parametrize("noise", [slow(0.0), 3.0])
@pytest.mark.parametrize("along", [[0.0, 0.0, 1.0], [1.0, 1.0, 0.0], slow([1.0, -2.0, 1.0])], ids=str)
def test_row_9_a_bone_along_which_fits_slide_is_not_located(along, noise):
    """A rod of uniform signal looks the same all along: fits begun apart stay apart, but for one with a knob."""
    random, axis = np.random.default_rng(3), np.array(along) / np.linalg.norm(along)
    grid = Grid((36, 36, 36), np.full(3, 2.0), np.full(3, -35.0))
    X = grid.points()
    ahead = X @ axis
    rod = np.linalg.norm(X - ahead[..., None] * axis, axis=-1) < 9.0
    aside = np.cross(axis, [0.3, 0.5, -0.4])
    knob = np.linalg.norm(X - 9.0 * aside / np.linalg.norm(aside) - 3.0 * axis, axis=-1) < 8.0
    bone = Mask(grid, (rod | knob) & (np.abs(ahead) < 16.0))

    def seen(shape: np.ndarray) -> Image:
        clean = gaussian_filter(np.where(shape, 100.0, 40.0), 0.7)
        return Image(grid, (clean + noise * random.normal(size=shape.shape)).astype(np.float32))

    advice = r"the position of the bone is uncertain\. Check .* or use --align image or none\.$"
    with pytest.raises(RegistrationError, match=advice):
        align(seen(rod), seen(rod), bone, "bone", 1)
    found = align(seen(rod | knob), seen(rod | knob), bone, "bone", 1)
    assert found.repeatability_mm < (0.4 if noise else 0.02)
    with pytest.raises(RegistrationError, match=r"the image is uncertain\. Give a mask .* or use --align none, if"):
        align(seen(rod), seen(rod), bone, "image", 1)


@pytest.mark.parametrize("noise", [0.5, 3.0])
def test_row_9_a_bone_whose_turning_nothing_shows_is_not_located(noise):
    """A ball looks the same however it is turned, a flat one when it is about its axis; with three axes it does not."""
    random, grid = np.random.default_rng(3), Grid((36, 36, 36), np.full(3, 2.0), np.full(3, -35.0))

    def pair(axes: list[float]) -> tuple[Image, Image, Mask]:
        radius = np.linalg.norm(grid.points() / axes, axis=-1)
        clean = 40.0 + 60.0 / (1.0 + np.exp(radius - 14.0))
        images = (clean + noise * random.normal(size=grid.shape) for _ in range(2))
        one, other = (Image(grid, values.astype(np.float32)) for values in images)
        return one, other, Mask(grid, radius < 14.0)

    for axes in ([1.0, 1.0, 1.0], [1.0, 1.0, 0.6]):
        with pytest.raises(RegistrationError, match="the position of the bone is uncertain"):
            align(*pair(axes), "bone", 1)
    assert align(*pair([1.0, 1.6, 0.6]), "bone", 1).repeatability_mm < 0.2 * noise


def test_row_9_an_image_without_the_bone_is_refused(small_pair, worker):
    random = np.random.default_rng(5)
    noise = gaussian_filter(random.normal(size=small_pair.loaded.grid.shape), 2.0).astype(np.float32)
    with pytest.raises(RegistrationError, match="no position in the loaded image matches it"):
        register(
            small_pair.reference,
            Image(small_pair.loaded.grid, noise),
            bone=small_pair.bone,
            settings=quick(),
            worker=worker,
        )


def test_row_27_inverted_contrast_is_refused_and_the_measure_that_could_is_named(tiny_pair, worker):
    turned = Image(tiny_pair.loaded.grid, tiny_pair.loaded.values.max() - tiny_pair.loaded.values)
    with pytest.raises(RegistrationError, match="AdvancedMattesMutualInformation"):
        register(tiny_pair.reference, turned, bone=tiny_pair.bone, settings=quick(), worker=worker)


@pytest.mark.parametrize("air_too", [True, False])
@pytest.mark.parametrize("settings", [Settings.of("gauss-newton"), quick()], ids=["gauss-newton", "elastix"])
def test_row_27_without_alignment_too(settings, air_too, tiny_pair, worker):
    loaded, back = tiny_pair.loaded, tiny_pair.foot_motion.inverse()
    grid = loaded.grid.moved_by(back.rotation, back.translation_mm)
    inside = np.ones(grid.shape, dtype=bool) if air_too else tissue_mask(loaded).inside
    turned = Image(grid, np.where(inside, loaded.values.max() - loaded.values, loaded.values))
    with pytest.raises(RegistrationError, match=r"correlate negatively .*AdvancedMattesMutualInformation"):
        register(tiny_pair.reference, turned, settings=replace(settings, align_on="none"), worker=worker)


@pytest.mark.full_size
def test_row_27_mutual_information_follows_turned_contrast(tiny_pair, worker):
    turned = Image(tiny_pair.loaded.grid, tiny_pair.loaded.values.max() - tiny_pair.loaded.values)
    settings = replace(quick(Metric=("AdvancedMattesMutualInformation",)), align_on="none")
    found = register(tiny_pair.reference, turned, settings=settings, worker=worker)
    fat = tiny_pair.labels.region("fat").points()[::7]
    total = found.total.displacement(fat)
    truth = Composed([tiny_pair.deformation, tiny_pair.foot_motion]).displacement(fat)
    # 3 mm without any registration
    assert np.nanmedian(np.linalg.norm(total - truth, axis=1)) < 1.5


def test_row_8_identical_images_are_refused(tiny_pair):
    with pytest.raises(InputError, match="all voxels are equal"):
        register(tiny_pair.reference, tiny_pair.reference, bone=tiny_pair.bone)


@pytest.mark.parametrize("of", ["image", "body"])
def test_a_bone_mask_that_leaves_no_soft_tissue_is_refused(of, tiny_pair):
    everything = np.ones(tiny_pair.reference.grid.shape, dtype=bool)
    inside = everything if of == "image" else tissue_mask(tiny_pair.reference).inside
    with pytest.raises(InputError, match=r"covers 100 % of the body"):
        register(tiny_pair.reference, tiny_pair.loaded, bone=Mask(tiny_pair.reference.grid, inside))


def test_the_bone_is_needed_to_align_on_it(tiny_pair):
    with pytest.raises(InputError, match="--bone"):
        register(tiny_pair.reference, tiny_pair.loaded)


def test_a_rigid_transform_is_no_nonrigid_stage():
    with pytest.raises(ParameterError, match="not a B-spline"):
        quick(Transform=("EulerTransform",))


def test_elastix_own_reason_is_told(tiny_pair, worker):
    with pytest.raises(RegistrationError, match=r"elastix failed: .*[Ss]pline"):
        register(
            tiny_pair.reference,
            tiny_pair.loaded,
            bone=tiny_pair.bone,
            worker=worker,
            settings=quick(BSplineTransformSplineOrder=("7",)),
        )


@pytest.mark.full_size
def test_missing_voxels_are_left_out(tiny_pair, worker):
    """A tenth of the bone is not shown: neither an edge for the rigid fit, nor a result there."""
    grid, inside = tiny_pair.loaded.grid, tiny_pair.bone.points()
    front = np.percentile(tiny_pair.foot_motion.apply(inside)[:, 1], 10.0)
    values = np.array(tiny_pair.loaded.values)
    values[grid.points()[..., 1] < front] = np.nan
    cut = Image(grid, values)
    found = register(tiny_pair.reference, cut, bone=tiny_pair.bone, settings=few(), worker=worker)
    assert rms_over(tiny_pair.bone, found.alignment.motion, tiny_pair.foot_motion) < 3 * COARSE_MM
    assert np.isfinite(found.displacement.coefficients_mm).all()
    X = tiny_pair.bone.points()
    assert 0.02 < 1.0 - shows(cut, found.alignment.motion.apply(X)).mean() < 0.2


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"engine": "gauss-newton"}, "Settings.of"),
        ({"engine": GaussNewton(), "align_on": "bones"}, "bone or image or none"),
        ({"engine": GaussNewton(), "threads": 0}, "1 to 256"),
    ],
)
def test_settings_that_cannot_be_used_are_refused_when_they_are_made(given, told):
    with pytest.raises(ParameterError, match=told):
        Settings(**given)


def test_an_engine_that_is_not_there_is_refused_with_those_that_are():
    with pytest.raises(
        ParameterError, match="use gauss-newton, gauss-newton-bone, gauss-newton-borders, heel-mr, or an elastix"
    ):
        Settings.of("gauss")


def test_stages_that_end_on_other_control_points_are_refused_first():
    preset = quick().engine.presets[0]
    other = replace(preset, parameters=preset.parameters | {"FinalGridSpacingInPhysicalUnits": ("5.0",)})
    with pytest.raises(ParameterError, match="must be equal"):
        Elastix((preset, other))


def test_progress_tells_stages_and_rises(tiny_pair, worker):
    told: list[tuple[str, float]] = []
    register(
        tiny_pair.reference,
        tiny_pair.loaded,
        bone=tiny_pair.bone,
        settings=quick(MaximumNumberOfIterations=("3",)),
        worker=worker,
        progress=lambda stage, fraction: told.append((stage, fraction)),
    )
    assert next(s for s, _ in told) == "aligning"
    fractions = [f for s, f in told if s == "registering"]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert len(fractions) > 2


def test_the_worker_compiles_beside_the_caller_once_it_has_aligned(tiny_pair, worker, monkeypatch):
    told = list[object]()
    monkeypatch.setattr(worker, "beforehand", told.append)
    run = worker.run
    monkeypatch.setattr(worker, "run", lambda what, *given, **how: told.append(what) or run(what, *given, **how))
    chosen = Settings(GaussNewton(bending=10.0, volume=300.0))
    register(tiny_pair.reference, tiny_pair.loaded, bone=tiny_pair.bone, settings=chosen, worker=worker)
    aligning, beside, fitting = told
    assert (aligning, beside) == ("aligning the bone", chosen.engine.prepare_beside)
    assert isinstance(fitting, str)


def test_the_motion_of_a_bone_is_taken_from_any_deformation(small_pair):
    motion = small_pair.foot_motion
    found = motion_of(Composed([small_pair.deformation, motion]), small_pair.bone)
    assert rms_over(small_pair.bone, found, motion) < 1e-9


@pytest.mark.full_size
def test_control_points_are_never_closer_than_two_voxels(small_pair, worker, caplog):
    """Thick slices: a spacing that the image cannot carry is widened, and that is told."""
    thick = Grid((64, 72, 14), np.array([1.6, 1.6, 8.0]), small_pair.reference.grid.origin_mm)

    def slices(image: Image) -> Image:
        return Image(thick, np.nan_to_num(carry(image, thick, order=1)))

    found = register(
        slices(small_pair.reference),
        slices(small_pair.loaded),
        settings=replace(few(), align_on="none"),
        worker=worker,
    )
    np.testing.assert_allclose(found.displacement.control.spacing_mm, [6.0, 6.0, 16.0])
    assert "too coarse" in caplog.text
