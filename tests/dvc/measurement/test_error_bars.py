"""The distance to bone that an error model asks for, exact where it is used; and intervals from drawn fields."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from dvc.errors import InputError
from dvc.images.depth import to_surface_mm
from dvc.images.image import Grid, Image, Mask
from dvc.measurement import error_bars
from dvc.measurement.subject import Subject
from dvc.trust.error_model import POOLED
from dvc.trust.uncertainty import uncertainty_of
from tests.dvc.trust.test_field_draws import FAR, GRID as FIELD, HALF, ROWS, TABLE, maps

GRID = Grid((40, 36, 30), (0.8, 0.8, 1.6), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_distances_to_bone_are_computed_in_the_box_of_the_body_alone(seed, monkeypatch):
    random, near = np.random.default_rng(seed), np.zeros(GRID.shape, dtype=bool)
    near[6:30, 8:27, 0:20] = True
    rough = gaussian_filter(random.normal(size=GRID.shape), 2.0)
    bone = near & (rough > 0.06)
    tissues = {"fat": near & (rough < 0.0), "muscle": near & (rough < 0.03) & (rough >= 0.0)}
    whole, sizes = to_surface_mm(bone, GRID.spacing_mm), []

    def watched(body: np.ndarray, spacing_mm: np.ndarray) -> np.ndarray:
        sizes.append(body.size)
        return to_surface_mm(body, spacing_mm)

    monkeypatch.setattr(error_bars, "to_surface_mm", watched)
    found = error_bars._to_bone_mm(bone, tissues, GRID)
    for inside in tissues.values():
        assert inside.sum() > 500
        np.testing.assert_array_equal(found[inside], whole[inside])
    assert sum(sizes) < 0.4 * near.size


@pytest.mark.parametrize("with_bone", [False, True])
def test_tissue_without_labels_has_the_name_that_its_intervals_have(with_bone):
    """Tables of strain look intervals up by it."""
    body = np.ones(GRID.shape, dtype=bool)
    bone = Mask(GRID, np.arange(GRID.shape[0])[:, None, None] < 5 * body) if with_bone else None
    regions = Subject(Image(GRID, body.astype(np.float32)), bone).regions(Mask(GRID, body))
    assert regions.names == {1: POOLED} | ({2: "bone"} if with_bone else {})


def test_an_interval_from_drawn_fields_is_as_wide_as_that_of_the_table():
    """The median of a tissue errs as a whole: its draws are widened by the factor of the tissue, as its interval is."""
    runs = tuple({POOLED: rows, "fat": rows} for rows in (ROWS + off for off in np.linspace(0.0, 0.04, 5)))
    table = replace(TABLE, runs=runs, widening=1.5, widening_of={"fat": 3.0})
    sure = uncertainty_of(maps().max_shear, FIELD, {"fat": HALF}, FAR, table)
    bars = error_bars.ErrorBars(sure, "made up")
    medians = [float(np.median(field.max_shear[HALF])) for field in bars.draws(maps(), 200, 1)]
    low, median, high = bars.interval_of(medians, "Fat")
    given = sure.intervals[0]
    np.testing.assert_allclose([low, median, high], [given.low, given.estimate, given.high], atol=0.15 * (high - low))
    as_drawn = np.subtract(*np.percentile(medians, [97.5, 2.5]))
    assert high - low == pytest.approx(3.0 * as_drawn)
    assert np.subtract(*bars.interval_of(medians, POOLED)[::-2]) == pytest.approx(1.5 * as_drawn)
    with pytest.raises(InputError, match="Unknown tissue 'skin'; choose one of fat, soft tissue"):
        bars.interval_of(medians, "skin")
    with pytest.raises(InputError, match="because there are no error bars"):
        error_bars.NO_ERROR_BARS.interval_of(medians, "fat")


def test_the_fraction_is_told_for_which_the_factor_was_found():
    """95 % where parts of the study itself were left out, 97 % for the models that ship; neither is a guarantee."""
    own = replace(TABLE, widening=2.0)
    assert "a factor of 2.0, to contain 95 % of the true values in the parts" in error_bars._held(own)
    shipped = error_bars._held(replace(own, widening_of={"fat": 3.0, "skin": 4.0}))
    assert "a factor of 3.0 to 4.0 (all soft tissue: 2.0), to contain 97 % (95 % and a margin" in shipped
