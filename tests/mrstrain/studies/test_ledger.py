"""Records of finished stages: what they are made from, whose names they leave out, and damage that they notice."""

from __future__ import annotations

import hashlib
import json
import os

import pytest

from mrstrain.records.provenance import file_hash, without_folders
from mrstrain.studies.ledger import Ledger, StageRecord
from mrstrain.studies.plan import Stage
from tests.mrstrain.studies.test_pipeline import ran


def test_a_copy_of_a_result_with_another_date_is_whole(folder):
    ran(folder)
    os.utime(folder / "results" / "register_a", (1.0, 1.0))
    assert ran(folder)[0] == []


@pytest.mark.parametrize("same_date", [False, True])
def test_a_result_that_was_damaged_is_made_again(folder, same_date):
    """With as many bytes as before, and even with the same date, as on a damaged disk."""
    ran(folder)
    result = folder / "results" / "register_a"
    content, state = result.read_bytes(), result.stat()
    result.write_bytes(content[:-2] + b"7]")
    if same_date:
        os.utime(result, ns=(state.st_atime_ns, state.st_mtime_ns))
    assert ran(folder)[0] == ["register a", "compare"]
    assert result.read_bytes() == content


def test_a_record_of_an_earlier_version_is_read(folder):
    """It held the size and the date of each file too; a study of hours need not run again for that."""
    ran(folder)
    file = folder / "results" / ".study" / "register a.json"
    record = StageRecord.model_validate_json(file.read_bytes())
    state = (folder / "results" / "register_a").stat()
    files = {name: (state.st_size, state.st_mtime_ns, of) for name, of in record.files.items()}
    file.write_text(record.model_copy(update={"files": files}).sealed().model_dump_json())
    assert ran(folder)[0] == []
    (folder / "results" / "register_a").write_text("[8]")
    assert ran(folder)[0] == ["register a", "compare"]


@pytest.mark.parametrize(("right", "wrong"), [("1.0", "1e400"), ("a done", "b done"), ("{", "["), ("}", "")])
def test_a_record_that_was_damaged_is_made_again(folder, right, wrong):
    ran(folder)
    record = folder / "results" / ".study" / "register a.json"
    told = record.read_text()
    assert right in told
    record.write_text(told.replace(right, wrong))
    assert ran(folder)[0] == ["register a", "compare"]
    assert ran(folder)[0] == []


@pytest.mark.parametrize("place", ["../elsewhere", "register_b", "{out}/../elsewhere"])
def test_a_record_that_names_a_file_which_is_not_its_stages_own_is_not_believed(folder, place):
    ran(folder)
    (folder / "elsewhere").write_text("precious")
    place = place.format(out=folder / "results")
    file = folder / "results" / ".study" / "register a.json"
    record = StageRecord.model_validate_json(file.read_bytes())
    files = record.files | {place: file_hash(folder / "results" / place)}
    file.write_text(record.model_copy(update={"files": files}).sealed().model_dump_json())
    assert ran(folder)[0] == ["register a", "compare"]
    assert (folder / "elsewhere").read_text() == "precious"
    assert ran(folder)[0] == []


def test_records_name_no_folders_outside_the_study(tmp_path):
    home = tmp_path / "Müller"
    given = {
        "in": str(home / "a" / "Load0.nii.gz"), "up": str(home / ".." / "Doe_Jane" / "x.nii"), "n": 1.5,
        "far": [str(tmp_path / "Doe_Jane" / "y.csv"), "../Doe_Jane/z.toml", "b/w.toml", "trebbi", ""], "none": None,
        "dicom": [str(tmp_path / "Doe_John"), "../Doe_John"],
    }  # fmt: skip
    (tmp_path / "Doe_John").mkdir()
    assert without_folders(given, home) == {
        "in": "a/Load0.nii.gz", "up": "x.nii", "n": 1.5,
        "far": ["y.csv", "z.toml", "b/w.toml", "trebbi", ""], "none": None, "dicom": ["a folder", "a folder"],
    }  # fmt: skip


def test_what_is_told_of_a_failure_names_no_folders_outside_the_study(tmp_path):
    home = tmp_path / "study"
    far, up = tmp_path / "Doe_Jane" / "x.nii", home / ".." / "Doe_John" / "y.nii"
    stage = Stage("register a", {}, (far, up, home / "z.nii"), (home / "results" / "a",))
    text = f"{far}: no image. {up}, in {tmp_path / 'Doe_John'}: none. {home / 'z.nii'}: none."
    told = Ledger(home / "results", home).impersonal(text, stage)
    assert told == "x.nii: no image. y.nii, in a folder: none. z.nii: none."


def test_what_is_told_of_a_failure_names_no_folders_one_within_another(tmp_path):
    home, dicom = tmp_path / "Doe_Jane", tmp_path / "Doe_Jim" / "DICOM"
    dicom.mkdir(parents=True)
    files = (home / ".." / "p.txt", tmp_path / "q.txt", dicom, tmp_path / "Doe_Jim" / "r.nii", home / "z.nii")
    text = f"{home / 'z.nii'}, {files[0]}, {files[1]}, {dicom / 'IM1'}, {dicom}, {files[3]}: none."
    for given in (files, files[::-1]):
        stage = Stage("register a", {}, given, (home / "results" / "a",))
        told = Ledger(home / "results", home).impersonal(text, stage)
        assert told == "z.nii, p.txt, q.txt, IM1, a folder, r.nii: none."


def test_a_record_tells_what_it_was_made_from(folder):
    _, outcomes, _ = ran(folder)
    record = outcomes["mesh"].record
    assert record.made_from["files"] == [["labels.txt", hashlib.sha256(b"labels").hexdigest()]]
    assert record.made_from["arguments"]["number"] == 1
    assert str(folder) not in json.dumps(record.made_from)
