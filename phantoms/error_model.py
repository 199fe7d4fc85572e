"""The error model fitted to the runs of an accuracy study, and its coverage on motions that it was not fitted to."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvc import ErrorModel, ErrorTable
from dvc.arrays import BoolArray, FloatArray
from dvc.errors import InputError
from dvc.trust.components import NORMAL, SHEAR
from dvc.trust.error_model import POOLED
from dvc.trust.uncertainty import statistics_of, widened
from phantoms.accuracy_run import ErrorSamples
from phantoms.error_moments import BONE_MM, FEW, KNOTS, errors_by_cell
from phantoms.error_tables import SOFT, OfCondition, by_condition, of_tissue

_THRESHOLDS = (0.1, 0.3)
_DRAWS = 8  # of each training run, when coverage of the intervals is evaluated
_OF_OTHERS = 0.97  # of the statistics of other motions
_SOME = 20_000  # of a tissue's samples that statistics are drawn of


@dataclass(frozen=True, slots=True)
class CoverageRow(OfCondition):
    """How often the truth lies where an error model fitted to other motions predicts; the rest as in `ErrorRow`.

    Attributes
    ----------
    voxels_within : float
        Fraction of the samples whose truth lies within 1.96 standard deviations; 0.95 if the model is right.
    left_over : float
        Mean error minus its expected bias.
    statistics_within : float
        Fraction of the tissue's statistics (median, 90th and 95th percentile, volumes above 0.1 and 0.3) inside their
        intervals, over the runs; 0.95 over all motions and tissues by construction of the widening. The correlated
        field of the intervals is left out, because it averages out over a tissue.
    normal_strain_within, shear_strain_within, displacement_within : float
        As ``voxels_within``, of the components of the strain and of the displacement; NaN where the model has none.
    """

    motion: str
    tissue: str
    voxels_within: float
    left_over: float
    statistics_within: float
    normal_strain_within: float = float("nan")
    shear_strain_within: float = float("nan")
    displacement_within: float = float("nan")


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


def widened_for(model: ErrorModel, runs: Sequence[ErrorSamples]) -> ErrorModel:
    """Widen the intervals of an error model, in all its conditions, by runs of motions that it was not fitted to.

    They then hold 97 % of the statistics of each tissue, and of soft tissue as a whole, in these runs: more than
    95 %, as motions differ. InputError if a run has no table that is close.
    """
    scores: dict[str, list[FloatArray]] = {}
    for run in runs:
        table = model.table_for(np.array(run.case.spacing_mm), run.estimated_snr)
        for tissue in (*(tissue for _, tissue in _large([run])), POOLED):
            scores.setdefault(tissue, []).append(_scores(run, tissue, table))
    factors = {t: max(1.0, round(float(np.quantile(np.concatenate(s), _OF_OTHERS)), 3)) for t, s in scores.items()}
    whole = factors.pop(POOLED)
    return replace(model, tables=tuple(replace(t, widening=whole, widening_of=factors) for t in model.tables))


def coverage_rows(runs: Sequence[ErrorSamples], model: ErrorModel | None = None) -> list[CoverageRow]:
    """Coverage of an error model on these runs.

    By default by cross-validation: each motion is compared with a model fitted to all other motions, or each heel with
    the others, where there is only one motion. Conditions with a single run have no rows.
    """
    rows = []
    for condition, some in by_condition([r for r in runs if r.case.wavelength_mm is None]):
        if model is None:
            validations = _validations(some)
            factor: float | None = _widening(validations)
        else:
            table = model.table_for(np.array(some[0].case.spacing_mm), some[0].estimated_snr)
            validations, factor = [_validated(run, tissue, table) for run, tissue in _large(some)], None
        for motion, tissue in dict.fromkeys((v.motion, v.tissue) for v in validations):
            mine = [v for v in validations if (v.motion, v.tissue) == (motion, tissue)]
            within, *components = (
                float(np.concatenate(some).mean()) for some in zip(*(v.within for v in mine), strict=True)
            )
            remaining = float(np.concatenate([v.remaining for v in mine]).mean())
            statistics = float(
                np.mean([v.scores <= (table.factor_of(tissue) if factor is None else factor) for v in mine])
            )
            rows.append(CoverageRow(*condition, motion, tissue, within, remaining, statistics, *components))
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class _Validation:
    """One tissue of one run, compared with a model of others."""

    motion: str
    tissue: str
    remaining: FloatArray  # errors of the maximum shear strain (n,) minus their expected bias
    within: tuple[BoolArray, ...]  # whether the errors are within 1.96 standard deviations: of shear and of components
    scores: FloatArray  # distance of the true statistics from the draws' middle, over the interval on that side


def _validations(runs: Sequence[ErrorSamples]) -> list[_Validation]:
    """Every tissue of runs of one condition, each motion without those of its own; empty for a single run."""
    several = len({r.case.motion for r in runs}) > 1
    groups: dict[str | int, list[ErrorSamples]] = {}
    for run in runs:
        groups.setdefault(run.case.motion if several else run.case.seed, []).append(run)
    if len(groups) < 2:
        return []
    tables = {group: _table([r for other, some in groups.items() if other != group for r in some]) for group in groups}
    return [_validated(run, tissue, tables[group]) for group, mine in groups.items() for run, tissue in _large(mine)]


def _large(runs: Sequence[ErrorSamples]) -> list[tuple[ErrorSamples, str]]:
    """The soft tissues of each run that have enough samples."""
    return [(r, tissue) for r in runs for tissue in SOFT if np.count_nonzero(of_tissue(r.tissue, tissue)) >= FEW]


def _table(runs: Sequence[ErrorSamples]) -> ErrorTable:
    """Errors of runs of one condition, for all runs together and for each run, by tissue; not calibrated."""
    whole, each = errors_by_cell(runs)
    snr = float(np.median([r.estimated_snr for r in runs]))
    shear_mm, *component_mm = (_correlation_mm(runs, n) for n in range(3))
    table = ErrorTable(
        np.array(runs[0].case.spacing_mm), snr, KNOTS, BONE_MM, whole, tuple(each), shear_mm,
        component_correlation_mm=(component_mm[0], component_mm[1]),
    )  # fmt: skip
    return replace(table, shared={tissue: _shared(runs, tissue, table) for tissue in (*SOFT, POOLED)})


def _shared(runs: Sequence[ErrorSamples], tissue: str, table: ErrorTable) -> FloatArray:
    """Fraction of the variance of the components' errors that is the same in all voxels of a run: strain, displacement.

    As if all that the mean over the tissue varies by were that part; zeros where the tissue is nowhere.
    """
    of_means, of_all = np.zeros((2, 2))
    for run in runs:
        kept = of_tissue(run.tissue, tissue)
        if np.count_nonzero(kept) < FEW:
            continue
        shear = run.shear[kept].astype(np.float64)
        shrinkage = table.expected_components(tissue, shear, run.to_bone_mm[kept])[0]
        left = run.strain_error[kept] - shrinkage[:, None] * run.strain[kept], run.u_error_mm[kept].astype(np.float64)
        of_means += [np.mean(error.mean(axis=0) ** 2) for error in left]
        of_all += [np.mean(error**2) for error in left]
    return of_means / np.maximum(of_all, 1e-12)


def _widening(validations: Sequence[_Validation]) -> float:
    """Factor by which 95 % of the statistics lie in their intervals, at least 1; NaN without a validation."""
    if not validations:
        return float("nan")
    return max(1.0, float(np.quantile(np.concatenate([v.scores for v in validations]), 0.95)))


def _validated(run: ErrorSamples, tissue: str, table: ErrorTable) -> _Validation:
    kept = of_tissue(run.tissue, tissue)
    shear, true = run.shear[kept].astype(np.float64), run.true_shear[kept].astype(np.float64)
    at_mm = run.to_bone_mm[kept]
    bias, sd = table.expected(tissue, shear, at_mm)
    remaining = shear - true - bias
    within = [np.abs(remaining) < 1.96 * sd]
    if table.has_components:
        shrinkage, normal, sheared, displaced = table.expected_components(tissue, shear, at_mm)[:, :, None]
        left = np.abs(run.strain_error[kept] - shrinkage * run.strain[kept])
        within += [left[:, NORMAL] < 1.96 * normal, left[:, SHEAR] < 1.96 * sheared]
        within.append(np.abs(run.u_error_mm[kept]) < 1.96 * displaced)
    return _Validation(run.case.motion, tissue, remaining, tuple(within), _scores(run, tissue, table))


def _scores(run: ErrorSamples, tissue: str, table: ErrorTable) -> FloatArray:
    """Distance of the true statistics of a tissue from the middle of those drawn, in units of the interval there.

    Soft tissue is drawn tissue by tissue, and its statistics are those of all.
    """
    random, names = np.random.default_rng(1), SOFT if tissue == POOLED else (tissue,)
    apart = -(-np.count_nonzero(of_tissue(run.tissue, tissue)) // _SOME)
    parts = [of_tissue(run.tissue, name) for name in names]
    shear = [run.shear[part][::apart].astype(np.float64) for part in parts]
    at_mm, every, draws = [run.to_bone_mm[part][::apart] for part in parts], np.concatenate(shear), []
    for registration in range(len(table.runs)):
        expected = [
            table.expected(name, measured, mm, registration)
            for name, measured, mm in zip(names, shear, at_mm, strict=True)
        ]
        bias, sd = (np.concatenate(rows) for rows in zip(*expected, strict=True))
        for _ in range(_DRAWS):
            drawn = np.maximum(every - bias - sd * random.standard_normal(len(bias)), 0.0)
            draws.append(statistics_of(drawn, 1.0, _THRESHOLDS))
    low, middle, high = widened(np.array(draws), 1.0)
    off = statistics_of(run.true_shear[of_tissue(run.tissue, tissue)].astype(np.float64), 1.0, _THRESHOLDS) - middle
    reach = np.where(off < 0, middle - low, high - middle)
    return np.where(off == 0, 0.0, np.abs(off) / np.maximum(reach, 1e-9))


def _correlation_mm(runs: Sequence[ErrorSamples], row: int) -> float:
    """Distance at which the mean autocorrelation of an error falls to 1/e, mm."""
    values = np.concatenate([[1.0], np.mean([r.correlation[row] for r in runs], axis=0)])
    lags = np.concatenate([[0.0], runs[0].lag_mm])
    below = np.flatnonzero(values < np.exp(-1.0))
    if not len(below):
        return float(lags[-1])
    i = int(below[0])
    part = (values[i - 1] - np.exp(-1.0)) / (values[i - 1] - values[i])
    return float(lags[i - 1] + part * (lags[i] - lags[i - 1]))
