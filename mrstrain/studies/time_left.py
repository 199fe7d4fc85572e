"""How long a run still takes: what its stages are expected to take, corrected by how long the others took."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

_TRUST_S = 20.0  # of the expectation: it counts as if so many seconds of stages had ended just as expected
_OVERDUE = 0.25  # of the time that a stage has taken already, where it should have ended


@dataclass(frozen=True, slots=True)
class Expected:
    """What a stage is expected to take: seconds while it runs, the cores that it keeps busy, and what it waits for."""

    seconds: float
    cores: int = 1
    before: tuple[str, ...] = ()

    def after(self, prefix: str) -> Self:
        """The same, waiting for stages whose names begin with a prefix."""
        return replace(self, before=tuple(prefix + name for name in self.before))


def seconds_to_end(stages: Mapping[str, Expected], left: Mapping[str, float] | None = None) -> dict[str, float]:
    """Seconds from the start of each stage to the end of the longest row of stages that wait for one another.

    No number of cores makes less of it, and a study ends soonest if the stage with most of it is started first. Stages
    are in an order in which each stands after those that it waits for; those that are ``left`` count, with their own
    seconds.
    """
    seconds = {name: one.seconds for name, one in stages.items()} if left is None else left
    to_end: dict[str, float] = {}
    for name in reversed(list(stages)):
        if name in seconds:
            waiting = (to_end[other] for other in to_end if name in stages[other].before)
            to_end[name] = seconds[name] + max(waiting, default=0.0)
    return to_end


@dataclass(slots=True)
class TimeLeft:
    """Time until the last of some stages ends, on so many workers.

    All stages are expected to be as much faster or slower than expected as those that have ended were.
    """

    stages: Mapping[str, Expected]  # in an order in which each stands after those that it waits for
    workers: int
    began: dict[str, float] = field(default_factory=dict)
    took: dict[str, float] = field(default_factory=dict)

    def begin(self, name: str) -> None:
        """Note that a stage has begun; again if it was begun anew."""
        self.began.setdefault(name, time.monotonic())

    def end(self, name: str) -> None:
        """Note that a stage has ended, or will never begin."""
        now = time.monotonic()
        self.took[name] = now - self.began.setdefault(name, now)

    @property
    def under_way(self) -> list[str]:
        """The stages that have begun and not ended."""
        return [name for name in self.began if name not in self.took]

    def seconds(self) -> float:
        """The time left, seconds."""
        now = time.monotonic()
        spent = {name: now - self.began[name] for name in self.under_way}
        pace = self._pace(spent)
        left = {
            name: max(pace * one.seconds - spent.get(name, 0.0), _OVERDUE * spent.get(name, 0.0))
            for name, one in self.stages.items()
            if name not in self.took
        }
        workers = max(self.workers, len(spent))  # a cluster may have more
        work = sum(seconds * min(self.stages[name].cores, workers) for name, seconds in left.items())
        return max([work / workers, *seconds_to_end(self.stages, left).values()])

    def _pace(self, spent: Mapping[str, float]) -> float:
        """Time that stages take over what they were expected to; one under way counts once it takes longer."""
        ended = {name: taken for name, taken in self.took.items() if taken > 0.0}
        taken = _TRUST_S + sum(ended.values())
        expected = _TRUST_S + sum(self.stages[name].seconds for name in ended)
        for name, so_far in spent.items():
            if so_far * expected > self.stages[name].seconds * taken:
                taken += so_far
                expected += self.stages[name].seconds
        return taken / expected
