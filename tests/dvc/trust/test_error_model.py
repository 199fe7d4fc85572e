"""Error tables say what was put in; intervals cover the truth as often as they claim."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from dvc.errors import InputError
from dvc.images.depth import to_surface_mm
from dvc.images.image import Grid
from dvc.trust.error_model import POOLED, ErrorModel, ErrorTable, read_error_model
from dvc.trust.truth_draws import GaussianField, TruthDraws
from dvc.trust.uncertainty import statistics_of, uncertainty_of

KNOTS = np.array([0.0, 0.1, 0.5])
FAT = np.array([[[0.02, 0.0, -0.04], [0.01, 0.0, 0.0]], [[0.02, 0.02, 0.06], [0.01, 0.01, 0.01]]])
WHOLE = {"fat": FAT, POOLED: np.stack([np.full((2, 3), 0.005), np.full((2, 3), 0.03)])}
TABLE = ErrorTable(
    spacing_mm=np.full(3, 0.8),
    snr=25.0,
    shear=KNOTS,
    to_bone_mm=np.array([0.0, 4.0]),
    whole=WHOLE,
    runs=(WHOLE, {POOLED: WHOLE[POOLED] + 0.01}),
    correlation_mm=4.0,
)
GRID = Grid((36, 36, 36), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))


def test_bias_and_deviation_are_read_off_the_table() -> None:
    bias, sd = TABLE.expected("fat", np.array([0.05, 0.3, 0.9, 0.1]), np.array([1.0, 3.9, 0.0, 4.0]))
    np.testing.assert_allclose(bias, [0.01, -0.02, -0.04, 0.0])
    np.testing.assert_allclose(sd, [0.02, 0.04, 0.06, 0.01])
    other, _ = TABLE.expected("scar", np.array([0.2]), np.array([0.0]))
    np.testing.assert_allclose(other, 0.005)


def test_each_run_has_its_own_figures() -> None:
    bias, sd = TABLE.expected("fat", np.array([0.2]), np.array([0.0]), run=1)
    np.testing.assert_allclose([bias[0], sd[0]], [0.015, 0.04])


def test_each_tissue_has_its_own_widening(tmp_path: Path) -> None:
    """Twice as wide in one tissue, and by the common factor elsewhere; also when written and read."""
    inside = np.ones(GRID.shape, dtype=bool)
    shear, far = np.full(GRID.shape, 0.25, dtype=np.float32), np.full(GRID.shape, 9.0, dtype=np.float32)
    table = replace(TABLE, widening=1.5, widening_of={"fat": 3.0})
    ErrorModel("heel-mr", "", (table,), "made up").write(tmp_path / "model.json")
    (again,) = read_error_model(tmp_path / "model.json").tables
    assert (again.factor, again.factor_of("fat"), again.factor_of("skin")) == (1.5, 3.0, 1.5)
    widths = []
    for one in (again, replace(again, widening_of={})):
        median = uncertainty_of(shear, GRID, {"Fat": inside}, far, one).intervals[0]
        widths.append(median.high - median.low)
    assert widths[0] == pytest.approx(2.0 * widths[1], rel=0.01)
    ErrorModel("heel-mr", "", (replace(TABLE, widening_of={"fat": 0.5}),), "made up").write(tmp_path / "model.json")
    with pytest.raises(InputError, match="widening of a tissue is below 1"):
        read_error_model(tmp_path / "model.json")


def test_model_survives_its_file(tmp_path: Path) -> None:
    model = ErrorModel("heel-mr", "abc", (TABLE, replace(TABLE, snr=50.0)), "made up")
    model.write(tmp_path / "model.json")
    again = read_error_model(tmp_path / "model.json")
    assert (again.preset, again.parameters_sha256, again.source, len(again.tables)) == ("heel-mr", "abc", "made up", 2)
    np.testing.assert_allclose(again.tables[1].whole["fat"], FAT)
    np.testing.assert_allclose(again.tables[1].runs[1][POOLED], TABLE.runs[1][POOLED])
    assert again.tables[1].snr == 50.0


@pytest.mark.parametrize(
    "text", ["", "[]", '{"format": 9}', '{"format": 1, "preset": "x", "source": "", "tables": []}']
)
def test_what_is_no_model_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "model.json").write_text(text)
    with pytest.raises(InputError, match=r"model.json: not an error model"):
        read_error_model(tmp_path / "model.json")


@pytest.mark.parametrize(
    "change",
    [
        {"snr": -3.0},
        {"runs": ()},
        {"shear": KNOTS[::-1]},
        {"whole": {"fat": FAT}},
        {"whole": {POOLED: FAT[:, :1]}},
        {"runs": ({POOLED: -WHOLE[POOLED]},)},
    ],
)
def test_damaged_tables_are_refused_when_read(tmp_path: Path, change: dict) -> None:
    ErrorModel("heel-mr", "", (replace(TABLE, **change),), "made up").write(tmp_path / "model.json")
    with pytest.raises(InputError, match="not an error model"):
        read_error_model(tmp_path / "model.json")


@pytest.mark.parametrize(
    "change",
    [
        {"component_correlation_mm": [3.0, None]},
        {"component_correlation_mm": [None, 3.0]},
        {"component_correlation_mm": []},
        {"component_correlation_mm": None},
        {"errors": [1]},
        None,
    ],
)
def test_damaged_tables_of_components_are_refused_when_read(tmp_path: Path, change: dict | None) -> None:
    rows = {POOLED: np.full((6, 2, 3), 0.02)}
    table = replace(TABLE, whole=rows, runs=(rows,), component_correlation_mm=(3.0, 5.0))
    path = tmp_path / "model.json"
    ErrorModel("heel-mr", "", (table,), "made up").write(path)
    assert read_error_model(path).tables[0].component_correlation_mm == (3.0, 5.0)
    told = json.loads(path.read_text())
    told["tables"] = [[1] if change is None else told["tables"][0] | change]
    path.write_text(json.dumps(told))
    with pytest.raises(InputError, match=r"model.json: not an error model"):
        read_error_model(path)


def test_models_of_former_versions_are_read(tmp_path: Path) -> None:
    """Format 1: bias and standard deviation of the maximum shear strain, without components."""
    path = tmp_path / "model.json"
    ErrorModel("heel-mr", "", (replace(TABLE, widening=3.0),), "made up").write(path)
    told = json.loads(path.read_text())
    (table,) = told["tables"]
    for new, former in (("errors", "bias_and_sd"), ("errors_of_each_run", "bias_and_sd_of_each_run")):
        table[former] = table.pop(new)
    del table["component_correlation_mm"]
    path.write_text(json.dumps(told | {"format": 1}))
    (again,) = read_error_model(path).tables
    np.testing.assert_allclose(again.whole["fat"], FAT)
    assert (again.widening, again.has_components) == (3.0, False)


def test_nearest_table_is_taken_and_a_far_one_refused() -> None:
    model = ErrorModel("heel-mr", "", (TABLE, replace(TABLE, snr=50.0)), "made up")
    assert model.table_for(np.full(3, 0.9), 45.0).snr == 50.0
    assert model.table_for(np.array([0.8, 0.7, 0.7]), 20.0).snr == 25.0
    # thick slices are no small voxels, whatever their volume
    for spacing, snr in (((2.0, 2.0, 2.0), 25.0), ((0.4, 0.4, 4.0), 25.0), ((0.8, 2.4, 0.8), 25.0), ((0.8,) * 3, 5.0)):
        with pytest.raises(InputError, match="too far"):
            model.table_for(np.array(spacing), snr)


def test_distance_to_a_surface_counts_half_an_edge() -> None:
    body = np.zeros((6, 5, 9), dtype=bool)
    body[:, :, :3] = True
    np.testing.assert_allclose(to_surface_mm(body, np.array([1.0, 1.0, 2.0]))[2, 2], [0, 0, 0, 1, 3, 5, 7, 9, 11])
    assert np.isinf(to_surface_mm(np.zeros_like(body), np.ones(3))).all()
    assert not to_surface_mm(np.ones_like(body), np.ones(3)).any()


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 3, 3), (4, 4, 1)])
def test_intervals_of_small_regions_are_as_wide_as_a_voxels_error(shape: tuple[int, int, int]) -> None:
    """A region smaller than the correlation length errs as one voxel does: 0.25 +- 1.96 times 0.03."""
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[tuple(slice(1, 1 + n) for n in shape)] = True
    one = replace(TABLE, runs=(WHOLE,), correlation_mm=12.0)
    shear, far = np.full(GRID.shape, 0.25, dtype=np.float32), np.full(GRID.shape, 9.0, dtype=np.float32)
    median = uncertainty_of(shear, GRID, {"x": inside}, far, one).intervals[0]
    assert median.estimate == pytest.approx(0.245, abs=0.01)
    assert 0.6 * 0.0588 < median.high - median.estimate < 1.4 * 0.0588
    assert 0.6 * 0.0588 < median.estimate - median.low < 1.4 * 0.0588


def test_drawn_errors_are_as_alike_as_the_correlation_length_says() -> None:
    """Unit variance, and exp(-(d / c)^2) at a distance d, on lattice nodes of a body of thin voxels."""
    away = np.array([0.0, 0.5, 1.0, 1.5, 4.0]) * 3.0
    starts = np.stack(np.meshgrid(*[np.arange(0.0, 40.0, 4.5)] * 3), axis=-1).reshape(-1, 3)
    points = np.concatenate([starts + np.array([d, 0.0, 0.0]) for d in away])
    field = GaussianField(points, np.array([1.5, 0.5, 0.75]), 3.0, np.random.default_rng(11))
    drawn = np.array([field.drawn().reshape(5, -1) for _ in range(100)])
    alike = np.mean(drawn[:, :1] * drawn, axis=(0, 2))
    np.testing.assert_allclose(alike, np.exp(-((away / 3.0) ** 2)), atol=0.015)


def test_sigma_lies_where_the_shear_is_known_and_nowhere_else() -> None:
    shear = np.full(GRID.shape, 0.1, dtype=np.float32)
    shear[:5] = np.nan
    fat = np.zeros(GRID.shape, dtype=bool)
    fat[:, :18] = True
    found = uncertainty_of(shear, GRID, {"fat": fat}, np.full(GRID.shape, 9.0, dtype=np.float32), TABLE)
    np.testing.assert_array_equal(np.isfinite(found.sigma), fat & np.isfinite(shear))
    assert np.nanmax(np.abs(found.sigma - 0.01)) < 1e-6
    np.testing.assert_array_equal(np.isfinite(found.bias), fat & np.isfinite(shear))


def test_intervals_are_widened_from_their_middle_and_stay_possible() -> None:
    everywhere, far = np.ones(GRID.shape, dtype=bool), np.full(GRID.shape, 9.0, dtype=np.float32)
    shear = np.random.default_rng(3).uniform(0.0, 0.6, GRID.shape).astype(np.float32)
    plain, wide = (
        uncertainty_of(shear, GRID, {"x": everywhere}, far, replace(TABLE, widening=w)).intervals for w in (1.0, 400.0)
    )
    half = uncertainty_of(shear, GRID, {"x": everywhere}, far, replace(TABLE, widening=2.0)).intervals
    assert half[0].estimate == plain[0].estimate
    assert half[0].high - half[0].estimate == pytest.approx(2.0 * (plain[0].high - plain[0].estimate))
    assert all(i.low >= 0.0 for i in wide)
    volume = everywhere.size * GRID.voxel_volume_mm3 / 1000.0
    assert all(i.high <= volume for i in wide if i.statistic.startswith("volume"))


def test_no_more_than_a_few_truths_are_in_memory_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures may take longer than a draw, and two hundred truths of a whole foot take half a gigabyte."""
    drawn, used, waiting = TruthDraws.drawn, list[None](), list[int]()

    def counted(draws: TruthDraws) -> np.ndarray:
        waiting.append(1 + len(waiting) - len(used))
        return drawn(draws)

    def slow(shear: np.ndarray, volume_ml: float) -> np.ndarray:
        time.sleep(0.003)
        used.append(None)
        return statistics_of(shear, volume_ml)

    monkeypatch.setattr(TruthDraws, "drawn", counted)
    monkeypatch.setattr("dvc.trust.uncertainty.statistics_of", slow)
    fat = np.zeros(GRID.shape, dtype=bool)
    fat[4:7, 4:7, 4:7] = True
    shear, far = np.full(GRID.shape, 0.2, dtype=np.float32), np.full(GRID.shape, 9.0, dtype=np.float32)
    uncertainty_of(shear, GRID, {"fat": fat}, far, TABLE)
    assert len(waiting) == 200
    assert max(waiting) <= 10


def test_intervals_cover_the_truth_as_often_as_they_claim() -> None:
    """Truths of images whose bias is their own, 12 times: 95 % intervals miss few; by the mean bias alone, many."""

    def cells(bias: float, sd: float) -> dict[str, np.ndarray]:
        return {POOLED: np.stack([np.full((2, 3), bias), np.full((2, 3), sd)])}

    random = np.random.default_rng(5)
    runs = tuple(cells(b, 0.03) for b in 0.01 + 0.01 * random.standard_normal(40))
    table = replace(TABLE, whole=cells(0.01, 0.0316), runs=runs)
    everywhere, far = np.ones(GRID.shape, dtype=bool), np.full(GRID.shape, 9.0, dtype=np.float32)
    hits: list[list[float]] = []
    for _ in range(12):
        base = gaussian_filter(random.standard_normal(GRID.shape), 8.0)
        found = 0.25 + 0.08 * base / base.std()
        noise = gaussian_filter(random.standard_normal(GRID.shape), 2.0)
        truth = found - 0.01 - 0.03 * noise / noise.std() - 0.01 * random.normal()
        actual = statistics_of(truth.ravel(), truth.size / 1000.0)
        row = []
        for one in (table, replace(table, runs=(cells(0.01, 0.03),))):
            got = uncertainty_of(found.astype(np.float32), GRID, {"x": everywhere}, far, one)
            row.append(float(np.mean([i.low <= t <= i.high for i, t in zip(got.intervals, actual, strict=True)])))
        hits.append(row)
    covered, without = np.mean(hits, axis=0)
    assert 0.88 < covered < 0.995
    assert without < 0.75
