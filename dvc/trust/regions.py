"""Figures per region: how much tissue, how much of it has a value, and how the values are spread."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from dvc.arrays import FloatArray
from dvc.atomic_files import write_csv
from dvc.errors import GeometryError, InputError
from dvc.images.image import LabelMap
from dvc.trust.verdict import Verdict

SHEAR_THRESHOLDS = (0.2, 0.3, 0.4, 0.5)
_NUMBERS = ("mean", "sd", "median", "p5", "p90", "p95", "p99", "max")
_ABOVE = "volume_above_{:g}_ml"
_PERCENTILES = (50.0, 5.0, 90.0, 95.0, 99.0)


@dataclass(frozen=True, slots=True)
class RegionRow:
    """One quantity in one region; values are in its unit, over the voxels with a value, NaN where there is none."""

    region: str
    quantity: str
    voxels: int
    volume_ml: float
    defined_voxels: int
    mean: float
    sd: float  # of the population: n, not n - 1
    median: float
    p5: float
    p90: float
    p95: float
    p99: float
    max: float
    volume_above_ml: Mapping[float, float] = field(default_factory=dict)  # by threshold; without voxels of no value

    @property
    def defined_fraction(self) -> float:
        """Share of the region's voxels that have a value; NaN for a region without voxels."""
        return self.defined_voxels / self.voxels if self.voxels else float("nan")


def volume_above(values: npt.ArrayLike, volumes_ml: npt.ArrayLike, thresholds: npt.ArrayLike) -> FloatArray:
    """Volume (m,), mL, whose value exceeds each threshold: V(s) = sum of the volumes with value > s; no bins.

    Values (n,) of voxels or cells have volumes of ``volumes_ml``, one number or (n,). NaN counts as no volume.

    >>> volume_above([0.1, 0.3, np.nan, 0.3], 2.0, [0.0, 0.1, 0.3]).tolist()
    [6.0, 4.0, 0.0]
    """
    flat, volumes = np.asarray(values, dtype=np.float64).ravel(), np.asarray(volumes_ml, dtype=np.float64)
    if volumes.ndim and volumes.shape != flat.shape:
        raise InputError(f"Each value needs one volume; got {flat.size} values and volumes of shape {volumes.shape}.")
    known = ~np.isnan(flat)
    each = np.broadcast_to(volumes, flat.shape)[known]
    order = np.argsort(flat[known])
    below = np.concatenate([[0.0], np.cumsum(each[order])])
    at = np.searchsorted(flat[known][order], np.asarray(thresholds, dtype=np.float64), side="right")
    return np.asarray(below[-1] - below[at])


def region_statistics(labels: LabelMap, values: Mapping[str, npt.NDArray[np.floating]]) -> list[RegionRow]:
    """Statistics of each quantity (ni, nj, nk), NaN where not defined, in each named region of the same grid.

    Rows follow the order of the quantities, then of the label map's names; a region without voxels has a row, too.
    GeometryError for another grid, InputError for infinite values.
    """
    for quantity, array in values.items():
        if array.shape != labels.grid.shape:
            raise GeometryError(
                f"'{quantity}' has shape {array.shape}, but the label map has shape {labels.grid.shape}. Use "
                "the same grid."
            )
        if infinite := int(np.count_nonzero(np.isinf(array))):
            raise InputError(f"'{quantity}' has {infinite} infinite values; set them to NaN (missing).")
    flat, voxel_ml = labels.labels.ravel(), labels.grid.voxel_volume_mm3 / 1000.0
    voxels_of = {name: np.flatnonzero(flat == label) for label, name in labels.names.items()}
    return [
        _row(region, quantity, array.ravel()[voxels], voxel_ml)
        for quantity, array in values.items()
        for region, voxels in voxels_of.items()
    ]


def _row(region: str, quantity: str, found: npt.NDArray[np.floating], voxel_ml: float) -> RegionRow:
    known = found[~np.isnan(found)].astype(np.float64)
    figures = dict.fromkeys(_NUMBERS, float("nan"))
    if known.size:
        several = known.mean(), known.std(), *np.percentile(known, _PERCENTILES), known.max()
        figures = {name: float(value) for name, value in zip(_NUMBERS, several, strict=True)}
    above = {}
    if quantity == "max_shear":
        above = dict(zip(SHEAR_THRESHOLDS, volume_above(known, voxel_ml, SHEAR_THRESHOLDS).tolist(), strict=True))
    return RegionRow(region, quantity, found.size, found.size * voxel_ml, known.size, **figures, volume_above_ml=above)


def write_regions_csv(path: Path, rows: Sequence[RegionRow], verdict: Verdict | None = None) -> None:
    """Write rows as a table, whole or not at all: one line each, nine digits, NaN where there is no value.

    A column ``volume_above_0.2_ml`` stands for each threshold of any row, empty for quantities without it; the words of
    the verdict stand in a last column.
    """
    thresholds = sorted({t for row in rows for t in row.volume_above_ml})
    told = [] if verdict is None else [verdict.words]
    columns = ("region", "quantity", "voxels", "volume_ml", "defined_voxels", "defined_fraction", *_NUMBERS)
    head = [*columns, *(_ABOVE.format(t) for t in thresholds), *["verdict"] * len(told)]

    def cells(row: RegionRow) -> Iterator[str]:
        above = (row.volume_above_ml.get(t, "") for t in thresholds)
        return map(_plain, (*(getattr(row, name) for name in columns), *above, *told))

    write_csv(path, head, map(cells, rows))


def read_regions_csv(path: Path) -> list[RegionRow]:
    """Read what `write_regions_csv` wrote; InputError for a missing file or another table."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            return [_row_of(cells) for cells in csv.DictReader(file)]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, csv.Error) as failure:
        why = f"{type(failure).__name__}: {failure}"
        what = f"cannot be read as statistics by region ({why}). Register this load again, or copy the file again"
        raise InputError(f"{path}: {what}.") from failure


def _row_of(cells: Mapping[str, str]) -> RegionRow:
    (before, after), given = _ABOVE.split("{:g}"), [name for name, cell in cells.items() if cell]
    thresholds = {name: name.removeprefix(before).removesuffix(after) for name in given if name.startswith(before)}
    above = {float(threshold): float(cells[name]) for name, threshold in thresholds.items()}
    voxels, volume_ml, defined = int(cells["voxels"]), float(cells["volume_ml"]), int(cells["defined_voxels"])
    figures = {name: float(cells[name]) for name in _NUMBERS}
    return RegionRow(cells["region"], cells["quantity"], voxels, volume_ml, defined, **figures, volume_above_ml=above)


def _plain(cell: object) -> str:
    return str(cell) if not isinstance(cell, float) else "NaN" if np.isnan(cell) else f"{cell:.9g}"
