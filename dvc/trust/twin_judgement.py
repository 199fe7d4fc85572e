"""Error bars judged by a pair whose strain is known: a synthetic warp of the very pair that they are for, its twin."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr, ndtri

from dvc.arrays import BoolArray, Float32Array, FloatArray
from dvc.trust.uncertainty import Uncertainty

_SURE = 0.95
_DEVIATIONS = 1.96
_STATISTICS = {"median": 50.0, "p90": 90.0, "p95": 95.0}
_FEW = 50


@dataclass(frozen=True, slots=True)
class Judged:
    """How a tissue's maximum shear strain came back from the twin.

    The model's bias need not come back: noise lifts a shear, and the twin's own, having been measured, is lifted
    already. So bias counts as part of the error that is claimed, whatever its sign. Without an error model there are no
    claims.
    """

    region: str
    rms_error: float  # of the shear measured in the twin less the twin's own, which is that measured in the pair
    bias: float
    held: float | None = None  # share of voxels whose error is under 1.96 sqrt(bias^2 + sd^2), as claimed
    # Least share at which the claims are believed: of twenty registrations of the study, one has less; at most 0.95.
    expected: float | None = None
    # At least 1: how much wider deviation and intervals have to be for 95 % of the voxels, where fewer are held than
    # expected, and for median, 90th and 95th percentile to come back no farther than the far end of their intervals.
    factor: float | None = None


def judged(
    measured: Float32Array,
    again: Float32Array,
    regions: Mapping[str, BoolArray],
    to_bone_mm: Float32Array | None = None,
    of_twin: Uncertainty | None = None,
    voxel_mm3: float = 1.0,
) -> tuple[Judged, ...]:
    """Judge error bars by the maximum shear strain measured ``again`` in a pair of known strain, (ni, nj, nk) or NaN.

    Regions (masks by name) of fewer than 50 voxels are not judged. ``of_twin`` is what the error model says of the
    shear measured again, at the voxels where both are defined, with the distance to bone; without these two, or either,
    errors alone are given.
    """
    rows = []
    for name, inside in regions.items():
        kept = inside & np.isfinite(measured) & np.isfinite(again)
        if np.count_nonzero(kept) < _FEW:
            continue
        true, found = measured[kept].astype(np.float64), again[kept].astype(np.float64)
        error = found - true
        rms, bias = float(np.sqrt(np.mean(error**2))), float(error.mean())
        if of_twin is None or to_bone_mm is None:
            rows.append(Judged(name, rms, bias))
            continue
        claimed, sd = of_twin.table.expected(name, found, to_bone_mm[kept])
        sd = np.maximum(sd, 1e-9)
        expected = _believed(name, found, to_bone_mm[kept], of_twin, np.hypot(claimed, sd), voxel_mm3)
        needed = np.sqrt(np.maximum((error / _DEVIATIONS) ** 2 - claimed**2, 0.0)) / sd  # factor for each voxel
        held = float(np.mean(needed <= 1.0))
        of_voxels = float(np.quantile(needed, _SURE)) if held < expected else 1.0
        rows.append(Judged(name, rms, bias, held, expected, max(1.0, of_voxels, *_statistics(name, true, of_twin))))
    return tuple(rows)


def _believed(
    name: str, found: FloatArray, to_bone_mm: Float32Array, of_twin: Uncertainty, claimed: FloatArray, voxel_mm3: float
) -> float:
    """The share of voxels that one in twenty registrations of the study would not reach."""
    table, shares = of_twin.table, []
    for run in range(len(table.runs)):
        bias, sd = table.expected(name, found, to_bone_mm, run)
        sd = np.maximum(sd, 1e-9)
        reach = _DEVIATIONS * claimed
        shares.append(float(np.mean(ndtr((reach - bias) / sd) - ndtr((-reach - bias) / sd))))
    share = min(_SURE, float(np.quantile(shares, 1.0 - _SURE)))
    apart = max(1.0, len(found) * voxel_mm3 / table.correlation_mm**3)  # voxels nearer than that say the same
    return max(0.0, share - float(ndtri(_SURE)) * float(np.sqrt(share * (1.0 - share) / apart)))


def _statistics(name: str, true: FloatArray, of_twin: Uncertainty) -> list[float]:
    """By how much the intervals of a tissue's statistics have to be wider for each to come back within the far end."""
    factors = []
    for interval in of_twin.intervals:
        if interval.region == name and interval.statistic in _STATISTICS:
            off = abs(interval.found - float(np.percentile(true, _STATISTICS[interval.statistic])))
            above = off + interval.found - interval.estimate, interval.high - interval.estimate
            below = off - interval.found + interval.estimate, interval.estimate - interval.low
            factors.append(min(reach / max(now, 1e-9) for reach, now in (above, below)))
    return factors
