"""Progress for people: live bars with time left in a terminal, a line now and then in a pipe."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

Told = Callable[[str, str, float], None]
"""``told(case, stage, fraction)``: what is being done for which case, and how far it is."""

_LINE_EVERY_S = 15.0


@contextmanager
def live() -> Iterator[Told]:
    """Show progress on standard error; standard output stays for results. An interrupt is told in a line."""
    console = Console(stderr=True)
    try:
        if console.is_terminal:
            with _bars(console) as told:
                yield told
        else:
            yield _lines()
    except KeyboardInterrupt:
        console.print("Interrupted. What was finished is kept; nothing half-written is.")
        raise


@contextmanager
def _bars(console: Console) -> Iterator[Told]:
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

        def told(case: str, stage: str, fraction: float) -> None:
            if case not in bars:
                bars[case] = progress.add_task(case, total=1.0)
            if stages.get(case) != stage:
                stages[case] = stage
                progress.reset(bars[case], total=1.0, description=f"{case}: {stage}")
            progress.update(bars[case], completed=fraction)

        yield told


def _lines() -> Told:
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
        spent = now - began[key]
        left = f", {spent * (1 - fraction) / fraction:.0f} s left" if 0.05 < fraction < 1.0 else ""
        print(f"{case}: {stage} {100 * fraction:.0f} % after {spent:.0f} s{left}", file=sys.stderr, flush=True)

    return told
