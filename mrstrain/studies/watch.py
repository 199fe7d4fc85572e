"""What people see of a run while it goes on: progress with the time left, what each stage found, a growing report."""

import logging
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from dvc.errors import OutputError
from dvc.io.result_folder import REPORT
from mrstrain.records.progress import ALL, NOTE, OnProgress, duration
from mrstrain.records.time_left import Expected, TimeLeft
from mrstrain.studies.file import Study
from mrstrain.studies.page import write_page_in_progress, write_run_report
from mrstrain.studies.pipeline import Pipeline, StageOutcome

OnReport = Callable[[Path], object]
OnEnd = Callable[[Study, Mapping[str, StageOutcome]], object]
_PAGE_EVERY_S = 3.0  # where something has changed
_PAGE_AT_LEAST_EVERY_S = 60.0  # its time of day shows that the run goes on
_UNENDED = 0.999  # of the whole: only what has ended is told as 1
_warnings = logging.getLogger("mrstrain.studies")


@dataclass(frozen=True, slots=True)
class Follower:
    """What follows a run from outside: its progress, its reports, and the work that it is a part of."""

    progress: OnProgress | None = None
    on_report: OnReport | None = None  # as in `mrstrain.run`
    on_end: OnEnd | None = None  # called when all stages of a study have ended, before its report is written
    began: float = field(default_factory=time.monotonic)  # when the whole work began
    before: Mapping[str, tuple[Expected, float]] = field(default_factory=dict)  # done before the run, and seconds taken

    def time_left(self, expected: Mapping[str, Expected], workers: int) -> TimeLeft:
        """The time left of stages; what was done before tells how fast this machine is."""
        took = {name: taken_s for name, (_, taken_s) in self.before.items()}
        done = {name: one for name, (one, _) in self.before.items()}
        return TimeLeft(done | dict(expected), workers, began=dict.fromkeys(took, self.began), took=took)


@dataclass(slots=True, eq=False)
class Report:
    """The report of a study at its place: in progress while the study runs, then whole."""

    study: Study
    pipeline: Pipeline
    on_report: OnReport | None = None  # called once, as soon as it shows a picture of this run

    @property
    def path(self) -> Path:
        """Where it stands."""
        return self.study.out / REPORT

    def in_progress(self, under_way: Sequence[str], left_s: float, *, interrupted: bool = False) -> None:
        """Write what is done and what is under way, and the time that all that is run still takes."""
        outcomes, names = dict(self.pipeline.outcomes), [stage.name for stage in self.pipeline.stages]
        state, when = f"{len(outcomes)} of {len(names)} stages are done", f"{datetime.now():%H:%M:%S}"
        told = (
            f"Interrupted at {when}: {state}. mrstrain run resumes it." if interrupted
            else f"In progress, at {when}: {state}, about {duration(left_s)} left. This page is updated every minute "
            f"and reloads itself. If it is minutes after {when}, the run was killed; mrstrain run resumes it."
        )  # fmt: skip
        write_page_in_progress(self.path, self.study, names, outcomes, under_way, told, ended=interrupted)
        self._show(outcomes[name] for load in self.study.loads if (name := f"register {load}") in outcomes)

    def whole(self) -> None:
        """Write the report when every stage has an outcome."""
        outcomes = self.pipeline.in_order()
        write_run_report(self.path, self.study, outcomes)
        self._show(outcomes.values())

    def _show(self, on_page: Iterable[StageOutcome]) -> None:
        ran = [section for one in on_page if not one.reused for section in one.result.sections]
        if self.on_report is not None and any(section.pictures for section in ran):
            shown, self.on_report = self.on_report, None
            shown(self.path)


@dataclass(slots=True, eq=False)
class Watch:
    """Follows the stages of studies that run together; stages and reports are named with the prefix of their study."""

    follower: Follower
    reports: Mapping[str, Report]
    left: TimeLeft
    _ended: int = 0
    _failed: int = 0
    _lock: threading.RLock = field(default_factory=threading.RLock)
    _changed: set[str] = field(default_factory=set)  # prefixes of the studies whose page is out of date
    _stop: threading.Event = field(default_factory=threading.Event)
    _warned: bool = False

    def tell(self, case: str, what: str, fraction: float) -> None:
        """Pass progress on."""
        if self.follower.progress is not None:
            self.follower.progress(case, what, fraction)

    def told(self, name: str, what: str, fraction: float) -> None:
        """Take the progress of a stage that is under way."""
        with self._lock:
            if name == NOTE:
                self.tell(name, what, fraction)
            if name not in self.left.stages or name in self.left.took:
                return
            if name not in self.left.began:
                self.left.begin(name)
                self._change(name)
            self.tell(name, what, min(fraction, _UNENDED))
            self._tell_all()

    def ended(self, name: str, outcome: StageOutcome) -> None:
        """Take the outcome of a stage: one that was to be done tells what it found, with the fraction 1."""
        with self._lock:
            self._ended += 1
            self._failed += outcome.status == "FAILED"
            if name in self.left.stages:
                self.left.end(name)
                self.tell(name, outcome.headline, 1.0)
                self._change(name)
            self._tell_all()

    @property
    def count(self) -> str:
        """How many of all stages have ended, and failed, in words."""
        stages = sum(len(report.pipeline.stages) for report in self.reports.values())
        return f"{self._ended} of {stages} stages" + f", {self._failed} failed" * bool(self._failed)

    def _tell_all(self) -> None:
        """Tell the share of the whole time, spent and left, that is spent."""
        spent, left = time.monotonic() - self.follower.began, self.left.seconds()
        self.tell(ALL, self.count, min(spent / (spent + left + 1e-9), _UNENDED))

    def _change(self, name: str) -> None:
        self._changed |= {prefix for prefix in self.reports if name.startswith(prefix)}

    @contextmanager
    def reporting(self) -> Iterator[None]:
        """Keep reports up to date, in a thread that nothing waits for; an interrupted run is reported as such."""
        thread = threading.Thread(target=self._keep_up, name="reports", daemon=True)
        thread.start()
        try:
            yield
        except BaseException:
            self._close(thread)
            self._write(self.reports, interrupted=True)
            raise
        self._close(thread)

    def _close(self, thread: threading.Thread) -> None:
        self._stop.set()
        thread.join()

    def _keep_up(self) -> None:
        renewed = time.monotonic()
        while not self._stop.wait(_PAGE_EVERY_S):
            with self._lock:
                if time.monotonic() - renewed >= _PAGE_AT_LEAST_EVERY_S:
                    renewed = time.monotonic()
                    for name in self.left.under_way:
                        self._change(name)
                changed, self._changed = self._changed, set()
            with self._going_on("The progress could not be shown"), self._lock:
                self._tell_all()  # stages that hang tell nothing
            self._write(changed)

    def _write(self, prefixes: Iterable[str], *, interrupted: bool = False) -> None:
        with self._lock:
            names, left_s = self.left.under_way, self.left.seconds()
        for prefix in prefixes:
            under_way = [name.removeprefix(prefix) for name in names if name.startswith(prefix)]
            with self._going_on(f"{self.reports[prefix].path}: the report could not be renewed"):
                self.reports[prefix].in_progress(under_way, left_s, interrupted=interrupted)

    @contextmanager
    def _going_on(self, failed: str) -> Iterator[None]:
        """Let what people see of a run fail without the run; the first reason that nobody expects is logged."""
        try:
            yield
        except OutputError:  # the run itself fails on a full disk, and says so
            pass
        except Exception as error:
            if not self._warned:
                self._warned = True
                _warnings.warning("%s (%s: %s). The run goes on.", failed, type(error).__name__, error)
