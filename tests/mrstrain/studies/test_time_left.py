"""The time left of a run: replayed on recorded runs of the demonstration, right within a factor of two."""

from __future__ import annotations

import pytest

from mrstrain.studies.time_left import Expected, TimeLeft, seconds_to_end

LOADS = tuple(f"register Load{n}" for n in (1, 2, 3, 4))
SIMULATED = tuple(f"simulate {name}" for name in ("trebbi", "luboz", "akrami"))
# As `costs.expected` has it for the demonstration on two cores.
EXPECTED = {
    "register repeat": Expected(50.8),
    **{name: Expected(50.8, before=("register repeat",)) for name in LOADS},
    "mesh": Expected(25.0),
    **{name: Expected(s, before=("mesh",)) for name, s in zip(SIMULATED, (75.1, 74.9, 17.4), strict=True)},
    "compare": Expected(40.0, 2, (*LOADS, *SIMULATED)),
}
# When each stage began and ended, seconds: on two cores that were idle, beside another program, and among many.
RUNS = {
    "idle": {
        "mesh": (1, 19), "register repeat": (1, 27), "simulate trebbi": (19, 45), "register Load1": (27, 59),
        "simulate luboz": (45, 93), "register Load4": (59, 93), "register Load3": (93, 127),
        "register Load2": (92, 129), "simulate akrami": (128, 142), "compare": (143, 169),
    },
    "beside another": {
        "mesh": (1, 26), "register repeat": (2, 41), "simulate trebbi": (26, 65), "register Load1": (40, 76),
        "register Load4": (76, 112), "register Load2": (112, 149), "simulate luboz": (65, 157),
        "register Load3": (150, 181), "simulate akrami": (181, 196), "compare": (196, 225),
    },
    "busy": {
        "mesh": (2, 91), "register repeat": (1, 150), "simulate trebbi": (92, 205), "register Load1": (150, 288),
        "simulate luboz": (205, 383), "register Load4": (288, 415), "simulate akrami": (383, 416),
        "register Load3": (416, 495), "register Load2": (415, 497), "compare": (498, 553),
    },
}  # fmt: skip


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr("mrstrain.studies.time_left.time.monotonic", lambda: now[0])
    return now


def replayed(run: dict[str, tuple[int, int]], clock: list[float], expected: dict[str, Expected] = EXPECTED):
    """The time that was left at every second, and what was told."""
    left, end = TimeLeft(expected, 2), max(ended for _, ended in run.values())
    for second in range(end):
        clock[0] = float(second)
        for name, (began, ended) in run.items():
            if second == began:
                left.begin(name)
            if second == ended:
                left.end(name)
        yield end - second, left.seconds()


def ratios(run: dict[str, tuple[int, int]], clock: list[float], **given) -> list[float]:
    """What was told over what was left, from the first tenth on; the last 3 % of the run are over in a moment."""
    end = max(ended for _, ended in run.values())
    return [told / true for true, told in replayed(run, clock, **given) if 0.03 * end <= true <= 0.9 * end]


@pytest.mark.parametrize("name", ["idle", "beside another"])
def test_the_time_left_is_right_within_a_factor_of_two_from_the_first_tenth_on(name: str, clock: list[float]) -> None:
    told = ratios(RUNS[name], clock)
    assert len(told) > 100
    assert 0.5 <= min(told) <= max(told) <= 2.0


def test_on_a_busy_machine_it_is_so_for_nine_tenths_of_the_time(clock: list[float]) -> None:
    told = ratios(RUNS["busy"], clock)
    assert sum(0.5 <= one <= 2.0 for one in told) > 0.9 * len(told)
    assert min(told) > 0.5  # never too soon


def test_it_would_not_be_right_without_what_the_stages_took(clock: list[float], monkeypatch) -> None:
    monkeypatch.setattr(TimeLeft, "_pace", lambda self, spent: 1.0)
    assert min(ratios(RUNS["busy"], clock)) < 0.5
    assert max(ratios(RUNS["idle"], clock)) > 2.0


@pytest.mark.parametrize("slower", [3, 10, 30])
def test_a_machine_of_another_speed_is_found_out_by_the_first_stages(slower: int, clock: list[float]) -> None:
    slow = {name: (slower * began, slower * ended) for name, (began, ended) in RUNS["idle"].items()}
    told = ratios(slow, clock)
    assert 0.5 <= min(told) <= max(told) <= 2.0


def test_what_waits_and_what_shares_no_core_count_one_after_another(clock: list[float]) -> None:
    row = {"a": Expected(10.0), "b": Expected(20.0, before=("a",)), "c": Expected(30.0, before=("b",))}
    assert seconds_to_end(row) == {"a": 60.0, "b": 50.0, "c": 30.0}
    assert TimeLeft(row, 8).seconds() == 60.0
    apart = {name: Expected(10.0) for name in "abcd"}
    assert TimeLeft(apart, 2).seconds() == 20.0
    left = TimeLeft(apart, 4)
    for name in "abcd":
        left.begin(name)
    clock[0] = 4.0
    assert left.seconds() == 6.0
    clock[0] = 12.0  # longer than was expected: a quarter of what it took, or as those that ended
    assert left.seconds() == pytest.approx(0.25 * 12.0, rel=0.2)
    for name in "abcd":
        left.end(name)
    assert (left.seconds(), left.under_way) == (0.0, [])
    alone = TimeLeft({"compare": Expected(10.0, cores=4)}, 4)
    assert alone.seconds() == 10.0  # all cores, together


def test_what_never_began_ends_without_a_time(clock: list[float]) -> None:
    left = TimeLeft({"a": Expected(10.0), "b": Expected(10.0)}, 1)
    left.begin("a")
    clock[0] = 10.0
    left.end("a")
    left.end("b")  # as it waited for one that failed
    assert left.seconds() == 0.0
    assert left._pace({}) == 1.0
