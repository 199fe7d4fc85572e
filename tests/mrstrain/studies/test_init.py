"""`init`: what it finds, what it passes over and says so, and every key of a study file in what it writes."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pixels
from pydantic import BaseModel

from dvc.errors import InputError
from dvc.io.images.write import write_image, write_labels, write_mask
from mrstrain.cli.questions import ask
from mrstrain.studies.check import check
from mrstrain.studies.file import Load, Study, keys_of, read_study
from mrstrain.studies.init import NewStudy, StudyInputs, init
from mrstrain.studies.picture import Labelled

LABELLED = StudyInputs(load0="Load0.nii.gz", loads={"Load1": "Load1.nii.gz"}, labels="tissues.nii.gz")
pytestmark = pytest.mark.usefixtures("real_pictures")


def folder_of(place: Path, *names: str) -> Path:
    for name in names:
        (place / name).write_bytes(b"")
    return place


def test_what_has_no_role_is_told_and_stands_in_the_study_file(tmp_path):
    folder_of(
        tmp_path, "Load0.nii.gz", "Load1.nii.gz", "Load1.nrrd", "Load1-again.nii.gz", "T1 <scout>.nii.gz",
        "labels.nii.gz", "tissues.nii.gz", "calcaneus.nii.gz", "other-bone.nii.gz",
    )  # fmt: skip
    begun = init(tmp_path, name='S07 "left" \U0001f9b6')
    told, text = "\n".join(begun.summary()), begun.path.read_text()
    study = read_study(tmp_path)
    assert study.study.name == 'S07 "left" \U0001f9b6'
    assert (study.images.labels, study.images.bone) == (Path("labels.nii.gz"), Path("calcaneus.nii.gz"))
    assert study.loads["Load1"].image == "Load1.nii.gz"
    assert "Mask of the bone: calcaneus.nii.gz" in told
    for name, why in (
        ("tissues.nii.gz", "because labels.nii.gz is used as the label map"),
        ("other-bone.nii.gz", "because calcaneus.nii.gz is used as the bone"),
        ("Load1.nrrd", "because Load1.nii.gz is used as the load of that name"),
        ("Load1-again.nii.gz", "because its name does not indicate a role"),
        ("T1 <scout>.nii.gz", "because its name does not indicate a role"),
    ):
        assert f"NOT USED: {name}, {why}" in told
        assert f'# NOT USED: "{name.split("<", maxsplit=1)[0]}' in text
        assert why in text
    assert told.count("NOT USED") == text.count("NOT USED") == 5


def test_names_that_a_laboratory_gives_are_recognised(tmp_path):
    found = init(folder_of(tmp_path, "heel_unloaded.nii.gz", "heel_140N.nii.gz", "calcaneus_seg.nii.gz")).inputs
    assert (found.load0, found.loads) == ("heel_unloaded.nii.gz", {"heel_140N": "heel_140N.nii.gz"})
    assert (found.labels, found.bone_mask, found.unused) == (None, "calcaneus_seg.nii.gz", {})


def test_the_force_in_the_name_of_an_image_is_that_of_the_load(tmp_path):
    made = init(
        folder_of(tmp_path, "sub07_rest.nii.gz", "sub07_115N.nii.gz", "sub07_62.5N.nii.gz", "sub07_bone.nii.gz")
    )
    assert (made.inputs.load0, made.inputs.unused) == ("sub07_rest.nii.gz", {})
    written = tomllib.loads(made.path.read_text())
    assert {name: load["normal_n"] for name, load in written["loads"].items()} == {
        "sub07_115N": 115.0, "sub07_62.5N": 62.5
    }  # fmt: skip
    assert written["mesh"]["edge_mm"] == 4.0  # of the whole body, which the label map of the study will hold


def test_names_that_would_be_recognised_are_listed_beside_those_that_are_not(tmp_path):
    told = init(folder_of(tmp_path, "Load0.nii.gz", "pressed.nii.gz")).summary()
    assert "NAME_140N" in next(line for line in told if line.startswith("Recognised names: "))


def test_two_unloaded_images_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"both Load0\.nii\.gz and unloaded\.nii\.gz"):
        init(folder_of(tmp_path, "Load0.nii.gz", "unloaded.nii.gz"))


def test_without_a_label_map_it_says_how_to_measure_all_the_same(tmp_path):
    told = init(folder_of(tmp_path, "Load0.nii.gz", "Load1.nii.gz", "Load2.nii.gz")).summary()
    images = " ".join(f"{tmp_path}/Load{n}.nii.gz" for n in range(3))
    command = f"mrstrain register {images} --bone BONE.nii.gz --out {tmp_path}/results"
    assert f"To measure strain without a label map, the mask of the bone alone is sufficient: {command}" in told
    assert any(line.startswith("Without a label map") and 'labels = "auto"' in line for line in told)
    assert not any("Without a label map" in line for line in NewStudy(tmp_path / "study.toml", LABELLED, "").summary())


def test_bones_are_left_open_until_a_label_map_is_there(tmp_path):
    """A label map that is made from the image may hold other bones, which a list written beforehand would leave out."""
    place = init(folder_of(tmp_path, "Load0.nii.gz", "Load1.nii.gz")).path
    assert [line for line in place.read_text().splitlines() if "bones = " in line and not line.startswith("#")] == []


def test_commands_to_type_take_a_folder_with_a_space(tmp_path):
    folder = tmp_path / "study one"
    folder.mkdir()
    told = init(folder_of(folder, "Load0.nii.gz", "Load1.nii.gz")).summary()
    images = " ".join(f"'{folder}/Load{n}.nii.gz'" for n in range(2))
    assert f"mrstrain register {images} --bone BONE.nii.gz --out '{folder}/results'" in "\n".join(told)
    assert told[-1] == f"Next step: mrstrain check '{folder}'"


@pytest.mark.parametrize("bone", ["calcaneus", "tibia", "left femur", "bone-mask", "calc", "calc_mask"])
def test_with_a_mask_of_the_bone_the_study_makes_its_label_map(tmp_path, bone):
    made = init(folder_of(tmp_path, "Load0.nii.gz", "Load1.nii.gz", f"{bone}.nii.gz"))
    told = made.summary()
    assert "Labels: to be made from Load0 and the mask of the bone" in told
    assert not any("Without a label map" in line for line in told)
    study = read_study(made.path)
    assert study.makes_labels
    assert study.images.bone == Path(f"{bone}.nii.gz")
    assert study.mesh.bones == ()
    assert not any("names" in line and "FILL IN" in line for line in made.path.read_text().splitlines())


def tables_of(text: str) -> dict[str, dict[str, str]]:
    """Every line ``key = value`` of a study file by its table, those that are commented out among them."""
    tables: dict[str, dict[str, str]] = {}
    for line in text.splitlines():
        if head := re.match(r"(?:# )?\[(\w+)[\].]", line):
            at = tables.setdefault(head[1], {})
        elif given := re.match(r"(?:# )?(\w+) = (.+)", line):
            at.setdefault(given[1], line.removeprefix("# "))
    return tables


SPREADS = {"mesh": 1.4, "force": 0.03, "direction_deg": 2.0, "poisson": 0.5, "labels_voxels": 0.5}


@pytest.mark.parametrize("names", [(), ("Load0.nii.gz", "Load1.nii.gz", "tissues.nii.gz", "to_mesh-labels.nii.gz")])
def test_every_key_of_a_study_file_stands_in_it_with_its_default(tmp_path, names):
    tables = tables_of(init(folder_of(tmp_path, *names)).path.read_text())
    parts = {name: one.annotation for name, one in Study.model_fields.items() if name != "place"}
    parts["loads"] = Load
    assert set(tables) == set(parts)
    for table, model in parts.items():
        assert isinstance(model, type)
        assert issubclass(model, BaseModel)
        keys = keys_of(model)
        assert set(tables[table]) == set(keys), table
        for key, line in tables[table].items():
            if key == "normal_n":  # a number is to be put in before the # is taken away
                assert line.startswith("normal_n = ... ")
                with pytest.raises(tomllib.TOMLDecodeError):
                    tomllib.loads(line)
                continue
            (value,) = tomllib.loads(line).values()  # each other is TOML once the # is taken away
            default = keys[key].get_default()
            if table == "uncertainty":  # without a table all inputs are exact; a new study begins with usual spreads
                assert value == SPREADS.get(key, default) or key in ("stiffness", "variants"), key
            elif not keys[key].is_required() and default not in (None, ()):
                assert (tuple(value) if isinstance(value, list) else value) == default, key


def test_init_of_an_empty_folder_says_what_is_missing(tmp_path):
    told = "\n".join(init(tmp_path).summary())
    assert "Load0: NOT FOUND" in told
    lines = (tmp_path / "study.toml").read_text().splitlines()
    places = re.findall(r"line (\d+): ((\S+) .*)$", told, re.MULTILINE)
    assert [key for _, _, key in places] == ["load0", "labels", "names", "[loads.Load1]", "image", "normal_n"]
    assert all(lines[int(number) - 1] == f"# {line}" for number, line, _ in places)
    with pytest.raises(InputError, match=r"(?s)line 10: \[images\] 'load0' is missing.*line 11: \[images\] 'labels'"):
        read_study(tmp_path)


def test_every_force_that_is_to_be_put_in_is_told_with_its_line_by_init_and_by_check(tmp_path):
    begun = init(folder_of(tmp_path, "Load0.nii.gz", "Load 1.nii.gz", "Load2.nii.gz", "tissues.nii.gz"))
    lines = begun.path.read_text().splitlines()
    first, second = (number for number, line in enumerate(lines, start=1) if line.startswith("# normal_n ="))
    told = [line.strip().split(" = ")[0] for line in begun.summary()[-5:-2]]
    assert told == ["line 12: names", f"line {first}: normal_n", f"line {second}: normal_n"]
    assert 'normal force of "Load 1", N' in begun.summary()[-4]
    places = [f"line {first}: [loads.Load 1] 'normal_n'", f"line {second}: [loads.Load2] 'normal_n'"]
    (told,) = (one for one in check(tmp_path).wrong if "normal_n" in one)
    assert [line.strip() for line in told.splitlines()[1:]] == places


def test_no_force_is_taken_from_the_published_experiment_by_removing_a_hash(tmp_path):
    begun = init(folder_of(tmp_path, "Load0.nii.gz", "Load3.nii.gz", "other-load-5.nii.gz", "tissues.nii.gz"))
    text = begun.path.read_text()
    assert 'normal force of "Load3", N (15.0 in the published experiment)' in text
    assert "shear force, N (45.0 in the published experiment)" in text
    uncommented = re.sub(r"^# (normal_n|shear_n) = ", r"\1 = ", text, flags=re.MULTILINE)
    begun.path.write_text(uncommented)
    with pytest.raises(
        InputError, match=r"(?s)not valid TOML.*normal_n = \.\.\.  .*FILL IN.*normal_n = \.\.\.  .*FILL IN"
    ):
        read_study(tmp_path)
    begun.path.write_text(re.sub(r"^normal_n = \.\.\.", "normal_n = 8.0", uncommented, flags=re.MULTILINE))
    assert {(load.normal_n, load.shear_n) for load in read_study(tmp_path).loads.values()} == {(8.0, 0.0)}


def test_dicom_folders_are_found_whatever_their_files_are_called(tmp_path):
    for folder, name in (("Load0", "IM0001"), ("Load1", "I1.IMA"), ("Load2", "A.DCM"), ("Load3", "notes.txt")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / name).write_bytes(bytes(128) + b"DICM" if folder in ("Load0", "Load1") else b"x")
    begun = init(tmp_path)
    assert begun.inputs.load0 == "Load0"
    assert begun.inputs.loads == {"Load1": "Load1", "Load2": "Load2"}
    assert "NOT USED: Load3, because the folder contains no DICOM image" in begun.summary()
    assert any(": labels = " in line for line in begun.summary())
    (tmp_path / "study.toml").unlink()
    (tmp_path / "tissues.nii.gz").touch()
    assert not any(": labels = " in line for line in init(tmp_path).summary())


def test_a_dicom_folder_may_hold_many_other_files(tmp_path):
    (tmp_path / "Load0").mkdir()
    for name in (*(f"A{n:02d}.bmp" for n in range(25)), "I1.dcm"):
        (tmp_path / "Load0" / name).write_bytes(b"x")
    assert init(tmp_path).inputs.load0 == "Load0"


def test_enhanced_dicom_files_are_found_and_single_slices_left_alone(tmp_path, monkeypatch):
    for name in ("Load0.dcm", "Load1.DCM", "load2_slice1.dcm", "load2_slice2.dcm", "notes.dcm"):
        (tmp_path / name).write_bytes(bytes(128) + b"DICM")  # no image at all
    with pytest.raises(InputError, match="holds the slices of a DICOM series"):
        init(tmp_path)
    assert not (tmp_path / "study.toml").exists()
    monkeypatch.setattr("mrstrain.studies.init.is_multiframe", lambda path: path.stem in ("Load0", "Load1"))
    (tmp_path / "IM0001").write_bytes(bytes(128) + b"DICM")
    (tmp_path / "README").write_text("no image")
    begun = init(tmp_path)
    found = begun.inputs
    assert (found.load0, found.loads, found.unused) == ("Load0.dcm", {"Load1": "Load1.DCM"}, {})
    (told,) = [line for line in begun.summary() if "DICOM series" in line]
    assert told.startswith("NOT USED: IM0001 and 3 more, single DICOM slices. ")
    for path in (tmp_path / "IM0001", *tmp_path.glob("load2*"), tmp_path / "notes.dcm", begun.path):
        path.unlink()
    assert not any("DICOM series" in line for line in init(tmp_path).summary())


def heel_in(folder: Path, pair) -> Path:
    """A folder with a small heel, its label map, two loads and a mask without a role."""
    write_image(folder / "Load0.nii.gz", pair.reference)
    write_image(folder / "Load1.nii.gz", pair.loaded)
    write_image(folder / "Load2.nii.gz", pair.repeat)
    write_labels(folder / "tissues.nii.gz", pair.labels)
    write_mask(folder / "os-calcis.nii.gz", pair.labels.region("bone"))
    return folder


def test_a_picture_shows_what_was_found(tmp_path, tiny_pair):
    begun = init(heel_in(tmp_path, tiny_pair))
    assert begun.picture == tmp_path / "study.png"
    assert begun.summary()[-2:] == [
        f"Check the picture of the images found: {tmp_path / 'study.png'}", f"Next step: mrstrain check {tmp_path}",
    ]  # fmt: skip
    with Pixels.open(begun.picture) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape[0] > 600  # two rows: the unloaded image in three planes, and two loads
    for colour in ((0, 0x72, 0xB2), (0xD5, 0x5E, 0)):  # outlines of bone and of fat
        assert (np.abs(pixels - colour).sum(axis=-1) < 30).sum() > 200


@pytest.mark.parametrize("whole", [True, False])
def test_without_labels_a_picture_shows_the_mask_of_the_bone(tmp_path, tiny_pair, whole):
    write_image(tmp_path / "Load0.nii.gz", tiny_pair.reference)
    write_mask(mask := tmp_path / "calcaneus.nii.gz", tiny_pair.labels.region("bone"))
    if not whole:
        mask.write_bytes(mask.read_bytes()[:200])
    begun = init(tmp_path)
    assert begun.inputs.bone_mask == mask.name
    with Pixels.open(begun.picture) as picture:
        r, _, b = np.moveaxis(np.asarray(picture.convert("RGB")).astype(int), -1, 0)
    assert (np.count_nonzero(b > r + 30) > 2000) == whole  # blue lies over grey


def test_no_picture_is_no_reason_to_write_no_study_file(tmp_path):
    begun = init(folder_of(tmp_path, "Load0.nii.gz", "Load1.nii.gz", "tissues.nii.gz"))
    assert begun.path.is_file()
    assert not (tmp_path / "study.png").exists()
    assert re.fullmatch(r"Picture of the images found: none, .*Load0\.nii\.gz.*", begun.summary()[-2])
    (tmp_path / "study.toml").unlink()
    (tmp_path / "Load0.nii.gz").unlink()
    assert init(tmp_path).summary()[-2:] == [
        "Picture of the images found: none, no unloaded image was found", f"Next step: mrstrain check {tmp_path}",
    ]  # fmt: skip


def test_labels_that_lie_elsewhere_are_left_out_of_the_picture(tiny_pair):
    far = replace(tiny_pair.labels.grid, origin_mm=tiny_pair.labels.grid.origin_mm + 1000.0)
    assert set(Labelled.of(tiny_pair.reference, tiny_pair.labels).regions) == set(tiny_pair.labels.names.values())
    assert Labelled.of(tiny_pair.reference, replace(tiny_pair.labels, grid=far)).regions == {}


def answering(*lines: str):
    """A console that gives these lines one after the other, then none; and what it was asked."""
    asked, left = [], list(lines)

    def read(question: str) -> str:
        asked.append(question)
        if not left:
            raise EOFError
        return left.pop(0)

    return read, asked


def asked_init(place: Path, *lines: str) -> tuple[NewStudy, list[str]]:
    read, asked = answering(*lines)
    (place / "study.toml").unlink(missing_ok=True)
    return init(place, ask=partial(ask, read=read)), asked


def test_every_label_named_like_a_bone_is_cut_out_of_the_mesh(tmp_path, tiny_pair):
    place = heel_in(tmp_path, tiny_pair)
    write_labels(place / "tissues_to_mesh.nii.gz", replace(tiny_pair.labels, labels=tiny_pair.labels.labels))
    (place / "tissues_probability.nii.gz").write_bytes(b"")  # written beside a label map, and none itself
    told = "\n".join(init(place).summary())
    assert read_study(place).mesh.bones == ("bone", "ankle")
    assert "NOT USED: tissues_probability.nii.gz" in told


def test_answers_stand_in_the_study_file(tmp_path, tiny_pair, capsys):
    place = heel_in(tmp_path, tiny_pair)
    begun, asked = asked_init(
        place, "heel", "ankle", "-5", "abc", "140 N", "", "15", "-45,5", "0 0.1 -1", "1 0", "[0, 1, 0]"
    )
    assert [question.split(",")[0].split(" [")[0] for question in asked] == [
        *["Which label is the bone (bone"] * 2, *["Load1: normal force"] * 3, "Load1: shear force",
        "Load2: normal force", "Load2: shear force", "Direction from the body to the plate",
        *["Direction of the shear force on the tissue"] * 2,
    ]  # fmt: skip
    assert asked[0].endswith("), or which file is its mask? [bone]: ")
    told = capsys.readouterr().out
    assert "'heel': choose one of bone, fat" in told
    assert "'-5': the normal force must be positive (compression)." in told
    assert "'abc': a number is needed" in told
    assert "'1 0': three numbers are needed" in told
    study = read_study(place)
    assert (study.bone, study.images.bone, study.mesh.bones) == ("ankle", None, ("ankle", "bone"))
    forces = {name: (load.normal_n, load.shear_n) for name, load in study.loads.items()}
    assert forces == {"Load1": (140.0, 0.0), "Load2": (15.0, -45.5)}
    assert study.plate.plate_normal == (0.0, 0.1, -1.0)
    assert study.plate.shear_direction == (0.0, 1.0, 0.0)
    assert not any("line" in line for line in begun.summary())  # nothing is left to fill in


def test_the_bone_may_be_the_file_of_a_mask(tmp_path, tiny_pair):
    begun, _ = asked_init(heel_in(tmp_path, tiny_pair), "os-calcis.nii.gz")
    assert read_study(tmp_path).images.bone == Path("os-calcis.nii.gz")
    assert not any("NOT USED" in line for line in begun.summary())


def test_every_question_can_be_skipped(tmp_path, tiny_pair):
    place = heel_in(tmp_path, tiny_pair)
    init(place)
    unasked = (place / "study.toml").read_text()
    for lines in ((), ("",) * 9):  # the end of the input, and Enter
        begun, _ = asked_init(place, *lines)
        assert begun.path.read_text() == unasked


@pytest.mark.skipif(sys.platform == "win32", reason="there are no pseudo-terminals")
@pytest.mark.parametrize(("options", "asks"), [((), True), (("--yes",), False)])
def test_a_terminal_is_asked_and_a_pipe_is_not(tmp_path, tiny_pair, options, asks):
    place = heel_in(tmp_path, tiny_pair)
    command = [sys.executable, "-m", "mrstrain", "init", str(place), *options]
    outside, inside = os.openpty()
    process = subprocess.Popen(command, stdin=inside, stdout=inside, stderr=inside)
    os.close(inside)
    told, answers = b"", [b"\n", b"140\n", b"\n", b"\n", b"\n"]
    with contextlib.suppress(OSError):  # its end, as Linux tells it
        while got := os.read(outside, 4096):
            told += got
            if told.endswith(b"]: "):
                os.write(outside, answers.pop(0))
    os.close(outside)
    assert process.wait() == 0, told
    assert (b"Load1: normal force, N [later]: " in told) == asks
    assert read_study(place).loads["Load1"].normal_n == (140.0 if asks else None)
    end = told[told.rindex(b"Check the picture") :].replace(b"\r\n  ", b" ")
    assert b"Check the picture of the images found: " in end
    assert b"Next step: mrstrain check " in end
    if asks:
        (place / "study.toml").unlink()
        piped = subprocess.run(command, input="", capture_output=True, text=True, check=True)
        assert "normal force, N [" not in piped.stdout
