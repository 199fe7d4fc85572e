"""What is recorded of the study with a hidden law: models in their true order, or their order called noise."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.hidden_law import misjudged

RECORD = Path(__file__).parents[1] / "benchmarks" / "results" / "hidden_law.json"


def test_recorded_order_is_the_true_one_or_called_noise() -> None:
    found = json.loads(RECORD.read_text(encoding="utf-8"))
    assert misjudged(found) == []
    # under the small load the measured order is not the true one, and saying nothing of noise would be wrong
    bold = found | {"not_told_apart": {load: [] for load in found["not_told_apart"]}}
    assert misjudged(bold) == [f"Load4: trebbi before {name}" for name in ("zwam", "erdemir", "akrami")]


def test_every_recorded_interval_holds_the_true_area() -> None:
    found = json.loads(RECORD.read_text(encoding="utf-8"))
    held = [
        found["measured_area_ml"][load][model][2] <= area <= found["measured_area_ml"][load][model][3]
        for load, of in found["true_area_ml"].items()
        for model, area in of.items()
    ]
    assert len(held) == 25
    assert all(held)


@pytest.mark.parametrize("pair", [("near", "far"), ("far", "near")])
def test_a_wrong_order_that_is_not_called_noise_is_found(pair: tuple[str, str]) -> None:
    found = {
        "true_area_ml": {"Load1": {"near": 1.0, "far": 2.0}},
        "measured_area_ml": {"Load1": {pair[0]: [0.0, 1.0], pair[1]: [0.0, 2.0]}},
        "not_told_apart": {"Load1": []},
    }
    assert misjudged(found) == ([] if pair[0] == "near" else ["Load1: far before near"])
    assert misjudged(found | {"not_told_apart": {"Load1": [list(pair)]}}) == []
