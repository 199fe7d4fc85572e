"""Filters on several threads give what scipy gives: splines bit for bit, Gaussians in single precision."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, spline_filter

from dvc import threads
from dvc.images.filters import gaussian, spline_coefficients

SHAPES = (70, 64, 66), (33, 21, 17), (2, 40, 3), (1, 5, 6), (8, 1, 1)  # the first is shared by threads


@pytest.fixture(params=[1, 2, 3])
def count(request):
    before = threads.count()
    threads.use(request.param)
    yield request.param
    threads.use(before)


def values_of(shape, dtype):
    return np.random.default_rng(1).normal(size=shape).astype(dtype)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_gaussians_are_those_of_scipy(shape, dtype, count):
    values = values_of(shape, dtype)
    for sigma, mode in product((0.7, (2.0, 0.0, 1.5)), ("nearest", "constant", "reflect", "wrap")):
        expected = gaussian_filter(values.astype(np.float64), sigma, mode=mode)
        for given in (values, np.asfortranarray(values)):
            found = gaussian(given, sigma, mode)
            assert found.dtype == dtype
            np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-6)  # of values up to 4.5
            np.testing.assert_array_equal(given, values_of(shape, dtype))
    for order in ((0, 1, 0), (1, 0, 2)):
        expected = gaussian_filter(values.astype(np.float64), 1.0, order=order)
        np.testing.assert_allclose(gaussian(values, 1.0, order=order), expected, rtol=0.0, atol=2e-6)


def test_a_missing_value_spreads_no_farther_than_the_gaussian_reaches():
    values = np.zeros((30, 30, 30), np.float32)
    values[0, 0, 0] = np.nan
    for mode in ("constant", "nearest", "reflect"):
        reached = np.isnan(gaussian(values, 1.0, mode))
        assert np.count_nonzero(reached) == 5**3
        assert reached[:5, :5, :5].all()


def test_gaussians_do_not_depend_on_the_number_of_threads():
    values, before = values_of(SHAPES[0], np.float32), threads.count()
    try:
        found = []
        for number in (1, 2, 3):
            threads.use(number)
            found.append(gaussian(values, (2.0, 1.0, 1.5)))
    finally:
        threads.use(before)
    for other in found[1:]:
        np.testing.assert_array_equal(found[0], other)


@pytest.mark.parametrize("shape", SHAPES)
def test_coefficients_are_those_of_scipy(shape, count):
    for given, dtype in product((np.float32, np.float64), repeat=2):
        values = values_of(shape, given)
        before = values.copy()
        found = spline_coefficients(values, dtype)
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, spline_filter(values, 3, dtype, "mirror"))
        np.testing.assert_array_equal(values, before)
