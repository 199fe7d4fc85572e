"""Error of a study's measurement against the known strain of a phantom: table and section of the report."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import get_type_hints

from dvc.atomic_files import write_csv
from dvc.report.page import Section, Table
from mrstrain.studies.file import Study
from mrstrain.studies.pipeline import StageOutcome
from phantoms import TissueError

TABLE = "error.csv"
_MADE = "registered_utc"
_HEADER = ("load", _MADE, *(f.name for f in fields(TissueError)))
_FIGURES = ("true_p50", "true_p95", "shear_rmse", "shear_bias", "u_p50_mm", "u_p95_mm")
_COLUMNS = ("load", "tissue", "true max. shear, median", "p95", "RMSE", "bias", "u error, median", "u error, p95")


def write_errors(path: Path, errors: Mapping[str, Sequence[TissueError]], outcomes: Mapping[str, StageOutcome]) -> None:
    """Write the error of each load by tissue, with the time at which its registration was made."""
    rows = [(load, _made(outcomes, load), *map(str, astuple(one))) for load, of in errors.items() for one in of]
    write_csv(path, _HEADER, rows)


def read_errors(path: Path, outcomes: Mapping[str, StageOutcome]) -> dict[str, tuple[TissueError, ...]]:
    """Errors that `write_errors` wrote, for the loads whose registration has not been made again since."""
    errors: dict[str, tuple[TissueError, ...]] = {}
    for row in _rows(path):
        if row[_MADE] and row[_MADE] == _made(outcomes, row["load"]):
            values = {name: kind(row[name]) for name, kind in get_type_hints(TissueError).items()}
            errors[row["load"]] = (*errors.get(row["load"], ()), TissueError(**values))
    return errors


def _rows(path: Path) -> list[dict[str, str]]:
    """Rows of such a table; none for any other file."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return rows if rows and set(_HEADER) <= set(rows[0]) else []


def error_against_truth(study: Study, outcomes: Mapping[str, StageOutcome]) -> list[Section]:
    """Section of the report on the error table in the study's folder; none without one.

    Loads whose registration was made again since are left out, because their error is not known.
    """
    rows = _rows(study.place / TABLE)
    if not rows:
        return []
    known = read_errors(study.place / TABLE, outcomes)
    figures = tuple(
        (load, one.tissue, *(getattr(one, key) for key in _FIGURES)) for load, of in known.items() for one in of
    )
    note = "Displacement in mm. The calcaneus and the ankle bones are rigid, so their true shear is zero."
    if old := dict.fromkeys(row["load"] for row in rows if row["load"] not in known):
        note += f" Registered again since, so not known: {', '.join(old)}; run `mrstrain demo` to compute it."
    table = Table("Error of max. shear and displacement, by load and tissue", _COLUMNS, figures, note)
    text = (
        "These images show a phantom whose strain is known at every point, so the measurement below can be compared "
        "with the truth. Real images have no such table: rely on the verdict, the intervals and the repeat scan. The "
        "phantom deforms by a prescribed motion, without forces, so no material set is the true one."
    )
    return [Section("Error against the truth", None, (table,), (), (text,))]


def _made(outcomes: Mapping[str, StageOutcome], load: str) -> str:
    """When a load was registered; empty where it has no result."""
    outcome = outcomes.get(f"register {load}")
    return "" if outcome is None or outcome.record is None else outcome.record.made_utc
