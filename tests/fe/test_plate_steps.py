"""Steps of the plate: it touches the nodes that it would touch in small steps, and stops at the largest force."""

import numpy as np
import pytest

from dvc import TetMesh
from fe import LoadStep, NeoHooke, Ogden
from fe.load_path import LoadPath
from tests.fe.test_simulate import FAT, LAWS, dome, press


def test_halved_steps_put_the_tape_in_the_same_places(monkeypatch: pytest.MonkeyPatch) -> None:
    soft = {"skin": FAT, "fat": FAT}
    loads = [LoadStep("pressed", 4.0)]
    plain = press(dome((3, 7, 7)), loads, soft)[0]
    monkeypatch.setattr("fe.load_path._FIRST_MM", (0.1, 0.1))
    monkeypatch.setattr("fe.load_path._MOST_MM", (0.1, 0.1))
    monkeypatch.setattr("fe.load_path._FIRST_STEP", 0.05)
    monkeypatch.setattr("fe.load_path._GROWTH", 1.0)
    small = press(dome((3, 7, 7)), loads, soft)[0]
    assert len(small.curve) > 2 * len(plain.curve)
    assert plain.plate_displacement_mm[0] == pytest.approx(small.plate_displacement_mm[0], rel=0.005)
    assert np.abs(plain.u_mm - small.u_mm).max() < 0.06


def test_the_longest_steps_of_the_plate_are_as_good_as_small_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four times the dome, so that the plate moves by 6.4 mm; steps of 2 mm are off by 0.19 mm."""
    small, soft = dome((4, 10, 10)), {"skin": FAT, "fat": FAT}
    mesh = TetMesh(4.0 * small.points_mm, small.cells, small.regions, small.facets)
    plain = press(mesh, [LoadStep("pressed", 30.0)], soft)[0]
    moved = np.diff([plate.displacement_mm[0] for plate in plain.curve])
    assert moved.max() == pytest.approx(1.0)
    monkeypatch.setattr("fe.load_path._FIRST_MM", (0.1, 0.1))
    monkeypatch.setattr("fe.load_path._MOST_MM", (0.1, 0.1))
    fine = press(mesh, [LoadStep("pressed", 30.0)], soft)[0]
    assert set(plain.on_plate) == set(fine.on_plate)
    assert np.abs(plain.u_mm - fine.u_mm).max() < 0.08


def test_a_sheared_plate_touches_the_nodes_that_it_would_in_small_steps(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first step of the shear force alone used to move a plate on soft tissue by 5 mm."""

    def touched() -> set[int]:
        laws = {"skin": NeoHooke.of(0.1, nu=0.49), "fat": NeoHooke.of(0.02, nu=0.49)}
        return {*press(dome((3, 9, 9)), [LoadStep("pressed", 4.0), LoadStep("sheared", 4.0, 2.0)], laws)[1].on_plate}

    plain = touched()
    with monkeypatch.context() as fine:
        fine.setattr("fe.load_path._FIRST_MM", (0.25, 0.3))
        fine.setattr("fe.load_path._MOST_MM", (1.0, 0.3))
        assert touched() == plain
    monkeypatch.setattr("fe.load_path.LoadPath.shear", LoadPath.raise_to)
    assert len(touched() ^ plain) > 1


def test_a_shear_force_beyond_the_largest_leaves_the_state_before_it() -> None:
    """A plate that is displaced passes the largest force that the tissue carries, and would end far beyond it."""
    soft = {region: Ogden.from_ansys(0.0034, 0.3) for region in LAWS}
    before, beyond = press(dome((3, 5, 5)), [LoadStep("pressed", 1.0), LoadStep("beyond", 1.0, 2.5)], soft)
    assert before.reached == 1.0
    assert 0.03 < beyond.reached < 1.0
    forces = [plate.force_n[1] for plate in beyond.curve]
    assert forces == sorted(forces)


@pytest.mark.parametrize(
    "loads",
    [
        [LoadStep("once", 1.0), LoadStep("again", 1.0)],
        [LoadStep("sheared", 2.0, 2.0), LoadStep("less", 2.0, 0.5)],
        [LoadStep("left", 2.0, -1.0), LoadStep("more", 2.0, -2.0)],
    ],
)
def test_loads_without_more_shear_are_reached_too(loads: list[LoadStep]) -> None:
    for state in press(dome((3, 5, 5)), loads):
        assert state.reached == 1.0
        assert state.force_n == pytest.approx([state.load.normal_n, state.load.shear_n or 0.0, 0.0], abs=4e-3)
