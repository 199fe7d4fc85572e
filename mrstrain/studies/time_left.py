"""How long a run still takes: what its stages are expected to take, corrected by how long the others took."""

import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

_TRUST_S = 15.0  # the expectation counts as if so many seconds of stages had ended just as expected
_ALIKE_S = 80.0  # the pace of all kinds counts as if so many seconds of stages of one kind had ended at that pace
_OVERDUE = 0.25  # of the time that a stage has taken already, where it should have ended


@dataclass(frozen=True, slots=True)
class Expected:
    """What a stage is expected to take: seconds while it runs, the cores that it keeps busy, and what it waits for."""

    seconds: float
    cores: int = 1
    before: tuple[str, ...] = ()
    kind: str = ""  # stages of one kind are as much faster or slower than expected as one another

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
class Pace:
    """Time that stages take over what they were expected to, for each kind of stage.

    With t and e the sums of the time taken and expected: of all kinds together p = (T + t) / (T + e), T = 15 s, near 1
    while little has ended; of one kind (A p + t_kind) / (A + e_kind), A = 80 s, near p while little of it has ended. A
    slow machine slows down every kind, but fast registrations hardly promise fast simulations.
    """

    taken: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    expected: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))

    def add(self, stage: Expected, taken: float) -> None:
        """Count a stage, and the seconds that it took."""
        self.taken[stage.kind] += taken
        self.expected[stage.kind] += stage.seconds

    def of(self, stage: Expected) -> float:
        """The pace of the kind of a stage."""
        of_all = (_TRUST_S + sum(self.taken.values())) / (_TRUST_S + sum(self.expected.values()))
        return (_ALIKE_S * of_all + self.taken.get(stage.kind, 0.0)) / (_ALIKE_S + self.expected.get(stage.kind, 0.0))


@dataclass(slots=True)
class TimeLeft:
    """Time until the last of some stages ends, on so many workers, at the pace of those that have ended (`Pace`)."""

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
            name: max(pace.of(one) * one.seconds - spent.get(name, 0.0), _OVERDUE * spent.get(name, 0.0))
            for name, one in self.stages.items()
            if name not in self.took
        }
        workers = max(self.workers, len(spent))  # a cluster may have more
        work = sum(seconds * min(self.stages[name].cores, workers) for name, seconds in left.items())
        return max([work / workers, *seconds_to_end(self.stages, left).values()])

    def _pace(self, spent: Mapping[str, float]) -> Pace:
        """The pace of the stages that have ended; one under way counts as soon as it takes longer, as overdue."""
        pace = Pace()
        for name, taken in self.took.items():
            if taken > 0.0:  # others never began
                pace.add(self.stages[name], taken)
        for name, so_far in spent.items():
            if so_far > pace.of(self.stages[name]) * self.stages[name].seconds:
                pace.add(self.stages[name], (1.0 + _OVERDUE) * so_far)
        return pace
