"""Progress for people: live bars with the time left in a terminal, a line now and then in a pipe."""

import math
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

OnProgress = Callable[[str, str, float], None]
"""``progress(case, stage, fraction)``: what is being done for which case, and how far it is (0 to 1)."""

ALL = "all"
"""The case that stands for a whole study, or several."""

_LINE_EVERY_S = 15.0
_LINE_OF_ALL_EVERY_S, _BETWEEN_ENDS_S = 60.0, 1.0


@contextmanager
def live(*, of_all: bool = False, console: Console | None = None) -> Iterator[OnProgress]:
    """Show progress on standard error; standard output is for results. An interrupt is reported in a line.

    ``of_all`` says that the case "all" is reported besides its parts, as studies do. Its bar is then the first and
    shown from the start; without a terminal its line is the only one, because the study's log has those of the cases.
    """
    console = console or Console(stderr=True)
    try:
        if console.is_terminal:
            with _bars(console, of_all) as progress:
                yield progress
        else:
            yield _lines_of_all() if of_all else _lines()
    except KeyboardInterrupt:
        console.print("Interrupted. Finished results are kept; incomplete ones are not.")
        raise


@contextmanager
def _bars(console: Console, of_all: bool) -> Iterator[OnProgress]:
    """Show a bar for each case under way; finished ones are hidden, because lines beyond the terminal are cut off."""
    bars: dict[str, TaskID] = {}
    name, percentage, left = (TextColumn(text) for text in ("{task.description}", "{task.percentage:>3.0f} %", "left"))
    columns = name, BarColumn(), percentage, TimeElapsedColumn(), left, TimeRemainingColumn()
    with Progress(*columns, console=console) as display:
        stages: dict[str, str] = {}
        if of_all:
            bars[ALL] = display.add_task(ALL, total=1.0)

        def progress(case: str, stage: str, fraction: float) -> None:
            visible = case == ALL or fraction < 1.0
            if case not in bars:
                bars[case] = display.add_task(case, total=1.0, visible=visible)
            if stages.get(case) != stage:
                stages[case] = stage
                display.reset(bars[case], total=1.0, description=f"{case}: {stage}")
            display.update(bars[case], completed=fraction, visible=visible)

        yield progress


def _lines() -> OnProgress:
    """Print a line when a stage begins and ends, and every 15 s between."""
    began: dict[tuple[str, str], float] = {}
    printed_at: dict[tuple[str, str], float] = {}

    def progress(case: str, stage: str, fraction: float) -> None:
        key, now = (case, stage), time.monotonic()
        began.setdefault(key, now)
        last = printed_at.get(key, -math.inf)
        if last < math.inf and (fraction >= 1.0 or now - last >= _LINE_EVERY_S):
            printed_at[key] = math.inf if fraction >= 1.0 else now
            _print(case, stage, fraction, now - began[key])

    return progress


def _lines_of_all() -> OnProgress:
    """Print a line of the whole study when a stage ends, and every minute between."""
    began = printed_at = time.monotonic()
    last_stage, last_fraction = "begun", 0.0

    def progress(case: str, stage: str, fraction: float) -> None:
        nonlocal printed_at, last_stage, last_fraction
        now = time.monotonic()
        stage_ended = case == ALL and last_fraction < 1.0
        if stage_ended:
            last_stage, last_fraction = stage, fraction
        all_ended = stage_ended and fraction >= 1.0
        if all_ended or now - printed_at >= (_BETWEEN_ENDS_S if stage_ended else _LINE_OF_ALL_EVERY_S):
            printed_at = now
            _print(ALL, last_stage, last_fraction, now - began)

    return progress


def _print(case: str, stage: str, fraction: float, spent_s: float) -> None:
    left = f", {spent_s * (1 - fraction) / fraction:.0f} s left" if 0.05 < fraction < 1.0 else ""
    print(f"{case}: {stage} {100 * fraction:.0f} % after {spent_s:.0f} s{left}", file=sys.stderr, flush=True)
