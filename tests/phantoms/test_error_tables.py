"""Runs of an accuracy study: what they keep, and the tables and error model that are made of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvc import Grid, LabelMap
from dvc.errors import InputError
from dvc.trust.error_model import POOLED
from dvc.trust.uncertainty import uncertainty_of
from phantoms import (
    TISSUES,
    AccuracyCase,
    ErrorSamples,
    Heel,
    coverage_rows,
    distances_mm,
    error_rows,
    fit_error_model,
    floor_rows,
    motion_named,
    resolution_rows,
    wavelength_recovered,
    widened_for,
)

COARSE = (2.3, 2.3, 2.3)
CASE = AccuracyCase("heel-mr", COARSE, 25.0, "Load1", 4)
FAT = next(number for number, name in TISSUES.items() if name == "fat")
BONE = next(number for number, name in TISSUES.items() if name == "bone")


def samples(
    case: AccuracyCase, bias: float = 0.0, sd: float = 0.01, count: int = 4000, offset: float = 0.0
) -> ErrorSamples:
    """Made-up samples of fat, with an error that is known: ``bias`` where the shear is above 0.1, ``sd`` everywhere."""
    random = np.random.default_rng([case.seed, count])
    true = random.uniform(0.0, 0.4, count).astype(np.float32)
    error = np.where(true > 0.1, bias, 0.0) + sd * random.standard_normal(count) + offset
    slope = np.cos(np.linspace(0.0, 60.0, count)).astype(np.float32)
    return ErrorSamples(
        case=case,
        estimated_snr=25.0,
        seconds=1.0,
        unknown=0,
        folded=0,
        tissue=np.full(count, FAT),
        to_bone_mm=random.uniform(0.0, 15.0, count).astype(np.float32),
        to_border_mm=random.uniform(0.5, 6.0, count).astype(np.float32),
        true_shear=true,
        shear=np.maximum(true + error, 0.0).astype(np.float32),
        u_error_mm=np.tile(np.array([0.3, 0.0, -0.4], dtype=np.float32), (count, 1)),
        strain=np.full((count, 6), 0.02, dtype=np.float32),
        strain_error=np.full((count, 6), 0.01, dtype=np.float32),
        true_slope=slope,
        slope=np.float32(0.8) * slope,
        correlation=np.tile(np.exp(-np.arange(1.0, 9.0) / 2.0), (3, 1)),
        lag_mm=1.6 * np.arange(1.0, 9.0),
    )


def test_distances_to_bone_and_to_borders() -> None:
    values = np.full((20, 5, 5), FAT)
    values[:4] = BONE
    values[16:] = 0
    for edge, other in ((0.5, 1.0), (1.0, 0.5)):
        grid = Grid((20, 5, 5), (edge, other, other), (0, 0, 0))
        to_bone, to_border = distances_mm(LabelMap(grid, values, TISSUES))
        np.testing.assert_allclose(to_bone[:, 2, 2], np.maximum(0.0, edge * (np.arange(20) - 3.5)))
        np.testing.assert_allclose(to_border[4:10, 2, 2], edge * (0.5 + np.arange(6)))
        np.testing.assert_allclose(to_border[:4, 2, 2], edge * (3.5 - np.arange(4)))


def test_every_motion_has_its_name() -> None:
    heel = Heel(1)
    assert motion_named(heel, "still") is None
    wave = motion_named(heel, "wave-12.5")
    assert wave is not None
    assert wave.wavelength_mm == 12.5  # type: ignore[attr-defined]
    for wrong in ("Load7", "wave-", "wave-x", "wave--3"):
        with pytest.raises(InputError, match=r"motion|wavelength"):
            motion_named(heel, wrong)


def test_rows_say_what_the_samples_hold() -> None:
    rows = error_rows([samples(CASE, bias=-0.05), samples(replace(CASE, seed=5), bias=-0.05)])
    whole = next(r for r in rows if r.tissue == "fat" and r.by == "all")
    assert (whole.motion, whole.voxel_mm, whole.snr, whole.samples) == ("Load1", "2.3", 25.0, 8000)
    assert whole.shear_bias == pytest.approx(-0.0375, abs=2e-3)
    assert whole.shear_rmse == pytest.approx(np.hypot(whole.shear_bias, whole.shear_sd))
    assert (whole.u_bias_mm, whole.u_rmse_mm, whole.u_p95_mm) == pytest.approx((0.5, 0.5, 0.5))
    assert whole.u_sd_mm == pytest.approx(0.0, abs=1e-6)
    by_strain = {r.low: r for r in rows if r.tissue == "fat" and r.by == "true maximum shear strain"}
    assert by_strain[0.2].shear_bias == pytest.approx(-0.05, abs=2e-3)
    assert by_strain[0.05].shear_bias == pytest.approx(0.0, abs=2e-3)
    assert sum(r.samples for r in rows if r.tissue == "fat" and r.by == "distance to bone, mm") == 8000
    assert not any(r.tissue == "skin" for r in rows)


def test_rows_by_border_hold_what_lies_there_and_the_95th_percentile_is_of_the_size_of_the_error() -> None:
    """An error of -0.1 within 1 mm of a border, half as much within 2 mm, and nothing beyond."""
    run = samples(CASE)
    size = np.select([run.to_border_mm < 1.0, run.to_border_mm < 2.0], [0.1, 0.05], 0.0)
    run = replace(run, true_shear=run.true_shear + np.float32(0.2))
    run = replace(run, shear=(run.true_shear - size).astype(np.float32))
    rows = [r for r in error_rows([run]) if r.tissue == "fat"]
    by_border = {(r.low, r.high): r for r in rows if r.by == "distance to a border, mm"}
    for (low, high), row in by_border.items():
        assert row.samples == np.count_nonzero((run.to_border_mm >= low) & (run.to_border_mm < high))
    near, next_to = (next(r for (low, high), r in by_border.items() if low <= at < high) for at in (0.5, 1.5))
    assert (near.high, next_to.low, next_to.high) == (1.0, 1.0, 2.0)
    assert (near.shear_bias, next_to.shear_bias) == pytest.approx((-0.1, -0.05), abs=1e-6)
    whole = next(r for r in rows if r.by == "all")
    share = np.mean(run.to_border_mm < 1.0)
    assert share > 0.05  # so the 95th percentile of the sizes lies there; that of signed errors would be 0
    assert whole.shear_p95 == pytest.approx(0.1, abs=1e-6)


def test_floor_and_resolution_come_from_their_own_runs() -> None:
    still, waves = replace(CASE, motion="still"), [replace(CASE, motion=f"wave-{w}") for w in (8, 16)]
    runs = [samples(CASE), samples(still), *(samples(w) for w in waves)]
    floor = {r.tissue: r for r in floor_rows(runs)}
    assert floor["fat"].maer == pytest.approx(0.02)
    assert floor["fat"].sder == pytest.approx(0.0, abs=1e-6)
    resolved = resolution_rows(runs)
    assert [(r.tissue, r.wavelength_mm) for r in resolved] == [
        (tissue, w) for tissue in ("fat", POOLED) for w in (8.0, 16.0)
    ]
    assert resolved[0].recovered == pytest.approx(0.8, abs=1e-6)
    assert {r.motion for r in error_rows(runs)} == {"Load1", "still"}


def test_wavelength_is_read_between_the_rows() -> None:
    rows = resolution_rows([samples(replace(CASE, motion=f"wave-{w}")) for w in (6, 8, 12)])
    rows = [replace(r, recovered=v) for r, v in zip(rows[:3], (0.2, 0.4, 0.8), strict=True)]
    assert wavelength_recovered(rows, 0.5) == pytest.approx(8.0 * 1.5**0.25)  # a quarter of the way from 8 to 12 mm
    assert np.isnan(wavelength_recovered(rows, 0.9))
    assert np.isnan(wavelength_recovered(rows, 0.1))
    with pytest.raises(ValueError, match="several conditions or tissues"):
        wavelength_recovered([*rows, replace(rows[0], tissue="skin")], 0.5)


def test_error_model_finds_the_error_that_was_put_in() -> None:
    runs = [
        samples(replace(CASE, seed=s), bias=-0.05, sd=0.02, count=30_000, offset=o)
        for s, o in ((1, 0.01), (2, -0.01), (3, 0.01), (4, -0.01))
    ]
    (table,) = fit_error_model([*runs, samples(replace(CASE, motion="wave-8"), bias=9.0)], "", "made up").tables
    bias, sd = table.expected("fat", np.array([0.25]), np.array([9.0], dtype=np.float32))
    assert bias[0] == pytest.approx(-0.05, abs=0.004)
    assert sd[0] == pytest.approx(np.hypot(0.02, 0.01), abs=0.003)
    # each run has an offset of its own, and a deviation without it
    for run, offset in enumerate((0.01, -0.01, 0.01, -0.01)):
        own, own_sd = table.expected("fat", np.array([0.25]), np.array([9.0], dtype=np.float32), run)
        assert own[0] - bias[0] == pytest.approx(offset, abs=0.004)
        assert own_sd[0] == pytest.approx(0.02, abs=0.003)
    assert table.correlation_mm == pytest.approx(3.2, abs=0.02)
    assert (table.spacing_mm.tolist(), table.snr) == (list(COARSE), 25.0)
    # nothing is known of skin: it leans on what soft tissue does
    np.testing.assert_allclose(table.whole["skin"][0, 0], table.whole[POOLED][0].mean(axis=0), atol=0.002)
    # and of shears that did not occur (0.5) what the nearest do, never certainty
    assert table.whole["fat"][1, 0, -1] == pytest.approx(table.whole["fat"][1, 0, -2], abs=0.005)
    with pytest.raises(InputError, match="one preset"):
        fit_error_model([samples(CASE), samples(replace(CASE, preset="other"))], "", "")


def test_coverage_judges_each_heel_by_the_others() -> None:
    """Alike heels: 95 %. A heel that is off by three deviations is found out: its own error is not in its model."""
    offsets = {1: 0.01, 2: -0.01, 3: 0.005, 4: -0.005, 5: 0.0, 6: 0.008, 7: -0.008}
    alike = [samples(replace(CASE, seed=s), sd=0.02, count=20_000, offset=o) for s, o in offsets.items()]
    fat = {r.tissue: r for r in coverage_rows(alike)}["fat"]
    assert fat.voxels_within == pytest.approx(0.95, abs=0.02)
    assert abs(fat.left_over) < 0.004
    assert fat.statistics_within == pytest.approx(0.95, abs=0.05)  # widened until it is
    (table,) = fit_error_model(alike, "", "").tables
    assert 1.0 < table.widening < 10.0
    assert np.isnan(fit_error_model(alike[:1], "", "").tables[0].widening)
    off = [*alike[1:], samples(replace(CASE, seed=1, motion="Load2"), sd=0.02, count=20_000, offset=0.06)]
    rows = {(r.motion, r.tissue): r for r in coverage_rows(off)}
    assert rows["Load2", "fat"].voxels_within < 0.3
    assert rows["Load2", "fat"].left_over == pytest.approx(0.06, abs=0.01)
    assert coverage_rows(alike[:1]) == []


def test_intervals_hold_for_a_motion_that_was_left_out() -> None:
    """Heels err alike and motions do not: what is left out is the motion, so that intervals hold in others."""
    offsets = {"Load1": 0.0, "smooth": 0.02, "sliding": -0.02, "attached-Load1": 0.01, "attached-Load3": -0.01}
    runs = [
        samples(replace(CASE, motion=motion, seed=seed), sd=0.01, count=5_000, offset=offset)
        for motion, offset in offsets.items()
        for seed in (1, 2)
    ]
    (table,) = fit_error_model(runs, "", "").tables
    by_heel = [replace(run, case=replace(run.case, motion="Load1")) for run in runs]
    assert table.widening > 1.3 * fit_error_model(by_heel, "", "").tables[0].widening
    new = [samples(replace(CASE, motion="other", seed=9), sd=0.01, count=5_000, offset=o) for o in (0.025, -0.025)]
    (row,) = (r for r in coverage_rows(new, fit_error_model(runs, "", "")) if r.tissue == "fat")
    assert row.statistics_within == 1.0
    as_drawn = fit_error_model(runs, "", "")
    as_drawn = replace(as_drawn, tables=(replace(table, widening=1.0),))
    assert next(r for r in coverage_rows(new, as_drawn) if r.tissue == "fat").statistics_within < 0.5


def test_intervals_are_widened_by_motions_of_another_origin() -> None:
    """By as much as their errors need, of each tissue and of the whole."""
    runs = [samples(replace(CASE, seed=s), sd=0.01, count=20_000, offset=o) for s, o in ((1, 0.004), (2, -0.004))]
    model, others = fit_error_model(runs, "", ""), []
    for seed, offset in enumerate((0.02, -0.02, 0.01, -0.01), start=3):
        one = samples(replace(CASE, motion="model-Load1", seed=seed), sd=0.01, count=20_000, offset=offset)
        skin = next(number for number, name in TISSUES.items() if name == "skin")
        others.append(replace(one, tissue=np.where(np.arange(20_000) % 4 > 0, FAT, skin)))
    (table,) = widened_for(model, others).tables
    assert set(table.widening_of) == {"fat", "skin"}
    assert table.factor_of("Fat") == table.widening_of["fat"] > 2.0
    assert table.factor_of("scar") == table.widening > 2.0
    new = samples(replace(CASE, motion="another-Load1", seed=9), sd=0.01, count=20_000, offset=0.015)
    as_drawn = replace(model, tables=(replace(model.tables[0], widening=1.0),))
    for given, least, most in ((widened_for(model, others), 1.0, 1.0), (as_drawn, 0.0, 0.4)):
        (row,) = (r for r in coverage_rows([new], given) if r.tissue == "fat")
        assert least <= row.statistics_within <= most


def test_components_err_as_the_samples_do() -> None:
    """A strain measured a tenth too small, noise of two sizes about that, and of a third in the displacement."""
    random = np.random.default_rng(3)
    runs = []
    for seed in (1, 2):
        run = samples(replace(CASE, seed=seed), count=30_000)
        true = 0.2 * random.standard_normal((30_000, 6))
        noise = random.standard_normal((30_000, 6)) * np.array([0.03, 0.02, 0.02, 0.03, 0.02, 0.03])
        strain, u = 0.9 * true + noise, 0.4 * random.standard_normal((30_000, 3))
        runs.append(replace(run, strain=strain, strain_error=strain - true, u_error_mm=u))
    (table,) = fit_error_model(runs, "", "").tables
    found = table.expected_components("fat", np.array([0.2]), np.array([9.0], dtype=np.float32))[:, 0]
    # The mean error as a fraction of the measured strain, over the whole tensor, in which a shear component is twice.
    counts = np.array([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])
    measured, error = np.concatenate([r.strain for r in runs]), np.concatenate([r.strain_error for r in runs])
    slope = (counts * measured * error).sum() / (counts * measured**2).sum()
    assert slope == pytest.approx(-0.1, abs=0.02)
    left = error - slope * measured
    sizes = np.sqrt(np.mean(left**2, axis=0))
    np.testing.assert_allclose(found, [slope, sizes[0], sizes[1], 0.4], rtol=0.05, atol=0.003)
    assert table.component_correlation_mm == pytest.approx((3.2, 3.2), abs=0.02)
    assert (table.shared_of("fat") < 0.001).all()
    off = [replace(r, u_error_mm=r.u_error_mm + np.float32(0.3) * sign) for r, sign in zip(runs, (1, -1), strict=True)]
    (table,) = fit_error_model(off, "", "").tables
    np.testing.assert_allclose(table.shared_of("fat"), [0.0, 0.09 / 0.25], atol=0.01)
    row = next(r for r in coverage_rows(runs) if r.tissue == "fat")
    within = row.normal_strain_within, row.shear_strain_within, row.displacement_within
    np.testing.assert_allclose(within, 0.95, atol=0.01)


def test_coverage_of_a_given_error_model() -> None:
    seen = [samples(replace(CASE, seed=s), sd=0.02, count=20_000) for s in (1, 2, 3)]
    model, new = fit_error_model(seen, "", ""), replace(CASE, seed=4)
    (alike,) = (r for r in coverage_rows([samples(new, sd=0.02, count=20_000)], model) if r.tissue == "fat")
    assert alike.voxels_within == pytest.approx(0.95, abs=0.02)
    (noisier,) = (r for r in coverage_rows([samples(new, sd=0.06, count=20_000)], model) if r.tissue == "fat")
    assert noisier.voxels_within < 0.6


@pytest.mark.full_size
def test_a_voxels_expanded_uncertainty_covers_the_truth_about_the_value_less_its_bias() -> None:
    """A strain measured .04 too small, in a run that the error model has not seen: not about the measured value."""
    seen = [samples(replace(CASE, seed=s), bias=-0.04, sd=0.02, count=20_000) for s in (1, 2, 3)]
    new = samples(replace(CASE, seed=4), bias=-0.04, sd=0.02, count=20_000)
    (table,) = fit_error_model(seen, "", "").tables
    line = (len(new.shear), 1, 1)
    measured, true, to_bone = (of.reshape(line) for of in (new.shear, new.true_shear, new.to_bone_mm))
    grid, fat = Grid(line, COARSE, (0.0, 0.0, 0.0)), np.ones(line, dtype=bool)
    found = uncertainty_of(measured, grid, {"fat": fat}, to_bone, table)
    assert found.bias is not None
    assert np.mean(np.abs(measured - found.bias - true) < 1.96 * found.sigma) == pytest.approx(0.95, abs=0.02)
    assert np.mean(np.abs(measured - true) < 1.96 * found.sigma) < 0.7


def test_samples_survive_their_file_and_a_damaged_one_is_made_anew(tmp_path: Path) -> None:
    path, made = tmp_path / "run.npz", samples(CASE)
    made.write(path, "key")
    again = ErrorSamples.read(path, lambda _: "key")
    assert again is not None
    assert again.case == CASE
    np.testing.assert_array_equal(again.shear, made.shear)
    assert ErrorSamples.read(path, lambda _: "another preset") is None
    path.write_bytes(path.read_bytes()[:2000])
    assert ErrorSamples.read(path, lambda _: "key") is None
    assert ErrorSamples.read(tmp_path / "none.npz", lambda _: "key") is None


def test_parameter_files_of_ones_own_can_be_judged(tmp_path: Path) -> None:
    """Named after the file; the error model then is for `register --parameters` with that file."""
    (tmp_path / "mine.txt").write_text('(Transform "BSplineTransform")\n')
    case = replace(CASE, preset=str(tmp_path / "mine.txt"))
    assert case.name.startswith("mine_2.3x2.3x2.3mm")
    assert fit_error_model([samples(case)], "", "").preset == "mine.txt"


def test_rows_of_labels_that_are_off_stand_apart_and_the_error_model_has_both() -> None:
    exact, off = (replace(CASE, preset="gauss-newton-borders", labels_off=by) for by in (0, 1))
    runs = [samples(exact, sd=0.01), samples(off, sd=0.03)]
    told = {r.labels_off: r.shear_rmse for r in error_rows(runs) if (r.by, r.tissue) == ("all", "fat")}
    assert told == {0: pytest.approx(0.01, rel=0.1), 1: pytest.approx(0.03, rel=0.1)}
    _, sd = fit_error_model(runs, "", "").tables[0].expected("fat", np.array([0.2]), np.array([6.0], dtype=np.float32))
    assert sd[0] == pytest.approx(np.sqrt((0.01**2 + 0.03**2) / 2), rel=0.15)
