"""Runs the stages of a study: finished stages are reused, and a failed stage does not stop the others."""

from collections.abc import Callable, Collection, Mapping, Sequence
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
_NOT_RUN = "Not run: "
_TO_RUN = "will run"


@dataclass(frozen=True, slots=True)
class StageOutcome:
    """Outcome of a stage."""

    stage: str
    record: StageRecord | None  # of its result
    reason: str = ""  # why there is no result, or why it no longer matches the study
    reused: bool = False  # the result existed already
    requested: bool = True  # the stage was among those that may be run

    def __str__(self) -> str:
        return f"{self.stage}: {self.told}"

    @property
    def why(self) -> str:
        """Why it was not run, or is not complete, without its status."""
        return self.reason.removeprefix(_NOT_RUN)

    @property
    def told(self) -> str:
        """Its status, and why."""
        if self.status == "not run":
            return f"not run ({self.why.rstrip('.')})."
        return f"{self.status}. {self.reason}".rstrip()

    @property
    def result(self) -> StageResult:
        """Its result, or an empty result if there is none."""
        return StageResult(()) if self.record is None else self.record.result

    @property
    def headline(self) -> str:
        """What was found, or why there is no result, in a line."""
        if self.complete:
            return self.result.headline or self.status
        if self.status == "not run":
            return self.told
        why = self.reason.partition("\n")[0] or self.result.headline
        return f"{self.status}. {why}" if why else self.status

    @property
    def left_out(self) -> bool:
        """Whether it has no result only because it was not requested."""
        return not self.requested and self.status == "not run"

    @property
    def complete(self) -> bool:
        """Whether there is a complete result that matches the current study."""
        return self.record is not None and self.result.complete and not self.reason

    @property
    def status(self) -> str:
        """Status for tables and the log."""
        if self.record is None:
            return "not run" if self.reason.startswith(_NOT_RUN) else "FAILED"
        if self.reason:
            return "OUT OF DATE"
        return "partial" if not self.result.complete else "up to date" if self.reused else "done"


def left_out_of(outcomes: Mapping[str, StageOutcome]) -> list[str]:
    """A sentence with the stages that have no result only because they were not requested, if there are any."""
    names = [name for name, outcome in outcomes.items() if outcome.left_out]
    return [f"Not requested, and without a result: {', '.join(names)}."] if names else []


class Pipeline:
    """The stages of a study in the order of dependencies, and their outcomes; ``only`` and ``force`` as in `run`."""

    def __init__(
        self, stages: Sequence[Stage], ledger: Ledger, *, only: Sequence[str] = (), force: Sequence[str] = ()
    ) -> None:
        self.stages, self.ledger = tuple(stages), ledger
        self._only, self._force = tuple(only), tuple(force)
        self.outcomes: dict[str, StageOutcome] = {}
        self.seconds_to_end: Mapping[str, float] = {}  # by stage; the one with most is started first
        self.gib: Mapping[str, float] = {}  # of memory that each stage is expected to need
        self._keys: dict[str, tuple[str, Mapping[str, Any]]] = {}
        self._waiting = {stage.name: stage for stage in stages}

    def in_order(self) -> dict[str, StageOutcome]:
        """Outcomes in the order of the stages."""
        return {stage.name: self.outcomes[stage.name] for stage in self.stages}

    def _to_end_s(self, stage: Stage) -> float:
        return self.seconds_to_end.get(stage.name, 0.0)

    def _requested(self, stage: Stage) -> bool:
        return not self._only or stage.is_one_of(self._only)

    def settle(self) -> list[tuple[Stage, Mapping[str, Any]]]:
        """Determine the outcome of all stages that need not be run; return those to run now, with their arguments."""
        ready = []
        for stage in list(self._waiting.values()):  # in the order of dependencies, so one pass is enough
            if any(name not in self.outcomes for name in stage.before):
                continue
            del self._waiting[stage.name]
            try:
                settled = self._settled(stage)
            except (OSError, MrstrainError) as failure:  # an input is missing or not readable
                settled = replace(self._failed(stage, failure), requested=self._requested(stage))
            if isinstance(settled, StageOutcome):
                self.outcomes[stage.name] = settled
            else:
                ready.append((stage, settled))
        return ready

    def _settled(self, stage: Stage) -> StageOutcome | Mapping[str, Any]:
        """Outcome of a stage that need not be run, or the arguments of one that must be run now."""
        records = {name: record for name in stage.before if (record := self.outcomes[name].record) is not None}
        requested = self._requested(stage)
        if missing := _missing(stage, records):
            return StageOutcome(stage.name, None, _NOT_RUN + missing, requested=requested)
        listed = {
            argument: [value for name, value in by_stage.items() if name in records]
            for argument, by_stage in {**stage.some, **stage.perhaps}.items()
        }
        arguments = {**stage.arguments, **listed}
        made_from, kept = self.ledger.made_from(stage, arguments), self.ledger.finished(stage)
        key = self.ledger.key(stage, made_from, records)
        self._keys[stage.name] = key, made_from
        current = kept is not None and kept.key == key
        reusable = kept is not None and current and not kept.result.retry and not stage.is_one_of(self._force)
        if requested and not reusable:
            return arguments
        if kept is None:
            reason = self.ledger.reason(stage) or f"{_NOT_RUN}it has no result and was not requested."
        else:
            reason = self._outdated_inputs(stage) if current else "The inputs have changed since this result was made."
        return StageOutcome(stage.name, kept, reason, reused=True, requested=requested)

    def _failed(self, stage: Stage, why: object) -> StageOutcome:
        return StageOutcome(stage.name, None, self.ledger.impersonal(str(why), stage))

    def _outdated_inputs(self, stage: Stage) -> str:
        """Names the outdated results that a stage depends on; empty if there are none."""
        outdated = [name for name in stage.before if self.outcomes[name].status == "OUT OF DATE"]
        return f"It depends on results that are out of date: {', '.join(outdated)}." if outdated else ""

    def forecast(self) -> dict[str, str]:
        """What a run would do with each stage: "up to date", "will run", "not requested", or "cannot run" and why."""
        trial = Pipeline(self.stages, self.ledger, only=self._only, force=self._force)
        to_run = set()
        while ready := trial.settle():
            for stage, _ in ready:
                anew = StageRecord(stage=stage.name, key="", made_utc="", seconds=0.0, files={}, result=StageResult(()))
                trial.outcomes[stage.name] = StageOutcome(stage.name, anew)  # different from all that others depend on
                to_run.add(stage.name)
        return {
            name: _TO_RUN if name in to_run
            else "not requested" if not outcome.requested
            else f"cannot run: {outcome.why}" if outcome.record is None
            else "up to date"
            for name, outcome in trial.in_order().items()
        }  # fmt: skip

    def to_do(self) -> list[Stage]:
        """The stages that a run would execute."""
        forecast = self.forecast()
        return [stage for stage in self.stages if forecast[stage.name] == _TO_RUN]

    def start(self, runner: "Callable[[], StageRunner]", log: Log, prefix: str = "") -> None:
        """Determine and log the outcomes that are known, and send the stages that must be run to the cluster."""
        before = set(self.outcomes)
        ready = self.settle()
        for name, outcome in self.outcomes.items():
            if name not in before:
                log(str(outcome))
        ready.sort(key=lambda one: -self._to_end_s(one[0]))
        for stage, arguments in ready:
            try:
                self.ledger.clear(stage, files=not stage.goes_on or stage.is_one_of(self._force))
                for place in stage.gives:
                    place.parent.mkdir(parents=True, exist_ok=True)
            except (OSError, MrstrainError) as failure:
                self.end(stage.name, str(failure), 0.0, log)
                continue
            needs = self._to_end_s(stage), self.gib.get(stage.name, 0.0)
            runner().begin(prefix + stage.name, stage.kind, arguments, self.ledger.lock(stage), *needs)

    def end(self, name: str, result: StageResult | str, seconds: float, log: Log) -> None:
        """Record the outcome of a stage that ran on the cluster: its result, or the reason of its failure."""
        stage = next(stage for stage in self.stages if stage.name == name)
        try:
            outcome = self._recorded(stage, result, seconds)
        except (OSError, MrstrainError) as failure:
            outcome = self._failed(stage, failure)
        self.outcomes[name] = outcome
        log(f"{name}: {outcome.status} after {seconds:.0f} s" + (f". {outcome.reason}" if outcome.reason else ""))
        for line in outcome.result.lines:
            log(f"    {line}")

    def recheck(self, log: Log) -> None:
        """Mark the results of which an input changed while the study ran, and those that depend on them."""
        for stage in self.stages:  # in the order of dependencies
            outcome = self.outcomes[stage.name]
            if outcome.record is None or outcome.reason:
                continue
            unchanged = self.ledger.are_unchanged(stage, self._keys[stage.name][1])
            reason = (
                self._outdated_inputs(stage)
                if unchanged
                else "An input file of this stage changed while the study ran; run it again."
            )
            if reason:
                self.outcomes[stage.name] = replace(outcome, reason=reason)
                log(str(self.outcomes[stage.name]))

    def _recorded(self, stage: Stage, result: StageResult | str, seconds: float) -> StageOutcome:
        if isinstance(result, str):
            failed = self._failed(stage, result)
            # files of an earlier or incomplete run are not a result of these inputs
            self.ledger.clear(stage, failed.reason, files=not stage.goes_on)
            return failed
        result = replace(result, lines=tuple(self.ledger.impersonal(line, stage) for line in result.lines))
        record = self.ledger.keep(stage, *self._keys[stage.name], result, seconds)
        return StageOutcome(stage.name, record, self._outdated_inputs(stage))


def run_all(
    pipelines: Mapping[str, Pipeline], pool: Callable[[], Any], logs: Mapping[str, Log],
    ended: Callable[[str, StageOutcome], None] = lambda _name, _outcome: None,
) -> None:  # fmt: skip
    """Run the remaining stages of several studies on one cluster.

    Keys of pipelines and logs are prefixes that distinguish the stage names of different studies. A log gets a line for
    each stage that ends, and ``ended`` gets its name and outcome once the stages that waited for it have been started.
    ``pool`` returns a context with a `StageRunner`, and is called only if there is work.
    """
    told: set[str] = set()

    def begin(prefix: str) -> None:
        pipeline = pipelines[prefix]
        pipeline.start(runner, logs[prefix], prefix)
        for name, outcome in pipeline.outcomes.items():
            if prefix + name not in told:
                told.add(prefix + name)
                ended(prefix + name, outcome)

    prefixes = {prefix + stage.name: prefix for prefix, pipeline in pipelines.items() for stage in pipeline.stages}
    with ExitStack() as stack:
        runners: list[StageRunner] = []

        def runner() -> "StageRunner":
            if not runners:
                runners.append(stack.enter_context(pool()))
            return runners[0]

        for prefix in pipelines:
            begin(prefix)
        while runners and runners[0].busy:
            name, result, seconds = runners[0].next()
            prefix = prefixes[name]
            pipelines[prefix].end(name.removeprefix(prefix), result, seconds, logs[prefix])
            begin(prefix)
        if runners:
            for prefix, pipeline in pipelines.items():
                pipeline.recheck(logs[prefix])


def _missing(stage: Stage, available: Collection[str]) -> str:
    """The missing result that a stage requires; empty if it can be run."""
    for name in stage.after:
        if name not in available:
            return f"{name} has no result."
    for by_stage in stage.some.values():
        if not any(name in available for name in by_stage):
            return f"none of {', '.join(by_stage)} has a result."
    return ""
