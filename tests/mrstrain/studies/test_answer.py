"""What a study's report says first: measured strain by load and tissue, and the model that is nearest to it."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from dvc.measurement.page import summary_table
from dvc.report.page import LOPSIDED, Banner, Estimate, Section, Table, write_report
from dvc.trust.quality import NoiseFloor
from dvc.trust.regions import RegionRow
from dvc.trust.uncertainty import Interval
from dvc.trust.verdict import Level, Verdict
from mrstrain.measurement.answer import MeasuredBeside, most_strained, told_once
from mrstrain.studies.answer import answer_of
from tests.validate.test_comparison import case, cube, labels, result, sheared
from validate import NOTHING, Area, Comparison, Criteria, compare
from validate.comparison_error import ComparisonError
from validate.tables import Curve

FAT = RegionRow("fat", "max_shear", 10, 1.0, 10, 0.1, 0.0, 0.131, 0.0, 0.3, 0.42, 0.5, 0.6)
BONE = replace(FAT, region="bone", median=0.0, p95=0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Models of half and 1.1 times the shear of Load1; under Load2 nothing is nearer than no deformation."""
    mesh, place = cube(4), tmp_path_factory.mktemp("compared")
    models = [result(name, mesh, sheared(gamma)) for name, gamma in (("half", 0.2), ("near", 0.44))]
    cases = [case(load, sheared(gamma), models) for load, gamma in (("Load1", 0.4), ("Load2", 0.01))]
    compare(cases, labels(), criteria=Criteria((0.05, 0.5))).write(place)
    assert Comparison.read(place).areas
    return place


def section(load: str) -> Section:
    intervals = [Interval("fat", "median", 0.131, 0.132, 0.0301, 0.1391), Interval("fat", "p90", 0.3, 0.3, 0.2, 0.4)]
    return Section(load, summary=summary_table([BONE, FAT, replace(FAT, quantity="jacobian")], intervals))


def test_each_load_and_tissue_has_its_strain_and_its_nearest_model(folder: Path) -> None:
    areas_of = (Table("Area", ("model",), (("near",),)),)
    overview = Section("Models and loads", tables=areas_of, paragraphs=("Best match: near.",))
    first, areas = answer_of(
        [section("Load1"), section("Load2"), Section("Load3")], [overview], Comparison.read(folder)
    )
    (table,), (area,) = first.tables, areas.tables
    assert (first.title, areas.title, area.title) == ("Models and loads", "Areas of all models and loads", "Area")
    assert not first.folded
    assert areas.folded  # one small table is what a reader sees first
    assert first.paragraphs == ("Best match: near.",)
    table = replace(table, rows=tuple(tuple(map(str, row)) for row in table.rows))
    assert table.columns == ("load", "tissue", "median", "95th percentile", "best match")
    assert table.rows == (
        ("Load1", "fat", "0.131 (0.030 to 0.139)", "0.420", "near (half)"),
        ("Load2", "fat", "0.131 (0.030 to 0.139)", "0.420", "–"),
    )


def test_models_that_may_be_as_good_are_in_brackets_and_uninformative_loads_and_tissues_have_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    areas = [
        Area("far", "Load1", "fat", 3.0, 0.3, 3.0, 2.5, 3.5, 0.1),
        Area("second", "Load1", "fat", 1.2, 0.1, 1.2, 1.1, 1.7, 0.1),
        Area("worse than nothing", "Load1", "fat", 1.4, 0.1, 1.4, 1.1, 1.7, 0.1),
        Area("hardly better than nothing", "Load1", "fat", 1.25, 0.1, 1.25, 1.1, 1.7, 0.1),
        Area("best", "Load1", "fat", 1.0, 0.1, 1.0, 0.8, 1.2, 0.1),
        Area(NOTHING, "Load1", "fat", 1.3, 0.1, 1.3, 1.1, 1.7, 0.1),
        Area("best", "Load2", "fat", 0.1, 0.1, 0.1, 0.0, 0.2, 0.1),
        Area("best", "Load3", "fat", 1.0, 0.1, 1.0, 0.8, 1.2, 0.1),
        Area(NOTHING, "Load3", "fat", 0.9, 0.1, 0.9, 0.8, 1.2, 0.1),
        Area("best", "Load4", "fat", 0.1, 0.1, 0.1, 0.0, 0.2, 0.1),
        Area(NOTHING, "Load4", "fat", 0.2, 0.1, 0.2, 0.0, 0.2, 0.1),
    ]
    above = {"Load1": 1.0, "Load2": 1.0, "Load3": 1.0, "Load4": 0.09}  # of 10 mL, above a strain of .2
    curves = [
        Curve(load, "fat", field, np.array([0.0, 0.2, 0.5]), np.array([10.0, above_ml, 0.0]))
        for load, above_ml in above.items()
        for field in ("measured", "best")
    ]
    known = SimpleNamespace(
        areas=areas,
        curves=curves,
        strains=(0.2, 0.5),
        ranking=SimpleNamespace(uninformative=("Load2",)),
        best="best",
        errors=(),
        banner=Banner("Models"),
    )
    compared = [Section("Models and loads")]
    (first,) = answer_of([section(load) for load in above], compared, cast(Comparison, known))
    assert [row[-1] for row in first.tables[0].rows] == ["best (second)", "–", "none", "–"]
    assert "less than 1 % of the tissue exceeds 0.2" in first.tables[0].note
    higher = ComparisonError("best", "Load1", "fat", "p95", 0.5, 0.4, 0.1, np.nan, np.nan, 0.02, 0.02, 0.06, 0.14)
    monkeypatch.setattr(known, "errors", [higher])
    (first,) = answer_of([section("Load1"), section("Load2")], compared, cast(Comparison, known))
    assert first.tables[0].columns[-2:] == ("best against measured, 95th percentile", "best match")
    assert [row[-2:] for row in first.tables[0].rows] == [
        ("0.500 against 0.400 (too high)", "best (second)"),
        ("–", "–"),
    ]
    monkeypatch.setattr(known, "errors", ())
    unknown = [replace(a, low_ml=np.nan, high_ml=np.nan) for a in areas]
    monkeypatch.setattr(known, "areas", unknown)
    (first,) = answer_of([section("Load1")], compared, cast(Comparison, known))
    assert first.tables[0].rows[0][-1] == "best (second)"  # of which nobody knows whether it is as good


def test_the_most_strained_tissue_is_surely_so() -> None:
    fat = Estimate(0.3, (0.2, 0.4)), Estimate(0.419, (0.4, 0.5))
    rows = (
        ("Load1", "muscle", Estimate(0.1, (0.0, 0.2)), Estimate(0.41, (0.405, 0.46))),
        ("Load1", "fat", *fat),
        ("Load2", "tendon", Estimate(0.3, (0.1, 0.4)), Estimate(0.464, (0.180, 0.759))),
        ("Load2", "skin", Estimate(np.nan), Estimate(np.nan)),
    )
    columns = ("load", "tissue", "median", "95th percentile")
    beside = MeasuredBeside({"Load1": "140 N"}, NoiseFloor(0.01, 0.01, 0.0112, 0.0292, 0.1))

    assert most_strained(Table("Measured", columns, rows), beside) == (
        "Maximum shear strain in fat, the most strained tissue, under Load1 (140 N): median 0.300 (0.200 to 0.400), "
        "95th percentile 0.419 (0.400 to 0.500), with 95 % intervals in brackets. The 95th percentile may be as large "
        "in muscle, since the intervals overlap. The noise floor (tissue outside the bone mask, if there "
        "is one) is "
        "0.011 (median) and 0.029 (95th percentile)."
    )
    below_zero = ("Load2", "tendon", fat[0], Estimate(0.5, (-0.45, 0.759)))
    assert "in fat, the most" in most_strained(Table("Measured", columns, (rows[1], below_zero)))
    apart = ("Load1", "muscle", fat[0], Estimate(0.3, (0.2, 0.399)))
    assert "as large" not in most_strained(Table("Measured", columns, (rows[1], apart)))
    unknown = ("Load1", "fat", Estimate(0.3), Estimate(0.41)), rows[0]
    assert "as large" not in most_strained(Table("Measured", columns, unknown))
    alone = most_strained(Table("Measured", columns, (("Load1", "soft tissue", *fat),)))
    assert alone.startswith("Maximum shear strain in soft tissue under Load1: median 0.300")
    alike = {"fat": 0.4195, "skin": 0.4202}  # 0.420 in the table
    without = tuple(("Load1", name, Estimate(0.3), Estimate(high)) for name, high in alike.items())
    plain = most_strained(Table("Measured", columns, without))
    assert plain.startswith("Maximum shear strain in skin, the most strained tissue, under Load1: ")
    assert plain.endswith("median 0.300, 95th percentile 0.420.")
    assert most_strained(Table("Measured", columns, rows[3:])) == most_strained(None) == ""


@pytest.mark.parametrize("level", ["trust", "caution", "distrust", None])
def test_the_most_strained_tissue_is_told_once_in_a_report(level: Level | None, folder: Path, tmp_path: Path) -> None:
    verdict = None if level is None else Verdict(level, ("Checked.",))
    overview = Section("Models and loads", paragraphs=("Best match: near.", "Another."))
    told, sections = told_once(answer_of([section("Load1")], [overview], Comparison.read(folder)), verdict)
    write_report(tmp_path / "report.html", "Heel", verdict, sections, (), {}, answer=told)
    page = (tmp_path / "report.html").read_text()
    strain = "Maximum shear strain in fat under Load1: median 0.131 (0.030 to 0.139), 95th percentile 0.420"
    assert page.count(strain) == 1
    banner = page[page.index("<h1>") : page.index("<details")]
    assert (strain in banner) == (level in ("trust", "caution"))  # a strain that is not to be trusted is not in it
    assert sections[0].paragraphs[-2:] == overview.paragraphs
    assert told_once([], verdict) == ("", [])


def test_the_noise_floor_is_that_of_any_load_and_none_without_a_repeat_scan(tmp_path: Path) -> None:
    floor = NoiseFloor(0.01, 0.01, 0.0112, 0.0292, 0.1)
    for name, told in (("Load1", None), ("Load2", asdict(floor))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "quality.json").write_text(json.dumps({"noise_floor": told}))
    assert MeasuredBeside.of({"gone": tmp_path / "gone", "Load2": tmp_path / "Load2"}).floor == floor
    assert MeasuredBeside.of({"Load1": tmp_path / "Load1"}).floor is None
    assert MeasuredBeside.of({}).floor is None


def test_intervals_are_told_of_only_where_there_are_any(tmp_path: Path) -> None:
    without = Section("Load1", summary=summary_table([BONE, FAT], []))
    notes = [answer_of([one], [], None)[0].tables[0].note for one in (section("Load1"), without)]
    assert ["95 %" in note for note in notes] == [True, False]
    assert [LOPSIDED in note for note in notes] == [True, False]


@pytest.mark.parametrize(
    ("told", "ends"),
    [
        (("", ""), f"{LOPSIDED} No interval is known in fat."),
        (("Far.", "Far."), "Far."),
        (("Far.", ""), "Load1: Far."),
        (("Far.", "Farther."), "Load1: Far. Load2: Farther."),
    ],
)
def test_what_makes_intervals_less_certain_stands_below_them(told: tuple[str, str], ends: str, tmp_path: Path) -> None:
    loads = [replace(section(f"Load{n}"), caveat=caveat) for n, caveat in enumerate(told, start=1)]
    note = answer_of(loads, [], None)[0].tables[0].note
    assert note.endswith(f" {ends}")
    assert note.count("Far.") == ends.count("Far.")


def test_registrations_alone_and_a_comparison_alone_are_shown_too(folder: Path, tmp_path: Path) -> None:
    (first,) = answer_of([section("Load1")], [], None)
    assert first.tables[0].columns == ("load", "tissue", "median", "95th percentile")
    assert "Best match" not in first.tables[0].note
    overview = Section("Models and loads")
    assert answer_of([Section("Load1")], [overview], None) == [overview]
    assert answer_of([], [], None) == []
    (first,) = answer_of([section("Load1")], [overview], None)  # the comparison's tables are not there
    assert first.tables[0].columns == ("load", "tissue", "median", "95th percentile")
