"""The page on reliability claims nothing without a test: those that it names are there."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_tests_that_the_page_names_are_there() -> None:
    named = set(re.findall(r"tests/[\w/]+\.py", (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")))
    assert len(named) > 30
    assert not [name for name in sorted(named) if not (ROOT / name).is_file()]
