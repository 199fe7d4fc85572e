"""Loads that a larger one passes: which they are, that they are solved once, and what becomes of it if they fail."""

from pathlib import Path

import numpy as np
import pytest

import fe
import mrstrain
from fe import LoadStep, Plate, Problem, problems_of
from mrstrain.models.simulate import LOADS as PUBLISHED
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
    assert passed([SMALL, LARGE], {"small": PLATE, "large": tilted}) == {"small": [], "large": []}


def test_passed_loads_are_solved_once_with_the_same_bits() -> None:
    loads, mesh = [LARGE, SMALL, SHEARED], dome((3, 5, 5))
    heard, alone = Notebook(), Notebook()
    together = fe.simulate(mesh, LAWS, PLATE, loads, observer=heard)
    assert [state.load.name for state in together.states] == ["large", "small", "sheared"]
    (first,) = fe.solve(problems_of(mesh, LAWS, PLATE, loads)[0], observer=alone)  # solves what it passes by itself
    state = together.state("large")
    assert np.array_equal(state.u_mm, first.u_mm)
    assert (state.iterations, len(state.curve)) == (first.iterations, len(first.curve))
    assert alone.lines[-1] == heard.lines[-1]
    moved = sum(line.startswith("moved") for line in heard.lines)
    assert moved == sum(line.startswith("moved") for line in alone.lines)  # the plate comes near only once
    assert {name for name, _ in alone.increments} == {"large"}


def test_a_load_that_passes_another_is_that_load_from_its_start() -> None:
    mesh = dome((4, 6, 6))
    alone, after = (fe.simulate(mesh, LAWS, PLATE, loads).state("large") for loads in ([LARGE], [SMALL, LARGE]))
    assert after.reached == 1.0
    assert after.curve[0].force_n.tolist() == [0.0] * 3
    assert np.diff([plate.force_n[0] for plate in after.curve]).min() > 0.0
    assert np.abs(after.u_mm - alone.u_mm).max() < 2e-3 * np.abs(alone.u_mm).max()


def test_what_passes_a_load_that_is_not_reached_is_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    solved: list[str] = []
    solve = fe.simulation.solve

    def counted(problem: Problem, *given):
        solved.append(problem.loads[0].name)
        return solve(problem, *given)

    monkeypatch.setattr("fe.simulation.solve", counted)
    weak = {"skin": fe.NeoHooke.of(0.067, nu=0.495), "fat": fe.NeoHooke.of(0.01, nu=0.49)}
    done = fe.simulate(dome((3, 4, 4)), weak, PLATE, [LoadStep("most", 4000.0), LoadStep("much", 3000.0)])
    assert solved == ["much"]
    assert [state.load.name for state in done.states] == ["much"]
    assert "most was not tried: the previous load was not reached." in done.notes


@pytest.mark.usefixtures("in_this_process")
def test_the_command_solves_them_once_on_one_core_and_gives_the_same_on_two(tmp_path: Path) -> None:
    fe.write_tet_mesh(tmp_path / "dome.vtu", dome((3, 5, 5)), {})
    states = []
    for workers in (1, 2):
        out = tmp_path / f"on {workers}"
        made = mrstrain.simulate(
            tmp_path / "dome.vtu", sets=["trebbi"], loads=[LARGE, SMALL, SHEARED], plate_normal=DOWN,
            shear_direction=ALONG, out=out, workers=workers, threads=1,
        )  # fmt: skip
        states.append(made.sets[0].state("large").u_mm)
        log = (out / "trebbi" / "log-large.txt").read_text()
        assert workers == 2 or log.startswith("small: resumed at 100%")
    assert np.array_equal(*states)


def test_nodes_touch_in_the_order_of_small_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Force-controlled steps by a quarter of the load put nodes on the tape that small steps do not."""
    loads, soft = [LoadStep("small", 0.8)], {"skin": FAT, "fat": FAT}
    mesh = dome((4, 12, 12))

    def nodes() -> set[int]:
        return set(fe.simulate(mesh, soft, PLATE, loads).states[0].on_plate.tolist())

    plain = nodes()
    with monkeypatch.context() as fine:
        fine.setattr("fe.load_path._MOST_APPROACH_MM", 0.05)
        fine.setattr("fe.load_path._APPROACH_MM", 0.05)
        fine.setattr("fe.load_path._ENOUGH", (0.98,))
        fine.setattr("fe.load_path._AIM", 0.99)
        small = nodes()
    with monkeypatch.context() as coarse:
        coarse.setattr("fe.load_path._ENOUGH", (0.2,))
        large = nodes()
    assert len(plain ^ small) < 0.5 * len(large ^ small)
