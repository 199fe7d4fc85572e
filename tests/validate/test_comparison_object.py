"""A comparison as an object: written and read back, in a notebook, and as plots; and the package's front door."""

from __future__ import annotations

import base64
import re
from dataclasses import astuple, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import validate
from dvc.own_files import read_rows
from dvc.report.page import shown
from dvc.trust.error_model import ErrorTable
from dvc.trust.verdict import Verdict
from dvc.worker import side_by_side
from tests.validate.test_comparison import case, cube, error_table, labels, max_shear, result, sheared
from validate import ALL, Comparison, Criteria, InputError, compare, compare_load
from validate.agreement import Agreement, over_loads, regression_told
from validate.ranking import rank_over_loads
from validate.report import area_rows, load_sections, overview
from validate.tables import columns_of, read_curves, remove_earlier

ROWS = ("areas", "overlaps", "agreements", "skin", "representations", "model_forms")
GAMMAS = {"half": 0.2, "double": 0.8}


@pytest.fixture(scope="module")
def comparison() -> Comparison:
    """Shear of two loads, and two models of uniform strain under both."""
    mesh = cube(4)
    models = [result(name, mesh, sheared(gamma)) for name, gamma in GAMMAS.items()]
    cases = [case(load, sheared(gamma), models, error_table(0.0, 0.01)) for load, gamma in
             (("Load1", 0.45), ("Load2", 0.5))]  # fmt: skip
    cases[1] = replace(cases[1], verdict=Verdict("caution", ("The images agree poorly.",)))
    return compare(cases, labels(), criteria=Criteria((0.05, 0.5)), notes=["half is linear."])


@pytest.fixture(scope="module")
def folder(comparison: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("compared")
    comparison.write(place, on_image=True)
    return place


@pytest.mark.full_size
@pytest.mark.usefixtures("real_pictures")  # as in processes of their own; with all tests, those of the folder too
def test_loads_compared_in_processes_give_the_same_to_the_bit(comparison: Comparison, folder: Path, tmp_path) -> None:
    with side_by_side("comparing", 2) as each:
        cases, by = [one.case for one in comparison.loads], comparison.loads[0].criteria
        again = compare(cases, labels(), criteria=by, notes=["half is linear."], each=each)
        again.write(tmp_path / "again", on_image=True, each=each)
    for rows in ROWS:
        assert repr(getattr(again, rows)) == repr(getattr(comparison, rows))
    assert again.loads[0].labels is again.loads[1].labels
    written = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    assert len(written) > 20
    for name in written:
        assert (tmp_path / "again" / name).read_bytes() == (folder / name).read_bytes(), name


def test_what_is_read_back_is_what_was_written(comparison: Comparison, folder: Path) -> None:
    back = Comparison.read(folder)
    for rows in ROWS:
        ours, theirs = getattr(comparison, rows), getattr(back, rows)
        assert len(ours) == len(theirs) > 0
        for one, other in zip(ours, theirs, strict=True):
            assert type(one) is type(other)
            for value, again in zip(astuple(one), astuple(other), strict=True):
                near = pytest.approx(value, rel=1e-5, abs=1e-12, nan_ok=True) if isinstance(value, float) else value
                assert again == near, (rows, one)
                assert type(again) in (type(value), float)
    for curve, again in zip(comparison.curves, back.curves, strict=True):
        assert (curve.load, curve.tissue, curve.field) == (again.load, again.tissue, again.field)
        assert again.max_shear == pytest.approx(curve.max_shear, rel=1e-5)
        assert again.volume_above_ml == pytest.approx(curve.volume_above_ml, rel=1e-5)
    assert back.ranking.statements == comparison.ranking.statements
    assert back.ranking.not_distinguishable == comparison.ranking.not_distinguishable
    assert [a.model for a in back.ranking.areas] == [a.model for a in comparison.ranking.areas]
    for same in ("strains", "coverage_ml", "verdict", "verdicts", "notes"):
        assert getattr(back, same) == getattr(comparison, same), same
    assert str(back) == str(comparison)
    assert str(back).startswith(
        "Measurement and model files: Use with care\n"
        "Load1: area between strain-volume curves (max. shear 0.05 to 0.5), mL, best first: "
    )
    assert "half is linear." in str(back)
    assert back._repr_html_().partition("<img")[0] == comparison._repr_html_().partition("<img")[0]
    with pytest.raises(InputError, match="copy its folder"):
        back.write(folder)
    assert (folder / "Load2" / "double_max_shear.nii.gz").is_file()


def test_a_folder_without_a_comparison_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"areas\.csv: the table of the comparison cannot be read"):
        Comparison.read(tmp_path)
    for path in folder.glob("*.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    Comparison.read(tmp_path)
    (tmp_path / "comparison.json").write_text('{"parameters": {}}')
    with pytest.raises(InputError, match=r"comparison\.json is not a valid record of a comparison"):
        Comparison.read(tmp_path)
    (tmp_path / "location.csv").write_text("model,load\na,Load1\n")
    with pytest.raises(InputError, match=r"location\.csv has no column threshold"):
        Comparison.read(tmp_path)
    whole = (folder / "curves.csv").read_text()
    for damage in ('"', "1,2\n"):
        (tmp_path / "curves.csv").write_text(whole + damage)
        with pytest.raises(InputError, match=r"curves\.csv: the table of the comparison cannot be read .*Compare"):
            read_curves(tmp_path)
    (tmp_path / "curves.csv").write_text(re.sub(r"(\d)\.(\d)", r"\1..\2", whole))
    with pytest.raises(InputError, match=r"curves\.csv: the table of the comparison is damaged .* Compare again"):
        read_curves(tmp_path)


def test_the_curves_of_a_figure_stand_beside_it(comparison: Comparison, folder: Path) -> None:
    every = columns_of(comparison.curves)
    for beside, of_figure in (("curves_by_load", {"tissue": ALL}), ("Load2/curves", {"load": "Load2"})):
        assert (folder / f"{beside}.pdf").is_file()
        (key, value), rows = *of_figure.items(), read_rows(folder / f"{beside}.csv")
        shown = [number for number, at in enumerate(every[key]) if at == value]
        assert [(row["load"], row["tissue"], row["field"]) for row in rows] == [
            (every["load"][n], every["tissue"][n], every["field"][n]) for n in shown
        ]
        for name in ("max_shear", "volume_above_ml"):
            found = [float(row[name]) for row in rows]
            assert found == pytest.approx([every[name][n] for n in shown], rel=1e-5), beside


def test_a_report_says_what_unnamed_tissue_is(comparison: Comparison) -> None:
    mesh, said = cube(4), "unnamed: tissue of the mesh whose name is not in the label map"
    aside = replace(labels(), labels=np.where(labels().labels == 2, 0, labels().labels))
    bare = replace(mesh, regions={"part": np.arange(len(mesh.cells))})
    one = case("Load1", sheared(0.45), [result("half", bare, sheared(0.2))], error_table(0.0, 0.01))
    (table, *_), (named, *_) = (load_sections(of, {"a": None, "b": None}, None)[0].tables for of in
                                (compare_load(one, aside), comparison.loads[0]))  # fmt: skip
    assert "unnamed" in [row[1] for row in table.rows]
    assert said in table.note
    assert said not in named.note


def test_an_older_comparison_has_another_name_of_a_table(folder: Path, tmp_path: Path) -> None:
    for path in folder.glob("*.*"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "skin_displacement.csv").rename(tmp_path / "travel.csv")
    assert Comparison.read(tmp_path).skin == Comparison.read(folder).skin != ()
    remove_earlier(tmp_path, [])
    assert not (tmp_path / "travel.csv").exists()


def test_a_notebook_shows_the_answer_the_areas_and_the_curves(comparison: Comparison) -> None:
    page = comparison._repr_html_()
    assert comparison.ranking.statements[0] in page
    assert "Use with care" in page
    best = comparison.ranking.areas[0]
    (row,) = re.findall(rf"<tr><td[^>]*>{best.model}</td>(.*?)</tr>", page)
    cells = re.findall("<td[^>]*>(.*?)</td>", row)
    assert cells[0] == "1"
    assert cells[1] == f"{best.best_ml:.2f} ({best.low_ml:.2f} to {best.high_ml:.2f})"
    assert len(cells) == 4
    image = re.search(r'src="data:image/png;base64,([^"]+)"', page)
    assert image is not None
    assert base64.b64decode(image[1]).startswith(b"\x89PNG")


def test_the_headline_is_the_best_match_or_the_area_of_the_best(comparison: Comparison) -> None:
    best_match = next(line for line in comparison.ranking.statements if line.startswith("Best match"))
    doubt = "Load2: less than 1 % of it is strained, so the area metric is not informative."
    ranking = replace(comparison.ranking, statements=(doubt, best_match))
    assert comparison.headline == replace(comparison, ranking=ranking).headline == best_match
    without = replace(comparison, ranking=replace(comparison.ranking, statements=(doubt,)))
    over = "area between strain-volume curves (max. shear 0.05 to 0.5) "
    assert without.headline.startswith(f"{comparison.ranking.areas[0].model}: {over}")


def test_slope_and_r2_of_the_best_match_are_told_at_once(comparison: Comparison, folder: Path) -> None:
    best = comparison.ranking.areas[0].model
    rows = [a for a in comparison.agreements if (a.model, a.quantity, a.part) == (best, "u_mm", ALL)]
    each = ", ".join(f"{a.slope:.2f} ({a.r2:.2f}) under {a.load}" for a in rows)
    told = f"Cell-by-cell regression of {best} (best by area) on the measurement, slope (R²): displacement {each}"
    assert len({a.slope for a in rows} | {a.r2 for a in rows}) > 1
    page, summary = (folder / "report.html").read_text(), comparison.summary()
    first = summary.index(comparison.ranking.statements[0])
    assert summary[first + 1].startswith(told)
    assert "Slope and R² are 1 if the fields are equal; R² is near 0" in summary[first + 1]
    banner, regression = page.index(comparison.ranking.statements[0]), page.index(told)
    assert banner < page.index("<figure") < regression < page.index("<table")
    table = re.search(r"<thead>.*?</tfoot>", page, re.DOTALL)
    assert table is not None
    assert re.search(r">slope</th><th[^>]*>R²</th></tr></thead>", table[0])


def test_each_load_has_its_slope_and_uniform_fields_have_none() -> None:
    def row(load: str, quantity: str, slope: float, r2: float, part: str = ALL) -> Agreement:
        return Agreement("a", load, quantity, part, 10, 1.0, 0.1, 0.1, slope, 0.0, r2, 0.0, 0.5, 0.0, 0.0, 0.0)

    one = [row("Load1", "max_shear", 0.414, 0.094), row("Load1", "max_shear", 0.9, 0.9, "fat")]
    told = regression_told(one, "a")
    assert told.startswith(
        "Cell-by-cell regression of a on the measurement, slope (R²): max. shear 0.41 (0.09). Slope and"
    )
    both = [
        *one,
        row("Load1", "u_mm", -0.2, 0.7),
        row("Load2", "max_shear", -0.5, 0.7),
        row("Load3", "u_mm", np.nan, 1),
    ]
    what = "displacement -0.20 (0.70) under Load1; max. shear 0.41 (0.09) under Load1, -0.50 (0.70) under Load2"
    assert f"measurement, slope (R²): {what}. Slope" in regression_told(both, "a")
    assert over_loads(both, "a", "max_shear", "slope") == "-0.50 to 0.41"
    assert regression_told([row("Load1", "u_mm", np.nan, np.nan)], "a") == regression_told(one, "b") == ""


def test_a_load_whose_area_is_not_informative_has_no_best_model(comparison: Comparison) -> None:
    load, model = next(iter(comparison.coverage_ml)), comparison.ranking.areas[0].model
    line = next(line for line in comparison.summary() if line.startswith(f"{load}: area"))
    assert ", best first: " in line
    ranking = replace(comparison.ranking, uninformative=(load, "all loads"))
    doubtful = replace(comparison, ranking=ranking)
    line = next(line for line in doubtful.summary() if line.startswith(f"{load}: area"))
    assert f", not informative: {model} " in line
    assert not any("no better than" in line or "best first" in line for line in doubtful.summary() if load in line)


def test_plots_draw_the_curves_and_areas_themselves(comparison: Comparison) -> None:
    figure = comparison.plot()
    assert [axes.get_title() for axes in figure.axes] == ["Load1", "Load2"]
    for axes, gamma in zip(figure.axes, (0.45, 0.5), strict=True):
        lines = {str(line.get_label()): line for line in axes.lines}
        for name, value in {"measured": gamma, **GAMMAS}.items():
            at, volume = (np.asarray(lines[name].get_data()[n], dtype=float) for n in (0, 1))
            assert volume == pytest.approx(8.0 * (max_shear(value) > at), abs=1e-9), name
    (axes,) = comparison.plot("areas", tissue="fat").axes
    drawn = {str(line.get_label()): line.get_ydata() for line in axes.lines}
    for name in GAMMAS:
        areas = [a.best_ml for a in comparison.areas if (a.model, a.tissue) == (name, "fat")]
        assert drawn[name] == pytest.approx(areas)
    with pytest.raises(InputError, match=f"'muscle' is not compared.*{ALL}"):
        comparison.plot(tissue="muscle")
    with pytest.raises(InputError, match="Unknown plot 'pie'"):
        comparison.plot("pie")  # type: ignore[arg-type]


def test_the_front_door_offers_what_it_lists() -> None:
    for name in validate.__all__:
        assert getattr(validate, name) is not None
    with pytest.raises(AttributeError, match="validate attribute nothing"):
        _ = validate.nothing


def test_a_model_no_nearer_than_no_deformation_is_said_to_be_so_beside_its_rank() -> None:
    mesh = cube(4)

    def compared(gammas: dict[str, float], error: ErrorTable | None, *loads: float) -> Comparison:
        models = [result(name, mesh, sheared(gamma)) for name, gamma in gammas.items()]
        cases = [case(f"Load{n}", sheared(gamma), models, error) for n, gamma in enumerate(loads, start=1)]
        return compare(cases, labels(), criteria=Criteria((0.05, 0.5)))

    for error in (None, error_table(0.0, 0.01)):
        both = compared({"twice": 0.9, "thrice": 1.2, "right": 0.38}, error, 0.4, 0.42)
        ranks = {row[0]: row[1] for row in area_rows(both.areas, both.ranking, ["Load1", "Load2"])}
        assert ranks["right"] == ("1" if error else "1–3")
        assert ranks["twice"] == ("2" if error else "1–3") + ", no better than no deformation"
        assert ranks["no deformation"] == "–"
        words = re.findall(
            r"(\S+): area between.*; no better than no deformation, [\d.]+.*: twice, thrice$", str(both), re.M
        )
        assert words == ["Load1", "Load2"]
        worse = r"^All loads, area in mL: .*; no better than no deformation, .*: twice, thrice$"
        assert re.search(worse, str(both), re.M)
        assert "It is no better" not in str(both)
        for gammas in ({"twice": 0.9, "thrice": 1.2}, {"twice": 0.9}):
            wrong = compared(gammas, error, 0.4)
            assert area_rows(wrong.areas, wrong.ranking, ["Load1"])[0][1].endswith(", no better than no deformation")
            assert re.search(rf"no better than no deformation, [\d.]+.*: {', '.join(gammas)}$", str(wrong), re.M)
            answer = wrong._repr_html_().partition("<table")[0]
            assert "no better than a model without deformation" in answer
            assert ("mL (95 % interval)" in wrong._repr_html_()) == (error is not None)
    right = compared({"right": 0.38}, None, 0.4)
    assert "no better" not in str(right) + right._repr_html_()


def test_tables_show_no_negative_zero_and_no_rounding_of_zero() -> None:
    mesh = cube(4)
    one = compare_load(case("Load1", sheared(0.4), [result("soft", mesh, sheared(0.5))]), labels())
    pictures: Any = dict.fromkeys(("curves", "slices"))
    for section in load_sections(one, pictures, pictures):
        for table in section.tables:
            cells = [shown(cell) for row in (*table.rows, *table.apart) for cell in row]
            assert not [cell for cell in cells if re.match(r"-0(\.0*)?$|.*e-1\d", cell)], table.title


def test_the_first_part_of_a_report_answers_and_all_else_is_folded(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    parts = re.findall(r'<details id="(part-\d+)"[^>]*?( open)?>', page)
    assert len(parts) > 5
    assert [name for name, is_open in parts if is_open] == ["part-1"]


def test_loads_without_an_informative_area_are_named_once_and_marked_in_the_table() -> None:
    models = [result(name, cube(6), sheared(gamma)) for name, gamma in {"a": 0.5, "b": 0.3}.items()]
    gammas = {"Load1": 0.38, "Load2": 0.6, "Load3": 0.38}
    loads = [compare_load(case(n, sheared(g), models, error_table(0.0, 0.001)), labels()) for n, g in gammas.items()]
    loads[2] = replace(loads[2], case=replace(loads[2].case, verdict=Verdict("caution", ("Poor.",))))
    ranking = rank_over_loads(loads)
    first = overview(loads, ranking, (), ranking.statements, ())
    few = "the measured maximum shear strain exceeds 0.2 in less than 1 % of the tissue"
    doubt = f"{few}, so the area metric is not informative."
    assert [line for line in first.paragraphs if doubt in line] == [f"Load1, Load3: {doubt}"]
    heads = ("all loads", "Load1 (not informative)", "Load2", "Load3 (use with care, not informative)")
    assert first.tables[0].columns[2:-2] == heads
    pictures: Any = dict.fromkeys(("curves", "slices"))
    assert load_sections(loads[0], pictures, pictures)[0].verdict is None  # what is not informative is no verdict
