"""The section on standard metrics: its answer, its tables and figure, on shears whose coefficients are known."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from tests.validate.test_comparison import case, cube, error_table, labels, max_shear, result, sheared
from validate import LEVELLED, NOTHING, Comparison, Criteria, LoadComparison, compare, compare_load
from validate.standards import answer, coefficients, columns_of, section

TRUE = 0.4
GAMMAS = {"right": TRUE, "far": 0.9, f"far{LEVELLED}": TRUE}


def compared(bias: float, sd: float | None) -> LoadComparison:
    """Uniform shear of a cube of fat and skin, whose one coefficient is its strain."""
    mesh = cube(6)
    models = [result(name, mesh, sheared(gamma)) for name, gamma in GAMMAS.items()]
    error = None if sd is None else error_table(bias, sd)
    return compare_load(case("Load1", sheared(TRUE), models, error), labels(), criteria=Criteria((0.05, 0.5)))


def test_a_uniform_strain_is_one_coefficient_with_the_uncertainty_of_the_tables() -> None:
    one = compared(0.0, 0.01)
    assert list(one.decompositions) == ["fat", "skin"]
    rows = {(r.model, r.tissue): r for r in one.representations}
    assert {model for model, _ in rows} == {*GAMMAS, NOTHING}
    for tissue, by in one.decompositions.items():
        assert by.measured.coefficients[0] == pytest.approx(max_shear(TRUE))
        assert by.u_cal == pytest.approx(0.01)
        assert (rows["right", tissue].coefficients, rows["right", tissue].accepted) == (1, True)
        assert rows["right", tissue].probability == 1.0
        assert (rows["far", tissue].in_band, rows["far", tissue].probability) == (0, 0.0)
        assert rows["far", tissue].guide_probability == 0.0  # a mean is off by more than any uncertainty
        assert by.guide_band == pytest.approx(0.02)


def test_the_bias_of_the_measurement_is_removed_for_models_and_kept_for_levelled_ones() -> None:
    """Measured 0.1 too high: a model of the true strain is right, and so is a levelled one of the measured strain."""
    one = compared(0.1, 0.005)
    rows = {r.model: r for r in one.representations if r.tissue == "fat"}
    assert rows[f"far{LEVELLED}"].probability == 1.0
    assert rows["right"].probability == 0.0
    assert one.decompositions["fat"].estimate == pytest.approx(max_shear(TRUE) - 0.1, abs=0.005)
    assert one.decompositions["fat"].u_cal == pytest.approx(np.hypot(0.1, 0.005))


def test_the_answer_comes_first_and_names_model_tissue_and_probability() -> None:
    one = compared(0.0, 0.01)
    first, accepted, guide = answer(one)
    assert first == (
        "In fat, the largest tissue, the probability that the model represents the measurement is 100 % for right and "
        "0 % for no deformation; similar values mean that this metric does not distinguish them. 1 of the 1 "
        "coefficients of right lie within their uncertainty. The probability can differ from this share, "
        "because coefficients are weighted by the size of their error."
    )
    assert "which CWA 16799 accepts (residual 0.000, measurement uncertainty 0.010, 0 clusters" in accepted
    assert guide.startswith(
        "CWA 16799 gives one uncertainty to all coefficients; with it, the probability is 100 % for right"
    )
    (alone,) = answer(compared(0.0, None))
    assert "no error model" in alone
    shown = section(one, None)
    assert shown.folded
    assert [table.title.partition(",")[0] for table in shown.tables] == [
        "Image decomposition", "Modified area validation metric",
    ]  # fmt: skip
    assert len(shown.tables[0].rows) == 6
    assert len(shown.tables[0].apart) == 2


def test_the_figure_shows_the_coefficients_over_the_band() -> None:
    one = compared(0.0, 0.01)
    figure = coefficients(one.decompositions, list(GAMMAS))
    assert [axes.get_title() for axes in figure.axes] == ["fat", "skin"]
    drawn = {str(line.get_label()): line for line in figure.axes[0].lines}
    by = one.decompositions["fat"]
    for name in GAMMAS:
        at, value = (np.asarray(of, dtype=float) for of in drawn[name].get_data())
        assert at == pytest.approx(by.estimate)
        assert value == pytest.approx(by.models[name].coefficients)
    columns = columns_of(one.decompositions)
    assert len(columns["simulated"]) == 2 * len([*GAMMAS, NOTHING])


def test_tables_and_figure_are_written_and_told_in_the_report(tmp_path: Path) -> None:
    mesh = cube(4)
    models = [result(name, mesh, sheared(gamma)) for name, gamma in GAMMAS.items()]
    cases = [case("Load1", sheared(TRUE), models, error_table(0.0, 0.01))]
    done = compare(cases, labels(), criteria=Criteria((0.05, 0.5)))
    done.write(tmp_path)
    with (tmp_path / "decomposition.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["model"], row["tissue"]) for row in rows} == {(r.model, r.tissue) for r in done.representations}
    with (tmp_path / "mavm.csv").open() as file:
        areas = {row["model"]: row for row in csv.DictReader(file) if row["tissue"] == "all soft tissue"}
    assert float(areas["far"]["d_minus"]) == pytest.approx(max_shear(0.9) - max_shear(TRUE), rel=1e-5)
    assert float(areas[NOTHING]["d_plus"]) == pytest.approx(max_shear(TRUE), rel=1e-5)
    assert (tmp_path / "Load1" / "coefficients.csv").is_file()
    page = (tmp_path / "report.html").read_text()
    assert "Load1, standard metrics (CWA 16799, MAVM)" in page
    assert "the probability that the model represents the measurement is 100 % for right" in page
    assert Comparison.read(tmp_path).model_forms[0].d_plus == pytest.approx(done.model_forms[0].d_plus, abs=1e-6)
