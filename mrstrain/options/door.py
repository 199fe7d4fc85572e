"""From the flat keywords that a person types to the models that functions take; once, at the door."""

import functools
import inspect
import re
import textwrap
from collections.abc import Callable
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, Protocol, TypeVar, Union, cast, get_args, get_origin, get_type_hints

from dvc.arguments import checked
from mrstrain.options.model import Options, bare

P = ParamSpec("P")
R_co = TypeVar("R_co", covariant=True)
_Models = dict[str, type[Options]]


class Door(Protocol[P, R_co]):
    """A function that takes flat keywords; ``with_options`` is the same with the models in their place."""

    @property
    def with_options(self) -> Callable[P, R_co]:
        """The function itself."""

    def __call__(self, *given: Any, **options: Any) -> R_co:
        """Check the flat keywords, and call the function with the models made of them."""


def models_of(function: Callable[..., object]) -> _Models:
    """Parameters of a function that are models of options."""
    hints = get_type_hints(function)
    models = {name: kind for name, kind in hints.items() if isinstance(kind, type) and issubclass(kind, Options)}
    models.pop("return", None)
    fields = [field for model in models.values() for field in model.model_fields]
    assert len(set(fields)) == len(fields), f"{function.__name__}: an option belongs to two models"
    return models


def door(function: Callable[P, R_co]) -> Door[P, R_co]:
    """Let a function be called with the fields of its models as flat keywords.

    They stand in its signature, and with type, default and help in its docstring, as if they were written there.
    """
    models, refusing = models_of(function), checked(function)

    @functools.wraps(function)
    def flat(*given: Any, **options: Any) -> Any:
        made: dict[str, Any] = {
            name: model.of({field: options.pop(field) for field in model.model_fields if field in options})
            for name, model in models.items()
        }
        return refusing(*given, **options, **made)

    flat.__signature__ = _flat_signature(function, models)  # type: ignore[attr-defined]
    flat.__doc__ = _flat_docstring(inspect.cleandoc(function.__doc__ or ""), models)
    flat.with_options = function  # type: ignore[attr-defined]
    return cast(Door[P, R_co], flat)


def _flat_signature(function: Callable[..., object], models: _Models) -> inspect.Signature:
    """The signature of a function with the fields of its models in their place, as keywords of plain types."""
    signature = inspect.signature(function)
    parameters = []
    for name, own in signature.parameters.items():
        if name not in models:
            parameters.append(own.replace(annotation=bare(own.annotation, [])))
            continue
        for field, info in models[name].model_fields.items():
            kind = bare(info.annotation, [])
            parameters.append(inspect.Parameter(field, own.KEYWORD_ONLY, default=info.default, annotation=kind))
    return signature.replace(parameters=parameters)


def _flat_docstring(own: str, models: _Models) -> str:
    """A numpydoc docstring in which models are called by their fields, which are listed before what is raised."""

    def called(entry: re.Match[str]) -> str:
        return ", ".join(
            one for name in entry[0].split(", ") for one in getattr(models.get(name), "model_fields", [name])
        )

    flags = {model.option(field): field for model in models.values() for field in model.model_fields}
    entries = []
    for model in models.values():
        for field, info in model.model_fields.items():
            usual = ", optional" if info.default is None else f", default {info.default!r}"
            told = re.sub(r"--[a-z-]+", lambda flag: f"`{flags.get(flag[0], flag[0])}`", info.description or "")
            entries.append(f"{field} : {_kind(bare(info.annotation, []))}{usual}")
            entries += textwrap.wrap(told, 116, initial_indent="    ", subsequent_indent="    ")
    own = re.sub(r"^\w+(, \w+)*$", called, own, flags=re.MULTILINE)
    head, raises, tail = own.partition("\n\nRaises\n")
    return "\n".join([head, "", "Other Parameters", "----------------", *entries]) + raises + tail


def _kind(kind: Any) -> str:
    """A type as numpydoc writes it."""
    origin, inner = get_origin(kind), get_args(kind)
    if origin is Literal:
        return f"{{{', '.join(map(repr, inner))}}}"
    if origin in (Union, UnionType):
        return " or ".join(_kind(one) for one in inner if one is not NoneType)
    if origin is tuple:
        return f"sequence of {_kind(inner[0])}" if ... in inner else f"({len(inner)},) {_kind(inner[0])}"
    return f"({', '.join(kind._fields)})" if issubclass(kind, tuple) else str(kind.__name__)
