"""Stretch-stress curves of mechanical tests, read from CSV files."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray
from dvc.errors import InputError
from fe.materials import MODES

_STRESS = {
    "nominal_stress_kpa": (1e-3, False),
    "nominal_stress_mpa": (1.0, False),
    "true_stress_kpa": (1e-3, True),
    "true_stress_mpa": (1.0, True),
}


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A test of an incompressible solid.

    Attributes
    ----------
    mode : str
        One of `fe.materials.MODES`: uniaxial, equibiaxial, pure shear.
    stretch : (n,)
        Length over undeformed length along the loading axis; below 1 in compression.
    stress_mpa : (n,)
        Force over undeformed area, MPa; below 0 in compression.
    """

    mode: str
    stretch: FloatArray
    stress_mpa: FloatArray


def read_curves(path: Path | str, mode: str | None = None) -> list[Curve]:
    """Curves of a CSV file, one for each kind of test.

    Columns: ``stretch``; one of ``nominal_stress_kpa``, ``nominal_stress_mpa``, ``true_stress_kpa``,
    ``true_stress_mpa`` (nominal: force over undeformed area; true: over deformed); and ``test``, a name of
    `fe.materials.MODES`, unless ``mode`` gives it for the whole file. In other columns nothing is read.

    Raises
    ------
    InputError
        If the file cannot be read, a column is missing or ambiguous, or a value is no number; with its line.
    """
    try:
        with Path(path).open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file)
            rows = list(reader)
            columns = [c.strip().lower() for c in reader.fieldnames or []]
    except (OSError, UnicodeDecodeError, csv.Error) as failure:
        raise InputError(f"Cannot read the curve {path}: {failure}.") from failure
    stress = [c for c in columns if c in _STRESS]
    if len(columns) == 1 and ";" in columns[0]:
        raise InputError(f"{path}: columns are divided by semicolons; write it with commas (and points in numbers).")
    if "stretch" not in columns or len(stress) != 1:
        raise InputError(
            f"{path}: a curve needs a column 'stretch' and one of {', '.join(_STRESS)}, so that unit and kind of "
            f"stress are said (stretch = 1 + strain); its columns are {', '.join(columns) or 'none'}."
        )
    mode = None if mode is None else mode.strip().lower()
    if mode is None and "test" not in columns:
        raise InputError(f"{path}: say which test it is: {', '.join(MODES)} (--test, or a column 'test').")
    scale, true = _STRESS[stress[0]]
    tests: dict[str, list[tuple[float, float]]] = {}
    for line, row in enumerate(rows, start=2):
        cells = {(k or "").strip().lower(): (v or "").strip() for k, v in row.items() if not isinstance(v, list)}
        try:
            stretch, value = float(cells["stretch"]), scale * float(cells[stress[0]])
        except ValueError as failure:
            raise InputError(f"{path}, line {line}: {failure}.") from failure
        if not (np.isfinite([stretch, value]).all() and stretch > 0.0):
            raise InputError(f"{path}, line {line}: a stretch is positive, and both numbers finite; got {cells}.")
        name = mode or cells["test"].lower()
        if name not in MODES:
            raise InputError(f"{path}, line {line}: no test '{name}'; there are {', '.join(MODES)}.")
        tests.setdefault(name, []).append((stretch, value / stretch if true else value))
    if not tests:
        raise InputError(f"{path}: no row under the header.")
    return [Curve(name, *np.array(points).T) for name, points in tests.items()]
