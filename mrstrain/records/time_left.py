"""How long a run still takes: what its stages are expected to take, corrected by how long they took so far.

Stages are those of a study, or the parts of a command that may run at the same time, such as the loads of `register`.
"""

import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Self

_TRUST_S = 15.0  # the expectation counts as if so many seconds of stages had ended just as expected
_TRUST = 0.1  # of a command, which may be over sooner: as if this fraction of it had
_ALIKE_S = 80.0  # the pace of all kinds counts as if so many seconds of stages of one kind had ended at that pace
_OVERDUE = 0.25  # of the time that a stage has taken already, where it should have ended
_STARTING_S = 1.5  # of a command, before its stages are known

STARTING = "starting"
"""The stage of a command before its stages are known."""
WRITING = "writing"
"""The part of a stage in which its results are written."""
FAILED = "failed"
"""The last part of a stage that ends by an error."""


@dataclass(frozen=True, slots=True)
class Expected:
    """What a stage is expected to take: seconds while it runs, the cores that it keeps busy, and what it waits for."""

    seconds: float
    cores: int = 1
    before: tuple[str, ...] = ()
    kind: str = ""  # stages of one kind are as much faster or slower than expected as one another
    parts: Mapping[str, float] = field(default_factory=dict)  # seconds of each, in their order, where it has several
    guessed: tuple[str, ...] = ()  # parts that tell no more than how much of what they expect has passed

    @classmethod
    def of(cls, parts: Mapping[str, float], **more: Any) -> Self:
        """What parts of a stage, one after another, are expected to take."""
        return cls(sum(parts.values()), parts=parts, **more)

    def share(self, part: str, fraction: float) -> float:
        """How much of the expected time has passed where a fraction of a part is done; 0 for an unknown part."""
        if part == FAILED:
            return 1.0
        if not self.parts:
            return fraction
        if part not in self.parts:
            return 0.0
        if part in self.guessed:
            fraction = float(fraction >= 1.0)
        before = list(self.parts)[: list(self.parts).index(part)]
        done = sum(self.parts[name] for name in before) + fraction * self.parts[part]
        return done / self.seconds if fraction < 1.0 or part != list(self.parts)[-1] else 1.0

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

    With t and e the sums of the time taken and expected: of all kinds together p = (T + t) / (T + e), T = 15 s (of a
    command: a tenth of what is expected), near 1 while little has ended; of one kind (A p + t_kind) / (A + e_kind),
    A = 80 s (5.3 T), near p while little of it has ended. A slow machine slows down every kind, but fast registrations
    hardly promise fast simulations.
    """

    trust_s: float = _TRUST_S
    taken: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    expected: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))

    def add(self, stage: Expected, taken: float) -> None:
        """Count a stage, and the seconds that it took."""
        self.taken[stage.kind] += taken
        self.expected[stage.kind] += stage.seconds

    def of(self, stage: Expected) -> float:
        """The pace of the kind of a stage."""
        of_all = (self.trust_s + sum(self.taken.values())) / (self.trust_s + sum(self.expected.values()))
        alike_s = self.trust_s * _ALIKE_S / _TRUST_S
        return (alike_s * of_all + self.taken.get(stage.kind, 0.0)) / (alike_s + self.expected.get(stage.kind, 0.0))


@dataclass(slots=True)
class TimeLeft:
    """Time until the last of some stages ends, on so many workers, at the pace of those that have ended (`Pace`)."""

    stages: Mapping[str, Expected]  # in an order in which each stands after those that it waits for
    workers: int
    trust_s: float = _TRUST_S
    began: dict[str, float] = field(default_factory=dict)
    took: dict[str, float] = field(default_factory=dict)
    # Of a stage under way: the share that it has reached, when, and the share at the end of its part.
    reached: dict[str, tuple[float, float, float]] = field(default_factory=dict)

    @classmethod
    def of_command(
        cls, stages: Mapping[str, Expected], workers: int, starting_s: float, reading_s: float = 0.0
    ) -> Self:
        """The time left of a command with such parts, which took so long to start; a busy machine is slow then, too.

        Until then it read its images, too, which is expected to take ``reading_s``.
        """
        trust_s, start = _TRUST * sum(one.seconds for one in stages.values()), Expected(_STARTING_S + reading_s)
        return cls({STARTING: start, **stages}, workers, trust_s, {STARTING: 0.0}, {STARTING: starting_s})

    def begin(self, name: str) -> None:
        """Note that a stage has begun; again if it was begun anew."""
        self.began.setdefault(name, time.monotonic())

    def end(self, name: str) -> None:
        """Note that a stage has ended, or will never begin."""
        now = time.monotonic()
        self.took[name] = now - self.began.setdefault(name, now)

    def told(self, name: str, part: str, fraction: float) -> None:
        """Take the progress of a stage that tells how far it is; others are left out."""
        if name not in self.stages or name in self.took:
            return
        self.begin(name)
        share = self.stages[name].share(part, fraction)
        if share >= 1.0:
            self.end(name)
        elif name not in self.reached or share > self.reached[name][0]:
            self.reached[name] = share, time.monotonic(), self.stages[name].share(part, 1.0)

    @property
    def under_way(self) -> list[str]:
        """The stages that have begun and not ended."""
        return [name for name in self.began if name not in self.took]

    def seconds(self) -> float:
        """The time left, seconds."""
        now = time.monotonic()
        spent = {name: now - self.began[name] for name in self.under_way}
        pace = self._pace(spent)
        left = {}
        for name, one in self.stages.items():
            if name not in self.took:
                share, at, _ = self.reached.get(name, (0.0, self.began.get(name, now), 1.0))
                left[name] = max(pace.of(one) * one.seconds * (1.0 - share) - (now - at), _OVERDUE * (now - at))
        workers = max(self.workers, len(spent))  # a cluster may have more
        work = sum(seconds * min(self.stages[name].cores, workers) for name, seconds in left.items())
        return max([work / workers, *seconds_to_end(self.stages, left).values()])

    def _pace(self, spent: Mapping[str, float]) -> Pace:
        """The pace of what has ended; a stage under way counts as far as it told, or if it is overdue."""
        pace = Pace(self.trust_s)
        for name, taken in self.took.items():
            if taken > 0.0:  # others never began
                pace.add(self.stages[name], taken)
        for name in spent.keys() & self.reached.keys():
            one, (share, at, end) = self.stages[name], self.reached[name]
            overdue = spent[name] - (at - self.began[name]) > pace.of(one) * (end - share) * one.seconds
            taken = at - self.began[name]
            if overdue:  # it may be at the end of its part, but not beyond
                share, taken = end, spent[name] * (1.0 if end < 1.0 else 1.0 + _OVERDUE)
            pace.add(replace(one, seconds=share * one.seconds), taken)
        for name in spent.keys() - self.reached.keys():
            if spent[name] > pace.of(self.stages[name]) * self.stages[name].seconds:
                pace.add(self.stages[name], (1.0 + _OVERDUE) * spent[name])
        return pace
