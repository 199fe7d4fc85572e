"""The error bars of one load in its results folder: their writer and reader."""

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from dvc.atomic_files import write_csv
from dvc.errors import InputError
from dvc.images.image import Grid, Image, LabelMap
from dvc.io.images.labels import read_labels
from dvc.io.images.write import write_image, write_labels
from dvc.io.result_folder import (
    AGAIN,
    BIAS,
    COMPONENTS,
    ERROR_MODEL,
    INTERVALS,
    SIGMA,
    SIGMA_DISPLACEMENT,
    SIGMA_NORMAL,
    SIGMA_SHEAR,
    SOFT_TISSUES,
    STRAIN_BIAS,
    TO_BONE,
    read_scalar,
    same_grid,
    there,
)
from dvc.own_files import read_rows
from dvc.trust.components import ComponentRow, ComponentUncertainty
from dvc.trust.error_model import ErrorModel, read_error_model
from dvc.trust.uncertainty import Interval, Uncertainty
from dvc.trust.verdict import Verdict

_MAPS = {
    STRAIN_BIAS: "strain_bias",
    SIGMA_NORMAL: "normal_strain",
    SIGMA_SHEAR: "shear_strain",
    SIGMA_DISPLACEMENT: "displacement_mm",
}
_Row = TypeVar("_Row", bound=Interval | ComponentRow)


def write_uncertainty(folder: Path, grid: Grid, sure: Uncertainty, model: ErrorModel | None, verdict: Verdict) -> None:
    """Write maps of standard uncertainty, what they were read off (error model, tissues, distance), and the tables."""
    if model is not None:
        model.write(folder / ERROR_MODEL)
    write_image(folder / SIGMA, Image(grid, sure.sigma))
    if sure.bias is not None:
        write_image(folder / BIAS, Image(grid, sure.bias))
    _write_rows(folder / INTERVALS, Interval, sure.intervals, verdict)
    if sure.to_bone_mm is not None and sure.regions:
        numbers = np.zeros(grid.shape, dtype=np.int64)
        for number, inside in enumerate(sure.regions.values(), start=1):
            numbers[inside] = number
        write_labels(folder / SOFT_TISSUES, LabelMap(grid, numbers, dict(enumerate(sure.regions, start=1))))
        known = np.where(np.isfinite(sure.to_bone_mm), sure.to_bone_mm, np.float32(np.nan))
        write_image(folder / TO_BONE, Image(grid, known))
    if (parts := sure.components) is not None:
        for file, name in _MAPS.items():
            write_image(folder / file, Image(grid, getattr(parts, name)))
        _write_rows(folder / COMPONENTS, ComponentRow, parts.rows, verdict)


def read_uncertainty(folder: Path, grid: Grid) -> tuple[Uncertainty, ErrorModel] | None:
    """Read what `write_uncertainty` wrote; None where the error was not known."""
    if not (folder / ERROR_MODEL).is_file():
        return None
    model, sigma = read_error_model(folder / ERROR_MODEL), read_scalar(folder / SIGMA, grid)
    bias = read_scalar(folder / BIAS, grid).values if (folder / BIAS).is_file() else None  # not in former versions
    intervals = _read_rows(folder / INTERVALS, Interval, 2)
    sure = Uncertainty(sigma.values, intervals, model.tables[0], bias=bias)
    if model.tables[0].has_components or (folder / SOFT_TISSUES).is_file():  # not in folders of former versions
        tissues = read_labels(there(folder / SOFT_TISSUES), there(folder / SOFT_TISSUES.replace(".nii.gz", ".csv")))
        same_grid(folder / SOFT_TISSUES, tissues.grid, grid)
        regions = {name: tissues.labels == number for number, name in tissues.names.items()}
        to_bone = read_scalar(folder / TO_BONE, grid).values
        parts = _read_components(folder, grid, model)
        sure = replace(sure, regions=regions, to_bone_mm=to_bone, components=parts)
    return sure, model


def _read_components(folder: Path, grid: Grid, model: ErrorModel) -> ComponentUncertainty | None:
    if not model.tables[0].has_components:
        return None
    maps = {name: read_scalar(folder / file, grid).values for file, name in _MAPS.items()}
    return ComponentUncertainty(**maps, rows=_read_rows(folder / COMPONENTS, ComponentRow, 3))


def _write_rows(path: Path, kind: type[_Row], rows: Sequence[_Row], verdict: Verdict) -> None:
    names = [f.name for f in fields(kind)]
    write_csv(path, [*names, "verdict"], ([*(getattr(row, n) for n in names), verdict.words] for row in rows))


def _read_rows(path: Path, kind: type[_Row], words: int) -> tuple[_Row, ...]:
    """Rows of a table, in each of which some words come before the numbers."""
    names = [f.name for f in fields(kind)]
    try:
        rows = [[row[name] for name in names] for row in read_rows(there(path))]
        return tuple(kind(*row[:words], *map(float, row[words:])) for row in rows)  # type: ignore[arg-type]
    except (OSError, ValueError, KeyError) as failure:
        why = f"{type(failure).__name__}: {failure}"
        raise InputError(f"{path}: not a table of intervals ({why}). {AGAIN}") from failure
