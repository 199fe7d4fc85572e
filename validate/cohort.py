"""Models ranked over subjects, with simultaneous intervals of their differences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import studentized_range, t as student

from dvc.arrays import FloatArray
from dvc.errors import InputError

_SURE, _LEVEL = 0.95, 0.975


@dataclass(frozen=True, slots=True)
class CohortRank:
    """A model over subjects; a row of ranking.csv.

    Attributes
    ----------
    subjects : int
        Number of subjects with a result of every model.
    mean, low, high, least, greatest : float
        Mean normalised area between curves, its 95 % interval over subjects (Student's t; NaN for one subject), and
        its range.
    nearest_in : int
        Subjects in which it has the smallest area.
    behind, behind_low, behind_high : float
        Mean paired difference to the area of the best model, and a simultaneous interval for all pairs of models: it
        stays valid although the same subjects determined which model is the best.
    """

    model: str
    subjects: int
    mean: float
    low: float
    high: float
    least: float
    greatest: float
    nearest_in: int
    behind: float
    behind_low: float
    behind_high: float

    @property
    def differs_from_best(self) -> bool:
        """Whether it is significantly worse than the best model."""
        return bool(self.behind_low > 0.0)


def rank_over_subjects(shares: Mapping[str, Mapping[str, float]]) -> tuple[CohortRank, ...]:
    """Rank models by their normalised areas between curves, by subject, over the subjects that have all; best first.

    Subjects are taken as an independent sample of one population. Intervals are those of a mean: they narrow with more
    subjects, and include the measurement error as far as it varies between subjects.

    Differences have Tukey's simultaneous 95 % intervals (honestly significant difference, subjects as blocks: Kutner
    and others, Applied Linear Statistical Models, section 21.5), which assume one residual variance for all models.

    Raises
    ------
    InputError
        If no subject has a result of every model.
    """
    names = list(shares)
    subjects = [s for s in dict.fromkeys(s for of in shares.values() for s in of) if all(s in shares[n] for n in names)]
    if not names or not subjects:
        raise InputError("No subject has a result of every model, so they cannot be ranked.")
    table = np.array([[shares[n][s] for s in subjects] for n in names])
    order = np.argsort(table.mean(axis=1), kind="stable")
    first, nearest, half = table[order[0]], np.argmin(table, axis=0), _simultaneous(table)
    ranks = []
    for at in order:
        row, behind = table[at], float((table[at] - first).mean())
        extremes, nearest_in = (float(row.min()), float(row.max())), int(np.count_nonzero(nearest == at))
        differences = behind, behind - half, behind + half
        ranks.append(CohortRank(names[at], len(subjects), *_mean(row), *extremes, nearest_in, *differences))
    return tuple(ranks)


def _mean(values: FloatArray) -> tuple[float, float, float]:
    mean, count = float(values.mean()), len(values)
    if count < 2:
        return mean, float("nan"), float("nan")
    half = float(student.ppf(_LEVEL, count - 1) * values.std(ddof=1) / np.sqrt(count))
    return mean, mean - half, mean + half


def _simultaneous(table: FloatArray) -> float:
    """Half width of the simultaneous 95 % intervals of all differences between means of models (k, subjects)."""
    models, subjects = table.shape
    if models < 2 or subjects < 2:
        return float("nan")
    rest = table - table.mean(axis=0) - table.mean(axis=1)[:, None] + table.mean()
    freedom = (models - 1) * (subjects - 1)
    spread = np.sqrt((rest**2).sum() / freedom / subjects)
    return float(studentized_range.ppf(_SURE, models, freedom) * spread)
