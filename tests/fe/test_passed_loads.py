"""Loads that a larger one passes: which they are, that they are solved once, and what becomes of it if they fail."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fe
import mrstrain
from dvc.errors import InputError, WorkerError
from fe import LoadStep, Plate, Problem, problems_of
from fe.simulation_files import ENDING, fingerprint, read_checkpoint, write_checkpoint
from mrstrain.models.simulate import LOADS as PUBLISHED, solve_in_folder
from tests.fe.solving import Notebook
from tests.fe.test_simulate import ALONG, DOWN, FAT, LAWS, dome

PLATE = Plate(DOWN, ALONG)
SMALL, LARGE, SHEARED = LoadStep("small", 1.0), LoadStep("large", 2.5), LoadStep("sheared", 1.0, 0.5)


def passed(loads: list[LoadStep], plate=PLATE) -> dict[str, list[str]]:
    problems = problems_of(dome((3, 4, 4)), LAWS, plate, loads)
    return {problem.loads[0].name: [load.name for load in problem.passed] for problem in problems}


def test_a_load_passes_smaller_ones_without_shear() -> None:
    assert passed(list(PUBLISHED)) == {"Load1": ["Load2"], "Load2": []}
    assert passed([LARGE, LoadStep("middle", 2.0), SHEARED, SMALL]) == {
        "large": ["small", "middle"], "middle": ["small"], "small": [],
    }  # fmt: skip
    assert passed([LARGE, SHEARED]) == {"large": [], "sheared": []}  # nothing passes a sheared state


def test_a_load_passes_only_loads_of_an_equal_plate() -> None:
    assert passed([LARGE, SMALL, LoadStep("in", normal_mm=1.5)]) == {"large": ["small"], "small": [], "in": []}
    assert passed([SMALL, LARGE], Plate(DOWN, ALONG, turns=True)) == {"small": [], "large": []}
    tilted = Plate([-1.0, 0.1, 0.0], ALONG)
    aside = Plate(DOWN, ALONG, pivot_mm=[0.0, 5.0, 5.0])
    for other in (tilted, aside):
        assert passed([SMALL, LARGE], {"small": PLATE, "large": other}) == {"small": [], "large": []}
    assert passed([SMALL, LoadStep("twin", 1.0), LARGE])["large"] == ["small"]  # the first of its path


@pytest.mark.parametrize(
    ("those", "plate", "why"),
    [
        ([SHEARED], PLATE, "cannot include sheared as an intermediate state: sheared has shear"),
        (
            [LoadStep("in", normal_mm=0.5)],
            PLATE,
            "cannot include in as an intermediate state: in has shear, or one",
        ),
        ([LoadStep("equal", 2.5)], PLATE, "equal is not smaller than large"),
        ([LoadStep("large", 1.0)], PLATE, "Two loads are named 'large'"),
        ([LoadStep("middle", 2.0), SMALL], PLATE, "middle is not smaller than small"),
        ([LoadStep("pulled", -1.0)], PLATE, "must be above 0 N"),
        ([SMALL], Plate(DOWN, ALONG, turns=True), "its plate rotates"),
    ],
)
def test_loads_that_cannot_be_passed_are_refused(those, plate, why) -> None:
    with pytest.raises(InputError, match=why):
        Problem(dome((3, 4, 4)), LAWS, plate, [LARGE], passed=those)


def test_passed_loads_are_solved_once_with_the_same_bits() -> None:
    loads, mesh = [LARGE, SHEARED, SMALL], dome((3, 5, 5))
    heard, alone = Notebook(), Notebook()
    together = fe.simulate(mesh, LAWS, PLATE, loads, observer=heard)
    assert [state.load.name for state in together.states] == [load.name for load in loads]  # as asked for
    (first,) = fe.solve(problems_of(mesh, LAWS, PLATE, loads)[0], observer=alone)  # solves what it passes by itself
    state = together.state("large")
    assert np.array_equal(state.u_mm, first.u_mm)
    assert (state.iterations, len(state.curve)) == (first.iterations, len(first.curve))
    assert alone.lines[-1] == heard.lines[-1]
    moved = sum(line.startswith("moved") for line in heard.lines)
    assert moved == sum(line.startswith("moved") for line in alone.lines)  # the plate comes near only once
    assert {name for name, _ in alone.increments} == {"large"}


def test_a_path_hands_its_memory_back_before_the_next_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    happened: list[str] = []
    solve = fe.solution.solve

    def noted(problem: Problem, *given):
        happened.append(problem.loads[0].name)
        return solve(problem, *given)

    monkeypatch.setattr("fe.solution.solve", noted)
    monkeypatch.setattr("fe.solution.hand_memory_back", lambda: happened.append("handed back"))
    fe.simulate(dome((3, 4, 4)), LAWS, PLATE, [LARGE, SMALL])
    assert happened == ["small", "handed back", "large", "handed back"]


def test_a_load_that_passes_another_is_that_load_from_its_start() -> None:
    mesh = dome((4, 6, 6))
    alone, after = (fe.simulate(mesh, LAWS, PLATE, loads).state("large") for loads in ([LARGE], [SMALL, LARGE]))
    assert after.reached == 1.0
    assert after.curve[0].force_n.tolist() == [0.0] * 3
    assert np.diff([plate.force_n[0] for plate in after.curve]).min() > 0.0
    # the plate stops at other places, where one node of 17 touches that does not otherwise
    assert len(set(after.on_plate) ^ set(alone.on_plate)) <= 1
    assert np.abs(after.u_mm - alone.u_mm).max() < 3e-3 * np.abs(alone.u_mm).max()


def test_what_passes_a_load_that_is_not_reached_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    solved: list[str] = []
    solve = fe.solution.solve

    def counted(problem: Problem, *given):
        solved.append(problem.loads[0].name)
        return solve(problem, *given)

    monkeypatch.setattr("fe.solution.solve", counted)
    weak = {"skin": fe.NeoHooke.of(0.067, nu=0.495), "fat": fe.NeoHooke.of(0.01, nu=0.49)}
    done = fe.simulate(dome((3, 4, 4)), weak, PLATE, [LoadStep("most", 4000.0), LoadStep("much", 3000.0)])
    assert solved == ["much"]
    assert [state.load.name for state in done.states] == ["much"]
    assert "most was not tried: the load before it was not reached." in done.notes


def test_the_fraction_reached_is_that_of_the_whole_load() -> None:
    mesh, ticks = dome((3, 5, 5)), Notebook()
    problem = problems_of(mesh, LAWS, PLATE, [LARGE, SMALL])[0]
    (small,) = fe.solve(Problem(mesh, LAWS, PLATE, [SMALL]))
    (whole,) = fe.solve(problem, observer=ticks, earlier={"small": small.checkpoint})
    shares = [(at.reached, at.curve[-1].force_n[0] / LARGE.normal_n) for _, at in ticks.increments]
    assert len(shares) > 2
    assert all(reached == pytest.approx(force, abs=1e-3) for reached, force in shares)
    middle = ticks.increments[1][1]
    (again,) = fe.solve(problem, earlier={"large": middle})  # its own checkpoint is enough
    assert np.abs(again.u_mm - whole.u_mm).max() < 1e-3 * np.abs(whole.u_mm).max()


def test_an_incomplete_or_missing_file_of_a_passed_load_is_not_used(tmp_path: Path) -> None:
    mesh = dome((3, 5, 5))
    small, large = sorted(problems_of(mesh, LAWS, PLATE, [LARGE, SMALL]), key=lambda one: len(one.passed))
    states, share = [], tmp_path / "share"
    for name in ("alone", "shared", "begun"):
        (folder := tmp_path / name).mkdir()
        if name != "alone":
            solve_in_folder(small, fe.SolverOptions(), folder, share)
        if name == "begun":
            file, made_from = folder / f"small{ENDING}", fingerprint(small, SMALL)
            write_checkpoint(file, replace(read_checkpoint(file, made_from), reached=0.5), made_from)
        states += solve_in_folder(large, fe.SolverOptions(), folder, share)
        assert (folder / "log-large.txt").read_text().startswith("small: resumed") == (name == "shared")
    assert [state.load.name for state in states] == ["large"] * 3
    assert np.array_equal(states[0].u_mm, states[1].u_mm)
    assert np.array_equal(states[0].u_mm, states[2].u_mm)


@pytest.mark.usefixtures("in_this_process")
def test_the_command_solves_them_once_on_one_core(tmp_path: Path) -> None:
    fe.write_tet_mesh(tmp_path / "dome.vtu", dome((3, 5, 5)), {})
    made = mrstrain.simulate(
        tmp_path / "dome.vtu", sets=["trebbi"], loads=[LARGE, SMALL, SHEARED], plate_normal=DOWN,
        shear_direction=ALONG, out=tmp_path / "out", workers=1, threads=1,
    )  # fmt: skip
    assert [state.load.name for state in made.sets[0].states] == ["large", "small", "sheared"]
    assert (
        (tmp_path / "out" / "trebbi" / "log-large.txt")
        .read_text()
        .startswith("small: resumed from the checkpoint at 100 %")
    )


def test_nodes_touch_in_the_order_of_small_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of the force from a fifth of the load puts nodes on the tape that small steps do not."""
    loads, soft = [LoadStep("small", 0.8)], {"skin": FAT, "fat": FAT}
    mesh = dome((4, 12, 12))

    def nodes() -> set[int]:
        return set(fe.simulate(mesh, soft, PLATE, loads).states[0].on_plate.tolist())

    plain = nodes()
    with monkeypatch.context() as fine:
        fine.setattr("fe.load_path._FIRST_MM", (0.05, 0.05))
        fine.setattr("fe.load_path._MOST_MM", (0.05, 0.05))
        fine.setattr("fe.load_path._ENOUGH", 0.98)
        fine.setattr("fe.load_path._AIM", 0.99)
        small = nodes()
    with monkeypatch.context() as coarse:
        coarse.setattr("fe.load_path._ENOUGH", 0.2)
        large = nodes()
    assert len(plain ^ small) < 0.5 * len(large ^ small)


@pytest.mark.usefixtures("in_this_process")
def test_a_crash_after_a_passed_load_does_not_cost_the_larger_one(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def crashing(problem: Problem, *given):
        states = solve_in_folder(problem, *given)
        if problem.loads[0].name == "small":
            raise WorkerError("The process was killed.")
        return states

    monkeypatch.setattr("mrstrain.models.simulate.solve_in_folder", crashing)
    fe.write_tet_mesh(tmp_path / "dome.vtu", dome((3, 5, 5)), {})
    made = mrstrain.simulate(
        tmp_path / "dome.vtu", sets=["trebbi"], loads=[LARGE, SMALL, SHEARED], plate_normal=DOWN,
        shear_direction=ALONG, out=tmp_path / "out", workers=1, threads=1,
    )  # fmt: skip
    assert [state.load.name for state in made.sets[0].states] == ["large"]
    assert list(made.failures) == ["trebbi, small sheared"]
    assert not made.complete
