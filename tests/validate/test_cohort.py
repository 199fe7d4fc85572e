"""Models over subjects: means, intervals and what is told apart, in closed form and as often as they claim."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import InputError
from mrstrain.studies.cohort import cohort
from mrstrain.studies.file import read_study
from mrstrain.studies.ledger import StageRecord
from mrstrain.studies.pipeline import StageOutcome
from mrstrain.studies.run import StudyRun
from mrstrain.studies.stages import StageResult
from validate import LEVELLED, NOTHING, rank_over_subjects

STUDY = """
[study]
name = "{name}"
[images]
load0 = "Load0.nii.gz"
labels = "tissues.nii.gz"
[loads.Load1]
image = "Load1.nii.gz"
[models]
results = ["near", "far"]
"""
HEAD = "load,tissue,model,ml,share,low_ml,high_ml,estimate_ml"


def test_closed_form():
    first, second = rank_over_subjects({"far": {"a": 0.3, "b": 0.5}, "near": {"a": 0.1, "b": 0.2, "c": 0.9}})
    assert (first.model, second.model) == ("near", "far")
    assert first.subjects == second.subjects == 2  # c has no result of the other
    assert first.mean == pytest.approx(0.15)
    # two values: the standard error is half their distance, and t(0.975, 1) = 12.7062
    assert second.high - second.mean == pytest.approx(12.7062 * 0.1, rel=1e-5)
    assert (second.least, second.greatest) == (0.3, 0.5)
    assert (first.best_in, second.best_in) == (2, 0)
    assert second.behind == pytest.approx(0.25)
    # of two models, Tukey's interval is Student's: the two differences are .2 and .3
    assert second.behind_high - second.behind == pytest.approx(12.7062 * 0.05, rel=1e-4)
    assert not second.differs_from_best


def test_a_difference_that_every_subject_shows_is_told_though_subjects_differ():
    rng = np.random.default_rng(1)
    level = rng.uniform(0.1, 0.9, 12)  # subjects differ far more than models
    near = {str(i): v for i, v in enumerate(level)}
    far = {str(i): v + 0.02 + 0.005 * rng.standard_normal() for i, v in enumerate(level)}
    first, second = rank_over_subjects({"far": far, "near": near})
    assert first.model == "near"
    assert second.differs_from_best
    assert second.low < first.high  # the means' own intervals overlap


def test_intervals_hold_as_often_as_they_claim():
    rng = np.random.default_rng(2)
    truth, held = 0.3, 0
    for _ in range(2000):
        values = {str(i): v for i, v in enumerate(truth + 0.05 * rng.standard_normal(5))}
        (one,) = rank_over_subjects({"model": values})
        held += one.low <= truth <= one.high
    assert held / 2000 == pytest.approx(0.95, abs=0.015)


def test_equal_models_differ_by_chance_as_rarely_as_claimed():
    rng = np.random.default_rng(3)
    apart = 0
    tries = 60
    for _ in range(tries):
        subjects = rng.uniform(0.2, 0.8, 6)
        table = subjects + 0.03 * rng.standard_normal((7, 6))
        found = rank_over_subjects({f"m{k}": {str(i): v for i, v in enumerate(row)} for k, row in enumerate(table)})
        apart += any(one.differs_from_best for one in found)
    assert apart / tries < 0.08  # plain intervals of each difference: over .35; of .15, one in 20 tests would pass


def test_one_subject_has_no_interval():
    first, second = rank_over_subjects({"far": {"a": 0.3}, "near": {"a": 0.1}})
    assert np.isnan(second.low)
    assert not second.differs_from_best
    assert first.mean == 0.1


def test_no_common_subject():
    with pytest.raises(InputError, match="ranked"):
        rank_over_subjects({"x": {"a": 0.1}, "y": {"b": 0.1}})


def compared(folder: Path, name: str, near: float, far: float) -> Path:
    """A study's folder with the table that a comparison leaves; what is no model of its own would be the nearest."""
    comparison = folder / name / "results" / "comparison"
    comparison.mkdir(parents=True)
    (folder / name / "study.toml").write_text(STUDY.format(name=name))
    shares = {"near": near, "far": far, "near" + LEVELLED: 0.01, NOTHING: 0.02}
    rows = [f"Load1,all soft tissue,{model},{share},{share},,,nan" for model, share in shares.items()]
    (comparison / "areas.csv").write_text("\n".join([HEAD, *rows]) + "\n")
    return folder / name


@pytest.mark.parametrize(
    ("outcome", "why"),
    [
        (
            StageOutcome("compare", None, "Not run: none of register Load1 has a result."),
            "compare not run (none of register Load1 has a result).",
        ),
        (StageOutcome("compare", None, "The label map has no 'bone'."), "compare FAILED. The label map has no 'bone'."),
        (None, "its study has no model to compare"),
    ],
)
def test_a_table_that_an_earlier_run_left_is_not_ranked_over(tmp_path, monkeypatch, outcome, why):
    places = [compared(tmp_path, "Ada", 0.1, 0.3), compared(tmp_path, "Ben", 0.9, 0.2)]
    record = StageRecord(
        stage="compare", key="k", made_utc="", seconds=1.0, files={}, result=StageResult(()), made_from={}
    )
    well = StageOutcome("compare", record)

    def ended(studies, **_):
        return [
            StudyRun(study, {} if one is None else {"compare": one}) for study, one in zip(studies, ends, strict=True)
        ]

    monkeypatch.setattr("mrstrain.studies.cohort.run_studies", ended)
    ends: list[StageOutcome | None] = [well, well]
    both = cohort(places, out=tmp_path / "both")
    assert (both.ranking[0].model, both.ranking[0].subjects) == ("far", 2)
    assert not any("is left out" in note for note in both.notes)
    ends[1] = outcome
    one = cohort(places, out=tmp_path / "one")
    assert (one.ranking[0].model, one.ranking[0].subjects) == ("near", 1)
    assert any(note.startswith(f"Ben is left out: {why}") for note in one.notes)
    assert not any("not used for the ranking" in note for note in one.notes)  # said once
    with (tmp_path / "one" / "cohort.csv").open() as file:
        assert {row["subject"] for row in csv.DictReader(file)} == {"Ada"}
    assert read_study(places[1]).study.name in (tmp_path / "one" / "report.html").read_text()
    ends[0] = outcome
    with pytest.raises(InputError, match="No subject was compared"):
        cohort(places, out=tmp_path / "none")


def test_a_model_that_few_subjects_have_does_not_take_the_others_from_the_ranking(tmp_path, monkeypatch):
    places = [compared(tmp_path, name, 0.1, 0.3) for name in ("Ada", "Ben", "Cy")]
    for place in places[1:]:  # a law that only Ada's heel bore
        table = place / "results" / "comparison" / "areas.csv"
        table.write_text("".join(line for line in table.read_text().splitlines(True) if ",far," not in line))
    record = StageRecord(
        stage="compare", key="k", made_utc="", seconds=1.0, files={}, result=StageResult(()), made_from={}
    )
    ended = lambda studies, **_: [StudyRun(study, {"compare": StageOutcome("compare", record)}) for study in studies]  # noqa: E731
    monkeypatch.setattr("mrstrain.studies.cohort.run_studies", ended)
    done = cohort(places, out=tmp_path / "out")
    assert [(one.model, one.subjects) for one in done.ranking] == [("near", 3)]
    assert "far is not ranked: it has an area over all loads in only 1 of 3 subjects." in done.notes
    assert not any("not used for the ranking" in note for note in done.notes)


def test_what_is_unlike_between_subjects_is_told_and_one_name_for_two_laws_refused(tmp_path, monkeypatch):
    places = [compared(tmp_path / "Mueller_Hans", name, 0.1, 0.3) for name in ("Ada", "Ben", "Cy")]
    record = StageRecord(
        stage="compare", key="k", made_utc="", seconds=1.0, files={}, result=StageResult(()), made_from={}
    )
    ended = lambda studies, **_: [StudyRun(study, {"compare": StageOutcome("compare", record)}) for study in studies]  # noqa: E731
    monkeypatch.setattr("mrstrain.studies.cohort.run_studies", ended)
    alike = cohort(places, out=tmp_path / "alike")
    assert not any("differs between subjects" in note for note in alike.notes)
    assert "Mueller_Hans" not in "".join(file.read_text(errors="ignore") for file in (tmp_path / "alike").iterdir())

    other = places[1] / "study.toml"
    text = other.read_text()
    other.write_text(
        text.replace('Load1.nii.gz"', 'Load1.nii.gz"\nnormal_n = 15\nshear_n = 0')
        + '[registration]\nengine = "elastix"\n'
    )
    notes = cohort(places, out=tmp_path / "unlike").notes
    begin, end = "Setting differs between subjects: ", " Their areas may not be comparable."
    assert f"{begin}[loads.Load1] normal_n = none (Ada, Cy); 15 (Ben).{end}" in notes
    assert f"{begin}[registration] engine = gauss-newton-borders (Ada, Cy); heel-mr (Ben).{end}" in notes
    assert len([note for note in notes if note.startswith(begin)]) == 2  # a shear of nothing is none

    for place, mu in zip(places, (10, 10, 999), strict=True):
        (place / "mine.toml").write_text(f'[mine]\n[mine.fat]\nlaw = "neo-Hooke"\nmu_kpa = {mu}\nnu = 0.49\n')
        (place / "study.toml").write_text(STUDY.format(name=place.name) + 'sets = ["mine.toml"]\n')
    with pytest.raises(InputError, match="'mine' differs between Cy and Ada"):
        cohort(places, out=tmp_path / "laws")
    again = (places[0] / "mine.toml").read_text().replace("mu_kpa = 10\n", "mu_mpa = 0.01\n").replace("fat", "Fat")
    (places[1] / "mine.toml").write_text(again)
    cohort(places[:2], out=tmp_path / "same")

    (places[1] / "study.toml").write_text(
        (places[1] / "study.toml").read_text() + 'limit_minutes = 5\n[loads.Load2]\nimage = "Load2.nii.gz"\n'
    )
    notes = cohort(places[:2], out=tmp_path / "more").notes
    assert f"{begin}[loads] = Load1 (Ada); Load1, Load2 (Ben).{end}" in notes
    assert f"{begin}[models] limit_minutes = none (Ada); 5 (Ben).{end}" in notes


def test_files_that_are_lacking_are_told_of_all_subjects_at_once(tmp_path):
    places = [compared(tmp_path, name, 0.1, 0.3) for name in ("Ada", "Ben")]
    with pytest.raises(InputError, match=r"(?s)Ada.*Load0\.nii\.gz.*Ben.*Load0\.nii\.gz"):
        cohort(places, out=tmp_path / "out")
