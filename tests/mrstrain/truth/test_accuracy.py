"""The accuracy study: what a run keeps, what the tables make of it, and that a study goes on where it stopped."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dvc import Alignment, BSpline, Grid, Image, LabelMap, Registration, RigidMotion
from dvc.errors import InputError, MrstrainError, OutputError
from dvc.registration.elastix.presets import load_preset
from dvc.registration.gauss_newton.fit import control_grid, spline_through
from dvc.trust.error_model import POOLED
from dvc.worker import Worker
from mrstrain import accuracy
from mrstrain.truth.accuracy import MOTIONS, accuracy_cases, expected_minutes
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
    measure_run,
    motion_named,
    resolution_rows,
    stretched,
    wavelength_recovered,
)
from tests.quick import QUICK

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
        mean_abs_strain=np.full(count, 0.02, dtype=np.float32),
        true_slope=slope,
        slope=np.float32(0.8) * slope,
        voxel=np.zeros((count, 3), dtype=np.int64),
        correlation=np.exp(-np.arange(1.0, 9.0) / 2.0),
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
    by_strain = {r.low: r for r in rows if r.tissue == "fat" and r.by == "true maximal shear"}
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
    assert wavelength_recovered(rows, 0.5) == pytest.approx(9.0)
    assert np.isnan(wavelength_recovered(rows, 0.9))
    assert np.isnan(wavelength_recovered(rows, 0.1))


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
    assert fat.figures_within == pytest.approx(0.95, abs=0.05)  # widened until it is
    (table,) = fit_error_model(alike, "", "").tables
    assert 1.0 < table.widening < 10.0
    assert np.isnan(fit_error_model(alike[:1], "", "").tables[0].widening)
    off = [*alike[1:], samples(replace(CASE, seed=1, motion="Load2"), sd=0.02, count=20_000, offset=0.06)]
    rows = {(r.motion, r.tissue): r for r in coverage_rows(off)}
    assert rows["Load2", "fat"].voxels_within < 0.3
    assert rows["Load2", "fat"].left_over == pytest.approx(0.06, abs=0.01)
    assert coverage_rows(alike[:1]) == []


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


def test_the_default_study_is_of_a_size_that_people_wait_for() -> None:
    cases = accuracy_cases()
    assert len({c.name for c in cases}) == len(cases) < 120
    assert not any(9000 <= c.seed <= 9999 for c in cases)  # set aside for published figures
    assert {"still", "sliding", "Load1", "wave-8"} <= {c.motion for c in cases}


def test_borders_are_studied_with_labels_that_are_right_too_large_and_too_small() -> None:
    """Waves move bone as they move tissue, which the engine holds still there."""
    cases = accuracy_cases(("gauss-newton", "gauss-newton-borders"), conditions=(((0.8, 0.8, 0.8), 25.0),))
    with_borders = [c for c in cases if c.preset == "gauss-newton-borders"]
    assert {c.motion for c in with_borders} == set(MOTIONS)
    for seed in (1, 2):
        assert {c.labels_off for c in with_borders if c.seed == seed} == {-1, 0, 1}
    assert {c.labels_off for c in cases if c not in with_borders} == {0}
    assert len({c.name for c in cases}) == len(cases)


def test_rows_of_labels_that_are_off_stand_apart_and_the_error_model_has_both() -> None:
    exact, off = (replace(CASE, preset="gauss-newton-borders", labels_off=by) for by in (0, 1))
    runs = [samples(exact, sd=0.01), samples(off, sd=0.03)]
    told = {r.labels_off: r.shear_rmse for r in error_rows(runs) if (r.by, r.tissue) == ("all", "fat")}
    assert told == {0: pytest.approx(0.01, rel=0.1), 1: pytest.approx(0.03, rel=0.1)}
    _, sd = fit_error_model(runs, "", "").tables[0].expected("fat", np.array([0.2]), np.array([6.0], dtype=np.float32))
    assert sd[0] == pytest.approx(np.sqrt((0.01**2 + 0.03**2) / 2), rel=0.15)


def test_the_time_told_beforehand_is_that_of_the_engine() -> None:
    ours, borders, elastix = (
        expected_minutes([replace(CASE, preset=p)] * 10, 2) for p in ("gauss-newton", "gauss-newton-borders", "heel-mr")
    )
    assert 1.0 < ours < 0.6 * elastix < 6.0
    assert 1.5 * ours < borders < elastix  # two fits and a choice more
    assert expected_minutes([CASE] * 10, 1) == pytest.approx(2.0 * elastix)


def test_study_measures_writes_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs, of which one is measured and one made up; then a third alone is made, and the page tells of all."""

    def measured(case: AccuracyCase, *given: Any) -> ErrorSamples:
        return measure_run(case, *given) if case.motion == "Load1" else samples(case)

    monkeypatch.setattr("mrstrain.truth.accuracy.measure_run", measured)
    cases = [replace(CASE, preset="gauss-newton", motion=m) for m in ("still", "Load1", "wave-24")]
    plans: list[str] = []
    first = accuracy(tmp_path, cases=cases[:2], workers=1, tell_plan=plans.append)
    stamp = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "runs").iterdir()}
    study = accuracy(tmp_path, cases=cases, workers=1, tell_plan=plans.append)
    assert [p.split(", about")[0] for p in plans] == [
        "2 registrations to do (0 are there already)",
        "1 registrations to do (2 are there already)",
    ]
    # a smaller call adds nothing and takes nothing away
    again = accuracy(tmp_path, cases=cases[:1], workers=1, tell_plan=plans.append)
    assert plans[-1].startswith("0 registrations to do (1 are there already)")
    assert repr(again.errors) == repr(study.errors)  # NaN, the ends of a bin that is none, equals nothing
    assert all((tmp_path / "runs" / name).stat().st_mtime_ns == t for name, t in stamp.items())
    assert not study.failures
    of_load = [[r for r in s.errors if r.motion == "Load1"] for s in (first, study)]
    assert repr(of_load[0]) == repr(of_load[1])
    fat = next(r for r in study.errors if r.motion == "Load1" and r.tissue == "fat" and r.by == "all")
    assert 0.01 < fat.shear_rmse < 0.15  # voxels of 2.3 mm
    assert study.resolution[0].recovered == pytest.approx(0.8)
    for name in ("errors.csv", "zero_strain.csv", "resolution.csv", "error_model_gauss-newton.json", "report.html"):
        assert (tmp_path / name).stat().st_size > 100
    page = (tmp_path / "report.html").read_text()
    assert "Spatial resolution" in page
    assert page.count("data:image/png") == 5


def test_a_perfect_registration_has_no_error_and_resolves_the_wave(monkeypatch: pytest.MonkeyPatch) -> None:
    case = replace(CASE, preset="gauss-newton", motion="wave-24")
    wave = motion_named(Heel(case.seed), case.motion)

    def perfect(reference: Image, loaded: Image, **given: Any) -> Registration:
        control = control_grid(reference.grid, np.full(3, 3.0))
        spline = BSpline(control, spline_through(wave, control))
        still = Alignment(RigidMotion.identity(), "none", 0.0, 1.0, 0.0, np.zeros(3))
        return Registration(reference, loaded, given["tissue"], None, still, spline, given["settings"], 1.0)

    monkeypatch.setattr("phantoms.accuracy_run.register", perfect)
    run = measure_run(case, SimpleNamespace(threads=1), nullcontext(), lambda _: None)  # type: ignore[arg-type]
    assert np.ptp(run.true_shear) > 0.05
    assert np.ptp(run.true_slope) > 0.1
    np.testing.assert_allclose(run.u_error_mm, 0.0, atol=0.02)
    np.testing.assert_allclose(run.shear, run.true_shear, atol=0.01)
    np.testing.assert_allclose(run.slope, run.true_slope, atol=0.02)


def test_what_cannot_be_studied_is_refused_before_anything_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def never(*_: object) -> None:
        pytest.fail("a case was run")

    rigid = tmp_path / "rigid.txt"
    rigid.write_text(load_preset("heel-mr").text.replace("RecursiveBSplineTransform", "EulerTransform"))
    monkeypatch.setattr("mrstrain.truth.accuracy.measure_run", never)
    for wrong, says in (
        (replace(CASE, snr=0.0), "SNR"),
        (replace(CASE, spacing_mm=(0.1, 0.1, 0.1)), "spacing"),
        (replace(CASE, motion="dance"), "motion"),
        (replace(CASE, preset="heel-xr"), "heel-mr"),
        (replace(CASE, preset=str(rigid)), "no B-spline"),
        (replace(CASE, motion="wave-3"), "two voxels"),
    ):
        with pytest.raises(MrstrainError, match=says):
            accuracy(tmp_path / "out", cases=[wrong])
    with pytest.raises(InputError, match="only once"):
        accuracy(tmp_path / "out", cases=[CASE, CASE])
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 10**6))
    with pytest.raises(OutputError, match="1 MB left"):
        accuracy(tmp_path / "out", cases=[CASE])


def test_a_folding_motion_is_found_before_any_image_is_made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    mirror = stretched(np.ones(3), np.zeros(3))
    object.__setattr__(mirror, "matrix", np.diag([-1.0, 1.0, 1.0]))
    monkeypatch.setattr("mrstrain.truth.accuracy.motion_named", lambda *_: mirror)
    with pytest.raises(InputError, match="folds"):
        accuracy(tmp_path / "out", cases=[CASE])


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="process groups are needed to see that none is left")
def test_a_study_that_is_told_to_end_leaves_no_process_behind(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mrstrain", "accuracy", "--out", str(tmp_path), "--spacing", "2.3"]
    options = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "start_new_session": True}
    with subprocess.Popen([*command, "--motion", "Load1", "--seed", "4"], **options) as running:
        try:
            for line in running.stderr:  # until elastix is at work
                if b"accuracy: 1 registrations" in line:
                    break
            time.sleep(2.0)
            running.terminate()
            assert running.wait(timeout=30.0) == 128 + signal.SIGTERM
            for _ in range(60):
                if not _alive(running.pid):
                    break
                time.sleep(0.5)
            assert not _alive(running.pid)
        finally:
            if _alive(running.pid):
                os.killpg(running.pid, signal.SIGKILL)
    assert not list((tmp_path / "runs").iterdir())


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_failed_run_is_told_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def measured(case: AccuracyCase, *_: object) -> ErrorSamples:
        if case.motion == "Load2":
            raise MrstrainError("the optimiser diverged")
        return samples(case)

    monkeypatch.setattr("mrstrain.truth.accuracy.measure_run", measured)
    study = accuracy(tmp_path, cases=[CASE, replace(CASE, motion="Load2")], workers=1)
    assert list(study.failures.values()) == ["the optimiser diverged"]
    assert any("FAILED. the optimiser diverged" in line for line in study.summary())
    assert "the optimiser diverged" in (tmp_path / "report.html").read_text()


def test_two_parameter_files_of_one_name_are_never_taken_for_each_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("mrstrain.truth.accuracy.measure_run", lambda case, *_: samples(case))
    cases = []
    for folder, iterations in (("a", 100), ("b", 200)):
        file = tmp_path / folder / "mine.txt"
        file.parent.mkdir()
        file.write_text(f'(Transform "BSplineTransform")\n(MaximumNumberOfIterations {iterations})\n')
        cases.append(replace(CASE, preset=str(file)))
    both = r"a/mine\.txt and .*b/mine\.txt"
    with pytest.raises(InputError, match=both):
        accuracy(tmp_path / "out", cases=cases)
    assert not (tmp_path / "out").exists()
    accuracy(tmp_path / "out", cases=cases[:1], workers=1)
    kept = {p: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()}
    for second in (cases[1], replace(cases[1], motion="Load2")):  # their error models would share a file as well
        with pytest.raises(InputError, match=both):
            accuracy(tmp_path / "out", cases=[second], workers=1)
    assert {p: p.read_bytes() for p in (tmp_path / "out").rglob("*") if p.is_file()} == kept
    Path(cases[0].preset).unlink()  # its runs are no longer counted
    assert not accuracy(tmp_path / "out", cases=[cases[1]], workers=1).failures


@pytest.mark.parametrize(
    "preset",
    [
        "gauss-newton",
        pytest.param("quick.txt", marks=pytest.mark.full_size),
        pytest.param("heel-mr", marks=pytest.mark.full_size),
        pytest.param("gauss-newton-borders", marks=pytest.mark.full_size),
    ],
)
def test_a_run_is_that_of_its_case(
    preset: str, worker: Worker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Still: the truth is zero and what is found is noise; the same case gives the same samples."""
    monkeypatch.chdir(tmp_path)
    Path("quick.txt").write_text(QUICK)
    case = replace(CASE, preset=preset, motion="still")
    one, two = (measure_run(case, worker, nullcontext(), lambda _: None) for _ in range(2))
    np.testing.assert_array_equal(one.shear, two.shear)
    assert not one.true_shear.any()
    assert 0.001 < np.median(one.shear) < 0.15  # voxels of 2.3 mm; .018 at 0.8 mm
    assert one.estimated_snr == pytest.approx(25.0, rel=0.15)
    assert one.correlation[0] > one.correlation[3]
