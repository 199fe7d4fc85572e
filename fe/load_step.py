"""Loads: what is asked of the plate, and which loads are reached one from the other."""

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Self

import numpy as np

from dvc.arrays import BoolArray, FloatArray
from dvc.errors import InputError


@dataclass(frozen=True, slots=True, eq=False)
class PlateTarget:
    """What the plate is to reach along each of its three axes: a force, or a displacement."""

    values: FloatArray  # (3,) forces in N, displacements from the plate's start in mm
    displaced: BoolArray  # (3,) axes along which a displacement is prescribed

    @property
    def sheared(self) -> bool:
        """Whether it asks for a force or a displacement across the normal."""
        return bool(self.values[1:].any() or self.displaced[1:].any())

    def unsheared(self) -> Self:
        """The same along the normal, without a force across it."""
        return replace(self, values=self.values * [1.0, 0.0, 0.0], displaced=self.displaced & [True, False, False])


@dataclass(frozen=True, slots=True)
class LoadStep:
    """A load, reached from the one before it: a force or a plate displacement along the normal, and one across it.

    Attributes
    ----------
    normal_n, shear_n : float, optional
        Force of the plate on the tissue along the normal force's and the shear's direction, N.
    normal_mm, shear_mm : float, optional
        In its place, the plate's displacement from its start, mm.

    Raises
    ------
    InputError
        Unless exactly one of the two is given along the normal, and at most one along the shear.
    """

    name: str
    normal_n: float | None = None
    shear_n: float | None = None
    normal_mm: float | None = None
    shear_mm: float | None = None

    def __post_init__(self) -> None:
        if (self.normal_n is None) == (self.normal_mm is None):
            raise InputError(f"{self.name}: give either the normal force or the plate's displacement along it.")
        if self.shear_n is not None and self.shear_mm is not None:
            raise InputError(f"{self.name}: give either the shear force or the plate's displacement along it.")

    @property
    def sheared(self) -> bool:
        """Whether it asks for a shear, as force or as displacement."""
        return self.target.sheared

    @property
    def target(self) -> PlateTarget:
        """What it asks of the plate along its three axes."""
        asked = [(self.normal_n, self.normal_mm), (self.shear_n, self.shear_mm), (0.0, None)]
        return PlateTarget(
            np.array([force or 0.0 if moved is None else moved for force, moved in asked]),
            np.array([moved is not None for _, moved in asked]),
        )

    def __str__(self) -> str:
        """The load in words, such as "15 N normal, 8 mm shear"."""
        target = self.target
        normal, shear, _ = (
            f"{value:g} {'mm' if moved else 'N'}" for value, moved in zip(target.values, target.displaced, strict=True)
        )
        return f"{normal} normal, {shear} shear"


def paths_of(
    loads: Sequence[LoadStep], directions: Mapping[str, Hashable] = MappingProxyType({})
) -> list[tuple[LoadStep, ...]]:
    """Loads by path: pressed alike and sheared to the same side, by force or by displacement, in the order of shear.

    A load without shear lies on the path of the first that is pressed like it and sheared. ``directions`` holds those
    of loads that have their own; only loads of the same directions lie on one path.

    Raises
    ------
    InputError
        If there is no load, or two have the same name.

    Examples
    --------
    >>> loads = [LoadStep("Load1", 140.0), LoadStep("Load3", 15.0, 45.0), LoadStep("Load2", 15.0)]
    >>> [" ".join(load.name for load in path) for path in paths_of(loads)]
    ['Load1', 'Load2 Load3']
    """
    names = [load.name for load in loads]
    if not names or len(set(names)) < len(names):
        raise InputError(f"Loads are needed, each with a name of its own; got {', '.join(names) or 'none'}.")

    def pressed(load: LoadStep) -> tuple[float, bool, Hashable]:
        return float(load.target.values[0]), bool(load.target.displaced[0]), directions.get(load.name)

    def key(load: LoadStep) -> tuple[Hashable, ...]:
        like = next((x for x in loads if x.sheared and pressed(x) == pressed(load)), load)
        shear = load if load.sheared else like
        return *pressed(load), bool(shear.target.displaced[1]), bool(shear.target.values[1] < 0.0)

    return [
        tuple(sorted((x for x in loads if key(x) == one), key=lambda x: (x.sheared, abs(float(x.target.values[1])))))
        for one in dict.fromkeys(key(load) for load in loads)
    ]
