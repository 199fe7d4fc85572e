"""What a command was given: what is refused is named so that it serves Python and the command line."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import InputError, MrstrainError, OutputError
from dvc.images.image import Grid, Image, LabelMap
from dvc.io.images.write import write_image, write_labels
from mrstrain.measurement.register import register
from mrstrain.options.measurement import MeshAndAxes, SubjectFiles
from mrstrain.records.inputs import (
    alone,
    case_names,
    make_output,
    read_given_labels,
    read_matrix,
    read_subject,
    refuse_small_disk,
    refuse_touching_inputs,
    swapped_by_name,
)
from mrstrain.studies.run import run_studies


@pytest.mark.parametrize("ending", [".csv", ".txt"])
def test_a_table_of_names_beside_a_label_map_is_pointed_to_and_not_taken(tmp_path: Path, caplog, ending: str) -> None:
    place, table = tmp_path / "my tissues.nii.gz", tmp_path / f"my tissues{ending}"
    grid = Grid((4, 1, 1), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    write_labels(place, LabelMap(grid, np.array([0, 5, 5, 7]).reshape(4, 1, 1), {5: "fat", 7: "bone"}))
    (tmp_path / "my tissues.csv").unlink(missing_ok=True)
    rows = {".csv": "label,name\n5,fat\n7,bone\n", ".txt": '5 0 0 0 1 1 1 "fat"\n7 0 0 0 1 1 1 "bone"\n'}[ending]
    table.write_text(rows)
    assert read_given_labels(place, None).names == {5: "label-5", 7: "label-7"}
    (note,) = (one.getMessage() for one in caplog.records)
    assert note.startswith(f"{place}: the labels have no names. There is a table of names beside it, {table};")
    assert f"(--names '{table}' on the command line)" in note
    caplog.clear()
    assert read_given_labels(place, table).names == {5: "fat", 7: "bone"}
    for other in (rows.splitlines()[0] + "\n", rows.rpartition("7")[0], "of something else\n"):
        table.write_text(other)
        read_given_labels(place, None)
    table.rename(tmp_path / f"other{ending}")
    read_given_labels(place, None)
    assert not caplog.records


@pytest.mark.parametrize(
    ("directions", "pressed"),
    [({}, False), ({"plate_normal": (0, 1, 0)}, True), ({"shear_direction": (0, 1, 0)}, True)],
)
def test_a_plate_presses_where_a_direction_of_it_is_given(tmp_path: Path, directions: dict, pressed: bool) -> None:
    """With the normal alone, too: the tissue under the bone must then move away from the plate."""
    image = tmp_path / "Load0.nii.gz"
    write_image(image, Image(Grid((4, 4, 4), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), np.arange(64.0).reshape(4, 4, 4)))
    subject = read_subject(image, SubjectFiles(), MeshAndAxes(**directions))
    normal = directions.get("plate_normal", (0, 0, -1))
    assert (subject.pressed_along is None) == (not pressed)
    assert subject.plate_normal.tolist() == list(normal)
    if pressed:
        assert subject.pressed_along.tolist() == list(normal)


def test_arguments_are_named_without_the_dashes_of_the_command_line(tmp_path: Path) -> None:
    image = tmp_path / "Load0.nii.gz"
    write_image(image, Image(Grid((4, 4, 4), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)), np.arange(64.0).reshape(4, 4, 4)))
    for refused, names in (
        (lambda: read_subject(image, SubjectFiles(names=Path("t.csv"))), "names and bone_label"),
        (lambda: case_names([image, tmp_path / "other" / "Load0.nii.gz"]), r"\(out\)"),
        (lambda: refuse_touching_inputs(tmp_path, ["a"], [tmp_path / "a" / "b.nii"]), r"\(out\)"),
        (lambda: refuse_small_disk(tmp_path, 1e30, "images need"), r"\(out\)"),
        (lambda: register(image, [tmp_path / "Load1.nii.gz"], out=tmp_path / "out"), r"bone \(--bone\)"),
        (lambda: make_output(image / "below"), r"\(out\)"),
        (lambda: run_studies([], scheduler="tcp://n:1", workers=4), r"workers=4 \(--workers 4\)"),
    ):
        with pytest.raises(MrstrainError, match=names) as told:
            refused()
        assert "--" not in re.sub(r"\(--.*?\)", "", str(told.value))


def test_a_full_disk_is_named_and_keeps_no_probe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, _: bytes) -> None:
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OutputError, match=r"No space left on device.*free disk space"):
        make_output(tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_two_runs_do_not_write_to_one_folder(tmp_path: Path) -> None:
    with alone(tmp_path), pytest.raises(OutputError, match="another run writes to it"), alone(tmp_path):
        pass
    with alone(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_without_a_bone_three_lines_tell_how_to_get_one(tmp_path: Path) -> None:
    with pytest.raises(MrstrainError) as told:
        register(tmp_path / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "out")
    assert len(str(told.value).splitlines()) <= 3
    for words in ("ITK-SNAP or 3D Slicer", "calcaneus", "on Load0.nii.gz", "NIfTI", "(--bone)", "(--align image)"):
        assert words in str(told.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "shape"),
        ("1 0 nan 5\n0 1 0 6\n0 0 1 7\n0 0 0 1\n", "row 1, column 3 of the matrix is not finite"),
        ("1 0 0 1_0\n0 1 0 6\n0 0 1 7\n0 0 0 1\n", "not a matrix of four rows"),
        ("1,0,0,5\n0,1,0,6\n0,0,1,7\n0,0,0,1\n", "four numbers, separated by spaces, with decimal points\\.$"),
        ("1 0 0 5\n0 1 0 6\n0 0 1 7\n", "4 x 4 is needed"),
    ],
)
def test_a_damaged_matrix_is_refused_and_warns_of_nothing(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "m.txt").write_text(text)
    with pytest.raises(InputError, match=rf"m\.txt: .*{message}"):
        read_matrix(tmp_path / "m.txt")
    with pytest.raises(InputError, match=r"^[^()]*n\.txt: no such file\. Check the path\.$"):
        read_matrix(tmp_path / "n.txt")


@pytest.mark.parametrize(
    ("load0", "loads", "odd"),
    [
        ("heel_140N.nii.gz", ["heel_unloaded.nii.gz"], "heel_unloaded.nii.gz"),
        ("Load1.nii.gz", ["Load2.nii.gz", "load_0.nrrd"], "load_0.nrrd"),
        ("Load0.nii.gz", ["Load1.nii.gz", "Load0-again.nii.gz"], ""),
        ("sub07_115N.nii.gz", ["sub07_rest.nii.gz"], "sub07_rest.nii.gz"),
        ("heel_60N.nii.gz", ["heel_140N_0N.nii.gz", "Load1_rest.nii.gz", "forest.nii.gz"], ""),
        ("a.nii.gz", ["b.nii.gz"], ""),
        ("heel.nii.gz", ["load01.nii.gz", "Load_05N.nii.gz", "load0.5kg.nii.gz", "mono_load1.nii.gz"], ""),
    ],
)
def test_images_that_their_names_say_are_swapped_are_told(load0: str, loads: list[str], odd: str, tmp_path) -> None:
    told = swapped_by_name(Path(load0), [Path(load) for load in loads])
    assert told.startswith(f"{odd} is given as a loaded image, but named like the unloaded one") if odd else told == ""
    notes = list[str]()
    with pytest.raises(InputError):  # there are no such files
        register(
            tmp_path / load0, [tmp_path / load for load in loads], out=tmp_path / "out", align="image",
            progress=lambda _, stage, __: notes.append(stage),
        )  # fmt: skip
    assert any("named like the unloaded one" in note for note in notes) == bool(odd)
