"""One load of a path, from the one before it: its stages, how far it came, and what it takes to go on from there."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from dvc.arrays import FloatArray
from fe.plate import Hold
from fe.plate_path import Goal, Path, PlateState, Standing


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """What it takes to go on from a load, or from somewhere on the way to it.

    Attributes
    ----------
    reached : float
        Share of what the load adds to the one before it, all of it being 1: along the axis, of those that it changes,
        where least is reached.
    stages : int
        Stages of the load that are done; for the first of a path the approach is one.
    curve : tuple of PlateState
        Every equilibrium from that of the load before it to this one.
    iterations : int
        Newton steps since the load before it, those of steps that failed not counted.
    seconds : float
    unknowns : (unknowns,)
        Displacements, along the plate's axes, and pressures.
    hold : Hold
    """

    reached: float
    stages: int
    curve: tuple[PlateState, ...]
    iterations: int
    seconds: float
    unknowns: FloatArray
    hold: Hold


class Leg:
    """A load on its way.

    Parameters
    ----------
    path : Path
        Which stands where the load before it was reached.
    goal : Goal
    before : Goal, optional
        Of the load before it; None for the first, which has to touch.
    earlier : Kept, optional
        Where this load came to in an earlier simulation.
    settled : callable
        Gets what it takes to go on, and the share that is done, at each equilibrium on the way.
    """

    def __init__(
        self, path: Path, goal: Goal, before: Goal | None, earlier: Kept | None, settled: Callable[[Kept, float], None]
    ) -> None:
        self._path, self._goal, self._first = path, goal, before is None
        self._before = path.reached(goal)
        if before is not None:  # what was asked for, not what was reached to the tolerance
            self._before = np.where(goal.travels == before.travels, before.values, self._before)
        self._began, self._counted = time.monotonic() - (earlier.seconds if earlier else 0.0), path.iterations
        self._stages, self._whole = 0, False
        path.solver.forget()  # so that a load depends on where it begins, and not on what was solved before
        path.curve = path.curve[-1:]
        if earlier is not None:
            path.curve = list(earlier.curve)
            path.stand(Standing(earlier.unknowns, earlier.curve[-1], earlier.hold))
            self._stages, self._counted = earlier.stages, path.iterations - earlier.iterations
        path.settled = lambda: settled(self.kept(), float(np.clip(self._shares(), 0.0, 1.0).mean()))

    def go(self) -> bool:
        """Go to the goal, normal first and then shear; whether it is there."""
        path, goal = self._path, self._goal
        stages: list[Callable[[], bool]] = [partial(path.raise_to, goal)]
        if self._first and goal.sheared:
            stages.insert(0, partial(path.raise_to, goal.unsheared()))
        if self._first:
            stages.insert(0, partial(path.approach, goal))
        for stage in stages[self._stages :]:
            if not stage():
                return False
            self._stages += 1
        self._whole = True
        return True

    def kept(self) -> Kept:
        """Where it is now."""
        path = self._path
        return Kept(
            1.0 if self._whole else max(0.0, float(self._shares().min(initial=1.0))),
            self._stages,
            tuple(path.curve),
            path.iterations - self._counted,
            time.monotonic() - self._began,
            path.state,
            path.contact.hold,
        )

    def _shares(self) -> FloatArray:
        """Of each of the plate's axes along which the load adds something, the share of it that is reached."""
        way = self._goal.values - self._before
        adds = way != 0.0
        if not adds.any():
            return np.ones(1)
        return np.asarray((self._path.reached(self._goal) - self._before)[adds] / way[adds])
