"""What is no object of the kind that a function takes is refused by the argument's name, with what to pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import validate
from dvc.errors import MrstrainError
from tests.validate.test_comparison import case, cube, labels, result, sheared

MESH = cube(2)
MODEL = result("a", MESH, sheared(0.2))
CASE = case("Load1", sheared(0.4), [MODEL], None)

REFUSED: dict[str, tuple[Callable[[Any], object], str]] = {
    "bones": (lambda v: v.compare([CASE], labels(), bones="bone"), "bones must be a list.*text.*; got 'bone'"),
    "number": (lambda v: v.compare([CASE], labels(), bones=[3]), r"bones\[0\] must be text \(str\); got 3"),
    "one case": (lambda v: v.compare(CASE, labels()), "cases must be a list.*LoadCase.*; got LoadCase"),
    "folder": (lambda v: v.compare("results", labels()), r"cases must be a list.*LoadCase\.of.*; got 'results'"),
    "folders": (lambda v: v.compare([Path("results")], labels()), r"cases\[0\] must .*LoadCase\.of.*; got .*results"),
    "label file": (lambda v: v.compare([CASE], "tissues.nii"), r"labels must .*dvc\.read_labels.*; got 'tissues\.nii'"),
    "label array": (lambda v: v.compare([CASE], np.zeros((2, 3, 4))), r"labels must .*; got ndarray of shape \(2, 3"),
    "mesh": (lambda v: v.compare([CASE], labels(), mesh="a.vtu"), r"mesh must .*fe\.read_tet_mesh.*; got 'a\.vtu'"),
    "criteria": (lambda v: v.compare([CASE], labels(), criteria=(0.2, 0.5)), r"criteria must .*Criteria.*; got tuple"),
    "load": (lambda v: v.compare_load("Load1", labels()), r"case must .*LoadCase\.of.*; got 'Load1'"),
    "file": (lambda v: v.LoadCase.of("a", sheared(0.1), ["a.vtu"]), r"results\[0\] must .*read_result.*; got 'a\.vtu'"),
    "one result": (lambda v: v.LoadCase.of("a", sheared(0.1), MODEL), "results must be a list.*; got FeResult"),
    "measured": (lambda v: v.LoadCase.of("a", "Load1", [MODEL]), "measured must .*read_displacement.*; got 'Load1'"),
    "array": (lambda v: v.LoadCase.of("a", np.zeros((4, 3)), [MODEL]), "measured must .*; got ndarray"),
    "error": (lambda v: v.LoadCase.of("a", sheared(0.1), [MODEL], "e.json"), r"error must .*tables; got 'e\.json'"),
    "model": (lambda v: v.FeResult.of("a", MESH), r"deformation must .*simulation\.deformation.*; got TetMesh"),
    "read": (lambda v: v.LoadCase("a", [MODEL]), "read must be a function; got list"),
    "boundary": (lambda v: v.boundary_displacement("a.vtu", sheared(0.1)), r"mesh must .*tet_mesh.*; got 'a\.vtu'"),
    "driven": (lambda v: v.simulate_driven(MESH, {}, "Load1", "Load1"), "measured must .*; got 'Load1'"),
    "fields": (lambda v: v.map_fields("a", labels(), ["bone"], sheared(0.1), {}), "mesh must .*; got 'a'"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_another_kind_of_argument_is_refused_with_what_to_pass(name: str) -> None:
    call, words = REFUSED[name]
    with pytest.raises(MrstrainError, match=words):
        call(validate)


def test_a_result_that_reading_gives_is_checked_as_well() -> None:
    wrong = replace(CASE, read=lambda: (sheared(0.4), ["a.vtu"]))  # type: ignore[list-item]
    with pytest.raises(MrstrainError, match=r"Load1: results\[0\] must be a validate\.FeResult.*; got 'a\.vtu'"):
        validate.compare([wrong], labels())


def test_two_models_and_two_loads_have_names_of_their_own() -> None:
    other = result("a", MESH, sheared(0.9))
    twice = validate.LoadCase.of("Load1", sheared(0.4), [MODEL, other])
    with pytest.raises(MrstrainError, match="Load1: two models are named 'a'"):
        validate.compare([twice], labels())
    with pytest.raises(MrstrainError, match="Two loads are named 'Load1'"):
        validate.compare([CASE, CASE], labels())
    alike = validate.LoadCase.of("Load1", sheared(0.4), [MODEL, replace(MODEL, name="A")])
    with pytest.raises(MrstrainError, match="Load1: two models are named 'a' and 'A'"):
        validate.compare([alike], labels())
    with pytest.raises(MrstrainError, match="Two loads are named 'Load1' and 'load1'"):
        validate.compare([CASE, replace(CASE, load="load1")], labels())
    with pytest.raises(MrstrainError, match="two models are named 'no deformation'"):
        validate.compare_load(
            validate.LoadCase.of("a", sheared(0.4), [replace(MODEL, name="no deformation")]), labels()
        )


def test_any_collection_of_names_will_do() -> None:
    bones: Any = np.array(["bone"])
    assert validate.compare([CASE], labels(), bones=bones).coverage_ml.keys() == {"Load1"}
