"""Uncertainty of a maximum shear strain: bias and standard deviation measured on phantoms, and intervals from them.

An error model is made by an accuracy study of one registration preset: of voxels in which a shear m was measured, by
tissue and distance to bone, how far it lay from the truth on average (bias) and how much that varied (standard
deviation), for each registration of the study and for all together. Given m, the truth is then about m - bias, with
that deviation. This holds for tissue that is strained and imaged like the study's phantoms, and for no other.
"""

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter, gaussian_filter1d

from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray
from dvc.atomic_files import write_whole
from dvc.errors import InputError
from dvc.images.image import Grid
from dvc.own_files import read_json
from dvc.trust.quality import plain
from dvc.trust.regions import SHEAR_THRESHOLDS

POOLED = "soft tissue"
"""Name of the row for tissue that the study did not have, or that has no label."""

_FORMAT = 1
_FAR = 1.6  # a table is used for voxels and noise within this factor of its own
_STEPS = 4  # of the lattice that noise at scattered points is drawn on, within a correlation length
_STEPS_OF_VOXELS = 2  # of the voxels at which truths of a map are drawn
_MOST_NODES = 500_000  # of their lattice, which is coarser where it would have more
_FEW = 2_000  # of a tissue's voxels on it, below which all are taken
_HALF = 0.5 + 1e-6  # points half-way between nodes, as every second voxel may be, all take the upper one
_DRAWS, _AT_ONCE = 200, 10  # truths, and those that are in memory


@dataclass(frozen=True, slots=True, eq=False)
class ErrorTable:
    """Error of the maximum shear strain for one voxel size and `dvc.images.noise.signal_to_noise`.

    It is given at rising measured shears (m,), linear between and constant beyond, and for bins of distance to bone
    whose lower ends (k,) rise from 0: mean and standard deviation (2, k, m) of measured minus true shear by tissue,
    over the whole study and in each of its runs (registrations), since errors differ from image to image.
    """

    spacing_mm: FloatArray
    snr: float
    shear: FloatArray
    to_bone_mm: FloatArray
    whole: Mapping[str, FloatArray]
    runs: tuple[Mapping[str, FloatArray], ...]
    correlation_mm: float  # distance at which the error's autocorrelation has fallen to 1/e
    # Factor on intervals as drawn, by which 95 % of the tissues' figures lay in them when each heel of the study was
    # judged by the others; NaN where there was one heel alone, and intervals stay as drawn.
    widening: float = float("nan")

    @property
    def factor(self) -> float:
        """`widening`, and 1 where it is not known."""
        return 1.0 if np.isnan(self.widening) else self.widening

    def expected(
        self, tissue: str, shear: FloatArray, to_bone_mm: Float32Array, run: int | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Bias and standard deviation (n,) of shears (n,) measured in a tissue at distances (n,) mm from bone.

        Over all registrations, or in the one numbered ``run``.
        """
        cells = self.whole if run is None else self.runs[run]
        rows = cells[tissue if tissue in cells else POOLED]
        bins = np.clip(np.searchsorted(self.to_bone_mm, to_bone_mm, side="right") - 1, 0, len(self.to_bone_mm) - 1)
        bias, sd = np.empty((2, len(shear)))
        for k in range(len(self.to_bone_mm)):
            here = bins == k
            bias[here], sd[here] = (np.interp(shear[here], self.shear, row[k]) for row in rows)
        return bias, sd


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """Error tables of one preset, what they were made from, and the study in a sentence (``source``)."""

    preset: str
    parameters_sha256: str  # of the preset's text: other parameters under the same name have another error
    tables: tuple[ErrorTable, ...]
    source: str

    def table_for(self, spacing_mm: FloatArray, snr: float) -> ErrorTable:
        """The closest table to a voxel (3,) mm and an SNR: sorted edges and SNR each within a factor of 1.6.

        InputError if no table is that close; the message gives the closest.
        """
        edges = np.sort(spacing_mm)

        def far(table: ErrorTable) -> float:
            voxel = np.abs(np.log(edges / np.sort(table.spacing_mm))).max()
            return float(max(voxel, abs(np.log(snr / table.snr))))

        nearest = min(self.tables, key=far)
        if not far(nearest) <= np.log(_FAR):
            raise InputError(
                f"The error of {self.preset} is not known for voxels of {_told(spacing_mm)} mm at SNR {snr:.0f}: the "
                f"closest known, {_told(nearest.spacing_mm)} mm at SNR {nearest.snr:.0f}, is too far. Measure it with "
                f"`mrstrain accuracy --preset {self.preset}` (--spacing, --snr); give its file as "
                "error_model (--error-model)."
            )
        return nearest

    def write(self, path: Path) -> None:
        """Write as JSON, whole or not at all."""

        def rounded(cells: Mapping[str, FloatArray]) -> dict[str, object]:
            return {tissue: np.round(rows, 4).tolist() for tissue, rows in cells.items()}

        told = {name: getattr(self, name) for name in ("preset", "parameters_sha256", "source")}
        tables = [
            {"spacing_mm": t.spacing_mm.tolist(), "snr": t.snr, "shear": t.shear.tolist()}
            | {"to_bone_mm": t.to_bone_mm.tolist(), "bias_and_sd": rounded(t.whole)}
            | {"bias_and_sd_of_each_run": [rounded(run) for run in t.runs]}
            | {"correlation_mm": t.correlation_mm, "widening": plain(t.widening)}
            for t in self.tables
        ]
        write_whole(path, json.dumps({"format": _FORMAT, **told, "tables": tables}, allow_nan=False) + "\n")


def read_error_model(path: Path | str) -> ErrorModel:
    """Read a file of `ErrorModel.write`; InputError if it cannot be read or is not an error model."""
    try:
        return _parsed(read_json(Path(path)))
    except (OSError, ValueError, KeyError, TypeError) as failure:
        what = f"not an error model written by `mrstrain accuracy` ({type(failure).__name__}: {failure})."
        raise InputError(f"{path}: {what}") from failure


def error_model_of(preset: str) -> ErrorModel | None:
    """The error model that comes with a named preset; None where there is none."""
    stored = files("dvc.trust") / "error_models" / f"{preset}.json"
    return _parsed(json.loads(stored.read_text(encoding="utf-8"))) if stored.is_file() else None


def _parsed(told: Mapping[str, Any]) -> ErrorModel:
    if told["format"] != _FORMAT:
        raise ValueError(f"the format is {told['format']}; {_FORMAT} is needed")

    def cells(given: Mapping[str, list[object]]) -> dict[str, FloatArray]:
        return {tissue: np.asarray(rows, dtype=np.float64) for tissue, rows in given.items()}

    tables = tuple(
        ErrorTable(
            snr=float(t["snr"]),
            whole=cells(t["bias_and_sd"]),
            runs=tuple(cells(run) for run in t["bias_and_sd_of_each_run"]),
            correlation_mm=float(t["correlation_mm"]),
            widening=float(np.nan if t["widening"] is None else t["widening"]),
            **{name: np.asarray(t[name], dtype=np.float64) for name in ("spacing_mm", "shear", "to_bone_mm")},
        )
        for t in told["tables"]
    )
    if not tables or any(POOLED not in cells for t in tables for cells in (t.whole, *t.runs)):
        raise ValueError(f"it has no table, or a table without a row '{POOLED}'")
    for t in tables:
        shape = (2, len(t.to_bone_mm), len(t.shear))
        figures = (rows for cells in (t.whole, *t.runs) for rows in cells.values())
        sound = (rows.shape == shape and np.isfinite(rows).all() and (rows[1] >= 0).all() for rows in figures)
        if not (t.runs and all(sound)):
            raise ValueError(f"a table has no runs, or its figures are not {shape} finite numbers")
        rising = np.all(np.diff(t.shear) > 0) and np.all(np.diff(t.to_bone_mm) > 0)
        if not (rising and t.spacing_mm.shape == (3,) and min(*t.spacing_mm, t.snr, t.correlation_mm) > 0):
            raise ValueError("a voxel size, SNR or bin is not positive, or the bins do not increase")
    return ErrorModel(str(told["preset"]), str(told["parameters_sha256"]), tables, str(told["source"]))


def _told(spacing_mm: FloatArray) -> str:
    return " x ".join(f"{s:.2g}" for s in spacing_mm[: 1 if np.ptp(spacing_mm) < 1e-6 else 3])


def to_surface_mm(body: BoolArray, spacing_mm: FloatArray) -> Float32Array:
    """Distance (mm) of voxels' centres to the surface of a body of voxels: 0 inside it, infinite without one.

    The surface lies half an edge from the centre of a voxel that touches it.
    """
    if not body.any():
        return np.full(body.shape, np.inf, dtype=np.float32)
    touching = np.full(body.shape, np.inf, dtype=np.float32)
    for axis in range(body.ndim):
        ahead, behind = [slice(None)] * body.ndim, [slice(None)] * body.ndim
        ahead[axis], behind[axis] = slice(1, None), slice(None, -1)
        differs = body[tuple(ahead)] != body[tuple(behind)]
        half = np.where(differs, np.float32(0.5 * spacing_mm[axis]), np.float32(np.inf))
        for side in (tuple(ahead), tuple(behind)):
            np.minimum(touching[side], half, out=touching[side])
    touching[body] = np.inf
    at = np.isfinite(touching)
    if not at.any():
        return np.zeros(body.shape, dtype=np.float32)
    distance, nearest = distance_transform_edt(~at, sampling=spacing_mm, return_indices=True)
    return np.where(body, 0.0, distance + touching[tuple(nearest)]).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Interval:
    """A figure of one tissue, and the interval in which the study's registrations would put the truth."""

    region: str
    figure: str  # such as "p95" or "volume_above_0.3_ml"
    found: float  # as measured
    estimate: float  # median of the truths drawn
    low: float  # their 2.5th and 97.5th percentile, moved away from the estimate by `ErrorTable.widening`
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Error of a strain map."""

    sigma: (
        Float32Array  # standard deviation (ni, nj, nk) of the maximum shear strain about its bias; NaN where not known
    )
    intervals: tuple[Interval, ...]
    table: ErrorTable


class GaussianField:
    """Gaussian fields of unit variance at points (n, 3), mm, with autocorrelation exp(-(d / correlation_mm)^2).

    They are drawn at the nodes of a lattice with edges (3,), mm, from the lowest point on; each point takes the value
    of the nearest node.
    """

    def __init__(
        self, points_mm: FloatArray, edges_mm: FloatArray, correlation_mm: float, random: np.random.Generator
    ) -> None:
        self._random, self._width = random, 0.5 * correlation_mm / edges_mm
        index = np.floor((points_mm - points_mm.min(axis=0)) / edges_mm + _HALF).astype(np.int64)
        # Room around, so that the field, which is periodic, does not meet itself.
        self._shape = tuple((index.max(axis=0) + 1 + np.ceil(6.0 * self._width).astype(np.int64)).tolist())
        self._at = np.ravel_multi_index(tuple(index.T), self._shape)
        spread = 1.0
        for w in self._width:
            kernel = gaussian_filter1d(np.eye(1, 2 * int(4 * w + 1) + 1, int(4 * w + 1))[0], w, mode="constant")
            spread *= float((kernel**2).sum())
        self._scale = 1.0 / np.sqrt(spread)

    def drawn(self) -> FloatArray:
        """Draw the values at the points, (n,)."""
        smooth = gaussian_filter(self._random.standard_normal(self._shape), self._width, mode="wrap")
        return np.asarray(self._scale * smooth.ravel()[self._at])


class TruthDraws:
    """Draws of the truth, as `uncertainty_of` makes them on a grid.

    At points (n, 3) of the reference configuration, mm: maximum shear strain, tissue and distance to bone, each (n,).
    Noise is drawn on a lattice with ``edges_mm`` (3,), by default a quarter of the table's correlation length.
    """

    def __init__(
        self,
        points_mm: FloatArray,
        shear: FloatArray,
        tissue: Sequence[str],
        to_bone_mm: FloatArray,
        table: ErrorTable,
        seed: int = 1,
        edges_mm: FloatArray | None = None,
    ) -> None:
        self._random = np.random.default_rng(seed)
        self._shear = shear
        names = np.asarray(tissue)
        self._tissues = {str(name): names == name for name in np.unique(names)}
        self._expected = []
        for run in range(len(table.runs)):
            bias, sd = np.empty((2, len(shear)))
            for name, here in self._tissues.items():
                bias[here], sd[here] = table.expected(name, shear[here], to_bone_mm[here], run)
            self._expected.append((bias.astype(np.float32), sd.astype(np.float32)))
        edges = np.full(3, table.correlation_mm / _STEPS) if edges_mm is None else edges_mm
        self._noise = GaussianField(points_mm, edges, table.correlation_mm, self._random)

    @cached_property
    def _variance(self) -> FloatArray:
        return np.asarray(np.mean([np.square(sd, dtype=np.float64) for _, sd in self._expected], axis=0))

    def drawn(self) -> FloatArray:
        """A truth (n,): the shear less a registration's bias, less a Gaussian field of its deviation; not below 0."""
        bias, sd = self._expected[self._random.integers(len(self._expected))]
        return np.maximum(self._shear - bias - sd * self._noise.drawn(), 0.0)

    def narrowed(self, truth: FloatArray) -> FloatArray:
        """A truth drawn (n,) whose spread in each tissue is that of the measured shear less the noise, not plus it.

        About the tissue's mean m: m + (x - m) (1 - 2 s^2 / v)^(1/2), with v the variance of x and s^2 the mean square
        of the noise's deviation, which is in x once as measured and once as drawn; uniform where noise could have made
        all of the spread.
        """
        narrow = np.empty(len(truth))
        for here in self._tissues.values():
            mean, spread = truth[here].mean(), truth[here].var()
            kept = max(spread - 2.0 * self._variance[here].mean(), 0.0) / spread if spread > 0.0 else 0.0
            narrow[here] = mean + np.sqrt(kept) * (truth[here] - mean)
        return narrow


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
    length; not below zero. The interval of the draws is widened by a factor from held-out heels (conformal prediction),
    so that it holds in 95 % of cases like those of the study.
    """
    sigma = np.full(grid.shape, np.nan, dtype=np.float32)
    measured = {name: inside & np.isfinite(max_shear) for name, inside in regions.items()}
    measured = {name: where for name, where in measured.items() if where.any()}
    if not measured:
        return Uncertainty(sigma, (), table)
    volumes = [np.count_nonzero(where) * grid.voxel_volume_mm3 / 1000.0 for where in measured.values()]
    drawn = _figures_drawn(max_shear, grid.spacing_mm, measured, volumes, to_bone_mm, table, seed)
    names = ["median", "p90", "p95", *(f"volume_above_{t:g}_ml" for t in SHEAR_THRESHOLDS)]
    intervals = []
    for (name, where), volume, figures in zip(measured.items(), volumes, drawn, strict=True):
        shear, factor = max_shear[where].astype(np.float64), wider.get(name, 1.0)
        sigma[where] = factor * table.expected(name, shear, to_bone_mm[where])[1]
        low, middle, high = widened(figures, factor * table.factor)
        high[3:] = np.minimum(high[3:], volume)
        each = zip(names, figures_of(shear, volume), middle, low, high, strict=True)
        intervals += [Interval(name, figure, *map(float, numbers)) for figure, *numbers in each]
    return Uncertainty(sigma, tuple(intervals), table)


def _figures_drawn(
    max_shear: Float32Array, spacing_mm: FloatArray, measured: Mapping[str, BoolArray], volumes_ml: Sequence[float],
    to_bone_mm: Float32Array, table: ErrorTable, seed: int,
) -> FloatArray:  # fmt: skip
    """Figures of each tissue (tissues, draws, figures) in the truths drawn for some of their voxels."""
    body = np.any(list(measured.values()), axis=0)
    apart = _voxels_apart(body, table.correlation_mm / _STEPS_OF_VOXELS / spacing_mm)
    at = [_some_of(where, apart) for where in measured.values()]
    every = tuple(np.concatenate(axis) for axis in zip(*at, strict=True))
    ends = np.cumsum([len(some[0]) for some in at])
    tissue = np.repeat(list(measured), np.diff(ends, prepend=0)).tolist()
    points, shear = np.stack(every, axis=1) * spacing_mm, max_shear[every].astype(np.float64)
    draws = TruthDraws(points, shear, tissue, to_bone_mm[every], table, seed, np.array(apart) * spacing_mm)

    def figures(truth: FloatArray) -> list[FloatArray]:
        return [figures_of(*tissue) for tissue in zip(np.split(truth, ends[:-1]), volumes_ml, strict=True)]

    with ThreadPoolExecutor(1) as beside:  # figures of one truth while the next is drawn
        few = (beside.map(figures, (draws.drawn() for _ in range(_AT_ONCE))) for _ in range(_DRAWS // _AT_ONCE))
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


def figures_of(shear: FloatArray, volume_ml: float, thresholds: Sequence[float] = SHEAR_THRESHOLDS) -> FloatArray:
    """Median, 90th and 95th percentile, and the volumes above thresholds (mL) of a tissue of a volume."""
    above = [volume_ml * np.count_nonzero(shear > t) / len(shear) for t in thresholds]
    return np.array([*np.percentile(shear, [50.0, 90.0, 95.0]), *above])


def widened(drawn: FloatArray, factor: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lower end, median and upper end of draws (n, figures): 2.5th and 97.5th percentile, ``factor`` times as far out.

    No figure of a shear is below zero.
    """
    low, middle, high = np.percentile(drawn, [2.5, 50.0, 97.5], axis=0)
    return np.maximum(middle - factor * (middle - low), 0.0), middle, middle + factor * (high - middle)
