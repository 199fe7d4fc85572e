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
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import psutil
import pytest

from dvc.io.images.write import write_labels
from fe import write_tet_mesh
from mrstrain.studies.run import forecast
from mrstrain.truth.accuracy import _finished
from tests.fe.test_meshing import half_onion
from tests.fe.test_simulate import dome
from tests.processes import is_gone, under_way, wait_for

COMPUTED_S, SAID_S, OVER_S = 20.0, 15.0, 50.0
"""What a command may compute after an interrupt, seconds of processor time, which other programs make hardly longer;
and the times until it says so and until it is over, which they do. On a machine that has nothing else to do it is over
in two seconds, unless a loop is compiled for the first time at that moment, which takes up to ten."""

slow = partial(pytest.param, marks=pytest.mark.full_size)  # `make test` has one of process and group for most commands


def interrupted(
    command: list[str], err: Path, begun: Callable[[psutil.Process], bool], *, group: bool, by: int = signal.SIGINT
) -> int:
    """Start a command, interrupt it or its group once it has begun, and see that it ends as it should; its status."""
    with err.open("wb") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "mrstrain", *command], stdout=subprocess.DEVNULL, stderr=errors,
            start_new_session=True,
        )  # fmt: skip
    try:
        wait_for(lambda: begun(psutil.Process(process.pid)), process)
        below = psutil.Process(process.pid).children(recursive=True)
        family = [psutil.Process(process.pid), *below]
        before = computed_s(family)
        (os.killpg if group else os.kill)(process.pid, by)
        began, after = time.monotonic(), dict(before)
        said, said_s = by != signal.SIGINT, 0.0
        while process.poll() is None or not all(is_gone(one.pid) for one in below):
            passed = time.monotonic() - began
            if not said and "Stopping." in err.read_text():
                said, said_s = True, passed
            assert said or passed < SAID_S, "it did not say so in time"
            assert passed < OVER_S, "it is not over"
            after |= computed_s(family)
            time.sleep(0.05)
        told_s = f"told after {said_s:.1f} s, " if by == signal.SIGINT else ""
        print(f"{command[0]}: {told_s}over after {time.monotonic() - began:.1f} s")
        assert sum(after.values()) - sum(before.values()) < COMPUTED_S, "it went on"
        told = err.read_text()
        assert by != signal.SIGINT or "Stopping." in told, "it did not say so"
        assert "Traceback" not in told, told
        assert process.returncode != 0
        return process.returncode
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def computed_s(processes: list[psutil.Process]) -> dict[int, float]:
    """Processor time of each process that is there, by its number."""
    seconds = dict[int, float]()
    for one in processes:
        with suppress(psutil.Error):
            seconds[one.pid] = sum(one.cpu_times()[:2])
    return seconds


@pytest.mark.parametrize("group", [slow(False, id="process"), slow(True, id="group")])
def test_a_study_ends_and_goes_on(images, tmp_path, group, monkeypatch):
    study, temporary = tmp_path / "study", tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    shutil.copytree(images, study)
    records = study / "results" / ".study"
    command = ["run", str(study), "--only", "register", "--workers", "1"]
    interrupted(command, tmp_path / "err.txt", lambda _: under_way(records, "register Load1"), group=group)
    assert (records / "register repeat.json").is_file()
    told = forecast(study, only=["register"])
    assert told["register repeat"] == "up to date"
    assert told["register Load1"] == "will run"
    assert "interrupted" in (study / "results" / "report.html").read_text().lower()
    assert list(temporary.iterdir()) == []


def test_a_study_whose_processes_hang_ends_and_leaves_nothing_in_shared_memory(images, tmp_path):
    study, below = tmp_path / "study", list[psutil.Process]()
    shutil.copytree(images, study)

    def hangs(process: psutil.Process) -> bool:
        if begun := under_way(study / "results" / ".study", "register repeat"):
            wait_for(lambda: any("popen_loky" in " ".join(one.cmdline()) for one in process.children(recursive=True)))
            below.extend(process.children(recursive=True))
            for one in below:
                if "resource_tracker" not in " ".join(one.cmdline()):
                    one.suspend()
        return begun

    command = ["run", str(study), "--only", "register repeat", "--workers", "1"]
    interrupted(command, tmp_path / "err.txt", hangs, group=False)
    assert "resource_tracker" not in (tmp_path / "err.txt").read_text()
    numbers = {str(one.pid) for one in below}
    shared = [file.name for file in Path("/dev/shm").glob("sem.loky-*") if file.name.split("-")[1] in numbers]
    assert shared == []


@pytest.mark.parametrize(
    ("by", "group"),
    [
        pytest.param(signal.SIGINT, False, id="process"), slow(signal.SIGINT, True, id="group"),
        pytest.param(signal.SIGTERM, False, id="told to end"),
    ],
)  # fmt: skip
def test_a_registration_ends(images, tmp_path, by, group):
    given = [str(images / name) for name in ("Load0.nii.gz", "Load1.nii.gz")]
    out, err = tmp_path / "out", tmp_path / "err.txt"
    command = ["register", *given, "--align", "image", "--out", str(out)]
    status = interrupted(command, err, lambda _: err.exists() and b"aligning" in err.read_bytes(), group=group, by=by)
    assert by == signal.SIGINT or status == 128 + by
    assert not out.exists() or list(out.iterdir()) == []


@dataclass(frozen=True)
class Case:
    """A command, when it is interrupted, and what is kept and not there then."""

    command: list[str]
    begun: Callable[[psutil.Process], bool]
    kept: Path | None
    absent: Path


def simulating(images: Path, folder: Path) -> Case:
    write_tet_mesh(folder / "dome.vtu", dome((4, 6, 6)), {})
    loads = [given for n in range(9) for given in ("--load", f"Load{n}=2,{0.3 * n}")]
    plate = ["--plate-normal", "-1", "0", "0", "--shear-direction", "0", "1", "0", "--workers", "1", "--set", "luboz"]
    command = ["simulate", str(folder / "dome.vtu"), *loads, *plate, "--out", str(folder / "out")]
    out = folder / "out" / "luboz"
    return Case(command, lambda _: (out / "Load0.vtu").is_file(), out / "Load0.restart.npz", out / "regions.csv")


def meshing(images: Path, folder: Path) -> Case:
    """A mesh of minutes, interrupted in the native code that makes it."""
    write_labels(folder / "labels.nii.gz", half_onion())
    (folder / "names.csv").write_text("label,name\n1,bone\n2,fat\n3,skin\n")
    command = ["mesh", str(folder / "labels.nii.gz"), "--names", str(folder / "names.csv"), "--edge-mm", "0.5"]
    return Case([*command, "--out", str(folder / "made.vtu")], works_below, None, folder / "made.vtu")


def works_below(process: psutil.Process) -> bool:
    """Whether a process that was started by this one has computed for a second since it was there."""
    with suppress(psutil.Error):
        return any(sum(one.cpu_times()[:2]) > 3.0 for one in process.children(recursive=True))
    return False


def measuring_accuracy(images: Path, folder: Path) -> Case:
    command = ["accuracy", "--out", str(folder / "out"), "--spacing", "3", "--seed", "1", "--workers", "1"]
    command += ["--preset", "gauss-newton"]
    motions = [given for name in ("still", "Load1", "Load2") for given in ("--motion", name)]
    run, report = folder / "out" / "runs" / "gauss-newton_3x3x3mm_snr25_still_1.npz", folder / "out/report.html"
    return Case([*command, *motions], lambda _: run.is_file(), run, report)


def running_a_cohort(images: Path, folder: Path) -> Case:
    shutil.copytree(images, folder / "study")
    records = folder / "study" / "results" / ".study"
    command = ["cohort", str(folder / "study"), "--out", str(folder / "out"), "--workers", "1"]
    return Case(command, lambda _: under_way(records, "register repeat"), None, folder / "out" / "report.html")


@pytest.mark.parametrize(
    ("case", "group"),
    [
        (simulating, False), slow(simulating, True), slow(meshing, False), (meshing, True),
        slow(measuring_accuracy, False), slow(running_a_cohort, True),  # whose studies run as that of `run` above
    ],
)  # fmt: skip
def test_a_command_ends_and_keeps_what_is_finished(case, group, images, tmp_path):
    made = case(images, tmp_path)
    interrupted(made.command, tmp_path / "err.txt", made.begun, group=group)
    assert made.kept is None or made.kept.is_file()
    assert not made.absent.exists()
    if case is measuring_accuracy:
        assert [run.case.motion for run in _finished(tmp_path / "out" / "runs").values()] == ["still"]


IN_A_TERMINAL = """
import fcntl, os, signal, sys, termios

signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which "nohup" leaves ignored
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, [sys.executable, "-m", "mrstrain", *sys.argv[1:]])
"""


@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="a terminal that is closed sends SIGHUP")
def test_a_command_ends_with_its_terminal(images, tmp_path):
    """What is finished is kept, as after Ctrl-C."""
    case = simulating(images, tmp_path)
    master, terminal = os.openpty()
    os.set_blocking(master, False)
    process = subprocess.Popen(
        [sys.executable, "-c", IN_A_TERMINAL, *case.command], stdin=terminal, stdout=terminal, stderr=terminal,
        start_new_session=True,
    )  # fmt: skip
    os.close(terminal)

    def begun() -> bool:
        with suppress(BlockingIOError):
            os.read(master, 1 << 16)  # a full terminal would stop the command
        return case.begun(psutil.Process(process.pid))

    try:
        wait_for(begun, process)
        below = psutil.Process(process.pid).children(recursive=True)
        assert below
        os.close(master)
        wait_for(lambda: process.poll() is not None and all(is_gone(one.pid) for one in below), limit_s=OVER_S)
        assert process.returncode == 128 + signal.SIGTERM
        assert case.kept is not None
        assert case.kept.is_file()
        assert not case.absent.exists()
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


NOTEBOOK = """
import time
from contextlib import suppress
import psutil
import mrstrain

def alive():
    for one in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):
            if one.status() != psutil.STATUS_ZOMBIE and "resource_tracker" not in " ".join(one.cmdline()):
                yield one.pid

try:
    {call}
except KeyboardInterrupt:
    ends = time.monotonic() + 10.0
    while (left := [*alive()]) and time.monotonic() < ends:
        time.sleep(0.1)
    print("interrupted", left)
"""


@pytest.mark.parametrize("function", [slow("run"), "simulate"])
def test_a_function_that_a_notebook_interrupts_raises_and_leaves_no_process(images, tmp_path, function):
    """The kernel goes on: it gets KeyboardInterrupt, and nothing computes beside it."""
    if function == "run":
        shutil.copytree(images, tmp_path / "study")
        call = f'mrstrain.run({str(tmp_path / "study")!r}, only=["register"], workers=1)'
        records = tmp_path / "study" / "results" / ".study"
        begun = partial(under_way, records, "register Load1")
    else:
        case = simulating(images, tmp_path)
        loads = ", ".join(f'LoadStep("Load{n}", 2.0, {0.3 * n})' for n in range(9))
        call = (
            f"from fe import LoadStep; mrstrain.simulate({case.command[1]!r}, out={str(tmp_path / 'out')!r}, "
            f'loads=[{loads}], sets=["luboz"], plate_normal=(-1, 0, 0), shear_direction=(0, 1, 0), workers=1)'
        )
        begun = partial(case.begun, psutil.Process())
    kernel = subprocess.Popen(
        [sys.executable, "-c", NOTEBOOK.format(call=call)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        start_new_session=True,
    )  # fmt: skip
    try:
        wait_for(begun, kernel)
        kernel.send_signal(signal.SIGINT)
        told, _ = kernel.communicate(timeout=OVER_S)
        assert told.splitlines()[-1] == "interrupted []", told
        assert kernel.returncode == 0
    finally:
        with suppress(ProcessLookupError):
            os.killpg(kernel.pid, signal.SIGKILL)
