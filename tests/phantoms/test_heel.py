"""Pairs of images of the phantom heel show the motion, and repeat bit for bit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, map_coordinates
from scipy.spatial.transform import Rotation

from dvc.deformation.protocol import RigidMotion
from dvc.deformation.strain import StrainField
from dvc.errors import InputError
from dvc.images.image import Grid, Image
from phantoms import (
    FAT_SIGNAL,
    LOADS,
    Heel,
    HeelPair,
    acquire,
    default_foot_motion,
    heel_pair,
    misdrawn,
    pressed,
    under_load,
)
from phantoms.heel import centred_grid, covering, labels_of, octants

COARSE = {"shape": (32, 36, 34), "spacing_mm": 3.1}
FEW = {"shape": (10, 12, 11), "spacing_mm": 3.1}  # the middle of the heel: bone, and fat around it
LEAST = {"shape": (3, 3, 3), "spacing_mm": 4.0}


@pytest.mark.parametrize("load", ["smooth", "Load1", "Load3"])
def test_signal_moves_with_the_tissue(heel: Heel, load: str) -> None:
    """Before blur, bias and noise, the loaded heel at x has the signal of the unloaded heel at X."""
    flow = pressed(heel) if load == "smooth" else under_load(heel, load)
    motion = default_foot_motion()
    X = np.random.default_rng(3).uniform([-30, -40, -42], [30, 44, 20], (4000, 3))
    before = heel.intensity_at(X)
    after = loaded_signal(heel, flow, motion)(motion.apply(X + flow.displacement(X)))
    scale = FAT_SIGNAL
    # a point within 1e-7 mm of a border may fall to its other side
    assert np.mean(np.abs(after - before) < 1e-4 * scale) > 0.9995
    shifted = loaded_signal(heel, flow, motion)(motion.apply(X + flow.displacement(X)) + 0.05)
    assert np.mean(np.abs(shifted - before) < 1e-4 * scale) < 0.5


def loaded_signal(heel, motion, foot_motion):
    """Noise-free signal of the heel after both motions, as a function of points (n, 3) mm."""
    back, home = motion.inverse(), foot_motion.inverse()

    def signal(points_mm):
        x = home.apply(points_mm)
        return heel.intensity_at(x + back.displacement(x))

    return signal


def test_voxels_are_carried_back_with_their_shape(heel: Heel) -> None:
    """Against samples that are each carried back by the flow itself."""
    turn = Rotation.from_rotvec([0.1, 0.3, -0.2]).as_matrix()
    grid = Grid((24, 22, 14), (0.8, 0.8, 1.6), (-8.0, 6.0, -38.0), turn)
    flow, motion = pressed(heel), default_foot_motion()
    signals = loaded_signal(heel, flow, motion), octants(heel, grid, flow, motion)
    one, two = (
        acquire(signal, grid, snr=None, reference_signal=1.0, seed=0, bias_seed=None).values for signal in signals
    )
    assert np.std(one - two) < 0.02 * one.std()


def test_images_show_the_motion(heel: Heel) -> None:
    """In the pad at 0.8 mm: carried back by the truth the loaded image is the reference, otherwise not."""
    before = Grid((24, 24, 16), (0.8, 0.8, 0.8), (-9.0, 6.0, -40.0))
    after = Grid((48, 48, 38), (0.8, 0.8, 0.8), (-18.0, -3.0, -45.0))
    reference = acquire(heel.intensity_at, before, snr=None, reference_signal=1.0, seed=0, bias_seed=None)
    pair = heel_pair(seed=1, snr=None, loaded_grid=after, **LEAST)
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


def test_same_seed_gives_the_same_pair() -> None:
    pair, again = (heel_pair(seed=1, **FEW) for _ in range(2))
    for name in ("reference", "loaded", "repeat"):
        np.testing.assert_array_equal(getattr(again, name).values, getattr(pair, name).values)
    np.testing.assert_array_equal(again.labels.labels, pair.labels.labels)
    other = heel_pair(seed=2, **FEW)
    assert np.abs(other.reference.values - pair.reference.values).mean() > 20.0


def test_noise_and_bias_are_independent() -> None:
    """The unmoved, unloaded pair differs by noise and sensitivity alone, and by both."""
    pair = heel_pair(seed=1, load=0.0, foot_motion=RigidMotion.identity(), **COARSE)
    assert pair.loaded.grid.same_as(pair.reference.grid)
    air = pair.labels.labels == 0
    air[:, :, 5:] = False  # well below the sole
    noise = [getattr(pair, name).values[air] for name in ("reference", "loaded", "repeat")]
    assert np.abs(np.corrcoef(noise) - np.eye(3)).max() < 0.05
    same = {"load": 0.0, "foot_motion": RigidMotion.identity(), "loaded_grid": centred_grid(*FEW.values())}
    clean = heel_pair(seed=1, snr=None, **same, **FEW)
    fat = clean.labels.region("fat").inside
    ratio = clean.loaded.values[fat] / clean.reference.values[fat]
    assert 0.05 < ratio.std() < 0.3


def test_bone_mask_is_the_label(tiny_pair: HeelPair) -> None:
    bone = tiny_pair.bone
    np.testing.assert_array_equal(bone.inside, tiny_pair.labels.region("bone").inside)
    assert not tiny_pair.deformation.displacement(bone.points()).any()


def far_motion(seed: int) -> RigidMotion:
    random = np.random.default_rng(seed)
    axis, way = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
    turn = Rotation.from_rotvec(15.0 * axis, degrees=True).as_matrix()
    return RigidMotion.about(np.array([0.0, 4.0, -2.0]), turn, 20.0 * way)


@pytest.mark.parametrize("seed", range(6))
def test_far_motion_keeps_the_bone_in_view(heel: Heel, seed: int) -> None:
    unloaded = centred_grid((34, 38, 36), 3.0)
    bone = far_motion(seed).apply(labels_of(heel, unloaded).region("bone").points())
    grid = covering(unloaded, bone)
    indices = grid.indices_of(bone)
    assert indices.min() > 0.9
    assert np.all(indices.max(axis=0) < np.array(grid.shape) - 1.9)


def test_a_pair_keeps_the_bone_in_view() -> None:
    motion = far_motion(0)
    pair = heel_pair(seed=1, motion=RigidMotion.identity(), foot_motion=motion, **FEW)
    needed = covering(pair.reference.grid, motion.apply(pair.bone.points()))
    assert np.prod(needed.shape) > 1.5 * np.prod(FEW["shape"])
    assert pair.loaded.grid.same_as(needed)
    assert pair.repeat.grid.same_as(needed)


def test_loaded_grid_is_taken_as_given() -> None:
    turn = Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()
    grid = Grid((5, 4, 6), (3.0, 3.0, 3.5), (-45.0, -50.0, -50.0), turn)
    pair = heel_pair(seed=1, loaded_grid=grid, **LEAST)
    assert pair.loaded.grid is grid
    assert pair.repeat.grid is grid


def test_strain_of_the_full_pair_is_that_of_a_loaded_heel() -> None:
    """Points of the full-size field of view: fat's maximum shear strain, and the largest displacement."""
    for seed in (1, 2, 3):
        heel = Heel(seed)
        random = np.random.default_rng(seed)
        points = random.uniform([-50.4, -56.0, -58.8], [50.4, 56.0, 46.8], (60_000, 3))
        tissue = heel.tissue_at(points)
        u, H = pressed(heel).evaluate(points[tissue > 0])
        shear = StrainField.from_gradient(H).max_shear[tissue[tissue > 0] == 2]
        median, high = np.percentile(shear, [50, 95])
        assert 0.12 < median < 0.18
        assert 0.40 < high < 0.49
        assert 7.0 < np.linalg.norm(u, axis=1).max() < 10.0


def test_loads_have_the_strain_that_models_of_the_heel_gave() -> None:
    """Maximum shear strain of the fat around the calcaneus, median and 90th percentile, for the published forces."""
    ranges = {
        "Load1": ((0.13, 0.23), (0.32, 0.53)),
        "Load2": ((0.03, 0.06), (0.06, 0.14)),
        "Load3": ((0.12, 0.21), (0.24, 0.42)),
    }
    for seed in (1, 2, 3):
        heel = Heel(seed)
        points = np.random.default_rng(seed).uniform([-32.0, -20.0, -46.0], [32.0, 46.0, 0.0], (15_000, 3))
        fat = points[heel.tissue_at(points) == 2]
        found = {
            load: np.percentile(StrainField.from_gradient(under_load(heel, load).evaluate(fat)[1]).max_shear, [50, 90])
            for load in LOADS
        }
        for load, limits in ranges.items():
            for value, (low, high) in zip(found[load], limits, strict=True):
                assert low < value < high, (seed, load, found[load])
        assert np.all(found["Load2"] < found["Load4"])
        assert np.all(found["Load4"] < found["Load3"])


def test_load_scales_the_strain(heel: Heel, tissue_points: np.ndarray) -> None:
    fat = tissue_points[heel.tissue_at(tissue_points) == 2]
    medians = [
        np.median(StrainField.from_gradient(pressed(heel, load).evaluate(fat)[1]).max_shear)
        for load in (0.0, 0.25, 0.5, 1.0)
    ]
    assert medians[0] == 0.0
    assert 0.15 < medians[1] / medians[3] < 0.35
    assert np.all(np.diff(medians) > 0)


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
        heel_pair(**{**LEAST, **arguments})


def test_a_label_map_that_is_badly_drawn_is_off_by_no_more_than_asked(tiny_pair: HeelPair) -> None:
    labels = tiny_pair.labels
    stiff = np.isin(labels.labels, [n for n, name in labels.names.items() if name in ("bone", "ankle", "skin")])
    body = labels.labels > 0
    for by in (1, -1):
        off = misdrawn(labels, by)
        changed = off.labels != labels.labels
        grown = binary_dilation(stiff if by > 0 else body & ~stiff)
        np.testing.assert_array_equal(changed, grown & body & (stiff != (by > 0)))
        np.testing.assert_array_equal(off.labels > 0, body)
        assert 0.02 < changed[body].mean() < 0.3
        for number in np.unique(off.labels[changed]):  # each gets the label of a neighbour
            assert np.all(binary_dilation(labels.labels == number, np.ones((3, 3, 3)))[off.labels == number])
    np.testing.assert_array_equal(misdrawn(labels, 0).labels, labels.labels)
