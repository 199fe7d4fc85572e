"""Progress for people: live bars with the time left in a terminal, a line now and then in a pipe."""

import logging
import math
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn, TimeElapsedColumn
from rich.text import Text

from mrstrain.records.time_left import STARTING, Expected, TimeLeft

OnProgress = Callable[[str, str, float], None]
"""``progress(case, stage, fraction)``: what is being done for which case, and how far it is (0 to 1).

A stage of a study is a case; when it has ended (1), what it found stands in the place of what is being done. What a
person should know at once is told as the case "note".
"""

ALL = "all"
"""The case that stands for a whole study or command; its fraction is the share of the time, spent and to come."""

NOTE = "note"
"""The case of a sentence to be shown at once, as it stands in the place of the stage; its fraction is 0."""

_LINE_EVERY_S = 15.0
_TOLD_EVERY_S = 1.0
_UNENDED = 0.999  # of the whole: only what has ended is told as 1
_LINE_OF_ALL_EVERY_S = 60.0
_LEAST_SHARE = 0.02
_NONE_LEFT = "about 0 s left"
_log = logging.getLogger(__name__)
_COUNTED = re.compile(r"(\d+) of \1\b.*")  # all that there are
_MOST_SHARE = 0.99  # of what is not done: no line says 100 % while work goes on


def expect(
    progress: OnProgress | None, cases: Mapping[str, Expected], workers: int = 1, *, reading_s: float = 0.0
) -> None:
    """Let the progress of a command tell the time left of the whole, if it is shown live.

    ``cases`` are all that will be reported, with what they are expected to take on so many ``workers``; what has been
    expected before stays, as where a command calls another. ``reading_s`` is what the images were expected to take
    that have been read by then: a machine is not slow because they are large.
    """
    if isinstance(progress, Live):
        progress.expect(cases, workers, reading_s)


class Live:
    """Progress that is shown: of each case, until `expect` has told what is to come; then of the whole in one line."""

    def __init__(self, show: OnProgress, log: OnProgress, began: float) -> None:
        self._show, self._log, self._began = show, log, began
        self._left: TimeLeft | None = None
        self._parts: dict[str, str] = {}  # of the cases under way
        self._under_way = STARTING
        self._telling, self._stop = threading.Lock(), threading.Event()

    def expect(self, cases: Mapping[str, Expected], workers: int, reading_s: float = 0.0) -> None:
        """As `mrstrain.records.progress.expect`."""
        if self._left is None:
            self._left = TimeLeft.of_command(cases, workers, time.monotonic() - self._began, reading_s)
            self.tell()
            threading.Thread(target=self._keep_up, name="time left", daemon=True).start()

    def __call__(self, case: str, stage: str, fraction: float) -> None:
        """Take progress, log it and show it."""
        self._log(case, stage, fraction)
        if self._left is None or case == NOTE:
            self._show(case, stage, fraction)
            return
        with self._telling:
            self._left.told(case, stage, fraction)
            self._parts = {name: part for name, part in self._parts.items() if name in self._left.under_way}
            if case in self._left.under_way:
                self._parts[case] = stage
        self.tell()

    def tell(self) -> None:
        """Show the whole: what is under way, and the share of the time, spent and left, that is spent."""
        with self._telling:
            if self._left is not None:
                spent = time.monotonic() - self._began
                told = "; ".join(f"{case}: {part}" for case, part in self._parts.items())
                self._under_way = told or self._under_way  # between two of them, as before
                self._show(ALL, self._under_way, min(spent / (spent + self._left.seconds() + 1e-9), _UNENDED))

    def close(self) -> None:
        """Show that the whole has ended, and no more."""
        self._stop.set()
        with self._telling:
            if self._left is not None:
                self._show(ALL, "finished", 1.0)
                self._left = None

    def stop(self) -> None:
        """Show no more."""
        self._stop.set()

    def _keep_up(self) -> None:
        while not self._stop.wait(_TOLD_EVERY_S):
            self.tell()


@contextmanager
def live(*, of_all: bool = False, console: Console | None = None, began: float | None = None) -> Iterator[OnProgress]:
    """Show progress on standard error; standard output is for results. An interrupt is reported in a line.

    A command that tells what it expects (`expect`) has one bar, or one line now and then, with the time left of all.
    ``of_all`` says that the case "all" is reported besides its parts, as studies do. Its bar is then the first and
    shown from the start, and what a part found is printed when it has ended. Without a terminal there is a line for
    each part that has ended, and one every minute between. ``began`` is when the command began, on the clock of
    `time.monotonic`; now by default.
    """
    console, began = console or Console(stderr=True), time.monotonic() if began is None else began

    def shown(others: OnProgress, case: str, stage: str, fraction: float) -> None:
        if case == NOTE:
            console.print(stage, markup=False, highlight=False, soft_wrap=True)
        else:
            others(case, stage, fraction)

    try:
        lines = nullcontext(_lines_of_all() if of_all else _lines(began))
        with _bars(console, of_all, began) if console.is_terminal else lines as to:
            whole = Live(partial(shown, to), _Logged(of_all), began)
            try:
                yield whole
                whole.close()
            finally:
                whole.stop()
    except KeyboardInterrupt:
        console.print("Interrupted. Finished results are kept." + " The same command resumes." * of_all)
        raise


class _Logged:
    """Gives beginning and end of each stage to the logger, with its time; what a part found where ``of_all`` does."""

    def __init__(self, of_all: bool) -> None:
        self._of_all = of_all
        self._began: dict[tuple[str, str], float] = {}
        self._ended: set[tuple[str, str]] = set()

    def __call__(self, case: str, stage: str, fraction: float) -> None:
        """Take progress."""
        if case == NOTE:
            _log.info(stage)
            return
        key, now = (case, "" if self._of_all else stage), time.monotonic()
        if case == ALL or key in self._ended:
            return
        if key not in self._began:
            self._began[key] = now
            _log.info("%s: %s", case, stage)
        if fraction >= 1.0:
            self._ended.add(key)
            _log.info("%s: %s (ended after %.1f s)", case, stage, now - self._began[key])


def duration(seconds: float) -> str:
    """A time as people say it.

    >>> [duration(s) for s in (0.4, 89.0, 100.0, 5000.0, 9000.0)]
    ['0 s', '89 s', '2 min', '83 min', '2.5 h']
    """
    minutes = seconds / 60.0
    return f"{seconds:.0f} s" if minutes < 1.5 else f"{minutes:.0f} min" if minutes < 90 else f"{minutes / 60:.1f} h"


def _left(spent_s: float, fraction: float) -> str:
    """The time left, if it can be told yet."""
    known = _LEAST_SHARE <= fraction < 1.0
    return f"about {duration(spent_s * (1.0 - fraction) / fraction)} left" if known else ""


class _TimeLeft(ProgressColumn):
    """The time left of a bar, from its share and the time that it took. The bar itself never goes back."""

    def render(self, task: Task) -> Text:
        return Text(_left(task.elapsed or 0.0, task.fields.get("fraction", task.completed)))


@contextmanager
def _bars(console: Console, of_all: bool, command_began: float) -> Iterator[OnProgress]:
    """Show a bar for each case under way; finished ones are hidden, because lines beyond the terminal are cut off."""
    bars: dict[str, TaskID] = {}
    name, percentage = (TextColumn(text) for text in ("{task.description}", "{task.percentage:>3.0f} %"))
    columns = name, BarColumn(), percentage, TimeElapsedColumn(), _TimeLeft()
    with Progress(*columns, console=console) as display:
        stages: dict[str, str] = {}
        bars[ALL] = display.add_task(ALL, total=1.0, visible=of_all)
        display.tasks[0].start_time = command_began

        def progress(case: str, stage: str, fraction: float) -> None:
            visible = case == ALL or fraction < 1.0
            if case not in bars:
                bars[case] = display.add_task(case, total=1.0, visible=visible)
            if stages.get(case) != stage:
                stages[case] = stage
                of_command = case == ALL and not of_all
                if not of_all and not of_command:  # parts of a case that is no stage of a study begin at 0 each
                    display.reset(bars[case], total=1.0)
                display.update(bars[case], description=stage if of_command else f"{case}: {stage}")
            share = _short_of_all(fraction)
            before = next(task.completed for task in display.tasks if task.id == bars[case])
            display.update(bars[case], completed=max(share, before), fraction=share, visible=visible)
            if of_all and not visible:
                console.print(f"{case}: {stage}", markup=False, highlight=False)

        yield progress


def _lines(command_began: float) -> OnProgress:
    """Print a line when a stage begins and ends, and every 15 s between; of a whole command when its stages change."""
    began: dict[tuple[str, str], float] = {}
    printed_at: dict[tuple[str, str], float] = {}
    of_all = "", -math.inf  # what was under way, and when that was printed
    highest = 0.0  # share of the whole that was printed: it never falls, though the time left may rise

    def progress(case: str, stage: str, fraction: float) -> None:
        nonlocal of_all, highest
        key, now = (case, stage), time.monotonic()
        if case == ALL:
            if stage != of_all[0] or now - of_all[1] >= _LINE_EVERY_S:
                of_all = stage, now
                time_left, spent = _left(now - command_began, fraction), duration(now - command_began)
                highest = max(highest, fraction)
                share = f"{100 * highest:.0f} % after {spent}{', ' * bool(time_left)}{time_left}"
                line = f"{stage} after {spent}" if fraction >= 1.0 else f"{stage} ({share})"
                print(line, file=sys.stderr, flush=True)
            return
        began.setdefault(key, now)
        last = printed_at.get(key, -math.inf)
        if last < math.inf and (fraction >= 1.0 or now - last >= _LINE_EVERY_S):
            printed_at[key] = math.inf if fraction >= 1.0 else now
            _print(case, stage, fraction, now - began[key])

    return progress


def _lines_of_all() -> OnProgress:
    """Print a line for each part that has ended, with how far all are; every minute between, one with what runs."""
    began = printed_at = time.monotonic()
    found, running = list[str](), dict[str, float]()

    def progress(case: str, stage: str, fraction: float) -> None:
        nonlocal printed_at
        now = time.monotonic()
        if case != ALL:
            found.extend([f"{case}: {stage}"] if fraction >= 1.0 else [])
            running.pop(case, None)
            running.update({case: fraction} if fraction < 1.0 else {})
        elif found or fraction >= 1.0 or now - printed_at >= _LINE_OF_ALL_EVERY_S:
            printed_at = now
            time_left, spent = _left(now - began, fraction), duration(now - began)
            left = f", {time_left}" if time_left not in ("", _NONE_LEFT) and not _COUNTED.fullmatch(stage) else ""
            after = f"{stage} after {spent}{left}"
            ended = [f"finished after {spent}: {stage}"] if fraction >= 1.0 else []
            under_way = ", ".join(f"{name} {100 * _short_of_all(share):.0f} %" for name, share in running.items())
            of_all = f"progress: {after}" + f"; running: {under_way}" * bool(running)
            told = [f"{line} ({after})" for line in found] or ([] if ended else [of_all])
            for line in (*told, *ended):
                print(line, file=sys.stderr, flush=True)
            found.clear()

    return progress


def _print(case: str, stage: str, fraction: float, spent_s: float) -> None:
    share = _short_of_all(fraction)
    left_s = spent_s * (1.0 - share) / share if share >= 0.1 and spent_s >= 1.0 else 0.0  # a first part: known at once
    left = f", {left_s:.0f} s left" if left_s >= 1.0 else ""
    print(f"{case}: {stage} {100 * share:.0f} % after {spent_s:.0f} s{left}", file=sys.stderr, flush=True)


def _short_of_all(fraction: float) -> float:
    return fraction if fraction >= 1.0 else min(fraction, _MOST_SHARE)
