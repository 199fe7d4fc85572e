"""What is no object of the kind that a function takes is refused by the argument's name, with what to pass."""

from __future__ import annotations

import re
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
    "bones": (lambda v: v.compare([CASE], labels(), bones="bone"), r"`bones` .* got 'bone'\. Pass \('bone',\)"),
    "one case": (lambda v: v.compare(CASE, labels()), r"`cases` .* got .* class LoadCase\. Pass \[cases\]"),
    "folder": (lambda v: v.compare("results", labels()), r"`cases` .* got 'results'.*LoadCase\.of"),
    "folders": (lambda v: v.compare([Path("results")], labels()), r"`cases\[0\]` .* got .*results.*LoadCase\.of"),
    "number": (lambda v: v.compare([CASE], labels(), bones=[3]), r"`bones\[0\]` is a str; got .* int\. Pass a name"),
    "label file": (lambda v: v.compare([CASE], "tissues.nii.gz"), r"`labels` .* got 'tissues.*dvc\.read_labels"),
    "label array": (lambda v: v.compare([CASE], np.zeros((2, 2, 2))), r"`labels` .* got .* class ndarray.*read_labels"),
    "mesh": (lambda v: v.compare([CASE], labels(), mesh="heel.vtu"), r"`mesh` .* got 'heel\.vtu'.*fe\.read_tet_mesh"),
    "criteria": (lambda v: v.compare([CASE], labels(), criteria=(0.2, 0.5)), r"`criteria` .* got .* tuple.*Criteria\("),
    "load": (lambda v: v.compare_load("Load1", labels()), r"`case` .* got 'Load1'.*LoadCase\.of"),
    "result file": (lambda v: v.LoadCase.of("a", sheared(0.1), ["a.vtu"]), r"`results\[0\]` .* got 'a\.vtu'.*read_"),
    "one result": (lambda v: v.LoadCase.of("a", sheared(0.1), MODEL), r"`results` .* got .* FeResult\. Pass \[results"),
    "measured": (lambda v: v.LoadCase.of("a", "Load1", [MODEL]), r"`measured` .* got 'Load1'.*read_displacement"),
    "array": (lambda v: v.LoadCase.of("a", np.zeros((4, 3)), [MODEL]), r"`measured` .* got .* class ndarray"),
    "error": (lambda v: v.LoadCase.of("a", sheared(0.1), [MODEL], "e.json"), r"`error` .* got 'e\.json'.*tables"),
    "model": (lambda v: v.FeResult.of("a", MESH), r"`deformation` .* got .* class TetMesh.*simulation\.deformation"),
    "read": (lambda v: v.LoadCase("a", [MODEL]), r"`read` .* got .* class list.*LoadCase\.of"),
    "boundary": (lambda v: v.boundary_displacement("a.vtu", sheared(0.1)), r"`mesh` .* got 'a\.vtu'.*read_tet_mesh"),
    "driven": (lambda v: v.simulate_driven(MESH, {}, "Load1", "Load1"), r"`measured` .* got 'Load1'"),
    "fields": (lambda v: v.map_fields("a", labels(), ["bone"], sheared(0.1), {}), r"`mesh` .* got 'a'"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_another_kind_of_argument_is_refused_with_what_to_pass(name: str) -> None:
    call, words = REFUSED[name]
    with pytest.raises(MrstrainError, match=words):
        call(validate)


def test_a_result_that_reading_gives_is_checked_as_well() -> None:
    wrong = replace(CASE, read=lambda: (sheared(0.4), ["a.vtu"]))  # type: ignore[list-item]
    with pytest.raises(MrstrainError, match=re.escape("`Load1: results[0]` is a FeResult; got 'a.vtu'")):
        validate.compare([wrong], labels())


def test_any_collection_of_names_will_do() -> None:
    bones: Any = np.array(["bone"])
    assert validate.compare([CASE], labels(), bones=bones).coverage_ml.keys() == {"Load1"}
