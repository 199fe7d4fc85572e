"""The text form of elastix parameter and transform files."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from dvc.errors import ParameterError

Parameters = Mapping[str, tuple[str, ...]]
Value = str | float | int | bool

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_BAD_NAME = re.compile(r"[.,:;!@#$%^&'()*+|<>?\"\s]")


def parse_parameters(text: str) -> dict[str, tuple[str, ...]]:
    """Parameters of an elastix parameter or transform file, all values as text.

    One per line, ``(Name value "text value" ...)``; what follows ``//`` is a comment, even inside quotes, as elastix
    has it. A line that elastix would not take is refused with its number.
    """
    parameters: dict[str, tuple[str, ...]] = {}
    for number, text_line in enumerate(text.split("\n"), start=1):
        line = text_line.split("//", maxsplit=1)[0].replace("\t", " ").strip()
        if not line:
            continue
        shown = line if len(line) < 80 else line[:77] + "..."
        if not line.isprintable():
            raise ParameterError(
                f"line {number}: {shown!r} has characters that are no text. Copy or write the file again."
            )
        if not (line.startswith("(") and line.endswith(")")):
            raise ParameterError(f"line {number}: '{shown}' is not in brackets; write (Name value ...).")
        pieces = line[1:-1].split('"')
        if len(pieces) % 2 == 0:
            raise ParameterError(f"line {number}: '{shown}' has an odd number of quotes.")
        name, *values = pieces[0].split() or [""]
        for position, piece in enumerate(pieces[1:], start=1):
            values += [piece] if position % 2 and piece else [] if position % 2 else piece.split()
        if not name or _BAD_NAME.search(name) or (not values and len(pieces) == 1):
            raise ParameterError(f"line {number}: '{shown}' is not a parameter name with one or more values.")
        if name in parameters:
            raise ParameterError(f"line {number}: the parameter {name} is given more than once.")
        parameters[name] = tuple(values)
    return parameters


def format_parameters(parameters: Mapping[str, Sequence[Value]]) -> str:
    """Text of an elastix parameter or transform file: numbers with all digits, all else in quotes.

    >>> print(format_parameters({"Spacing": [0.1, 2], "UseDirectionCosines": [True]}), end="")
    (Spacing 0.1 2)
    (UseDirectionCosines "true")
    """
    # A spline has 100,000 numbers: plain ones are written without a call for each.
    return "".join(
        f"({name} {' '.join(repr(v) if type(v) is float else _formatted(name, v) for v in values)})\n"
        for name, values in parameters.items()
    )


def _formatted(name: str, value: Value) -> str:
    if isinstance(value, bool | np.bool_):
        return '"true"' if value else '"false"'
    if not isinstance(value, str):
        return repr(int(value)) if isinstance(value, int | np.integer) else repr(float(value))
    if _NUMBER.fullmatch(value):
        return value
    if '"' in value or "\n" in value or "//" in value:
        raise ParameterError(f"{name}: elastix files do not allow the text {value!r} (quote, line break or //).")
    return f'"{value}"'
