"""The credibility section: what records tell stands in it, what only a person can tell is not given, none is graded."""

from __future__ import annotations

import json
import re
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dvc import Verdict
from dvc.report.page import Section, Table
from fe import material_set
from mrstrain.comparison.credibility import CODE, COMPARATOR, MESH_DOUBT, Holdings, credibility_section
from mrstrain.comparison.model_facts import ModelFacts, facts_of, used_for_calibration
from mrstrain.measurement.acquisition import NOT_GIVEN
from mrstrain.models.fit import fit
from mrstrain.options.credibility import CredibilityOptions
from tests.mrstrain.comparison.test_methods import driven, levelled, simulated
from tests.mrstrain.models.test_fit import write_curve
from validate import ALL

ROOT = Path(__file__).resolve().parents[3]
CATEGORIES = (
    "Code verification results", "Model calibration evidence", "Bench test validation results",
    "In vivo validation results", "Population-based validation results", "Emergent model behavior",
    "Model plausibility", "Calculation verification and UQ results using simulations of the context of use",
)  # fmt: skip
FACTORS = (
    "Software quality assurance", "Numerical code verification", "Discretization error", "Numerical solver error",
    "Use error", "Model form", "Model inputs", "Test samples", "Test conditions", "Equivalency of input parameters",
    "Output comparison", "Relevance of the quantities of interest",
    "Relevance of the validation activities to the context of use",
)  # fmt: skip
TEXTS = {name: f"Said of {name}" for name in CredibilityOptions.model_fields}
TEXTS |= {"model_influence": "low", "decision_consequence": "high", "model_risk": "medium"}


def simulation(folder: Path, name: str, *, title: str = "", reached: float = 1.0, **step: float) -> Path:
    """The folder of a simulated model, as `simulate` records it."""
    place = simulated(folder, name, {"edge_mm": 2.5}).parent / "simulation.json"
    record = json.loads(place.read_text())
    record["parameters"]["title"] = title or f"Set of {name}"
    if step:
        record["parameters"]["paths"] = [[{"name": "Load1", **step}]]
    record["outcome"] = {"Load1": {"reached": reached}}
    place.write_text(json.dumps(record))
    return place.parent


def comparison(
    *models: str, low: float = 0.5, reasons: tuple[str, ...] = (), inputs: dict[str, tuple[float, float]] | None = None
) -> Any:
    """A comparison of models under one load, each with an area of 1 mL, and u_num and u_input of some."""
    errors = tuple(SimpleNamespace(model=m, u_num=num, u_input=by) for m, (num, by) in (inputs or {}).items())
    areas = tuple(
        SimpleNamespace(model=m, tissue=t, load="all loads", levelled=False, best_ml=1.0, low_ml=low, high_ml=1.5)
        for m in models
        for t in (ALL, "fat", "skin")
    )
    ranking = SimpleNamespace(areas=areas[::3], statements=("Best match over all loads (area metric): trebbi.",))
    verdict = Verdict("caution", reasons) if reasons else Verdict("trust")
    return SimpleNamespace(areas=areas, ranking=ranking, strains=(0.2, 0.5), verdict=verdict, errors=errors)


def held(folders: dict[str, Path], **more: Any) -> Holdings:
    return Holdings(facts_of(folders), {"Load1": Verdict("trust"), "Load2": None}, **more)


def table(section: Section, title: str) -> Table:
    return next(one for one in section.tables if one.title == title)


def rows(section: Section, title: str) -> dict[str, tuple[str, ...]]:
    return {str(row[0]): tuple(map(str, row[1:])) for row in table(section, title).rows}


def test_all_categories_and_factors_stand_there_once_and_nothing_is_graded(tmp_path: Path) -> None:
    section = credibility_section(held({"trebbi": simulation(tmp_path, "trebbi")}, comparison=comparison("trebbi")))
    assert section.verdict is None
    assert section.folded
    assert [str(row[0]) for row in table(section, "Evidence by category").rows] == [
        f"{n}. {name}" for n, name in enumerate(CATEGORIES, start=1)
    ]
    factors = rows(section, "Credibility factors")
    assert tuple(factors) == FACTORS
    assert {level for _, level in factors.values()} == {NOT_GIVEN}
    asked = rows(section, "Question, context of use and model risk")
    assert set(asked.values()) == {(NOT_GIVEN,)}
    assert len(asked) == 7


def test_every_field_of_the_study_file_is_shown(tmp_path: Path) -> None:
    given = CredibilityOptions(**TEXTS)
    section = credibility_section(held({}, given=given))
    shown = "\n".join(str(cell) for one in section.tables for row in one.rows for cell in row)
    for name, text in TEXTS.items():
        assert text in shown, name
    levels = [name for name in TEXTS if name.startswith("level_")]
    assert len(levels) == len(FACTORS)
    assert [level for _, level in rows(section, "Credibility factors").values()] == [TEXTS[name] for name in levels]


def test_what_this_comparison_holds_is_filled_in(tmp_path: Path) -> None:
    folders = {"trebbi": simulation(tmp_path, "trebbi"), "luboz": simulation(tmp_path, "luboz", reached=0.4)}
    folders |= {"ansys": tmp_path / "ansys"}
    section = credibility_section(held(folders, comparison=comparison(*folders), subject="Heel 3"))
    evidence = {name[3:]: told for name, (told,) in rows(section, "Evidence by category").items()}
    assert CODE in evidence["Code verification results"]
    assert "Code verification of ansys: not given." in evidence["Code verification results"]
    vivo = evidence["In vivo validation results"]
    assert vivo.startswith(
        "Verdicts on the registrations: Load1 Trust. Best match over all loads (area metric): trebbi."
    )
    assert "its interval of 95 % coverage: trebbi 1.00 (0.50 to 1.50), luboz 1.00 (0.50 to 1.50), ansys" in vivo
    assert COMPARATOR in vivo
    assert "Mesh convergence: not given (mrstrain converge)" in vivo
    assert MESH_DOUBT in vivo
    assert "reached in part: luboz Load1 40 %" in vivo
    assert (
        "Measurement uncertainty: in the intervals. Input uncertainty: not given. Error of the mesh: not given" in vivo
    )
    assert evidence[CATEGORIES[7]].startswith(NOT_GIVEN)  # what is compared is no context of use
    for name in ("Bench test validation results", "Emergent model behavior"):
        assert evidence[name] == NOT_GIVEN
    assert rows(section, "Applicability") == {
        "Loads": ("Load1 140 N normal, 0 N shear; Load2",), "Tissues": ("fat, skin",),
        "Range of strain": ("max. shear from 0.2 to 0.5",), "Subject": ("Heel 3",),
        "Context of use, and differences": (NOT_GIVEN,),
    }  # fmt: skip
    factors = rows(section, "Credibility factors")
    assert "fat Ogden, mu0 10.54 kPa" in factors["Model form"][0]
    assert "P1, made from the label map, requested edge length 2.5 mm" in factors["Discretization error"][0]
    assert str(section.tables).count("Residual forces at the end of a load") == 1


def test_without_intervals_or_a_comparison_nothing_is_claimed(tmp_path: Path) -> None:
    folders = {"trebbi": simulation(tmp_path, "trebbi")}
    told = str(credibility_section(held(folders, comparison=comparison("trebbi", low=np.nan))).tables)
    assert "trebbi 1.00 (no interval)" in told
    assert "Measurement uncertainty: not given" in told
    section = credibility_section(held(folders))
    assert rows(section, "Credibility factors")["Output comparison"][0] == NOT_GIVEN
    assert "Comparison with models: not given" in str(section.tables)


def test_input_uncertainty_that_is_in_the_intervals_is_told_with_the_models_that_have_it(tmp_path: Path) -> None:
    folders = {name: simulation(tmp_path, name) for name in ("trebbi", "luboz")}
    one = comparison("trebbi", "luboz", inputs={"trebbi": (0.01, 0.02), "luboz": (np.nan, 0.01)})
    told = rows(credibility_section(held(folders, comparison=one)), "Evidence by category")
    (vivo,) = told["4. In vivo validation results"]
    assert "Input uncertainty: in the intervals of trebbi, luboz. Error of the mesh: in the intervals of trebbi" in vivo


def test_mesh_convergence_takes_the_place_of_the_known_doubt(tmp_path: Path) -> None:
    found = "Mesh convergence of trebbi, cells of 3.0, 2.0, 1.5 mm, largest error of the finest mesh: p50 -2.0 %."
    told = str(credibility_section(held({"t": simulation(tmp_path, "t")}, convergence=(found,))).tables)
    assert told.count(found[:-1]) == 1
    assert MESH_DOUBT not in told
    assert "onvergence: not given" not in told


def test_signs_of_other_inputs_are_told_and_those_of_the_measurement_are_not_taken_for_them(tmp_path: Path) -> None:
    folders = {"t": simulation(tmp_path, "t")}
    of_model, of_measurement = "Load1: t: in metres?", "Load1, registration (Use with care): thick slices."
    one = comparison("t", reasons=(of_model, of_measurement))
    (told, _) = rows(credibility_section(held(folders, comparison=one)), "Credibility factors")[FACTORS[9]]
    assert of_model in told
    assert of_measurement not in told
    sound = rows(credibility_section(held(folders, comparison=comparison("t"))), "Credibility factors")[FACTORS[9]]
    assert "no check found another position, unit or frame" in sound[0]


def test_a_sign_that_two_loads_share_is_told_once(tmp_path: Path) -> None:
    one = comparison("t", reasons=("Load1: t seems to be in metres.", "Load2: t seems to be in metres."))
    told = rows(credibility_section(held({"t": simulation(tmp_path, "t")}, comparison=one)), "Credibility factors")
    assert told[FACTORS[9]][0].endswith("Inputs of the models: Load1, Load2: t seems to be in metres.")


def test_what_was_used_for_calibration_is_found(tmp_path: Path) -> None:
    made = fit(write_curve(tmp_path / "heel fat.csv"), "Ogden", out=tmp_path / "fit", test="uniaxial")
    title = material_set(made.out / "material.toml").title
    folders = {
        "mine": simulation(tmp_path, "mine", title=title), "trebbi": simulation(tmp_path, "trebbi"),
        "trebbi-driven": driven(tmp_path, "trebbi-driven", "trebbi").parent,
        "trebbi-levelled": levelled(tmp_path, "trebbi", "bone").parent,
        "moved": simulation(tmp_path, "moved", normal_mm=6.0), "ansys": tmp_path / "ansys",
    }  # fmt: skip
    facts = facts_of(folders)
    assert [one.kind for one in facts] == ["simulated", "simulated", "driven", "levelled", "simulated", "other"]
    found = used_for_calibration(facts)
    assert [(row[0].split(":")[0], row[1]) for row in found] == [
        ("mine", "material parameters"), ("trebbi-driven", "boundary conditions"),
        ("trebbi-levelled", "simulated measurement of the model"), ("Load1", "load"),
    ]  # fmt: skip
    assert "heel fat.csv" in found[0][2]
    assert used_for_calibration(facts_of({"trebbi": folders["trebbi"]})) == []
    section = credibility_section(held(folders, comparison=comparison("trebbi-driven")))
    assert "4 found, listed below" in str(section.tables)
    assert "trebbi-driven with measured boundary conditions 1.00" in str(section.tables)


@pytest.mark.parametrize("content", ["{", "[]", '{"command": "simulate"}', '{"command": "drive", "laws": 3}'])
def test_a_record_that_cannot_be_read_is_a_model_of_which_nothing_is_known(tmp_path: Path, content: str) -> None:
    (tmp_path / "simulation.json").write_text(content)
    assert ModelFacts.read("m", tmp_path) == ModelFacts("m", "other", {})
    assert credibility_section(held({"m": tmp_path})).tables


def test_figures_of_the_code_are_those_of_the_manual() -> None:
    elements = (ROOT / "benchmarks" / "finite-elements.md").read_text()
    orders = re.findall(r"(P1|MINI|P2) (\d\.\d\d) and (\d\.\d\d)", CODE)
    assert [name for name, _, _ in orders] == ["P1", "MINI", "P2"]
    for name, order, gradient in orders:
        assert re.search(rf"\| {name} \| [\w ]+ \| {order} \| {gradient} \|", elements), name
    lines = (ROOT / "README.md").read_text().splitlines()
    plain = next(line for line in lines if line.startswith("| **mrstrain** |")).replace("*", "").split("|")
    labelled = next(line for line in lines if line.startswith("| mrstrain with a label map |")).split("|")
    pairs = re.findall(r"(fat|muscle|skin) (\.\d+) and (\.\d+)", COMPARATOR)
    assert [(p[1], p[2]) for p in pairs] == [(plain[n].strip(), labelled[n].strip()) for n in (2, 3, 4)]
    limits = " ".join((ROOT / "docs" / "limits.md").read_text().split())
    assert MESH_DOUBT.removesuffix(" (Limitations)").split("fat lie")[1] in limits


def test_the_holdings_have_no_field_for_a_grade_of_the_program() -> None:
    assert not [one.name for one in fields(Holdings) if "level" in one.name or "grade" in one.name]
