"""Runs the stages of a study: finished stages are reused, and a failed stage does not stop the others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set as AbstractSet
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from dvc.errors import MrstrainError
from mrstrain.studies.ledger import Ledger, StageRecord
from mrstrain.studies.plan import Stage
from mrstrain.studies.stages import StageResult

if TYPE_CHECKING:
    from mrstrain.studies.cluster import StageRunner

Log = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class StageOutcome:
    """How a stage ended."""

    stage: str
    record: StageRecord | None  # of its result
    reason: str = ""  # why there is no result, or why it does not match the study any more
    reused: bool = False  # the result existed already
    requested: bool = True  # the stage was among those that may be run

    @property
    def left_out(self) -> bool:
        """Whether it has no result only because it was not requested."""
        return not self.requested and self.status == "not run"

    @property
    def complete(self) -> bool:
        """Whether there is a complete result that matches the study as it is now."""
        return self.record is not None and self.record.result.complete and not self.reason

    @property
    def status(self) -> str:
        """Status in a word or two, for tables and the log."""
        if self.record is None:
            return "not run" if self.reason.startswith("Not run") else "FAILED"
        if self.reason:
            return "OUT OF DATE"
        return "in part" if not self.record.result.complete else "there already" if self.reused else "done"


class Pipeline:
    """The stages of a study in an order that can be run, and their outcomes; ``only`` and ``force`` as in `run`."""

    def __init__(
        self, stages: Sequence[Stage], ledger: Ledger, *, only: Sequence[str] = (), force: Sequence[str] = ()
    ) -> None:
        self.stages, self.ledger = tuple(stages), ledger
        self._only, self._force = tuple(only), tuple(force)
        self.outcomes: dict[str, StageOutcome] = {}
        self._keys: dict[str, tuple[str, Mapping[str, Any]]] = {}
        self._waiting = {stage.name: stage for stage in stages}

    def in_order(self) -> dict[str, StageOutcome]:
        """Outcomes in the order of the stages."""
        return {stage.name: self.outcomes[stage.name] for stage in self.stages}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the stages."""
        return tuple(stage.name for stage in self.stages)

    def _requested(self, stage: Stage) -> bool:
        return not self._only or _named(stage, self._only)

    def _forced(self, stage: Stage) -> bool:
        return _named(stage, self._force)

    def _origin(
        self, stage: Stage, records: Mapping[str, StageRecord]
    ) -> tuple[Mapping[str, Any], str, Mapping[str, Any]]:
        """Arguments of a stage, and key and origin (`Ledger.made_from`) of the result that it would have now."""
        arguments = _arguments(stage, records.keys())
        made_from = self.ledger.made_from(stage, arguments)
        built_on = {name: records[name] for name in stage.before if name in records}
        return arguments, self.ledger.key(stage, made_from, built_on), made_from

    def settle(self) -> list[tuple[Stage, Mapping[str, Any]]]:
        """Advance every stage as far as possible without work; return those to be run now, with their arguments."""
        ready = []
        for stage in list(self._waiting.values()):  # each after those that it waits for: one pass is enough
            if any(name not in self.outcomes for name in stage.before):
                continue
            del self._waiting[stage.name]
            try:
                settled = self._settled(stage)
            except (OSError, MrstrainError) as failure:  # an input that is gone, or may not be read
                reason = self.ledger.impersonal(str(failure), stage)
                settled = StageOutcome(stage.name, None, reason, requested=self._requested(stage))
            if isinstance(settled, StageOutcome):
                self.outcomes[stage.name] = settled
            else:
                ready.append((stage, settled))
        return ready

    def _settled(self, stage: Stage) -> StageOutcome | Mapping[str, Any]:
        """Outcome of a stage that need not be run, or the arguments of one that has to be run now."""
        records = {name: outcome.record for name, outcome in self.outcomes.items() if outcome.record is not None}
        requested = self._requested(stage)
        missing = _missing(stage, records.keys())
        if missing:
            return StageOutcome(stage.name, None, f"Not run: {missing}", requested=requested)
        arguments, key, made_from = self._origin(stage, records)
        kept = self.ledger.finished(stage)
        current = kept is not None and kept.key == key
        if kept is None and not requested:
            reason = self.ledger.reason(stage) or "Not run: it has no result, and is not among those asked for."
        elif current or not requested:
            reason = self._outdated_inputs(stage) if current else "Made from other inputs than the study names now."
        if not requested or (kept is not None and current and not kept.result.retry and not self._forced(stage)):
            return StageOutcome(stage.name, kept, reason, reused=True, requested=requested)
        self._keys[stage.name] = key, made_from
        return arguments

    def _outdated_inputs(self, stage: Stage) -> str:
        """Which results that a stage reads are out of date, so that it is too; empty where none is."""
        outdated = [name for name in stage.before if self.outcomes[name].status == "OUT OF DATE"]
        return f"Built on {', '.join(outdated)}, out of date." if outdated else ""

    def forecast(self) -> dict[str, str]:
        """What a run would do with each stage: "done already", "run", "left out", or "cannot be run" and why."""
        forecast: dict[str, str] = {}
        records: dict[str, StageRecord] = {}
        available: set[str] = set()
        for stage in self.stages:
            record = self.ledger.finished(stage)
            missing = _missing(stage, available)
            if missing:
                forecast[stage.name] = f"cannot be run: {missing}" if self._requested(stage) else "left out"
                continue
            if not self._requested(stage):
                forecast[stage.name] = "left out"
            elif record is None or self._forced(stage) or any(forecast[name] == "run" for name in stage.before):
                forecast[stage.name] = "run"
            else:
                current = record.key == self._origin(stage, records)[1] and not record.result.retry
                forecast[stage.name] = "done already" if current else "run"
            if record is not None:
                records[stage.name] = record
            if record is not None or forecast[stage.name] == "run":
                available.add(stage.name)
        return forecast

    def to_do(self) -> list[Stage]:
        """The stages that a run would work on."""
        forecast = self.forecast()
        return [stage for stage in self.stages if forecast[stage.name] == "run"]

    def start(self, runner: Callable[[], StageRunner], log: Log, prefix: str = "") -> None:
        """Settle what can be settled, log it, and hand the stages that have to be run to the cluster."""
        before = set(self.outcomes)
        ready = self.settle()
        for name, outcome in self.outcomes.items():
            if name not in before:
                log(f"{name}: {outcome.status}" + (f". {outcome.reason}" if outcome.reason else ""))
        for stage, arguments in ready:
            try:
                if stage.goes_on and not self._forced(stage):
                    self.ledger.forget(stage)
                else:
                    self.ledger.remove(stage)
                for place in stage.gives:
                    place.parent.mkdir(parents=True, exist_ok=True)
            except (OSError, MrstrainError) as failure:
                self.end(stage.name, str(failure), 0.0, log)
                continue
            runner().begin(prefix + stage.name, stage.kind, arguments, self.ledger.lock(stage))

    def end(self, name: str, result: StageResult | str, seconds: float, log: Log) -> None:
        """Record how a stage ended that was handed to the cluster: its result, or why it failed."""
        stage = next(stage for stage in self.stages if stage.name == name)
        try:
            outcome = self._recorded(stage, result, seconds)
        except (OSError, MrstrainError) as failure:
            outcome = StageOutcome(name, None, self.ledger.impersonal(str(failure), stage))
        self.outcomes[name] = outcome
        log(f"{name}: {outcome.status} after {seconds:.0f} s" + (f". {outcome.reason}" if outcome.reason else ""))
        for line in () if outcome.record is None else outcome.record.result.lines:
            log(f"    {line}")

    def _recorded(self, stage: Stage, result: StageResult | str, seconds: float) -> StageOutcome:
        if isinstance(result, str):
            reason = self.ledger.impersonal(result, stage)
            # what an earlier run or half of this one left is no result of these inputs
            (self.ledger.forget if stage.goes_on else self.ledger.remove)(stage, reason)
            return StageOutcome(stage.name, None, reason)
        result = replace(result, lines=tuple(self.ledger.impersonal(line, stage) for line in result.lines))
        record = self.ledger.keep(stage, *self._keys[stage.name], result, seconds)
        return StageOutcome(stage.name, record, self._outdated_inputs(stage))


def run_all(pipelines: Mapping[str, Pipeline], pool: Callable[[], Any], logs: Mapping[str, Log]) -> None:
    """Run what is left of several studies on one cluster.

    Pipelines and logs are given by the prefix that tells one study's stage names from another's; a log gets a line for
    each stage that ends. ``pool`` gives a context with a `StageRunner`, and is called only if there is work.
    """
    with ExitStack() as stack:
        runners: list[StageRunner] = []

        def runner() -> StageRunner:
            if not runners:
                runners.append(stack.enter_context(pool()))
            return runners[0]

        for prefix, pipeline in pipelines.items():
            pipeline.start(runner, logs[prefix], prefix)
        while runners and runners[0].busy:
            full_name, result, seconds = runners[0].next()
            prefix, name = next(
                (p, full_name[len(p) :])
                for p in pipelines
                if full_name.startswith(p) and full_name[len(p) :] in pipelines[p].names
            )
            pipelines[prefix].end(name, result, seconds, logs[prefix])
            pipelines[prefix].start(runner, logs[prefix], prefix)


def _arguments(stage: Stage, available: AbstractSet[str]) -> Mapping[str, Any]:
    """Arguments of a stage, with what the available stages that it may build on are listed with."""
    chosen = {
        argument: [value for name, value in by_stage.items() if name in available]
        for argument, by_stage in {**stage.some, **stage.perhaps}.items()
    }
    return {**stage.arguments, **chosen}


def _missing(stage: Stage, available: AbstractSet[str]) -> str:
    """Which result that a stage requires is not available; empty where it can be run."""
    for name in stage.after:
        if name not in available:
            return f"{name} has no result."
    for by_stage in stage.some.values():
        if available.isdisjoint(by_stage):
            return f"none of {', '.join(by_stage)} has a result."
    return ""


def _named(stage: Stage, chosen: Sequence[str]) -> bool:
    return stage.name in chosen or stage.kind in chosen
