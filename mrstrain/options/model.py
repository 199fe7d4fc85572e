"""What every model of options can do, and the kinds of values that options have."""

import functools
import numbers
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, ClassVar, Self, TypeVar, Union, get_args, get_origin

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, Strict, ValidationError
from pydantic.fields import FieldInfo

from dvc.file_names import refuse_missing, refuse_path


@dataclass(frozen=True, slots=True)
class Cli:
    """How the command line offers a field, where it differs from the field itself."""

    name: str | None = None  # with its dashes
    help: str | None = None
    panel: str | None = None  # group of the help, in place of its model's
    off: bool = False  # whether the option is a flag that turns the field off
    times: float = 1.0  # factor from the option's unit to the field's


def _of_numpy(kind: type, own: type) -> BeforeValidator:
    """A number of NumPy as Python's own; anything else as it is, for the check that follows."""
    return BeforeValidator(lambda v: own(v) if isinstance(v, kind) and not isinstance(v, bool) else v)


def _once(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(names)) < len(names):
        raise ValueError("each name may occur only once")
    return names


Real = Annotated[float, _of_numpy(numbers.Real, float), Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[Real, Field(gt=0.0)]
NotNegative = Annotated[Real, Field(ge=0.0)]
Count = Annotated[int, _of_numpy(numbers.Integral, int), Strict(), Field(ge=1)]
Flag = Annotated[bool, Strict()]
Vector = Annotated[tuple[Real, Real, Real], BeforeValidator(lambda v: v.tolist() if hasattr(v, "tolist") else v)]
Text = Annotated[str, BeforeValidator(lambda v: fspath(v) if isinstance(v, PathLike) else v)]
Said = Annotated[str | None, AfterValidator(lambda v: (v or "").strip() or None)]
"""What a person says in free words; None if they are empty."""
Names = Annotated[tuple[Text, ...], AfterValidator(_once)]

_M = TypeVar("_M", bound="Options")
_SHORT = 100  # characters: a longer value is told by its type


class Options(BaseModel):
    """One concern's options, checked when they are given; a field's help is the text below it."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)
    panel: ClassVar[str] = "Options"

    @classmethod
    def of(cls, given: Mapping[str, Any], called: Callable[[str], str] = str) -> Self:
        """The options given by name, the others by default.

        ParameterError names each that cannot be used, as it is ``called`` where it was given, and why; InputError a
        path that no file can have.
        """
        try:
            made = cls(**given)
        except ValidationError as wrong:
            from dvc.errors import ParameterError

            raise ParameterError(
                " ".join(f"{called(str(e['loc'][0]))}: {reason(e)}." for e in wrong.errors(include_url=False))
            ) from wrong
        for path in made.paths:
            refuse_path(path)
        return made

    @classmethod
    def option(cls, name: str) -> str:
        """Name of a field on the command line."""
        return cls.cli(name).name or "--" + name.replace("_", "-")

    @classmethod
    def cli(cls, name: str) -> Cli:
        """How the command line offers a field."""
        return next((m for m in cls.model_fields[name].metadata if isinstance(m, Cli)), Cli())

    def located(self, folder: Path) -> Self:
        """The same options with every path relative to a folder."""
        there = {name: tuple(folder / path for path in paths) for name, paths in self.files.items()}
        lone = {name: at[0] for name, at in there.items() if not isinstance(getattr(self, name), tuple)}
        return self.model_copy(update=there | lone)

    @property
    def files(self) -> dict[str, list[Path]]:
        """Fields that are given as paths."""
        each = {name: value if isinstance(value, tuple) else (value,) for name, value in self}
        paths = {name: [one for one in of if isinstance(one, Path)] for name, of in each.items()}
        return {name: of for name, of in paths.items() if of}

    @property
    def paths(self) -> tuple[Path, ...]:
        """All paths among the fields."""
        return tuple(path for paths in self.files.values() for path in paths)

    def refuse_missing(self) -> None:
        """InputError for the first path at which there is nothing."""
        for path in self.paths:
            refuse_missing(path)

    def narrowed(self, model: type[_M]) -> _M:
        """The fields that these options share with another model, one of their bases."""
        return model.model_validate({field: getattr(self, field) for field in model.model_fields})

    def plain(self) -> dict[str, Any]:
        """The fields as values that JSON can hold."""
        return self.model_dump(mode="json")


def reason(error: Mapping[str, Any]) -> str:
    """Why pydantic refuses a value, and the value."""
    if error["type"] == "missing":
        return "a value is required"
    why = error["msg"].removeprefix("Value error, ")
    if error["type"] == "literal_error":
        why = f"must be {error['ctx']['expected'].replace(chr(39), '')}"
    given = repr(error["input"])
    return f"{why}; got {given if len(given) < _SHORT else type(error['input']).__name__}"


def bare(annotation: Any, metadata: list[Any]) -> Any:
    """A type without its Annotated metadata, which is added to ``metadata``."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        for told in inner[1:]:
            metadata += told.metadata if isinstance(told, FieldInfo) else [told]
        return bare(inner[0], metadata)
    if origin in (Union, UnionType):
        return functools.reduce(operator.or_, (bare(one, metadata) for one in inner))
    if origin in (tuple, Sequence, Mapping):
        return origin[tuple(one if one is ... else bare(one, metadata) for one in inner)]
    return annotation
