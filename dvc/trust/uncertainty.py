"""Uncertainty of the maximum shear strain by an error table: in each voxel, and of the statistics of each tissue."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np

from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray
from dvc.images.image import Grid
from dvc.trust.components import ComponentUncertainty
from dvc.trust.error_model import ErrorTable
from dvc.trust.regions import SHEAR_THRESHOLDS
from dvc.trust.truth_draws import TruthDraws

_STEPS_OF_VOXELS = 2  # of the voxels at which truths of a map are drawn, within a correlation length
_MOST_NODES = 500_000  # of their lattice, which is coarser where it would have more
_FEW = 2_000  # of a tissue's voxels on it, below which all are taken
_DRAWS, _AT_ONCE = 200, 10  # truths, and those that are in memory


@dataclass(frozen=True, slots=True)
class Interval:
    """A statistic of one tissue, and the interval in which the study's registrations would put the truth."""

    region: str
    statistic: str  # such as "p95" or "volume_above_0.3_ml"
    found: float  # as measured
    estimate: float  # median of the truths drawn
    low: float  # their 2.5th and 97.5th percentile, moved away from the estimate by `ErrorTable.widening`
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Errors of a measurement.

    Attributes
    ----------
    sigma : (ni, nj, nk)
        Standard deviation of the error of the maximum shear strain about its bias; NaN where not known.
    intervals : tuple of Interval
        Of the statistics of each tissue.
    table : ErrorTable
        What they were made from.
    regions : mapping of (ni, nj, nk) bool
        The soft tissues by name.
    to_bone_mm : (ni, nj, nk) or None
        Distance to bone; None where not known, as in results of older versions.
    components : ComponentUncertainty or None
        Of the components of strain and displacement; None where the table has none.
    bias : (ni, nj, nk) or None
        Expected error of the maximum shear strain: the true value is about measured - bias, with the deviation sigma.
        None in results of older versions.
    """

    sigma: Float32Array
    intervals: tuple[Interval, ...]
    table: ErrorTable
    regions: Mapping[str, BoolArray] = field(default_factory=dict)
    to_bone_mm: Float32Array | None = None
    components: ComponentUncertainty | None = None
    bias: Float32Array | None = None


def uncertainty_of(
    max_shear: Float32Array,
    grid: Grid,
    regions: Mapping[str, BoolArray],
    to_bone_mm: Float32Array,
    table: ErrorTable,
    *,
    seed: int = 1,
    wider: Mapping[str, float] = MappingProxyType({}),
) -> Uncertainty:
    """Error of a map of maximum shear strain (ni, nj, nk), NaN where not defined, by an error table.

    For each of the soft tissues ``regions``, masks by name, at distances to bone (ni, nj, nk). Beside
    `ErrorTable.widening`, ``wider`` holds factors on the deviation and the intervals of some regions.

    The truth is drawn 200 times for all tissues at once: measured shear, less the bias of one of the study's
    registrations, drawn anew each time, less a Gaussian field of its standard deviation and of the table's correlation
    length; not below zero. The interval of the draws is widened by the factor by which 95 % of the statistics of
    motions left out lay in theirs (97 % for the models that ship). No coverage is guaranteed for other motions.
    """
    bias, sigma = (np.full(grid.shape, np.nan, dtype=np.float32) for _ in range(2))
    measured = {name: inside & np.isfinite(max_shear) for name, inside in regions.items()}
    measured = {name: where for name, where in measured.items() if where.any()}
    if not measured:
        return Uncertainty(sigma, (), table, regions, to_bone_mm, bias=bias)
    volumes = [np.count_nonzero(where) * grid.voxel_volume_mm3 / 1000.0 for where in measured.values()]
    drawn = _statistics_drawn(max_shear, grid.spacing_mm, measured, volumes, to_bone_mm, table, seed)
    names = ["median", "p90", "p95", *(f"volume_above_{t:g}_ml" for t in SHEAR_THRESHOLDS)]
    intervals = []
    for (name, where), volume, statistics in zip(measured.items(), volumes, drawn, strict=True):
        shear, factor = max_shear[where].astype(np.float64), wider.get(name, 1.0)
        bias[where], deviation = table.expected(name, shear, to_bone_mm[where])
        sigma[where] = factor * deviation
        low, middle, high = widened(statistics, factor * table.factor_of(name))
        high[3:] = np.minimum(high[3:], volume)
        each = zip(names, statistics_of(shear, volume), middle, low, high, strict=True)
        intervals += [Interval(name, statistic, *map(float, numbers)) for statistic, *numbers in each]
    return Uncertainty(sigma, tuple(intervals), table, regions, to_bone_mm, bias=bias)


def _statistics_drawn(
    max_shear: Float32Array, spacing_mm: FloatArray, measured: Mapping[str, BoolArray], volumes_ml: Sequence[float],
    to_bone_mm: Float32Array, table: ErrorTable, seed: int,
) -> FloatArray:  # fmt: skip
    """Statistics of each tissue (tissues, draws, statistics) in the truths drawn for some of their voxels."""
    body = np.any(list(measured.values()), axis=0)
    apart = _voxels_apart(body, table.correlation_mm / _STEPS_OF_VOXELS / spacing_mm)
    at = [_some_of(where, apart) for where in measured.values()]
    every = tuple(np.concatenate(axis) for axis in zip(*at, strict=True))
    ends = np.cumsum([len(some[0]) for some in at])
    tissue = np.repeat(list(measured), np.diff(ends, prepend=0)).tolist()
    points, shear = np.stack(every, axis=1) * spacing_mm, max_shear[every].astype(np.float64)
    draws = TruthDraws(points, shear, tissue, to_bone_mm[every], table, seed, np.array(apart) * spacing_mm)

    def statistics(truth: FloatArray) -> list[FloatArray]:
        return [statistics_of(*tissue) for tissue in zip(np.split(truth, ends[:-1]), volumes_ml, strict=True)]

    with ThreadPoolExecutor(1) as beside:  # statistics of one truth while the next is drawn
        few = (beside.map(statistics, (draws.drawn() for _ in range(_AT_ONCE))) for _ in range(_DRAWS // _AT_ONCE))
        drawn = [each for some in few for each in some]
    return np.swapaxes(drawn, 0, 1)


def _voxels_apart(body: BoolArray, about: FloatArray) -> list[int]:
    """How many voxels apart truths are drawn along each axis: ``about`` (3,), or more in a large body."""
    extent = [np.ptp(np.flatnonzero(body.any(axis=tuple({0, 1, 2} - {axis})))) + 1 for axis in range(3)]
    larger = (float(np.prod(extent / np.maximum(about, 1.0))) / _MOST_NODES) ** (1 / 3)
    return [max(1, round(max(1.0, larger) * voxels)) for voxels in about]


def _some_of(where: BoolArray, apart: Sequence[int]) -> tuple[IntArray, ...]:
    """Indices of a mask's voxels on the lattice of every so many, or of all where these are few."""
    i, j, k = apart
    on_lattice = np.zeros_like(where)
    on_lattice[::i, ::j, ::k] = where[::i, ::j, ::k]
    return np.nonzero(on_lattice if np.count_nonzero(on_lattice) >= _FEW else where)


def statistics_of(shear: FloatArray, volume_ml: float, thresholds: Sequence[float] = SHEAR_THRESHOLDS) -> FloatArray:
    """Median, 90th and 95th percentile, and the volumes above thresholds (mL) of a tissue of a volume."""
    above = [volume_ml * np.count_nonzero(shear > t) / len(shear) for t in thresholds]
    return np.array([*np.percentile(shear, [50.0, 90.0, 95.0]), *above])


def widened(drawn: FloatArray, factor: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lower end, median and upper end of draws (n, statistics): 2.5th and 97.5th percentile, ``factor`` times as far.

    No statistic of a shear is below zero.
    """
    low, middle, high = np.percentile(drawn, [2.5, 50.0, 97.5], axis=0)
    return np.maximum(middle - factor * (middle - low), 0.0), middle, middle + factor * (high - middle)
