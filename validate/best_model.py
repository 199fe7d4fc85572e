"""What a comparison says of the best model at first sight: how its largest strains compare with the measured ones."""

from collections.abc import Mapping, Sequence

import numpy as np

from dvc.report.page import Banner
from dvc.trust.verdict import Verdict
from validate.comparison_error import ComparisonError
from validate.mapping import ALL
from validate.ranking import ALL_LOADS, Ranking

_P95 = "p95"


def banner_of(ranking: Ranking, errors: Sequence[ComparisonError], verdict: Verdict | None) -> Banner | None:
    """The banner of a report on models; None where no model has every load, or the uncertainty is unknown.

    Its title names the best match over all loads, or the only model, and whether its 95th percentile differs from the
    measured one by more than the validation uncertainty. Where no load has an informative area, no model is best: the
    banner holds the statements, which compare the 95th percentiles.
    """
    ranked = [area.model for area in ranking.areas if not area.levelled]
    if not ranked or not any(error.tissue == ALL for error in errors):
        return None
    if ALL_LOADS in ranking.uninformative:
        return Banner("Models: not ranked, since the area metric is not informative", ranking.statements)
    best, only, judged = ranked[0], len(ranked) == 1, ranking.statements[0]
    high = {e.load: e for e in errors if (e.model, e.tissue, e.statistic) == (best, ALL, _P95) and np.isfinite(e.error)}
    title = f"Model: {best}" if only else f"Models: {best} is the best match"
    if verdict is not None and verdict.level == "distrust":
        return Banner(f"{title}, to a measurement that should not be trusted", (judged,))
    return Banner(title + _how_far(high), tuple(filter(None, (judged, _beside(best, high)))))


def _how_far(high: Mapping[str, ComparisonError]) -> str:
    """The end of a title: under how many loads the 95th percentile differs significantly."""
    apart = [load for load, error in high.items() if error.significant]
    if not high:
        return ""
    if not apart:
        return ", with no significant difference in the 95th percentile"
    if len(high) == 1:
        return ", but its 95th percentile differs significantly"
    return f", but its 95th percentile differs significantly under {_listed(apart)}"


def _beside(best: str, high: Mapping[str, ComparisonError]) -> str:
    """A sentence with the 95th percentile under each load, simulated and measured; empty without any."""
    if not high:
        return ""
    told = ", ".join(f"{load} {error.simulated:.3f} against {error.measured:.3f}" for load, error in high.items())
    return (
        f"95th percentile of the maximum shear strain in all soft tissue, {best} against the measurement (its bias "
        f"removed): {told}. A difference is significant if it exceeds the expanded validation uncertainty (2 u_val)."
    )


def simulated_percentiles(errors: Sequence[ComparisonError], model: str) -> dict[tuple[str, str], str]:
    """By load and tissue: the simulated 95th percentile, and on which side of the measurement it lies, if on one.

    Where the measurement uncertainty is unknown, there is none.
    """
    return {
        (error.load, error.tissue): f"{error.simulated:.3f}" + _side(error)
        for error in errors
        if (error.model, error.statistic) == (model, _P95) and np.isfinite(error.simulated)
    }


def _side(error: ComparisonError) -> str:
    return " (higher)" if error.low > 0.0 else " (lower)" if error.high < 0.0 else ""


def _listed(names: Sequence[str]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last
