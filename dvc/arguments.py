"""What is passed to a front door: refused by its name where it is of another kind than its annotation says."""

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, wraps
from numbers import Integral, Real
from os import PathLike
from types import NoneType, SimpleNamespace, UnionType
from typing import Any, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from dvc.errors import InputError
from dvc.file_names import refuse_path

_P = ParamSpec("_P")
_T = TypeVar("_T")

_WANTED = {
    "str": "text (str)",
    "int": "a whole number",
    "float": "a number",
    "Callable": "a function",
    "Criteria": "a validate.Criteria, such as validate.Criteria(strains=(0.2, 0.5))",
    "Deformation": "a deformation, from dvc.read_displacement(file) or dvc.register",
    "ErrorModel": "a dvc.ErrorModel, from dvc.read_error_model(file)",
    "ErrorTable": "a dvc.ErrorTable, one of dvc.read_error_model(file).tables",
    "FeResult": "a validate.FeResult: read_result(name, file) or FeResult.of(name, simulation.deformation(load))",
    "Grid": "a dvc.Grid, such as that of an image (image.grid)",
    "Image": "a dvc.Image, from dvc.read_image(file), or dvc.Image(grid, values) for an array on a dvc.Grid",
    "LabelMap": "a dvc.LabelMap, from dvc.read_labels(file, names), or dvc.LabelMap(grid, labels, {1: 'fat'})",
    "LoadCase": "a validate.LoadCase: LoadCase.of(load, measured, results)",
    "LoadStep": "a fe.LoadStep, such as fe.LoadStep('Load1', normal_n=15.0)",
    "Mask": "a dvc.Mask, from dvc.read_mask(file), or dvc.Mask(grid, inside) for an array on a dvc.Grid",
    "Measurement": "a dvc.Measurement, from dvc.measure",
    "Material": "a material, such as fe.Ogden.from_abaqus(mu_mpa, alpha)",
    "MaterialSet": "a material set, from fe.material_set(name or file)",
    "MeshFile": "a dvc.MeshFile, from dvc.read_mesh(file)",
    "OnMesh": "the deformation of a mesh, from simulation.deformation('Load1') of a fe.Simulation",
    "Plate": "a fe.Plate, such as fe.Plate(normal=(0, 0, -1), shear=(0, -1, 0))",
    "Settings": "a dvc.Settings, such as dvc.Settings(dvc.GaussNewton(), threads=2)",
    "TetMesh": "a TetMesh, from fe.read_tet_mesh(file) or fe.mesh_labels",
}


def checked(function: Callable[_P, _T]) -> Callable[_P, _T]:
    """Refuse arguments that are of another kind than their annotations, by an `InputError` that names each."""
    signature = inspect.signature(function)
    of_arguments = SimpleNamespace(__annotations__={k: v for k, v in function.__annotations__.items() if k != "return"})
    hints = cache(lambda: get_type_hints(of_arguments, function.__globals__))

    @wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _T:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            if name in hints():
                check(name, value, hints()[name])
        return function(*args, **kwargs)

    return call


def check_fields(instance: Any) -> None:
    """Refuse the fields of a dataclass, as `checked` refuses arguments."""
    for name, hint in get_type_hints(type(instance)).items():
        check(name, getattr(instance, name), hint)


def check(name: str, value: object, hint: Any) -> None:
    """InputError where a value is not of the kind of a type hint: its name, what is wanted, and what was passed."""
    if (other := _misfit(name, value, hint)) is not None:
        named, given, wanted = other
        raise InputError(f"{named} must be {_words(wanted)}; got {shown(given)}.")
    if _holds_paths(hint):
        _refuse_paths(value)


def _holds_paths(hint: Any) -> bool:
    """Whether a value of a type hint may be the path of a file, or hold some."""
    hint = _meant(hint)
    kind = get_origin(hint) or hint
    return (isinstance(kind, type) and issubclass(kind, PathLike)) or any(map(_holds_paths, get_args(hint)))


def _refuse_paths(value: object) -> None:
    """InputError for a path that no file can have, among values that may be paths."""
    if isinstance(value, str | PathLike):
        refuse_path(value)
    elif isinstance(value, Mapping):
        _refuse_paths(list(value.values()))
    elif isinstance(value, list | tuple):
        for each in value:
            _refuse_paths(each)


def shown(value: object) -> str:
    """A value for a message: itself if it is short, else its type and shape."""
    if isinstance(value, str | PathLike | int | float | None):
        return repr(value)
    return type(value).__name__ + (f" of shape {value.shape}" if isinstance(value, np.ndarray) else "")


def _misfit(name: str, value: object, hint: Any) -> tuple[str, object, Any] | None:
    """What of a value is not of the kind of a hint; arrays and literal values are left to who takes them."""
    hint = _meant(hint)
    if isinstance(hint, TypeVar):
        kinds = hint.__constraints__ or (hint.__bound__ or object,)
        hint = Union[kinds]  # noqa: UP007 - of a tuple
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (UnionType, Union):
        misfits = [_misfit(name, value, each) for each in inner]
        inside = [each for each in misfits if each is not None and each[1] is not value]
        return None if None in misfits else inside[0] if inside else (name, value, hint)
    kind: Any = {float: Real, int: Integral}.get(hint, origin or hint)
    if kind in (Sequence, tuple, list):  # an array, a set or the keys of a dict will do
        if isinstance(value, str | bytes | Mapping) or not (hasattr(value, "__len__") and hasattr(value, "__iter__")):
            return name, value, hint
        each_of = inner if kind is tuple and Ellipsis not in inner else inner[:1] * len(value)
        if inner and len(value) != len(each_of):
            return name, value, hint
        return _first((f"{name}[{n}]", *pair) for n, pair in enumerate(zip(value, each_of, strict=False)))
    if kind is np.ndarray:
        return (name, value, hint) if isinstance(value, str | PathLike | Mapping) else None
    if not isinstance(kind, type):
        return None
    if not isinstance(value, kind):
        return name, value, hint
    if kind is Mapping and isinstance(value, Mapping) and len(inner) == 2:
        return _first((f"{name}[{key!r}]", each, inner[1]) for key, each in value.items())
    return None


def _first(parts: Iterable[tuple[str, object, Any]]) -> tuple[str, object, Any] | None:
    return next(filter(None, (_misfit(*part) for part in parts)), None)


def _meant(hint: Any) -> Any:
    """What a hint stands for that is an alias, as NDArray is one from NumPy 2.5 on."""
    return getattr(get_origin(hint) or hint, "__value__", hint)


def _words(hint: Any) -> str:
    """What a type hint asks for."""
    hint = _meant(hint)
    origin, inner = get_origin(hint), get_args(hint)
    if origin in (UnionType, Union):
        paths = {each for each in inner if _holds_paths(each)}
        others = [each for each in inner if each is not NoneType and not (paths and each in {*paths, str})]
        return ", or ".join(_words(each) for each in [*others, PathLike][: len(others) + bool(paths)])
    if origin is tuple and inner and Ellipsis not in inner:
        return f"({', '.join(_words(each) for each in inner)})"
    if origin in (Sequence, tuple, list) and inner:
        return f"a list, each item {_words(inner[0])}"
    if origin is np.ndarray:
        return "an array of numbers"
    if hint is PathLike or origin is PathLike:
        return "the path of a file or folder (str or pathlib.Path)"
    if origin is Mapping and len(inner) == 2:
        return f"a dict, each value {_words(inner[1])}"
    name = getattr(origin or hint, "__name__", str(hint))
    return _WANTED.get(name, f"a {getattr(origin or hint, '__module__', '').split('.')[0]}.{name}")
