"""Error bars judged by a pair whose strain is known: the twin of the very pair that they stand on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.uncertainty import Uncertainty

_SURE = 0.95
_DEVIATIONS = 1.96
_PERCENTILES = (50.0, 90.0, 95.0)
_FIGURES = ("median", "p90", "p95")
_FEW = 50


@dataclass(frozen=True, slots=True)
class Judged:
    """How a tissue's maximal shear came back from the twin.

    Attributes
    ----------
    region : str
    rms_error, bias : float
        Of the shear found in the twin less the twin's own, which is that measured.
    held : float or None
        Share of voxels whose error is under 1.96 times the root of bias squared and variance that the error model
        tells; None without an error model.
    factor : float or None
        By how much error bars have to be wider for that share to be 95 %, and for the tissue's median, 90th and 95th
        percentile to come back nearer than the far end of their intervals: at least 1.

    Notes
    -----
    The model's bias need not come back: noise lifts a shear, and the twin's own, having been measured, is lifted
    already. So bias counts as part of the error that is claimed, whatever its sign.
    """

    region: str
    rms_error: float
    bias: float
    held: float | None
    factor: float | None


def judged(
    measured: Float32Array,
    again: Float32Array,
    regions: Mapping[str, BoolArray],
    to_bone_mm: Float32Array | None = None,
    of_twin: Uncertainty | None = None,
) -> tuple[Judged, ...]:
    """Judge error bars by the maximal shear found in a pair whose true one is known.

    Parameters
    ----------
    measured, again : (ni, nj, nk)
        The true maximal shear, and that found; NaN where not defined.
    regions : mapping of name to (ni, nj, nk) bool
    to_bone_mm : (ni, nj, nk), optional
        Distance to bone, mm.
    of_twin : Uncertainty, optional
        What the error model says of the shear found; neither where there is none.
    """
    return tuple(
        _region(name, kept, measured, again, to_bone_mm, of_twin)
        for name, inside in regions.items()
        if np.count_nonzero(kept := inside & np.isfinite(measured) & np.isfinite(again)) >= _FEW
    )


def _region(
    name: str,
    kept: BoolArray,
    measured: Float32Array,
    again: Float32Array,
    to_bone_mm: Float32Array | None,
    of_twin: Uncertainty | None,
) -> Judged:
    true, found = measured[kept].astype(np.float64), again[kept].astype(np.float64)
    error = found - true
    rms, bias = float(np.sqrt(np.mean(error**2))), float(error.mean())
    if of_twin is None or to_bone_mm is None:
        return Judged(name, rms, bias, None, None)
    expected, sd = of_twin.table.expected(name, found, to_bone_mm[kept])
    off = np.abs(error) / (_DEVIATIONS * np.maximum(np.hypot(expected, sd), 1e-9))
    wider = max(1.0, float(np.quantile(off, _SURE)), *_figures(name, true, of_twin))
    return Judged(name, rms, bias, float(np.mean(off <= 1.0)), wider)


def _figures(name: str, true: FloatArray, of_twin: Uncertainty) -> list[float]:
    """How far from a tissue's true figures those of the twin lie, in units of the far end of their intervals."""
    figures = dict(zip(_FIGURES, np.percentile(true, _PERCENTILES), strict=True))
    return [
        float(abs(interval.found - figures[interval.figure]))
        / max(interval.high - interval.found, interval.found - interval.low, 1e-9)
        for interval in of_twin.intervals
        if interval.region == name and interval.figure in figures
    ]
