"""What a report says of the best model at first sight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvc.trust.verdict import Verdict
from tests.validate.test_comparison import case, cube, error_table, labels, result, sheared
from validate import ALL, Comparison, Criteria, compare
from validate.best_model import banner_of, percentiles_beside
from validate.comparison_error import ComparisonError
from validate.curves import Area
from validate.ranking import ALL_LOADS, Ranking

NOTHING = Area("no deformation", ALL_LOADS, ALL, 5.0, 0.5, 5.0, 4.5, 5.5, 0.1)


def ranking(*models: str, uninformative: tuple[str, ...] = ()) -> Ranking:
    areas = tuple(Area(name, ALL_LOADS, ALL, 1.0, 0.1, 1.0, 0.5, 1.5, 0.1) for name in models)
    return Ranking(areas, NOTHING, ("The statement.", "Another."), {}, uninformative)


def error(load: str, model: str, difference: float, u_val: float = 0.02, tissue: str = ALL) -> ComparisonError:
    unknown, ends = float("nan"), (difference - 2 * u_val, difference + 2 * u_val)
    simulated = 0.4 + difference
    return ComparisonError(
        model, load, tissue, "p95", simulated, 0.4, difference, unknown, unknown, u_val, u_val, *ends
    )  # fmt: skip


LOADS = ["Load1", "Load2"]


@pytest.mark.parametrize(
    ("differences", "end"),
    [
        ((0.01, -0.03), "; no significant difference in its high strains"),
        ((0.05, 0.01), "; its high strains are significantly too high under Load1"),
        ((0.05, -0.05), "; its high strains are significantly too high under Load1, too low under Load2"),
        ((0.05, 0.05), "; its high strains are significantly too high under Load1 and Load2"),
        ((np.nan, 0.01), "; no significant difference in its high strains under Load2"),  # beyond the measured curve
        ((np.nan, np.nan), ""),
    ],
)
def test_the_title_says_how_far_the_best_match_agrees(differences: tuple[float, ...], end: str) -> None:
    errors = [error(load, "near", d) for load, d in zip(LOADS, differences, strict=True)]
    errors += [error("Load1", "far", 0.3), error("Load1", "near", 0.3, tissue="fat")]  # neither counts
    banner = banner_of(ranking("near", "far"), errors, LOADS, Verdict("trust"))
    assert banner is not None
    assert banner.title == f"Models: best match near{end}"
    assert banner.paragraphs[0] == "The statement."
    assert ("Load1 nan (not tested, beyond" in banner.paragraphs[1]) == np.isnan(differences[0])
    if differences == (0.05, 0.01):
        assert "Load1 0.450 against 0.400 (too high), Load2 0.410 against 0.400. " in banner.paragraphs[1]
        assert "The uncertainty of the mesh (u_num) and the inputs (u_input) is not given" in banner.paragraphs[1]


def test_the_title_says_which_models_are_as_near_and_that_none_may_be_near() -> None:
    errors = [error(load, name, 0.0) for load in LOADS for name in ("near", "far")]
    near = replace(ranking("near", "far"), not_distinguishable={ALL_LOADS: (("near", "far"),)})
    worse = replace(ranking("near", "far"), nothing=replace(NOTHING, estimate_ml=1.0))
    titles = [banner.title for one in (near, worse) if (banner := banner_of(one, errors, LOADS, None))]
    agrees = "no significant difference in its high strains"
    assert titles == [
        f"Models: best match near, not distinguishable from far; {agrees}",
        f"Models: none is better than a model without deformation; best match near; {agrees}",
    ]
    single = banner_of(ranking("near"), errors[::2], LOADS, None)
    assert single is not None
    assert single.title == f"Model: near; {agrees}"


def test_there_is_no_banner_where_it_could_mislead() -> None:
    errors, both = [error(load, "near", 0.3) for load in LOADS], ranking("near", "far")
    assert banner_of(both, errors, LOADS, None) is not None
    assert banner_of(both, errors, LOADS, Verdict("distrust", ("It folds.",))) is None
    assert banner_of(both, errors[:1], LOADS, None) is None  # no uncertainty is known under Load2
    assert banner_of(ranking(), errors, LOADS, None) is None  # no model has every load
    assert banner_of(ranking("near", uninformative=(*LOADS, ALL_LOADS)), errors, LOADS, None) is None
    assert banner_of(replace(both, statements=()), errors, LOADS, None) is None


def test_percentiles_say_on_which_side_of_the_measurement_they_lie() -> None:
    errors = [error("Load1", "near", d, tissue=t) for t, d in (("fat", 0.05), ("skin", -0.05), ("muscle", 0.03))]
    errors += [replace(errors[0], statistic="median"), replace(errors[0], model="far")]
    assert percentiles_beside(errors, "near") == {
        ("Load1", "fat"): "0.450 against 0.400 (too high)", ("Load1", "skin"): "0.350 against 0.400 (too low)",
        ("Load1", "muscle"): "0.430 against 0.400",
    }  # fmt: skip


def test_a_report_begins_with_the_verdict_and_the_banner_which_says_it_once(tmp_path: Path) -> None:
    mesh = cube(4)
    models = [result(name, mesh, sheared(gamma)) for name, gamma in (("half", 0.2), ("near", 0.44))]
    cases = [replace(case("Load1", sheared(0.45), models, error_table(0.0, 0.01)), verdict=Verdict("trust"))]
    compare(cases, labels(), criteria=Criteria((0.05, 0.5))).write(tmp_path)
    page, back = (tmp_path / "report.html").read_text(), Comparison.read(tmp_path)
    assert back.banner is not None
    statement = back.banner.paragraphs[0]
    assert statement.startswith("Best match under Load1 (area metric): near")
    assert page.count(statement) == 1
    assert page.index("Use with care") < page.index("Models: best match near") < page.index(statement)
    assert page.index(statement) < page.index('id="part-1"')
