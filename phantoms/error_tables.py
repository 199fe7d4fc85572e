"""Errors against the truth by tissue, and tables of an accuracy study: errors, noise floor, spatial resolution."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from dvc import Deformation, LabelMap, StrainField, StrainMaps, evaluate_on_grid
from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.errors import GeometryError
from dvc.trust.error_model import POOLED
from phantoms.accuracy_run import RIGID, SAMPLED, ErrorSamples
from phantoms.anatomy import TISSUES

SOFT = tuple(name for name in TISSUES.values() if name not in RIGID)
_BINS: Mapping[str, tuple[str, tuple[float, ...]]] = {
    "distance to bone, mm": ("to_bone_mm", (0.0, 1.5, 3.0, 6.0, 12.0, np.inf)),
    "distance to a border, mm": ("to_border_mm", (0.0, 1.0, 2.0, 4.0, np.inf)),
    "true maximum shear strain": ("true_shear", (0.0, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, np.inf)),
}
_Pool = Mapping[str, npt.NDArray[Any]]


@dataclass(frozen=True, slots=True)
class TissueError:
    """Error in one tissue over its voxels; reference configuration, displacement in mm, max. shear dimensionless.

    Attributes
    ----------
    voxels, folded : int
        Voxels compared, and those with det F <= 0.
    true_p50, true_p95 : float
        Percentiles of the true maximum shear strain (E_1 - E_3) / 2.
    shear_rmse, shear_bias, shear_error_p95 : float
        Root mean square and mean of measured minus true max. shear; 95th percentile of its absolute value.
    u_p50_mm, u_p95_mm : float
        Percentiles of the length of the difference between measured and true displacement.
    """

    tissue: str
    voxels: int
    true_p50: float
    true_p95: float
    shear_rmse: float
    shear_bias: float
    shear_error_p95: float
    u_p50_mm: float
    u_p95_mm: float
    folded: int


def errors_by_tissue(
    labels: LabelMap, truth: Deformation, measured: Deformation, where: BoolArray
) -> tuple[TissueError, ...]:
    """Compare two deformations in the voxels of each tissue; tissues without such a voxel are left out.

    Parameters
    ----------
    labels : LabelMap
        Tissues on the reference grid.
    truth, measured : Deformation
        u and grad u in the reference configuration, LPS mm.
    where : (ni, nj, nk) bool
        Voxels to compare, as far as ``measured`` is defined there.

    Raises
    ------
    GeometryError
        If ``where`` is not on the labels' grid.
    """
    shape = labels.grid.shape
    if where.shape != shape:
        raise GeometryError(f"The voxels to compare have shape {where.shape}, but the labels have shape {shape}.")
    inside = where & (labels.labels > 0)
    true_u, true_H = evaluate_on_grid(truth, labels.grid, inside)
    u, H = evaluate_on_grid(measured, labels.grid, inside)
    true, strain = StrainField.from_gradient(true_H).max_shear, StrainField.from_gradient(H)
    kept = strain.valid
    fields = (field[kept] for field in (true, strain.max_shear, strain.jacobian, true_u, u))
    return _by_tissue(labels.names, labels.labels[inside][kept], *fields)


def errors_of_maps(labels: LabelMap, truth: StrainMaps, measured: StrainMaps) -> tuple[TissueError, ...]:
    """Compare maps of a deformation and of the true one as `errors_by_tissue` does, in the voxels where both are valid.

    Raises
    ------
    GeometryError
        If they are not on the labels' grid.
    """
    for name, maps in (("true", truth), ("measured", measured)):
        if not maps.grid.same_as(labels.grid):
            raise GeometryError(f"The {name} maps are on another grid than the labels.")
    where = truth.valid & measured.valid & (labels.labels > 0)
    fields = (truth.max_shear, measured.max_shear, measured.jacobian, truth.displacement_mm, measured.displacement_mm)
    return _by_tissue(labels.names, labels.labels[where], *(field[where].astype(np.float64) for field in fields))


def _by_tissue(
    names: Mapping[int, str], number: IntArray, true_shear: FloatArray, shear: FloatArray, jacobian: FloatArray,
    true_u: FloatArray, u: FloatArray,
) -> tuple[TissueError, ...]:  # fmt: skip
    """Errors in voxels (n,) of known label numbers; displacements (n, 3), mm."""
    error, distance, rows = shear - true_shear, np.linalg.norm(u - true_u, axis=1), []
    for value, tissue in names.items():
        kept = number == value
        if not kept.any():
            continue
        true, off, length = true_shear[kept], error[kept], distance[kept]
        of_true = np.median(true), np.percentile(true, 95)
        of_shear = np.sqrt(np.mean(off**2)), off.mean(), np.percentile(np.abs(off), 95)
        of_u = np.median(length), np.percentile(length, 95)
        figures: list[Any] = [float(found) for found in (*of_true, *of_shear, *of_u)]
        figures.append(int(np.count_nonzero(jacobian[kept] <= 0)))
        rows.append(TissueError(tissue, len(true), *figures))
    return tuple(rows)


@dataclass(frozen=True, slots=True)
class OfCondition:
    """Row of one condition: preset, voxel size in mm, such as "0.8" or "0.8 x 0.8 x 1.6", and signal-to-noise ratio."""

    preset: str
    voxel_mm: str
    snr: float

    @property
    def condition(self) -> tuple[str, str, float]:
        """Preset, voxel size and SNR."""
        return self.preset, self.voxel_mm, self.snr


@dataclass(frozen=True, slots=True)
class ErrorRow(OfCondition):
    """Errors over one set of samples, measured minus true; max. shear dimensionless, displacement in mm.

    Attributes
    ----------
    preset, voxel_mm, snr
        The condition: voxel size in mm, such as "0.8" or "0.8 x 0.8 x 1.6".
    labels_off : int
        As in `AccuracyCase`.
    by : {"all", "distance to bone, mm", "distance to a border, mm", "true maximum shear strain"}
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
class FloorRow(OfCondition):
    """Noise floor: apparent strain in one tissue of an unloaded pair, dimensionless.

    MAER and SDER: mean and SD of the samples' mean absolute strain component; percentiles of the max. shear.
    """

    tissue: str
    maer: float
    sder: float
    shear_p50: float
    shear_p95: float


@dataclass(frozen=True, slots=True)
class ResolutionRow(OfCondition):
    """Fraction of a sinusoidal shear of one wavelength (mm) that is recovered: slope of measured on true H_dn."""

    tissue: str
    wavelength_mm: float
    recovered: float


@dataclass(frozen=True, slots=True)
class RunRow:
    """One registration: time (s), fraction of the heel without a result, folded samples, RMSE of the max. shear."""

    case: str
    estimated_snr: float
    seconds: float
    without_result: float
    folded: int
    shear_rmse: float


def run_rows(runs: Sequence[ErrorSamples]) -> list[RunRow]:
    """One row for each run, in the order given; errors are those of its soft tissue."""
    rows = []
    for run in runs:
        error = (run.shear - run.true_shear)[of_tissue(run.tissue, POOLED)].astype(np.float64)
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
            pool = _pooled(some)
            for tissue in (*TISSUES.values(), POOLED):
                for place, kept in _bins(pool, of_tissue(pool["tissue"], tissue)):
                    if kept.any():
                        rows.append(ErrorRow(*condition, labels_off, motion, tissue, *place, *_figures(pool, kept)))
    return rows


def floor_rows(runs: Sequence[ErrorSamples]) -> list[FloorRow]:
    """Noise floor by condition and tissue, over the runs named "still"; conditions without one have no rows."""
    rows = []
    for condition, of_condition in by_condition(runs):
        still = [r for r in of_condition if r.case.motion == "still"]
        pool = _pooled(still)
        for tissue in (*TISSUES.values(), POOLED) if still else ():
            kept = of_tissue(pool["tissue"], tissue)
            if kept.any():
                strain = np.abs(pool["strain"][kept]).mean(axis=1)
                p50, p95 = (float(p) for p in np.percentile(pool["shear"][kept], [50, 95]))
                rows.append(FloorRow(*condition, tissue, float(strain.mean()), float(strain.std()), p50, p95))
    return rows


def resolution_rows(runs: Sequence[ErrorSamples]) -> list[ResolutionRow]:
    """Fraction of a sinusoidal strain that is recovered, by condition, tissue and rising wavelength; of waves alone."""
    rows = []
    for condition, of_condition in by_condition(runs):
        wavelengths = sorted({r.case.wavelength_mm for r in of_condition if r.case.wavelength_mm is not None})
        pools = {length: _pooled([r for r in of_condition if r.case.wavelength_mm == length]) for length in wavelengths}
        for tissue in (*SOFT, POOLED):
            for wavelength, pool in pools.items():
                kept = of_tissue(pool["tissue"], tissue)
                true, measured = (pool[name][kept].astype(np.float64) for name in ("true_slope", "slope"))
                if len(true):
                    recovered = float(true @ measured / (true @ true))
                    rows.append(ResolutionRow(*condition, tissue, wavelength, recovered))
    return rows


def wavelength_recovered(rows: Sequence[ResolutionRow], share: float) -> float:
    """Shortest wavelength (mm) from which on a ``share`` of the strain is recovered; NaN outside the range of the rows.

    Between the rows, which are of one condition and tissue, the fraction is linear in the logarithm of the wavelength.
    """
    if len({(r.preset, r.voxel_mm, r.snr, r.tissue) for r in rows}) > 1:
        raise ValueError("the rows are of several conditions or tissues")
    lengths, recovered = np.array(sorted((r.wavelength_mm, r.recovered) for r in rows)).reshape(-1, 2).T
    below = np.flatnonzero(recovered < share)
    if not len(below) or below[-1] == len(rows) - 1:
        return float("nan")  # recovered even at the shortest, or not even at the longest
    i = int(below[-1])
    part = (share - recovered[i]) / (recovered[i + 1] - recovered[i])
    return float(lengths[i] * (lengths[i + 1] / lengths[i]) ** part)


def by_condition(runs: Sequence[ErrorSamples]) -> Iterator[tuple[tuple[str, str, float], list[ErrorSamples]]]:
    """Runs of equal preset, voxel size and SNR, with these three as tables name them."""
    groups: dict[tuple[str, tuple[float, float, float], float], list[ErrorSamples]] = {}
    for run in runs:
        groups.setdefault((run.case.preset, run.case.spacing_mm, run.case.snr), []).append(run)
    for (preset, spacing, snr), group in groups.items():
        edges = spacing[:1] if len(set(spacing)) == 1 else spacing
        yield (preset, " x ".join(f"{edge:g}" for edge in edges), snr), group


def of_tissue(numbers: IntArray, name: str) -> BoolArray:
    """Which label numbers (n,) are those of a tissue, (n,) bool; "soft tissue" is all of SOFT."""
    return np.isin(numbers, [n for n, tissue in TISSUES.items() if tissue in (SOFT if name == POOLED else (name,))])


def _pooled(runs: Sequence[ErrorSamples]) -> _Pool:
    """Samples of several runs, one after the other, by the names of `ErrorSamples`."""
    return {name: np.concatenate([getattr(run, name) for run in runs]) for name in SAMPLED} if runs else {}


def _bins(pool: _Pool, of_tissue: BoolArray) -> Iterator[tuple[tuple[str, float, float], BoolArray]]:
    """Quantity, low and high end of each bin, with the samples of the tissue in it, (n,) bool."""
    yield ("all", float("nan"), float("nan")), of_tissue
    for by, (name, ends) in _BINS.items():
        for low, high in pairwise(ends):
            yield (by, low, high), of_tissue & (pool[name] >= low) & (pool[name] < high)


def _figures(pool: _Pool, kept: BoolArray) -> tuple[Any, ...]:
    """Number of samples, percentiles of the true shear, and errors, in the order of `ErrorRow`."""
    true, shear, u = (pool[name][kept].astype(np.float64) for name in ("true_shear", "shear", "u_error_mm"))
    shear -= true
    mean = u.mean(axis=0)
    length = np.linalg.norm(u, axis=1)
    of_shear = (shear.mean(), shear.std(), np.sqrt(np.mean(shear**2)), np.percentile(np.abs(shear), 95))
    spread = np.sqrt(((u - mean) ** 2).sum(axis=1).mean())
    of_u = (np.linalg.norm(mean), spread, np.sqrt(np.mean(length**2)), np.percentile(length, 95))
    return (len(true), *(float(value) for value in (*np.percentile(true, [50, 95]), *of_shear, *of_u)))
