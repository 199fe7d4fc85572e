"""What a comparison says of the best model at first sight: how its largest strains compare with the measured ones."""

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from dvc import Verdict
from dvc.report.alike import listed
from dvc.report.page import Banner, Section
from validate.comparison_error import ComparisonError
from validate.mapping import ALL
from validate.ranking import ALL_LOADS, Ranking, no_nearer

_P95 = "p95"


def banner_of(
    ranking: Ranking, errors: Sequence[ComparisonError], loads: Collection[str], verdict: Verdict | None
) -> Banner | None:
    """The banner of a report on models: the best match, and whether its 95th percentile differs from the measured one.

    None where that cannot be told: without a model that has every load, without the measurement uncertainty under each
    of the ``loads``, with the ``verdict`` Do not trust, or if no area is informative.
    """
    ranked = [area.model for area in ranking.areas if not area.levelled]
    tested = [error for error in errors if (error.tissue, error.statistic) == (ALL, _P95)]
    distrusted = verdict is not None and verdict.level == "distrust"
    unknown = {error.load for error in tested} != {*loads} or ALL_LOADS in ranking.uninformative
    if distrusted or unknown or not ranked or not ranking.statements:
        return None
    of_best = [error for error in tested if error.model == ranked[0]]
    title = "; ".join(filter(None, (_best_match(ranking, ranked, len({e.model for e in tested})), _sides(of_best))))
    return Banner(title, (ranking.statements[0], _beside(of_best)))


def without_banner(section: Section, banner: Banner | None) -> Section:
    """A section without the sentences that a banner above it has."""
    told = () if banner is None else banner.paragraphs
    return replace(section, paragraphs=tuple(one for one in section.paragraphs if one not in told))


def percentiles_beside(errors: Sequence[ComparisonError], model: str) -> dict[tuple[str, str], str]:
    """By load and tissue: a model's 95th percentile against the measured one, and on which side it is, if on one."""
    return {
        (error.load, error.tissue): _against(error)
        for error in errors
        if (error.model, error.statistic) == (model, _P95) and np.isfinite(error.simulated)
    }


def _best_match(ranking: Ranking, ranked: Sequence[str], models: int) -> str:
    best = ranked[0]
    worse = best in no_nearer(ranking.areas, ranking.nothing)
    if models == 1:
        return f"Model: {best}" + ", no better than a model without deformation" * worse
    if worse:
        return f"Models: none is better than a model without deformation; best match {best}"
    near = [b for a, b in ranking.not_distinguishable.get(ALL_LOADS, ()) if a == best]
    return f"Models: best match {best}" + (f", not distinguishable from {listed(near)}" if near else "")


def _sides(of_best: Sequence[ComparisonError]) -> str:
    """The end of a title: under which loads the 95th percentile is significantly too high or too low."""
    tested = [error for error in of_best if np.isfinite(error.error)]
    if not tested:
        return ""
    sides = {side: [error.load for error in tested if _side(error) == side] for side in ("too high", "too low")}
    apart = [f"{side} under {listed(of)}" for side, of in sides.items() if of]
    if apart:
        return f"its high strains are significantly {', '.join(apart)}"
    under = f" under {listed([error.load for error in tested])}" * (len(tested) < len(of_best))
    return f"no significant difference in its high strains{under}"


def _beside(of_best: Sequence[ComparisonError]) -> str:
    """The 95th percentiles under each load, in sentences, and what makes a difference significant."""
    told = ", ".join(f"{e.load} {_against(e)}" for e in of_best)
    by = {
        "the mesh (u_num)": any(np.isnan(error.u_num) for error in of_best),
        "the inputs (u_input)": any(np.isnan(error.u_input) for error in of_best),
    }
    lacking = [name for name, lacks in by.items() if lacks]
    why = "is not given and may explain the difference"
    also = f". The uncertainty of {listed(lacking)} {why}" if lacking else ""
    return (
        "High strains (95th percentile of the maximum shear strain in all soft tissue, in the compared cells), "
        f"{of_best[0].model} against the measurement, whose bias is removed: {told}. Too high or too low: the "
        f"difference exceeds twice the known standard uncertainty (2 u_val){also}."
    )


def _against(error: ComparisonError) -> str:
    if not np.isfinite(error.error):
        return f"{error.simulated:.3f} (not tested, beyond the measured curve)"
    side = _side(error)
    return f"{error.simulated:.3f} against {error.measured:.3f}" + f" ({side})" * bool(side)


def _side(error: ComparisonError) -> str:
    return "too high" if error.low > 0.0 else "too low" if error.high < 0.0 else ""
