"""From the samples of an accuracy study: errors by tissue, place and strain, noise, and spatial resolution."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dvc.arrays import BoolArray, Float32Array
from dvc.trust.error_model import POOLED
from phantoms.accuracy_run import RIGID, ErrorSamples
from phantoms.anatomy import TISSUES

SOFT = tuple(name for name in TISSUES.values() if name not in RIGID)
BONE_BINS_MM = (0.0, 1.5, 3.0, 6.0, 12.0, np.inf)
BORDER_BINS_MM = (0.0, 1.0, 2.0, 4.0, np.inf)
SHEAR_BINS = (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, np.inf)


@dataclass(frozen=True, slots=True)
class ErrorRow:
    """Errors over one set of samples; maximal shear without unit, displacement in mm.

    Attributes
    ----------
    preset : str
    voxel_mm : str
        Such as "0.8" or "0.8 x 0.8 x 1.6".
    snr : float
    labels_off : int
        As in `phantoms.accuracy_run.AccuracyCase`.
    motion, tissue : str
    by : {"all", "distance to bone, mm", "distance to a border, mm", "true maximal shear"}
    low, high : float
        Of the bin, NaN for "all".
    samples : int
    true_p50, true_p95 : float
        Percentiles of the true maximal shear.
    shear_bias, shear_sd, shear_rmse, shear_p95 : float
        Of found minus true; the 95th percentile is of the absolute value.
    u_bias_mm, u_sd_mm, u_rmse_mm, u_p95_mm : float
        Length of the mean error vector; root mean square distance from it, and from the truth; 95th percentile
        of the error's length.
    """

    preset: str
    voxel_mm: str
    snr: float
    labels_off: int
    motion: str
    tissue: str
    by: str
    low: float
    high: float
    samples: int
    true_p50: float
    true_p95: float
    shear_bias: float
    shear_sd: float
    shear_rmse: float
    shear_p95: float
    u_bias_mm: float
    u_sd_mm: float
    u_rmse_mm: float
    u_p95_mm: float


@dataclass(frozen=True, slots=True)
class FloorRow:
    """Apparent strain in one tissue where the truth is zero: MAER, SDER, percentiles of the maximal shear."""

    preset: str
    voxel_mm: str
    snr: float
    tissue: str
    maer: float
    sder: float
    shear_p50: float
    shear_p95: float


@dataclass(frozen=True, slots=True)
class ResolutionRow:
    """How much of a sinusoidal shear of one wavelength is found in a tissue: the slope of found on true H_dn."""

    preset: str
    voxel_mm: str
    snr: float
    tissue: str
    wavelength_mm: float
    recovered: float


@dataclass(frozen=True, slots=True)
class RunRow:
    """One registration: its time, the share of the heel without a result, and folded voxels of those sampled."""

    case: str
    estimated_snr: float
    seconds: float
    without_result: float
    folded: int
    shear_rmse: float


def run_rows(runs: Sequence[ErrorSamples]) -> list[RunRow]:
    """Tell of each run, with the root mean square error of the maximal shear in its soft tissue."""
    rows = []
    for run in runs:
        error = (run.shear - run.true_shear)[of_tissue(run, POOLED)].astype(np.float64)
        without = run.unknown / (run.unknown + len(run.shear))
        rmse = float(np.sqrt(np.mean(error**2)))
        rows.append(RunRow(run.case.name, run.estimated_snr, run.seconds, without, run.folded, rmse))
    return rows


def error_rows(runs: Sequence[ErrorSamples]) -> list[ErrorRow]:
    """Errors by condition, labels, motion and tissue: over all, by distance to bone, to a border, and by true strain.

    Waves are left out: they have rows of their own (`resolution_rows`).
    """
    rows = []
    for condition, some in by_condition(runs):
        plain = [r for r in some if r.case.wavelength_mm is None]
        for off, motion in dict.fromkeys((r.case.labels_off, r.case.motion) for r in plain):
            alike = [r for r in plain if (r.case.labels_off, r.case.motion) == (off, motion)]
            for tissue in (*TISSUES.values(), POOLED):
                for by, low, high, kept in _bins(alike, [of_tissue(r, tissue) for r in alike]):
                    row = _row((*condition, off), (motion, tissue, by, low, high), alike, kept)
                    rows += [] if row is None else [row]
    return rows


def floor_rows(runs: Sequence[ErrorSamples]) -> list[FloorRow]:
    """Apparent strain of the pairs without strain, by condition and tissue."""
    rows = []
    for (preset, voxel, snr), some in by_condition(runs):
        still = [r for r in some if r.case.motion == "still"]
        for tissue in (*TISSUES.values(), POOLED) if still else ():
            mean = np.concatenate([r.mean_abs_strain[of_tissue(r, tissue)] for r in still])
            shear = np.concatenate([r.shear[of_tissue(r, tissue)] for r in still])
            if len(mean):
                p50, p95 = (float(p) for p in np.percentile(shear, [50, 95]))
                rows.append(FloorRow(preset, voxel, snr, tissue, float(mean.mean()), float(mean.std()), p50, p95))
    return rows


def resolution_rows(runs: Sequence[ErrorSamples]) -> list[ResolutionRow]:
    """Share of a sinusoidal strain that is recovered, by condition, tissue and wavelength, rising."""
    rows = []
    for (preset, voxel, snr), some in by_condition(runs):
        lengths = sorted({r.case.wavelength_mm for r in some if r.case.wavelength_mm is not None})
        for tissue in (*SOFT, POOLED):
            for length in lengths:
                waves = [r for r in some if r.case.wavelength_mm == length]
                kept = [of_tissue(r, tissue) for r in waves]
                true = np.concatenate([r.true_slope[k] for r, k in zip(waves, kept, strict=True)]).astype(np.float64)
                found = np.concatenate([r.slope[k] for r, k in zip(waves, kept, strict=True)]).astype(np.float64)
                if len(true):
                    share = float(true @ found / (true @ true))
                    rows.append(ResolutionRow(preset, voxel, snr, tissue, length, share))
    return rows


def wavelength_recovered(rows: Sequence[ResolutionRow], share: float) -> float:
    """Shortest wavelength (mm) from which on a share of the strain is recovered; NaN where the rows do not tell.

    Linear between the wavelengths of the rows, which are of one condition and tissue.
    """
    lengths = np.array([r.wavelength_mm for r in rows])
    recovered = np.array([r.recovered for r in rows])
    order = np.argsort(lengths)
    lengths, recovered = lengths[order], recovered[order]
    below = np.flatnonzero(recovered < share)
    if not len(below) or below[-1] == len(rows) - 1:
        return float("nan")  # recovered even at the shortest, or not even at the longest
    i = int(below[-1])
    part = (share - recovered[i]) / (recovered[i + 1] - recovered[i])
    return float(lengths[i] + part * (lengths[i + 1] - lengths[i]))


def by_condition(runs: Sequence[ErrorSamples]) -> Iterator[tuple[tuple[str, str, float], list[ErrorSamples]]]:
    """Runs of equal preset, voxel and noise, with these three as tables name them."""
    conditions = dict.fromkeys((r.case.preset, r.case.spacing_mm, r.case.snr) for r in runs)
    for preset, spacing, snr in conditions:
        same = len(set(spacing)) == 1
        voxel = f"{spacing[0]:g}" if same else " x ".join(f"{s:g}" for s in spacing)
        alike = [r for r in runs if (r.case.preset, r.case.spacing_mm, r.case.snr) == (preset, spacing, snr)]
        yield (preset, voxel, snr), alike


def of_tissue(run: ErrorSamples, name: str) -> BoolArray:
    """Which samples lie in a tissue; "soft tissue" is all of SOFT."""
    numbers = [n for n, tissue in TISSUES.items() if tissue == name or (name == POOLED and tissue in SOFT)]
    return np.isin(run.tissue, numbers)


def _bins(
    runs: Sequence[ErrorSamples], tissue: Sequence[BoolArray]
) -> Iterator[tuple[str, float, float, list[BoolArray]]]:
    yield "all", float("nan"), float("nan"), list(tissue)
    ways: Mapping[str, tuple[Callable[[ErrorSamples], Float32Array], tuple[float, ...]]] = {
        "distance to bone, mm": (lambda r: r.to_bone_mm, BONE_BINS_MM),
        "distance to a border, mm": (lambda r: r.to_border_mm, BORDER_BINS_MM),
        "true maximal shear": (lambda r: r.true_shear, SHEAR_BINS),
    }
    for by, (value, ends) in ways.items():
        for low, high in pairwise(ends):
            yield (
                by,
                low,
                high,
                [k & (value(r) >= low) & (value(r) < high) for r, k in zip(runs, tissue, strict=True)],
            )


def _row(
    condition: tuple[str, str, float, int],
    place: tuple[str, str, str, float, float],
    runs: Sequence[ErrorSamples],
    kept: Sequence[BoolArray],
) -> ErrorRow | None:
    pairs = list(zip(runs, kept, strict=True))
    true = np.concatenate([r.true_shear[k] for r, k in pairs]).astype(np.float64)
    if not len(true):
        return None
    shear = np.concatenate([r.shear[k] for r, k in pairs]).astype(np.float64) - true
    u = np.concatenate([r.u_error_mm[k] for r, k in pairs]).astype(np.float64)
    mean = u.mean(axis=0)
    length = np.linalg.norm(u, axis=1)
    p50, p95 = (float(p) for p in np.percentile(true, [50, 95]))
    preset, voxel, snr, labels_off = condition
    motion, tissue, by, low, high = place
    return ErrorRow(
        preset=preset,
        voxel_mm=voxel,
        snr=snr,
        labels_off=labels_off,
        motion=motion,
        tissue=tissue,
        by=by,
        low=low,
        high=high,
        samples=len(true),
        true_p50=p50,
        true_p95=p95,
        shear_bias=float(shear.mean()),
        shear_sd=float(shear.std()),
        shear_rmse=float(np.sqrt(np.mean(shear**2))),
        shear_p95=float(np.percentile(np.abs(shear), 95)),
        u_bias_mm=float(np.linalg.norm(mean)),
        u_sd_mm=float(np.sqrt(((u - mean) ** 2).sum(axis=1).mean())),
        u_rmse_mm=float(np.sqrt(np.mean(length**2))),
        u_p95_mm=float(np.percentile(length, 95)),
    )
