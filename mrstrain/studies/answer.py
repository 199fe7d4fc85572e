"""The first part of the report of a study: the best-matching model, and the measured strain."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dvc.errors import InputError
from dvc.report.page import Picture, Section
from mrstrain.measurement.answer import most_strained, table_of_loads
from validate import NOTHING, Comparison

_NEAREST = (
    " Best match: smallest area between the strain-volume curves of model and measurement in that tissue alone; the "
    "sentences above judge all soft tissue together. In brackets: models whose intervals overlap with its interval. "
    "A dash: no model is better than no deformation, or hardly any tissue is strained."
)


def answer_of(
    measured: Sequence[Section], compared: Sequence[Section], folder: Path, pictures: Sequence[Picture] = ()
) -> list[Section]:
    """The first part of a report, from the sections of the loads, and those and the folder of a comparison, if any.

    It begins with the most strained tissue. Its table has a row for each load and tissue: the measured maximum shear
    strain, and the best match. Without a comparison it has ``pictures`` of the measured strain.
    """
    table = table_of_loads(measured)
    if not compared:
        if table is None:
            return []
        return [Section("Measured strain", None, (table,), tuple(pictures), most_strained(table), pictures_first=True)]
    if table is None:
        return list(compared)
    nearest = _nearest(folder)
    rows = tuple((*row, nearest.get((str(row[0]), str(row[1])), "–")) for row in table.rows)
    columns = (*table.columns, "best match")
    first_table = replace(table, columns=columns, rows=rows, note=table.note + _NEAREST)
    words = (*most_strained(table), *compared[0].paragraphs)
    return [replace(compared[0], tables=(first_table, *compared[0].tables), paragraphs=words)]


def _nearest(folder: Path) -> dict[tuple[str, str], str]:
    """The model with the smallest area for each informative load and tissue, and those that may be as good.

    None if its area is not below that of a model without deformation.
    """
    try:
        comparison = Comparison.read(folder)
    except InputError:
        return {}
    areas = [a for a in comparison.areas if not a.levelled and a.load not in comparison.ranking.uninformative]
    found: dict[tuple[str, str], str] = {}
    for key in dict.fromkeys((area.load, area.tissue) for area in areas):
        best, *others = sorted(
            (area for area in areas if (area.load, area.tissue) == key), key=lambda a: (a.best_ml, a.model != NOTHING)
        )
        if best.model != NOTHING:
            near = [other.model for other in others if other.model != NOTHING and other.low_ml <= best.high_ml]
            found[key] = f"{best.model} ({', '.join(near)})" if near else best.model
    return found
