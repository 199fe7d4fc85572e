"""Error tables say what was put in; intervals cover the truth as often as they claim."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from dvc.errors import InputError
from dvc.image import Grid
from dvc.uncertainty import POOLED, ErrorModel, ErrorTable, read_error_model, uncertainty_of

KNOTS = np.array([0.0, 0.1, 0.5])
TABLE = ErrorTable(
    voxel_mm=0.8,
    snr=25.0,
    shear=KNOTS,
    to_bone_mm=np.array([0.0, 4.0]),
    bias={"fat": np.array([[0.02, 0.0, -0.04], [0.01, 0.0, 0.0]]), POOLED: np.full((2, 3), 0.005)},
    sd={"fat": np.array([[0.02, 0.02, 0.06], [0.01, 0.01, 0.01]]), POOLED: np.full((2, 3), 0.03)},
    run_sd={"fat": 0.002, POOLED: 0.004},
    correlation_mm=4.0,
)
GRID = Grid((36, 36, 36), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))


def test_bias_and_deviation_are_read_off_the_table() -> None:
    bias, sd = TABLE.expected("fat", np.array([0.05, 0.3, 0.9, 0.1]), np.array([1.0, 3.9, 0.0, 4.0]))
    np.testing.assert_allclose(bias, [0.01, -0.02, -0.04, 0.0])
    np.testing.assert_allclose(sd, [0.02, 0.04, 0.06, 0.01])
    other, _ = TABLE.expected("scar", np.array([0.2]), np.array([0.0]))
    np.testing.assert_allclose(other, 0.005)


def test_model_survives_its_file(tmp_path: Path) -> None:
    model = ErrorModel("heel-mr", (TABLE, replace(TABLE, snr=50.0)), "made up")
    model.write(tmp_path / "model.json")
    again = read_error_model(tmp_path / "model.json")
    assert (again.preset, again.source, len(again.tables)) == ("heel-mr", "made up", 2)
    np.testing.assert_allclose(again.tables[1].bias["fat"], TABLE.bias["fat"])
    assert again.tables[1].snr == 50.0


@pytest.mark.parametrize(
    "text", ["", "[]", '{"format": 9}', '{"format": 1, "preset": "x", "source": "", "tables": []}']
)
def test_what_is_no_model_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "model.json").write_text(text)
    with pytest.raises(InputError, match=r"model.json: no error model"):
        read_error_model(tmp_path / "model.json")


def test_nearest_table_is_taken_and_a_far_one_refused() -> None:
    model = ErrorModel("heel-mr", (TABLE, replace(TABLE, snr=50.0)), "made up")
    assert model.table_for(0.9, 45.0).snr == 50.0
    assert model.table_for(0.7, 20.0).snr == 25.0
    with pytest.raises(InputError, match="too far"):
        model.table_for(2.0, 25.0)
    with pytest.raises(InputError, match="too far"):
        model.table_for(0.8, 5.0)


def test_sigma_lies_where_the_shear_is_known_and_nowhere_else() -> None:
    shear = np.full(GRID.shape, 0.1, dtype=np.float32)
    shear[:5] = np.nan
    fat = np.zeros(GRID.shape, dtype=bool)
    fat[:, :18] = True
    found = uncertainty_of(shear, GRID, {"fat": fat}, np.full(GRID.shape, 9.0, dtype=np.float32), TABLE)
    np.testing.assert_array_equal(np.isfinite(found.sigma), fat & np.isfinite(shear))
    assert np.nanmax(np.abs(found.sigma - 0.01)) < 1e-6


def test_intervals_cover_the_truth_as_often_as_they_claim() -> None:
    """Truths drawn as the table says, 60 times: 95 % intervals miss few; without the image's own offset, many."""
    table = replace(TABLE, bias={POOLED: np.full((2, 3), 0.01)}, run_sd={POOLED: 0.006})
    random = np.random.default_rng(5)
    everywhere, far = np.ones(GRID.shape, dtype=bool), np.full(GRID.shape, 9.0, dtype=np.float32)
    hits: list[list[bool]] = []
    for _ in range(60):
        base = gaussian_filter(random.standard_normal(GRID.shape), 8.0)
        found = 0.25 + 0.08 * base / base.std()
        noise = gaussian_filter(random.standard_normal(GRID.shape), 2.0)
        truth = found - 0.01 - 0.03 * noise / noise.std() - 0.006 * random.normal()
        row = []
        for one in (table, replace(table, run_sd={POOLED: 0.0})):
            got = uncertainty_of(found.astype(np.float32), GRID, {"x": everywhere}, far, one, thresholds=(0.3,))
            true = {
                "median": np.median(truth),
                "p90": np.percentile(truth, 90),
                "p95": np.percentile(truth, 95),
                "volume_above_0.3_ml": np.count_nonzero(truth > 0.3) / 1000.0,
            }
            row.append(np.mean([i.low <= true[i.figure] <= i.high for i in got.intervals]))
        hits.append(row)
    covered, without = np.mean(hits, axis=0)
    assert 0.88 < covered <= 1.0
    assert without < 0.75
