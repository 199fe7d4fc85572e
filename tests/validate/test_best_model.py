"""What a report says of the best model at first sight."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvc.trust.verdict import Verdict
from tests.validate.test_comparison import case, cube, error_table, labels, result, sheared
from validate import ALL, Comparison, Criteria, compare
from validate.best_model import banner_of, simulated_percentiles
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


@pytest.mark.parametrize(
    ("differences", "end"),
    [
        ((0.01, -0.03), ", with no significant difference in the 95th percentile"),
        ((0.05, 0.01), ", but its 95th percentile differs significantly under Load1"),
        ((0.05, -0.05), ", but its 95th percentile differs significantly under Load1 and Load2"),
        ((0.05,), ", but its 95th percentile differs significantly"),
        ((np.nan,), ""),  # beyond the measured curve
    ],
)
def test_the_title_says_how_far_the_best_model_agrees(differences: tuple[float, ...], end: str) -> None:
    errors = [error(f"Load{n}", "near", d) for n, d in enumerate(differences, 1)]
    errors += [error("Load1", "far", 0.3), error("Load1", "near", 0.3, tissue="fat")]  # neither counts
    banner = banner_of(ranking("near", "far"), errors, Verdict("trust"))
    assert banner is not None
    assert banner.title == f"Models: near is the best match{end}"
    assert banner.paragraphs[0] == "The statement."
    if np.isfinite(differences[0]):
        assert (
            f"near against the measurement (its bias removed): Load1 {0.4 + differences[0]:.3f} against 0.400"
            in (banner.paragraphs[1])
        )


def test_a_single_model_is_no_best_match_and_loads_without_information_rank_none() -> None:
    errors = [error("Load1", "near", 0.0)]
    single = banner_of(ranking("near"), errors, None)
    assert single is not None
    assert single.title.startswith("Model: near, with no")
    unranked = banner_of(ranking("near", "far", uninformative=("Load1", ALL_LOADS)), errors, None)
    assert unranked is not None
    assert (unranked.title, unranked.paragraphs) == (
        "Models: not ranked, since the area metric is not informative", ("The statement.", "Another."),
    )  # fmt: skip


def test_a_measurement_not_to_be_trusted_judges_no_percentile_and_one_without_uncertainty_none() -> None:
    errors = [error("Load1", "near", 0.3)]
    doubtful = banner_of(ranking("near", "far"), errors, Verdict("distrust", ("It folds.",)))
    assert doubtful is not None
    assert doubtful.title == "Models: near is the best match, to a measurement that should not be trusted"
    assert doubtful.paragraphs == ("The statement.",)
    assert banner_of(ranking("near", "far"), [], None) is None
    assert banner_of(ranking(), errors, None) is None


def test_percentiles_say_on_which_side_of_the_measurement_they_lie() -> None:
    errors = [error("Load1", "near", d, tissue=t) for t, d in (("fat", 0.05), ("skin", -0.05), ("muscle", 0.03))]
    errors += [replace(errors[0], statistic="median"), replace(errors[0], model="far")]
    assert simulated_percentiles(errors, "near") == {
        ("Load1", "fat"): "0.450 (higher)", ("Load1", "skin"): "0.350 (lower)", ("Load1", "muscle"): "0.430",
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
    assert page.index("Use with care") < page.index("Models: near is the best") < page.index(statement)
    assert page.index(statement) < page.index('id="part-1"')
