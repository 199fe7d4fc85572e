"""The time left of a run: replayed on recorded runs, right within a factor of two after the first tenth.

Left out of every replay are the last 3 % of a run (4 s of the shortest, 29 s of the longest), in which a few seconds
are a factor of two, and the writing of the report after the last stage (6 to 8 s), which no estimate counts. Runs in
which it is not right all the time have tests of their own, which say for how much of the time it is.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from mrstrain.records.time_left import FAILED, Expected, Pace, TimeLeft, seconds_to_end
from mrstrain.studies import costs
from mrstrain.studies.file import read_study
from mrstrain.studies.plan import plan

ROOT = Path(__file__).resolve().parents[3]
LOADS = tuple(f"register Load{n}" for n in (1, 2, 3, 4))
# When each of these stages began and ended, seconds, on two workers. Begins are ends less the whole seconds taken, and
# are one second later where three stages would be under way at once.
STAGES = (
    "register repeat", "mesh", *LOADS, "simulate trebbi", "simulate erdemir", "simulate akrami", "simulate luboz",
    "simulate spears", "simulate zwam", "compare",
)  # fmt: skip
FULL_SETS = STAGES[-4:-1]
# Full demonstrations with six sets, and demonstrations with three, of the program of November 2026 on idle cores.
RECORDED = {
    "full, 1": "1-21 1-47 21-44 69-95 304-329 44-69 131-190 359-405 96-131 190-304 47-218 305-359 405-468",
    "full, 2": "2-21 1-50 21-43 67-91 342-364 44-67 126-195 400-455 91-126 195-342 51-238 343-400 455-520",
    "full, 3": "1-20 0-52 20-42 294-317 66-89 43-66 128-184 295-348 90-127 184-294 53-187 347-397 397-462",
    "full, 4": "1-20 1-48 20-42 276-300 65-87 42-65 138-191 225-275 191-225 191-353 48-164 88-138 354-417",
    "full, long spears": "1-19 1-45 20-41 244-270 64-87 41-64 191-244 318-365 365-394 88-191 45-365 270-318 395-455",
    "full, long luboz": "1-35 1-47 35-57 79-102 357-379 57-79 102-158 405-457 407-445 158-356 47-198 357-406 458-520",
    "1": "0-18 1-25 19-39 61-83 47-70 39-61 25-46 70-89 89-101 101-131",
    "2": "1-35 1-24 35-57 81-105 76-100 57-81 24-55 55-75 100-113 114-147",
    "3": "1-24 1-31 24-48 76-103 74-100 49-74 31-54 54-76 100-115 115-147",
    "4": "1-21 1-23 21-45 71-99 68-94 45-71 23-46 46-68 94-110 111-146",
    "5": "1-21 2-26 22-45 70-96 80-105 45-70 26-54 54-80 97-113 112-147",
    "6": "2-26 2-32 26-49 71-96 75-100 49-71 32-55 55-75 96-109 109-139",
    "7": "2-21 2-25 21-43 67-91 71-95 44-67 25-49 49-71 92-106 106-138",
    "8": "2-40 2-25 40-64 80-107 88-114 64-88 25-58 59-80 107-122 122-157",
    "9": "1-19 1-23 20-41 64-88 69-92 41-64 23-47 47-69 88-103 104-136",
    # With an earlier program, whose registrations take three times as long, the comparison twice.
    "full, slower program": (
        "1-56 1-59 56-130 212-295 276-356 131-212 59-187 551-640 295-353 354-550 549-736 187-276 737-857"
    ),
    "full, slower program, again": (
        "1-91 1-54 91-173 255-339 777-848 173-254 54-168 339-428 755-809 258-482 428-755 168-257 847-966"
    ),
    "beside others at first": "3-81 2-57 81-112 144-173 149-174 112-149 58-115 115-144 173-186 187-245",
}
NO_EQUILIBRIUM = "0-32 0-23 32-53 73-98 75-98 53-75 23-53 53-73 98-179 179-211"  # akrami takes five times as long
# Runs of a still earlier program with what it expected: on idle cores, beside another program, and among many.
SIMULATED = tuple(f"simulate {name}" for name in ("trebbi", "luboz", "akrami"))
EXPECTED = {
    "register repeat": Expected(50.8, kind="register"),
    **{name: Expected(50.8, 1, ("register repeat",), "register") for name in LOADS},
    "mesh": Expected(25.0, kind="mesh"),
    **{name: Expected(s, 1, ("mesh",), "simulate") for name, s in zip(SIMULATED, (75.1, 74.9, 17.4), strict=True)},
    "compare": Expected(40.0, 2, (*LOADS, *SIMULATED), "compare"),
}
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


Run = dict[str, tuple[int, int]]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [0.0]
    monkeypatch.setattr("mrstrain.records.time_left.time.monotonic", lambda: now[0])
    return now


@pytest.fixture
def recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Gives a recorded run and what `costs.expected` says of it, on two cores."""
    monkeypatch.setattr(costs, "usable_cores", lambda: 2)

    def read(text: str) -> tuple[Run, dict[str, Expected]]:
        times = [tuple(map(int, one.split("-"))) for one in text.split()]
        full = len(times) == len(STAGES)
        run = dict(zip([name for name in STAGES if full or name not in FULL_SETS], times, strict=True))
        study = (ROOT / "benchmarks/full_six_sets.toml").read_text()
        (tmp_path / "study.toml").write_text(study if full else study.replace(', "luboz", "spears", "zwam"]', "]"))
        told = read_study(tmp_path)
        cells = 83.1e3 if full else 33.1e3  # as `costs.sizes_of` has it with edges of 2.8 and 4 mm
        expected = costs.expected(plan(told), told, 2_328_480.0, cells)
        assert {*expected} == {*run}
        return run, expected

    return read


def replayed(run: Run, clock: list[float], expected: dict[str, Expected], slower: int):
    """The time that was left at every second of the record, and what was told, on a machine so much slower."""
    left, end = TimeLeft(expected, 2), max(ended for _, ended in run.values())
    for second in range(end):
        clock[0] = float(slower * second)
        for name, (began, ended) in run.items():
            if second == began:
                left.begin(name)
            if second == ended:
                left.end(name)
        yield end - second, left.seconds() / slower


def ratios(run: Run, clock: list[float], expected: dict[str, Expected] = EXPECTED, slower: int = 1) -> list[float]:
    """What was told over what was left, from the first tenth on; the last 3 % of the run are over in a moment."""
    end = max(ended for _, ended in run.values())
    told = [told / true for true, told in replayed(run, clock, expected, slower) if 0.03 * end <= true <= 0.9 * end]
    assert len(told) > 100
    return told


@pytest.mark.parametrize("name", RECORDED)
def test_the_time_left_is_right_within_a_factor_of_two_from_the_first_tenth_on(name: str, clock, recorded) -> None:
    run, expected = recorded(RECORDED[name])
    told = ratios(run, clock, expected)
    assert 0.5 <= min(told) <= max(told) <= 2.0


@pytest.mark.parametrize("name", ["idle", "beside another"])
def test_so_it_was_for_an_earlier_program_with_other_expectations(name: str, clock: list[float]) -> None:
    told = ratios(RUNS[name], clock)
    assert 0.5 <= min(told) <= max(told) <= 2.0


def test_on_a_busy_machine_it_is_so_for_nine_tenths_of_the_time(clock: list[float]) -> None:
    told = ratios(RUNS["busy"], clock)
    assert sum(0.5 <= one <= 2.0 for one in told) > 0.9 * len(told)
    assert min(told) > 0.5  # never too soon


def test_where_a_simulation_finds_no_equilibrium_it_is_so_for_two_thirds_of_the_time(clock, recorded) -> None:
    run, expected = recorded(NO_EQUILIBRIUM)
    told = ratios(run, clock, expected)
    assert sum(0.5 <= one <= 2.0 for one in told) > len(told) / 1.5
    assert 0.3 < min(told) < 0.5  # too soon: nobody foresees it


def test_it_would_not_be_right_without_what_the_stages_took(clock: list[float], monkeypatch) -> None:
    monkeypatch.setattr(Pace, "of", lambda self, stage: 1.0)
    assert min(ratios(RUNS["busy"], clock)) < 0.5
    assert max(ratios(RUNS["idle"], clock)) > 2.0


@pytest.mark.parametrize("slower", [3, 10, 30])
def test_a_machine_of_another_speed_is_found_out_by_the_first_stages(slower: int, clock: list[float]) -> None:
    told = ratios(RUNS["idle"], clock, slower=slower)
    assert 0.5 <= min(told) <= max(told) <= 2.0


@pytest.mark.parametrize("slower", [3, 10, 30])
@pytest.mark.parametrize("name", RECORDED)
def test_so_it_is_on_all_recorded_runs_but_for_the_first_seconds(name: str, slower: int, clock, recorded) -> None:
    run, expected = recorded(RECORDED[name])
    told = ratios(run, clock, expected, slower)
    assert max(told) <= 2.0
    assert min(told) > 0.45  # where no stage has ended after the first tenth
    assert min(told[len(told) // 20 :]) >= 0.5


def test_fast_registrations_promise_no_fast_simulations_but_a_fast_machine_does(clock: list[float]) -> None:
    one, other = Expected(50.0, kind="register"), Expected(50.0, kind="simulate")
    pace = Pace()
    assert pace.of(one) == pace.of(other) == 1.0
    for _ in range(8):
        pace.add(one, 20.0)
    assert pace.of(other) < 0.5  # nothing of it has ended: as all
    for _ in range(8):
        pace.add(other, 50.0)
    assert pace.of(one) == pytest.approx(0.45, abs=0.05)
    assert pace.of(other) == pytest.approx(0.95, abs=0.05)


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
    assert left._pace({}).of(Expected(10.0)) == 1.0


def test_a_stage_that_tells_how_far_it_is_needs_no_end_to_correct_the_pace(clock: list[float]) -> None:
    parts = {"aligning": 10.0, "registering": 30.0, "strain and figures": 10.0}
    one = Expected.of(parts, kind="register")
    assert one.seconds == 50.0
    assert one.share("registering", 0.5) == 0.5
    assert one.share("registering", 1.0) == 0.8
    assert one.share("strain and figures", 1.0) == one.share(FAILED, 1.0) == 1.0
    assert one.share("reading", 1.0) == 0.0  # unknown
    assert Expected(5.0).share("simulating", 0.3) == 0.3
    left = TimeLeft.of_command({"Load1": one, "Load2": one}, 1, 1.5)
    for second, part, fraction in ((0.0, "aligning", 0.0), (30.0, "aligning", 1.0), (30.0, "registering", 0.0)):
        clock[0] = second
        left.told("Load1", part, fraction)
    # a third as fast, (T + 31.5) / (T + 11.5) with T = 10 s and the start; then once more for the kind, with 5.3 T
    assert left.seconds() == pytest.approx(90.0 * (53.3 * 41.5 / 21.5 + 30.0) / (53.3 + 10.0), rel=0.001)
    clock[0] = 1e4  # silent for long
    assert left.seconds() > 2e3
    for case in ("Load1", "Load2", "Load3"):
        left.told(case, FAILED, 1.0)
    assert left.seconds() == 0.0


def test_the_reading_of_large_images_is_no_sign_of_a_slow_machine(clock: list[float]) -> None:
    loads = {"Load1": Expected(100.0)}
    usual, large = TimeLeft.of_command(loads, 1, 1.5), TimeLeft.of_command(loads, 1, 9.5, reading_s=8.0)
    assert usual.seconds() == large.seconds() == pytest.approx(100.0)
    assert TimeLeft.of_command(loads, 1, 9.5).seconds() > 110.0
