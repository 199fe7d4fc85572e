"""The error of a study's measurement against a known strain, in its report: for folders of the demonstration."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from dvc.atomic_files import write_whole
from dvc.report.page import Section, Table
from mrstrain.studies.file import Study
from mrstrain.studies.pipeline import Outcome
from phantoms import TissueError

TABLE = "error.csv"
_MADE = "registered_utc"
_FIGURES = ("true_p50", "true_p95", "shear_rmse", "shear_bias", "u_p50_mm", "u_p95_mm")
_KINDS: Mapping[str, Callable[[str], Any]] = {"str": str, "int": int, "float": float}
_COLUMNS = (
    "load",
    "tissue",
    "true shear, median",
    "true shear, p95",
    "RMSE",
    "bias",
    "u error, median",
    "u error, p95",
)


def write_errors(path: Path, errors: Mapping[str, Sequence[TissueError]], outcomes: Mapping[str, Outcome]) -> None:
    """Write each load's error by tissue as a table, with the time at which its registration was made."""
    table = io.StringIO()
    writer = csv.DictWriter(table, ["load", _MADE, *(f.name for f in fields(TissueError))], lineterminator="\n")
    writer.writeheader()
    for load, of in errors.items():
        writer.writerows({"load": load, _MADE: _made(outcomes, load)} | asdict(error) for error in of)
    write_whole(path, table.getvalue())


def read_errors(path: Path, outcomes: Mapping[str, Outcome]) -> dict[str, tuple[TissueError, ...]]:
    """What `write_errors` wrote of the loads whose registration is still the one that it was told of."""
    errors: dict[str, tuple[TissueError, ...]] = {}
    for row in _rows(path):
        if row[_MADE] and row[_MADE] == _made(outcomes, row["load"]):
            told = {field.name: _KINDS[str(field.type)](row[field.name]) for field in fields(TissueError)}
            errors[row["load"]] = (*errors.get(row["load"], ()), TissueError(**told))
    return errors


def _rows(path: Path) -> list[dict[str, str]]:
    """The rows of such a table; none of a file of somebody's own."""
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return rows if rows and {"load", _MADE, *(f.name for f in fields(TissueError))} <= set(rows[0]) else []


def error_against_truth(study: Study, outcomes: Mapping[str, Outcome]) -> list[Section]:
    """The section of a study whose folder has such a table; none of any other.

    The rows are those of registrations that are still there; of one that was made anew the error is not known.
    """
    rows = _rows(study.place / TABLE)
    if not rows:
        return []
    known = [row for row in rows if row[_MADE] and row[_MADE] == _made(outcomes, row["load"])]
    old = dict.fromkeys(row["load"] for row in rows if row not in known)
    note = "Displacement in mm. The calcaneus and the ankle's bones are rigid: their true shear is zero."
    if old:
        note += f" Registered anew since, and not known: {', '.join(old)}; `mrstrain demo` tells it."
    table = Table(
        "Maximal shear and displacement, by load and tissue",
        _COLUMNS,
        tuple((row["load"], row["tissue"], *(float(row[key]) for key in _FIGURES)) for row in known),
        note,
    )
    told = (
        "These images are a phantom: the strain is known at every point, so the measurement below can be compared "
        "with the truth, wherever it has a result. Real images have no such table; the verdict, the intervals and "
        "the repeat scan stand in for it. The phantom's tissue flows as a motion prescribes and knows no forces: "
        "no material set is the true one."
    )
    return [Section("Error against the truth", None, (table,), (), (told,))]


def _made(outcomes: Mapping[str, Outcome], load: str) -> str:
    """When a load was registered; empty where it has no result."""
    outcome = outcomes.get(f"register {load}")
    return "" if outcome is None or outcome.record is None else outcome.record.made_utc
