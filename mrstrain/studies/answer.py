"""The first part of the report of a study: the best-matching model, and the measured strain."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dvc.errors import InputError
from dvc.report.page import Section, Table
from validate import NOTHING, Comparison

_NOTE = "Green-Lagrange, (E₁ − E₃)/2, in the unloaded configuration, with its interval of 95 % coverage in brackets."
_NEAREST = (
    " Best match: smallest area between the strain-volume curves of model and measurement in that tissue. A dash: no "
    "model is better than zero strain everywhere."
)


def answer_of(measured: Sequence[Section], compared: Sequence[Section], folder: Path) -> list[Section]:
    """The first part of a report, from the sections of the loads, and those and the folder of a comparison, if any.

    Its table has a row for each load and tissue: the measured maximum shear strain, and the best match.
    """
    tables = [(section.title, section.summary) for section in measured if section.summary is not None]
    if not tables:
        return list(compared)
    nearest = _nearest(folder) if compared else {}
    model = ("best match",) if compared else ()
    rows = [
        (load, *row, *(nearest.get((load, str(row[0])), "–") for _ in model)) for load, of in tables for row in of.rows
    ]
    columns = ("load", *tables[0][1].columns, *model)
    table = Table("Measured maximum shear strain", columns, tuple(rows), _NOTE + _NEAREST * bool(compared))
    first = compared[0] if compared else Section("Measured strain")
    return [replace(first, tables=(table, *first.tables))]


def _nearest(folder: Path) -> dict[tuple[str, str], str]:
    """The model with the smallest area for each load and tissue, if it is below that of a model without deformation."""
    try:
        areas = [area for area in Comparison.read(folder).areas if not area.levelled]
    except InputError:
        return {}
    found: dict[tuple[str, str], str] = {}
    for key in dict.fromkeys((area.load, area.tissue) for area in areas):
        of = {area.model: area.best_ml for area in areas if (area.load, area.tissue) == key}
        best = min(of, key=lambda name: (of[name], name != NOTHING))
        if best != NOTHING:
            found[key] = best
    return found
