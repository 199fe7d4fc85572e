"""The error model fitted to the runs of an accuracy study, and its coverage on motions that it was not fitted to."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvc import ErrorModel, ErrorTable
from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.errors import InputError
from dvc.trust.components import NORMAL, SHEAR
from dvc.trust.error_model import POOLED, SCALED
from dvc.trust.uncertainty import figures_of, widened
from phantoms.accuracy_run import ErrorSamples
from phantoms.error_moments import BONE_MM, FEW, KNOTS, errors_by_cell
from phantoms.error_tables import SOFT, OfCondition, by_condition, of_tissue

_THRESHOLDS = (0.1, 0.3)
_DRAWS = 8  # of each training run, when coverage of the intervals is evaluated
_SOME = 20_000  # of a tissue's samples that figures are drawn of
_PRIOR = 400.0  # voxels that the factor of all distances counts for


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
    tables = tuple(_calibrated(some) for _, some in by_condition(plain))
    digest = hashlib.sha256(parameters.encode()).hexdigest()
    return ErrorModel(Path(presets.pop()).name, digest, tables, source)


def coverage_rows(runs: Sequence[ErrorSamples], model: ErrorModel | None = None) -> list[CoverageRow]:
    """Coverage of an error model on these runs.

    By default by cross-validation: each kind of motion is compared with a model fitted to all other kinds, or each
    heel with the others, where there is only one kind. Conditions with a single heel have no rows.
    """
    rows = []
    for condition, some in by_condition([r for r in runs if r.case.wavelength_mm is None]):
        if model is None:
            validations = _validations(some)
            table = replace(_table(some), scales=_scales(validations), widening=_widening(validations))
        else:
            table = model.table_for(np.array(some[0].case.spacing_mm), some[0].estimated_snr)
            as_drawn = replace(table, scales={})
            validations = [_validated(run, tissue, as_drawn) for run, tissue in _large(some)]
        for motion, tissue in dict.fromkeys((v.run.case.motion, v.tissue) for v in validations):
            mine = [v for v in validations if (v.run.case.motion, v.tissue) == (motion, tissue)]
            within = {name: float(np.mean(np.concatenate([v.within(name, table) for v in mine]))) for name in SCALED}
            remaining = float(np.concatenate([v.remaining for v in mine]).mean())
            figures = float(np.mean([v.scores <= table.factor for v in mine]))
            rows.append(CoverageRow(*condition, motion, tissue, within["sd"], remaining, figures))
    return rows


@dataclass(frozen=True, slots=True, eq=False)
class _Validation:
    """One tissue of one run, compared with a model of others."""

    run: ErrorSamples
    tissue: str
    to_bone_mm: Float32Array
    remaining: FloatArray  # errors of the maximum shear strain (n,) minus their expected bias
    off: Mapping[str, FloatArray]  # size of the errors of `SCALED` in standard deviations (n, components), not scaled
    scores: FloatArray  # distance of the true figures from the draws' middle, in units of their interval on that side

    def within(self, name: str, table: ErrorTable) -> BoolArray:
        """Whether each error (n, components) is within 1.96 of a table's scaled standard deviations."""
        return self.off[name] < 1.96 * table.scale(name, self.tissue, self.to_bone_mm)[:, None]


def _validations(runs: Sequence[ErrorSamples]) -> list[_Validation]:
    """Every tissue of runs of one condition; empty with a single heel."""
    if len({r.case.seed for r in runs}) < 2:
        return []
    several = len({r.case.kind for r in runs}) > 1
    groups: dict[str | int, list[ErrorSamples]] = {}
    for run in runs:
        groups.setdefault(run.case.kind if several else run.case.seed, []).append(run)
    return [
        _validated(run, tissue, _table([r for other, some in groups.items() if other != group for r in some]))
        for group, mine in groups.items()
        for run, tissue in _large(mine)
    ]


def _large(runs: Sequence[ErrorSamples]) -> list[tuple[ErrorSamples, str]]:
    """The soft tissues of each run that have enough samples."""
    return [(r, tissue) for r in runs for tissue in SOFT if np.count_nonzero(of_tissue(r.tissue, tissue)) >= FEW]


def _calibrated(runs: Sequence[ErrorSamples]) -> ErrorTable:
    """The table of runs of one condition, with scales and widening."""
    validations = _validations(runs)
    return replace(_table(runs), scales=_scales(validations), widening=_widening(validations))


def _table(runs: Sequence[ErrorSamples]) -> ErrorTable:
    """Errors of runs of one condition, for all runs together and for each run, by tissue; not calibrated."""
    whole, each = errors_by_cell(runs)
    snr = float(np.median([r.estimated_snr for r in runs]))
    shear_mm, *component_mm = (_correlation_mm(runs, n) for n in range(3))
    return ErrorTable(
        np.array(runs[0].case.spacing_mm), snr, KNOTS, BONE_MM, whole, tuple(each), shear_mm,
        component_correlation_mm=(component_mm[0], component_mm[1]),
    )  # fmt: skip


def _scales(validations: Sequence[_Validation]) -> dict[str, FloatArray]:
    """Factors (4, k) by tissue on the standard deviations, by which they hold in every kind of motion."""
    if not validations:
        return {}
    of = {tissue: [v for v in validations if v.tissue == tissue] for tissue in {v.tissue for v in validations}}
    return {t: np.stack([_scale(some, n) for n in SCALED]) for t, some in {**of, POOLED: validations}.items()}


def _scale(validations: Sequence[_Validation], name: str) -> FloatArray:
    """Factor (k,) by distance to bone with which 95 % of the voxels of every kind lie within 1.96 deviations.

    The factor of few voxels goes towards that of all distances.
    """
    factors = []
    for kind in {v.run.case.kind for v in validations}:
        mine = [v for v in validations if v.run.case.kind == kind]
        off = np.concatenate([v.off[name] for v in mine])
        bins = np.searchsorted(BONE_MM, np.concatenate([v.to_bone_mm for v in mine]), side="right") - 1
        of_all = np.quantile(off, 0.95)
        some = [off[bins == k] for k in range(len(BONE_MM))]
        share = np.array([len(s) / (len(s) + _PRIOR) for s in some])
        factors.append(share * [np.quantile(s, 0.95) if len(s) else of_all for s in some] + (1.0 - share) * of_all)
    return np.asarray(np.max(factors, axis=0) / 1.96)


def _widening(validations: Sequence[_Validation]) -> float:
    """Factor by which 95 % of the figures lie in their intervals, at least 1; NaN without a validation."""
    if not validations:
        return float("nan")
    return max(1.0, float(np.quantile(np.concatenate([v.scores for v in validations]), 0.95)))


def _validated(run: ErrorSamples, tissue: str, table: ErrorTable) -> _Validation:
    kept = of_tissue(run.tissue, tissue)
    shear, true = run.shear[kept].astype(np.float64), run.true_shear[kept].astype(np.float64)
    at_mm = run.to_bone_mm[kept]
    bias, sd = table.expected(tissue, shear, at_mm)
    remaining = shear - true - bias
    off = {"sd": np.abs(remaining / sd)[:, None]}
    if table.has_components:
        shrinkage, normal, sheared, displaced = table.expected_components(tissue, shear, at_mm)[:, :, None]
        left = run.strain_error[kept] - shrinkage * run.strain[kept]
        off |= {"sd_normal": np.abs(left[:, NORMAL] / normal), "sd_shear": np.abs(left[:, SHEAR] / sheared)}
        off["sd_displacement_mm"] = np.abs(run.u_error_mm[kept] / displaced)
    return _Validation(run, tissue, at_mm, remaining, off, _scores(shear, true, tissue, at_mm, table))


def _scores(
    shear: FloatArray, true: FloatArray, tissue: str, to_bone_mm: Float32Array, table: ErrorTable
) -> FloatArray:
    """Distance of the true figures of a tissue from the middle of figures drawn, in units of the interval there."""
    random, few = np.random.default_rng(1), slice(None, None, -(-len(shear) // _SOME))
    some, at_mm, draws = shear[few], to_bone_mm[few], []
    for number in range(len(table.runs)):
        b, s = table.expected(tissue, some, at_mm, number)
        for _ in range(_DRAWS):
            drawn = np.maximum(some - b - s * random.standard_normal(len(b)), 0.0)
            draws.append(figures_of(drawn, 1.0, _THRESHOLDS))
    low, middle, high = widened(np.array(draws), 1.0)
    off = figures_of(true, 1.0, _THRESHOLDS) - middle
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
