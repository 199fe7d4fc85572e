"""Loads of a simulation: the published experiment's, those that a user types, and the paths on which they lie."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from dvc.errors import InputError
from fe.simulate import LoadStep

Vector = tuple[float, float, float]

LOADS = (
    LoadStep("Load1", 140.0),
    LoadStep("Load2", 15.0),
    LoadStep("Load3", 15.0, 45.0),
    LoadStep("Load4", 15.0, 12.0),
)
"""The published experiment's."""

_ALIKE: Mapping[str, Hashable] = MappingProxyType({})


def paths_of(loads: Sequence[LoadStep], towards: Mapping[str, Hashable] = _ALIKE) -> list[tuple[LoadStep, ...]]:
    """Loads by path: pressed alike and sheared to the same side, by force or by travel, in the order of the shear.

    A load without shear lies on the path of the first that is pressed like it and sheared. ``towards`` has the loads
    that go in directions of their own; only those of the same directions lie on one path.

    Examples
    --------
    >>> [" ".join(load.name for load in path) for path in paths_of(LOADS)]
    ['Load1', 'Load2 Load4 Load3']
    """
    names = [load.name for load in loads]
    if not names or len(set(names)) < len(names):
        raise InputError(f"Loads are needed, each with a name of its own; got {', '.join(names) or 'none'}.")

    def pressed(load: LoadStep) -> tuple[float, bool, Hashable]:
        return float(load.goal.values[0]), bool(load.goal.travels[0]), towards.get(load.name)

    def key(load: LoadStep) -> tuple[Hashable, ...]:
        like = next((x for x in loads if x.sheared and pressed(x) == pressed(load)), load)
        shear = load if load.sheared else like
        return *pressed(load), bool(shear.goal.travels[1]), bool(shear.goal.values[1] < 0.0)

    return [
        tuple(sorted((x for x in loads if key(x) == one), key=lambda x: (x.sheared, abs(float(x.goal.values[1])))))
        for one in dict.fromkeys(key(load) for load in loads)
    ]


def load_named(text: str) -> LoadStep:
    """A load from NAME=NORMAL or NAME=NORMAL,SHEAR; each a force in N, or, with mm after it, the plate's travel.

    Examples
    --------
    >>> load_named("Load3=15,45").told
    '15 N normal, 45 N shear'
    >>> load_named("Load3=15,8mm").told
    '15 N normal, 8 mm shear'
    """
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
            "A load is NAME=NORMAL or NAME=NORMAL,SHEAR in N, such as Load3=15,45, or the plate's travel in mm, such "
            f"as Load3=15,8mm; got '{text}'."
        ) from failure
    if not name.strip() or not re.fullmatch(r"[\w. -]+", name.strip()):
        raise InputError(f"A load needs a name of letters, digits, dots, blanks or dashes; got '{name}'.")
    return LoadStep(name.strip(), **values)
