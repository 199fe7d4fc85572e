"""Images with short borders: as near to the minimum as scikit-image comes in thousands of iterations, in fewer."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from skimage.restoration import denoise_tv_chambolle

from dvc import threads
from dvc.arrays import FloatArray
from dvc.labelling.brightness import Levels, brighter_share
from dvc.labelling.total_variation import with_short_borders

WEIGHT = 0.8


def speckled() -> FloatArray:
    """Two tissues of -0.5 and 0.5 with a curved border, and noise as large as the step between them."""
    random = np.random.default_rng(1)
    border = gaussian_filter(random.normal(size=(30, 26, 22)), 5.0) > 0.0
    return np.where(border, 0.5, -0.5) + random.normal(size=border.shape)


def energy(u: FloatArray, image: FloatArray) -> float:
    steps = [np.diff(u, axis=axis, append=u.take([-1], axis)) for axis in range(3)]
    return float(0.5 * ((u - image) ** 2).sum() + WEIGHT * np.sqrt(sum(step**2 for step in steps)).sum())


def test_a_hundred_iterations_come_as_near_to_the_minimum_as_thousands_without_memory() -> None:
    image = speckled()
    found = with_short_borders(image, WEIGHT, 0.0, 100).astype(np.float64)
    slow = denoise_tv_chambolle(image, weight=WEIGHT, max_num_iter=4000, eps=0.0)
    assert energy(found, image) < 1.001 * energy(slow, image)
    assert np.abs(found - slow).max() < 0.03
    hundred = denoise_tv_chambolle(image, weight=WEIGHT, max_num_iter=100, eps=0.0)
    assert energy(hundred, image) - energy(slow, image) > 3.0 * (energy(found, image) - energy(slow, image))


def test_it_ends_once_hardly_anything_changes() -> None:
    image = speckled()
    whole = with_short_borders(image, WEIGHT, 0.0, 200)
    ended = with_short_borders(image, WEIGHT, 5e-3, 200)
    assert 0.0 < float(np.abs(ended - whole).mean()) < 2e-2


def test_the_result_is_the_same_on_any_number_of_threads() -> None:
    image, before = speckled(), threads.count()
    try:
        found = []
        for count in (1, 3):
            threads.use(count)
            found.append(with_short_borders(image, WEIGHT, 0.0, 30))
    finally:
        threads.use(before)
    assert np.array_equal(*found)


def test_a_thin_dark_layer_between_skin_and_fat_is_fat() -> None:
    """Voxels that are dark by their part of skin end as bright as what is beside them, and no tissue is undecided."""
    values = np.full((12, 12, 80), 600.0, dtype=np.float32)
    where = np.zeros(values.shape, dtype=bool)
    where[:, :, 60:] = True
    values[:, :, 60] = 420.0
    levels, spacing = Levels(400.0, 600.0, 500.0), np.full(3, 0.8)
    muscle, undecided, fat = (
        brighter_share(values, where, levels, spacing, beside=beside)[6, 6] for beside in (-0.2, 0.0, 0.2)
    )
    assert muscle[60] < 0.2
    assert undecided[60] == pytest.approx(0.5, abs=0.1)
    assert fat[60] > 0.9
    assert fat[70] > 0.99
    assert fat[0] == 0.5
