"""The demonstration's study file, in both sizes, and one load of it on coarse voxels; `make demo` runs it whole."""

from __future__ import annotations

import csv
import json
import re
from functools import partial
from importlib import import_module

import numpy as np
import pytest

from dvc import StrainField, evaluate_on_grid, read_labels, read_mask
from dvc.errors import InputError, OutputError
from dvc.report.page import Section
from dvc.trust.verdict import Verdict
from mrstrain.models.simulate import LOADS
from mrstrain.records.time_left import Expected, Pace
from mrstrain.studies.demo import _make, _reached, _summary
from mrstrain.studies.file import read_study
from mrstrain.studies.ledger import StageRecord
from mrstrain.studies.pipeline import StageOutcome
from mrstrain.studies.plan import plan
from mrstrain.studies.run import StudyRun, run_studies
from mrstrain.studies.stages import StageResult
from mrstrain.studies.true_error import read_errors, write_errors
from mrstrain.studies.watch import Follower
from mrstrain.truth.phantom import phantom
from phantoms import Heel, TissueError, under_load
from tests.processes import stages_run_here

demonstration = import_module("mrstrain.studies.demo")  # the package has a function of that name


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "phantom.json").write_text(json.dumps({"parameters": {"seed": 1}}))  # as if the images were there
    return tmp_path


def test_three_sets_on_a_coarser_mesh(folder):
    _make(folder, 1, False, None)
    study = read_study(folder)
    names = [stage.name for stage in plan(study)]
    assert names[:6] == ["register repeat", *(f"register {x.name}" for x in LOADS), "mesh"]
    assert [n.split()[0] for n in names[6:]] == ["simulate"] * 3 + ["compare"]
    for load in LOADS:
        told = study.loads[load.name]
        assert (told.normal_n, told.shear_n) == (load.normal_n, load.shear_n or 0.0)
    labels = read_labels(study.path(str(study.mesh.labels)), study.path(str(study.mesh.names)))
    assert labels.grid.spacing_mm[0] > 1.0


def test_the_published_size_has_all_seven_sets(folder):
    _make(folder, 1, True, None)
    study = read_study(folder)
    assert len(study.models.sets) == 7
    assert study.mesh.edge_mm < 3.0


def test_another_phantom_in_the_folder_is_refused(folder):
    with pytest.raises(OutputError, match="seed 1"):
        _make(folder, 2, False, None)
    (folder / "phantom.json").write_text('{"parameters": ')
    with pytest.raises(InputError, match=r"phantom\.json: not the record of a phantom"):
        _make(folder, 2, False, None)


def test_a_study_of_ones_own_is_not_touched(tmp_path):
    (tmp_path / "study.toml").write_text("mine")
    with pytest.raises(OutputError, match="would overwrite"):
        _make(tmp_path, 1, False, None)
    assert (tmp_path / "study.toml").read_text() == "mine"


def test_changes_to_its_study_file_are_kept(folder):
    _make(folder, 1, False, None)
    changed = (folder / "study.toml").read_text().replace('"erdemir", ', "")
    (folder / "study.toml").write_text(changed)
    _make(folder, 1, False, None)
    assert (folder / "study.toml").read_text() == changed


def test_it_ends_with_five_lines_and_the_reports_path(folder):
    _make(folder, 1, False, None)
    study = read_study(folder)

    def ended(stage: str, *lines: str, verdict: str | None = None, complete: bool = True) -> StageOutcome:
        sections = () if verdict is None else (Section(stage, verdict=Verdict(verdict, ("why",))),)
        given = StageResult(lines, sections, complete=complete)
        return StageOutcome(stage, StageRecord(stage=stage, key="", made_utc="", seconds=1.0, files={}, result=given))

    outcomes = {
        f"register {load.name}": ended(f"register {load.name}", verdict="caution" if load.name == "Load3" else "trust")
        for load in LOADS
    }
    outcomes["compare"] = ended(
        "compare",
        "Load1: trebbi 1.0",
        "All loads, area in mL: trebbi 2.5",
        "Best match over all loads (area metric): trebbi.",
    )
    errors = {x.name: (TissueError("fat", 9, 0.1, 0.44, 0.0221, 0.0, 0.1, 0.1, 0.2, 0),) for x in LOADS}
    lines = _summary(errors, StudyRun(study, outcomes))
    assert len(lines) == 5
    assert lines[0].startswith("Verdicts on the registrations: ")
    assert "Load1: Trust" in lines[0]
    assert "Load3: Use with care" in lines[0]
    assert lines[1].startswith("RMSE of the max. shear in fat (true 95th percentile in brackets): ")
    assert "Load4 0.022 (0.44)" in lines[1]
    assert lines[2:4] == ["All loads, area in mL: trebbi 2.5", "Best match over all loads (area metric): trebbi."]
    assert lines[4] == f"Report: {folder / 'results' / 'report.html'}"
    outcomes["simulate erdemir"] = ended("simulate erdemir", "erdemir, Load1: ONLY 75 % of the load", complete=False)
    lines = _summary(errors, StudyRun(study, outcomes))
    assert lines[4] == "simulate erdemir: partial. erdemir, Load1: ONLY 75 % of the load"
    assert lines[5].startswith("Report: ")


def test_a_load_that_a_model_does_not_carry_is_no_failure_of_the_demonstration():
    def reached(*, retry: bool = False, reason: str = "", there: bool = True) -> bool:
        given = StageResult((), complete=False, retry=retry)
        record = StageRecord(stage="simulate akrami", key="", made_utc="", seconds=1.0, files={}, result=given)
        return _reached(StageOutcome("simulate akrami", record if there else None, reason))

    assert reached()
    assert not reached(retry=True)
    assert not reached(reason="The inputs have changed since this result was made.")
    assert not reached(there=False)


def test_it_makes_the_phantom_runs_its_study_and_tells_the_error_against_the_truth(tmp_path, monkeypatch):
    """Load2 alone, voxels of 2.3 mm, and nothing but its registration."""
    (load2,) = (load for load in LOADS if load.name == "Load2")
    monkeypatch.setattr(demonstration, "LOADS", [load2])
    monkeypatch.setattr(demonstration, "phantom", partial(phantom, spacing_mm=2.3, loads=["Load2"]))
    monkeypatch.setattr(demonstration, "run_studies", partial(run_studies, only=["register Load2"], workers=1))
    demonstration._make(tmp_path / "demo", 3, False, None)
    quick = "[registration]\nborders = false\nbending = 3.0\nvolume = 300.0\n"
    study = tmp_path / "demo" / "study.toml"
    assert "[registration]" not in study.read_text()
    study.write_text(study.read_text() + quick)
    pages, told = [], []
    with stages_run_here():
        shown = demonstration.demo(
            tmp_path / "demo", seed=3, progress=lambda *event: told.append(event), on_report=pages.append
        )
    assert pages == [tmp_path / "demo" / "results" / "report.html"]
    found = [what for case, what, fraction in told if case == "register Load2" and fraction == 1.0]
    assert re.fullmatch(r"max\. shear in \w+ [\d.]+ median, [\d.]+ at the 95th percentile; .*", *found)
    assert not shown.complete  # the rest has no result
    assert shown.lines[0].startswith("Verdicts on the registrations: Load2: ")
    error, true = (float(word) for word in re.search(r"Load2 ([\d.]+) \(([\d.]+)\)", shown.lines[1]).groups())
    assert 0.0 < error < 0.5 * true
    labels = read_labels(tmp_path / "demo" / "tissues.nii.gz", tmp_path / "demo" / "tissues.csv")
    valid = read_mask(tmp_path / "demo" / "results" / "registration" / "Load2" / "valid.nii.gz").inside
    _, H = evaluate_on_grid(under_load(Heel(3), "Load2"), labels.grid, labels.region("fat").inside & valid)
    with (tmp_path / "demo" / "error.csv").open(newline="") as file:
        (fat,) = (row for row in csv.DictReader(file) if row["tissue"] == "fat")
    assert float(fat["true_p95"]) == pytest.approx(np.percentile(StrainField.from_gradient(H).max_shear, 95), rel=1e-4)
    report = tmp_path / "demo" / "results" / "report.html"
    assert shown.lines[-1] == f"Report: {report}"
    assert "Measurement error (phantom with known strain)" in report.read_text()
    before = (tmp_path / "demo" / "error.csv").read_bytes()
    again = demonstration.demo(tmp_path / "demo", seed=3, on_report=pages.append)
    assert again.lines == shown.lines  # nothing is done again
    assert len(pages) == 1  # nor shown
    assert (tmp_path / "demo" / "error.csv").read_bytes() == before


def test_errors_are_read_again_while_their_registrations_are_the_same(tmp_path):
    def outcomes(made_utc: str) -> dict[str, StageOutcome]:
        record = StageRecord(
            stage="register Load1", key="", made_utc=made_utc, seconds=1.0, files={}, result=StageResult(())
        )
        return {"register Load1": StageOutcome("register Load1", record)}

    errors = {
        "Load1": tuple(TissueError(name, 12345, 0.1, 0.4, 1 / 3, -0.01, 0.05, 0.1, 0.2, 1) for name in ("fat", "a, b"))
    }
    write_errors(tmp_path / "error.csv", errors, outcomes("then"))
    assert read_errors(tmp_path / "error.csv", outcomes("then")) == errors
    assert read_errors(tmp_path / "error.csv", outcomes("since")) == {}
    assert read_errors(tmp_path / "none.csv", outcomes("then")) == {}
    (tmp_path / "own.csv").write_text("a,b\n1,2\n")
    assert read_errors(tmp_path / "own.csv", outcomes("then")) == {}
    (tmp_path / "own.csv").write_bytes(b"a,b\n\xff,2\n")
    assert read_errors(tmp_path / "own.csv", outcomes("then")) == {}
    (tmp_path / "error.csv").write_text((tmp_path / "error.csv").read_text().replace("12345", "12x45", 1))
    with pytest.raises(InputError, match=r"error\.csv: the error of Load1 is damaged .*12x45.*Delete this file"):
        read_errors(tmp_path / "error.csv", outcomes("then"))


@pytest.mark.parametrize("slower", [1, 10])
@pytest.mark.parametrize(("phantom_s", "study_s"), [(42, 150), (64, 315), (140, 370)])  # idle; recorded on busy cores
def test_the_time_left_is_right_within_a_factor_of_two_while_the_phantom_is_made(
    phantom_s: int, study_s: int, slower: int, monkeypatch
) -> None:
    """From the first tenth on, and at the beginning of the study, which knows how long the phantom took."""
    assert all(0.5 <= one <= 2.0 for one in _told_over_true(slower * phantom_s, slower * study_s, monkeypatch))


def test_it_would_not_be_so_without_the_time_that_the_phantom_took(monkeypatch) -> None:
    monkeypatch.setattr(Pace, "of", lambda self, stage: 1.0)
    assert min(_told_over_true(140, 370, monkeypatch)) < 0.5


def _told_over_true(phantom_s: int, study_s: int, monkeypatch) -> list[float]:
    """The time left as told over the true one: at each image of a phantom, and when its study begins."""
    clock, shares = [0.0], list[float]()
    monkeypatch.setattr("time.monotonic", lambda: clock[0])
    making = demonstration.Making(
        lambda case, stage, fraction: shares.append(fraction) if case == "all" else None, False, 0.0
    )
    assert making.done == {}
    ratios = []
    for share in (0.0, 0.052, 0.105, 0.25, 0.329, 0.47, 0.55, 0.7, 0.78, 0.92, 1.0):  # as `phantom` tells
        clock[0] = float(share * phantom_s)
        making("phantom", "images and truth", share)
        if clock[0] >= 0.1 * (phantom_s + study_s):
            ratios.append(clock[0] * (1.0 / shares[-1] - 1.0) / (phantom_s + study_s - clock[0]))
    assert len(ratios) > 3
    ((_, taken_s),) = making.done.values()
    assert taken_s == phantom_s
    begun = Follower(before=making.done).time_left({"study": Expected(150.0)}, 1)  # what `costs` expects of it
    return [*ratios, begun.seconds() / study_s]
