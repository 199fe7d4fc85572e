"""The phantom's truth is exact, its images are what they claim to be, and it repeats bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from dvc.deformation import Deformation, RigidMotion
from dvc.errors import InputError
from dvc.image import Grid, Image
from phantoms.anatomy import FAT_SIGNAL, TISSUES, Heel
from phantoms.heel import HeelPair, default_motion, heel_pair, loaded_octants, loaded_signal, pressed
from phantoms.motions import EllipsoidUnion, Flow
from phantoms.mri import acquire, sensitivity

COARSE = {"shape": (50, 56, 53), "spacing_mm": 2.0}


@pytest.fixture(scope="module")
def heel() -> Heel:
    return Heel(seed=1)


@pytest.fixture(scope="module")
def pair() -> HeelPair:
    return heel_pair(seed=1, **COARSE)


@pytest.fixture(scope="module")
def tissue_points(heel: Heel) -> np.ndarray:
    """Points in soft tissue and bone, all over the heel."""
    points = np.random.default_rng(5).uniform([-32, -55, -45], [32, 46, 40], (6000, 3))
    return points[heel.tissue_at(points) > 0]


def max_shear(H: np.ndarray) -> np.ndarray:
    F = H + np.eye(3)
    principal = np.linalg.eigvalsh(0.5 * (F.transpose(0, 2, 1) @ F - np.eye(3)))
    return 0.5 * (principal[:, 2] - principal[:, 0])


# --- motions ---------------------------------------------------------------------------------------


def test_flow_is_a_deformation(heel: Heel) -> None:
    assert isinstance(pressed(heel), Deformation)


@pytest.mark.parametrize("load", [0.3, 1.0])
def test_gradient_is_the_derivative_of_the_map(heel: Heel, tissue_points: np.ndarray, load: float) -> None:
    flow, h = pressed(heel, load), 1e-3
    points = tissue_points[:1500]
    _, H = flow.evaluate(points)
    differences = np.stack(
        [(flow.displacement(points + h * e) - flow.displacement(points - h * e)) / (2 * h) for e in np.eye(3)],
        axis=-1,
    )
    assert np.abs(H).max() > 0.1
    np.testing.assert_allclose(H, differences, atol=1e-6)


def test_both_ways_give_the_same_displacement(heel: Heel, tissue_points: np.ndarray) -> None:
    flow = pressed(heel)
    np.testing.assert_array_equal(flow.evaluate(tissue_points)[0], flow.displacement(tissue_points))


def test_backward_flow_is_the_inverse(heel: Heel, tissue_points: np.ndarray) -> None:
    flow = pressed(heel)
    u, H = flow.evaluate(tissue_points)
    back, H_back = flow.inverse().evaluate(tissue_points + u)
    assert np.abs(u + back).max() < 1e-6
    np.testing.assert_allclose((H_back + np.eye(3)) @ (H + np.eye(3)), np.tile(np.eye(3), (len(u), 1, 1)), atol=1e-5)


def test_volume_is_kept(heel: Heel, tissue_points: np.ndarray) -> None:
    _, H = pressed(heel).evaluate(tissue_points)
    np.testing.assert_allclose(np.linalg.det(H + np.eye(3)), 1.0, atol=1e-5)


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


@pytest.mark.parametrize("load", [0.5, 1.5])
def test_nothing_moves_further_than_images_allow_for(heel: Heel, tissue_points: np.ndarray, load: float) -> None:
    """Images leave out air beyond 1.2 times the plate's displacement; tissue must not get there."""
    flow = pressed(heel, load)
    moved = np.linalg.norm(flow.displacement(tissue_points), axis=1)
    assert moved.max() < 1.2 * np.linalg.norm(flow.plate_mm)


def test_missing_points_stay_missing(heel: Heel) -> None:
    u, H = pressed(heel).evaluate(np.array([[0.0, 15.0, -35.0], [np.nan, 0.0, 0.0]]))
    assert np.isfinite(u[0]).all()
    assert np.isnan(u[1]).all()
    assert np.isnan(H[1]).all()


def test_body_distance_is_exact_for_a_ball() -> None:
    ball = EllipsoidUnion.of([((1.0, 2.0, 3.0), (8.0, 8.0, 8.0), (10.0, 20.0, 30.0))])
    points = np.random.default_rng(0).normal(size=(50, 3)) * 6.0 + 12.0
    np.testing.assert_allclose(ball.distance(points), np.linalg.norm(points - [1.0, 2.0, 3.0], axis=1) - 8.0, atol=1e-9)


# --- anatomy ---------------------------------------------------------------------------------------


def test_every_tissue_is_there(pair: HeelPair) -> None:
    volumes = {name: pair.labels.region(name).volume_mm3 / 1000 for name in TISSUES.values()}
    assert 25 < volumes["bone"] < 45
    assert 70 < volumes["fat"] < 130
    assert all(volume > 1.0 for volume in volumes.values()), volumes


def test_calcaneus_has_the_size_of_one(heel: Heel) -> None:
    points = Grid((60, 90, 60), (1.0, 1.0, 1.0), (-30.0, -45.0, -32.0)).points().reshape(-1, 3)
    bone = points[heel.tissue_at(points) == 1]
    extent = np.ptp(bone, axis=0) + 1.0
    np.testing.assert_array_less([30.0, 62.0, 36.0], extent)
    np.testing.assert_array_less(extent, [42.0, 74.0, 46.0])
    lowest = bone[np.argmin(bone[:, 2])]
    below = np.array([[lowest[0], lowest[1], z] for z in np.arange(lowest[2] - 1.5, -60.0, -0.5)])
    names = [TISSUES.get(int(t), "air") for t in heel.tissue_at(below)]
    assert [n for n, before in zip(names, [None, *names], strict=False) if n != before] == [
        "fat",
        "skin",
        "air",
    ]


def test_skin_has_its_thickness(heel: Heel) -> None:
    column = np.array([[0.0, 15.0, z] for z in np.arange(-48.0, -36.0, 0.01)])
    thickness = 0.01 * np.count_nonzero(heel.tissue_at(column) == 4)
    assert thickness == pytest.approx(2.0, abs=0.1)


def test_signal_follows_the_tissue(heel: Heel, tissue_points: np.ndarray) -> None:
    tissue, signal = heel.tissue_at(tissue_points), heel.intensity_at(tissue_points)
    mean = {name: signal[tissue == label].mean() for label, name in TISSUES.items()}
    assert mean["tendon"] < mean["skin"] < mean["muscle"] < mean["bone"] < mean["fat"]
    assert mean["fat"] == pytest.approx(FAT_SIGNAL, rel=0.03)
    assert heel.intensity_at(np.array([[0.0, 0.0, -80.0]])) == 0.0


@pytest.mark.parametrize("name", ["fat", "muscle", "bone"])
def test_tissue_has_texture_to_follow(heel: Heel, tissue_points: np.ndarray, name: str) -> None:
    """Seen at 0.8 mm, the texture stands clear of noise at SNR 25."""
    label = {v: k for k, v in TISSUES.items()}[name]
    inside = tissue_points[heel.tissue_at(tissue_points) == label]
    voxels = heel.octant_intensity(inside, 0.8 * np.eye(3)).mean(axis=(1, 2, 3))
    assert voxels.std() > FAT_SIGNAL / 25.0


def test_seeds_differ(heel: Heel, tissue_points: np.ndarray) -> None:
    other = Heel(seed=2)
    changed = np.mean(other.tissue_at(tissue_points) != heel.tissue_at(tissue_points))
    assert 0.005 < changed < 0.2
    fat = (other.tissue_at(tissue_points) == 2) & (heel.tissue_at(tissue_points) == 2)
    signals = other.intensity_at(tissue_points[fat]), heel.intensity_at(tissue_points[fat])
    assert abs(np.corrcoef(signals)[0, 1]) < 0.15


# --- image formation -------------------------------------------------------------------------------


def test_rician_noise_has_its_sigma() -> None:
    grid = Grid((40, 40, 40), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    bright = acquire(
        np.full((*grid.shape, 2, 2, 2), 500.0), grid, snr=20.0, reference_signal=500.0, seed=1, bias_seed=None
    )
    dark = acquire(np.zeros((*grid.shape, 2, 2, 2)), grid, snr=20.0, reference_signal=500.0, seed=2, bias_seed=None)
    sigma = 25.0
    assert bright.values.std() == pytest.approx(sigma, rel=0.02)
    assert bright.values.mean() == pytest.approx(500.0 + sigma**2 / 1000.0, abs=0.4)
    # air: the Rayleigh distribution
    assert dark.values.mean() == pytest.approx(sigma * np.sqrt(np.pi / 2), rel=0.01)
    assert dark.values.std() == pytest.approx(sigma * np.sqrt(2 - np.pi / 2), rel=0.02)


def scanned(octants: np.ndarray, grid: Grid) -> np.ndarray:
    return acquire(octants, grid, snr=None, reference_signal=1.0, seed=0, bias_seed=None).values.astype(float)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_frequencies_that_voxels_carry_are_kept_and_finer_ones_are_not(axis: int) -> None:
    """Waves of 0.25 and of 0.75 cycles a voxel: one as it is, the other gone, where plain averaging keeps a ghost."""
    grid = Grid((20, 20, 20), (0.8, 0.8, 2.0), (0.0, 0.0, 0.0))
    centres, samples = np.arange(20) + 0.5, (np.arange(40) + 0.5) / 2.0
    for frequency, kept in ((0.25, 1.0), (0.75, 0.0)):
        fine = np.moveaxis(np.broadcast_to(np.cos(2 * np.pi * frequency * samples), (40, 40, 40)), 2, axis)
        octants = fine.reshape(20, 2, 20, 2, 20, 2).transpose(0, 2, 4, 1, 3, 5)
        expected = kept * np.moveaxis(np.broadcast_to(np.cos(2 * np.pi * frequency * centres), grid.shape), 2, axis)
        np.testing.assert_allclose(scanned(octants, grid), expected, atol=1e-5)
        if kept == 0.0:
            assert octants.mean(axis=(3, 4, 5)).std() > 0.2


def test_a_point_keeps_its_sum_and_its_place() -> None:
    grid = Grid((21, 21, 21), (0.8, 0.8, 2.0), (0.0, 0.0, 0.0))
    point = np.zeros((21, 21, 21, 2, 2, 2))
    point[10, 11, 9] = 1.0
    image = scanned(point, grid)
    assert image.sum() == pytest.approx(1.0, abs=1e-5)
    for axis, place in enumerate((10, 11, 9)):
        profile = image.sum(axis=tuple(a for a in range(3) if a != axis))
        assert profile @ np.arange(21.0) == pytest.approx(place, abs=2e-3)
        np.testing.assert_allclose(profile[place - 8 : place], profile[place + 8 : place : -1], atol=1e-3)


def test_function_and_array_give_the_same_image(heel: Heel) -> None:
    turn = Rotation.from_rotvec([0.2, -0.1, 0.3]).as_matrix()
    grid = Grid((9, 8, 7), (0.8, 1.0, 1.5), (-3.0, 12.0, -40.0), turn)
    octants = heel.octant_intensity(grid.points().reshape(-1, 3), turn * grid.spacing_mm)
    array = octants.reshape(*grid.shape, 2, 2, 2)
    images = [
        acquire(signal, grid, snr=None, reference_signal=1.0, seed=0, bias_seed=3).values
        for signal in (heel.intensity_at, array)
    ]
    np.testing.assert_allclose(images[0], images[1], rtol=1e-6, atol=1e-3)


def test_sensitivity_is_smooth_and_bounded() -> None:
    grid = Grid((60, 50, 40), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    one, two = sensitivity(grid, 1), sensitivity(grid, 2)
    assert np.abs(one - 1.0).max() == pytest.approx(0.2, abs=1e-6)
    assert max(np.abs(np.diff(one, axis=a)).max() for a in range(3)) < 0.03
    assert np.abs(one - two).max() > 0.1


# --- pairs -----------------------------------------------------------------------------------------


def test_signal_moves_with_the_tissue(heel: Heel) -> None:
    """Before blur, bias and noise, the loaded heel at x has the signal of the unloaded heel at X."""
    flow, motion = pressed(heel), default_motion()
    X = np.random.default_rng(3).uniform([-30, -40, -42], [30, 44, 20], (4000, 3))
    before = heel.intensity_at(X)
    after = loaded_signal(heel, flow, motion)(motion.apply(X + flow.displacement(X)))
    scale = FAT_SIGNAL
    # a point within 1e-7 mm of a border may fall to its other side
    assert np.mean(np.abs(after - before) < 1e-4 * scale) > 0.9995
    shifted = loaded_signal(heel, flow, motion)(motion.apply(X + flow.displacement(X)) + 0.05)
    assert np.mean(np.abs(shifted - before) < 1e-4 * scale) < 0.5


def test_voxels_are_carried_back_with_their_shape(heel: Heel) -> None:
    """Against samples that are each carried back by the flow itself."""
    turn = Rotation.from_rotvec([0.1, 0.3, -0.2]).as_matrix()
    grid = Grid((24, 22, 14), (0.8, 0.8, 1.6), (-8.0, 6.0, -38.0), turn)
    flow, motion = pressed(heel), default_motion()
    signals = loaded_signal(heel, flow, motion), loaded_octants(heel, flow, motion, grid)
    one, two = (
        acquire(signal, grid, snr=None, reference_signal=1.0, seed=0, bias_seed=None).values for signal in signals
    )
    assert np.std(one - two) < 0.02 * one.std()


def test_images_show_the_motion(heel: Heel) -> None:
    """In the pad at 0.8 mm: carried back by the truth the loaded image is the reference, otherwise not."""
    before = Grid((34, 34, 20), (0.8, 0.8, 0.8), (-13.0, 2.0, -42.0))
    after = Grid((60, 60, 44), (0.8, 0.8, 0.8), (-23.0, -8.0, -48.0))
    reference = acquire(heel.intensity_at, before, snr=None, reference_signal=1.0, seed=0, bias_seed=None)
    pair = heel_pair(seed=1, snr=None, shape=(12, 12, 12), spacing_mm=8.0, loaded_grid=after)
    X = before.points().reshape(-1, 3)
    fat = heel.tissue_at(X) == 2
    X, signal = X[fat], reference.values.reshape(-1)[fat]

    def agreement(image: Image, x: np.ndarray) -> float:
        assert after.contains(x).all()
        values = map_coordinates(image.values.astype(float), after.indices_of(x).T, order=3)
        return float(np.corrcoef(signal, values)[0, 1])

    moved, rigid = (pair.foot_motion.apply(x) for x in (X + pair.deformation.displacement(X), X))
    assert agreement(pair.repeat, rigid) > 0.92
    assert agreement(pair.loaded, moved) > 0.9
    assert agreement(pair.loaded, rigid) < 0.5


def test_same_seed_gives_the_same_pair(pair: HeelPair) -> None:
    again = heel_pair(seed=1, **COARSE)
    for name in ("reference", "loaded", "repeat"):
        np.testing.assert_array_equal(getattr(again, name).values, getattr(pair, name).values)
    np.testing.assert_array_equal(again.labels.labels, pair.labels.labels)
    other = heel_pair(seed=2, **COARSE)
    assert np.abs(other.reference.values - pair.reference.values).mean() > 20.0


def test_noise_and_bias_are_independent() -> None:
    """The unmoved, unloaded pair differs by noise and sensitivity alone, and by both."""
    pair = heel_pair(seed=1, load=0.0, foot_motion=RigidMotion.identity(), **COARSE)
    assert pair.loaded.grid.same_as(pair.reference.grid)
    air = pair.labels.labels == 0
    air[:, :, 6:] = False  # well below the sole
    noise = [getattr(pair, name).values[air] for name in ("reference", "loaded", "repeat")]
    assert np.abs(np.corrcoef(noise) - np.eye(3)).max() < 0.03
    clean = heel_pair(seed=1, load=0.0, foot_motion=RigidMotion.identity(), snr=None, **COARSE)
    fat = clean.labels.region("fat").inside
    ratio = clean.loaded.values[fat] / clean.reference.values[fat]
    assert 0.05 < ratio.std() < 0.3


def test_bone_mask_is_the_label(pair: HeelPair) -> None:
    np.testing.assert_array_equal(pair.bone.inside, pair.labels.region("bone").inside)
    assert not pair.deformation.displacement(pair.bone.points()).any()


@pytest.mark.parametrize("seed", range(6))
def test_far_motion_keeps_the_bone_in_view(seed: int) -> None:
    random = np.random.default_rng(seed)
    axis, way = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(15.0 * axis, degrees=True).as_matrix()
    motion = RigidMotion.about(np.array([0.0, 4.0, -2.0]), turn, 20.0 * way)
    pair = heel_pair(seed=1, shape=(34, 38, 36), spacing_mm=3.0, foot_motion=motion)
    indices = pair.loaded.grid.indices_of(motion.apply(pair.bone.points()))
    assert indices.min() > 0.9
    assert np.all(indices.max(axis=0) < np.array(pair.loaded.grid.shape) - 1.9)


def test_loaded_grid_is_taken_as_given() -> None:
    turn = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()
    grid = Grid((30, 32, 28), (3.0, 3.0, 3.5), (-45.0, -50.0, -50.0), turn)
    pair = heel_pair(seed=1, shape=(34, 38, 36), spacing_mm=3.0, loaded_grid=grid)
    assert pair.loaded.grid is grid
    assert pair.repeat.grid is grid


def test_strain_of_the_full_pair_is_that_of_a_loaded_heel() -> None:
    """Points of the full-size field of view: fat's maximal shear, and the largest displacement."""
    for seed in (1, 2, 3):
        heel = Heel(seed)
        random = np.random.default_rng(seed)
        points = random.uniform([-50.4, -56.0, -58.8], [50.4, 56.0, 46.8], (60_000, 3))
        tissue = heel.tissue_at(points)
        u, H = pressed(heel).evaluate(points[tissue > 0])
        shear = max_shear(H)[tissue[tissue > 0] == 2]
        median, high = np.percentile(shear, [50, 95])
        assert 0.12 < median < 0.18
        assert 0.40 < high < 0.49
        assert 7.0 < np.linalg.norm(u, axis=1).max() < 10.0


def test_load_scales_the_strain(heel: Heel, tissue_points: np.ndarray) -> None:
    fat = tissue_points[heel.tissue_at(tissue_points) == 2]
    medians = [np.median(max_shear(pressed(heel, load).evaluate(fat)[1])) for load in (0.0, 0.25, 0.5, 1.0)]
    assert medians[0] == 0.0
    assert 0.15 < medians[1] / medians[3] < 0.35
    assert np.all(np.diff(medians) > 0)


# --- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"seed": -1}, "seed"),
        ({"load": -0.1}, "load"),
        ({"load": 1.6}, "load"),
        ({"load": float("nan")}, "load"),
        ({"snr": 0.0}, "SNR"),
        ({"snr": float("nan")}, "SNR"),
        ({"spacing_mm": -1.0}, "spacing"),
        ({"spacing_mm": (1.0, 2.0)}, "spacing"),
    ],
)
def test_refuses_what_cannot_be_made(arguments: dict, says: str) -> None:
    with pytest.raises(InputError, match=says):
        heel_pair(**{"shape": (12, 12, 12), "spacing_mm": 8.0, **arguments})


def test_refuses_bad_shapes() -> None:
    with pytest.raises(InputError, match="positive definite"):
        EllipsoidUnion(np.zeros((1, 3)), -np.eye(3)[None])
    with pytest.raises(InputError, match="forms"):
        EllipsoidUnion(np.zeros((2, 3)), np.eye(3)[None])
    body = EllipsoidUnion(np.zeros((1, 3)), np.eye(3)[None])
    with pytest.raises(InputError, match="width_mm must be positive"):
        Flow(np.zeros(3), np.zeros(3), body, 1.0, np.zeros(3), np.array([1.0, 0.0, 1.0]))
    with pytest.raises(InputError, match="pivot_mm needs three"):
        Flow(np.zeros(3), np.zeros(2), body, 1.0, np.zeros(3), np.ones(3))
    with pytest.raises(InputError, match="steps"):
        Flow(np.zeros(3), np.zeros(3), body, 1.0, np.zeros(3), np.ones(3), steps=0)
    with pytest.raises(InputError, match="shape"):
        acquire(
            np.zeros((2, 2, 2)), Grid((3, 3, 3), (1, 1, 1), (0, 0, 0)),
            snr=None, reference_signal=1.0, seed=0, bias_seed=None,
        )  # fmt: skip
