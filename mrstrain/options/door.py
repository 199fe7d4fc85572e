"""From the flat keywords that a person types to the models that functions take; once, at the door."""

import functools
import inspect
from collections.abc import Callable
from typing import Any, ParamSpec, Protocol, TypeVar, cast, get_type_hints

from mrstrain.options.model import Options, bare

P = ParamSpec("P")
R_co = TypeVar("R_co", covariant=True)


class Door(Protocol[P, R_co]):
    """A function that takes flat keywords; ``with_options`` is the same with the models in their place."""

    @property
    def with_options(self) -> Callable[P, R_co]:
        """The function itself."""

    def __call__(self, *given: Any, **options: Any) -> R_co:
        """Check the flat keywords, and call the function with the models made of them."""


def models_of(function: Callable[..., object]) -> dict[str, type[Options]]:
    """Parameters of a function that are models of options."""
    hints = get_type_hints(function)
    models = {name: kind for name, kind in hints.items() if isinstance(kind, type) and issubclass(kind, Options)}
    models.pop("return", None)
    fields = [field for model in models.values() for field in model.model_fields]
    assert len(set(fields)) == len(fields), f"{function.__name__}: an option belongs to two models"
    return models


def door(function: Callable[P, R_co]) -> Door[P, R_co]:
    """Let a function be called with the fields of its models as flat keywords.

    They stand in its signature, and with their help in its docstring, as if they were written there.
    """
    models = models_of(function)
    helps = [
        f"{field}\n    {' '.join((info.description or '').split())}"
        for model in models.values()
        for field, info in model.model_fields.items()
    ]

    @functools.wraps(function)
    def flat(*given: Any, **options: Any) -> Any:
        made: dict[str, Any] = {
            name: model.of({field: options.pop(field) for field in model.model_fields if field in options})
            for name, model in models.items()
        }
        return function(*given, **options, **made)

    flat.__signature__ = _flat_signature(function, models)  # type: ignore[attr-defined]
    own = inspect.cleandoc(function.__doc__ or "")
    flat.__doc__ = "\n".join([own, "", "Other Parameters", "----------------", *helps, ""])
    flat.with_options = function  # type: ignore[attr-defined]
    return cast(Door[P, R_co], flat)


def _flat_signature(function: Callable[..., object], models: dict[str, type[Options]]) -> inspect.Signature:
    """The signature of a function with the fields of its models in their place, as keywords."""
    signature = inspect.signature(function)
    parameters = []
    for name, own in signature.parameters.items():
        if name not in models:
            parameters.append(own)
            continue
        for field, info in models[name].model_fields.items():
            default, kind = own.empty if info.is_required() else info.default, bare(info.annotation, [])
            parameters.append(inspect.Parameter(field, own.KEYWORD_ONLY, default=default, annotation=kind))
    return signature.replace(parameters=parameters)
