"""Results as quantities: every array, column and number in the files of a folder, by the file's name and its own."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import meshio
import nibabel
import numpy as np

Quantity = np.ndarray  # of numbers, or of words
_OF_THE_RUN = ("command", "made_utc", "versions", "machine", "inputs", "parameters", "seconds")
"""Keys of a JSON file that tell when, where and from what it was made: another run has others."""
_GIVEN = ("provenance.json", "error_model.json")  # what went in, and the error model that comes with the package
_HIDDEN = ".study"


def quantities(folder: Path) -> dict[str, Quantity]:
    """Everything in images, meshes, tables and JSON files; provenance, prose, pages and pictures are left out.

    So is the table beside a picture of its name: it holds what the picture shows of the maps and tables that are kept.
    """
    found: dict[str, Quantity] = {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        shown = path.suffix == ".csv" and path.with_suffix(".pdf").is_file()
        if path.name in _GIVEN or name.startswith(_HIDDEN) or shown:
            continue
        for end, read in _READERS.items():
            if name.endswith(end):
                found |= {f"{name}: {what}": value for what, value in read(path)}
    return found


def _image(path: Path) -> Iterator[tuple[str, Quantity]]:
    image = nibabel.load(path)
    yield "voxels", np.asarray(image.dataobj)
    yield "affine", np.asarray(image.affine)


def _mesh(path: Path) -> Iterator[tuple[str, Quantity]]:
    mesh = meshio.read(path)
    yield "points", mesh.points
    for kind in mesh.cells_dict:
        yield kind, mesh.cells_dict[kind]
    for name, values in mesh.point_data.items():
        yield f"{name} at points", values
    for name, blocks in mesh.cell_data.items():
        yield f"{name} in cells", np.concatenate(blocks)


def _table(path: Path) -> Iterator[tuple[str, Quantity]]:
    with path.open(encoding="utf-8") as file:
        head, *rows = list(csv.reader(file))
    for number, name in enumerate(head):
        column = [row[number] for row in rows]
        yield name, _numbers(column)


def _numbers(column: list[str]) -> Quantity:
    """As numbers, empty ones as NaN, where every word is one."""
    try:
        return np.array([float(word or "nan") for word in column])
    except ValueError:
        return np.array(column)


def _json(path: Path) -> Iterator[tuple[str, Quantity]]:
    yield from _leaves(json.loads(path.read_text(encoding="utf-8")), ())


def _leaves(told: Any, at: tuple[str, ...]) -> Iterator[tuple[str, Quantity]]:
    """Numbers, lists of them and single words, by the way to them; sentences may be put otherwise and are left out."""
    if isinstance(told, Mapping):
        for key, value in told.items():
            if key not in _OF_THE_RUN:
                yield from _leaves(value, (*at, key))
    elif isinstance(told, list) and not _numeric(told):
        yield " ".join((*at, "count")), np.array(len(told))
        for number, value in enumerate(told):
            yield from _leaves(value, (*at, str(number)))
    elif isinstance(told, list | float | int) or (isinstance(told, str) and " " not in told):
        yield " ".join(at), np.array(told)


def _numeric(told: list[Any]) -> bool:
    try:
        return np.asarray(told).dtype.kind in "biuf"
    except ValueError:  # rows of several lengths
        return False


_READERS: Mapping[str, Callable[[Path], Iterator[tuple[str, Quantity]]]] = {
    ".nii.gz": _image,
    ".vtu": _mesh,
    ".csv": _table,
    ".json": _json,
}
