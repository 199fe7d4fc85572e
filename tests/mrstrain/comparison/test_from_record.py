"""What was given to `register` is not asked for again; what is given wins."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dvc import load_preset
from dvc.errors import InputError
from dvc.io.result_folder import PROVENANCE, ResultFolder
from mrstrain.comparison.from_record import (
    fill_directions,
    fill_engine,
    fill_labels,
    fill_subject,
    taken_from_record,
)
from mrstrain.options.measurement import EngineOptions, SubjectFiles
from mrstrain.options.modelling import ComparisonDirections, ComparisonLabels, Directions
from mrstrain.records.measured_with import MeasuredWith
from mrstrain.records.provenance import file_hash, provenance

ROLES = {"load0": "Load0.nii.gz", "labels": "tissues.nii.gz", "names": "tissues.csv", "bone": "bone.nii.gz"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A subject's folder, in another: files are looked for beside it too, where those of other tests would be found."""
    place = tmp_path / "subject"
    place.mkdir()
    for name in ROLES.values():
        (place / name).write_text(name)
    return place


def measured(folder: Path, *roles: str, load: str = "Load1", **parameters: object) -> ResultFolder:
    """A load that was measured with the files of these roles, by its record."""
    place = folder / "results" / load
    place.mkdir(parents=True, exist_ok=True)
    record = provenance("register", {role: folder / ROLES[role] for role in roles}, parameters)
    (place / PROVENANCE).write_text(json.dumps(record))
    return ResultFolder(place)


def record_of(load: ResultFolder) -> MeasuredWith:
    return MeasuredWith.shared([load], "")


def test_the_label_map_comes_with_its_names_and_its_bone(folder: Path) -> None:
    load = measured(folder, "labels", "names", bone_label="calcaneus")
    found = fill_labels(ComparisonLabels(), [load])
    own = {"labels": folder / "tissues.nii.gz", "names": folder / "tissues.csv", "bones": ("calcaneus",)}
    assert found == ComparisonLabels(**own)
    for field, value in (("names", folder / "other.csv"), ("bones", ("calcaneus", "talus"))):
        assert fill_labels(ComparisonLabels(**{field: value}), [load]) == ComparisonLabels(**(own | {field: value}))


def test_a_label_map_made_from_the_image_may_have_other_bones(folder: Path) -> None:
    """With the bone of the alignment alone, other bones would count as soft tissue."""
    load = measured(folder, "labels", "names", bone_label="bone")
    made = {"command": "label", "labels_sha256": file_hash(folder / "tissues.nii.gz"), "uncertain": 0.1, "notes": []}
    (folder / "tissues.json").write_text(json.dumps(made))
    assert fill_labels(ComparisonLabels(), [load]).bones == ()
    assert fill_labels(ComparisonLabels(bones=("bone",)), [load]).bones == ("bone",)


def test_another_label_map_has_its_own_names_and_bone(folder: Path) -> None:
    load = measured(folder, "labels", "names", bone_label="calcaneus")
    other = ComparisonLabels(labels=folder / "other.nii.gz")
    assert fill_labels(other, [load]) == other
    found = fill_subject(SubjectFiles(labels=folder / "other.nii.gz"), record_of(load))
    assert found == SubjectFiles(labels=folder / "other.nii.gz")
    assert fill_labels(other, [ResultFolder(folder)]) == other  # no record is needed


def test_a_measurement_without_labels_says_so(folder: Path) -> None:
    load = measured(folder, "bone", bone_label=None)
    with pytest.raises(InputError, match=r"Load1/provenance.json: .* made without a label map.* \(--labels\)"):
        fill_labels(ComparisonLabels(), [load])


def test_each_load_has_the_directions_that_it_was_measured_with(folder: Path) -> None:
    up, left, back = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
    loads = [
        measured(folder, plate_normal_lps=up, shear_direction_lps=back),
        measured(folder, load="Load2", plate_normal_lps=up, shear_direction_lps=left),
    ]
    usual, own = fill_directions(ComparisonDirections(), loads)
    assert usual == Directions(plate_normal=up, shear_direction=back)
    assert own == {"Load2": Directions(plate_normal=up, shear_direction=left)}
    given = ComparisonDirections(shear_direction=back)
    assert fill_directions(given, loads) == (usual, {})


def test_records_without_directions_are_read_as_the_usual_ones(folder: Path) -> None:
    loads = [measured(folder), ResultFolder(folder), measured(folder, load="Load2", shear_direction_lps=None)]
    assert fill_directions(ComparisonDirections(), loads) == (Directions(), {})


def test_a_subject_is_what_was_measured_with(folder: Path) -> None:
    with_mask = record_of(measured(folder, "labels", "names", "bone", bone_label=None))
    files = {role: folder / ROLES[role] for role in ("labels", "names", "bone")}
    assert fill_subject(SubjectFiles(), with_mask) == SubjectFiles(**files)
    with_label = record_of(measured(folder, "labels", bone_label="calcaneus"))
    assert fill_subject(SubjectFiles(), with_label) == SubjectFiles(labels=files["labels"], bone_label="calcaneus")
    other = folder / "other.nii.gz"
    assert fill_subject(SubjectFiles(bone=other), with_label) == SubjectFiles(labels=files["labels"], bone=other)
    assert fill_subject(SubjectFiles(bone_label="b"), with_mask).bone is None


PRESET = {"name": "heel-mr", "text": load_preset("heel-mr").text}
GAUSS_NEWTON = {"engine": "gauss-newton", "gauss_newton": {}, "stages": []}


@pytest.mark.parametrize(
    ("recorded", "engine"),
    [
        (GAUSS_NEWTON | {"borders": {"skin": None}}, {}),
        (GAUSS_NEWTON | {"borders": None}, {"borders": False}),
        ({"engine": "elastix", "borders": None, "stages": [PRESET]}, {"preset": "heel-mr"}),
        ({"engine": "of-a-plugin"}, {"engine": "of-a-plugin"}),
        ({}, {}),  # the record of `strain`
    ],
)
def test_the_engine_is_that_of_the_measurement(folder: Path, recorded: dict, engine: dict) -> None:
    record = record_of(measured(folder, "labels", **recorded))
    assert fill_engine(EngineOptions(), record, labelled=True) == EngineOptions.model_construct(
        **(dict(EngineOptions()) | engine)
    )
    for given in (EngineOptions(engine="gauss-newton"), EngineOptions(preset="heel-mr")):
        assert fill_engine(given, record, labelled=True) == given


def test_a_model_is_measured_with_the_interfaces_of_the_measurement(folder: Path) -> None:
    """Whether labels are given now or not: another engine has another bias."""
    record, given = record_of(measured(folder, "bone", **GAUSS_NEWTON, borders=None)), EngineOptions()
    for labelled in (False, True):
        assert fill_engine(given, record, labelled=labelled) == EngineOptions(borders=False)
    record = record_of(measured(folder, "bone", **GAUSS_NEWTON, borders={"bone_alone": True}))
    assert fill_engine(given, record, labelled=False) == given  # at the bone, too
    with pytest.raises(InputError, match="Leave out the label map"):
        fill_engine(given, record, labelled=True)
    record = record_of(measured(folder, "labels", **GAUSS_NEWTON, borders=None))
    assert fill_engine(EngineOptions(borders=True), record, labelled=True) == EngineOptions(borders=True)


def test_parameter_files_are_found_by_their_text_with_line_ends_of_any_system(folder: Path) -> None:
    stages = [PRESET | {"name": "mine.txt"}]
    record = record_of(measured(folder, engine="elastix", stages=stages))
    (folder / "mine.txt").write_bytes(PRESET["text"].replace("\n", "\r\n").encode())
    assert fill_engine(EngineOptions(), record, labelled=True) == EngineOptions(parameters=(folder / "mine.txt",))
    (folder / "mine.txt").write_text("something else")
    with pytest.raises(InputError, match=r"mine.txt is not the elastix parameter file .* \(--parameters\)"):
        fill_engine(EngineOptions(), record, labelled=True)


def test_what_was_taken_is_told_as_one_would_type_it() -> None:
    given = ComparisonLabels(names=Path("own.csv"))
    filled = ComparisonLabels(labels=Path("tissues.nii.gz"), names=Path("own.csv"), bones=("a", "b"))
    usual = Directions(plate_normal=(0.0, 0.0, 1.0))
    told = taken_from_record(
        Path("results"), (given, filled), (ComparisonDirections(), usual),
        (EngineOptions(), EngineOptions(borders=False)), more=["Load0.nii.gz"],
    )  # fmt: skip
    assert told == (
        "From the record of results: --labels tissues.nii.gz --bone a --bone b --plate-normal 0 0 1 --no-borders "
        "Load0.nii.gz",
    )
    assert taken_from_record(Path("results"), (filled, filled), (ComparisonDirections(), Directions())) == ()
