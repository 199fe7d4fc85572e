"""Models over subjects: means, intervals and what is told apart, in closed form and as often as they claim."""

from __future__ import annotations

import numpy as np
import pytest

from dvc.errors import InputError
from validate.cohort import standings


def test_closed_form():
    first, second = standings({"far": {"a": 0.3, "b": 0.5}, "near": {"a": 0.1, "b": 0.2, "c": 0.9}})
    assert (first.model, second.model) == ("near", "far")
    assert first.subjects == second.subjects == 2  # c has no result of the other
    assert first.mean == pytest.approx(0.15)
    # two values: the standard error is half their distance, and t(0.975, 1) = 12.7062
    assert second.high - second.mean == pytest.approx(12.7062 * 0.1, rel=1e-5)
    assert (second.least, second.greatest) == (0.3, 0.5)
    assert (first.nearest_in, second.nearest_in) == (2, 0)
    assert second.behind == pytest.approx(0.25)
    # of two models, Tukey's interval is Student's: the two differences are .2 and .3
    assert second.behind_high - second.behind == pytest.approx(12.7062 * 0.05, rel=1e-4)
    assert not second.told_apart


def test_a_difference_that_every_subject_shows_is_told_though_subjects_differ():
    rng = np.random.default_rng(1)
    level = rng.uniform(0.1, 0.9, 12)  # subjects differ far more than models
    near = {str(i): v for i, v in enumerate(level)}
    far = {str(i): v + 0.02 + 0.005 * rng.standard_normal() for i, v in enumerate(level)}
    first, second = standings({"far": far, "near": near})
    assert first.model == "near"
    assert second.told_apart
    assert second.low < first.high  # the means' own intervals overlap


def test_intervals_hold_as_often_as_they_claim():
    rng = np.random.default_rng(2)
    truth, held = 0.3, 0
    for _ in range(2000):
        values = {str(i): v for i, v in enumerate(truth + 0.05 * rng.standard_normal(5))}
        (one,) = standings({"model": values})
        held += one.low <= truth <= one.high
    assert held / 2000 == pytest.approx(0.95, abs=0.015)


def test_models_that_are_alike_are_told_apart_by_chance_as_rarely_as_claimed():
    rng = np.random.default_rng(3)
    apart = 0
    for _ in range(400):
        subjects = rng.uniform(0.2, 0.8, 6)
        table = subjects + 0.03 * rng.standard_normal((7, 6))
        found = standings({f"m{k}": {str(i): v for i, v in enumerate(row)} for k, row in enumerate(table)})
        apart += any(one.told_apart for one in found)
    assert apart / 400 < 0.06  # plain intervals of each difference: over .35


def test_one_subject_has_no_interval():
    first, second = standings({"far": {"a": 0.3}, "near": {"a": 0.1}})
    assert np.isnan(second.low)
    assert not second.told_apart
    assert first.mean == 0.1


def test_no_common_subject():
    with pytest.raises(InputError, match="ranked"):
        standings({"x": {"a": 0.1}, "y": {"b": 0.1}})
