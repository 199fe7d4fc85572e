"""Every seeded fault finds its place in the sources, and the tests that are to notice it are there."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
FAULTS = tomllib.loads(Path(__file__).with_name("faults.toml").read_text(encoding="utf-8"))["fault"]


@pytest.mark.parametrize("fault", FAULTS, ids=[fault["name"] for fault in FAULTS])
def test_a_fault_finds_its_place_and_its_tests(fault: dict[str, Any]) -> None:
    assert (ROOT / fault["file"]).read_text(encoding="utf-8").count(fault["find"]) == 1
    for test in fault["tests"]:
        file, _, name = test.partition("::")
        assert name.rpartition("::")[2].partition("[")[0] in (ROOT / file).read_text(encoding="utf-8")
