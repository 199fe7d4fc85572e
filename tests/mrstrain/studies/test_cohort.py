"""A cohort of finished studies: one table, one report, and the doubts about its measurements."""

from __future__ import annotations

import csv
import re
import shutil

import pytest

from dvc.errors import InputError
from mrstrain.studies.cohort import _areas, cohort
from mrstrain.studies.ledger import StageRecord
from tests.mrstrain.studies.test_run import change
from validate import ALL


def test_a_cohort_of_finished_studies_is_one_table_and_one_report(done, tmp_path):
    folder, *_ = done
    places = []
    for name in ("Ada", "Ben"):
        places.append(tmp_path / name)
        shutil.copytree(folder, places[-1])
        change(places[-1], ("Heel <b>3</b>", name))
    told = cohort(places, out=tmp_path / "cohort")
    assert all(o.reused for one in told.ran for o in one.outcomes.values())
    (first,) = told.ranking
    assert (first.model, first.subjects, first.best_in) == ("akrami", 2, 2)
    with (folder / "results" / "comparison" / "areas.csv").open() as file:
        shares = [float(r["share"]) for r in csv.DictReader(file) if r["load"] == "all loads"]
    assert first.mean == pytest.approx(shares[0], rel=1e-5)
    assert first.high - first.low == pytest.approx(0.0, abs=1e-12)  # one subject twice
    with (tmp_path / "cohort" / "cohort.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {r["subject"] for r in rows} == {"Ada", "Ben"}
    assert not any("Do not trust" in note for note in told.notes)
    page = (tmp_path / "cohort" / "report.html").read_text()
    assert "Ada" in page
    assert "Ben" in page
    ledger = places[1] / "results" / ".study" / "register Load1.json"
    doubted = re.sub(r'"level":"(trust|caution)"', '"level":"distrust"', ledger.read_text())
    ledger.write_text(StageRecord.model_validate_json(doubted).sealed().model_dump_json())
    doubtful = [note for note in cohort(places, out=tmp_path / "cohort").notes if "Do not trust" in note]
    assert [note.split(";")[0] for note in doubtful] == [
        "Ben: the registration of Load1 has the verdict 'Do not trust'"
    ]
    with pytest.raises(InputError, match="different names"):
        cohort([places[0], places[0]], out=tmp_path / "cohort")


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda text: text.replace("akrami", '"akrami', 1), "unexpected end of data"),
        (lambda text: text.replace("share", "shore", 1), "'share'"),
        (lambda text: text[: text.rindex(",")], "cells, but the header has"),
        (lambda text: re.sub(r"\d\.\d+", "1.2.3", text), "could not convert"),
    ],
)
def test_a_damaged_table_of_areas_is_named(tmp_path, damage, why):
    place = tmp_path / "comparison" / "areas.csv"
    place.parent.mkdir()
    table = f"model,load,tissue,ml,share,estimate_ml\nakrami,Load1,{ALL},1.5,0.1,nan\nakrami,Load2,{ALL},1.5,0.1,nan\n"
    place.write_text(table)
    assert [row["load"] for row in _areas(tmp_path)] == ["Load1", "Load2"]
    place.write_text(damage(table))
    with pytest.raises(InputError, match=rf"areas\.csv: .* is damaged \(.*{why}.*\). Compare again: mrstrain run"):
        _areas(tmp_path)
