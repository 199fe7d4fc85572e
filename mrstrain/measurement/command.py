"""A user's command, such as a segmenter: it and all that it starts end with this process, however that ends."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil

_ONE_THREAD = {"OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"}
"""Variables by which the stages of a study keep to a core each."""
_LOOK_EVERY_S = 5.0
_WORKS = 0.01  # of a core: less is what a program takes to wait
_SAID_BYTES = 1 << 16
_GUARD = """
import os, signal, sys, time
sys.stdin.read()
try:
    os.killpg(int(sys.argv[1]), signal.SIGTERM)
    for _ in range(30):
        time.sleep(0.1)
        os.killpg(int(sys.argv[1]), 0)
    os.killpg(int(sys.argv[1]), signal.SIGKILL)
except ProcessLookupError:
    pass
"""
"""Ends a process group, by force after 3 s, when its standard input is closed."""


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
    with (
        tempfile.TemporaryFile() as said,  # not a pipe, which what it leaves behind could keep open
        subprocess.Popen(
            parts, cwd=folder, env=free, stdin=subprocess.DEVNULL, stdout=said, stderr=subprocess.STDOUT,
            process_group=0,
        ) as running,
        _guarded(running),
    ):  # fmt: skip
        while True:
            try:
                code = running.wait(_LOOK_EVERY_S)
                break
            except subprocess.TimeoutExpired:
                before, computed_s = computed_s, _computed_s(running.pid)
                if computed_s - before > _WORKS * _LOOK_EVERY_S:
                    goes_on(time.monotonic() - began)
        said.seek(max(0, said.seek(0, os.SEEK_END) - _SAID_BYTES))
        return code, said.read().decode(errors="replace")


@contextmanager
def _guarded(running: "subprocess.Popen[bytes]") -> Iterator[None]:
    """End a command and all that it started with this block, or with this process, even if it is killed."""
    if not hasattr(os, "killpg"):  # no groups of processes
        try:
            yield
        finally:
            running.kill()
        return
    guard = [sys.executable, "-I", "-S", "-c", _GUARD, str(running.pid)]
    with subprocess.Popen(
        guard, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    ) as guarding:
        try:
            yield
        finally:
            assert guarding.stdin is not None
            guarding.stdin.close()
            running.wait()  # the guard sees it as long as nobody has asked for its status


def _computed_s(process: int) -> float:
    """Processor time of a process and all below it, with those that have ended, seconds."""
    seconds = 0.0
    with suppress(psutil.Error):
        first = psutil.Process(process)
        for one in (first, *first.children(recursive=True)):
            with suppress(psutil.Error):
                seconds += sum(one.cpu_times()[:4])
    return seconds
