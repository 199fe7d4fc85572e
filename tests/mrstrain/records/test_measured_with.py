"""What a measurement was made with is found again where it is now, or it is said what is wrong and what to give."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from dvc.errors import InputError
from dvc.io.result_folder import PROVENANCE, ResultFolder
from mrstrain.records.measured_with import MeasuredWith
from mrstrain.records.provenance import provenance


def write_record(load: Path, engine: str = "gauss-newton", **inputs: Path) -> ResultFolder:
    load.mkdir(parents=True, exist_ok=True)
    how = {"bone_label": "calcaneus", "engine": engine}
    (load / PROVENANCE).write_text(json.dumps(provenance("register", inputs, how)))
    return ResultFolder(load)


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A label map in a folder, a bone beside the results of two loads, and work that is done elsewhere."""
    place = tmp_path / "project"
    (place / "heel").mkdir(parents=True)
    (place / "heel" / "tissues[1].nii.gz").write_text("labels")
    (place / "bone.nii.gz").write_text("bone")
    for load in ("Load1", "Load2"):
        write_record(place / "results" / load, labels=place / "heel" / "tissues[1].nii.gz", bone=place / "bone.nii.gz")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    return place


def recorded(project: Path) -> MeasuredWith:
    found = MeasuredWith.read(project / "results" / "Load1")
    assert found is not None
    return found


def test_files_beside_the_results_and_in_folders_there_are_found_also_when_all_is_moved(project: Path) -> None:
    moved = project.rename(project.with_name("moved"))
    found = recorded(moved)
    assert found.file("bone") == moved / "bone.nii.gz"
    assert found.file("labels") == moved / "heel" / "tissues[1].nii.gz"
    assert found.file("tissue") is None  # measured without it
    assert found.parameters["bone_label"] == "calcaneus"


def test_results_that_were_moved_alone_find_their_files_from_where_one_works(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = tmp_path / "a" / "b" / "c" / "d"
    shutil.move(project / "results", far / "results")
    with pytest.raises(InputError, match=r"bone mask bone.nii.gz .* neither in the folders around the results nor"):
        recorded(far).file("bone")
    monkeypatch.chdir(project)
    assert recorded(far).file("bone") == Path("bone.nii.gz")


def test_a_changed_file_is_refused_and_another_of_its_name_is_not_taken_for_it(project: Path) -> None:
    (project / "bone.nii.gz").write_text("another bone")
    with pytest.raises(InputError) as refused:
        recorded(project).file("bone")
    for told in ("Load1/provenance.json", "project/bone.nii.gz is not the bone mask", "as bone (--bone)"):
        assert told in str(refused.value)
    (project / "heel" / "bone.nii.gz").write_text("bone")  # the one that was measured with, further away
    assert recorded(project).file("bone") == project / "heel" / "bone.nii.gz"


def test_a_file_that_is_gone_is_named_with_the_record_and_the_option(project: Path) -> None:
    (project / "heel" / "tissues[1].nii.gz").unlink()
    with pytest.raises(InputError) as refused:
        recorded(project).file("labels")
    for told in ("Load1/provenance.json", "label map tissues[1].nii.gz", "as labels (--labels)"):
        assert told in str(refused.value)


def test_loads_share_a_record_unless_they_were_measured_with_something_else(project: Path) -> None:
    loads = [ResultFolder(project / "results" / load) for load in ("Load1", "Load2")]
    assert MeasuredWith.shared(loads, "x").path == project / "results" / "Load1" / PROVENANCE
    (project / "other.nii.gz").write_text("other bone")
    write_record(loads[1].folder, labels=project / "heel" / "tissues[1].nii.gz", bone=project / "other.nii.gz")
    with pytest.raises(InputError, match=r"Load1.*Load2.*not measured with the same bone mask\. Give x"):
        MeasuredWith.shared(loads, "x")
    assert MeasuredWith.shared(loads, "x", ("labels", "bone_label"))  # alike in what counts here
    files = {"labels": project / "heel" / "tissues[1].nii.gz", "bone": project / "bone.nii.gz"}
    write_record(loads[1].folder, "elastix", **files)
    with pytest.raises(InputError, match="not measured with the same engine"):
        MeasuredWith.shared(loads, "x")


def test_a_record_that_is_missing_or_is_none_is_named(project: Path) -> None:
    path = project / "results" / "Load1" / PROVENANCE
    for damaged in ("{", "[]", '{"inputs": {"labels": [{"name": "a"}]}, "parameters": {}}'):
        path.write_text(damaged)
        with pytest.raises(InputError, match=r"provenance.json: not the record of a measurement"):
            MeasuredWith.read(path.parent)
    path.unlink()
    assert MeasuredWith.read(path.parent) is None
    with pytest.raises(InputError, match=r"provenance.json is missing.* Give the label map"):
        MeasuredWith.shared([ResultFolder(path.parent)], "the label map")
