"""The error model that an accuracy study amounts to, and whether it holds on heels that it has not seen."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.errors import InputError
from dvc.trust.error_model import POOLED, ErrorModel, ErrorTable, figures_of, widened
from phantoms.accuracy_run import ErrorSamples
from phantoms.error_tables import SOFT, by_condition, of_tissue

_KNOTS = np.array([0.005, 0.015, 0.03, 0.05, 0.08, 0.12, 0.18, 0.25, 0.35, 0.5])
_EDGES = np.concatenate([[0.0], 0.5 * (_KNOTS[1:] + _KNOTS[:-1]), [np.inf]])
_BONE_MM = np.array([0.0, 2.0, 4.0, 8.0])
_PRIOR = 400.0  # samples that a cell's parent counts for
_FEW = 50.0
_JUDGED = (0.1, 0.3)
_DRAWS = 8  # of each training run, when intervals are judged
_Moments = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True, slots=True)
class CoverageRow:
    """How often the truth was where the error model of the other heels says.

    Attributes
    ----------
    preset, voxel_mm, snr, motion, tissue
        As in `phantoms.error_tables.ErrorRow`.
    voxels_within : float
        Share of the samples whose truth lay within 1.96 standard deviations; 0.95 if the model is right.
    left_over : float
        Mean of the error less its expected bias.
    figures_within : float
        Share of the tissue's figures (median, 90th and 95th percentile, volumes above 0.1 and 0.3) that lay in their
        intervals, over the runs; 0.95 over all motions and tissues, by the widening. The intervals' field is left out
        here: in a whole tissue it averages out.
    """

    preset: str
    voxel_mm: str
    snr: float
    motion: str
    tissue: str
    voxels_within: float
    left_over: float
    figures_within: float


def fit_error_model(runs: Sequence[ErrorSamples], parameters: str, source: str) -> ErrorModel:
    """Fit the error of the maximal shear, as `register` uses it, to all motions but waves.

    Parameters
    ----------
    runs : sequence of ErrorSamples
        Of one preset.
    parameters : str
        The preset's text.
    source : str
        The study, in a sentence.

    Raises
    ------
    InputError
        If the runs are of several presets, or there is none.
    """
    presets = {r.case.preset for r in runs}
    plain = [r for r in runs if r.case.wavelength_mm is None]
    if len(presets) != 1 or not plain:
        raise InputError(f"An error model is of one preset and needs motions other than waves; got {sorted(presets)}.")
    tables = tuple(replace(_table(some), widening=_widening(_judgements(some))) for _, some in by_condition(plain))
    digest = hashlib.sha256(parameters.encode()).hexdigest()
    return ErrorModel(Path(presets.pop()).name, digest, tables, source)


def coverage_rows(runs: Sequence[ErrorSamples]) -> list[CoverageRow]:
    """Judge the error model on heels that it has not seen: each heel by a model fitted to all others.

    The motions are those that it has seen. Conditions with one heel alone have no rows.
    """
    rows = []
    for condition, some in by_condition([r for r in runs if r.case.wavelength_mm is None]):
        judgements = _judgements(some)
        factor = _widening(judgements)
        for motion, tissue in dict.fromkeys((j.motion, j.tissue) for j in judgements):
            mine = [j for j in judgements if (j.motion, j.tissue) == (motion, tissue)]
            within = float(np.concatenate([j.within for j in mine]).mean())
            left = float(np.concatenate([j.left for j in mine]).mean())
            figures = float(np.mean([j.scores <= factor for j in mine]))
            rows.append(CoverageRow(*condition, motion, tissue, within, left, figures))
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class _Judgement:
    """One run's tissue judged by the heels that are not its own.

    ``left`` are errors less their expected bias, ``within`` whether each is within 1.96 deviations, and ``scores`` how
    far the true figures lie from the middle of the draws, in units of the draws' own interval on that side.
    """

    motion: str
    tissue: str
    left: FloatArray
    within: BoolArray
    scores: FloatArray


def _judgements(runs: Sequence[ErrorSamples]) -> list[_Judgement]:
    """Of runs of one condition; empty with one heel alone."""
    seeds = sorted({r.case.seed for r in runs})
    if len(seeds) < 2:
        return []
    tables = {seed: _table([r for r in runs if r.case.seed != seed]) for seed in seeds}
    judged = (_judged(run, tissue, tables[run.case.seed]) for run in runs for tissue in SOFT)
    return [j for j in judged if j is not None]


def _widening(judgements: Sequence[_Judgement]) -> float:
    """Factor by which 95 % of the figures lie in their intervals; never below one. NaN without a judgement."""
    if not judgements:
        return float("nan")
    return max(1.0, float(np.quantile(np.concatenate([j.scores for j in judgements]), 0.95)))


def _judged(run: ErrorSamples, tissue: str, table: ErrorTable) -> _Judgement | None:
    kept = of_tissue(run, tissue)
    if np.count_nonzero(kept) < _FEW:
        return None
    shear, true = run.shear[kept].astype(np.float64), run.true_shear[kept].astype(np.float64)
    bias, sd = table.expected(tissue, shear, run.to_bone_mm[kept])
    left = shear - true - bias
    random = np.random.default_rng(1)
    drawn = []
    for number in range(len(table.runs)):
        b, s = table.expected(tissue, shear, run.to_bone_mm[kept], number)
        for _ in range(_DRAWS):
            drawn.append(figures_of(np.maximum(shear - b - s * random.standard_normal(len(b)), 0.0), 1.0, _JUDGED))
    low, middle, high = widened(np.array(drawn), 1.0)
    off = figures_of(true, 1.0, _JUDGED) - middle
    reach = np.where(off < 0, middle - low, high - middle)
    scores = np.where(off == 0, 0.0, np.abs(off) / np.maximum(reach, 1e-9))
    return _Judgement(run.case.motion, tissue, left, np.abs(left) < 1.96 * sd, scores)


def _table(runs: Sequence[ErrorSamples]) -> ErrorTable:
    tissues = (*SOFT, POOLED)
    pooled = _filled(_moments(runs, POOLED, None))
    whole = {tissue: _cells(runs, tissue, pooled) for tissue in tissues}
    return ErrorTable(
        np.array(runs[0].case.spacing_mm),
        float(np.median([r.estimated_snr for r in runs])),
        _KNOTS,
        _BONE_MM,
        {tissue: _rows(cells) for tissue, cells in whole.items()},
        tuple({tissue: _rows(_of_run(run, tissue, whole[tissue])) for tissue in tissues} for run in runs),
        _correlation_mm(runs),
    )


def _cells(runs: Sequence[ErrorSamples], tissue: str, pooled: _Moments) -> list[_Moments]:
    """Moments by distance to bone and shear found.

    Cells with few samples lean on their tissue's mean over all distances, and this on that of all soft tissue.
    """
    own = pooled if tissue == POOLED else _leaning(_moments(runs, tissue, None), pooled)
    return [_leaning(_moments(runs, tissue, k), own) for k in range(len(_BONE_MM))]


def _of_run(run: ErrorSamples, tissue: str, whole: Sequence[_Moments]) -> list[_Moments]:
    """Moments of one run alone; cells with few samples lean on those of all runs."""
    return [_leaning(_moments([run], tissue, k), parent) for k, parent in enumerate(whole)]


def _rows(cells: Sequence[_Moments]) -> FloatArray:
    """Bias and standard deviation, (2, k, m)."""
    mean = np.array([m for _, m, _ in cells])
    square = np.array([q for _, _, q in cells])
    return np.stack([mean, np.sqrt(np.maximum(square - mean**2, 1e-10))])


def _moments(runs: Sequence[ErrorSamples], tissue: str, bone_bin: int | None) -> _Moments:
    """Number, mean and mean square of the errors by shear found; every sample counts the same."""
    ends = [*_BONE_MM, np.inf]
    count, total, square = (np.zeros(len(_KNOTS)) for _ in range(3))
    for run in runs:
        kept = of_tissue(run, tissue)
        if bone_bin is not None:
            kept = kept & (run.to_bone_mm >= ends[bone_bin]) & (run.to_bone_mm < ends[bone_bin + 1])
        cell = np.searchsorted(_EDGES, run.shear[kept], side="right") - 1
        error = (run.shear - run.true_shear)[kept].astype(np.float64)
        count += np.bincount(cell, minlength=len(_KNOTS))
        total += np.bincount(cell, error, minlength=len(_KNOTS))
        square += np.bincount(cell, error**2, minlength=len(_KNOTS))
    some = np.maximum(count, 1.0)
    return count, total / some, square / some


def _filled(moments: _Moments) -> _Moments:
    """Shears that hardly occurred take the figures of the nearest that did."""
    count, mean, square = moments
    often = np.flatnonzero(count >= _FEW)
    if not len(often):
        raise InputError(f"A study needs at least {_FEW:.0f} samples of soft tissue to tell an error.")
    nearest = often[np.argmin(np.abs(_KNOTS[:, None] - _KNOTS[often]), axis=1)]
    return count, mean[nearest], square[nearest]


def _leaning(own: _Moments, parent: _Moments) -> _Moments:
    weight = own[0] / (own[0] + _PRIOR)
    mean = weight * own[1] + (1 - weight) * parent[1]
    return own[0] + _PRIOR, mean, weight * own[2] + (1 - weight) * parent[2]


def _correlation_mm(runs: Sequence[ErrorSamples]) -> float:
    mean = np.mean([r.correlation for r in runs], axis=0)
    lags = np.concatenate([[0.0], runs[0].lag_mm])
    values = np.concatenate([[1.0], mean])
    below = np.flatnonzero(values < np.exp(-1.0))
    if not len(below):
        return float(lags[-1])
    i = int(below[0])
    part = (values[i - 1] - np.exp(-1.0)) / (values[i - 1] - values[i])
    return float(lags[i - 1] + part * (lags[i] - lags[i - 1]))
