"""Runs the stages of a study: what is finished is not done again, what fails leaves the others to finish."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from dvc.errors import MrstrainError
from mrstrain.studies.ledger import Ledger, Record
from mrstrain.studies.plan import Stage
from mrstrain.studies.stages import Given

if TYPE_CHECKING:
    from mrstrain.studies.cluster import Cluster

Tell = Callable[[str], None]

_OUT_OF_DATE = "Made from other inputs than the study names now."


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a stage ended.

    Attributes
    ----------
    stage : str
    record : Record or None
        What it made; None where it has no result.
    reason : str
        Why it has none, or is no result of what the study says now.
    again : bool
        Whether it was there already.
    asked : bool
        Whether it was among those that might be run.
    """

    stage: str
    record: Record | None
    reason: str = ""
    again: bool = False
    asked: bool = True

    @property
    def left_out(self) -> bool:
        """Whether it has no result for the reason alone that it was not asked for."""
        return not self.asked and self.words == "not run"

    @property
    def whole(self) -> bool:
        """Whether there is a result, complete, and of what the study says now."""
        return self.record is not None and self.record.given.complete and not self.reason

    @property
    def words(self) -> str:
        """In a word or two, for a table."""
        if self.record is None:
            return "not run" if self.reason.startswith("Not run") else "FAILED"
        if self.reason:
            return "OUT OF DATE"
        return "in part" if not self.record.given.complete else "there already" if self.again else "done"


class Pipeline:
    """The stages of one study and their outcomes.

    Parameters
    ----------
    stages : sequence of Stage
        Each behind those that it waits for.
    ledger : Ledger
    only : sequence of str
        Names or kinds of stages that may be run; all where empty. Others are taken as they are.
    force : sequence of str
        Names or kinds of stages that are made anew.
    """

    def __init__(
        self, stages: Sequence[Stage], ledger: Ledger, *, only: Sequence[str] = (), force: Sequence[str] = ()
    ) -> None:
        self.stages, self.ledger = tuple(stages), ledger
        self._only, self._force = tuple(only), tuple(force)
        self.outcomes: dict[str, Outcome] = {}
        self._keys: dict[str, tuple[str, Mapping[str, Any]]] = {}
        self._waiting = {stage.name: stage for stage in stages}

    def in_order(self) -> dict[str, Outcome]:
        """Outcomes in the order of the stages."""
        return {stage.name: self.outcomes[stage.name] for stage in self.stages}

    @property
    def names(self) -> tuple[str, ...]:
        """Of its stages."""
        return tuple(stage.name for stage in self.stages)

    def settle(self) -> list[tuple[Stage, Mapping[str, Any]]]:
        """Take every stage as far as it goes without work; return those that have to be run now, with arguments."""
        ready = []
        moved = True
        while moved:
            moved = False
            for stage in list(self._waiting.values()):
                if any(name not in self.outcomes for name in stage.before):
                    continue
                del self._waiting[stage.name]
                moved = True
                try:
                    work = self._settled(stage)
                except (OSError, MrstrainError) as failure:  # an input that is gone, or may not be read
                    reason = self.ledger.impersonal(str(failure), stage)
                    self.outcomes[stage.name] = Outcome(stage.name, None, reason, asked=self._asked(stage))
                    continue
                if work is not None:
                    ready.append((stage, work))
        return ready

    def _settled(self, stage: Stage) -> Mapping[str, Any] | None:
        """Give the arguments of a stage that has to be run now; None for one whose outcome is known."""
        there = {name for name, outcome in self.outcomes.items() if outcome.record is not None}
        lacking, asked = _lacking(stage, there), self._asked(stage)
        if lacking:
            self.outcomes[stage.name] = Outcome(stage.name, None, f"Not run: {lacking}", asked=asked)
            return None
        arguments = self._arguments(stage)
        made_from = self.ledger.made_from(stage, arguments)
        built_on = {name: r for name in stage.before if (r := self.outcomes[name].record) is not None}
        key = self.ledger.key(stage, made_from, built_on)
        kept = self.ledger.finished(stage)
        same = kept is not None and kept.key == key
        if not asked:
            reason = self._why_not(stage) if kept is None else self._built_on_old(stage) if same else _OUT_OF_DATE
            self.outcomes[stage.name] = Outcome(stage.name, kept, reason, again=True, asked=False)
        elif kept is not None and same and not kept.given.retry and not _among(stage, self._force, default=False):
            self.outcomes[stage.name] = Outcome(stage.name, kept, self._built_on_old(stage), again=True)
        else:
            self._keys[stage.name] = key, made_from
            return arguments
        return None

    def _asked(self, stage: Stage) -> bool:
        return _among(stage, self._only, default=True)

    def _built_on_old(self, stage: Stage) -> str:
        """Which results that it reads are out of date, so that it is too; empty where none is."""
        old = [name for name in stage.before if self.outcomes[name].words == "OUT OF DATE"]
        return f"Built on {', '.join(old)}, out of date." if old else ""

    def _why_not(self, stage: Stage) -> str:
        return self.ledger.reason(stage) or "Not run: it has no result, and is not among those asked for."

    def forecast(self) -> dict[str, str]:
        """What a run would do with each stage, without doing it.

        "done already", "run", "left out", or "cannot be run" and what for.
        """
        told: dict[str, str] = {}
        kept = {stage.name: self.ledger.finished(stage) for stage in self.stages}
        there: set[str] = set()
        for stage in self.stages:
            anew = any(told[name] == "run" for name in stage.before)
            record = kept[stage.name]
            lacking = _lacking(stage, there)
            if lacking:
                told[stage.name] = f"cannot be run: {lacking}" if self._asked(stage) else "left out"
                continue
            if not self._asked(stage):
                told[stage.name] = "left out"
            elif anew or record is None or _among(stage, self._force, default=False):
                told[stage.name] = "run"
            else:
                some = {
                    argument: [value for name, value in of.items() if name in there]
                    for argument, of in {**stage.some, **stage.perhaps}.items()
                }
                built_on = {name: r for name in stage.before if name in there and (r := kept[name]) is not None}
                made_from = self.ledger.made_from(stage, {**stage.arguments, **some})
                same = record.key == self.ledger.key(stage, made_from, built_on) and not record.given.retry
                told[stage.name] = "done already" if same else "run"
            if record is not None or told[stage.name] == "run":
                there.add(stage.name)
        return told

    def to_do(self) -> list[Stage]:
        """The stages that a run would work on."""
        forecast = self.forecast()
        return [stage for stage in self.stages if forecast[stage.name] == "run"]

    def _arguments(self, stage: Stage) -> Mapping[str, Any]:
        there = {
            argument: [value for name, value in of.items() if self.outcomes[name].record is not None]
            for argument, of in {**stage.some, **stage.perhaps}.items()
        }
        return {**stage.arguments, **there}

    def start(self, cluster: Callable[[], Cluster], tell: Tell, prefix: str = "") -> None:
        """Settle what can be, tell it, and hand what has to be run to the cluster."""
        before = set(self.outcomes)
        ready = self.settle()
        for name, outcome in self.outcomes.items():
            if name not in before:
                tell(f"{name}: {outcome.words}" + (f". {outcome.reason}" if outcome.reason else ""))
        for stage, arguments in ready:
            try:
                if stage.goes_on and not _among(stage, self._force, default=False):
                    self.ledger.forget(stage)
                else:
                    self.ledger.remove(stage)
                for place in stage.gives:
                    place.parent.mkdir(parents=True, exist_ok=True)
            except (OSError, MrstrainError) as failure:
                self.end(stage.name, str(failure), 0.0, tell)
                continue
            cluster().begin(prefix + stage.name, stage.kind, arguments, self.ledger.lock(stage))

    def end(self, name: str, outcome: Given | str, seconds: float, tell: Tell) -> None:
        """Record how a stage ended that was handed to the cluster."""
        stage = next(stage for stage in self.stages if stage.name == name)
        if isinstance(outcome, str):
            outcome = self.ledger.impersonal(outcome, stage)
        else:
            outcome = replace(outcome, lines=tuple(self.ledger.impersonal(line, stage) for line in outcome.lines))
        try:
            if isinstance(outcome, str):
                # what an earlier run or half of this one left is no result of these inputs
                (self.ledger.forget if stage.goes_on else self.ledger.remove)(stage, outcome)
                self.outcomes[stage.name] = Outcome(stage.name, None, outcome)
            else:
                key, made_from = self._keys[stage.name]
                record = self.ledger.keep(stage, key, made_from, outcome, seconds)
                self.outcomes[stage.name] = Outcome(stage.name, record, self._built_on_old(stage))
        except (OSError, MrstrainError) as failure:
            self.outcomes[stage.name] = Outcome(stage.name, None, self.ledger.impersonal(str(failure), stage))
        one = self.outcomes[stage.name]
        tell(f"{stage.name}: {one.words} after {seconds:.0f} s" + (f". {one.reason}" if one.reason else ""))
        if one.record is not None:
            for line in one.record.given.lines:
                tell(f"    {line}")


def run_all(pipelines: Mapping[str, Pipeline], pool: Callable[[], Any], tell: Mapping[str, Tell]) -> None:
    """Run what is left of several studies on one cluster.

    Parameters
    ----------
    pipelines : mapping of str to Pipeline
        By a prefix of their stages' names, which tells one study's from another's.
    pool : callable
        Gives a context with a `Cluster`; asked for only where there is work.
    tell : mapping
        Of the same prefixes: gets a line for each stage that ends.
    """
    with ExitStack() as stack:
        made: list[Cluster] = []

        def cluster() -> Cluster:
            if not made:
                made.append(stack.enter_context(pool()))
            return made[0]

        for prefix, pipeline in pipelines.items():
            pipeline.start(cluster, tell[prefix], prefix)
        while made and made[0].busy:
            full, given, seconds = made[0].next()
            prefix = next(p for p in pipelines if full.startswith(p) and full[len(p) :] in pipelines[p].names)
            pipelines[prefix].end(full[len(prefix) :], given, seconds, tell[prefix])
            pipelines[prefix].start(cluster, tell[prefix], prefix)


def _lacking(stage: Stage, there: Set[str]) -> str:
    """Which result a stage cannot do without, of those that are there; empty where it can be run."""
    for name in stage.after:
        if name not in there:
            return f"{name} has no result."
    for of in stage.some.values():
        if there.isdisjoint(of):
            return f"none of {', '.join(of)} has a result."
    return ""


def _among(stage: Stage, chosen: Sequence[str], *, default: bool) -> bool:
    return default if not chosen else stage.name in chosen or stage.kind in chosen
