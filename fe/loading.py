"""One load of a load path in progress, and the states from which it can be resumed."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from dvc.arrays import FloatArray
from fe.load_path import LoadPath, PlateState
from fe.plate import ContactStatus
from fe.problem import PlateTarget


@dataclass(frozen=True, slots=True, eq=False)
class Checkpoint:
    """State from which a simulation continues: the end of a load, or a converged increment within it.

    Attributes
    ----------
    reached : float
        Fraction of the change from the previous load that is reached, 1 at the end of the load. If the load changes
        several axes, that of the axis where it is smallest.
    stages : int
        Completed stages of the load; for the first load of a path, the approach of the plate is one.
    curve : tuple of PlateState
        State of the plate at every converged increment, from that of the previous load to this one.
    iterations : int
        Newton iterations since the previous load, without those of failed increments; those of loads that are passed
        count, as they do in ``curve`` and ``seconds``.
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
    """A load in progress, which starts from the end of the previous load of its path.

    ``before`` is the target of the previous load, None for the first load, which starts with the approach. ``earlier``
    is the checkpoint of this load in an earlier solution. ``on_converged`` is called at each converged increment with a
    checkpoint and the fraction done.
    """

    def __init__(
        self, path: LoadPath, target: PlateTarget, before: PlateTarget | None, earlier: Checkpoint | None,
        on_converged: Callable[[Checkpoint, float], None],
    ) -> None:  # fmt: skip
        self._path, self._target, self._first = path, target, before is None
        self._before = path.reached(target)
        if before is not None:  # the target itself, not the values reached within the tolerance
            self._before = np.where(target.displaced == before.displaced, before.values, self._before)
        self._began, self._counted = time.monotonic() - (earlier.seconds if earlier else 0.0), path.iterations
        self._stages, self._complete = 0, False
        path.solver.forget()  # so that a load depends only on its start, not on earlier solutions
        path.assembler.forget()
        path.curve = path.curve[-1:]
        if earlier is not None:
            path.curve = list(earlier.curve)
            path.resume((earlier.unknowns, earlier.curve[-1], earlier.contact))
            self._stages, self._counted = earlier.stages, path.iterations - earlier.iterations
        if before is None:  # from the first touch, whatever it passes
            self._before = np.where(target.displaced, path.curve[0].displacement_mm, path.curve[0].force_n)
        path.on_converged = lambda: on_converged(self.checkpoint(), float(np.clip(self._shares(), 0.0, 1.0).mean()))

    def run(self) -> bool:
        """Load up to the target, normal first, then shear; whether it is reached."""
        path, target = self._path, self._target
        stages = [partial(path.shear, target)]
        if self._first:
            stages = [partial(path.approach, target), partial(path.press, target), *(stages if target.sheared else [])]
        for stage in stages[self._stages :]:
            if not stage():
                return False
            self._stages += 1
        self._complete = True
        return True

    def checkpoint(self) -> Checkpoint:
        """Checkpoint of the current state."""
        path = self._path
        reached = 1.0 if self._complete else max(0.0, float(self._shares().min(initial=1.0)))
        return Checkpoint(
            reached, self._stages, tuple(path.curve), path.iterations - self._counted,
            time.monotonic() - self._began, path.state, path.contact.status,
        )  # fmt: skip

    def _shares(self) -> FloatArray:
        """Fraction reached of the load's change, along each of the plate's axes that it changes."""
        way = self._target.values - self._before
        adds = way != 0.0
        if not adds.any():
            return np.ones(1)
        return np.asarray((self._path.reached(self._target) - self._before)[adds] / way[adds])
