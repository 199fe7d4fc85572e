"""Progress in a pipe: the first line at once, others now and then, with the time left."""

from __future__ import annotations

import pytest

from mrstrain import progress


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time in seconds, to be set."""
    now = [1000.0]
    monkeypatch.setattr("mrstrain.progress.time.monotonic", lambda: now[0])
    return now


def test_lines_come_now_and_then_with_the_time_left(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with progress.live() as told:
        for second, fraction in ((0, 0.0), (5, 0.1), (14, 0.2), (20, 0.25), (30, 0.3), (36, 0.6), (60, 1.0), (61, 1.0)):
            clock[0] = 1000.0 + second
            told("Load1", "registering", fraction)
    lines = capsys.readouterr()
    assert lines.out == ""
    assert lines.err.splitlines() == [
        "Load1: registering 0 % after 0 s",
        "Load1: registering 25 % after 20 s, 60 s left",
        "Load1: registering 60 % after 36 s, 24 s left",
        "Load1: registering 100 % after 60 s",
    ]


def test_cases_and_stages_have_clocks_of_their_own(clock: list[float], capsys: pytest.CaptureFixture[str]) -> None:
    with progress.live() as told:
        told("Load1", "aligning", 0.0)
        clock[0] += 40.0
        told("Load1", "registering", 0.0)
        told("Load2", "aligning", 0.5)
        clock[0] += 20.0
        told("Load1", "registering", 0.4)
    assert capsys.readouterr().err.splitlines() == [
        "Load1: aligning 0 % after 0 s",
        "Load1: registering 0 % after 0 s",
        "Load2: aligning 50 % after 0 s, 0 s left",
        "Load1: registering 40 % after 20 s, 30 s left",
    ]
