"""What cannot reach equilibrium ends with its cause, after a limited number of steps.

A step is one linear solution. Processor time is looked at too, so that "within a minute" is more than a number of
steps; it was 3 s at most. The four materials that are told to be odd took 64, 57, 186 and 97 steps, 164, 122, 256 and
115 without their limits on iterations and on forces after displacements, and up to 600 where smaller steps and viscous
descent are tried too; the last took 225 without a limit on the steps that may be left to the load. Rounding, which
differs between processors, changes the numbers.
"""

import re
import time

import pytest

from dvc.errors import InputError
from fe import LoadStep, Material, NeoHooke, Plate, Simulation, Yeoh, simulate
from fe.linear import Solver
from tests.fe.test_simulate import ALONG, DOWN, FAT, SKIN, dome

MOST_STEPS, MINUTE = 1000, 60.0
FALLING = Yeoh.of(0.03, c20_mpa=-0.02)
SOFT = NeoHooke.of(1e-5)  # 10 Pa
SOFT_IN_MPA = r"modulus of 0.01 kPa, .* Are they in MPa, entered as kPa\?"
FALLS = r"stable \(rising stress\) only at"
TOLD = "no equilibrium was found beyond"


class Counted:
    """Simulations of the dome, with what they cost."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.steps, solve = 0, Solver.solve

        def counted(solver: Solver, *given: object) -> object:
            self.steps += 1
            return solve(solver, *given)

        monkeypatch.setattr(Solver, "solve", counted)

    def of(self, laws: dict[str, Material], load: LoadStep) -> Simulation:
        began = time.process_time()
        done = simulate(dome(), laws, Plate(DOWN, ALONG), [load])
        self.seconds = time.process_time() - began
        return done


@pytest.mark.parametrize(
    ("skin", "fat", "load", "cause", "most"),
    [
        (FALLING, FAT, LoadStep("a", 40.0), FALLS, 120),
        (Yeoh.of(0.01, c20_mpa=-0.1), FAT, LoadStep("a", 40.0, 10.0), FALLS, 100),
        (SKIN, SOFT, LoadStep("a", 2.0), SOFT_IN_MPA, 230),
        (SKIN, SOFT, LoadStep("a", 140.0), SOFT_IN_MPA, 170),
        (SKIN, FAT, LoadStep("a", 2.0, 300.0), "nearly inverted", MOST_STEPS),
    ],
    ids=["falling skin", "falling steeply", "fat of 10 Pa", "fat of 10 Pa far from its load", "sheared too far"],
)
def test_it_ends_within_a_minute_with_its_cause(
    skin: Material, fat: Material, load: LoadStep, cause: str, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch)
    done = counted.of({"skin": skin, "fat": fat}, load)
    assert not done.complete
    assert done.states[0].reached < 0.5
    notes = " ".join(done.notes)
    assert f"a: {TOLD}" in notes
    assert re.search(cause, notes)
    assert ("below half of the normal load, the search is cut short" in notes) == (most < MOST_STEPS)
    assert counted.steps < most
    assert counted.seconds < MINUTE


@pytest.mark.parametrize(
    ("laws", "load", "cause"),
    [
        ({"skin": SKIN, "fat": FAT}, LoadStep("a", 1e9), "Forces are in N and moduli in MPa"),
        ({"skin": SKIN, "fat": NeoHooke.of(1e-8)}, LoadStep("a", 2.0), "fat has a shear modulus of 0.01 Pa"),
    ],
    ids=["a load of 10^9 N", "fat of .01 Pa"],
)
def test_what_no_tissue_can_is_refused_before_the_first_step(
    laws: dict[str, Material], load: LoadStep, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    counted = Counted(monkeypatch)
    with pytest.raises(InputError, match=cause):
        counted.of(laws, load)
    assert not counted.steps


@pytest.mark.full_size
def test_a_plate_that_rotates_may_go_on_with_a_doubted_material() -> None:
    """To .84 of the load; with the few iterations that a parallel plate gets, to .65."""
    laws, plate = {"skin": SKIN, "fat": NeoHooke.of(3e-5)}, Plate(DOWN, ALONG, turns=True)
    done = simulate(dome(), laws, plate, [LoadStep("a", 0.5)])
    assert "softer than in any published set" in " ".join(done.notes)
    assert done.states[0].reached > 0.75


def test_a_doubted_material_that_can_reach_its_load_does(monkeypatch: pytest.MonkeyPatch) -> None:
    counted = Counted(monkeypatch)
    stiff = NeoHooke.of(30.0)  # fat of 30 MPa: kPa entered as MPa
    done = counted.of({"skin": SKIN, "fat": stiff}, LoadStep("a", 2.0, 1.0))
    assert "Are its parameters in kPa, entered as MPa?" in " ".join(done.notes)
    assert done.complete
