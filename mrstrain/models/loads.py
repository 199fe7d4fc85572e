"""Loads of a simulation: the published experiment's, and those that a user types."""

import re
from collections.abc import Sequence

import numpy as np

from dvc.errors import InputError
from fe import LoadStep

LOADS = (
    LoadStep("Load1", 140.0),
    LoadStep("Load2", 15.0),
    LoadStep("Load3", 15.0, 45.0),
    LoadStep("Load4", 15.0, 12.0),
)
"""The published experiment's."""


def load_named(text: str) -> LoadStep:
    """A load from NAME=NORMAL or NAME=NORMAL,SHEAR: forces in N or, with mm after them, the plate's displacements."""
    name, _, asked = text.partition("=")
    found = [re.fullmatch(r"\s*([^\s]+?)\s*(mm|N)?\s*", part) for part in asked.split(",")]
    try:
        values = {
            f"{axis}_{'mm' if match[2] == 'mm' else 'n'}": float(match[1])
            for axis, match in zip(("normal", "shear"), found, strict=False)
            if match
        }
        if len(values) < len(found) or not np.isfinite(list(values.values())).all():
            raise ValueError("not finite numbers")
    except ValueError as failure:
        raise InputError(
            "A load is NAME=NORMAL or NAME=NORMAL,SHEAR in N, such as Load3=15,45, or the plate's displacement in mm, "
            f"such as Load3=15,8mm; got '{text}'."
        ) from failure
    if not name.strip() or not re.fullmatch(r"[\w. -]+", name.strip()):
        raise InputError(f"A load needs a name of letters, digits, dots, blanks or dashes; got '{name}'.")
    return LoadStep(name.strip(), **values)


def loads_named(texts: Sequence[str] | None) -> Sequence[LoadStep]:
    """The loads that a person types, as `load_named` reads each; the published experiment's where none is typed."""
    return [load_named(text) for text in texts] if texts else LOADS
