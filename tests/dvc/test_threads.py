"""Compiled loops that several threads share."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from dvc import threads

ROOT = Path(__file__).resolve().parents[2]
LONG_S = 120.0  # on a busy machine a thread may stand still for seconds


def squares(start: int, stop: int, out: np.ndarray) -> None:
    out[start:stop] += np.arange(start, stop) ** 2


@pytest.mark.parametrize("count", [1, 2, 5])
@pytest.mark.parametrize("size", [0, 1, 3, 1000])
def test_every_number_of_a_range_is_done_once(count, size):
    before = threads.count()
    threads.use(count)
    try:
        out = np.zeros(size, dtype=np.int64)
        threads.in_parts(squares, size, out)
    finally:
        threads.use(before)
    np.testing.assert_array_equal(out, np.arange(size) ** 2)


def test_a_loop_ends_where_no_thread_can_be_started(monkeypatch):
    """As where memory is limited: each has a stack of megabytes."""
    started = threading.Thread.start
    seen = list[threading.Thread]()

    def start(thread: threading.Thread) -> None:
        seen.append(thread)
        if len(seen) > 1:
            raise RuntimeError("can't start new thread")
        started(thread)

    pool, out = threads._Threads(4), np.zeros(1000, dtype=np.int64)
    monkeypatch.setattr(threads, "_threads", [pool])
    monkeypatch.setattr(threading.Thread, "start", start)
    for _ in range(3):
        threads.in_parts(squares, 1000, out)
    np.testing.assert_array_equal(out, 3 * np.arange(1000) ** 2)
    assert len(seen) == 2
    pool.end()
    seen[0].join(LONG_S)
    assert not seen[0].is_alive()
    assert pool._loops.empty()


def test_one_core_is_counted_on_within_the_block():
    before = threads.count(), threads.usable_cores()
    with threads.on_one_core():
        assert (threads.count(), threads.usable_cores()) == (1, 1)
    assert (threads.count(), threads.usable_cores()) == before


def test_a_thread_that_comes_too_late_is_not_taken_for_one_that_has_finished():
    go_on, out = threading.Event(), np.zeros(1)

    def slow(start: int, stop: int) -> None:
        go_on.wait(LONG_S)
        out[start:stop] = 1.0

    loop = threads._Loop(slow, [0, 1], ())
    helper, finishing = threading.Thread(target=loop.help), threading.Thread(target=loop.finish)
    helper.start()
    while not loop._helping:
        time.sleep(0.001)
    finishing.start()
    time.sleep(0.05)
    loop.help()  # finds no part left
    finishing.join(0.2)
    assert finishing.is_alive()
    go_on.set()
    finishing.join(LONG_S)
    helper.join(LONG_S)
    assert out[0] == 1.0


def raises(start: int, stop: int, out: np.ndarray) -> None:
    if start == 3:
        raise ValueError("part 3")
    out[start:stop] = 1


def test_an_error_of_any_thread_is_raised_and_the_next_loop_runs():
    before = threads.count()
    threads.use(3)
    try:
        for _ in range(50):  # whichever thread takes the part
            with pytest.raises(ValueError, match="part 3"):
                threads.in_parts(raises, 12, np.zeros(12))
        out = np.zeros(100, dtype=np.int64)
        threads.in_parts(squares, 100, out)
    finally:
        threads.use(before)
    np.testing.assert_array_equal(out, np.arange(100) ** 2)


@pytest.mark.parametrize("told", ["", "-1", "4.0", "many", "2,1"])
def test_a_number_of_threads_that_is_none_counts_as_not_given(told, monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", told)
    assert threads._asked() == threads.usable_cores()


def test_threads_asked_for_are_taken(monkeypatch):
    monkeypatch.setenv("NUMBA_NUM_THREADS", " 3")
    assert threads._asked() == 3


@pytest.mark.skipif(sys.platform != "linux", reason="no fork here, or not one that is safe")
def test_a_forked_process_has_threads_of_its_own():
    code = """
import os
import numpy as np
from dvc import threads
from tests.dvc.test_threads import squares
threads.use(2)
out = np.zeros(100, dtype=np.int64)
threads.in_parts(squares, 100, out)
child = os.fork()
if not child:
    threads.in_parts(squares, 100, out)
    os._exit(0)
os._exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=LONG_S, check=False).returncode == 0
