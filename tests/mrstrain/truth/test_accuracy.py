"""The accuracy study: a run, its page, and that a study goes on where it stopped."""

from __future__ import annotations

import csv
import html
import os
import re
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

from dvc import Alignment, BSpline, Engine, GaussNewton, Image, Registration, RigidMotion, Settings
from dvc.errors import InputError, MrstrainError, OutputError, RegistrationError
from dvc.images.noise import Noise
from dvc.registration.elastix.presets import load_preset
from dvc.registration.gauss_newton.fit import control_grid, spline_through
from dvc.worker import Worker
from mrstrain import accuracy
from mrstrain.truth.accuracy import MOTIONS, accuracy_cases, expected_minutes
from phantoms import (
    AccuracyCase,
    ErrorSamples,
    Heel,
    measure_run,
    motion_named,
    stretched,
)
from phantoms.accuracy_run import _phantom_pair
from tests.phantoms.test_error_tables import CASE, samples
from tests.quick import QUICK


def test_the_default_study_is_of_a_size_that_people_wait_for() -> None:
    cases = accuracy_cases()
    assert len({c.name for c in cases}) == len(cases) == 90  # as its help says
    assert not any(9000 <= c.seed <= 9999 for c in cases)  # set aside for published figures
    assert {"still", "sliding", "Load1"} <= {c.motion for c in cases}
    assert {c.preset for c in cases} == {"gauss-newton-bone"}  # as `register` without labels
    assert "wave-8" in {c.motion for c in accuracy_cases(("gauss-newton",))}
    with pytest.raises(InputError, match="gauss-newton-bone keeps rigid"):
        accuracy_cases(motions=("still", "wave-8"))


def test_a_run_that_used_another_engine_than_the_one_tested_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """One smooth spline in place of one that is discontinuous at the bone; here all are found by another."""
    with pytest.raises(RegistrationError, match="with gauss-newton instead of gauss-newton-bone"):
        perfectly_registered(replace(CASE, preset="gauss-newton-bone", motion="still"), monkeypatch, GaussNewton())


def test_borders_are_studied_with_labels_that_are_right_too_large_and_too_small() -> None:
    """Waves move bone as they move tissue, which the engine holds still there."""
    cases = accuracy_cases(("gauss-newton", "gauss-newton-borders"), conditions=(((0.8, 0.8, 0.8), 25.0),))
    with_borders = [c for c in cases if c.preset == "gauss-newton-borders"]
    assert {c.motion for c in with_borders} == set(MOTIONS)
    for seed in (1, 2):
        assert {c.labels_off for c in with_borders if c.seed == seed} == {-1, 0, 1}
    assert {c.labels_off for c in cases if c not in with_borders} == {0}
    assert len({c.name for c in cases}) == len(cases)
    at_bone = accuracy_cases(("gauss-newton-bone",))
    assert {c.motion for c in at_bone} == set(MOTIONS)
    assert {c.labels_off for c in at_bone} == {-1, 0, 1}  # as is the bone mask


def test_the_time_told_beforehand_is_that_of_the_engine() -> None:
    usual = replace(CASE, spacing_mm=(0.8, 0.8, 0.8))
    ours, borders, elastix = (
        expected_minutes([replace(usual, preset=p)] * 10, 2)
        for p in ("gauss-newton", "gauss-newton-borders", "heel-mr")
    )
    assert 1.0 < ours < 0.6 * elastix < 6.0
    assert 1.5 * ours < borders < elastix  # two fits and a choice more
    assert expected_minutes([usual] * 10, 1) == pytest.approx(2.0 * elastix)
    coarser = expected_minutes([replace(usual, preset="gauss-newton", spacing_mm=(1.0, 1.0, 1.0))] * 10, 2)
    assert 0.5 * ours < coarser < 0.7 * ours  # 15.5 s instead of 30 s of processor time


def test_the_tutorial_tells_the_time_that_the_command_tells() -> None:
    page = (Path(__file__).parents[3] / "docs" / "tutorials" / "preset.md").read_text()
    (told,) = re.findall(
        r"about (\d+) s with\ngauss-newton, (\d+) s with gauss-newton-borders and (\d+) s with elastix", page
    )
    case = replace(CASE, spacing_mm=(1.0, 1.0, 1.0))
    for seconds, preset in zip(map(float, told), ("gauss-newton", "gauss-newton-borders", "heel-mr"), strict=True):
        assert 60.0 * expected_minutes([replace(case, preset=preset)], 1) == pytest.approx(seconds, rel=0.1)


@pytest.mark.parametrize(("preset", "share"), [("gauss-newton", 0.53), ("heel-mr", 0.21)])
def test_progress_begins_before_the_pair_is_made_and_counts_what_comes_before_the_registration(
    preset: str, share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    case, told = replace(CASE, preset=preset, spacing_mm=(4.0, 4.0, 4.0)), list[float]()

    def made(case: AccuracyCase) -> tuple[Any, ...]:
        assert told == [0.0]  # the clock of the time left runs
        return _phantom_pair(case)

    def registered(*_: object, progress: Any, settings: Settings, **__: object) -> SimpleNamespace:
        for stage, fraction in (("aligning", 0.0), ("aligning", 1.0), ("registering", 0.5), ("registering", 1.0)):
            progress(stage, fraction)
        return SimpleNamespace(settings=settings)

    monkeypatch.setattr("phantoms.accuracy_run._phantom_pair", made)
    monkeypatch.setattr("phantoms.accuracy_run.register", registered)
    monkeypatch.setattr("phantoms.accuracy_run.sampled_errors", lambda *_: samples(case))
    measure_run(case, SimpleNamespace(threads=1), nullcontext(), told.append)  # type: ignore[arg-type]
    _, making, aligned, half, whole = told
    assert making == pytest.approx(share, abs=0.01)  # measured of the processor time at 0.8 mm: .57 and .28
    assert making < aligned < half < whole < 1.0
    assert half == pytest.approx(0.5 * (aligned + whole))


@pytest.mark.usefixtures("in_this_process")
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
    assert [re.sub(r"about \d+ min on idle cores", "soon", p) for p in plans] == [
        "Registrations to run: 2, 1 at a time, soon; already done: 0.",
        "Registrations to run: 1, 1 at a time, soon; already done: 2.",
    ]
    # a smaller call adds nothing and takes nothing away
    again = accuracy(tmp_path, cases=cases[:1], workers=1, tell_plan=plans.append)
    assert plans[-1].startswith("Registrations to run: 0, ")
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
    assert page.count("data:image/webp") == 4  # one wave, recovered to 80 %, says nothing of the trade-off
    made = [path.name for path in (tmp_path / "figures").iterdir()]
    assert "resolution.pdf" in made
    (table,) = (tmp_path / "figures").glob("error_by_distance_to_bone_gauss-newton_*.csv")
    with table.open(newline="") as file:
        pooled = list(csv.DictReader(file))
    nearest = next(row for row in pooled if row["tissue"] == "fat")
    assert list(nearest) == ["tissue", "distance_to_bone_mm", "max_shear_rmse", "max_shear_bias"]
    assert float(nearest["max_shear_rmse"]) > 0.0


def perfectly_registered(
    case: AccuracyCase, monkeypatch: pytest.MonkeyPatch, used: Engine | None = None
) -> ErrorSamples:
    """A run of a shear wave whose registration finds the true displacement, with the engine ``used``."""
    wave = motion_named(Heel(case.seed), case.motion if "wave" in case.motion else "wave-24")

    def perfect(reference: Image, loaded: Image, **given: Any) -> Registration:
        control = control_grid(reference.grid, np.full(3, 3.0))
        spline = BSpline(control, spline_through(wave, control))
        still = Alignment(RigidMotion.identity(), "none", 0.0, 1.0, 0.0, np.zeros(3))
        settings = given["settings"] if used is None else Settings(used)
        return Registration(
            reference, loaded, given["tissue"], None, still, spline, settings, 1.0, (Noise(None, 25.0),) * 2
        )

    monkeypatch.setattr("phantoms.accuracy_run.register", perfect)
    return measure_run(case, SimpleNamespace(threads=1), nullcontext(), lambda _: None)  # type: ignore[arg-type]


def test_a_perfect_registration_has_no_error_and_resolves_the_wave(monkeypatch: pytest.MonkeyPatch) -> None:
    run = perfectly_registered(replace(CASE, preset="gauss-newton", motion="wave-24"), monkeypatch)
    assert np.ptp(run.true_shear) > 0.05
    assert np.ptp(run.true_slope) > 0.1
    np.testing.assert_allclose(run.u_error_mm, 0.0, atol=0.02)
    np.testing.assert_allclose(run.shear, run.true_shear, atol=0.01)
    np.testing.assert_allclose(run.slope, run.true_slope, atol=0.02)


def test_distances_longer_than_the_tissue_along_one_axis_are_taken_along_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    case = replace(CASE, preset="gauss-newton", motion="wave-24", spacing_mm=(4.0, 4.0, 4.0))
    run = perfectly_registered(case, monkeypatch)
    assert run.lag_mm[-1] == 64.0  # no longer than the heel along one axis at least
    assert np.isfinite(run.correlation).all()


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
        (replace(CASE, preset=str(rigid)), "not a B-spline"),
        (replace(CASE, motion="wave-3"), "two voxels"),
        (replace(CASE, motion="wave-x"), "wavelength"),
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


@pytest.mark.full_size  # `make test` ends a registration so: test_interrupt
@pytest.mark.skipif(not hasattr(os, "killpg"), reason="process groups are needed to see that none is left")
def test_a_study_that_is_told_to_end_leaves_no_process_behind(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mrstrain", "accuracy", "--out", str(tmp_path), "--spacing", "2.3"]
    options = {"stderr": subprocess.PIPE, "stdout": subprocess.DEVNULL, "start_new_session": True}
    with subprocess.Popen([*command, "--motion", "Load1", "--seed", "4"], **options) as running:
        try:
            for line in running.stderr:  # until elastix is at work
                if b"accuracy: 1 registration " in line:
                    break
            time.sleep(2.0)
            running.terminate()
            assert running.wait(timeout=120.0) == 128 + signal.SIGTERM
            for _ in range(240):
                if not _alive(running.pid):
                    break
                time.sleep(0.5)
            assert not _alive(running.pid)
        finally:
            if _alive(running.pid):
                os.killpg(running.pid, signal.SIGKILL)
    assert not list(tmp_path.glob("runs/*"))


def _alive(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.usefixtures("in_this_process")
def test_a_study_too_small_for_an_error_model_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With one heel and one motion, its intervals held 4 to 26 % of the true values, without a word."""
    monkeypatch.setattr("mrstrain.truth.accuracy.measure_run", lambda case, *_: samples(case))
    cases = [replace(CASE, motion=m, seed=n) for n in (1, 2) for m in ("still", "smooth", "Load1", "Load2")]
    small = accuracy(tmp_path / "small", cases=cases[:2], workers=1)
    (told,) = [line for line in small.summary() if "do not rely on the error model" in line]
    assert told.endswith("It needs 2 heels and 3 motions with strain or more; this study has 1 and 1.")
    assert told in html.unescape((tmp_path / "small" / "report.html").read_text())
    for enough, some in ((False, cases[:4]), (False, [*cases[:3], *cases[4:7]]), (True, cases)):
        study = accuracy(tmp_path / f"of {len(some)}", cases=some, workers=1)
        assert bool(study.too_few) is not enough


@pytest.mark.usefixtures("in_this_process")
def test_a_failed_run_is_told_and_the_others_go_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def measured(case: AccuracyCase, *_: object) -> ErrorSamples:
        if case.motion == "Load2":
            raise MrstrainError("the optimiser diverged")
        return samples(case)

    monkeypatch.setattr("mrstrain.truth.accuracy.measure_run", measured)
    study = accuracy(tmp_path, cases=[CASE, replace(CASE, motion="Load2")], workers=1)
    assert list(study.failures.values()) == ["the optimiser diverged"]
    assert any("FAILED. the optimiser diverged" in line for line in study.summary())
    page = (tmp_path / "report.html").read_text()
    assert (
        page.index("Incomplete: 1 of 2 cases failed.")
        < page.index('id="part-1"')
        < page.index("the optimiser diverged")
    )


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("names", [("mine.txt", "mine.txt"), ("mine.txt", "Mine.txt")])
def test_two_parameter_files_of_one_name_are_never_taken_for_each_other(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, names: tuple[str, str]
) -> None:
    """Neither are those whose names differ in case alone, which some file systems ignore."""
    monkeypatch.setattr("mrstrain.truth.accuracy.measure_run", lambda case, *_: samples(case))
    cases = []
    for folder, name, iterations in (("a", names[0], 100), ("b", names[1], 200)):
        file = tmp_path / folder / name
        file.parent.mkdir()
        file.write_text(f'(Transform "BSplineTransform")\n(MaximumNumberOfIterations {iterations})\n')
        cases.append(replace(CASE, preset=str(file)))
    both = rf"a/{names[0]}, .*b/{names[1]}"
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


@pytest.mark.full_size
@pytest.mark.parametrize("preset", ["gauss-newton", "quick.txt", "heel-mr", "gauss-newton-borders"])
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
    assert (one.correlation[:, 0] > one.correlation[:, 3]).all()
