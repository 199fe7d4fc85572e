"""No error bars where they are known to hold too few true values, and all of them elsewhere."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dvc.errors import InputError
from dvc.measurement.error_bars import ErrorBars
from dvc.measurement.page import error_tables, summary_table
from dvc.report.page import shown
from dvc.trust.components import components_of
from dvc.trust.gaps import without_gaps
from dvc.trust.regions import RegionRow
from dvc.trust.uncertainty import Uncertainty, uncertainty_of
from tests.dvc.trust.test_field_draws import FAR, GRID, TABLE, maps

THIRDS = np.arange(GRID.shape[2]) // 8 * np.ones(GRID.shape, dtype=int)
REGIONS = {name: number == THIRDS for number, name in enumerate(("fat", "Skin", "tendon"))}


@pytest.fixture(scope="module")
def known() -> Uncertainty:
    sure = uncertainty_of(maps().max_shear, GRID, REGIONS, FAR, TABLE)
    return replace(sure, components=components_of(maps(), REGIONS, FAR, TABLE))


@pytest.mark.parametrize(
    ("engine", "from_image", "lacking"),
    [
        ("gauss-newton-borders", False, {"components in tendon"}),
        ("gauss-newton-borders", True, {"components in tendon", "intervals in Skin"}),
        ("gauss-newton", False, {"components in tendon", "voxels in Skin"}),
        ("gauss-newton-bone", False, {"components in tendon", "voxels in Skin"}),
    ],
)
def test_what_holds_too_few_true_values_is_left_out_with_a_reason(known, engine, from_image, lacking) -> None:
    found, reasons = without_gaps(known, engine, labels_from_image=from_image)
    missing = set()
    for name, inside in REGIONS.items():
        components = found.components
        of = [found.sigma, components.normal_strain, components.shear_strain, components.displacement_mm]
        of += [found.bias, components.strain_bias]
        voxels, *parts, bias, strain_bias = (bool(np.isnan(field[inside]).all()) for field in of)
        assert all(np.isnan(field[inside]).all() or np.isfinite(field[inside]).all() for field in of)
        assert not bias  # an expected error is known without its uncertainty
        assert not strain_bias
        unknown = {np.isnan(row.voxel_expanded_uncertainty) for row in components.rows if row.region == name}
        assert unknown == set(parts)
        ends = {np.isnan(i.low) and np.isnan(i.high) for i in found.intervals if i.region == name}
        assert all(np.isfinite([i.found, i.estimate]).all() for i in found.intervals)
        missing |= {f"voxels in {name}"} if voxels else set()
        missing |= {f"components in {name}"} if all(parts) else set()
        missing |= {f"intervals in {name}"} if ends == {True} else set()
    assert missing == lacking
    assert len(reasons) == len(lacking)
    assert all(reason.startswith("No ") and " %" in reason for reason in reasons)


def test_tables_show_a_dash_and_no_interval_is_made_of_draws(known) -> None:
    found, reasons = without_gaps(known, "gauss-newton-borders", labels_from_image=True)
    bars = ErrorBars(found, " ".join(reasons))
    intervals, components = error_tables(bars)
    assert {row[0]: shown(row[4]) for row in intervals.rows}["Skin"] == "–"
    assert {row[0]: shown(row[2]) for row in components.rows}["tendon"] == "–"
    assert "No intervals in skin" in intervals.note
    rows = [RegionRow(name, "max_shear", 1, 1.0, 1, *[0.3] * 8) for name in REGIONS]
    short = summary_table(rows, found.intervals)
    assert ["(" in str(row[1]) for row in short.rows] == [True, False, True]
    assert "No interval in Skin: its coverage is known to be below 90 %." in short.note
    with pytest.raises(InputError, match=r"Skin has no interval\. No standard"):
        bars.interval_of([0.3, 0.3], "Skin")
