"""The phantom's heel: its tissues, sizes and signals."""

from __future__ import annotations

import numpy as np
import pytest

from dvc.errors import InputError
from dvc.images.image import Grid
from phantoms import FAT_SIGNAL, TISSUES, Heel, centred_grid, labels_of, labels_to_mesh


def test_every_tissue_is_there(heel: Heel) -> None:
    labels = labels_of(heel, centred_grid((50, 56, 53), 2.0))
    volumes = {name: labels.region(name).volume_mm3 / 1000 for name in TISSUES.values()}
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


@pytest.mark.parametrize(("skin", "size"), [(1.5, 1.0), (2.0, 1.0), (3.0, 1.0), (2.0, 1.2)])
def test_skin_has_its_thickness(skin: float, size: float) -> None:
    heel = Heel(seed=1, skin_mm=skin, size=size)
    column = size * np.array([[0.0, 15.0, z] for z in np.arange(-48.0, -36.0, 0.01)])
    thickness = size * 0.01 * np.count_nonzero(heel.tissue_at(column) == 4)
    assert thickness == pytest.approx(skin, abs=0.1)
    # all over: between two shells, by the skin's points that lie deepest
    points = size * np.random.default_rng(0).uniform([-32, -40, -46], [32, 46, 40], (60_000, 3))
    deep = -heel.outline.distance(points[heel.tissue_at(points) == 4])
    assert 0.9 * skin < np.percentile(deep, 99) < 1.2 * skin


@pytest.mark.parametrize("seed", range(4))
def test_the_part_to_mesh_has_the_volume_of_published_meshes(seed: int) -> None:
    heel = Heel(seed)
    part = labels_to_mesh(heel, labels_of(heel, centred_grid((84, 93, 88), 1.2)))
    soft = sum(part.region(name).volume_mm3 for name in ("fat", "muscle", "skin", "tendon")) / 1000
    assert 75.0 < soft < 100.0


def test_parameters_change_what_they_say() -> None:
    def sole(heel: Heel) -> float:
        column = np.array([[3.0, 19.0, z] for z in np.arange(-60.0, -10.0, 0.05)])
        tissue = heel.tissue_at(column)
        return 0.05 * np.count_nonzero((tissue > 0) & (tissue != 1))

    assert sole(Heel(1, pad_mm=24.0)) - sole(Heel(1, pad_mm=18.0)) == pytest.approx(6.0, abs=0.2)
    assert np.ptp(Heel(1, size=1.2).bone.centres_mm, axis=0) == pytest.approx(
        1.2 * np.ptp(Heel(1).bone.centres_mm, axis=0)
    )


@pytest.mark.parametrize(
    "arguments", [{"seed": -1}, {"size": 2.0}, {"pad_mm": 2.0}, {"skin_mm": 0.0}, {"lobule_mm": float("nan")}]
)
def test_refuses_a_heel_out_of_range(arguments: dict) -> None:
    with pytest.raises(InputError, match=next(iter(arguments))):
        Heel(**arguments)


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


def test_larger_lobules_make_a_coarser_texture(tissue_points: np.ndarray) -> None:
    """Correlation of fat's signal over 1 mm; both ends of each step in fat."""
    found = []
    for size in (3.0, 6.0, 12.0):
        heel = Heel(1, lobule_mm=size)
        ends = tissue_points, tissue_points + np.array([0.0, 1.0, 0.0])
        fat = (heel.tissue_at(ends[0]) == 2) & (heel.tissue_at(ends[1]) == 2)
        found.append(float(np.corrcoef(*(heel.intensity_at(e[fat]) for e in ends))[0, 1]))
    assert found[0] + 0.05 < found[1] < found[2] - 0.05


def test_seeds_differ(heel: Heel, tissue_points: np.ndarray) -> None:
    other = Heel(seed=2)
    changed = np.mean(other.tissue_at(tissue_points) != heel.tissue_at(tissue_points))
    assert 0.005 < changed < 0.2
    fat = (other.tissue_at(tissue_points) == 2) & (heel.tissue_at(tissue_points) == 2)
    signals = other.intensity_at(tissue_points[fat]), heel.intensity_at(tissue_points[fat])
    assert abs(np.corrcoef(signals)[0, 1]) < 0.15
