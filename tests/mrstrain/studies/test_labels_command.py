"""A label map from a segmenter of the user's choice: run in a study, and refused with what it said."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from dvc import read_labels, write_image, write_labels
from dvc.errors import InputError, MrstrainError
from mrstrain.measurement.label_command import labelled_by_command
from mrstrain.studies.check import check
from mrstrain.studies.file import read_study
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.plan import plan

SEGMENTER = """
import shutil, sys
assert sys.argv[1].endswith("Load0.nii.gz"), sys.argv
shutil.copy("drawn.nii.gz", sys.argv[2])
"""
STUDY = """
[study]
name = "Heel"
[images]
load0 = "Load0.nii.gz"
labels = "auto"
labels_command = "segment {image} {labels}"
names = "drawn.csv"
bone = "bone"
[loads.Load1]
image = "Load1.nii.gz"
"""


@pytest.fixture
def folder(tmp_path, tiny_pair) -> Path:
    place = tmp_path / "a heel"  # a space in the path
    place.mkdir()
    write_image(place / "Load0.nii.gz", tiny_pair.reference)
    write_labels(place / "drawn.nii.gz", tiny_pair.labels)
    (place / "segment.py").write_text(SEGMENTER)
    return place


def test_what_the_command_writes_is_the_label_map(folder, tiny_pair):
    out, command = folder / "results" / "tissues.nii.gz", f"'{sys.executable}' segment.py {{image}} {{labels}}"
    done = labelled_by_command(folder / "Load0.nii.gz", command, folder / "drawn.csv", out)
    made = read_labels(out, out.with_name("tissues.csv"))
    assert np.array_equal(made.labels, tiny_pair.labels.labels)
    assert made.names == tiny_pair.labels.names
    assert json.loads(out.with_name("tissues.json").read_text())["parameters"]["command"] == command
    assert {path.name for path in out.parent.iterdir()} == {
        "tissues.nii.gz", "tissues.csv", "tissues.json", "tissues.png", "tissues.pdf",
    }  # fmt: skip
    assert done.section.paragraphs == (f"Made by the command: {command}",)


@pytest.mark.parametrize(
    ("command", "told"),
    [
        ("no-such-segmenter {image} {labels}", "no-such-segmenter cannot be run (No such file or directory)"),
        ("'{python}' -c 'import sys; sys.exit(\"no GPU\")' {image} {labels}", "status 1"),
        ("'{python}' -c 'import sys; sys.exit(\"no GPU\")' {image} {labels}", "no GPU"),
        ("'{python}' -c 'print(1)' {image} {labels}", "it wrote no file in place of {labels}"),
        ("segment {image}", "the command needs {labels} where it takes the label map"),
        ("segment '{image} {labels}", "No closing quotation"),
    ],
)
def test_a_command_that_fails_is_told_and_leaves_nothing(folder, command, told):
    command = command.replace("{python}", sys.executable)
    with pytest.raises(MrstrainError, match=re.escape(told)):
        labelled_by_command(folder / "Load0.nii.gz", command, None, folder / "results" / "tissues.nii.gz")
    assert not (folder / "results").exists()


def test_a_long_command_is_told_to_go_on_and_may_use_all_cores(folder, monkeypatch):
    monkeypatch.setattr("mrstrain.measurement.label_command._TOLD_EVERY_S", 0.05)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    (folder / "slow.py").write_text(
        "import os, shutil, sys, time\ntime.sleep(1.0)\nassert 'OMP_NUM_THREADS' not in os.environ\n"
        "shutil.copy('drawn.nii.gz', sys.argv[1])\n"
    )
    told, command = list[float](), f"'{sys.executable}' slow.py {{labels}} {{image}}"
    out = folder / "results" / "tissues.nii.gz"
    labelled_by_command(folder / "Load0.nii.gz", command, folder / "drawn.csv", out, watch=told.append)
    assert len(told) > 4
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_study_runs_it_as_its_first_stage(folder):
    (folder / "study.toml").write_text(STUDY)
    stage = plan(read_study(folder))[0]
    assert stage.name == "label"
    assert stage.arguments["command"] == "segment {image} {labels}"
    assert [path.name for path in stage.files] == ["Load0.nii.gz", "drawn.csv"]
    script = STUDY.replace("segment {image}", "/opt/a/python segment.py {image}")
    (folder / "study.toml").write_text(script)
    first = plan(read_study(folder))[0]
    assert [path.name for path in first.files] == ["Load0.nii.gz", "drawn.csv", "segment.py"]
    (folder / "study.toml").write_text(script.replace("/opt/a", "/opt/b"))  # folders do not count, the hash does
    ledger = Ledger(folder / "results", folder)
    keys = [ledger.made_from(stage, stage.arguments)["arguments"] for stage in (first, plan(read_study(folder))[0])]
    assert keys[0]["command"] == keys[1]["command"]
    assert keys[0] != keys[1]
    (folder / "study.toml").write_text(STUDY.replace('bone = "bone"', 'bone = "calcaneus"'))
    assert "has no label 'calcaneus'; it has bone, fat" in "\n".join(check(folder).wrong)
    for old, new, told in (
        ('"auto"', '"drawn.nii.gz"', "only for labels"),
        (" {labels}", "", "needs {labels}"),
        ('bone = "bone"', 'marks = "m.nii.gz"', "without 'marks'"),
    ):
        (folder / "study.toml").write_text(STUDY.replace(old, new, 1))
        with pytest.raises(InputError, match=re.escape(told)):
            read_study(folder)
