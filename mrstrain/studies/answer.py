"""The first part of the report of a study: the best-matching model, and the measured strain."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dvc.errors import InputError
from dvc.report.page import Picture, Section, Table
from mrstrain.measurement.answer import table_of_loads
from validate import NOTHING, Comparison
from validate.best_model import percentiles_beside
from validate.curves import range_told
from validate.load_comparison import STRAINED
from validate.ranking import CLOSER

_AREAS = "Areas of all models and loads"
_PREDICTED = (
    " {model} against measured: 95th percentiles in the compared cells, which may be part of a tissue, with the bias "
    "of the measurement removed. Too high, too low: the difference exceeds twice the known standard uncertainty (2 "
    "u_val). Dash: not compared, or no uncertainty is known."
)
_NEAREST = (
    " Best match: the model with the smallest area between its strain-volume curve and the measured one ({range}) in "
    "that tissue. In all soft tissue, over- and underestimates of single tissues cancel, so another model may be best. "
    "In brackets: models that may be as good, since their 95 % intervals overlap with that of the best match or are "
    "not known; this is no significance test. None: no model has an area at least 5 % smaller than no deformation. "
    "Dash: less than 1 % of the tissue exceeds {low:g}, so its areas are not informative."
)


def answer_of(
    measured: Sequence[Section], compared: Sequence[Section], comparison: Comparison | None,
    pictures: Sequence[Picture] = (),
) -> list[Section]:  # fmt: skip
    """The first part of a report, from the sections of the loads, and those and the files of a comparison, if any.

    Its table has a row for each load and tissue: the measured maximum shear strain, the 95th percentile that the best
    match over all loads predicts, and the best match in this tissue. Without a comparison it has ``pictures`` of the
    measured strain; with one, its areas are folded.
    """
    table = table_of_loads(measured)
    if not compared:
        if table is None:
            return []
        return [Section("Measured strain", None, (table,), tuple(pictures), pictures_first=True)]
    if table is None:
        return list(compared)
    if comparison is not None:
        table = _with_models(table, comparison)
    first = replace(compared[0], tables=(table,))
    areas = [Section(_AREAS, None, compared[0].tables, folded=True)] if compared[0].tables else []
    return [first, *areas]


def _with_models(table: Table, comparison: Comparison) -> Table:
    """The table of the measured strain, with the best match in each tissue, and what the best over all loads predicts.

    The latter needs the measurement uncertainty.
    """
    nearest, columns = _nearest(comparison), ["best match"]
    best, known = comparison.best, comparison.banner is not None
    predicted = percentiles_beside(comparison.errors, best) if known else {}
    note = table.note + _NEAREST.format(low=comparison.strains[0], range=range_told(comparison.strains))
    if predicted:
        columns = [f"{best} against measured, 95th percentile", *columns]
        note = table.note + _PREDICTED.format(model=best) + note.removeprefix(table.note)
    rows = []
    for row in table.rows:
        where = str(row[0]), str(row[1])
        of_model = (predicted.get(where, "–"),) if predicted else ()
        rows.append((*row, *of_model, nearest.get(where, "–")))
    return replace(table, columns=(*table.columns, *columns), rows=tuple(rows), note=note)


def comparison_in(folder: Path) -> Comparison | None:
    """The comparison in a folder; None if there is none that can be read."""
    try:
        return Comparison.read(folder)
    except InputError:
        return None


def _nearest(comparison: Comparison) -> Mapping[tuple[str, str], str]:
    """For each load and tissue that is strained: the model with the smallest area, and those that may be as good."""
    found: dict[tuple[str, str], str] = {}
    for curve in comparison.curves:
        if curve.field != "measured" or curve.load in comparison.ranking.uninformative:
            continue
        above, whole = np.interp([comparison.strains[0], 0.0], curve.max_shear, curve.volume_above_ml)
        if above < STRAINED * whole:
            continue
        areas = [a for a in comparison.areas if (a.load, a.tissue) == (curve.load, curve.tissue) and not a.levelled]
        limit = CLOSER * next((a.best_ml for a in areas if a.model == NOTHING), np.inf)
        better = sorted((a for a in areas if a.best_ml < limit), key=lambda a: a.best_ml)
        near = [other.model for other in better[1:] if not other.low_ml > better[0].high_ml]  # or not known
        best = better[0].model if better else "none"
        found[curve.load, curve.tissue] = f"{best} ({', '.join(near)})" if near else best
    return found
