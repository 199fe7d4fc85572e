"""Strokes on the unloaded image, read from the file of any program."""

from dataclasses import replace
from pathlib import Path

from dvc import LabelMap, read_labels
from dvc.errors import InputError, few
from dvc.report.strokes import MARKED


def read_marks(path: Path, names: Path | None) -> LabelMap:
    """Marks with the names of a table, of the file itself, or the usual ones of their numbers."""
    marks = read_labels(path, names)
    if names is None and all(name == f"label-{number}" for number, name in marks.names.items()):
        if unknown := [number for number in marks.names if number not in MARKED]:
            usual = ", ".join(f"{number} {name}" for number, name in MARKED.items())
            raise InputError(
                f"{path}: the strokes {few(unknown)} have no name. Give a table of names as mark_names (--mark-names), "
                f"or use the usual numbers: {usual}."
            )
        return replace(marks, names={number: MARKED[number] for number in marks.names})
    return marks
