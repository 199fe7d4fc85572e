"""The error model fitted to the runs of an accuracy study, and its coverage on heels that it was not fitted to."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from dvc import ErrorModel, ErrorTable
from dvc.arrays import BoolArray, FloatArray
from dvc.errors import InputError
from dvc.trust.error_model import POOLED, figures_of, widened
from phantoms.accuracy_run import ErrorSamples
from phantoms.error_tables import SOFT, OfCondition, by_condition, of_tissue

_KNOTS = np.array([0.005, 0.015, 0.03, 0.05, 0.08, 0.12, 0.18, 0.25, 0.35, 0.5])
_EDGES = np.concatenate([[0.0], 0.5 * (_KNOTS[1:] + _KNOTS[:-1]), [np.inf]])
_BONE_MM = np.array([0.0, 2.0, 4.0, 8.0])
_PRIOR = 400.0  # samples that the prior of a cell counts for
_FEW = 50.0
_THRESHOLDS = (0.1, 0.3)
_DRAWS = 8  # of each training run, when coverage of the intervals is evaluated


@dataclass(frozen=True, slots=True)
class CoverageRow(OfCondition):
    """How often the truth lies where an error model fitted to the other heels predicts; the rest as in `ErrorRow`.

    Attributes
    ----------
    voxels_within : float
        Fraction of the samples whose truth lies within 1.96 standard deviations; 0.95 if the model is right.
    left_over : float
        Mean error minus its expected bias.
    figures_within : float
        Fraction of the tissue's figures (median, 90th and 95th percentile, volumes above 0.1 and 0.3) inside their
        intervals, over the runs; 0.95 over all motions and tissues by construction of the widening. The correlated
        field of the intervals is left out, because it averages out over a tissue.
    """

    motion: str
    tissue: str
    voxels_within: float
    left_over: float
    figures_within: float


def fit_error_model(runs: Sequence[ErrorSamples], parameters: str, source: str) -> ErrorModel:
    """Fit the error of the max. shear, as `register` uses it, to all motions except shear waves.

    Parameters
    ----------
    runs : sequence of ErrorSamples
        Runs of one preset.
    parameters, source : str
        Text of the preset, and a sentence that describes the runs.

    Raises
    ------
    InputError
        If the runs are of several presets, or there is no run.
    """
    presets = {r.case.preset for r in runs}
    plain = [r for r in runs if r.case.wavelength_mm is None]
    if len(presets) != 1 or not plain:
        raise InputError(f"An error model needs one preset, and motions other than waves; got {sorted(presets)}.")
    tables = tuple(replace(_table(some), widening=_widening(_validations(some))) for _, some in by_condition(plain))
    digest = hashlib.sha256(parameters.encode()).hexdigest()
    return ErrorModel(Path(presets.pop()).name, digest, tables, source)


def coverage_rows(runs: Sequence[ErrorSamples], model: ErrorModel | None = None) -> list[CoverageRow]:
    """Coverage of an error model on these runs.

    By default by cross-validation: each heel is compared with a model fitted to all other heels. Motions are the same
    in both, and conditions with a single heel have no rows.
    """
    rows = []
    for condition, some in by_condition([r for r in runs if r.case.wavelength_mm is None]):
        if model is None:
            validations = _validations(some)
            factor = _widening(validations)
        else:
            table = model.table_for(np.array(some[0].case.spacing_mm), some[0].estimated_snr)
            validations, factor = [_validated(run, tissue, table) for run, tissue in _large(some)], table.factor
        for motion, tissue in dict.fromkeys((v.motion, v.tissue) for v in validations):
            mine = [v for v in validations if (v.motion, v.tissue) == (motion, tissue)]
            within = float(np.concatenate([v.within for v in mine]).mean())
            remaining = float(np.concatenate([v.remaining for v in mine]).mean())
            figures = float(np.mean([v.scores <= factor for v in mine]))
            rows.append(CoverageRow(*condition, motion, tissue, within, remaining, figures))
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class _Validation:
    """One tissue of one run, compared with a model of the other heels."""

    motion: str
    tissue: str
    remaining: FloatArray  # errors minus their expected bias
    within: BoolArray  # whether each of these is within 1.96 standard deviations
    scores: FloatArray  # distance of the true figures from the draws' middle, in units of their interval on that side


def _validations(runs: Sequence[ErrorSamples]) -> list[_Validation]:
    """Every tissue of runs of one condition; empty with a single heel."""
    seeds = sorted({r.case.seed for r in runs})
    if len(seeds) < 2:
        return []
    tables = {seed: _table([r for r in runs if r.case.seed != seed]) for seed in seeds}
    return [_validated(run, tissue, tables[run.case.seed]) for run, tissue in _large(runs)]


def _large(runs: Sequence[ErrorSamples]) -> list[tuple[ErrorSamples, str]]:
    """The soft tissues of each run that have enough samples."""
    return [(r, tissue) for r in runs for tissue in SOFT if np.count_nonzero(of_tissue(r.tissue, tissue)) >= _FEW]


def _widening(validations: Sequence[_Validation]) -> float:
    """Factor by which 95 % of the figures lie in their intervals, at least 1; NaN without a validation."""
    if not validations:
        return float("nan")
    return max(1.0, float(np.quantile(np.concatenate([v.scores for v in validations]), 0.95)))


def _validated(run: ErrorSamples, tissue: str, table: ErrorTable) -> _Validation:
    kept = of_tissue(run.tissue, tissue)
    shear, true = run.shear[kept].astype(np.float64), run.true_shear[kept].astype(np.float64)
    bias, sd = table.expected(tissue, shear, run.to_bone_mm[kept])
    remaining = shear - true - bias
    random = np.random.default_rng(1)
    draws = []
    for number in range(len(table.runs)):
        b, s = table.expected(tissue, shear, run.to_bone_mm[kept], number)
        for _ in range(_DRAWS):
            drawn = np.maximum(shear - b - s * random.standard_normal(len(b)), 0.0)
            draws.append(figures_of(drawn, 1.0, _THRESHOLDS))
    low, middle, high = widened(np.array(draws), 1.0)
    off = figures_of(true, 1.0, _THRESHOLDS) - middle
    reach = np.where(off < 0, middle - low, high - middle)
    scores = np.where(off == 0, 0.0, np.abs(off) / np.maximum(reach, 1e-9))
    return _Validation(run.case.motion, tissue, remaining, np.abs(remaining) < 1.96 * sd, scores)


def _table(runs: Sequence[ErrorSamples]) -> ErrorTable:
    """Errors of runs of one condition, for all runs together and for each run, by tissue."""
    tissues = (*SOFT, POOLED)
    pooled = _filled(_moments(runs, POOLED))
    # The prior of a cell is its tissue's mean over all distances, whose own prior is that of all soft tissue.
    priors = {tissue: _with_prior(_moments(runs, tissue), pooled) for tissue in SOFT} | {POOLED: pooled}
    cells = {tissue: _by_distance(runs, tissue, priors[tissue][:, None]) for tissue in tissues}
    return ErrorTable(
        np.array(runs[0].case.spacing_mm),
        float(np.median([r.estimated_snr for r in runs])),
        _KNOTS,
        _BONE_MM,
        {tissue: _bias_and_sd(of_all) for tissue, of_all in cells.items()},
        tuple({tissue: _bias_and_sd(_by_distance([r], tissue, cells[tissue])) for tissue in tissues} for r in runs),
        _correlation_mm(runs),
    )


def _by_distance(runs: Sequence[ErrorSamples], tissue: str, prior: FloatArray) -> FloatArray:
    """Moments (3, k, m) for each distance to bone, with a prior (3, 1 or k, m)."""
    bins = pairwise([*_BONE_MM, np.inf])
    return _with_prior(np.stack([_moments(runs, tissue, low, high) for low, high in bins], axis=1), prior)


def _bias_and_sd(cells: FloatArray) -> FloatArray:
    """Bias and standard deviation by distance to bone and measured shear, (2, k, m), from their moments (3, k, m)."""
    _, mean, square = cells
    return np.stack([mean, np.sqrt(np.maximum(square - mean**2, 1e-10))])


def _moments(runs: Sequence[ErrorSamples], tissue: str, low: float = 0.0, high: float = np.inf) -> FloatArray:
    """Number, mean and mean square of the errors by measured shear, (3, m), from ``low`` to ``high`` mm off bone.

    Every sample has the same weight.
    """
    count, total, square = np.zeros((3, len(_KNOTS)))
    for run in runs:
        kept = of_tissue(run.tissue, tissue) & (run.to_bone_mm >= low) & (run.to_bone_mm < high)
        cell = np.searchsorted(_EDGES, run.shear[kept], side="right") - 1
        error = (run.shear - run.true_shear)[kept].astype(np.float64)
        count += np.bincount(cell, minlength=len(_KNOTS))
        total += np.bincount(cell, error, minlength=len(_KNOTS))
        square += np.bincount(cell, error**2, minlength=len(_KNOTS))
    some = np.maximum(count, 1.0)
    return np.stack([count, total / some, square / some])


def _filled(moments: FloatArray) -> FloatArray:
    """Moments in which shears with few samples take those of the nearest with enough."""
    often = np.flatnonzero(moments[0] >= _FEW)
    if not len(often):
        raise InputError(f"An error model needs at least {_FEW:.0f} samples of soft tissue.")
    nearest = often[np.argmin(np.abs(_KNOTS[:, None] - _KNOTS[often]), axis=1)]
    return np.stack([moments[0], *moments[1:, nearest]])


def _with_prior(own: FloatArray, prior: FloatArray) -> FloatArray:
    """Moments averaged with a prior that counts for 400 samples."""
    weight = own[0] / (own[0] + _PRIOR)
    return np.stack([own[0] + _PRIOR, *(weight * own[1:] + (1 - weight) * prior[1:])])


def _correlation_mm(runs: Sequence[ErrorSamples]) -> float:
    """Distance at which the mean autocorrelation of the error falls to 1/e, mm."""
    values = np.concatenate([[1.0], np.mean([r.correlation for r in runs], axis=0)])
    lags = np.concatenate([[0.0], runs[0].lag_mm])
    below = np.flatnonzero(values < np.exp(-1.0))
    if not len(below):
        return float(lags[-1])
    i = int(below[0])
    part = (values[i - 1] - np.exp(-1.0)) / (values[i - 1] - values[i])
    return float(lags[i - 1] + part * (lags[i] - lags[i - 1]))
