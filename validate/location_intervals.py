"""How sure the figures of location are: the same figures for truths that may lie behind the measurement."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from scipy import sparse

from dvc.arrays import BoolArray, FloatArray
from dvc.trust.error_model import widened
from validate.location import Overlap, Part, centroids_apart, dice, hausdorff95, in_clusters

DRAWS = 60
"""Truths drawn for the figures of location of a load: the first of those drawn for the curves."""

_CELLS = 1000  # by which a distance of a draw is told: its percentile moves by 0.7 points, the draws by far more
_FIGURES: dict[str, Callable[[Part, Part], float]] = {
    "dice{}": dice,
    "centroids{}_mm": centroids_apart,
    "hausdorff95{}_mm": partial(hausdorff95, most=_CELLS),
}
_ENOUGH = 0.5  # share of the draws that must have a figure


def with_intervals(
    overlaps: Sequence[Overlap],
    truths: Sequence[FloatArray],
    models: Mapping[str, FloatArray],
    volumes_ml: FloatArray,
    points_mm: FloatArray,
    touching: sparse.csr_matrix,
    least_ml: float,
    widening: float,
) -> list[Overlap]:
    """Overlaps with 95 % intervals from truths drawn, and with what a perfect model would be given.

    Parameters
    ----------
    overlaps : sequence of Overlap
        Of one load.
    truths : sequence of (n,)
        Maximal shear of each truth drawn, in the cells compared; see `dvc.trust.truth_draws.TruthDraws`.
    models : mapping of name to (n,)
        Maximal shear in the same cells.
    volumes_ml, points_mm : (n,), (n, 3)
        Of these cells.
    touching : (n, n)
        Which of these cells share a face.
    least_ml : float
        Volume of the smallest cluster that counts.
    widening : float
        By which intervals of draws are widened; see `dvc.trust.error_model.ErrorTable`.

    Notes
    -----
    A perfect model's figure is the median between one truth drawn and the next: what noise alone takes from a Dice, and
    adds to a distance. An interval that reaches it goes on to 1, or to 0 mm, as a perfect model's has to. Distances
    are told where at least half of the truths have tissue above the threshold.
    """

    def part(above: BoolArray) -> Part:
        return Part(in_clusters(above, volumes_ml, touching, least_ml), volumes_ml, points_mm)

    told: list[Overlap] = []
    for threshold in dict.fromkeys(o.threshold for o in overlaps):
        parts = [part(truth > threshold) for truth in truths]
        volume = _interval([drawn.volume_ml for drawn in parts], widening)
        perfect = {
            figure: _interval([of(a, b) for a, b in zip(parts[1:], parts, strict=False)], 1.0)[1]
            for figure, of in _FIGURES.items()
        }
        for one in (o for o in overlaps if o.threshold == threshold):
            model = part(models[one.model] > threshold)
            given: dict[str, Any] = {
                "measured_low_ml": volume[0],
                "measured_high_ml": min(volume[2], float(volumes_ml.sum())),
            }
            for figure, of in _FIGURES.items():
                low, _, high = _interval([of(drawn, model) for drawn in parts], widening)
                if of is dice:
                    high = 1.0 if high >= perfect[figure] else high
                elif low <= perfect[figure]:
                    low = 0.0
                ends = {"_low": low, "_high": high, "_perfect": perfect[figure]}
                given |= {figure.format(end): value for end, value in ends.items()}
            told.append(replace(one, **given))
    order = {(o.model, o.threshold): n for n, o in enumerate(overlaps)}
    return sorted(told, key=lambda o: order[o.model, o.threshold])


def _interval(drawn: Sequence[float], widening: float) -> tuple[float, float, float]:
    """Lower end, median and upper end of draws; NaN where too few have a value."""
    known = np.array([d for d in drawn if not np.isnan(d)])
    if len(known) < max(2.0, _ENOUGH * len(drawn)):
        return (float("nan"),) * 3
    low, middle, high = (float(v[0]) for v in widened(known[:, None], widening))
    return low, middle, high
