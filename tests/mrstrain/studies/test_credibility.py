"""Credibility and acquisition in a study: from its file and its results into the report, and never a reason to fail."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from dvc.errors import InputError
from dvc.report.page import METHODS, Section
from mrstrain.measurement.acquisition import ACQUIRED
from mrstrain.records.provenance import file_hash
from mrstrain.studies.credibility import convergence_of
from mrstrain.studies.file import Study, read_study
from mrstrain.studies.stages import StageResult
from tests.mrstrain.comparison.test_credibility import simulation
from tests.mrstrain.studies.test_page import SOUND, STUDY, ended, page_of

HARM = "<script>alert(1)</script>"


@pytest.fixture
def study(tmp_path: Path) -> Study:
    """A study of two loads and one material set, whose files hold their names."""
    for name in ("Load0", "Load1", "Load2", "tissues"):
        (tmp_path / f"{name}.nii.gz").write_bytes(name.encode())
    (tmp_path / "study.toml").write_text(STUDY)
    return read_study(tmp_path)


def with_more(study: Study, text: str) -> Study:
    (study.place / "study.toml").write_text(STUDY + text)
    return read_study(study.place)


def part(page: str, title: str) -> str:
    """A section of a page."""
    return page.split(f"<h2>{title}")[1].split("</details>", maxsplit=1)[0]


def test_free_text_is_shown_as_text_and_recorded(study: Study) -> None:
    more = f'[acquisition]\nscanner = "{HARM}"\n[credibility]\nquestion_of_interest = "/{HARM * 20}"\n'
    page = page_of(with_more(study, more), ended(study, register_Load1=SOUND))
    assert HARM not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in part(page, "Credibility (ASME")
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in part(page, "Acquisition and measurement")
    record = json.loads((study.out / "provenance.json").read_text())
    assert record["parameters"]["credibility"]["question_of_interest"] == f"/{HARM * 20}"


def test_a_study_that_gives_nothing_has_the_section_and_runs(study: Study) -> None:
    page = page_of(study, ended(study, register_Load1=SOUND))
    assert "not given" in part(page, "Credibility (ASME")
    assert "Load1 Trust" in part(page, "Credibility (ASME")
    assert "<h2>Acquisition and measurement" not in page  # there is nothing to tell


def test_a_study_without_models_has_no_section_on_their_credibility(study: Study) -> None:
    (study.place / "study.toml").write_text(STUDY.replace('sets = ["trebbi"]', ""))
    alone = read_study(study.place)
    assert "Credibility (ASME" not in page_of(alone, ended(alone, register_Load1=SOUND))


def test_models_of_finished_stages_are_read_from_their_records(study: Study) -> None:
    (study.out / "models").mkdir(parents=True)
    simulation(study.out / "models", "trebbi", title="Ogden fitted to mine.csv")
    assert "mine.csv" not in page_of(study, ended(study, register_Load1=SOUND))
    page = page_of(study, ended(study, register_Load1=SOUND, simulate_trebbi=StageResult(())))
    assert "the stress of the tests in mine.csv" in part(page, "Credibility (ASME")


def test_the_section_of_the_comparison_gives_way_to_that_of_the_study(study: Study) -> None:
    closing = (Section("Credibility (ASME V&V 40, FDA)", paragraphs=("Of the comparison alone.",)),)
    page = page_of(study, ended(study, register_Load1=SOUND, compare=StageResult((), (), closing)))
    assert "Of the comparison alone." not in page
    assert page.count("<h2>Credibility (ASME") == 1


def test_the_methods_text_has_the_acquisition_of_the_study_file(study: Study) -> None:
    old = f"{ACQUIRED} at 1.5 T."
    closing = (Section(METHODS, paragraphs=(old, "Models and measurement were compared.")),)
    outcomes = ended(study, register_Load1=SOUND, compare=StageResult((), (), closing))
    page = page_of(with_more(study, "[acquisition]\nfield_strength_t = 3.0\n"), outcomes)
    assert old not in page
    assert f"{ACQUIRED} at 3 T." in part(page, METHODS)
    assert "Models and measurement were compared." in part(page, METHODS)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('[credibility]\nquestion = "x"\n', r"'question' is an unknown key; did you mean 'question_of_interest'"),
        ('[credibility]\nmodel_influence = "some"\n', r"must be low, medium or high; got 'some'"),
        ('[credibility]\nlevel_model_frm = "b"\n', "did you mean 'level_model_form'"),
        ("[acquisition]\necho_time_ms = -1.0\n", "greater than 0"),
        ('[acquisition]\nmanufacturer_name = "GE"\n', "did you mean 'manufacturer'"),
    ],
)
def test_what_the_file_cannot_have_is_refused_with_its_line(study: Study, text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as told:
        with_more(study, text)
    assert re.search(r"line \d+: \[(credibility|acquisition)\]", str(told.value))


def test_empty_words_are_not_given(study: Study) -> None:
    given = with_more(study, '[credibility]\ncontext_of_use = "  "\nmodel_risk = "low"\n').credibility
    assert given.model_dump(exclude_none=True) == {"model_risk": "low"}


def converged(place: Path, labels: Path, **changes: Any) -> None:
    place.mkdir(parents=True, exist_ok=True)
    limit = {"limit": 1.0, "order": 1.0, "scatter": 0.0}
    record = {
        "sizes_mm": [3.0, 2.0, 1.5], "parameters": {"material": "trebbi"},
        "inputs": {"labels": [{"name": labels.name, "sha256": file_hash(labels)}]},
        "rows": [
            {"load": "Load1", "quantity": "p50 of fat", "limit": limit | {"error": -0.02}},
            {"load": "Load2", "quantity": "p50 of fat", "limit": limit | {"error": 0.05}},
            {"load": "Load1", "quantity": "plate", "limit": limit | {"error": 0.01}},
            {"load": "Load2", "quantity": "plate", "limit": limit | {"error": None}},
        ],
    } | changes  # fmt: skip
    (place / "convergence.json").write_text(json.dumps(record))


def test_mesh_convergence_is_found_for_the_label_map_that_is_meshed_alone(study: Study) -> None:
    assert convergence_of(study) == ()
    converged(study.place / "mesh" / "converged", study.place / "Load1.nii.gz")  # another file
    assert convergence_of(study) == ()
    converged(study.place / "converged", study.place / "tissues.nii.gz")
    (told,) = convergence_of(study)
    assert told == (
        "Mesh convergence of trebbi, cells of 3.00, 2.00, 1.50 mm, largest error of the finest mesh: p50 of fat +5.0 "
        "%; plate no limit found."
    )
    page = page_of(study, ended(study, register_Load1=SOUND))
    assert "p50 of fat +5.0 %" in part(page, "Credibility (ASME")


@pytest.mark.parametrize("changes", [{"rows": 3}, {"rows": [{}]}, {"inputs": None}, {"sizes_mm": ["x"]}])
def test_a_record_of_convergence_that_is_damaged_tells_nothing(study: Study, changes: dict[str, Any]) -> None:
    converged(study.place / "converged", study.place / "tissues.nii.gz", **changes)
    assert convergence_of(study) == ()
