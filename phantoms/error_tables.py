"""Tables of an accuracy study: errors by tissue, position and strain, noise floor, and spatial resolution."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

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
    """Errors over one set of samples, measured minus true; max. shear dimensionless, displacement in mm.

    Attributes
    ----------
    voxel_mm : str
        Voxel size, such as "0.8" or "0.8 x 0.8 x 1.6".
    labels_off : int
        As in `AccuracyCase`.
    by : {"all", "distance to bone, mm", "distance to a border, mm", "true maximal shear"}
    low, high : float
        Limits of the bin; NaN for "all".
    true_p50, true_p95 : float
        Percentiles of the true max. shear.
    shear_bias, shear_sd, shear_rmse, shear_p95 : float
        Error of the max. shear; the 95th percentile is that of its absolute value.
    u_bias_mm, u_sd_mm, u_rmse_mm, u_p95_mm : float
        Length of the mean error vector, root mean square distance from it, root mean square length of the error, and
        95th percentile of that length.
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
    """Noise floor: apparent strain in one tissue of an unloaded pair; MAER, SDER, percentiles of the max. shear."""

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
    """Fraction of a sinusoidal shear of one wavelength that is recovered: slope of measured on true H_dn."""

    preset: str
    voxel_mm: str
    snr: float
    tissue: str
    wavelength_mm: float
    recovered: float


@dataclass(frozen=True, slots=True)
class RunRow:
    """One registration: time, fraction of the heel without a result, folded samples, RMSE of the max. shear."""

    case: str
    estimated_snr: float
    seconds: float
    without_result: float
    folded: int
    shear_rmse: float


def run_rows(runs: Sequence[ErrorSamples]) -> list[RunRow]:
    """One row for each run; errors are those of its soft tissue."""
    rows = []
    for run in runs:
        error = (run.shear - run.true_shear)[of_tissue(run, POOLED)].astype(np.float64)
        without = run.unknown / (run.unknown + len(run.shear))
        rmse = float(np.sqrt(np.mean(error**2)))
        rows.append(RunRow(run.case.name, run.estimated_snr, run.seconds, without, run.folded, rmse))
    return rows


def error_rows(runs: Sequence[ErrorSamples]) -> list[ErrorRow]:
    """Errors by condition, label map, motion and tissue: overall, by distance to bone and border, and by true strain.

    Shear waves are left out; see `resolution_rows`.
    """
    rows = []
    for condition, of_condition in by_condition(runs):
        by_motion: dict[tuple[int, str], list[ErrorSamples]] = {}
        for run in of_condition:
            if run.case.wavelength_mm is None:
                by_motion.setdefault((run.case.labels_off, run.case.motion), []).append(run)
        for (labels_off, motion), some in by_motion.items():
            for tissue in (*TISSUES.values(), POOLED):
                for place, kept in _bins(some, [of_tissue(r, tissue) for r in some]):
                    if any(k.any() for k in kept):
                        rows.append(ErrorRow(*condition, labels_off, motion, tissue, *place, *_figures(some, kept)))
    return rows


def floor_rows(runs: Sequence[ErrorSamples]) -> list[FloorRow]:
    """Noise floor by condition and tissue, over the pairs without strain."""
    rows = []
    for condition, of_condition in by_condition(runs):
        still = [r for r in of_condition if r.case.motion == "still"]
        for tissue in (*TISSUES.values(), POOLED) if still else ():
            kept = [of_tissue(r, tissue) for r in still]
            strain = _joined(still, kept, lambda r: r.mean_abs_strain)
            if len(strain):
                p50, p95 = (float(p) for p in np.percentile(_joined(still, kept, lambda r: r.shear), [50, 95]))
                rows.append(FloorRow(*condition, tissue, float(strain.mean()), float(strain.std()), p50, p95))
    return rows


def resolution_rows(runs: Sequence[ErrorSamples]) -> list[ResolutionRow]:
    """Fraction of a sinusoidal strain that is recovered, by condition, tissue and rising wavelength."""
    rows = []
    for condition, of_condition in by_condition(runs):
        wavelengths = sorted({r.case.wavelength_mm for r in of_condition if r.case.wavelength_mm is not None})
        for tissue in (*SOFT, POOLED):
            for wavelength in wavelengths:
                waves = [r for r in of_condition if r.case.wavelength_mm == wavelength]
                kept = [of_tissue(r, tissue) for r in waves]
                true = _joined(waves, kept, lambda r: r.true_slope).astype(np.float64)
                measured = _joined(waves, kept, lambda r: r.slope).astype(np.float64)
                if len(true):
                    recovered = float(true @ measured / (true @ true))
                    rows.append(ResolutionRow(*condition, tissue, wavelength, recovered))
    return rows


def wavelength_recovered(rows: Sequence[ResolutionRow], share: float) -> float:
    """Shortest wavelength (mm) from which on a ``share`` of the strain is recovered; NaN outside the range of the rows.

    Interpolated linearly between the rows, which are of one condition and tissue.
    """
    lengths, recovered = np.array(sorted((r.wavelength_mm, r.recovered) for r in rows)).reshape(-1, 2).T
    below = np.flatnonzero(recovered < share)
    if not len(below) or below[-1] == len(rows) - 1:
        return float("nan")  # recovered even at the shortest, or not even at the longest
    i = int(below[-1])
    part = (share - recovered[i]) / (recovered[i + 1] - recovered[i])
    return float(lengths[i] + part * (lengths[i + 1] - lengths[i]))


def by_condition(runs: Sequence[ErrorSamples]) -> Iterator[tuple[tuple[str, str, float], list[ErrorSamples]]]:
    """Runs of equal preset, voxel size and SNR, with these three as tables name them."""
    groups: dict[tuple[str, tuple[float, float, float], float], list[ErrorSamples]] = {}
    for run in runs:
        groups.setdefault((run.case.preset, run.case.spacing_mm, run.case.snr), []).append(run)
    for (preset, spacing, snr), group in groups.items():
        edges = spacing[:1] if len(set(spacing)) == 1 else spacing
        yield (preset, " x ".join(f"{edge:g}" for edge in edges), snr), group


def of_tissue(run: ErrorSamples, name: str) -> BoolArray:
    """Which samples lie in a tissue, (n,) bool; "soft tissue" is all of SOFT."""
    numbers = [n for n, tissue in TISSUES.items() if tissue == name or (name == POOLED and tissue in SOFT)]
    return np.isin(run.tissue, numbers)


def _joined(
    runs: Sequence[ErrorSamples], kept: Sequence[BoolArray], values: Callable[[ErrorSamples], Float32Array]
) -> Float32Array:
    """Values of the kept samples of several runs, one after the other."""
    return np.concatenate([values(run)[k] for run, k in zip(runs, kept, strict=True)])


def _bins(
    runs: Sequence[ErrorSamples], tissue: Sequence[BoolArray]
) -> Iterator[tuple[tuple[str, float, float], list[BoolArray]]]:
    """Quantity, low and high end of each bin, with each run's samples of the tissue in it."""
    yield ("all", float("nan"), float("nan")), list(tissue)
    quantities: Mapping[str, tuple[Callable[[ErrorSamples], Float32Array], tuple[float, ...]]] = {
        "distance to bone, mm": (lambda r: r.to_bone_mm, BONE_BINS_MM),
        "distance to a border, mm": (lambda r: r.to_border_mm, BORDER_BINS_MM),
        "true maximal shear": (lambda r: r.true_shear, SHEAR_BINS),
    }
    for by, (value, ends) in quantities.items():
        for low, high in pairwise(ends):
            kept = [k & (value(r) >= low) & (value(r) < high) for r, k in zip(runs, tissue, strict=True)]
            yield (by, low, high), kept


def _figures(runs: Sequence[ErrorSamples], kept: Sequence[BoolArray]) -> tuple[Any, ...]:
    """Number of samples, percentiles of the true shear, and errors, in the order of `ErrorRow`."""
    true = _joined(runs, kept, lambda r: r.true_shear).astype(np.float64)
    shear = _joined(runs, kept, lambda r: r.shear).astype(np.float64) - true
    u = _joined(runs, kept, lambda r: r.u_error_mm).astype(np.float64)
    mean = u.mean(axis=0)
    length = np.linalg.norm(u, axis=1)
    of_shear = (shear.mean(), shear.std(), np.sqrt(np.mean(shear**2)), np.percentile(np.abs(shear), 95))
    spread = np.sqrt(((u - mean) ** 2).sum(axis=1).mean())
    of_u = (np.linalg.norm(mean), spread, np.sqrt(np.mean(length**2)), np.percentile(length, 95))
    return (len(true), *(float(value) for value in (*np.percentile(true, [50, 95]), *of_shear, *of_u)))
