"""Loads of a simulation: the published experiment's, those that a user types, and the paths on which they lie."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from dvc.errors import InputError
from fe.simulate import LoadStep

LOADS = (
    LoadStep("Load1", 140.0),
    LoadStep("Load2", 15.0),
    LoadStep("Load3", 15.0, 45.0),
    LoadStep("Load4", 15.0, 12.0),
)
"""The published experiment's."""


def paths_of(loads: Sequence[LoadStep]) -> list[tuple[LoadStep, ...]]:
    """Loads by path: those of one normal force, and of shear to the same side, in the order of their shear.

    Examples
    --------
    >>> [" ".join(load.name for load in path) for path in paths_of(LOADS)]
    ['Load1', 'Load2 Load4 Load3']
    """
    names = [load.name for load in loads]
    if not names or len(set(names)) < len(names):
        raise InputError(f"Loads are needed, each with a name of its own; got {', '.join(names) or 'none'}.")
    both = {load.normal_n for load in loads if load.shear_n > 0.0} & {x.normal_n for x in loads if x.shear_n < 0.0}

    def path(load: LoadStep) -> tuple[float, bool]:
        return load.normal_n, load.shear_n < 0.0 and load.normal_n in both

    return [
        tuple(sorted((x for x in loads if path(x) == key), key=lambda x: abs(x.shear_n)))
        for key in dict.fromkeys(path(load) for load in loads)
    ]


def load_named(text: str) -> LoadStep:
    """A load from NAME=NORMAL or NAME=NORMAL,SHEAR, in N.

    Examples
    --------
    >>> load_named("Load3=15,45")
    LoadStep(name='Load3', normal_n=15.0, shear_n=45.0)
    """
    name, _, forces = text.partition("=")
    try:
        normal, shear = (float(v) for v in (forces if "," in forces else forces + ",0").split(","))
        if not np.isfinite([normal, shear]).all():
            raise ValueError("not finite")
    except ValueError as failure:
        raise InputError(
            f"A load is NAME=NORMAL or NAME=NORMAL,SHEAR in N, such as Load3=15,45; got '{text}'."
        ) from failure
    if not name.strip() or not re.fullmatch(r"[\w. -]+", name.strip()):
        raise InputError(f"A load needs a name of letters, digits, dots, blanks or dashes; got '{name}'.")
    return LoadStep(name.strip(), normal, shear)
