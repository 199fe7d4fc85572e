"""What the phantom's scanner does to a signal."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.errors import InputError
from dvc.images.image import Grid
from phantoms import Heel, acquire, centred_grid, mri, scan, sensitivity


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
    grid = Grid((20, 20, 20), (0.8, 0.8, 1.5), (0.0, 0.0, 0.0))
    centres, samples = np.arange(20) + 0.5, (np.arange(40) + 0.5) / 2.0
    for frequency, kept in ((0.25, 1.0), (0.75, 0.0)):
        fine = np.moveaxis(np.broadcast_to(np.cos(2 * np.pi * frequency * samples), (40, 40, 40)), 2, axis)
        octants = fine.reshape(20, 2, 20, 2, 20, 2).transpose(0, 2, 4, 1, 3, 5)
        expected = kept * np.moveaxis(np.broadcast_to(np.cos(2 * np.pi * frequency * centres), grid.shape), 2, axis)
        np.testing.assert_allclose(scanned(octants, grid), expected, atol=1e-5)
        if kept == 0.0:
            assert octants.mean(axis=(3, 4, 5)).std() > 0.2


def test_a_point_keeps_its_sum_and_its_place() -> None:
    grid = Grid((21, 21, 21), (0.8, 0.8, 1.5), (0.0, 0.0, 0.0))
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


@pytest.mark.parametrize("spacing_mm", [(1.6, 1.6, 1.6), (2.3, 2.3, 2.3), (1.0, 1.0, 4.0), (3.2, 3.2, 3.2)])
def test_partial_volume_is_right_in_large_voxels(
    heel: Heel, spacing_mm: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against samples every quarter of a millimetre. Two samples a voxel, however large, miss the borders in it."""
    i, j, k = (round(32.0 / s) for s in spacing_mm)
    grid = centred_grid((i, j, k), spacing_mm)
    images = []
    for largest_mm in (0.5, mri._LARGEST_MM, np.inf):
        monkeypatch.setattr(mri, "_LARGEST_MM", largest_mm)
        images.append(scan(heel, grid, snr=None, number=0).values.astype(float))
    true, made, bare = images
    error, without = (np.sqrt(np.mean((image - true) ** 2)) / true.mean() for image in (made, bare))
    assert error < 0.015
    if max(spacing_mm) > 2.0:
        assert without > 0.017  # .020 at 2.3 mm, .031 and .039 at 4 and 3.2


def test_sensitivity_is_smooth_and_bounded() -> None:
    grid = Grid((60, 50, 40), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    one, two = sensitivity(grid, 1), sensitivity(grid, 2)
    assert np.abs(one - 1.0).max() == pytest.approx(0.2, abs=1e-6)
    assert max(np.abs(np.diff(one, axis=a)).max() for a in range(3)) < 0.03
    assert np.abs(one - two).max() > 0.1


def test_refuses_a_signal_of_another_shape() -> None:
    grid = Grid((3, 3, 3), (1, 1, 1), (0, 0, 0))
    with pytest.raises(InputError, match="shape"):
        acquire(np.zeros((2, 2, 2)), grid, snr=None, reference_signal=1.0, seed=0, bias_seed=None)
