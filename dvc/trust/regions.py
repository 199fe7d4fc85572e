"""Figures per region: how much tissue, how much of it has a value, and how the values are spread."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from dvc.arrays import FloatArray
from dvc.atomic_files import write_whole
from dvc.errors import GeometryError, InputError
from dvc.images.image import LabelMap
from dvc.trust.verdict import Verdict

SHEAR_THRESHOLDS = (0.2, 0.3, 0.4, 0.5)
_THRESHOLDS: Mapping[str, Sequence[float]] = MappingProxyType({"max_shear": SHEAR_THRESHOLDS})
_NUMBERS = ("mean", "sd", "median", "p5", "p90", "p95", "p99", "max")
_ABOVE = "volume_above_{:g}_ml"
_PERCENTILES = (50.0, 5.0, 90.0, 95.0, 99.0)


@dataclass(frozen=True, slots=True)
class RegionRow:
    """One quantity in one region.

    Attributes
    ----------
    region, quantity : str
    voxels : int
        Voxels of the region, with a value or not.
    volume_ml : float
        Volume of the region, mL.
    defined_voxels : int
        Voxels of the region with a value; all figures below are over these alone.
    mean, sd, median, p5, p90, p95, p99, max : float
        In the unit of the quantity; sd is that of the population (n, not n - 1). NaN without a value.
    volume_above_ml : mapping of threshold to mL
        Volume whose value exceeds each threshold; empty for quantities without thresholds. A lower bound
        where ``defined_fraction`` is below one.
    """

    region: str
    quantity: str
    voxels: int
    volume_ml: float
    defined_voxels: int
    mean: float
    sd: float
    median: float
    p5: float
    p90: float
    p95: float
    p99: float
    max: float
    volume_above_ml: Mapping[float, float] = field(default_factory=dict)

    @property
    def defined_fraction(self) -> float:
        """Share of the region's voxels that have a value; NaN for a region without voxels."""
        return self.defined_voxels / self.voxels if self.voxels else float("nan")


def volume_above(values: npt.ArrayLike, volumes_ml: npt.ArrayLike, thresholds: npt.ArrayLike) -> FloatArray:
    """Volume whose value exceeds each threshold: V(s) = sum of the volumes with value > s; no bins.

    Parameters
    ----------
    values : (n,)
        Value per voxel or element. NaN counts as no volume at any threshold.
    volumes_ml : float or (n,)
        Volume of each, mL.
    thresholds : (m,)

    Returns
    -------
    (m,)
        mL; falls in steps at the values.

    Raises
    ------
    InputError
        If values and volumes differ in number.

    Examples
    --------
    >>> volume_above([0.1, 0.3, np.nan, 0.3], 2.0, [0.0, 0.1, 0.3]).tolist()
    [6.0, 4.0, 0.0]
    """
    flat = np.asarray(values, dtype=np.float64).ravel()
    volumes = np.asarray(volumes_ml, dtype=np.float64)
    if volumes.ndim and volumes.shape != flat.shape:
        raise InputError(f"Got {flat.size} values and volumes of shape {volumes.shape}; give one volume for each.")
    known = ~np.isnan(flat)
    each = np.broadcast_to(volumes, flat.shape)[known]
    order = np.argsort(flat[known])
    below = np.concatenate([[0.0], np.cumsum(each[order])])
    at = np.searchsorted(flat[known][order], np.asarray(thresholds, dtype=np.float64), side="right")
    return np.asarray(below[-1] - below[at])


def region_statistics(
    labels: LabelMap,
    values: Mapping[str, npt.NDArray[np.floating]],
    *,
    thresholds: Mapping[str, Sequence[float]] = _THRESHOLDS,
) -> list[RegionRow]:
    """Statistics of each quantity in each named region.

    Parameters
    ----------
    labels : LabelMap
    values : mapping of quantity to (ni, nj, nk) array
        On the label map's grid; NaN where not defined.
    thresholds : mapping of quantity to thresholds
        For which the volume above is wanted; by default maximal shear above 0.2, 0.3, 0.4 and 0.5.

    Returns
    -------
    list of RegionRow
        In the order of the quantities, then of the label map's names. A region without voxels has a row too.

    Raises
    ------
    GeometryError
        If an array is not on the label map's grid.
    InputError
        If an array holds infinite values.
    """
    for quantity, array in values.items():
        if array.shape != labels.grid.shape:
            raise GeometryError(
                f"'{quantity}' has shape {array.shape}, the label map {labels.grid.shape}; they must be on one grid."
            )
        infinite = int(np.count_nonzero(np.isinf(array)))
        if infinite:
            raise InputError(f"'{quantity}' holds {infinite} infinite values; set them to NaN (missing).")
    flat = labels.labels.ravel()
    voxels_of = {name: np.flatnonzero(flat == label) for label, name in labels.names.items()}
    voxel_ml = labels.grid.voxel_volume_mm3 / 1000.0
    return [
        _row(region, quantity, array.ravel()[voxels], voxel_ml, thresholds.get(quantity, ()))
        for quantity, array in values.items()
        for region, voxels in voxels_of.items()
    ]


def _row(
    region: str, quantity: str, found: npt.NDArray[np.floating], voxel_ml: float, thresholds: Sequence[float]
) -> RegionRow:
    known = found[~np.isnan(found)].astype(np.float64)
    if known.size:
        median, p5, p90, p95, p99 = (float(p) for p in np.percentile(known, _PERCENTILES))
        mean, sd, largest = float(known.mean()), float(known.std()), float(known.max())
    else:
        mean = sd = median = p5 = p90 = p95 = p99 = largest = float("nan")
    above = volume_above(known, voxel_ml, list(thresholds))
    return RegionRow(
        region,
        quantity,
        found.size,
        found.size * voxel_ml,
        known.size,
        mean,
        sd,
        median,
        p5,
        p90,
        p95,
        p99,
        largest,
        {float(t): float(v) for t, v in zip(thresholds, above, strict=True)},
    )


def write_regions_csv(path: Path, rows: Sequence[RegionRow], verdict: Verdict | None = None) -> None:
    """Write rows as a table: one line each, full precision, NaN where there is no value.

    A column ``volume_above_0.2_ml`` stands for each threshold of any row; empty for quantities without it.
    With a verdict its words (`Verdict.words`) stand in a last column.
    The file appears under its name only when it is complete.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    thresholds = sorted({t for row in rows for t in row.volume_above_ml})
    header = ["region", "quantity", "voxels", "volume_ml", "defined_voxels", "defined_fraction", *_NUMBERS]
    header += [_ABOVE.format(t) for t in thresholds]
    told = [] if verdict is None else [verdict.words]
    header += ["verdict"] if told else []
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for row in rows:
        cells: list[object] = [row.region, row.quantity, row.voxels, row.volume_ml, row.defined_voxels]
        cells += [row.defined_fraction, *(getattr(row, name) for name in _NUMBERS)]
        cells += [*(row.volume_above_ml.get(t, "") for t in thresholds), *told]
        writer.writerow([_plain(cell) for cell in cells])
    write_whole(path, text.getvalue())


def read_regions_csv(path: Path) -> list[RegionRow]:
    """Read what `write_regions_csv` wrote: nine digits of every number.

    Raises
    ------
    InputError
        If there is no such file, or it is another table.
    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [_row_of(cells) for cells in csv.DictReader(file)]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as failure:
        raise InputError(
            f"{path}: no statistics by region ({failure!r}). Register this load again, or get a whole copy of the file."
        ) from failure


def _row_of(cells: Mapping[str, str]) -> RegionRow:
    before, after = _ABOVE.split("{:g}")
    above = {
        float(name.removeprefix(before).removesuffix(after)): float(cell)
        for name, cell in cells.items()
        if name.startswith(before) and cell
    }
    mean, sd, median, *higher = (float(cells[name]) for name in _NUMBERS)
    counts = int(cells["voxels"]), float(cells["volume_ml"]), int(cells["defined_voxels"])
    p5, p90, p95, p99, most = higher
    return RegionRow(
        cells["region"], cells["quantity"], *counts, mean, sd, median, p5, p90, p95, p99, most, volume_above_ml=above
    )


def _plain(cell: object) -> str:
    if isinstance(cell, float):
        return "NaN" if np.isnan(cell) else f"{cell:.9g}"
    return str(cell)
