"""A plate that turns about its pivot: no moment there, rigid all the same, level where nothing turns it."""

import numpy as np
import pytest
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation

from dvc.errors import InputError
from dvc.mesh import TetMesh
from fe import LoadState, LoadStep, Plate, Tolerance
from tests.blocks import block
from tests.fe.solving import solved
from tests.fe.test_simulate import ALONG, DOWN, LAWS

EXACT = Tolerance(force=1e-9, step_mm=1e-8)
LOADS = [LoadStep("pressed", 2.0), LoadStep("sheared", 2.0, 1.0)]
MIDDLE = (0.0, 10.0, 10.0)


def made_of(box: TetMesh) -> TetMesh:
    fat = np.concatenate([box.regions[f"layer {k}"] for k in (1, 2, 3)])
    facets = {"bone": box.facets["x1"], "skin": box.facets["x0"]}
    return TetMesh(box.points_mm, box.cells, {"skin": box.regions["layer 0"], "fat": fat}, facets)


def wedge(slope: float = 0.0) -> TetMesh:
    """20 x 20 mm, 10 mm high in the middle; bone at x = 10."""
    mesh = made_of(block((4, 5, 5), (10.0, 20.0, 20.0), layers=4, wobble=0.15))
    points = mesh.points_mm.copy()
    points[:, 0] += slope * (points[:, 1] - 10.0) * (1.0 - points[:, 0] / 10.0)
    return TetMesh(points, mesh.cells, mesh.regions, mesh.facets)


def mirrored() -> TetMesh:
    """The same block, of which one half is the other's mirror image in y = 10."""
    half = made_of(block((4, 3, 4), (10.0, 10.0, 20.0), layers=4, wobble=0.15))
    count = len(half.points_mm)
    points = np.concatenate([half.points_mm, half.points_mm * [1.0, -1.0, 1.0] + [0.0, 20.0, 0.0]])
    other = np.where(np.isclose(half.points_mm[:, 1], 10.0), np.arange(count), count + np.arange(count))
    cells = np.concatenate([half.cells, other[half.cells[:, [0, 1, 3, 2]]]])
    used = np.unique(cells)
    number = np.zeros(len(points), dtype=int)
    number[used] = np.arange(len(used))
    regions = {name: np.concatenate([of, of + len(half.cells)]) for name, of in half.regions.items()}
    facets = {name: number[np.concatenate([of, other[of]])] for name, of in half.facets.items()}
    return TetMesh(points[used], number[cells], regions, facets)


def pressed(
    mesh: TetMesh, turns: bool, loads: list[LoadStep] = LOADS, pivot: tuple = MIDDLE, **others
) -> list[LoadState]:
    plate = Plate(others.pop("normal", DOWN), others.pop("shear", ALONG), turns=turns, pivot_mm=pivot)
    return solved(mesh, LAWS, plate, loads, tolerance=EXACT, **others)


@pytest.fixture(scope="module")
def free() -> list[LoadState]:
    return pressed(wedge(0.15), True)


def test_a_small_load_is_reached_too() -> None:
    """The first moves are then far too large: the plate stands on its first nodes until smaller ones are made."""
    (state,) = pressed(wedge(), True, [LoadStep("a", 0.5)])
    assert state.reached == 1.0


def test_a_free_plate_carries_no_moment_and_a_locked_one_does(free: list[LoadState]) -> None:
    locked = pressed(wedge(0.15), False)
    for turned, level in zip(free, locked, strict=True):
        assert turned.reached == level.reached == 1.0
        assert turned.force_n == pytest.approx(level.force_n, abs=1e-8)
        assert np.abs(turned.plate.moment_nmm).max() < 1e-7
        assert level.plate.turn_deg.tolist() == [0.0] * 3
        assert np.abs(level.plate.moment_nmm).max() > 10.0  # N mm
    # the wedge is 8.5 degrees steep, and the plate comes to lie on all of it
    assert free[0].plate.turn_deg == pytest.approx([0.0, 0.0, -8.0], abs=1.0)
    assert free[0].plate.area_mm2 > 2.0 * locked[0].plate.area_mm2


def test_the_plate_is_rigid(free: list[LoadState]) -> None:
    mesh, axes = wedge(0.15), Plate(DOWN, ALONG).axes
    first, last = ((mesh.points_mm + state.u_mm)[free[0].on_plate] for state in free)
    assert len(first) > 20
    assert pdist(last) == pytest.approx(pdist(first), abs=1e-7)
    turns = [Rotation.from_rotvec(state.plate.turn_deg, degrees=True).as_matrix() for state in free]
    assert np.degrees(Rotation.from_matrix(turns[1] @ turns[0].T).magnitude()) > 2.0
    moved = [(at - at.mean(axis=0)) @ axes for at in (first, last)]
    assert moved[1] @ turns[1] == pytest.approx(moved[0] @ turns[0], abs=1e-7)
    assert np.ptp((moved[1] @ turns[1])[:, 0]) < 1e-9  # and flat


def test_pressing_beside_the_middle_turns_the_plate_that_way() -> None:
    turns = [pressed(wedge(), True, LOADS[:1], (0.0, y, 10.0))[0].plate.turn_deg[2] for y in (8.0, 12.0)]
    assert turns[0] > 1.0
    assert turns[1] < -1.0


def test_a_mirrored_block_leaves_the_plate_level() -> None:
    state = pressed(mirrored(), True, LOADS[:1])[0]
    assert np.abs(state.plate.turn_deg[[0, 2]]).max() < 1e-6
    assert abs(state.plate_displacement_mm[1]) < 1e-8
    sheared = pressed(mirrored(), True)[1]
    assert abs(sheared.plate.turn_deg[2]) > 1.0  # what a shear above the bone does to it


def test_another_frame_gives_the_same_turn(free: list[LoadState]) -> None:
    turn = Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix()
    shift, mesh = np.array([3.0, -50.0, 20.0]), wedge(0.15)
    moved = TetMesh(mesh.points_mm @ turn.T + shift, mesh.cells, mesh.regions, mesh.facets)
    again = pressed(
        moved, True, pivot=tuple(turn @ np.array(MIDDLE) + shift), normal=turn @ DOWN, shear=turn @ np.array(ALONG)
    )
    for state, other in zip(free, again, strict=True):
        assert other.plate.turn_deg == pytest.approx(state.plate.turn_deg, abs=1e-5)
        assert np.abs(other.u_mm @ turn - state.u_mm).max() < 1e-6


def test_newtons_method_keeps_its_order_with_a_plate_that_turns(free: list[LoadState]) -> None:
    # Three steps of the force; the forces out of balance square from one iteration to the next.
    assert len(free[1].curve) == 4
    assert free[1].iterations <= 15


def test_a_free_plate_that_is_moved(free: list[LoadState]) -> None:
    travel = free[0].plate_displacement_mm
    state = pressed(wedge(0.15), True, [LoadStep("in", normal_mm=float(travel[0]))])[0]
    assert state.plate_displacement_mm[0] == pytest.approx(travel[0], abs=1e-9)
    assert np.abs(state.plate.moment_nmm).max() < 1e-7
    assert state.force_n[0] == pytest.approx(2.0, rel=0.1)  # other steps, so other places on the tape


def test_quadratic_cells_turn_too() -> None:
    state = pressed(wedge(0.15), True, LOADS[:1], element="P2")[0]
    assert np.abs(state.plate.moment_nmm).max() < 1e-7
    assert state.plate.turn_deg[2] == pytest.approx(-8.0, abs=1.5)


def test_what_cannot_turn_is_refused() -> None:
    with pytest.raises(InputError, match="would slip off"):
        Plate(DOWN, ALONG, taped=False, turns=True)
    with pytest.raises(InputError, match="three finite coordinates"):
        Plate(DOWN, ALONG, pivot_mm=[0.0, np.nan, 1.0])
