"""The input uncertainty of the models in a study: variants, cached, announced by `check`, and skipped."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from dvc import TissueLabels, write_labels
from dvc.errors import InputError
from dvc.labelling.boundary_position import position_sd_mm
from dvc.labelling.near_marks import certain
from dvc.own_files import read_rows
from mrstrain.records.outcome import Outcome
from mrstrain.studies import stages
from mrstrain.studies.check import check
from mrstrain.studies.file import read_study
from mrstrain.studies.plan import Stage, plan
from mrstrain.studies.run import forecast, run
from mrstrain.studies.stages import StageResult

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


SET = '[soft]\n[soft.all]\nlaw = "neo-Hooke"\nmu_kpa = 10.0\nnu = 0.49\n'
PLAIN = """
[study]
name = "x"
[images]
load0 = "Load0.nii.gz"
labels = "tissues.nii.gz"
bone = "bone"
[loads.Load1]
image = "Load1.nii.gz"
normal_n = 5.0
[models]
sets = ["soft.toml"]
"""


def planned(folder: Path, table: str, quick: bool = False) -> dict[str, Stage]:
    """Stages of a small study with the table [uncertainty], by name."""
    (folder / "soft.toml").write_text(SET)
    (folder / "study.toml").write_text(PLAIN + table)
    study = read_study(folder)
    return {stage.name: stage for stage in plan(study.without_variants() if quick else study)}


def test_further_solutions_are_stages_which_quick_leaves_out(tmp_path: Path) -> None:
    stages = planned(tmp_path, TABLE)
    assert list(stages)[1:] == ["mesh", "mesh coarse", "simulate soft", "vary soft", "compare"]
    assert stages["mesh coarse"].arguments["ratio"] == 1.4
    assert set(stages["vary soft"].before) == {"mesh", "mesh coarse"}
    assert stages["vary soft"].arguments["uncertainty"]["stiffness"] == {"fat": 0.2}
    assert stages["vary soft"].goes_on
    assert "vary soft" in stages["compare"].before
    assert "vary soft" not in stages["compare"].after  # without it, the comparison is made all the same
    # without a coarser mesh, they start from the simulation itself
    alone = planned(tmp_path, "[uncertainty]\nforce = 0.1\n")
    assert set(alone["vary soft"].before) == {"mesh", "simulate soft"}
    assert alone["vary soft"].arguments["coarse"] is None
    usual = ["mesh", "simulate soft", "compare"]
    assert list(planned(tmp_path, TABLE, quick=True))[1:] == usual
    assert list(planned(tmp_path, ""))[1:] == usual
    assert list(planned(tmp_path, TABLE.replace("1.4", "0").replace("2.0", "0") + "quick = true\n"))[1:] == usual
    given = planned(tmp_path, '[uncertainty]\nvariants = ["stronger"]\n')["compare"]
    assert given.arguments["variants_elsewhere"] == [tmp_path / "stronger"]
    assert tmp_path / "stronger" in given.files


def test_the_probabilities_of_a_label_map_are_inputs_of_the_variants(tmp_path: Path) -> None:
    """A map made from an image has them beside it; one that `label` makes in the study is an output already."""
    beside = {tmp_path / name for name in ("tissues.json", "tissues_probability.json", "tissues_probability.nii.gz")}
    assert not beside & set(planned(tmp_path, TABLE)["vary soft"].files)
    for path in beside:
        path.touch()
    stages = planned(tmp_path, TABLE)
    assert beside < set(stages["vary soft"].files)
    assert not beside & set(stages["mesh"].files)
    (tmp_path / "tissues_probability.nrrd").touch()  # as `label` names it, whatever the ending of the label map
    (tmp_path / "study.toml").write_text(PLAIN.replace("tissues.nii.gz", "tissues.SEG.nrrd") + TABLE)
    named = {path.name for stage in plan(read_study(tmp_path)) if stage.name == "vary soft" for path in stage.files}
    assert {"tissues.json", "tissues_probability.nrrd"} < named
    made = PLAIN.replace('"tissues.nii.gz"', '"auto"').replace('bone = "bone"', 'bone_mask = "calcaneus.nii.gz"')
    (tmp_path / "study.toml").write_text(made + TABLE)
    (auto,) = [stage for stage in plan(read_study(tmp_path)) if stage.name == "vary soft"]
    assert not beside & set(auto.files)


@pytest.mark.parametrize(
    ("line", "told"),
    [("mesh = 1.05", "1.2 to 2.5 times as long"), ("force = -0.1", "greater than or equal to 0"),
     ("angle = 1.0", "unknown key")],
)  # fmt: skip
def test_a_spread_that_cannot_be_is_refused_with_its_line(tmp_path: Path, line: str, told: str) -> None:
    with pytest.raises(InputError, match=rf"line 1\d: \[uncertainty\].*{told}"):
        planned(tmp_path, f"[uncertainty]\n{line}\n")


def test_check_tells_the_further_solutions_and_a_tissue_that_is_not_there(varied: Path) -> None:
    told = "\n".join(check(varied).summary())
    assert "2 stages give the input uncertainty of the models and take about" in told
    assert "`mrstrain run --quick` skips them" in told
    assert forecast(varied, quick=True)["compare"] == "will run"
    assert "vary akrami" not in forecast(varied, quick=True)
    text = (varied / "study.toml").read_text()
    (varied / "study.toml").write_text(text.replace("{ fat = 0.2 }", "{ brawn = 0.2 }"))
    try:
        assert any("'stiffness': there is no soft tissue 'brawn'" in one for one in check(varied).wrong)
    finally:
        (varied / "study.toml").write_text(text)


def test_check_tells_of_variants_that_are_not_there(varied: Path) -> None:
    text = (varied / "study.toml").read_text()
    (varied / "study.toml").write_text(f'{text}variants = ["stronger"]\n')
    try:
        assert [one for one in check(varied).wrong if "stronger: no folder in it has a file variant.toml" in one]
    finally:
        (varied / "study.toml").write_text(text)


@pytest.mark.full_size
@pytest.mark.usefixtures("stages_in_this_process")
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
    assert "was skipped (quick)" not in report
    hurried = run(varied, workers=1, quick=True)
    assert hurried.complete
    assert "was skipped (quick)" in (varied / "results" / "report.html").read_text()


def test_boundaries_follow_from_the_probabilities_of_a_label_map_that_was_made(
    tiny_pair, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of one whose probabilities are lost, only bone and skin are uncertain, and the summary says why."""
    labels, seen = tiny_pair.labels, list[object]()
    write_labels(tmp_path / "tissues.nii.gz", labels)

    def solved(_mesh: Path, **given: object) -> Outcome:
        seen.append(given["boundaries_mm"])
        return Outcome(tmp_path, ("soft with one input changed",))

    def varied_with(made: Callable[..., TissueLabels]) -> StageResult:
        monkeypatch.setattr("mrstrain.measurement.label_files.read_made", made)
        return stages.vary(
            lambda *_: None, mesh=tmp_path, labels=tmp_path / "tissues.nii.gz", names=tmp_path / "tissues.csv",
            loads=[], uncertainty={"labels_voxels": 0.5},
        )  # fmt: skip

    def lost(*_: object) -> TissueLabels:
        raise InputError("The probabilities that belong to it cannot be read.")

    monkeypatch.setattr("mrstrain.models.vary.vary", solved)
    found = TissueLabels(labels, certain(labels))
    assert varied_with(lambda *_: found).lines[0] == "soft with one input changed"
    assert varied_with(lost).lines[0] == "The probabilities that belong to it cannot be read."
    varied_with(lambda *_: None)
    assert seen == [position_sd_mm(found), None, None]
    assert set(position_sd_mm(found)) == {name for name in labels.names.values() if name not in ("bone", "ankle")}
