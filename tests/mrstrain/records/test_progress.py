"""Progress in a pipe: lines now and then, with the time left; and in a terminal: what is under way."""

from __future__ import annotations

import io
import re
import time

import pytest
from rich.console import Console

from mrstrain.records import progress
from mrstrain.records.time_left import FAILED, Expected
from tests.processes import wait_for


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time in seconds, to be set."""
    now = [1000.0]
    monkeypatch.setattr("mrstrain.records.progress.time.monotonic", lambda: now[0])
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


PARTS = {"aligning": 10.0, "registering": 20.0, "strain and figures": 10.0}
LOADS = {"Load1": Expected.of(PARTS), "Load2": Expected.of(PARTS), "report": Expected(2.0)}
TOLD = (
    (0, "Load1", "aligning", 0.0), (10, "Load1", "aligning", 1.0), (10, "Load1", "registering", 0.0),
    (20, "Load1", "registering", 0.5), (30, "Load1", "registering", 1.0), (30, "Load1", "strain and figures", 0.0),
    (40, "Load1", "strain and figures", 1.0), (40, "Load2", "aligning", 0.0), (45, "Load2", FAILED, 1.0),
    (45, "report", "writing", 0.0), (47, "report", "writing", 1.0),
)  # fmt: skip


def test_a_command_that_tells_what_it_expects_has_one_line_with_the_time_left_of_all(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with progress.live() as told:
        progress.expect(told, LOADS)
        progress.expect(told, {"Load1": Expected(1e6)})  # by a command that it calls
        for second, case, stage, fraction in TOLD:
            clock[0] = 1000.0 + second
            told(case, stage, fraction)
    lines = capsys.readouterr()
    assert lines.out == ""
    assert lines.err.splitlines() == [
        "starting (0 % after 0 s)",
        "Load1: aligning (0 % after 0 s)",
        "Load1: registering (12 % after 10 s, about 72 s left)",
        "Load1: registering (37 % after 30 s, about 52 s left)",
        "Load1: strain and figures (37 % after 30 s, about 52 s left)",
        "Load2: aligning (49 % after 40 s, about 42 s left)",
        "report: writing (98 % after 45 s, about 1 s left)",
        "finished after 47 s",
    ]


def test_the_share_never_falls_though_the_time_left_may_rise(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with progress.live() as told:
        progress.expect(told, {"Load1": Expected.of(PARTS)})
        for second, stage in ((10, "aligning"), (150, "registering")):
            clock[0] = 1000.0 + second
            told("Load1", stage, 1.0 if stage == "aligning" else 0.55)
    assert capsys.readouterr().err.splitlines()[1:3] == [
        "Load1: aligning (63 % after 10 s, about 6 s left)",
        "Load1: registering (63 % after 2 min, about 2 min left)",  # 55 % of the time
    ]
    file = io.StringIO()
    with progress.live(console=Console(file=file, force_terminal=True, width=100, height=24)) as told:
        told("all", "working", 0.6)
        told("all", "working", 0.3)
        wait_for(lambda: "%" in " ".join(screen(file.getvalue(), 24)))
        assert " 60 %" in " ".join(screen(file.getvalue(), 24))


def test_in_a_terminal_it_has_one_bar() -> None:
    file = io.StringIO()
    with progress.live(console=Console(file=file, force_terminal=True, width=100, height=24)) as told:
        progress.expect(told, LOADS, 2)
        for case in ("Load1", "Load2"):
            told(case, "aligning", 1.0)
            told(case, "registering", 0.5)
        wait_for(lambda: "registering" in " ".join(screen(file.getvalue(), 24)))
        shown = screen(file.getvalue(), 24)
    assert len(shown) == 1
    assert shown[0].startswith("Load1: registering; Load2: registering")


def test_a_whole_that_is_silent_is_told_all_the_same_and_one_that_failed_is_not_called_finished(monkeypatch) -> None:
    monkeypatch.setattr(progress, "_TOLD_EVERY_S", 0.01)
    shown: list[tuple[str, str, float]] = []
    whole = progress.Live(lambda *one: shown.append(one), lambda *_: None, time.monotonic())
    whole.expect(LOADS, 1)
    whole("Load1", "aligning", 0.0)
    wait_for(lambda: len(shown) > 5)
    assert {one[:2] for one in shown} == {("all", "starting"), ("all", "Load1: aligning")}
    whole.stop()
    monkeypatch.undo()
    failed = pytest.raises(ValueError, match="no")
    with failed, progress.live() as told:
        progress.expect(told, LOADS)
        raise ValueError("no")


def test_what_takes_longer_than_expected_is_never_called_done(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with progress.live() as told:
        for second, fraction in ((0, 0.0), (20, 0.98), (40, 0.999), (200, 0.9999), (300, 1.0)):
            clock[0] = 1000.0 + second
            told("mesh", "meshing", fraction)
    assert capsys.readouterr().err.splitlines() == [
        "mesh: meshing 0 % after 0 s",
        "mesh: meshing 98 % after 20 s",
        "mesh: meshing 99 % after 40 s",
        "mesh: meshing 99 % after 200 s, 2 s left",
        "mesh: meshing 100 % after 300 s",
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
        "Load2: aligning 50 % after 0 s",
        "Load1: registering 40 % after 20 s, 30 s left",
    ]


@pytest.mark.parametrize("of_all", [False, True])
def test_a_note_is_shown_at_once_and_in_one_line(of_all: bool, capsys: pytest.CaptureFixture[str]) -> None:
    words = "From the record of results: " + "--labels " + "a folder/" * 20
    with progress.live(of_all=of_all) as told:
        told(progress.NOTE, words, 0.0)
        assert capsys.readouterr().err == f"{words}\n"
    screen = io.StringIO()
    with progress.live(of_all=of_all, console=Console(file=screen, force_terminal=True, width=80)) as told:
        told(progress.NOTE, words, 0.0)
        told("Load1", "registering", 0.5)
    assert f"{words}\n" in screen.getvalue()
    assert "note" not in screen.getvalue()


def test_of_many_stages_a_pipe_gets_a_line_for_each_that_ended_with_the_time_left(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with progress.live(of_all=True) as told:
        told("all", "0 of 40 stages", 0.0)
        for second in range(121):  # two minutes of a stage that tells every second
            clock[0] = 1000.0 + second
            told("Ada: register Load1", "registering", second / 200)
            told("all", "0 of 40 stages", second / 240)
        told("Ada: register Load1", "max. shear in fat 0.131 median; Trust", 1.0)
        told("all", "1 of 40 stages", 0.5)
        told("all", "2 of 40 stages", 0.6)  # there already
        clock[0] = 1180.0
        told("Ben: mesh", "35,000 tetrahedra", 1.0)
        told("all", "40 of 40 stages", 0.999)
        told("all", "40 of 40 stages", 1.0)
    lines = capsys.readouterr()
    assert lines.out == ""
    assert lines.err.splitlines() == [
        "progress: 0 of 40 stages after 60 s, about 3 min left; running: Ada: register Load1 30 %",
        "progress: 0 of 40 stages after 2 min, about 2 min left; running: Ada: register Load1 60 %",
        "Ada: register Load1: max. shear in fat 0.131 median; Trust (1 of 40 stages after 2 min, about 2 min left)",
        "Ben: mesh: 35,000 tetrahedra (40 of 40 stages after 3 min)",
        "finished after 3 min: 40 of 40 stages",
    ]


def screen(written: str, lines: int) -> list[str]:
    """What a terminal of some lines shows at last: the text of the last picture drawn, without its codes."""
    last = re.split(r"\x1b\[1A\x1b\[2K(?!\x1b\[1A)|\x1b\[2K", written)[-1]
    shown = [line.strip() for line in re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", last).splitlines()]
    return [line for line in shown if line][-lines:]


def test_thirty_ended_stages_do_not_push_the_running_one_off_the_screen() -> None:
    file = io.StringIO()
    console = Console(file=file, force_terminal=True, width=100, height=24)
    with progress.live(of_all=True, console=console) as told:
        wait_for(lambda: screen(file.getvalue(), 24) != [])  # drawn ten times a second, by a thread
        begun = screen(file.getvalue(), 24)
        assert len(begun) == 1
        assert begun[0].startswith("all")
        for number in range(30):
            told(f"simulate set-{number}", "Load1", 0.5)
            told(f"simulate set-{number}", f"plate displacement [{number}] mm", 1.0)
            told("all", "40 stages", (number + 1) / 40)
        told("register Load4", "registering", 0.25)
        wait_for(lambda: "25 %" in screen(file.getvalue(), 24)[-1])
        shown = screen(file.getvalue(), 24)
    assert [line.split("%")[0].split()[0] for line in shown] == ["all:", "register"]
    assert "75 %" in shown[0]
    assert "left" in shown[0]
    assert "25 %" in shown[1]
    for number in range(30):  # above the bars, once each
        assert file.getvalue().count(f"simulate set-{number}: plate displacement [{number}] mm") == 1


@pytest.mark.parametrize(("of_all", "end"), [(False, "kept."), (True, "kept. The same command resumes.")])
def test_an_interrupt_is_told_with_how_to_go_on(of_all: bool, end: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyboardInterrupt), progress.live(of_all=of_all):
        raise KeyboardInterrupt
    assert capsys.readouterr().err.splitlines() == [f"Interrupted. Finished results are {end}"]
