"""Bias and standard deviation of the errors of an accuracy study's runs, by tissue, distance to bone and shear."""

from collections.abc import Sequence

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import InputError
from dvc.trust.components import NORMAL, SHEAR
from dvc.trust.error_model import POOLED
from phantoms.accuracy_run import ErrorSamples
from phantoms.error_tables import SOFT, of_tissue

KNOTS = np.array([0.005, 0.015, 0.03, 0.05, 0.08, 0.12, 0.18, 0.25, 0.35, 0.5])
BONE_MM = np.array([0.0, 2.0, 4.0, 8.0])
FEW = 50.0  # samples
_EDGES = np.concatenate([[0.0], 0.5 * (KNOTS[1:] + KNOTS[:-1]), [np.inf]])
_PRIOR = 400.0  # samples that the prior of a cell counts for


def errors_by_cell(runs: Sequence[ErrorSamples]) -> tuple[dict[str, FloatArray], list[dict[str, FloatArray]]]:
    """Rows of an error table (`dvc.trust.error_model.ROWS`) over all runs, and in each of them, by tissue.

    Every sample has the same weight.
    """
    tissues = *SOFT, POOLED
    each = {tissue: [_moments(run, tissue) for run in runs] for tissue in tissues}  # (rows, k + 1, m) of every run
    of_all = {tissue: _mean(some) for tissue, some in each.items()}
    pooled = _filled(of_all[POOLED][:, -1])
    # The prior of a cell is its tissue's mean over all distances, whose own prior is that of all soft tissue.
    priors = {tissue: _with_prior(of_all[tissue][:, -1], pooled) for tissue in SOFT} | {POOLED: pooled}
    cells = {tissue: _with_prior(of_all[tissue][:, :-1], priors[tissue][:, None]) for tissue in tissues}
    own = [
        {tissue: _with_prior(each[tissue][n][:, :-1], cells[tissue]) for tissue in tissues} for n in range(len(runs))
    ]
    return {t: _rows(of) for t, of in cells.items()}, [{t: _rows(of) for t, of in some.items()} for some in own]


def _moments(run: ErrorSamples, tissue: str) -> FloatArray:
    """Number, then means of the products of errors, by distance to bone (k, and over all) and shear, (10, k + 1, m).

    Products: e, e^2 of the maximum shear strain; of normal and of shear components e E, E^2 and e^2 (e the error, E the
    measured strain); and the square of a component of the displacement's error.
    """
    kept = of_tissue(run.tissue, tissue)
    cell = np.searchsorted(_EDGES, run.shear[kept], side="right") - 1
    place = np.searchsorted(BONE_MM, run.to_bone_mm[kept], side="right") - 1
    error = (run.shear - run.true_shear)[kept].astype(np.float64)
    products = [np.ones(len(error)), error, error**2]
    e, E = run.strain_error[kept].astype(np.float64), run.strain[kept].astype(np.float64)
    for of in (NORMAL, SHEAR):
        products += [np.mean(a[:, of] * b[:, of], axis=1) for a, b in ((e, E), (E, E), (e, e))]
    products.append(np.mean(run.u_error_mm[kept].astype(np.float64) ** 2, axis=1))
    shape = (len(BONE_MM), len(KNOTS))
    index = np.ravel_multi_index((place, cell), shape)
    sums = np.stack([np.bincount(index, p, minlength=shape[0] * shape[1]).reshape(shape) for p in products])
    sums = np.concatenate([sums, sums.sum(axis=1, keepdims=True)], axis=1)
    return np.concatenate([sums[:1], sums[1:] / np.maximum(sums[0], 1.0)])


def _mean(moments: Sequence[FloatArray]) -> FloatArray:
    """Moments over several runs."""
    each = np.array(moments)
    count = each[:, 0].sum(axis=0)
    return np.stack([count, *(np.sum(each[:, 1:] * each[:, :1], axis=0) / np.maximum(count, 1.0))])


def _filled(moments: FloatArray) -> FloatArray:
    """Moments (r, m) in which shears with few samples take those of the nearest with enough."""
    often = np.flatnonzero(moments[0] >= FEW)
    if not len(often):
        raise InputError(f"An error model needs at least {FEW:.0f} samples of soft tissue.")
    nearest = often[np.argmin(np.abs(KNOTS[:, None] - KNOTS[often]), axis=1)]
    return np.stack([moments[0], *moments[1:, nearest]])


def _with_prior(own: FloatArray, prior: FloatArray) -> FloatArray:
    """Moments averaged with a prior that counts for 400 samples."""
    weight = own[0] / (own[0] + _PRIOR)
    return np.stack([own[0] + _PRIOR, *(weight * own[1:] + (1 - weight) * prior[1:])])


def _rows(moments: FloatArray) -> FloatArray:
    """Rows of an error table (6, k, m) from moments (10, k, m)."""
    _, mean, square, eE_n, EE_n, ee_n, eE_s, EE_s, ee_s, uu = moments
    # Least squares over all components of the tensor, in which a shear component stands twice.
    shrinkage = (eE_n + 2.0 * eE_s) / np.maximum(EE_n + 2.0 * EE_s, 1e-12)
    left = [ee - 2.0 * shrinkage * eE + shrinkage**2 * EE for eE, EE, ee in ((eE_n, EE_n, ee_n), (eE_s, EE_s, ee_s))]
    variances = [square - mean**2, *left, uu]
    sd, normal, shear, displacement = (np.sqrt(np.maximum(v, 1e-10)) for v in variances)
    return np.stack([mean, sd, shrinkage, normal, shear, displacement])
