"""Landmark pairs: the same anatomical points marked by hand in the unloaded and the loaded image."""

import csv
import logging
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from dvc.arrays import FloatArray
from dvc.deformation.protocol import Deformation
from dvc.errors import ImageFileError, InputError, few
from dvc.own_files import parse_json
from dvc.tables import read_table, read_text, refuse_half_a_line

_log = logging.getLogger(__name__)

_COLUMNS = ("x0", "y0", "z0", "x1", "y1", "z1")
_TO_LPS = {"LPS": np.array([1.0, 1.0, 1.0]), "RAS": np.array([-1.0, -1.0, 1.0])}
_FCSV_FRAMES = {"LPS": "LPS", "RAS": "RAS", "1": "LPS", "0": "RAS"}  # Slicer before 4.11 wrote a number

_Path = str | os.PathLike[str]
_Points = list[tuple[str, FloatArray]]


def read_landmarks(
    path: _Path | tuple[_Path, _Path], *, frame: str = "LPS"
) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    """Read pairs of points, unloaded and loaded.

    Parameters
    ----------
    path : path, or a pair of paths
        A CSV file with the columns x0, y0, z0 (unloaded image), x1, y1, z1 (loaded image), in mm, and optionally
        name; or two point lists of 3D Slicer (.mrk.json or .fcsv), unloaded first. If both lists have the same names,
        each once, points are paired by name; if they have no name in common, in the order listed (logged); otherwise
        they are refused.
    frame : {"LPS", "RAS"}
        Frame of the coordinates in the CSV file. Slicer files state their own.

    Returns
    -------
    reference_mm, deformed_mm : (n, 3)
        The points in the unloaded and in the loaded image, each in its own image's frame, LPS mm.
    names : tuple of str
        Their names, or their numbers from 1.

    Raises
    ------
    InputError
        If the frame or the kind of file is not one of those above, a file cannot be read as text, a row of the table is
        incomplete, or two point lists do not match.
    ImageFileError
        If a file is damaged, a column or number is missing, or its frame or unit is not known.
    """
    if frame not in _TO_LPS:
        raise InputError(f"The frame of landmarks must be LPS or RAS; got {frame!r}.")
    if isinstance(path, tuple):
        return _paired(Path(path[0]), Path(path[1]))
    file = Path(path)
    if file.suffix.lower() != ".csv":
        raise InputError(
            f"{file}: landmark pairs are read from one CSV file, or from two point lists of Slicer (.mrk.json, "
            ".fcsv): first that of the unloaded image, then that of the loaded one."
        )
    pairs, names = [], []
    header, rows = read_table(file)
    if missing := [name for name in _COLUMNS if name not in header]:
        raise ImageFileError(
            f"{file}: the column {missing[0]} is missing. The first line must name the columns "
            f"{', '.join(_COLUMNS)}; it has: {few(header) or 'nothing'}."
        )
    for count, (line, cells) in enumerate(rows, start=1):
        row = dict(zip(header, cells, strict=True))
        pairs.append([_number(f"{file}, line {line}", name, row[name]) for name in _COLUMNS])
        names.append(row.get("name") or str(count))
    if not pairs:
        raise ImageFileError(f"{file}: no landmarks below the header line.")
    reference, deformed = np.split(np.array(pairs), 2, axis=1)
    return reference * _TO_LPS[frame], deformed * _TO_LPS[frame], tuple(names)


def target_registration_error(
    deformation: Deformation, reference_mm: FloatArray, deformed_mm: FloatArray
) -> FloatArray:
    """Distance between the registered and the observed position of each landmark, |X + u(X) - x|.

    Parameters
    ----------
    deformation : Deformation
        The whole motion from the unloaded to the loaded image, bone motion included, because the landmarks x are in
        the loaded image as scanned.
    reference_mm, deformed_mm : (n, 3)
        Landmarks X in the unloaded and x in the loaded image, LPS mm.

    Returns
    -------
    (n,)
        mm; NaN where the deformation is not defined. Report their number, because a mean over the other landmarks alone
        is too optimistic.

    Raises
    ------
    InputError
        If the two arrays do not have the same shape (n, 3).

    Examples
    --------
    >>> from dvc.deformation.protocol import Affine
    >>> shift = Affine(np.eye(3), np.array([3.0, 0.0, 0.0]))
    >>> target_registration_error(shift, np.zeros((1, 3)), np.array([[0.0, 4.0, 0.0]])).tolist()
    [5.0]
    """
    X, x = np.asarray(reference_mm, dtype=np.float64), np.asarray(deformed_mm, dtype=np.float64)
    if X.shape != x.shape or X.ndim != 2 or X.shape[1] != 3:
        raise InputError(f"Landmarks must be two arrays (n, 3) of equal length; got {X.shape} and {x.shape}.")
    return np.asarray(np.linalg.norm(X + deformation.displacement(X) - x, axis=1))


def _paired(first: Path, second: Path) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
    reference, deformed = _slicer_points(first), _slicer_points(second)
    names, others = [name for name, _ in reference], [name for name, _ in deformed]
    if sorted(names) == sorted(others) and len(set(names)) == len(names):
        deformed = [(name, dict(deformed)[name]) for name in names]
    elif len(names) != len(others) or set(names) & set(others):
        only = sorted(set(names) ^ set(others))
        repeated = sorted({name for some in (names, others) for name in some if some.count(name) > 1})
        odd = f"only in one file: {few(only, most=3) or 'none'}; repeated: {few(repeated, most=3) or 'none'}"
        raise InputError(
            f"The point names in {first} ({len(names)} points) and {second} ({len(others)} points) do not match one "
            f"to one ({odd}). Use the same names in both lists, each once."
        )
    else:
        _log.warning("%s and %s have no point name in common; points are paired in the order listed.", first, second)
    return np.stack([X for _, X in reference]), np.stack([x for _, x in deformed]), tuple(names)


def _slicer_points(path: Path) -> _Points:
    read = {".json": _from_markups, ".fcsv": _from_fcsv}.get(path.suffix.lower())
    if read is None:
        raise InputError(f"{path}: not a Slicer point list; its name must end in .mrk.json or .fcsv.")
    if not (points := read(path)):
        raise ImageFileError(f"{path}: the list has no points.")
    return points


def _from_markups(path: Path) -> _Points:
    try:
        (markup,) = parse_json(read_text(path))["markups"]
        frame, unit = str(markup["coordinateSystem"]), markup.get("coordinateUnits", "mm")
        listed: list[dict[str, Any]] = list(markup["controlPoints"])
    except (ValueError, KeyError, TypeError) as error:
        what = f"is not a Slicer file with one point list ({type(error).__name__}: {error})"
        raise ImageFileError(f"{path} {what}.") from error
    if frame not in _TO_LPS or unit not in ("mm", ["mm", "UCUM"]):
        raise ImageFileError(f"{path}: coordinates must be in mm, LPS or RAS; the file gives {frame}, {unit}.")
    points: _Points = []
    for count, point in enumerate(listed, start=1):
        name, position = str(point.get("label") or count), point.get("position")
        if point.get("positionStatus", "defined") != "defined":
            raise ImageFileError(f"{path}: point {name!r} was never placed. Place or delete it in Slicer.")
        if not isinstance(position, list) or len(position) != 3:
            raise ImageFileError(f"{path}: point {name!r} has no position.")
        at = [_number(f"{path}, point {name!r}", "position", x) for x in position]
        points.append((name, np.array(at) * _TO_LPS[frame]))
    return points


def _from_fcsv(path: Path) -> _Points:
    lines = [(line, text) for line, text in enumerate(read_text(path).splitlines(), start=1) if text.strip()]
    head = [text.removeprefix("#").partition("=") for _, text in lines if text.startswith("#")]
    header = {key.strip(): value.strip() for key, _, value in head}
    frame = _FCSV_FRAMES.get(header.get("CoordinateSystem", ""))
    columns = [name.strip() for name in header.get("columns", "").split(",")]
    points: _Points = []
    for line, text in (each for each in lines if not each[1].startswith("#")):
        if frame is None or not {"x", "y", "z"} <= set(columns):
            what = "the header lacks the frame (CoordinateSystem = LPS or RAS) or the columns"
            raise ImageFileError(f"{path}: {what}. Save the list again in Slicer.")
        cells = next(csv.reader([text]), [])
        if len(cells) < len(columns):
            count = f"{len(cells)} of {len(columns)} columns"
            raise ImageFileError(f"{path}, line {line}: the row has {count}. Save the list again in Slicer.")
        row = dict(zip(columns, cells, strict=False))
        position = np.array([_number(f"{path}, line {line}", axis, row.get(axis)) for axis in "xyz"])
        points.append((row.get("label") or str(len(points) + 1), position * _TO_LPS[frame]))
    refuse_half_a_line(path)
    return points


def _number(where: str, name: str, value: object) -> float:
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ImageFileError(f"{where}: {name} must be a finite number in mm; got {value!r}.")
    return number
