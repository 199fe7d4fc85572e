"""A simulation that was begun and not ended, as after a kill: what it left is not taken for its result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

import fe
import mrstrain
from dvc.errors import InputError
from fe import LoadStep
from mrstrain.comparison import drive as driving
from mrstrain.comparison.model_files import loads_of, model_files
from mrstrain.models.simulate import _Run
from mrstrain.options.modelling import ModelReading
from tests.golden.scenes import GIVEN

OWN, PAD = str(GIVEN / "materials.toml"), GIVEN / "pad.inp"


def simulated(made: Path, out: Path, patch: pytest.MonkeyPatch) -> Path:
    def cut_off(*_: object) -> None:
        raise KeyboardInterrupt

    patch.setattr(_Run, "_write", cut_off)
    mrstrain.simulate(PAD, out=out, sets=[OWN], loads=[LoadStep("Load1", 2.0)], workers=1)
    return out / "two-laws"


def driven(made: Path, out: Path, patch: pytest.MonkeyPatch) -> Path:
    def cut_off(*_: object) -> None:
        raise KeyboardInterrupt

    patch.setattr(driving.fe, "write_regions_csv", cut_off)
    mrstrain.drive(PAD, made / "strain", out=out, sets=[OWN], threads=1)
    return out / "two-laws-driven"


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("command", [simulated, driven])
def test_the_loads_of_a_simulation_that_did_not_end_are_not_compared(
    made: Path, tmp_path: Path, command: Callable[[Path, Path, pytest.MonkeyPatch], Path]
) -> None:
    for _ in range(2):  # on what an earlier one left, too
        with pytest.MonkeyPatch.context() as patch, pytest.raises(KeyboardInterrupt):
            command(made, tmp_path, patch)
        (folder,) = (file.parent for file in tmp_path.glob("two-laws*/Load1.vtu"))
        assert loads_of(folder, has_mesh=False) == []
        for place in (folder, folder / "Load1.vtu"):
            with pytest.raises(InputError, match=r"two-laws.*: its simulation has not ended.*Run it"):
                model_files(["Load1"], [place], ModelReading())
        with pytest.raises(InputError, match=r"two-laws.*the simulation has not ended"):
            fe.Simulation.read(folder)
