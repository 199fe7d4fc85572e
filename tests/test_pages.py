"""What a reader meets first: a short README, and a picture at the head of every page that explains something."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
LOOKED_UP = {"api", "reference", "decisions", "glossary.md", "changelog.md", "reliability.md"}  # not read from the top
RECORDS = {"record.md", "gauss-newton.md", "finite-elements.md", "heel-mr.md"}  # stand behind the page of plots
READ = sorted(
    page for page in DOCS.rglob("*.md") if not (LOOKED_UP | RECORDS) & set(page.relative_to(DOCS).parts)
)  # fmt: skip
ABOVE_THE_FOLD = 15  # lines
NOTE_TO_SELF = re.compile(r"\b(TODO|FIXME|TBD|XXX)\b|\((and )?(add|insert|delete|reword)\b|to the glossary\)", re.I)
PICTURE = re.compile(r"^!\[(.*)\]\((.*)\)$", re.MULTILINE)


def prose(text: str) -> list[str]:
    """The lines of a page without its code, tables and pictures."""
    lines = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL).splitlines()
    return [line for line in lines if not line.startswith(("    ", "|", "!["))]


def test_the_readme_is_short() -> None:
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) < 90
    assert len(PICTURE.findall(text)) == 1
    assert max(map(len, prose(text))) <= 118  # all lines are wrapped alike
    (code,) = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert len(re.findall(r"^(?!import)\S", code, re.MULTILINE)) <= 5
    header = next(line for line in text.splitlines() if "muscle" in line and line.startswith("|"))
    assert header.strip("|").count("|") + 1 <= 6


@pytest.mark.parametrize(("page", "words"), [("limits.md", 600), ("verdicts.md", 880)])  # under four minutes
def test_what_to_read_first_is_read_in_minutes(page: str, words: int) -> None:
    text = re.sub(r"!\[.*?\]\(.*?\)|\]\([^)]*\)", "", (DOCS / page).read_text())
    assert len(re.findall(r"\S*\w\S*", text)) <= words


@pytest.mark.parametrize("page", READ, ids=lambda page: str(page.relative_to(DOCS)))
def test_a_page_begins_with_a_picture(page: Path) -> None:
    head = "\n".join(page.read_text().splitlines()[:ABOVE_THE_FOLD])
    assert PICTURE.search(head)


def test_every_picture_says_what_it_shows() -> None:
    pages = [ROOT / "README.md", *DOCS.rglob("*.md")]
    told = [(page.name, words) for page in pages for words, _ in PICTURE.findall(page.read_text())]
    assert len(told) > 40
    assert not [one for one in told if len(one[1].split()) < 3]


@pytest.mark.parametrize("page", [ROOT / "README.md", *READ, *sorted((DOCS / "reference").glob("*.md"))])
def test_files_shown_on_a_page_can_be_read_and_lines_are_wrapped_alike(page: Path) -> None:
    text = page.read_text()
    for language, block in re.findall(r"^```(toml|json)\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        assert {"toml": tomllib.loads, "json": json.loads}[language](block), block
    links = re.compile(r"\]\([^)]*\)")  # a long address cannot be wrapped
    assert not [line for line in prose(text) if len(links.sub("]()", line)) > 120]


def test_no_page_keeps_a_note_of_its_writer() -> None:
    assert NOTE_TO_SELF.search("a truth (and add 'drawn truth: a sample' to the glossary)")
    pages = [ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS.rglob("*.md"), *(ROOT / "benchmarks").rglob("*.md")]
    notes = [(page.name, found[0]) for page in pages for found in NOTE_TO_SELF.finditer(page.read_text())]
    assert not notes, notes


def test_the_page_of_commands_lists_them_all() -> None:
    from typer.main import get_command

    from mrstrain.cli.app import app

    listed = re.findall(r"`mrstrain ([a-z]+)", (DOCS / "reference" / "commands.md").read_text())
    assert set(listed) == set(get_command(app).commands)  # type: ignore[attr-defined]
