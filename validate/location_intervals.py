"""Uncertainty of location: the same figures for truths drawn from the measurement's error model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from dvc.arrays import FloatArray
from dvc.trust.error_model import widened
from validate.location import CellGraph, Overlap, StrainedRegion, centroid_distance, dice, hausdorff95

LOCATION_DRAWS = 60
"""Truths drawn for the location of a load: the first of those drawn for the curves."""

_CELLS = 1000  # of a draw, for the Hausdorff distance: its percentile moves by 0.7 points, between draws by far more
_FIGURES: dict[str, Callable[[StrainedRegion, StrainedRegion], float]] = {
    "dice{}": dice,
    "centroids{}_mm": centroid_distance,
    "hausdorff95{}_mm": partial(hausdorff95, most=_CELLS),
}
_ENOUGH = 0.5  # fraction of the draws that must have a value


def with_intervals(
    overlaps: Sequence[Overlap],
    truths: Sequence[FloatArray],
    models: Mapping[str, FloatArray],
    cells: CellGraph,
    least_ml: float,
    widening: float,
) -> list[Overlap]:
    """Overlaps with 95 % intervals from truths drawn, and with the value that a perfect model would get.

    Parameters
    ----------
    overlaps : sequence of Overlap
        Of one load.
    truths : sequence of (n,)
        Maximum shear strain of each truth drawn, in the cells; see `dvc.trust.truth_draws.TruthDraws`.
    models : mapping of name to (n,)
        Maximum shear strain in the same cells.
    cells : CellGraph
        The cells compared.
    least_ml : float
        Volume of the smallest cluster that counts.
    widening : float
        Factor on intervals of draws; see `dvc.trust.error_model.ErrorTable`.

    Notes
    -----
    A perfect model's value is the median between one truth drawn and the next: what noise alone takes from a Dice
    coefficient, and adds to a distance. An interval that reaches it is extended to 1, or to 0 mm. Distances have an
    interval where at least half of the truths have tissue above the threshold.
    """
    rows: list[Overlap] = []
    for threshold in dict.fromkeys(o.threshold for o in overlaps):
        regions = [cells.region(truth > threshold, least_ml) for truth in truths]
        volume = _interval([region.volume_ml for region in regions], widening)
        perfect = {
            figure: _interval([of(a, b) for a, b in zip(regions[1:], regions, strict=False)], 1.0)[1]
            for figure, of in _FIGURES.items()
        }
        for one in (o for o in overlaps if o.threshold == threshold):
            model = cells.region(models[one.model] > threshold, least_ml)
            values: dict[str, Any] = {
                "measured_low_ml": volume[0],
                "measured_high_ml": min(volume[2], float(cells.volumes_ml.sum())),
            }
            for figure, of in _FIGURES.items():
                low, _, high = _interval([of(region, model) for region in regions], widening)
                if of is dice:
                    high = 1.0 if high >= perfect[figure] else high
                elif low <= perfect[figure]:
                    low = 0.0
                ends = {"_low": low, "_high": high, "_perfect": perfect[figure]}
                values |= {figure.format(end): value for end, value in ends.items()}
            rows.append(replace(one, **values))
    order = {(o.model, o.threshold): n for n, o in enumerate(overlaps)}
    return sorted(rows, key=lambda o: order[o.model, o.threshold])


def _interval(drawn: Sequence[float], widening: float) -> tuple[float, float, float]:
    """Lower end, median and upper end of draws; NaN where too few have a value."""
    known = np.array([d for d in drawn if not np.isnan(d)])
    if len(known) < max(2.0, _ENOUGH * len(drawn)):
        return (float("nan"),) * 3
    low, middle, high = (float(v[0]) for v in widened(known[:, None], widening))
    return low, middle, high
