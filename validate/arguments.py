"""Arguments of another kind than a function takes, refused before they fail somewhere inside."""

from collections.abc import Collection, Sequence
from pathlib import PurePath
from typing import Any

from dvc.errors import InputError

_MADE_BY = {
    "Criteria": "validate.Criteria(strains=(0.2, 0.5))",
    "Deformation": "dvc.read_displacement(file), the result of dvc.register, or a dvc.Measurement",
    "ErrorTable": "one of dvc.read_error_model(file).tables",
    "FeResult": "validate.read_result(name, file) or validate.FeResult.of(name, simulation.deformation(load))",
    "LabelMap": "dvc.read_labels(file, names)",
    "LoadCase": "validate.LoadCase.of(load, measured, results)",
    "OnMesh": 'simulation.deformation("Load1") of a fe.Simulation',
    "str": "a name",
    "TetMesh": "fe.read_tet_mesh(file)",
    "Callable": "a function without arguments, or use validate.LoadCase.of for fields that are in memory",
}


def check_kind(argument: str, given: object, kind: Any) -> None:
    """Refuse an argument that is no instance of a class, with an `InputError` that says what to pass."""
    if not isinstance(given, kind):
        name = kind.__name__
        raise InputError(f"`{argument}` is a {name}; got {_told(given)}. Pass {_MADE_BY[name]}.")


def check_each(argument: str, given: object, kind: Any) -> None:
    """Refuse an argument that is no collection of instances of a class, as `check_kind`."""
    if isinstance(given, (kind, str)) or not isinstance(given, Collection):
        alone = f"({given!r},)" if kind is str else f"[{argument}]"
        what = alone if isinstance(given, kind) else f"a list, each of {_MADE_BY[kind.__name__]}"
        raise InputError(f"`{argument}` is a sequence of {kind.__name__}; got {_told(given)}. Pass {what}.")
    for number, one in enumerate(given if isinstance(given, Sequence) else ()):
        check_kind(f"{argument}[{number}]", one, kind)


def _told(given: object) -> str:
    return repr(str(given)) if isinstance(given, str | PurePath) else f"an object of class {type(given).__name__}"
