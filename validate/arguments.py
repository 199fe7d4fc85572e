"""Arguments of another kind than a function takes, refused before they fail somewhere inside."""

from collections.abc import MappingView, Set
from typing import Any

import numpy as np

from dvc.arguments import expect

_MANY = list | tuple | Set | MappingView | np.ndarray  # type: ignore[type-arg]
_WANTED = {
    "Callable": "a function without arguments (validate.LoadCase.of takes fields that are in memory)",
    "Criteria": "a Criteria, such as validate.Criteria(strains=(0.2, 0.5))",
    "Deformation": "a deformation, as dvc.read_displacement(file) and dvc.register give it, or a dvc.Measurement",
    "ErrorTable": "an ErrorTable, one of dvc.read_error_model(file).tables",
    "FeResult": "a FeResult: validate.read_result(name, file) or .FeResult.of(name, simulation.deformation(load))",
    "LabelMap": "a LabelMap, as dvc.read_labels(file, names) gives it",
    "LoadCase": "a LoadCase: validate.LoadCase.of(load, measured, results)",
    "OnMesh": 'the deformation of a mesh, as simulation.deformation("Load1") of a fe.Simulation',
    "TetMesh": "a TetMesh, as fe.read_tet_mesh(file) gives it",
    "str": "a name",
}


def check_kind(argument: str, given: object, kind: Any) -> None:
    """Refuse an argument that is no instance of a class, with an `InputError` that says what to pass."""
    expect(argument, given, kind, _WANTED[kind.__name__])


def check_each(argument: str, given: Any, kind: Any) -> None:
    """Refuse an argument that is no list or the like of instances of a class, as `check_kind`."""
    expect(argument, given, _MANY, f"a list, with each {_WANTED[kind.__name__]}")
    for number, one in enumerate(given):
        check_kind(f"{argument}[{number}]", one, kind)
