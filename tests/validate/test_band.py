"""The band of a strain-volume curve."""

from __future__ import annotations

import numpy as np
import pytest

from validate import ALL
from validate.curves import bands


def test_the_band_of_a_falling_curve_falls_however_much_it_is_widened() -> None:
    """Half of the tissue is certainly strained by .1; how much the other half is near .01 is not known."""
    random = np.random.default_rng(4)
    base, everywhere = np.repeat([0.01, 0.1], 200), {ALL: np.ones(400, dtype=bool)}
    truths = (np.abs(base + np.where(base < 0.05, random.normal(0.0, 0.004), 0.0)) for _ in range(100))
    band = bands(truths, {"a": base}, np.full(400, 0.1), everywhere, lambda _: 3.0, lambda field: field)[ALL]
    assert (np.diff(band.low_ml) <= 0.0).all()
    assert (np.diff(band.high_ml) <= 0.0).all()
    certain = (band.strains > 0.05) & (band.strains < 0.09)
    assert band.low_ml[certain] == pytest.approx(20.0)
    assert band.high_ml[certain] == pytest.approx(20.0)
    assert band.low_ml[band.strains < 0.05].min() == pytest.approx(20.0)  # -20 without what bounds it at .05
