"""The first part of the report of a study: the best-matching model, and the measured strain."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dvc.errors import InputError
from dvc.report.page import Picture, Section
from mrstrain.measurement.answer import table_of_loads
from validate import NOTHING, Comparison

_NEAREST = (
    " Best match: smallest area between the strain-volume curves of model and measurement in that tissue. A dash: no "
    "model is better than no deformation."
)


def answer_of(
    measured: Sequence[Section], compared: Sequence[Section], folder: Path, pictures: Sequence[Picture] = ()
) -> list[Section]:
    """The first part of a report, from the sections of the loads, and those and the folder of a comparison, if any.

    Its table has a row for each load and tissue: the measured maximum shear strain, and the best match. Without a
    comparison it has ``pictures`` of the measured strain.
    """
    table = table_of_loads(measured)
    if not compared:
        first = Section("Measured strain", pictures=tuple(pictures), pictures_first=True)
        return [] if table is None else [replace(first, tables=(table,))]
    if table is None:
        return list(compared)
    nearest = _nearest(folder)
    rows = tuple((*row, nearest.get((str(row[0]), str(row[1])), "–")) for row in table.rows)
    columns = (*table.columns, "best match")
    first_table = replace(table, columns=columns, rows=rows, note=table.note + _NEAREST)
    return [replace(compared[0], tables=(first_table, *compared[0].tables))]


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
