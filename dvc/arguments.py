"""What is passed to a front door: refused by its name where it is of another kind than is needed."""

from os import PathLike
from pathlib import Path
from types import UnionType

import numpy as np

from dvc.errors import InputError


def expect(name: str, value: object, kind: type | UnionType, wanted: str) -> None:
    """InputError unless `value` is of a kind: the argument's `name`, what is `wanted`, and what was passed."""
    if not isinstance(value, kind):
        shown = repr(value) if isinstance(value, str | PathLike | int | float | None) else type(value).__name__
        shape = f" of shape {value.shape}" if isinstance(value, np.ndarray) else ""
        raise InputError(f"{name} must be {wanted}; got {shown}{shape}.")


def path_of(path: str | PathLike[str]) -> Path:
    """The argument `path` as a path; InputError for anything else, such as an array or what was read from a file."""
    expect("path", path, str | PathLike, "the path of a file or folder (str or pathlib.Path)")
    return Path(path)
