"""One load of a path, from the one before it: its stages, how far it came, and what it takes to resume from there."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from dvc.arrays import FloatArray
from fe.load_path import Increment, LoadPath, PlateState
from fe.load_step import PlateTarget
from fe.plate import ContactStatus


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """What it takes to go on from the end of a load, or from a converged increment on the way to it.

    Attributes
    ----------
    reached : float
        Share of what the load adds to the one before it, all of it being 1: along the axis, of those that it changes,
        where least is reached.
    stages : int
        Stages of the load that are done; for the first of a path the approach is one.
    curve : tuple of PlateState
        The plate at every converged increment from that of the load before it to this one.
    iterations : int
        Newton steps since the load before it, those of increments that failed not counted.
    unknowns : (unknowns,)
        Displacements, along the plate's axes, and pressures.
    """

    reached: float
    stages: int
    curve: tuple[PlateState, ...]
    iterations: int
    seconds: float
    unknowns: FloatArray
    contact: ContactStatus


class Loading:
    """A load in progress on a path that is where the load before it ended.

    ``before`` is that load's target, None for the first, which has to touch; ``earlier`` is where this load came to in
    an earlier solution. ``on_converged`` gets a checkpoint and the share that is done, at each converged increment.
    """

    def __init__(
        self, path: LoadPath, target: PlateTarget, before: PlateTarget | None, earlier: Checkpoint | None,
        on_converged: Callable[[Checkpoint, float], None],
    ) -> None:  # fmt: skip
        self._path, self._target, self._first = path, target, before is None
        self._before = path.reached(target)
        if before is not None:  # what was asked for, not what was reached to the tolerance
            self._before = np.where(target.displaced == before.displaced, before.values, self._before)
        self._began, self._counted = time.monotonic() - (earlier.seconds if earlier else 0.0), path.iterations
        self._stages, self._complete = 0, False
        path.solver.forget()  # so that a load depends on where it begins, and not on what was solved before
        path.curve = path.curve[-1:]
        if earlier is not None:
            path.curve = list(earlier.curve)
            path.resume(Increment(earlier.unknowns, earlier.curve[-1], earlier.contact))
            self._stages, self._counted = earlier.stages, path.iterations - earlier.iterations
        path.on_converged = lambda: on_converged(self.checkpoint(), float(np.clip(self._shares(), 0.0, 1.0).mean()))

    def run(self) -> bool:
        """Go to the target, normal first and then shear; whether it is reached."""
        path, target = self._path, self._target
        stages: list[Callable[[], bool]] = [partial(path.raise_to, target)]
        if self._first and target.sheared:
            stages.insert(0, partial(path.raise_to, target.unsheared()))
        if self._first:
            stages.insert(0, partial(path.approach, target))
        for stage in stages[self._stages :]:
            if not stage():
                return False
            self._stages += 1
        self._complete = True
        return True

    def checkpoint(self) -> Checkpoint:
        """Where it is now."""
        path = self._path
        reached = 1.0 if self._complete else max(0.0, float(self._shares().min(initial=1.0)))
        return Checkpoint(
            reached, self._stages, tuple(path.curve), path.iterations - self._counted,
            time.monotonic() - self._began, path.state, path.contact.status,
        )  # fmt: skip

    def _shares(self) -> FloatArray:
        """Share reached of what the load adds, along each of the plate's axes where it adds something."""
        way = self._target.values - self._before
        adds = way != 0.0
        if not adds.any():
            return np.ones(1)
        return np.asarray((self._path.reached(self._target) - self._before)[adds] / way[adds])
