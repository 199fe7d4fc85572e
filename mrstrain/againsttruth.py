"""The error of a study's measurement against a known strain, in its report: for folders of the demonstration."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path

from dvc.report import Section, Table
from dvc.whole import write_whole
from mrstrain.pipeline import Outcome
from mrstrain.studyfile import Study
from phantoms.score import TissueError

TABLE = "error.csv"
_MADE = "registered_utc"
_FIGURES = ("true_p50", "true_p95", "shear_rmse", "shear_bias", "u_p50_mm", "u_p95_mm")
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


def error_against_truth(study: Study, outcomes: Mapping[str, Outcome]) -> list[Section]:
    """The section of a study whose folder has such a table; none of any other.

    The rows are those of registrations that are still there; of one that was made anew the error is not known.
    """
    path = study.place / TABLE
    if not path.is_file():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    if not rows or not {"load", "tissue", _MADE, *_FIGURES} <= set(rows[0]):
        return []  # a file of somebody's own
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
