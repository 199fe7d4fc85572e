"""Models over many subjects: how far each is from the measurement, and which are told apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.stats import studentized_range
from scipy.stats import t as student

from dvc.arrays import FloatArray
from dvc.errors import InputError

_SURE, _LEVEL = 0.95, 0.975


@dataclass(frozen=True, slots=True)
class CohortRank:
    """A model's place over subjects.

    Attributes
    ----------
    model : str
    subjects : int
        On which every model has a result.
    mean, low, high : float
        Of the area between its curve and the measured one, divided by the tissue's volume and the width of the range;
        95 % interval of the mean over subjects (Student's t). NaN for one subject.
    least, greatest : float
        Over the subjects.
    nearest_in : int
        Subjects in which it is the nearest.
    behind, behind_low, behind_high : float
        Mean over subjects of its area minus that of the first model, in the same subject, and an interval that holds
        for all pairs of models at once, so that it stays true of the one which the subjects made the first.
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
    def told_apart(self) -> bool:
        """Whether the subjects tell it from the first model."""
        return bool(self.behind_low > 0.0)


def rank_over_subjects(shares: Mapping[str, Mapping[str, float]]) -> tuple[CohortRank, ...]:
    """Rank models over the subjects that have a result of each, the nearest first.

    Subjects are taken as drawn from one population, independent of each other. Intervals are those of a mean: they
    narrow with more subjects, and hold the error of the measurement as far as it differs from subject to subject.

    Differences have the simultaneous 95 % intervals of Tukey (the honestly significant difference of a design with
    subjects as blocks: Kutner and others, Applied Linear Statistical Models, section 21.5), which take what subject and
    model do not explain as of one size for all models.

    Parameters
    ----------
    shares : mapping of model to mapping of subject to float
        Area between curves over volume and width of the range.

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
    made = []
    for at in order:
        mean, low, high = _mean(table[at])
        behind = float((table[at] - first).mean())
        made.append(
            CohortRank(
                names[at], len(subjects), mean, low, high, float(table[at].min()), float(table[at].max()),
                int(np.count_nonzero(nearest == at)), behind, behind - half, behind + half,
            )
        )  # fmt: skip
    return tuple(made)


def _mean(values: FloatArray) -> tuple[float, float, float]:
    mean, count = float(values.mean()), len(values)
    if count < 2:
        return mean, float("nan"), float("nan")
    half = float(student.ppf(_LEVEL, count - 1) * values.std(ddof=1) / np.sqrt(count))
    return mean, mean - half, mean + half


def _simultaneous(table: FloatArray) -> float:
    """Half the width of the 95 % intervals of all differences of means of models (k, subjects) at once."""
    models, subjects = table.shape
    if models < 2 or subjects < 2:
        return float("nan")
    rest = table - table.mean(axis=0) - table.mean(axis=1)[:, None] + table.mean()
    freedom = (models - 1) * (subjects - 1)
    spread = np.sqrt((rest**2).sum() / freedom / subjects)
    return float(studentized_range.ppf(_SURE, models, freedom) * spread)
