"""A label map from a segmenter of the user's choice: run in a study, and refused with what it said."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import psutil
import pytest

from dvc import Grid, LabelMap, read_image, read_labels, write_image, write_labels
from dvc.errors import InputError, MrstrainError
from mrstrain.measurement.command import run_command
from mrstrain.measurement.label_command import labelled_by_command
from mrstrain.studies.check import check
from mrstrain.studies.cluster import _kill
from mrstrain.studies.file import read_study
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.plan import plan
from tests.mrstrain.studies.test_interrupt import OVER_S
from tests.processes import is_gone, wait_for

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
        ("'{python}' -c 'import os; os.kill(os.getpid(), 9)' {image} {labels}", "signal 9 ended it, most often for"),
        ("'{python}' -c 'input()' {image} {labels}", "EOFError"),
        ("'{python}' copy.py empty.nii.gz {labels} {image}", "empty"),
        ("'{python}' copy.py elsewhere.nii.gz {labels} {image}", "only 0 % of its volume is inside the image"),
        ("'{python}' copy.py segment.py {labels} {image}", "_of_command.nii.gz"),
        ("segment {image}", "the command needs {labels} where it takes the label map"),
        ("segment '{image} {labels}", "No closing quotation"),
    ],
)
def test_a_command_that_fails_is_told_and_leaves_nothing(folder, command, told):
    command, drawn = command.replace("{python}", sys.executable), read_labels(folder / "drawn.nii.gz")
    (folder / "copy.py").write_text("import shutil, sys\nshutil.copy(*sys.argv[1:3])\n")
    grid = drawn.grid
    elsewhere = Grid(grid.shape, grid.spacing_mm, grid.origin_mm + 500.0)
    write_labels(folder / "elsewhere.nii.gz", LabelMap(elsewhere, drawn.labels, drawn.names))
    write_labels(folder / "empty.nii.gz", LabelMap(grid, np.zeros_like(drawn.labels), drawn.names))
    with pytest.raises(MrstrainError, match=re.escape(told)):
        labelled_by_command(folder / "Load0.nii.gz", command, None, folder / "results" / "tissues.nii.gz")
    assert not (folder / "results").exists()


def test_a_long_command_is_told_to_go_on_and_may_use_all_cores(folder, monkeypatch):
    monkeypatch.setattr("mrstrain.measurement.command._LOOK_EVERY_S", 0.05)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    (folder / "slow.py").write_text(
        "import os, shutil, sys, time\nassert 'OMP_NUM_THREADS' not in os.environ\n"
        "while time.process_time() < 1.0: pass\n"
        "shutil.copy('drawn.nii.gz', sys.argv[1])\n"
    )
    told, command = list[float](), f"'{sys.executable}' slow.py {{labels}} {{image}}"
    out = folder / "results" / "tissues.nii.gz"
    labelled_by_command(folder / "Load0.nii.gz", command, folder / "drawn.csv", out, watch=told.append)
    assert len(told) > 4
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_command_that_hangs_is_not_told_to_go_on(tmp_path, monkeypatch):
    """So the study names it after ten minutes, and ends it after an hour."""
    monkeypatch.setattr("mrstrain.measurement.command._LOOK_EVERY_S", 1.0)
    told = list[float]()
    run_command([sys.executable, "-S", "-c", "import time; time.sleep(6.0)"], tmp_path, told.append)
    assert len(told) <= 2  # while it starts


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes")
def test_what_a_command_leaves_behind_is_ended(tmp_path):
    """Also where that holds the command's output open, and does not listen."""
    (tmp_path / "stays.sh").write_text("trap '' TERM\necho $$ > left\nexec sleep 1000\n")
    began = time.monotonic()
    command = "sh stays.sh & until [ -s left ]; do sleep 0.1; done; echo done"
    assert run_command(["sh", "-c", command], tmp_path, lambda _: None) == (0, "done\n")
    assert time.monotonic() - began < 60.0
    # Killed by then, but it ends only when it gets a core.
    wait_for(lambda: is_gone(int((tmp_path / "left").read_text())), limit_s=60.0)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes")
def test_a_command_ends_with_a_process_that_is_killed_at_its_first_instruction(tmp_path):
    (tmp_path / "run.py").write_text(
        "import os, pathlib\nfrom mrstrain.measurement.command import run_command\n"
        "pathlib.Path('above').write_text(str(os.getpid()))\n"
        "run_command(['sh', '-c', 'echo $$ > below; kill -9 $(cat above); exec sleep 1000'], '.', print)\n"
    )
    for _ in range(5):
        above = subprocess.run([sys.executable, "run.py"], cwd=tmp_path, check=False)
        assert above.returncode == -signal.SIGKILL
        below = int((tmp_path / "below").read_text())
        wait_for(lambda: is_gone(below), limit_s=OVER_S)  # noqa: B023


@pytest.fixture
def running(tmp_path) -> Iterator[tuple[psutil.Process, int]]:
    """The guard of a command that runs, and the command, below a process of their own."""
    (tmp_path / "run.py").write_text(
        "from mrstrain.measurement.command import run_command\n"
        "print(run_command(['sh', '-c', 'echo $$ > below; trap \"\" TERM; sleep 1000 & wait'], '.', print))\n"
    )
    with subprocess.Popen([sys.executable, "run.py"], cwd=tmp_path, stderr=subprocess.PIPE, text=True) as above:
        wait_for(lambda: (tmp_path / "below").is_file() and (tmp_path / "below").read_text().strip() != "", above)
        (guard,) = psutil.Process(above.pid).children()
        yield guard, int((tmp_path / "below").read_text())
        above.kill()


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes")
def test_a_command_that_starts_while_the_processes_of_a_study_are_killed_ends(running):
    """As they were listed before: the guard and what is above it, but not the command."""
    guard, command = running
    _kill([guard.parent(), guard])
    wait_for(lambda: is_gone(command), limit_s=OVER_S)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes")
def test_a_command_ends_with_its_guard(running):
    guard, command = running
    above = guard.parent()
    guard.terminate()  # as a batch system does to every process
    wait_for(lambda: is_gone(command), limit_s=OVER_S)
    wait_for(lambda: is_gone(above.pid), limit_s=OVER_S)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes")
def test_an_interrupt_returns_only_when_the_command_has_ended(running):
    guard, command = running
    above = guard.parent()
    above.send_signal(signal.SIGINT)
    wait_for(lambda: is_gone(above.pid) or is_gone(command), limit_s=OVER_S)
    assert is_gone(command)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes")
def test_a_guard_that_is_killed_is_not_taken_for_the_command(tmp_path):
    said = "the process that watches over it was killed"
    with pytest.raises(ChildProcessError, match=said):
        run_command(["sh", "-c", "kill -9 $PPID"], tmp_path, lambda _: None)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes")
@pytest.mark.parametrize("by", [pytest.param(signal.SIGINT, marks=pytest.mark.full_size), signal.SIGKILL])
def test_a_study_that_is_ended_leaves_no_segmenter(folder, by):
    segmenter = "sh -c 'sleep 1000 & echo $! $$ > processes; sleep 1000' {image} {labels}"
    write_image(folder / "Load1.nii.gz", read_image(folder / "Load0.nii.gz"))
    (folder / "study.toml").write_text(STUDY.replace("segment {image} {labels}", segmenter))
    command = [sys.executable, "-m", "mrstrain", "run", str(folder), "--only", "label", "--no-open"]
    study, begun = subprocess.Popen(command, start_new_session=True), folder / "processes"
    try:
        wait_for(lambda: begun.is_file() and len(begun.read_text().split()) == 2, study)
        os.killpg(study.pid, by)
        began, below = time.monotonic(), [int(one) for one in begun.read_text().split()]
        wait_for(lambda: all(map(is_gone, below)), limit_s=OVER_S)
        print(f"over after {time.monotonic() - began:.1f} s")
    finally:
        with suppress(ProcessLookupError):
            os.killpg(study.pid, signal.SIGKILL)
        study.wait()


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
