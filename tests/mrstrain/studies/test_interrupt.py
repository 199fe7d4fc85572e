"""Ctrl-C: said at once, over within seconds, with no process left and what is finished kept."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from mrstrain.studies.run import forecast
from tests.processes import under_way, wait_for

SAID_S, OVER_S = 2.0, 10.0


def interrupted(command: list[str], err: Path, begun: Callable[[], bool], *, group: bool) -> None:
    """Start a command, interrupt it or its group once it has begun, and see that it ends as it should."""
    with err.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "mrstrain", *command], stdout=subprocess.DEVNULL, stderr=errors,
            start_new_session=True,
        )  # fmt: skip
    try:
        wait_for(begun, process)
        below = psutil.Process(process.pid).children(recursive=True)
        (os.killpg if group else os.kill)(process.pid, signal.SIGINT)
        began = time.monotonic()
        while b"Stopping." not in err.read_bytes():
            assert time.monotonic() - began < SAID_S, "it did not say so"
            time.sleep(0.05)
        status = process.wait(timeout=OVER_S)
        assert status != 0
        _, left = psutil.wait_procs(below, timeout=max(0.1, OVER_S - (time.monotonic() - began)))
        assert not [one for one in left if one.status() != psutil.STATUS_ZOMBIE]
        told = err.read_text()
        assert "Traceback" not in told, told
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@pytest.mark.parametrize("group", [False, True], ids=["process", "group"])
def test_a_study_ends_and_goes_on(images, tmp_path, group):
    study = tmp_path / "study"
    shutil.copytree(images, study)
    records = study / "results" / ".study"
    command = ["run", str(study), "--only", "register", "--workers", "1"]
    interrupted(command, tmp_path / "err.txt", lambda: under_way(records, "register Load1"), group=group)
    assert (records / "register repeat.json").is_file()
    told = forecast(study, only=["register"])
    assert told["register repeat"] == "done already"
    assert told["register Load1"] == "run"
    assert "interrupted" in (study / "results" / "report.html").read_text().lower()


@pytest.mark.parametrize("group", [False, True], ids=["process", "group"])
def test_a_registration_ends(images, tmp_path, group):
    given = [str(images / name) for name in ("Load0.nii.gz", "Load1.nii.gz")]
    out, err = tmp_path / "out", tmp_path / "err.txt"
    command = ["register", *given, "--align", "image", "--out", str(out)]
    interrupted(command, err, lambda: err.exists() and b"aligning" in err.read_bytes(), group=group)
    assert not out.exists() or list(out.iterdir()) == []
