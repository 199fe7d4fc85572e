"""A study whose label map is made from the image: what is written, told and done anew."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

import mrstrain
from dvc import Mask, read_labels, write_image, write_mask
from dvc.errors import InputError
from mrstrain.studies.file import read_study
from mrstrain.studies.run import forecast, run
from tests.processes import stages_run_here

STUDY = """
[study]
name = "Heel"
[images]
load0 = "Load0.nii.gz"
labels = "auto"
bone = "bone"
bone_mask = "calcaneus.nii.gz"
[loads.Load1]
image = "Load1.nii.gz"
[registration]
bending = 3.0
volume = 300.0
borders = false
"""


@pytest.fixture(scope="module")
def study(tiny_pair, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("auto")
    write_image(folder / "Load0.nii.gz", tiny_pair.reference)
    write_image(folder / "Load1.nii.gz", tiny_pair.loaded)
    write_mask(folder / "calcaneus.nii.gz", tiny_pair.bone)
    (folder / "study.toml").write_text(STUDY)
    with stages_run_here():
        run(folder, workers=1)
    return folder


def test_the_label_map_is_made_and_measured_with(study):
    made = study / "results" / "labels"
    labels = read_labels(made / "tissues.nii.gz", made / "tissues.csv")
    regions = (study / "results" / "registration" / "Load1" / "regions.csv").read_text()
    assert {"bone", "fat", "muscle"} <= set(labels.names.values())
    assert all(f"{name}," in regions for name in labels.names.values())
    page = (study / "results" / "report.html").read_text()
    assert "Label map made from the image" in page
    record = json.loads((study / "results" / "registration" / "Load1" / "provenance.json").read_text())
    unsure = record["parameters"]["labels_from_image"]["uncertain"]
    assert unsure == json.loads((made / "tissues.json").read_text())["uncertain"]
    assert f"{100 * unsure:.0f} % of its voxels have an uncertain label" in page


def test_the_bone_is_that_of_the_label_map_and_not_its_mask(study):
    """The interface would else be where the mask was drawn."""
    assert_bone_of_labels(study / "results" / "registration" / "Load1")
    assert "bone" in json.loads((study / "results" / "labels" / "tissues.json").read_text())["inputs"]


def assert_bone_of_labels(case: Path) -> None:
    record = json.loads((case / "provenance.json").read_text())
    assert record["parameters"]["bone_label"] == "bone"
    assert "bone" not in record["inputs"]


def test_beside_labels_of_another_program_the_bone_is_its_mask(tmp_path):
    command = 'labels = "auto"\nlabels_command = "segment {image} {labels}"'
    (tmp_path / "study.toml").write_text(STUDY.replace('labels = "auto"', command))
    files = read_study(tmp_path).subject_files
    assert (files.bone, files.bone_label) == (tmp_path / "calcaneus.nii.gz", None)


def test_a_study_without_models_begins_with_the_strain_in_a_picture(study):
    first = (study / "results" / "report.html").read_text().split('<details id="part-')[1]
    assert "<h2>Measured strain</h2>" in first
    assert first.index("<figure>") < first.index("<table>")
    assert "Sagittal" in first
    assert (study / "results" / "registration" / "slices_by_load.png").stat().st_size > 0


def test_only_what_another_mask_changes_is_done_anew(study, tiny_pair):
    assert set(forecast(study).values()) == {"up to date"}
    smaller = Mask(tiny_pair.bone.grid, binary_erosion(tiny_pair.bone.inside))
    write_mask(study / "calcaneus.nii.gz", smaller)
    try:
        assert forecast(study) == {"label": "will run", "register Load1": "will run"}
    finally:
        write_mask(study / "calcaneus.nii.gz", tiny_pair.bone)


@pytest.mark.full_size
def test_a_series_makes_its_label_map_as_a_study_does(study, tmp_path, in_this_process):
    """With `register`, and what it refuses before anything is made."""
    load0, load1, bone = study / "Load0.nii.gz", study / "Load1.nii.gz", study / "calcaneus.nii.gz"
    quick = {"bending": 3.0, "volume": 300.0, "borders": False}
    series = mrstrain.register(load0, [load1], out=tmp_path / "out", bone=bone, labels="auto", **quick)
    own = read_labels(tmp_path / "out" / "labels" / "tissues.nii.gz", tmp_path / "out" / "labels" / "tissues.csv")
    made = study / "results" / "labels"
    assert np.array_equal(own.labels, read_labels(made / "tissues.nii.gz", made / "tissues.csv").labels)
    assert_bone_of_labels(tmp_path / "out" / "Load1")
    record = json.loads((tmp_path / "out" / "Load1" / "provenance.json").read_text())
    assert "calcaneus.nii.gz" in str(record["inputs"]["drawn_bone"])
    assert [section.title for section in (series.cases[0].section,)] == ["Load1"]
    assert "Label map made from the image" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, "labels auto also needs the mask of the bone"),
        ({"bone": "calcaneus.nii.gz", "names": "study.toml"}, "`names` is for a label map of your own"),
        ({"bone": "calcaneus.nii.gz", "allow_missing": True}, "cannot be combined with `allow_missing`"),
        ({"bone": "calcaneus.nii.gz", "loads": ["labels.nii.gz"]}, "A loaded image is named 'labels'"),
    ],
)
def test_labels_that_cannot_be_made_are_refused_first(study, tmp_path, given, told):
    loads = [study / name for name in given.pop("loads", ["Load1.nii.gz"])]
    files = {name: study / value if isinstance(value, str) else value for name, value in given.items()}
    with pytest.raises(InputError, match=told):
        mrstrain.register(study / "Load0.nii.gz", loads, out=tmp_path / "out", labels="auto", **files)
    assert not (tmp_path / "out").exists()


def test_other_commands_say_who_makes_labels(study, tmp_path):
    with pytest.raises(InputError, match="Make it with `mrstrain label` first"):
        mrstrain.strain(study / "Load0.nii.gz", tmp_path / "u.nii.gz", out=tmp_path / "out", labels="auto")
