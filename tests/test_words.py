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
CODE = re.compile(r"`[^`]*`|sets\s*=|(?:\[models\] |\{\{? ?|[-.\"'])sets\b")  # the name in code
SETS = re.compile(r"(?<!material )(?<!surface )(?<!node )(?<!element )\bsets\b(?! of| up)", re.IGNORECASE)
TIGHT_PERCENT = re.compile(r"(?<!:)\b\d+%(?!\d)")  # not the width of a style


def entries() -> list[dict[str, str]]:
    """The rows of the glossary's tables by their columns; the last of each table is "not"."""
    rows, columns = [], []
    for line in GLOSSARY.read_text().splitlines():
        cells = [cell.strip() for cell in line.removeprefix("|").removesuffix("|").split("|")]
        if cells[0] == "term":
            columns = cells
        elif line.startswith("|") and cells[0].strip("-"):
            rows.append(dict(zip(columns, cells, strict=True)))
    return rows


def forbidden() -> list[str]:
    """The expressions of the column "not" of the glossary's tables."""
    return [words.strip() for row in entries() for words in row["not"].split(",") if words.strip()]


@cache
def pages() -> list[tuple[str, str]]:
    folders = (ROOT / "docs", ROOT / "benchmarks")
    paths = [ROOT / "README.md", *(page for folder in folders for page in sorted(folder.rglob("*.md")))]
    read = [path for path in paths if path != GLOSSARY]
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


def sets_alone(texts: Iterable[tuple[str, str]]) -> list[str]:
    """Where "sets" stands without the word that says of what: material, surface, node, element, or "sets of"."""
    prose = [(place, " ".join(CODE.sub("", text).split())) for place, text in texts if text != "sets"]
    return [
        f"{place}: {text[max(at.start() - 30, 0) : at.end()]!r}" for place, text in prose for at in SETS.finditer(text)
    ]


def test_the_glossary_has_its_forbidden_twins() -> None:
    assert {"shading", "told apart", "maximal shear"} <= set(forbidden())
    assert {"confidence interval", "how accurate", "how sure", "error margin"} <= set(forbidden())
    assert found("told apart", [("here", "A is told\n    apart from B")]) == ["here: 'told\\n    apart'"]
    assert not found("travel", [("here", "travelling")])
    assert len(sets_alone([("here", "The published sets, of\nwhich three sets need care; all sets")])) == 3
    assert not sets_alone([("here", "material\n  sets and surface sets, `sets`, sets = [], a.sets; sets of nodes")])


def test_terms_of_measurement_quality_are_those_of_the_vim_and_say_where_they_are_used() -> None:
    of_vim = {row["term"]: row for row in entries() if "VIM" in row}
    numbers = {
        "measurand": "2.3", "accuracy": "2.13", "trueness": "2.14", "precision": "2.15", "measurement error": "2.16",
        "bias": "2.18", "repeatability": "2.21", "reproducibility": "2.25", "measurement uncertainty": "2.26",
        "standard uncertainty": "2.30", "expanded uncertainty": "2.35", "coverage interval": "2.36", "coverage": "2.37",
        "calibration": "2.39", "resolution": "4.14",
    }  # fmt: skip
    assert {term: row["VIM"] for term, row in of_vim.items()} == numbers
    assert "k = 2" in of_vim["expanded uncertainty"]["meaning"]
    for term, row in of_vim.items():
        assert len(row["meaning"]) > 20, term
        assert len(row["in mrstrain"]) > 20, term


@pytest.mark.parametrize("place", ["mrstrain/measurement/answer.py", "dvc/measurement/page.py", "validate/report.py"])
def test_reports_say_what_their_intervals_are(place: str) -> None:
    assert "95 % coverage" in (ROOT / place).read_text()


@pytest.mark.parametrize("words", forbidden())
def test_no_page_uses_another_name(words: str) -> None:
    assert not found(words, pages())


@pytest.mark.parametrize("words", forbidden())
def test_no_message_or_docstring_uses_another_name(words: str) -> None:
    assert not found(words, strings())


def test_sets_are_named_by_their_kind() -> None:
    assert not sets_alone([*pages(), *strings()])


def percent_formats(code: str) -> list[int]:
    """Lines of the f-strings that format as Python does, without a space: ``{share:.0%}``."""
    specs = (n.format_spec for n in ast.walk(ast.parse(code)) if isinstance(n, ast.FormattedValue) and n.format_spec)
    return [spec.lineno for spec in specs if ast.unparse(spec).rstrip("'\"").endswith("%")]


def test_percent_stands_after_a_space() -> None:
    texts = [*pages(), *strings()]
    assert [f"{place}: {match[0]!r}" for place, text in texts for match in TIGHT_PERCENT.finditer(text)] == []
    assert percent_formats('f"{share:.0%} and {100 * share:.0f} %"') == [1]
    for folder in (*PACKAGES, "docs/gallery"):
        for path in (ROOT / folder).rglob("*.py"):
            assert percent_formats(path.read_text()) == [], path
