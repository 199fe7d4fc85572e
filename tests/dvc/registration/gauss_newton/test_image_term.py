"""The image term of a Gauss-Newton step: the gain between two images."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from dvc.registration.gauss_newton import image_term


@pytest.mark.parametrize("shape", [(41, 52, 33), (9, 64, 40)])
def test_a_gain_on_coarser_blocks_is_that_of_all_blocks(shape: tuple[int, int, int], monkeypatch) -> None:
    """Within a thousandth, and a hundredth at the ends of the tissue; laid half a coarse block off it is not."""
    random, sigma = np.random.default_rng(2), np.array([8.0, 7.0, 6.5])
    i, j, k = np.indices(shape) / 40.0
    inside = np.zeros(shape)
    inside[2:-2, 6:-6, 4:-5] = 1.0
    own = inside * random.uniform(0.5, 1.5, shape)
    both = own * (1.0 + 0.3 * np.sin(2.0 * i + j) + 0.1 * k)
    exact = gaussian_filter(both, sigma, mode="constant") / gaussian_filter(own, sigma, mode="constant")
    off = np.abs(image_term._gain(both, own, sigma) / exact - 1.0)[inside > 0]
    assert off.max() < 0.01
    assert np.sqrt((off**2).mean()) < 1e-3
    monkeypatch.setattr(image_term, "_FINE", 100.0)
    np.testing.assert_allclose(image_term._gain(both, own, sigma), exact, rtol=1e-6)
