"""The page on reliability claims nothing without a test: those that it names are there, and each claim names one."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
SHOWN = re.compile(r"`(?:tests/[\w/]+\.py|benchmarks/\w+\.py|make [\w-]+)`")


def test_tests_that_the_page_names_are_there() -> None:
    named = set(re.findall(r"(?:tests|benchmarks)/[\w/]+\.py", PAGE))
    assert len(named) > 30
    assert not [name for name in sorted(named) if not (ROOT / name).is_file()]


def test_commands_that_the_page_names_are_there() -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    named = set(re.findall(r"`(?:\w+=\w+ )?make ([\w-]+)`", PAGE))
    assert named
    assert named <= set(targets)


def test_every_claim_names_what_shows_it() -> None:
    """A claim is a row of a table or a point of a list, but for what is not tried."""
    claims, _, untried = PAGE.partition("## Not tested")
    assert untried
    rows = [
        row for row in re.findall(r"^\|.*\|$", claims, re.MULTILINE) if not re.match(r"\|(-|.*\| what happens \|)", row)
    ]
    points = re.findall(r"^- .*(?:\n  .*)*", claims, re.MULTILINE)
    assert len(rows) > 30
    assert len(points) > 10
    assert not [claim for claim in (*rows, *points) if not SHOWN.search(claim)]


def test_every_seeded_fault_finds_its_line() -> None:
    listed = tomllib.loads((ROOT / "tests" / "faults" / "faults.toml").read_text())["fault"]
    assert len(listed) > 40
    assert not [fault["name"] for fault in listed if (ROOT / fault["file"]).read_text().count(fault["find"]) != 1]
