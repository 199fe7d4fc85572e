"""The first part of a study's report: which model fits best, and how large the measured strain is."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dvc.errors import InputError
from dvc.report.page import Section, Table
from validate import NOTHING, Comparison

_NOTE = "Green-Lagrange, (E₁ − E₃)/2, in the unloaded configuration; in brackets the 95 % confidence interval."
_NEAREST = (
    " Nearest model: the one with the smallest area between the curves in that tissue; a dash where no model is nearer "
    "than one without deformation."
)


def answer_of(measured: Sequence[Section], compared: Sequence[Section], folder: Path) -> list[Section]:
    """The first part of a report from the loads' sections, and that of a comparison with its folder, if there is one.

    It has a row for each load and tissue: the measured maximum shear strain, and the nearest model.
    """
    tables = [(section.title, section.summary) for section in measured if section.summary is not None]
    if not tables:
        return list(compared)
    nearest = _nearest(folder) if compared else {}
    model = ("nearest model",) if compared else ()
    rows = [
        (load, *row, *(nearest.get((load, str(row[0])), "–") for _ in model)) for load, of in tables for row in of.rows
    ]
    columns = ("load", *tables[0][1].columns, *model)
    table = Table("Measured maximum shear strain", columns, tuple(rows), _NOTE + _NEAREST * bool(compared))
    first = compared[0] if compared else Section("Measured strain")
    return [replace(first, tables=(table, *first.tables))]


def _nearest(folder: Path) -> dict[tuple[str, str], str]:
    """The model with the smallest area for each load and tissue, if it is smaller than that without deformation."""
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
