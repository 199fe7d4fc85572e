"""A user's command, such as a segmenter: it and all that it starts end with this process, however that ends."""

import errno
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import psutil

from mrstrain.measurement import guard

_ONE_THREAD = {"OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"}
"""Variables by which the stages of a study keep to a core each."""
_LOOK_EVERY_S = 5.0
_WORKS = 0.01  # of a core: less is what a program takes to wait
_SAID_BYTES = 1 << 16


def run_command(parts: Sequence[str], folder: Path, goes_on: Callable[[float], None]) -> tuple[int, str]:
    """Run a command, which may use all cores and cannot ask questions; return its status and the end of its output.

    Parameters
    ----------
    parts : sequence of str
        The command and its arguments.
    folder : path
        Folder in which it runs.
    goes_on : callable
        Called every 5 s with the seconds since the start, if the command has used processor time: not while it hangs.

    Raises
    ------
    OSError
        If it cannot be started.
    """
    free = {name: value for name, value in os.environ.items() if name not in _ONE_THREAD}
    began, computed_s = time.monotonic(), 0.0
    guarded = [sys.executable, "-I", "-S", guard.__file__, *parts]  # it is there before the command, and ends it
    with (
        tempfile.TemporaryFile() as said,  # not a pipe, which what it leaves behind could keep open
        subprocess.Popen(
            guarded, cwd=folder, env=free, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said,
            start_new_session=True,
        ) as running,
    ):  # fmt: skip
        assert running.stdin is not None
        assert running.stdout is not None
        try:
            while True:
                try:
                    running.wait(_LOOK_EVERY_S)
                    break
                except subprocess.TimeoutExpired:
                    before, computed_s = computed_s, _computed_s(running.pid)
                    if computed_s - before > _WORKS * _LOOK_EVERY_S:
                        goes_on(time.monotonic() - began)
        finally:
            running.stdin.close()  # as at the end of this process, even if it is killed: the guard ends the command
            running.wait()
        what, _, code = running.stdout.read().decode().strip().rpartition(" ")
        if what == "cannot start":
            raise OSError(int(code), os.strerror(int(code)))
        if what != "ended":
            raise ChildProcessError(errno.ECHILD, "the process that watches over it was killed")
        said.seek(max(0, said.seek(0, os.SEEK_END) - _SAID_BYTES))
        return int(code), said.read().decode(errors="replace")


def _computed_s(process: int) -> float:
    """Processor time of all below a process, with those that have ended, seconds."""
    seconds = 0.0
    with suppress(psutil.Error):
        for one in psutil.Process(process).children(recursive=True):
            with suppress(psutil.Error):
                seconds += sum(one.cpu_times()[:4])
    return seconds
