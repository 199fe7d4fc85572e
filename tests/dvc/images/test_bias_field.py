"""The bias field: N4 as ITK computes it, and what its removal leaves of a field that is known."""

from __future__ import annotations

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.interpolate import NdBSpline

from dvc.images.bias_field import log_bias_field, without_bias_field
from dvc.images.image import Grid, Image

GRID = Grid((44, 38, 35), np.array([2.0, 2.3, 2.5]), np.zeros(3))


@pytest.fixture(scope="module")
def shaded() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A ball of two tissues with noise, its bias field, and where it is."""
    X = np.stack(np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in GRID.shape), indexing="ij"), axis=-1)
    body = np.linalg.norm(X - 0.5, axis=-1) < 0.42
    random = np.random.default_rng(4)
    tissue = np.where(body, np.where(random.random(GRID.shape) < 0.5, 100.0, 60.0), 0.0)
    field = 1.0 + 0.3 * (X[..., 0] - 0.5) + 0.2 * np.sin(3.0 * X[..., 1])
    return tissue * field + random.normal(scale=1.0, size=GRID.shape), field, tissue


def test_the_field_is_that_of_itk(shaded):
    """The same voxels and settings: ITK's sums in single precision differ by a few millionths."""
    values, _, tissue = shaded
    values, inside = np.abs(values) + 1.0, tissue > 0.0
    scan, mask = (sitk.GetImageFromArray(array) for array in (values.astype(np.float32), inside.astype(np.uint8)))
    n4 = sitk.N4BiasFieldCorrectionImageFilter()
    n4.SetMaximumNumberOfIterations([50, 50, 50])
    corrected = sitk.GetArrayFromImage(n4.Execute(scan, mask))
    logarithm = np.log(values)
    lattice = log_bias_field(logarithm, inside, [np.linspace(0.0, 1.0, n) for n in values.shape])
    assert lattice.shape == (7, 7, 7)
    at = np.stack(np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in values.shape), indexing="ij"), axis=-1)[inside]
    ours = NdBSpline((np.arange(-3.0, 8.0) / 4.0,) * 3, lattice, 3)(at)
    theirs = logarithm[inside] - np.log(corrected[inside])
    assert np.ptp(theirs) > 0.2
    np.testing.assert_allclose(ours, theirs, atol=2e-5)


@pytest.mark.parametrize("offset", [0.0, 300.0])
def test_shading_is_removed_whatever_the_images_zero(shaded, offset):
    values, field, tissue = shaded
    corrected = without_bias_field(Image(GRID, values + offset)).values - offset
    bright = tissue == 100.0

    def unevenness(seen: np.ndarray) -> float:
        return float(seen[bright].std() / seen[bright].mean())

    assert unevenness(values) > 0.05
    assert unevenness(corrected) < 1.2 * unevenness(values / field)  # what the noise leaves
