"""The input uncertainty of the models in a study: further solutions, cached, told by `check`, and left out."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from dvc.own_files import read_rows
from mrstrain.studies.check import check
from mrstrain.studies.file import read_study
from mrstrain.studies.plan import plan
from mrstrain.studies.run import forecast, run

TABLE = """
[uncertainty]
mesh = 1.4
force = 0.03
direction_deg = 2.0
poisson = 0.5
labels_voxels = 0.5
stiffness = { fat = 0.2 }
"""
INPUTS = ("direction-across", "direction-along", "force", "labels-bone", "mesh", "poisson", "stiffness-fat")


@pytest.fixture(scope="module")
def varied(done, tmp_path_factory) -> Path:
    """The finished study, with the input uncertainty of its model."""
    folder = tmp_path_factory.mktemp("varied") / "study"
    shutil.copytree(done[0], folder)
    with (folder / "study.toml").open("a") as file:
        file.write(TABLE)
    return folder


def test_further_solutions_are_stages_that_check_tells_and_quick_leaves_out(varied: Path) -> None:
    stages = {stage.name: stage for stage in plan(read_study(varied))}
    assert list(stages)[-5:] == ["mesh", "mesh coarse", "simulate akrami", "vary akrami", "compare"]
    assert set(stages["vary akrami"].before) == {"mesh", "mesh coarse"}
    assert "vary akrami" in stages["compare"].before
    quick = {stage.name: stage for stage in plan(read_study(varied).quickly())}
    assert not {"mesh coarse", "vary akrami"} & set(quick)
    told = "\n".join(check(varied).summary())
    assert "2 stages are further solutions for the input uncertainty of the models, about" in told
    assert "`mrstrain run --quick` leaves them out" in told
    assert forecast(varied, quick=True)["compare"] == "run"
    assert "vary akrami" not in forecast(varied, quick=True)


def test_a_study_draws_its_inputs_and_says_what_each_adds(varied: Path) -> None:
    ran = run(varied, workers=1)
    assert ran.complete, ran.summary()
    assert ran.outcomes["simulate akrami"].reused
    folders = sorted(p.name for p in (varied / "results" / "variants" / "akrami").iterdir())
    assert tuple(folders) == INPUTS
    for name in INPUTS:
        (of_set,) = (varied / "results" / "variants" / "akrami" / name).iterdir()
        assert {"Load1.vtu", "Load2.vtu", "variant.toml"} <= {p.name for p in of_set.iterdir()}
    rows = read_rows(varied / "results" / "comparison" / "comparison_error.csv")
    assert {row["model"] for row in rows} <= {"akrami"}
    # nothing is solved again
    again = run(varied, workers=1)
    assert all(outcome.reused for outcome in again.outcomes.values())
    report = (varied / "results" / "report.html").read_text()
    assert "were left out (quick)" not in report
    hurried = run(varied, workers=1, quick=True)
    assert hurried.complete
    assert "were left out (quick)" in (varied / "results" / "report.html").read_text()
