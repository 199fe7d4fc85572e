"""Error of a measurement relative to the known strain of a phantom: table and section of the report."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import get_type_hints

from dvc.atomic_files import write_csv
from dvc.errors import InputError
from dvc.report.page import Section, Table
from mrstrain.studies.file import Study
from mrstrain.studies.pipeline import StageOutcome
from phantoms import TissueError

TABLE = "error.csv"
_MADE = "registered_utc"
_HEADER = ("load", _MADE, *(f.name for f in fields(TissueError)))
_FIGURES = ("true_p50", "true_p95", "shear_rmse", "shear_bias", "u_p50_mm", "u_p95_mm")
_COLUMNS = (
    "load", "tissue", "true max. shear, median", "true max. shear, p95", "error of max. shear, RMSE", "bias",
    "displacement error, mm, median", "p95",
)  # fmt: skip


def write_errors(path: Path, errors: Mapping[str, Sequence[TissueError]], outcomes: Mapping[str, StageOutcome]) -> None:
    """Write the error of each load by tissue, with the time of its registration."""
    rows = [(load, _made(outcomes, load), *map(str, astuple(one))) for load, of in errors.items() for one in of]
    write_csv(path, _HEADER, rows)


def read_errors(path: Path, outcomes: Mapping[str, StageOutcome]) -> dict[str, tuple[TissueError, ...]]:
    """Read the errors of `write_errors`, for the loads that have not been registered again since.

    InputError is raised for a row that is damaged.
    """
    errors: dict[str, tuple[TissueError, ...]] = {}
    for row in _rows(path):
        if row[_MADE] and row[_MADE] == _made(outcomes, row["load"]):
            try:
                values = {name: kind(row[name]) for name, kind in get_type_hints(TissueError).items()}
            except (ValueError, TypeError) as failure:
                what = f"the error of {row['load']} is damaged ({failure})"
                raise InputError(f"{path}: {what}. Delete this file; `mrstrain demo` replaces it.") from failure
            errors[row["load"]] = (*errors.get(row["load"], ()), TissueError(**values))
    return errors


def _rows(path: Path) -> list[dict[str, str]]:
    """Rows of an error table; none if the file is something else."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error):
        return []
    return rows if rows and set(_HEADER) <= set(rows[0]) else []


def error_against_truth(study: Study, outcomes: Mapping[str, StageOutcome]) -> list[Section]:
    """Section of the report with the error table in the folder of the study; none without a table.

    Loads that were registered again since are left out, because their error is unknown.
    """
    rows = _rows(study.place / TABLE)
    if not rows:
        return []
    known = read_errors(study.place / TABLE, outcomes)
    figures = tuple(
        (load, one.tissue, *(getattr(one, key) for key in _FIGURES)) for load, of in known.items() for one in of
    )
    note = (
        "p95: 95th percentile. All bones are rigid: their true shear is zero. The registration keeps only one of them "
        "rigid."
    )
    if old := dict.fromkeys(row["load"] for row in rows if row["load"] not in known):
        note += f" Unknown for {', '.join(old)}, registered again since; `mrstrain demo` computes the error."
    table = Table("Error of max. shear and displacement, by load and tissue", _COLUMNS, figures, note)
    text = (
        "These images show a phantom whose strain is known at every point, so the measurement can be compared with "
        "the truth. For real images there is no such table; use the verdict, the intervals and the repeat scan. The "
        "phantom deforms by a prescribed motion, without forces, so no material set is the true one."
    )
    return [Section("Measurement error (phantom with known strain)", None, (table,), (), (text,))]


def _made(outcomes: Mapping[str, StageOutcome], load: str) -> str:
    """Time of the registration of a load; empty if it has no result."""
    outcome = outcomes.get(f"register {load}")
    return "" if outcome is None or outcome.record is None else outcome.record.made_utc
