"""Progress for people: live bars with time left in a terminal, a line now and then in a pipe."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

OnProgress = Callable[[str, str, float], None]
"""``told(case, stage, fraction)``: what is being done for which case, and how far it is."""

ALL = "all"
"""The case that stands for a whole study, or several."""

_LINE_EVERY_S = 15.0
_LINE_OF_ALL_EVERY_S, _BETWEEN_ENDS_S = 60.0, 1.0


@contextmanager
def live(*, of_all: bool = False, console: Console | None = None) -> Iterator[OnProgress]:
    """Show progress on standard error; standard output stays for results. An interrupt is told in a line.

    Parameters
    ----------
    of_all : bool
        Whether the case "all" is told beside those that it is made of, as studies do. Its bar is then the first and
        there from the start, and without a terminal its line is the only one: the cases' own are in the study's log.
    console : Console, optional
        Standard error by default.
    """
    console = console or Console(stderr=True)
    try:
        if console.is_terminal:
            with _bars(console, of_all) as told:
                yield told
        else:
            yield _lines_of_all() if of_all else _lines()
    except KeyboardInterrupt:
        console.print("Interrupted. What was finished is kept; nothing half-written is.")
        raise


@contextmanager
def _bars(console: Console, of_all: bool) -> Iterator[OnProgress]:
    """A bar for each case that is under way: a terminal has few lines, and what does not fit is cut off."""
    bars: dict[str, TaskID] = {}
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
    ) as progress:
        stages: dict[str, str] = {}
        if of_all:
            bars[ALL] = progress.add_task(ALL, total=1.0)

        def told(case: str, stage: str, fraction: float) -> None:
            shown = case == ALL or fraction < 1.0
            if case not in bars:
                bars[case] = progress.add_task(case, total=1.0, visible=shown)
            if stages.get(case) != stage:
                stages[case] = stage
                progress.reset(bars[case], total=1.0, description=f"{case}: {stage}")
            progress.update(bars[case], completed=fraction, visible=shown)

        yield told


def _lines() -> OnProgress:
    began: dict[tuple[str, str], float] = {}
    told_at: dict[tuple[str, str], float] = {}

    def told(case: str, stage: str, fraction: float) -> None:
        key, now = (case, stage), time.monotonic()
        first = key not in began
        began.setdefault(key, now)
        done = fraction >= 1.0 and told_at.get(key) != float("inf")
        if not (first or done or now - told_at.get(key, now) >= _LINE_EVERY_S):
            return
        told_at[key] = float("inf") if done else now
        _print(case, stage, fraction, now - began[key])

    return told


def _lines_of_all() -> OnProgress:
    began = told_at = time.monotonic()
    last_stage, last_fraction = "begun", 0.0

    def told(case: str, stage: str, fraction: float) -> None:
        nonlocal told_at, last_stage, last_fraction
        now = time.monotonic()
        ended = case == ALL and last_fraction < 1.0
        if ended:
            last_stage, last_fraction = stage, fraction
        whole = ended and fraction >= 1.0
        if whole or now - told_at >= (_BETWEEN_ENDS_S if ended else _LINE_OF_ALL_EVERY_S):
            told_at = now
            _print(ALL, last_stage, last_fraction, now - began)

    return told


def _print(case: str, stage: str, fraction: float, spent_s: float) -> None:
    left = f", {spent_s * (1 - fraction) / fraction:.0f} s left" if 0.05 < fraction < 1.0 else ""
    print(f"{case}: {stage} {100 * fraction:.0f} % after {spent_s:.0f} s{left}", file=sys.stderr, flush=True)
