"""`label`: what it writes, that `register` takes it, and what it refuses."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import nibabel
import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from typer.testing import CliRunner

import mrstrain
from dvc import (
    Image,
    LabelMap,
    TissueLabels,
    read_image,
    read_labels,
    read_mask,
    write_image,
    write_labels,
    write_mask,
)
from dvc.errors import InputError, OutputError
from dvc.io.images.labels import read_names
from dvc.measurement.subject import LabelsFromImage
from mrstrain.cli.app import app
from mrstrain.comparison.methods import _labels
from mrstrain.measurement import label as labelling
from mrstrain.measurement.strokes import read_marks
from mrstrain.options.measurement import SubjectFiles
from mrstrain.records.inputs import made_from_image, read_subject
from phantoms import Heel, labels_of, misdrawn


@pytest.fixture(scope="module")
def folder(made_once, heel_at_rest_once) -> Path:
    def fill(place: Path) -> None:
        image, truth = heel_at_rest_once(41, 1.6)
        write_image(place / "Load0.nii.gz", image)
        write_mask(place / "bone.nii.gz", truth.region("bone"))
        told = mrstrain.label(place / "Load0.nii.gz", bone=place / "bone.nii.gz", out=place / "made" / "tissues.nii.gz")
        (place / "told.txt").write_text("\n".join(told.summary()))

    return made_once("labelled heel", fill)


def test_everything_is_written_and_agrees(folder: Path) -> None:
    made = folder / "made"
    assert {path.name for path in made.iterdir()} == {
        "tissues.nii.gz", "tissues.csv", "tissues.json", "tissues.png", "tissues.pdf",
        "tissues_probability.nii.gz", "tissues_probability.json",
    }  # fmt: skip
    labels = read_labels(made / "tissues.nii.gz", made / "tissues.csv")
    names = json.loads((made / "tissues_probability.json").read_text())["components"]
    assert list(read_names(made / "tissues.csv").values()) == names
    probability = nibabel.load(made / "tissues_probability.nii.gz").get_fdata()[..., 0, :]
    numbers = np.array([number for name in names for number, known in labels.names.items() if known == name])
    inside = labels.labels > 0
    assert np.array_equal(numbers[probability.argmax(axis=-1)][inside], labels.labels[inside])
    bone = read_mask(folder / "bone.nii.gz", read_image(folder / "Load0.nii.gz").grid)
    assert np.array_equal(labels.region("bone").inside, bone.inside)
    record = json.loads((made / "tissues.json").read_text())
    assert record["command"] == "label"
    assert record["inputs"]["bone"][0]["sha256"]
    assert 0.0 < record["uncertain"] < 0.5
    told = (folder / "told.txt").read_text()
    assert "Bones found: bone and other bone. A bone that was missed is labelled as fat." in told
    assert f"{100 * record['uncertain']:.0f} % of the voxels have an uncertain label" in told
    assert told.endswith(f"Label map: {made / 'tissues.nii.gz'}")


def test_a_measurement_knows_labels_that_were_made_from_the_image(folder: Path, tmp_path: Path) -> None:
    made = shutil.copytree(folder / "made", tmp_path / "made")
    known = made_from_image(made / "tissues.nii.gz")
    assert known == LabelsFromImage(json.loads((made / "tissues.json").read_text())["uncertain"])
    assert not known.doubts
    files = SubjectFiles(bone=folder / "bone.nii.gz", labels=made / "tissues.nii.gz", names=made / "tissues.csv")
    assert read_subject(folder / "Load0.nii.gz", files).from_image == known
    labels = read_labels(made / "tissues.nii.gz", made / "tissues.csv")
    corrected = labels.labels.copy()
    corrected[corrected == 2] = 3  # by hand
    write_labels(made / "tissues.nii.gz", replace(labels, labels=corrected))
    assert made_from_image(made / "tissues.nii.gz") is None
    assert made_from_image(folder / "bone.nii.gz") is None


def test_marks_without_names_have_the_usual_ones(folder: Path, tmp_path: Path) -> None:
    truth = labels_of(Heel(41), read_image(folder / "Load0.nii.gz").grid)
    drawn = np.zeros_like(truth.labels)
    for number, name in enumerate(("bone", "fat", "muscle", "skin", "tendon"), 1):
        places = np.argwhere(truth.region(name).inside)
        drawn[tuple(places[len(places) // 2])] = number
    place = tmp_path / "strokes.nrrd"
    write_labels(place, LabelMap(truth.grid, drawn, {n: f"label-{n}" for n in range(1, 6)}))
    assert list(read_marks(place, None).names.values()) == ["bone", "fat", "muscle", "skin", "tendon"]
    assert list(read_marks(place, tmp_path / "strokes.csv").names.values()) == [f"label-{n}" for n in range(1, 6)]
    write_labels(
        place, LabelMap(truth.grid, np.where(drawn == 5, 9, drawn), {n: f"label-{n}" for n in (1, 2, 3, 4, 9)})
    )
    with pytest.raises(InputError, match=r"strokes 9 have no name"):
        read_marks(place, None)
    write_labels(place, LabelMap(truth.grid, drawn, {n: f"label-{n}" for n in range(1, 6)}))
    load0, bone, out = folder / "Load0.nii.gz", folder / "bone.nii.gz", tmp_path / "made.nii.gz"
    mrstrain.label(load0, bone=bone, marks=place, out=out)
    made = read_labels(out, tmp_path / "made.csv")
    for number, name in ((2, "fat"), (3, "muscle"), (5, "tendon")):  # every mark has its tissue
        assert (made.region(name).inside[drawn == number]).all()
    record = json.loads((tmp_path / "made.json").read_text())
    assert set(record["inputs"]) == {"load0", "bone", "marks"}


def test_what_cannot_be_labelled_is_refused_before_anything_is_written(folder: Path, tmp_path: Path) -> None:
    load0, bone = folder / "Load0.nii.gz", folder / "bone.nii.gz"
    with pytest.raises(InputError, match="A bone is needed"):
        mrstrain.label(load0, out=tmp_path / "a" / "t.nii.gz")
    with pytest.raises(InputError, match=r"must end in \.nii\.gz"):
        mrstrain.label(load0, bone=bone, out=tmp_path / "a" / "t.png")
    with pytest.raises(OutputError, match="would be overwritten"):
        mrstrain.label(load0, bone=bone, out=bone)
    with pytest.raises(OutputError, match="would be overwritten"):
        mrstrain.label(load0, bone=bone, out=folder / "Load0.nii.gz")
    assert not list(tmp_path.iterdir())


def test_an_image_without_a_dark_surface_says_so(folder: Path, tmp_path: Path) -> None:
    image, bone = read_image(folder / "Load0.nii.gz"), read_mask(folder / "bone.nii.gz")
    labels = labels_of(Heel(41), image.grid)
    even = np.where(labels.labels > 0, 500.0, 0.0) + np.random.default_rng(1).normal(0.0, 10.0, image.grid.shape)
    write_image(tmp_path / "even.nii.gz", Image(image.grid, even))
    write_mask(tmp_path / "bone.nii.gz", bone)
    told = mrstrain.label(tmp_path / "even.nii.gz", bone=tmp_path / "bone.nii.gz", out=tmp_path / "t.nii.gz").summary()
    assert any("No skin was found" in line for line in told)
    assert any("only one tissue was found" in line for line in told)
    assert set(read_labels(tmp_path / "t.nii.gz", tmp_path / "t.csv").names.values()) == {"bone", "fat"}


def test_a_drawn_label_map_is_corrected_and_its_files_agree(folder: Path, tmp_path: Path) -> None:
    load0, drawn = folder / "Load0.nii.gz", tmp_path / "drawn.nii.gz"
    truth = labels_of(Heel(41), read_image(load0).grid)
    write_labels(drawn, misdrawn(truth, 1))
    names = tmp_path / "drawn.csv"
    told = mrstrain.label(load0, labels=drawn, names=names, out=tmp_path / "out" / "tissues.nii.gz").summary()
    made = read_labels(tmp_path / "out" / "tissues.nii.gz", tmp_path / "out" / "tissues.csv")
    wrong = [np.mean(of.labels != truth.labels) for of in (made, misdrawn(truth, 1))]
    assert wrong[0] < 0.5 * wrong[1]
    record = json.loads((tmp_path / "out" / "tissues.json").read_text())
    assert record["changed"] == np.mean((made.labels != misdrawn(truth, 1).labels)[truth.labels > 0])
    assert record["moved"]["bone"]["mean_mm"] < -0.5
    assert told[0].startswith(f"{100 * record['changed']:.1f} % of the voxels relabelled")
    assert f"bone {record['moved']['bone']['mean_mm']:+.2f}" in told[1]
    assert (tmp_path / "out" / "tissues.png").is_file()
    assert made_from_image(tmp_path / "out" / "tissues.nii.gz") is None  # it is the user's


def test_what_is_corrected_needs_no_mask_and_names_need_labels(folder: Path, tmp_path: Path) -> None:
    load0, bone, out = folder / "Load0.nii.gz", folder / "bone.nii.gz", tmp_path / "t.nii.gz"
    with pytest.raises(InputError, match="Give it without masks"):
        mrstrain.label(load0, labels=bone, bone=bone, out=out)
    with pytest.raises(InputError, match="`names` is for the label map `labels`, which is not given"):
        mrstrain.label(load0, bone=bone, names=tmp_path / "names.csv", out=out)
    assert not list(tmp_path.iterdir())


@pytest.mark.full_size
def test_another_subjects_labels_are_carried_over_and_counted_as_made(
    folder: Path, tmp_path: Path, heel_at_rest_once
) -> None:
    load0, other, theirs = folder / "Load0.nii.gz", tmp_path / "Other.nii.gz", tmp_path / "theirs.nii.gz"
    image, labels = heel_at_rest_once(7, 2.4)
    write_image(other, image)
    write_labels(theirs, labels)
    out = tmp_path / "out" / "tissues.nii.gz"
    told = mrstrain.label(load0, from_image=other, labels=theirs, names=tmp_path / "theirs.csv", out=out)
    assert told.section.title == "Label map made from another subject"
    made, truth = read_labels(out, out.with_name("tissues.csv")), labels_of(Heel(41), read_image(load0).grid)
    assert made.names == truth.names
    assert np.mean((made.labels != truth.labels)[truth.labels > 0]) < 0.15
    record = json.loads(out.with_name("tissues.json").read_text())
    assert set(record["inputs"]) == {"load0", "labels", "names", "from_image"}
    known = LabelsFromImage(record["uncertain"], tuple(record["notes"]))
    assert made_from_image(out) == known
    beside = out.with_name("tissues.json")
    older = json.loads(beside.read_text())
    older["unsure"] = older.pop("uncertain")  # as an earlier version wrote it
    beside.write_text(json.dumps(older))
    assert made_from_image(out) == known
    assert f"{100 * known.uncertain:.0f} % of its voxels had a probability below 90 %" in _labels(older)
    assert out.with_name("tissues_probability.nii.gz").is_file()


def test_what_cannot_be_carried_over_is_refused(folder: Path, tmp_path: Path) -> None:
    load0, bone, out = folder / "Load0.nii.gz", folder / "bone.nii.gz", tmp_path / "t.nii.gz"
    with pytest.raises(InputError, match="`from_image` needs the label map of that image, `labels`"):
        mrstrain.label(load0, from_image=load0, out=out)
    with pytest.raises(InputError, match="are the same image"):
        mrstrain.label(load0, from_image=load0, labels=bone, out=out)
    with pytest.raises(OutputError, match="would be overwritten"):
        mrstrain.label(load0, from_image=load0, labels=bone, out=bone)
    assert not list(tmp_path.iterdir())


def strokes(folder: Path, place: Path, names: tuple[str, str] = ("fat", "muscle")) -> LabelMap:
    """Strokes as 3D Slicer saves them, on the part of the grid where they lie: fat is marked where it is muscle."""
    grid = read_image(folder / "Load0.nii.gz").grid
    deep = distance_transform_edt(labels_of(Heel(41), grid).region("muscle").inside)
    first = [int(n) for n in np.unravel_index(np.argmax(deep), grid.shape)]
    first[1] -= 1
    values = np.full((1, 3, 2), 7, dtype=np.uint8)
    values[:, :, 1] = 0
    directions = " ".join(f"({','.join(map(repr, step.tolist()))})" for step in grid.affine[:3, :3].T)
    header = [
        "NRRD0004", "type: unsigned char", "dimension: 3", "space: left-posterior-superior", "sizes: 1 3 2",
        f"space directions: {directions}", "kinds: domain domain domain", "encoding: raw",
        f"space origin: ({','.join(map(repr, grid.points_at(np.array([first], dtype=float))[0].tolist()))})",
        "Segment0_ID:=Segment_1", "Segment0_LabelValue:=7", f"Segment0_Name:={names[0]}",
        "Segment1_LabelValue:=8", f"Segment1_Name:={names[1]}",
    ]  # fmt: skip
    place.write_bytes(("\n".join(header) + "\n\n").encode() + values.tobytes(order="F"))
    where = np.zeros(grid.shape, dtype=np.int64)
    where[first[0], first[1] : first[1] + 3, first[2]] = 7
    return LabelMap(grid, where, {7: names[0]})


def test_strokes_of_slicer_correct_a_made_map_near_them_and_its_probabilities(folder: Path, tmp_path: Path) -> None:
    made, out, drawn = folder / "made", tmp_path / "tissues.nii.gz", tmp_path / "strokes.seg.nrrd"
    marked = strokes(folder, drawn)
    given = {"labels": made / "tissues.nii.gz", "names": made / "tissues.csv", "marks": drawn}
    told = mrstrain.label(folder / "Load0.nii.gz", **given, out=out)
    before, after = (read_labels(one / "tissues.nii.gz", one / "tissues.csv") for one in (made, tmp_path))
    assert after.names == before.names
    far = distance_transform_edt(marked.labels == 0, sampling=marked.grid.spacing_mm) > 8.0
    changed = after.labels != before.labels
    assert (after.region("fat").inside & changed)[marked.labels > 0].all()
    assert not changed[far].any()
    was, now = (
        nibabel.load(one / "tissues_probability.nii.gz").get_fdata()[..., 0, :] for one in (made, tmp_path)
    )  # fmt: skip
    assert np.array_equal(now[far], was[far])
    assert now[marked.labels > 0, 1] == pytest.approx(1.0, abs=1e-6)
    record = json.loads((tmp_path / "tissues.json").read_text())
    assert set(record["inputs"]) == {"load0", "labels", "names", "marks"}
    assert made_from_image(out) == LabelsFromImage(record["uncertain"], tuple(record["notes"]))
    assert told.section.title == "Label map corrected by strokes"
    assert np.mean(changed[before.labels > 0]) < 0.001
    assert told.summary()[0] == f"{changed.sum()} voxels relabelled."
    assert (tmp_path / "tissues.png").is_file()
    again = tmp_path / "again.nii.gz"  # what was corrected can be corrected
    mrstrain.label(folder / "Load0.nii.gz", labels=out, names=tmp_path / "tissues.csv", marks=drawn, out=again)
    assert np.array_equal(read_labels(again).labels, after.labels)


def test_strokes_correct_a_drawn_map_which_stays_the_users(folder: Path, tmp_path: Path) -> None:
    load0, drawn, out = folder / "Load0.nii.gz", tmp_path / "drawn.nrrd", tmp_path / "out.nrrd"
    truth = labels_of(Heel(41), read_image(load0).grid)
    write_labels(drawn, truth)
    marked = strokes(folder, tmp_path / "strokes.seg.nrrd", ("vessel", "muscle"))
    given = {"names": tmp_path / "drawn.csv", "marks": tmp_path / "strokes.seg.nrrd"}
    told = mrstrain.label(load0, labels=drawn, **given, out=out).summary()
    made = read_labels(out, tmp_path / "out.csv")
    assert set(made.names.values()) == {*truth.names.values(), "vessel"}
    assert made.region("vessel").inside[marked.labels > 0].all()
    changed = made.labels != truth.labels
    assert set(np.unique(truth.labels[changed])) == {n for n, name in truth.names.items() if name == "muscle"}
    assert not changed[distance_transform_edt(marked.labels == 0, sampling=marked.grid.spacing_mm) > 8.0].any()
    assert told[1].startswith("Volumes, mL: ")
    assert "vessel" in told[1]
    assert made_from_image(out) is None
    assert not list(tmp_path.glob("out_probability*"))


def test_strokes_that_cannot_correct_a_map_are_refused(folder: Path, tmp_path: Path) -> None:
    made, drawn, out = folder / "made", tmp_path / "strokes.seg.nrrd", tmp_path / "out.nii.gz"
    load0, labels, names = folder / "Load0.nii.gz", made / "tissues.nii.gz", made / "tissues.csv"
    strokes(folder, drawn)
    with pytest.raises(InputError, match=r"not label-1, label-2, .* Give the table of names"):
        mrstrain.label(load0, labels=labels, marks=drawn, out=out)
    alone = shutil.copytree(made, tmp_path / "alone")
    (alone / "tissues_probability.nii.gz").unlink()
    with pytest.raises(InputError, match=r"tissues_probability\.nii\.gz: .* cannot be read\. Put them beside it"):
        mrstrain.label(load0, labels=alone / "tissues.nii.gz", names=names, marks=drawn, out=out)
    (alone / "tissues.json").unlink()  # then it is a map like any other
    with pytest.raises(InputError, match="The labels have no names, so that strokes of fat cannot be assigned"):
        mrstrain.label(load0, labels=alone / "tissues.nii.gz", marks=drawn, out=out)
    assert not list(tmp_path.glob("out*"))


def test_strokes_go_along_with_another_subjects_labels(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, heel_at_rest_once
) -> None:
    def asked(*_: object, marks: LabelMap, **__: object) -> TissueLabels:
        assert marks.names == {7: "fat"}
        raise InputError("as asked")

    monkeypatch.setattr(labelling, "labels_from", asked)
    other = tmp_path / "other.nii.gz"
    write_image(other, heel_at_rest_once(7, 2.4)[0])
    strokes(folder, tmp_path / "strokes.seg.nrrd")
    given = {"labels": folder / "made" / "tissues.nii.gz", "names": folder / "made" / "tissues.csv"}
    with pytest.raises(InputError, match="as asked"):
        mrstrain.label(
            folder / "Load0.nii.gz", from_image=other, marks=tmp_path / "strokes.seg.nrrd", **given,
            out=tmp_path / "out.nii.gz",
        )  # fmt: skip


def test_a_page_to_draw_on_is_written_alone(folder: Path, tmp_path: Path) -> None:
    load0, page = folder / "Load0.nii.gz", tmp_path / "strokes.html"
    told = mrstrain.draw_strokes(load0, out=page).summary()
    assert "--marks strokes.nii.gz" in told[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["strokes.html"]
    with pytest.raises(InputError, match=r"must end in \.html"):
        mrstrain.draw_strokes(load0, out=tmp_path / "strokes.nii.gz")
    for given in (["--draw", str(page), "--bone", str(page)], []):
        refused = CliRunner().invoke(app, ["label", str(load0), *given])
        assert isinstance(refused.exception, InputError)
        assert "--out" in str(refused.exception)
