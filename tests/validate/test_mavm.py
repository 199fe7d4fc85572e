"""The modified area validation metric on distributions whose areas are known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import wasserstein_distance

from validate import InputError, area_between, model_form, safety_factor, signed_areas

UNIFORM = (np.arange(4000) + 0.5) / 4000  # F(s) = s
EQUAL = np.full(4000, 0.5)


def test_a_shift_is_all_on_one_side() -> None:
    assert signed_areas(UNIFORM + 0.1, UNIFORM, EQUAL) == pytest.approx((0.1, 0.0), abs=1e-9)
    assert signed_areas(UNIFORM, UNIFORM + 0.1, EQUAL) == pytest.approx((0.0, 0.1), abs=1e-9)
    assert signed_areas(UNIFORM[::-1], UNIFORM, EQUAL) == (0.0, 0.0)  # place does not matter


def test_a_wider_distribution_is_on_both_sides() -> None:
    """Twice as wide about its middle: F is below for the larger half, by 1/4 times 1/2, over 2."""
    wide = 0.5 + 2.0 * (UNIFORM - 0.5)
    assert signed_areas(wide, UNIFORM, EQUAL) == pytest.approx((0.125, 0.125), rel=1e-3)


def test_their_sum_is_the_area_metric_and_their_difference_that_of_the_means() -> None:
    random = np.random.default_rng(1)
    first, second = random.gamma(1.0, 0.2, 500), random.gamma(4.0, 0.06, 500)
    volumes = random.uniform(0.1, 2.0, 500)
    plus, minus = signed_areas(first, second, volumes)
    weights = volumes / volumes.sum()
    assert plus + minus == pytest.approx(wasserstein_distance(first, second, weights, weights))
    assert plus - minus == pytest.approx(weights @ (first - second))
    assert min(plus, minus) > 0.01
    assert plus + minus != pytest.approx(wasserstein_distance(first, second), rel=0.01)  # volumes count
    # over the same range it is the area between strain-volume curves, over the volume
    assert (plus + minus) * volumes.sum() == pytest.approx(area_between(first, second, volumes, (0.0, 3.0)))


def test_the_interval_of_the_model_holds_the_measured_mean() -> None:
    row = model_form(("m", "Load1", "fat"), UNIFORM + 0.1, 0.5 + 0.6 * (UNIFORM - 0.5), EQUAL)
    assert (row.mean, row.measured_mean) == pytest.approx((0.5, 0.6))
    assert row.d_plus - row.d_minus == pytest.approx(0.1)
    assert (row.low, row.high) == pytest.approx((0.5 - row.d_minus, 0.5 + row.d_plus))
    assert row.d_minus > 0.0
    assert row.low < row.measured_mean < row.high


def test_few_experiments_widen_it_and_cells_do_not() -> None:
    assert safety_factor(None) == 1.0
    assert safety_factor(8) == pytest.approx(1.25 + 1.2 * 2.75 / 2.0)
    assert safety_factor(10**9) == pytest.approx(1.25, abs=0.01)
    few = model_form(("m", "l", "t"), UNIFORM + 0.1, UNIFORM, EQUAL, samples=8)
    assert (few.low, few.high) == pytest.approx((0.5, 0.5 + 2.9 * 0.1))
    with pytest.raises(InputError, match="at least two experiments"):
        safety_factor(1)


def test_an_area_of_nothing_has_no_sign_and_a_field_that_is_not_known_is_refused() -> None:
    """Zeros are written as 0. A cell without a value would count as no volume in one distribution, and not in all."""
    for sides in (signed_areas(UNIFORM, UNIFORM, EQUAL), signed_areas(UNIFORM + 0.1, UNIFORM, EQUAL)):
        assert np.copysign(1.0, sides).tolist() == [1.0, 1.0]
    gaps = np.where(UNIFORM < 0.5, np.nan, UNIFORM)
    for fields in ((gaps, UNIFORM), (UNIFORM, gaps)):
        with pytest.raises(InputError, match="2000 of 4000 cells have no value"):
            model_form(("m", "l", "t"), *fields, EQUAL)
