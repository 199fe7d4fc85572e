"""A study's report: whose verdict stands at its head, what is lacking, how it was measured, and a phantom's error."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from dvc.errors import MrstrainError, ParameterError
from dvc.report.page import Section, Table
from dvc.trust.verdict import Verdict
from mrstrain.cli.app import app
from mrstrain.studies.file import Study, read_study
from mrstrain.studies.ledger import Ledger, StageRecord
from mrstrain.studies.page import write_run_report
from mrstrain.studies.pipeline import StageOutcome
from mrstrain.studies.plan import plan
from mrstrain.studies.run import StudyRun, report, run
from mrstrain.studies.stages import StageResult
from mrstrain.studies.true_error import TABLE, write_errors
from phantoms import TissueError
from tests.mrstrain.comparison.test_methods import measured
from validate.verdict import verdict_on

STUDY = """
[study]
name = "Heel"
[images]
load0 = "Load0.nii.gz"
labels = "tissues.nii.gz"
[loads.Load1]
image = "Load1.nii.gz"
normal_n = 140
[loads.Load2]
image = "Load2.nii.gz"
normal_n = 15
[models]
sets = ["trebbi"]
"""
SOUND = StageResult((), (Section("Load1", Verdict("trust")),))


@pytest.fixture
def study(tmp_path: Path) -> Study:
    (tmp_path / "study.toml").write_text(STUDY)
    for name in ("Load0", "Load1", "Load2", "tissues"):
        (tmp_path / f"{name}.nii.gz").write_bytes(name.encode())
    return read_study(tmp_path)


def record(stage: str, given: StageResult, made: str = "2026-01-01T00:00:00Z") -> StageRecord:
    return StageRecord(stage=stage, key="", made_utc=made, seconds=1.0, files={}, result=given)


def ended(study: Study, **given: StageResult | str) -> dict[str, StageOutcome]:
    """Outcomes of all stages: records where something is given, reasons where a sentence is, else not asked for."""
    outcomes = {}
    for stage in plan(study):
        one = given.get(stage.name.replace(" ", "_"))
        if isinstance(one, StageResult):
            outcomes[stage.name] = StageOutcome(stage.name, record(stage.name, one))
        else:
            outcomes[stage.name] = StageOutcome(
                stage.name, None, one or "Not run: nobody asked.", requested=one is not None
            )
    return outcomes


def page_of(study: Study, outcomes: dict[str, StageOutcome]) -> str:
    study.out.mkdir(exist_ok=True)
    write_run_report(study.out / "report.html", study, outcomes)
    return (study.out / "report.html").read_text()


def head(page: str) -> str:
    """What stands between title and table of contents, as text."""
    return " ".join(re.sub(r"<[^>]+>", " ", page.split("<h1>")[1].split("<h2>", maxsplit=1)[0]).split())


def test_what_was_not_asked_for_or_failed_is_no_verdict_on_the_registrations(study: Study) -> None:
    sound = {"register_Load1": SOUND, "register_Load2": SOUND}
    only = ended(study, **sound)
    told = head(page_of(study, only))
    assert told.startswith("Heel Measurement: Trust Both registrations passed all checks. Not requested")
    assert told.endswith("without a result: mesh, simulate trebbi, compare.")
    assert StudyRun(study, only).complete
    assert "Not requested, and without a result: mesh, simulate trebbi, compare." in StudyRun(study, only).summary()

    broken = ended(study, **sound, mesh="It broke.\nTraceback", simulate_trebbi="Not run: mesh has no result.")
    told = head(page_of(study, broken))
    assert "Do not trust" not in told
    assert "Incomplete: mesh: failed (It broke); simulate trebbi: not run (mesh has no result)." in told
    assert "Traceback" not in told
    assert not StudyRun(study, broken).complete

    part = ended(study, **sound, mesh=SOUND, simulate_trebbi=StageResult((), complete=False))
    assert "Incomplete: simulate trebbi: partial." in head(page_of(study, part))
    assert not StudyRun(study, part).complete


def test_a_registration_that_is_not_to_be_trusted_heads_the_report(study: Study) -> None:
    folded = StageResult((), (Section("Load2", Verdict("distrust", ("It folds.",))),))
    told = head(page_of(study, ended(study, register_Load1=SOUND, register_Load2=folded)))
    assert told.startswith("Heel Measurement: Do not trust Load2, registration (Do not trust): It folds.")
    # the comparison has the same reason, which is given once
    poor = Verdict("caution", ("The images agree poorly.",))
    doubted = ended(study, register_Load1=StageResult((), (Section("Load1", poor),)), register_Load2=SOUND,
                    compare=StageResult((), (Section("Models", verdict_on({"Load1": poor})),)))  # fmt: skip
    assert head(page_of(study, doubted)).count("The images agree poorly.") == 1
    compared = StageResult((), (Section("Models", Verdict("distrust", ("Its bone moves by 134 mm.",))),))
    told = head(page_of(study, ended(study, register_Load1=SOUND, register_Load2=SOUND, compare=compared)))
    assert told.startswith("Heel Measurement and model files: Do not trust Its bone moves by 134 mm.")
    placed = StageResult((), (Section("Models", Verdict("caution", ("In metres?",))),))
    told = head(page_of(study, ended(study, register_Load1=SOUND, register_Load2=SOUND, compare=placed)))
    assert told.startswith("Heel Measurement and model files: Use with care In metres?")


def test_the_table_of_stages_repeats_neither_reasons_nor_what_sections_tell(study: Study) -> None:
    section = (Section("Load1", Verdict("trust")),)
    registered = StageResult(("Load1: Trust.", "fat 0.131 / 0.425"), section, headline="0.131 median; Trust")
    meshed = StageResult(("35399 tetrahedra", "bone 1200 faces"), headline="35399 tetrahedra")
    why = "Not run: the engine is not installed."
    outcomes = ended(study, register_Load1=registered, mesh=meshed, register_Load2=why, simulate_trebbi=why)
    table = page_of(study, outcomes).split("<h3>Stages</h3>")[1].split("</table>")[0]
    assert table.count(why) == 1
    assert "<td>Same reason as for register Load2.</td>" in table
    assert "0.131 median; Trust" in table
    assert "0.131 / 0.425" not in table
    assert "35399 tetrahedra\nbone 1200 faces" in table  # no section tells it


def test_the_table_of_stages_has_the_headline_and_the_notes_of_a_simulation(study: Study) -> None:
    of_load = "trebbi, Load1: plate displacement 10.30 mm; max. shear, median / 95th percentile: fat 0.131 / 0.425"
    note = "trebbi: Load1: the material of fat is not stable (Drucker) in 2.0 % of its volume."
    simulated = StageResult((of_load, note), headline="plate displacement, mm: Load1 10.3")
    page = page_of(study, ended(study, simulate_trebbi=simulated))
    assert f"plate displacement, mm: Load1 10.3\n{note}<" in page
    assert "0.131 / 0.425" not in page


def test_without_a_verdict_nothing_is_claimed(study: Study) -> None:
    told = head(page_of(study, ended(study, register_Load1="The bone was not found.", register_Load2="Nor here.")))
    assert told.startswith(
        "Heel Incomplete: register Load1: failed (The bone was not found); register Load2: failed (Nor here)."
    )


def test_registrations_alone_have_a_methods_text(study: Study) -> None:
    outcomes = ended(study, register_Load1=SOUND)
    measured(study.out / "registration", "Load1")
    page = page_of(study, outcomes)
    assert "Methods text" in page
    assert "Load1: The loaded image was aligned with the unloaded one rigidly on the bone" in page
    assert "A study of 3 heels." in page
    assert "Tustison NJ" in page
    assert "Models and measurement" not in page
    closing = (Section("Methods text", paragraphs=("All of it.",)),)
    page = page_of(study, ended(study, register_Load1=SOUND, compare=StageResult((), (), closing)))
    assert page.count("<h2>Methods text</h2>") == 1  # that of the comparison tells the registrations too


def test_no_figure_of_the_report_is_a_negative_zero(study: Study) -> None:
    table = Table("Travel", ("load", "mm"), (("Load1", round(-0.001, 2)), ("Load2", -0.25)))
    page = page_of(study, ended(study, register_Load1=StageResult((), (Section("Load1", None, (table,)),))))
    assert ">0</td>" in page
    assert ">-0</td>" not in page
    assert ">-0.25</td>" in page


def test_the_error_of_a_phantom_stays_in_the_report_as_long_as_its_registration_does(study: Study) -> None:
    assert "Measurement error (phantom with known strain)" not in page_of(study, ended(study, register_Load1=SOUND))
    ledger = Ledger(study.out, study.place)
    stages = {stage.name: stage for stage in plan(study)}
    for load in ("Load1", "Load2"):
        (study.out / "registration" / load).mkdir(parents=True)
        ledger.keep(stages[f"register {load}"], "", {}, SOUND, 1.0)
    errors = [TissueError("fat", 10, 0.1, 0.2, 0.0123, 0.002, 0.03, 0.04, 0.05, 0)]
    write_errors(
        study.place / TABLE, {"Load1": errors, "Load2": [replace(errors[0], shear_rmse=0.0456)]}, report(study).outcomes
    )
    report(study)  # what `run --report-only` does
    page = (study.out / "report.html").read_text()
    assert "Measurement error (phantom with known strain)" in page
    assert "0.0123" in page
    assert "0.0456" in page
    ledger.keep(stages["register Load2"], "", {}, SOUND, 1.0)  # made anew: the error of what was before is no longer so
    report(study)
    page = (study.out / "report.html").read_text()
    assert "0.0123" in page
    assert "0.0456" not in page
    assert "Unknown for Load2, registered again since" in page


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (["--report-only", "--force", "mesh"], "--force"),
        (["--report-only", "--only", "mesh"], "--only"),
        (["--report-only", "--dry-run"], "--dry-run"),
        (["--report-only", "--workers", "2"], "--workers"),
        (["--dry-run", "--scheduler", "tcp://node1:8786"], "--scheduler"),
        (["--scheduler", "tcp://node1:8786", "--workers", "4"], "--workers 4"),
    ],
)
def test_options_that_would_do_nothing_are_refused(study: Study, options: list[str], named: str) -> None:
    told = CliRunner().invoke(app, ["run", str(study.place), *options])
    assert isinstance(told.exception, ParameterError)
    assert named in str(told.exception)
    assert not study.out.exists()


def test_a_cohort_refuses_them_too(study: Study, tmp_path: Path) -> None:
    told = CliRunner().invoke(
        app, ["cohort", str(study.place), "--out", str(tmp_path / "all"), "--scheduler", "tcp://n:1", "--workers", "4"]
    )
    assert isinstance(told.exception, ParameterError)


def test_only_what_was_asked_for_decides_the_exit(study: Study) -> None:
    stages = {stage.name: stage for stage in plan(study)}
    ledger = Ledger(study.out, study.place)
    for load in ("Load1", "Load2"):
        stage = stages[f"register {load}"]
        arguments = stage.arguments | {"repeat": []} if stage.perhaps else stage.arguments
        arguments = arguments | {name: [] for name in stage.perhaps}
        made_from = ledger.made_from(stage, arguments)
        (study.out / "registration" / load).mkdir(parents=True)
        ledger.keep(stage, ledger.key(stage, made_from, {}), made_from, SOUND, 1.0)
    told = CliRunner().invoke(app, ["run", str(study.place), "--only", "register"])
    assert told.exit_code == 0, told.output
    assert "Not requested, and without a result: mesh, simulate trebbi, compare." in told.output
    assert run(study, only=["register"]).complete
    with pytest.raises(MrstrainError):
        run(study, only=["registr"])
    assert json.loads((study.out / "provenance.json").read_text())["command"] == "run"
