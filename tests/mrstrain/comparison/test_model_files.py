"""Which files of a model are compared, and what is said of the others."""

from __future__ import annotations

import zipfile
from pathlib import Path

import pytest

from dvc.errors import InputError
from mrstrain.comparison.model_files import model_files
from mrstrain.options.modelling import ModelReading
from tests.validate.test_codes import CODES

LOADS = ("Load1", "Load2")


def model(place: Path, **runs: str) -> Path:
    """A folder of a model with the results of runs in ``codes.zip``, and all that lies beside them, by load."""
    place.mkdir()
    with zipfile.ZipFile(CODES) as packed:
        for load, run in runs.items():
            for name in packed.namelist():
                if name.startswith(f"{run}."):
                    (place / f"{load}{Path(name).suffix}").write_bytes(packed.read(name))
    return place


@pytest.mark.parametrize(("failed", "why"), [("febio/fails", "ERROR TERMINATION"), ("calculix/incs", "time 0.4 of 1")])
def test_a_run_that_ended_early_is_left_out_and_told(tmp_path: Path, failed: str, why: str) -> None:
    place = model(tmp_path / "mine", Load1=failed, Load2="febio/hex8")
    files, notes = model_files(LOADS, [place], ModelReading())
    assert list(files) == ["Load2"]
    (note,) = notes
    assert note.startswith("mine: the run of Load1 ended")
    assert why in note
    assert "is not compared" in note
    assert "--unfinished" in note
    files, notes = model_files(LOADS, [place], ModelReading(unfinished=True))
    assert list(files) == list(LOADS)
    assert why in notes[0]
    assert "not compared" not in notes[0]


def test_where_no_run_ended_nothing_is_compared(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="ERROR TERMINATION"):
        model_files(LOADS, [model(tmp_path / "mine", Load1="febio/fails")], ModelReading())


def test_of_two_results_of_one_load_it_is_said_which_is_compared(tmp_path: Path) -> None:
    place = model(tmp_path / "mine", Load1="febio/hex8", Load2="febio/hex8")
    (place / "Load1.vtu").write_text("")  # as `simulate --decks` leaves it, where FEBio then runs the deck
    files, notes = model_files(LOADS, [place], ModelReading())
    assert [files[load][0].path.name for load in LOADS] == ["Load1.vtu", "Load2.xplt"]
    (note,) = notes
    assert note == "mine: Load1.vtu is compared, Load1.xplt is not. To compare it, move it to another folder."


def test_a_model_names_the_parts_that_are_no_tissue(tmp_path: Path) -> None:
    place = model(tmp_path / "mine", Load1="febio/rigid")

    def regions() -> set[str]:
        files, _ = model_files(["Load1"], [place], ModelReading())
        return set(files["Load1"][0].deformation().mesh.regions)

    (tissue,) = regions()
    (place / "model.toml").write_text(f'leave_out = ["{tissue}"]\n')
    (plate,) = regions()
    assert plate != tissue
    (place / "model.toml").write_text('leave_out = "plate"\n')
    with pytest.raises(InputError, match=r"model\.toml: leave_out is a list of names of regions"):
        regions()


def test_settings_of_a_model_that_differ_from_an_option_are_told(tmp_path: Path) -> None:
    """Where nothing was given, they are the usual way to say it, and no word is needed."""
    place = model(tmp_path / "mine", Load1="febio/hex8")
    (place / "model.toml").write_text('unit = "m"\nframe = "LPS"\n')
    given: ModelReading
    told: list[str]
    for given, told in (
        (ModelReading(), []),
        (ModelReading(model_unit="m", model_frame="LPS"), []),
        (
            ModelReading(model_unit="mm"),
            ["mine: its model.toml says unit m, which is used instead of mm (--model-unit)."],
        ),
        (
            ModelReading(model_frame="RAS"),
            ["mine: its model.toml says frame LPS, which is used instead of RAS (--model-frame)."],
        ),
    ):
        files, notes = model_files(["Load1"], [place], given)
        assert notes == told
        assert files["Load1"][0].reading.model_unit == "m"
