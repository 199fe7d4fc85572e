"""Statistics by region against figures worked out by hand, and the table that is written of them."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, strategies as st

from dvc.errors import GeometryError, InputError, OutputError
from dvc.images.image import Grid, LabelMap
from dvc.trust.regions import region_statistics, volume_above, write_regions_csv
from dvc.trust.verdict import Verdict, worst

GRID = Grid((2, 3, 2), (1.0, 2.0, 5.0), (0.0, 0.0, 0.0))  # voxels of 0.01 mL
LABELS = LabelMap(
    GRID, np.array([1, 1, 1, 1, 1, 2, 2, 2, 0, 0, 0, 0]).reshape(2, 3, 2), {1: "fat", 2: "skin", 3: "tendon"}
)
SHEAR = np.array([0.1, 0.2, 0.3, 0.6, np.nan, np.nan, np.nan, np.nan, 9, 9, 9, 9]).reshape(2, 3, 2)


def test_statistics_by_hand_and_missing_values_are_counted() -> None:
    fat, skin, tendon = region_statistics(LABELS, {"max_shear": SHEAR})
    assert (fat.region, fat.voxels, fat.defined_voxels) == ("fat", 5, 4)
    assert fat.volume_ml == pytest.approx(0.05)
    assert fat.defined_fraction == pytest.approx(0.8)
    assert fat.mean == pytest.approx(0.3)
    assert fat.sd == pytest.approx(np.sqrt((0.04 + 0.01 + 0.0 + 0.09) / 4))
    assert fat.median == pytest.approx(0.25)
    assert fat.p5 == pytest.approx(0.1 + 0.15 * 0.1)  # linear between order statistics
    assert fat.p95 == pytest.approx(0.3 + 0.85 * 0.3)
    assert fat.max == 0.6
    # "above" excludes the value itself: 0.2 and 0.3 are not above 0.2 and 0.3
    assert fat.volume_above_ml == pytest.approx({0.2: 0.02, 0.3: 0.01, 0.4: 0.01, 0.5: 0.01})
    assert (skin.voxels, skin.defined_voxels, skin.defined_fraction) == (3, 0, 0.0)
    assert np.isnan([skin.mean, skin.sd, skin.median, skin.p5, skin.p99, skin.max]).all()
    assert tendon.voxels == 0
    assert np.isnan(tendon.defined_fraction)


def test_other_quantities_have_no_thresholds() -> None:
    rows = region_statistics(LABELS, {"jacobian": SHEAR, "max_shear": SHEAR})
    assert [r.quantity for r in rows] == ["jacobian"] * 3 + ["max_shear"] * 3
    assert rows[0].volume_above_ml == {}


@pytest.mark.parametrize(
    ("array", "error", "told"),
    [
        (np.zeros((3, 2, 2)), GeometryError, r"\(3, 2, 2\)"),
        (np.where(SHEAR > 5, np.inf, SHEAR), InputError, "4 infinite"),
    ],
)
def test_arrays_that_cannot_be_used_are_refused(array: np.ndarray, error: type[Exception], told: str) -> None:
    with pytest.raises(error, match=told):
        region_statistics(LABELS, {"max_shear": array})


VALUES = st.floats(0.0, 1.0) | st.just(float("nan"))


@given(st.lists(st.tuples(VALUES, st.floats(0.01, 2.0)), min_size=1, max_size=30), st.floats(-0.1, 1.1))
def test_volume_above_is_the_plain_sum(pairs: list[tuple[float, float]], threshold: float) -> None:
    values, volumes = (np.array(column) for column in zip(*pairs, strict=True))
    # each value is a threshold too: that is where a curve with > and one with >= differ
    thresholds = [threshold, *values[~np.isnan(values)]]
    wanted = [volumes[values > t].sum() for t in thresholds]
    np.testing.assert_allclose(volume_above(values, volumes, thresholds), wanted, rtol=0, atol=1e-12)


def test_volumes_of_another_number_are_refused() -> None:
    with pytest.raises(InputError, match="3 values"):
        volume_above([0.1, 0.2, 0.3], [1.0, 2.0], [0.0])


def test_table_round_trip_with_awkward_names(tmp_path: Path) -> None:
    labels = LabelMap(GRID, LABELS.labels, {1: 'fat, "deep"', 2: "Haut ä", 3: "tendon"})
    rows = region_statistics(labels, {"jacobian": SHEAR, "max_shear": SHEAR})
    path = tmp_path / "regions.csv"
    write_regions_csv(path, rows)
    with path.open(encoding="utf-8", newline="") as file:
        read = list(csv.DictReader(file))
    assert [r["region"] for r in read] == ['fat, "deep"', "Haut ä", "tendon"] * 2
    assert float(read[3]["median"]) == pytest.approx(0.25)
    assert read[4]["mean"] == "NaN"
    assert read[0]["volume_above_0.2_ml"] == ""
    assert float(read[3]["volume_above_0.2_ml"]) == pytest.approx(0.02)
    assert [p.name for p in tmp_path.iterdir()] == ["regions.csv"]


def test_a_failed_write_leaves_the_older_file_and_nothing_else(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="nowhere"):
        write_regions_csv(tmp_path / "nowhere" / "regions.csv", [])
    (tmp_path / "regions.csv").mkdir()
    with pytest.raises(OutputError, match=r"regions\.csv"):
        write_regions_csv(tmp_path / "regions.csv", [])
    assert [p.name for p in tmp_path.iterdir()] == ["regions.csv"]


def test_a_file_is_replaced_never_written_over(tmp_path: Path) -> None:
    path, other_name = tmp_path / "regions.csv", tmp_path / "kept.csv"
    path.write_text("old")
    other_name.hardlink_to(path)
    write_regions_csv(path, region_statistics(LABELS, {"max_shear": SHEAR}))
    assert other_name.read_text() == "old"  # whoever reads while we write sees the whole old file
    assert path.read_text().startswith("region,quantity,")


def test_verdicts() -> None:
    poor, folds = Verdict("caution", ("Poor.",)), Verdict("distrust", ("Folds.",))
    assert worst([Verdict("trust"), poor]) == poor
    assert worst([poor, folds, Verdict("distrust", ("Folds.", "Far."))]).reasons == ("Folds.", "Far.")
    assert [Verdict("trust").words, poor.words, folds.words] == ["Trust", "Use with care", "Do not trust"]
    for wrong in (lambda: worst([]), lambda: Verdict("fine"), lambda: Verdict("distrust")):  # type: ignore[arg-type]
        with pytest.raises(InputError):
            wrong()
