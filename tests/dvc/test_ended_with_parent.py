"""Native code that holds the interpreter ends with the process that started it."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from contextlib import nullcontext, suppress
from pathlib import Path

import pytest

from dvc.worker import Worker, ended_with_parent
from tests.processes import is_gone, wait_for

__all__ = ["Worker", "holds"]  # for the script of the test
LONG_S = 60.0


def holds(told: str, guarded: bool) -> None:
    with ended_with_parent() if guarded else nullcontext():
        Path(told).write_text(str(os.getpid()))
        ctypes.PyDLL(None).sleep(int(LONG_S))  # a call that keeps the interpreter


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a POSIX shell looks for the parent")
@pytest.mark.parametrize("guarded", [True, False])
def test_native_code_that_holds_the_interpreter_ends_with_the_parent(tmp_path, guarded):
    """As the mesher does; without the guard, the thread that looks for the parent does not run."""
    told = tmp_path / "child"
    here = "from tests.dvc.test_ended_with_parent import *"
    script = f"{here}; Worker(threads=1).run('meshing', holds, {str(told)!r}, {guarded})"
    root = Path(__file__).resolve().parents[2]
    parent = subprocess.Popen([sys.executable, "-c", script], cwd=root, stderr=subprocess.DEVNULL)
    wait_for(lambda: told.exists() and told.read_text())
    child = int(told.read_text())
    try:
        parent.kill()
        parent.wait()
        if guarded:
            wait_for(lambda: is_gone(child))
        else:
            time.sleep(4.0)
            assert not is_gone(child)
    finally:
        with suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
