"""What people read says one thing by one name: no expression of the glossary's last column is used."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
GLOSSARY = ROOT / "docs" / "glossary.md"
PACKAGES = ("dvc", "fe", "validate", "phantoms", "mrstrain")
QUOTED = re.compile(r"`[^`]*`|\"[^\"]*\"")  # names as they were, in the changelog
NOT_FOR_USERS = {"decisions", "api"}  # a record of its time; made from docstrings


def forbidden() -> list[str]:
    """The expressions of the last column of the glossary's tables."""
    rows = [line.strip("| \n").split("|") for line in GLOSSARY.read_text().splitlines() if line.startswith("|")]
    lines = [row[-1].strip() for row in rows if len(row) == 3 and row[0].strip() != "term"]
    return [words.strip() for line in lines for words in line.split(",") if words.strip(" -")]


@cache
def pages() -> list[tuple[str, str]]:
    folders = (ROOT / "docs", ROOT / "benchmarks")
    paths = [ROOT / "README.md", *(page for folder in folders for page in sorted(folder.rglob("*.md")))]
    read = [path for path in paths if path != GLOSSARY and not NOT_FOR_USERS & set(path.parts)]
    changelog = QUOTED.sub("", (ROOT / "CHANGELOG.md").read_text())
    return [("CHANGELOG.md", changelog), *((str(path.relative_to(ROOT)), path.read_text()) for path in read)]


@cache
def strings() -> list[tuple[str, str]]:
    """Every string of the code, docstrings and messages alike, and the templates of pages and files."""
    texts = []
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    texts.append((f"{path.relative_to(ROOT)}:{node.lineno}", node.value))
        for path in sorted(p for ending in ("j2", "toml") for p in (ROOT / package).rglob(f"*.{ending}")):
            texts.append((str(path.relative_to(ROOT)), path.read_text()))
    return texts


def found(words: str, texts: Iterable[tuple[str, str]]) -> list[str]:
    """Where an expression stands, in any case and across line ends."""
    pattern = re.compile(r"\b" + r"\s+".join(map(re.escape, words.split())) + r"\b", re.IGNORECASE)
    return [f"{place}: {match[0]!r}" for place, text in texts for match in pattern.finditer(text)]


def test_the_glossary_has_its_forbidden_twins() -> None:
    assert {"shading", "told apart", "maximal shear"} <= set(forbidden())
    assert found("told apart", [("here", "A is told\n    apart from B")]) == ["here: 'told\\n    apart'"]
    assert not found("travel", [("here", "travelling")])


@pytest.mark.parametrize("words", forbidden())
def test_no_page_uses_another_name(words: str) -> None:
    assert not found(words, pages())


@pytest.mark.parametrize("words", forbidden())
def test_no_message_or_docstring_uses_another_name(words: str) -> None:
    assert not found(words, strings())
