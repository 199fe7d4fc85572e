"""Where the body is: gaps in the tissue mask are closed as by an ellipsoid laid at every voxel; margins are exact."""

import numpy as np
import pytest
from scipy.ndimage import binary_closing, distance_transform_edt, gaussian_filter

from dvc.images.image import Grid, Image
from dvc.images.tissue import _closed, _ellipsoid, tissue_mask, within


@pytest.mark.parametrize("radius", [(2, 2, 2), (3, 1, 0), (5, 4, 2), (0, 0, 0)])
@pytest.mark.parametrize("level", [-9.0, 0.01, 0.1, 9.0])
def test_closing_by_the_surface_alone_is_closing_by_every_voxel(radius: tuple[int, int, int], level: float) -> None:
    mask = gaussian_filter(np.random.default_rng(3).normal(size=(36, 30, 25)), 1.5) > level
    padded = np.pad(mask, [(r, r) for r in radius], mode="edge")
    inner = tuple(slice(r, r + n) for r, n in zip(radius, mask.shape, strict=True))
    expected = binary_closing(padded, structure=_ellipsoid(np.array(radius)))[inner]
    assert np.array_equal(_closed(mask, np.array(radius)), expected)
    if 0.0 < level < 1.0 and max(radius) > 0:
        assert np.count_nonzero(expected) > 1.01 * np.count_nonzero(mask)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.8, 0.8, 3.6), (0.7875, 0.875, 0.825)])
@pytest.mark.parametrize("margin", [0.0, 0.5, 2.0, 4.0, 4.5, 200.0])
def test_a_margin_is_that_of_a_distance_transform(spacing: tuple[float, float, float], margin: float) -> None:
    """Also where voxels lie exactly at the margin: one step along an axis too few, or a smaller margin, fails."""
    inside = np.random.default_rng(5).random((23, 1, 31)) > 0.97
    inside = np.concatenate([inside, np.zeros((23, 12, 31), dtype=bool)], axis=1)
    away_mm = distance_transform_edt(~inside, sampling=spacing)
    assert np.array_equal(within(inside, np.array(spacing), margin), away_mm <= margin)


@pytest.mark.parametrize("offset", [1e4, 1e6, -1e6])
def test_the_body_is_found_whatever_the_images_zero(offset: float) -> None:
    """Beside 1e6 numbers of 32 bits are 1/16 apart, and 256 bins of a histogram over 10 of them are narrower."""
    body = np.zeros((24, 20, 22), dtype=bool)
    body[5:19, 4:16, 6:17] = True
    values = np.where(body, 8.0, 1.0) + np.random.default_rng(4).normal(0.0, 0.3, body.shape)
    grid = Grid(body.shape, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    found, expected = (tissue_mask(Image(grid, values + zero)).inside for zero in (offset, 0.0))
    assert expected[body].all()
    assert np.count_nonzero(found ^ expected) < 0.01 * np.count_nonzero(expected)
