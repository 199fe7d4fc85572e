"""A plate that moves by a prescribed displacement: it moves by that much, and its forces give the same state."""

import numpy as np
import pytest

from dvc.mesh import TetMesh
from fe import LoadState, LoadStep, Tolerance
from tests.blocks import block
from tests.fe.test_simulate import dome, press

EXACT = Tolerance(force=1e-9, step_mm=1e-8)


@pytest.fixture(scope="module")
def moved() -> list[LoadState]:
    loads = [LoadStep("in", normal_mm=1.5), LoadStep("along", normal_mm=1.5, shear_mm=1.0)]
    return press(block_under_plate(), loads, tolerance=EXACT)


def block_under_plate() -> TetMesh:
    box = block((4, 5, 5), (10.0, 20.0, 20.0), layers=4, wobble=0.15)
    fat = np.concatenate([box.regions[f"layer {k}"] for k in (1, 2, 3)])
    facets = {"bone": box.facets["x1"], "skin": box.facets["x0"]}
    return TetMesh(box.points_mm, box.cells, {"skin": box.regions["layer 0"], "fat": fat}, facets)


def test_the_travel_is_the_one_asked_for(moved: list[LoadState]) -> None:
    assert [state.reached for state in moved] == [1.0, 1.0]
    assert moved[0].plate_displacement_mm[0] == pytest.approx(1.5, abs=1e-9)
    assert moved[1].plate_displacement_mm[:2] == pytest.approx([1.5, 1.0], abs=1e-9)
    assert np.abs(moved[0].force_n[1:]).max() < 1e-6  # free across, where no travel is given
    assert abs(moved[1].force_n[2]) < 1e-6
    assert (np.diff([at.displacement_mm[0] for at in moved[0].curve]) <= 0.6 + 1e-9).all()


def test_the_force_of_a_travel_gives_that_travel(moved: list[LoadState]) -> None:
    forces = [LoadStep(state.load.name, float(state.force_n[0]), float(state.force_n[1])) for state in moved]
    forces[0] = LoadStep("in", forces[0].normal_n)
    for travelled, pushed in zip(moved, press(block_under_plate(), forces, tolerance=EXACT), strict=True):
        assert pushed.plate_displacement_mm == pytest.approx(travelled.plate_displacement_mm, abs=1e-6)
        assert np.abs(pushed.u_mm - travelled.u_mm).max() < 1e-6
        assert np.abs(pushed.u_mm).max() > 1.0


def test_a_force_along_the_normal_and_a_travel_across(moved: list[LoadState]) -> None:
    normal = float(moved[1].force_n[0])
    state = press(block_under_plate(), [LoadStep("both", normal_n=normal, shear_mm=1.0)], tolerance=EXACT)[0]
    assert state.plate_displacement_mm == pytest.approx(moved[1].plate_displacement_mm, abs=1e-6)
    assert state.force_n == pytest.approx(moved[1].force_n, abs=1e-5)


def test_a_travel_too_far_ends_with_the_last_state_in_balance() -> None:
    state = press(dome((3, 4, 4)), [LoadStep("in", normal_mm=9.5)])[0]
    assert 0.3 < state.reached < 1.0
    assert state.plate_displacement_mm[0] == pytest.approx(9.5 * state.reached)
