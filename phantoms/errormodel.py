"""The error model that an accuracy study amounts to, and whether it holds on heels that it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import InputError
from dvc.uncertainty import POOLED, ErrorModel, ErrorTable
from phantoms.accuracy import SOFT, by_condition, of_tissue
from phantoms.study import Samples

_KNOTS = np.array([0.005, 0.015, 0.03, 0.05, 0.08, 0.12, 0.18, 0.25, 0.35, 0.5])
_EDGES = np.concatenate([[0.0], 0.5 * (_KNOTS[1:] + _KNOTS[:-1]), [np.inf]])
_BONE_MM = np.array([0.0, 2.0, 4.0, 8.0])
_PRIOR = 400.0  # samples that a cell's parent counts for
_FEW = 50.0


@dataclass(frozen=True, slots=True)
class CoverageRow:
    """How often the truth lay within 1.96 standard deviations of what the error model of the other heels says.

    Attributes
    ----------
    preset, voxel_mm, snr, motion, tissue
        As in `ErrorRow`.
    within : float
        Share of the samples; 0.95 if the error model is right.
    left_over : float
        Mean of the error less its expected bias.
    """

    preset: str
    voxel_mm: str
    snr: float
    motion: str
    tissue: str
    within: float
    left_over: float


def fit_error_model(runs: Sequence[Samples], source: str) -> ErrorModel:
    """Fit the error of the maximal shear, as `register` uses it, to all motions but waves.

    Parameters
    ----------
    runs : sequence of Samples
        Of one preset.
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
    tables = tuple(_table(some) for _, some in by_condition(plain))
    return ErrorModel(Path(presets.pop()).name, tables, source)


def coverage_rows(runs: Sequence[Samples]) -> list[CoverageRow]:
    """Judge the error model on heels that it has not seen: each heel by a model fitted to all others.

    Conditions with one heel alone have no rows.
    """
    rows = []
    for condition, some in by_condition([r for r in runs if r.case.wavelength_mm is None]):
        seeds = sorted({r.case.seed for r in some})
        if len(seeds) < 2:
            continue
        tables = {seed: _table([r for r in some if r.case.seed != seed]) for seed in seeds}
        for motion in dict.fromkeys(r.case.motion for r in some):
            for tissue in (*SOFT, POOLED):
                left, within = [], []
                for run in (r for r in some if r.case.motion == motion):
                    kept = of_tissue(run, tissue)
                    shear = run.shear[kept].astype(np.float64)
                    bias, sd = tables[run.case.seed].expected(tissue, shear, run.to_bone_mm[kept])
                    left.append(shear - run.true_shear[kept] - bias)
                    within.append(np.abs(left[-1]) < 1.96 * sd)
                if sum(map(len, left)):
                    share, mean = float(np.concatenate(within).mean()), float(np.concatenate(left).mean())
                    rows.append(CoverageRow(*condition, motion, tissue, share, mean))
    return rows


def _table(runs: Sequence[Samples]) -> ErrorTable:
    rows = {tissue: _cells(runs, tissue) for tissue in (*SOFT, POOLED)}
    bias = {tissue: b for tissue, (b, _) in rows.items()}
    sd = {tissue: s for tissue, (_, s) in rows.items()}
    spacing = np.array(runs[0].case.spacing_mm)
    table = ErrorTable(
        float(np.cbrt(spacing.prod())),
        float(np.median([r.estimated_snr for r in runs])),
        _KNOTS,
        _BONE_MM,
        bias,
        sd,
        {},
        _correlation_mm(runs),
    )
    run_sd = {tissue: _between_runs(runs, tissue, table) for tissue in (*SOFT, POOLED)}
    return ErrorTable(table.voxel_mm, table.snr, table.shear, table.to_bone_mm, bias, sd, run_sd, table.correlation_mm)


def _cells(runs: Sequence[Samples], tissue: str) -> tuple[FloatArray, FloatArray]:
    """Bias and standard deviation by distance to bone and shear found.

    Cells with few samples lean on their tissue's mean over all distances, and this on that of all soft tissue.
    """
    whole = _filled(_moments(runs, POOLED, None))
    own = whole if tissue == POOLED else _leaning(_moments(runs, tissue, None), whole)
    bias, sd = np.empty((len(_BONE_MM), len(_KNOTS))), np.empty((len(_BONE_MM), len(_KNOTS)))
    for k in range(len(_BONE_MM)):
        _, mean, square = _leaning(_moments(runs, tissue, k), own)
        bias[k], sd[k] = mean, np.sqrt(np.maximum(square - mean**2, 1e-10))
    return bias, sd


_Moments = tuple[FloatArray, FloatArray, FloatArray]


def _moments(runs: Sequence[Samples], tissue: str, bone_bin: int | None) -> _Moments:
    """Number, mean and mean square of the errors by shear found; every run counts the same."""
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


def _between_runs(runs: Sequence[Samples], tissue: str, table: ErrorTable) -> float:
    left = []
    for run in runs:
        kept = of_tissue(run, tissue)
        if np.count_nonzero(kept) > 100:
            expected, _ = table.expected(tissue, run.shear[kept].astype(np.float64), run.to_bone_mm[kept])
            left.append(float(np.mean((run.shear - run.true_shear)[kept] - expected)))
    return float(np.sqrt(np.mean(np.square(left)))) if left else 0.0


def _correlation_mm(runs: Sequence[Samples]) -> float:
    mean = np.mean([r.correlation for r in runs], axis=0)
    lags = np.concatenate([[0.0], runs[0].lag_mm])
    values = np.concatenate([[1.0], mean])
    below = np.flatnonzero(values < np.exp(-1.0))
    if not len(below):
        return float(lags[-1])
    i = int(below[0])
    part = (values[i - 1] - np.exp(-1.0)) / (values[i - 1] - values[i])
    return float(lags[i - 1] + part * (lags[i] - lags[i - 1]))
