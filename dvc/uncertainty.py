"""How sure a maximal shear is: bias and standard deviation measured on phantoms, and the intervals that follow.

An error model is a table, made by an accuracy study of one registration preset: of voxels in which a shear m was
found, by tissue and distance to bone, how far it lay from the truth on average (bias) and how much that varied
(standard deviation). Given m, the truth is then about m - bias, with that deviation. This holds for tissue that is
strained and imaged like the study's phantoms, and for no other.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from dvc.arrays import BoolArray, Float32Array, FloatArray, IntArray
from dvc.errors import InputError
from dvc.image import Grid
from dvc.regions import SHEAR_THRESHOLDS

POOLED = "soft tissue"
"""Name of the row for tissue that the study did not have, or that has no label."""

_FOLDER = "error_models"
_FORMAT = 1
_FAR = 1.6  # a table is used for voxels and noise within this factor of its own
_LATTICE = 30_000
_DRAWS = 200


@dataclass(frozen=True, slots=True, eq=False)
class ErrorTable:
    """Error of the maximal shear for one voxel size and noise.

    Attributes
    ----------
    voxel_mm : float
        Cube root of the voxel's volume, mm.
    snr : float
        As `dvc.noise.signal_to_noise` finds it.
    shear : (m,)
        Values of the shear found, rising, at which bias and deviation are given; linear between, constant beyond.
    to_bone_mm : (k,)
        Lower ends of the bins of distance to bone, mm, rising from 0.
    bias, sd : mapping of tissue to (k, m)
        Mean and standard deviation of found minus true shear.
    run_sd : mapping of tissue to float
        Standard deviation, from image to image, of the error's mean over the tissue.
    correlation_mm : float
        Distance at which the error's autocorrelation has fallen to 1/e, mm.
    """

    voxel_mm: float
    snr: float
    shear: FloatArray
    to_bone_mm: FloatArray
    bias: Mapping[str, FloatArray]
    sd: Mapping[str, FloatArray]
    run_sd: Mapping[str, float]
    correlation_mm: float

    def expected(self, tissue: str, shear: FloatArray, to_bone_mm: Float32Array) -> tuple[FloatArray, FloatArray]:
        """Bias and standard deviation (n,) of shears (n,) found in a tissue at distances (n,) mm from bone."""
        row = tissue if tissue in self.bias else POOLED
        bins = np.clip(np.searchsorted(self.to_bone_mm, to_bone_mm, side="right") - 1, 0, len(self.to_bone_mm) - 1)
        bias, sd = np.empty(len(shear)), np.empty(len(shear))
        for k in range(len(self.to_bone_mm)):
            here = bins == k
            bias[here] = np.interp(shear[here], self.shear, self.bias[row][k])
            sd[here] = np.interp(shear[here], self.shear, self.sd[row][k])
        return bias, sd


@dataclass(frozen=True, slots=True, eq=False)
class ErrorModel:
    """Error tables of one preset, and what they were made from.

    Attributes
    ----------
    preset : str
    tables : tuple of ErrorTable
    source : str
        The study in a sentence.
    """

    preset: str
    tables: tuple[ErrorTable, ...]
    source: str

    def table_for(self, voxel_mm: float, snr: float) -> ErrorTable:
        """The table nearest to a voxel size and a signal-to-noise ratio, both within a factor of 1.6.

        Raises
        ------
        InputError
            If none is that near; the message names those there are.
        """

        def far(table: ErrorTable) -> float:
            return float(max(abs(np.log(voxel_mm / table.voxel_mm)), abs(np.log(snr / table.snr))))

        nearest = min(self.tables, key=far)
        if not far(nearest) <= np.log(_FAR):
            known = "; ".join(f"{t.voxel_mm:.2g} mm at SNR {t.snr:.0f}" for t in self.tables)
            raise InputError(
                f"The error of {self.preset} is known for voxels of {known}. This image has voxels of {voxel_mm:.2g} "
                f"mm at SNR {snr:.0f}, too far from any of these."
            )
        return nearest

    def write(self, path: Path) -> None:
        """Write as JSON, whole or not at all."""
        from dvc.whole import write_whole

        tables = [
            {
                "voxel_mm": t.voxel_mm,
                "snr": t.snr,
                "shear": t.shear.tolist(),
                "to_bone_mm": t.to_bone_mm.tolist(),
                "bias": {k: np.round(v, 5).tolist() for k, v in t.bias.items()},
                "sd": {k: np.round(v, 5).tolist() for k, v in t.sd.items()},
                "run_sd": {k: round(v, 6) for k, v in t.run_sd.items()},
                "correlation_mm": t.correlation_mm,
            }
            for t in self.tables
        ]
        told = {"format": _FORMAT, "preset": self.preset, "source": self.source, "tables": tables}
        write_whole(path, json.dumps(told, indent=1, allow_nan=False) + "\n")


def read_error_model(path: Path | str) -> ErrorModel:
    """Read what `ErrorModel.write` wrote.

    Raises
    ------
    InputError
        If the file cannot be read or is no error model.
    """
    try:
        return _parsed(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError, KeyError, TypeError) as failure:
        raise InputError(
            f"{path}: no error model as `mrstrain accuracy` writes it ({type(failure).__name__}: {failure})."
        ) from failure


def error_model_of(preset: str) -> ErrorModel | None:
    """The error model that comes with a named preset; None where there is none."""
    stored = files("dvc") / _FOLDER / f"{preset}.json"
    return _parsed(stored.read_text(encoding="utf-8")) if stored.is_file() else None


def _parsed(text: str) -> ErrorModel:
    told = json.loads(text)
    if told["format"] != _FORMAT:
        raise ValueError(f"format {told['format']}, not {_FORMAT}")
    tables = tuple(
        ErrorTable(
            float(t["voxel_mm"]),
            float(t["snr"]),
            np.asarray(t["shear"], dtype=np.float64),
            np.asarray(t["to_bone_mm"], dtype=np.float64),
            {k: np.asarray(v, dtype=np.float64) for k, v in t["bias"].items()},
            {k: np.asarray(v, dtype=np.float64) for k, v in t["sd"].items()},
            {k: float(v) for k, v in t["run_sd"].items()},
            float(t["correlation_mm"]),
        )
        for t in told["tables"]
    )
    if not tables or any(POOLED not in t.bias for t in tables):
        raise ValueError(f"no table, or one without a row '{POOLED}'")
    return ErrorModel(str(told["preset"]), tables, str(told["source"]))


@dataclass(frozen=True, slots=True)
class Interval:
    """A figure of one tissue with its 95 % interval.

    Attributes
    ----------
    region, figure : str
        Such as "fat", "p95" or "volume_above_0.3_ml".
    found : float
        As measured.
    estimate, low, high : float
        Median, 2.5th and 97.5th percentile of what the truth may be: the bias is taken out.
    """

    region: str
    figure: str
    found: float
    estimate: float
    low: float
    high: float


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Error of a strain map.

    Attributes
    ----------
    sigma : (ni, nj, nk)
        Standard deviation of the maximal shear about its bias; NaN where not defined, and in bone.
    intervals : tuple of Interval
    table : ErrorTable
    """

    sigma: Float32Array
    intervals: tuple[Interval, ...]
    table: ErrorTable


def uncertainty_of(
    max_shear: Float32Array,
    grid: Grid,
    regions: Mapping[str, BoolArray],
    to_bone_mm: Float32Array,
    table: ErrorTable,
    *,
    thresholds: Sequence[float] = SHEAR_THRESHOLDS,
    seed: int = 1,
) -> Uncertainty:
    """Error of a map of maximal shear by an error table.

    Parameters
    ----------
    max_shear : (ni, nj, nk)
        NaN where not defined.
    grid : Grid
    regions : mapping of name to (ni, nj, nk) bool
        Soft tissues, each on the grid.
    to_bone_mm : (ni, nj, nk)
        Distance to bone, mm.
    table : ErrorTable
    thresholds : sequence of float
        Strains for which the volume above is wanted.
    seed : int
        Of the draws.

    Notes
    -----
    The truth is drawn 200 times: found shear, less bias, less a Gaussian field of the table's standard deviation and
    correlation length, less a constant of the tissue's own for what differs from image to image; not below zero.
    """
    sigma = np.full(grid.shape, np.nan, dtype=np.float32)
    intervals: list[Interval] = []
    random = np.random.default_rng(seed)
    for name, inside in regions.items():
        where = inside & np.isfinite(max_shear)
        if not where.any():
            continue
        _, sd = table.expected(name, max_shear[where].astype(np.float64), to_bone_mm[where])
        sigma[where] = sd
        intervals += _intervals(name, where, max_shear, to_bone_mm, grid, table, thresholds, random)
    return Uncertainty(sigma, tuple(intervals), table)


def _intervals(
    name: str,
    where: BoolArray,
    max_shear: Float32Array,
    to_bone_mm: Float32Array,
    grid: Grid,
    table: ErrorTable,
    thresholds: Sequence[float],
    random: np.random.Generator,
) -> list[Interval]:
    """Of one region, from draws on a lattice coarse enough to be quick."""
    box = tuple(slice(int(a.min()), int(a.max()) + 1) for a in np.nonzero(where))
    step = max(1, int(np.ceil((np.count_nonzero(where) / _LATTICE) ** (1 / 3))))
    lattice = tuple(slice(b.start, b.stop, step) for b in box)
    kept = where[lattice]
    if not kept.any():
        lattice, kept, step = box, where[box], 1
    found = max_shear[lattice][kept].astype(np.float64)
    bias, sd = table.expected(name, found, to_bone_mm[lattice][kept])
    run_sd = table.run_sd.get(name, table.run_sd[POOLED])
    volume = np.count_nonzero(where) * grid.voxel_volume_mm3 / 1000.0
    width = 0.5 * table.correlation_mm / (step * grid.spacing_mm)
    at = np.nonzero(kept)
    drawn = np.stack(
        [
            _figures(
                np.maximum(found - bias - sd * _field(kept.shape, width, at, random) - run_sd * random.normal(), 0.0),
                volume,
                thresholds,
            )
            for _ in range(_DRAWS)
        ]
    )
    low, middle, high = np.percentile(drawn, [2.5, 50.0, 97.5], axis=0)
    measured = _figures(max_shear[where].astype(np.float64), volume, thresholds)
    names = ["median", "p90", "p95", *(f"volume_above_{t:g}_ml" for t in thresholds)]
    return [
        Interval(name, figure, float(m), float(e), float(a), float(b))
        for figure, m, e, a, b in zip(names, measured, middle, low, high, strict=True)
    ]


def _figures(shear: FloatArray, volume_ml: float, thresholds: Sequence[float]) -> FloatArray:
    above = [volume_ml * np.count_nonzero(shear > t) / len(shear) for t in thresholds]
    return np.array([*np.percentile(shear, [50.0, 90.0, 95.0]), *above])


def _field(
    shape: tuple[int, ...], width: FloatArray, at: tuple[IntArray, ...], random: np.random.Generator
) -> FloatArray:
    """Gaussian field of unit variance, smooth over ``width`` voxels, at some voxels."""
    smooth = gaussian_filter(random.standard_normal(shape), width, mode="wrap")
    values = smooth[at]
    return np.asarray(values / max(float(smooth.std()), 1e-12))
