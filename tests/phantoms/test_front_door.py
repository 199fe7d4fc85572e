"""`import phantoms` offers all that others need of it, and they take it from there."""

from __future__ import annotations

import ast
import inspect
from pathlib import Path

import pytest
from sybil import Sybil
from sybil.parsers.markdown import PythonCodeBlockParser

import phantoms

ROOT = Path(__file__).resolve().parents[2]
OUTSIDE = [
    path
    for folder in ("mrstrain", "validate", "fe", "dvc", "tests", "benchmarks")
    for path in sorted((ROOT / folder).rglob("*.py"))
]


@pytest.mark.parametrize("name", phantoms.__all__)
def test_every_name_is_there_and_described(name: str) -> None:
    value = getattr(phantoms, name)
    if inspect.isfunction(value) or inspect.isclass(value) or inspect.ismodule(value):
        assert inspect.getdoc(value)


def test_other_names_are_refused() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Hoof'"):
        phantoms.Hoof  # noqa: B018


def test_nobody_passes_by_the_front_door() -> None:
    past = [
        (path.relative_to(ROOT).as_posix(), alias.name)
        for path in OUTSIDE
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("phantoms.")
        for alias in node.names
        if alias.name in phantoms.__all__
    ]
    assert past == []


def test_the_page_does_what_it_says() -> None:
    examples = list(Sybil(parsers=[PythonCodeBlockParser()]).parse(ROOT / "docs" / "python" / "phantoms.md").examples())
    assert any("assert" in example.parsed for example in examples)
    for example in examples:
        example.evaluate()
