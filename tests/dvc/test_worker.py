"""Workers that crash, are killed, or raise: the caller gets a sentence, and the next task a fresh process."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial

import numpy as np
import psutil
import pytest
from loky import process_executor

import dvc  # whose functions load when they are asked for: the processes of these tests import this file
from dvc.errors import RegistrationError, WorkerError
from dvc.memory import hand_memory_back
from dvc.worker import Worker, each_in_workers, side_by_side
from tests.processes import is_gone, wait_for

LONG_S, AT_ONCE_S = 60.0, 50.0
"""How long a task sleeps, and the most that its end may take: to start a process takes long on a busy machine."""


def soon(act: Callable[[], None]) -> Callable[[], None]:
    """Something that another thread does once, as the task runs and is waited for; to be given as ``watch``."""
    later = threading.Timer(0.1, act)
    return lambda: None if later.ident else later.start()


def _crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def _needs_a_library_that_does_not_fit() -> None:
    try:
        raise ImportError("_core.so: failed to map segment from shared object")
    except ImportError as lack:
        raise ImportError("scipy.optimize cannot be imported") from lack


def _killed() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _fails() -> None:
    raise RegistrationError("no overlap")


def _needs_more_memory_than_there_is() -> None:
    import resource

    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, limits[1]))
    try:
        np.ones(2 << 30)  # 16 GiB
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)


def _imports(module: str) -> bool:
    return module in sys.modules


def _process() -> tuple[int, str | None]:
    return os.getpid(), os.environ.get("ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS")


def _pages_of_freed_arrays() -> int:
    """Pages that the system had to give for a hundred arrays of 1 MB, each freed before the next."""
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(100):
        np.ones(1 << 17)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_memory_of_a_freed_array_serves_the_next_even_below_a_worker_of_dask(monkeypatch):
    monkeypatch.setenv("MALLOC_TRIM_THRESHOLD_", "65536")  # as Dask sets it: 25,600 pages
    with Worker(threads=1) as worker:
        assert worker.run("counting", _pages_of_freed_arrays) < 1000


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_freed_memory_goes_back_to_the_system_between_tasks():
    process, blocks = psutil.Process(), [np.ones(12_000) for _ in range(2_000)]  # 192 MB, none of them a mapping
    last = blocks.pop()  # above the others, which therefore stay
    blocks.clear()
    kept = process.memory_info().rss
    hand_memory_back()
    assert kept - process.memory_info().rss > 150e6
    assert last[0] == 1.0


def _resident(needed: int) -> int:
    """Resident memory once so many small arrays are freed, all but the last, which lies above the others."""
    blocks = [np.ones(12_000) for _ in range(needed)]
    if blocks:
        _KEPT.append(blocks.pop())
        blocks.clear()
    return int(psutil.Process().memory_info().rss)


_KEPT: list[np.ndarray] = []


@pytest.mark.skipif(sys.platform != "linux", reason="of glibc")
def test_a_worker_gives_the_freed_memory_of_a_task_back_before_the_next():
    with Worker(threads=1) as worker:
        at_its_end = worker.run("counting", _resident, 2_000)  # 192 MB
        assert at_its_end - worker.run("counting", _resident, 0) > 150e6


@pytest.mark.skipif(sys.platform != "linux", reason="limits of Linux")
def test_memory_that_runs_out_is_named_and_the_next_task_runs():
    with Worker(threads=1) as worker:
        with pytest.raises(WorkerError, match=r"memory ran out while registering Load1 \(.*16.*\)\. Free memory"):
            worker.run("registering Load1", _needs_more_memory_than_there_is)
        assert worker.run("adding", sum, [1, 2]) == 3


def test_a_library_that_there_is_no_memory_for_is_lack_of_memory():
    with Worker(threads=1) as worker, pytest.raises(WorkerError, match="memory ran out while meshing"):
        worker.run("meshing", _needs_a_library_that_does_not_fit)


class _TooLargeToSend:
    """What there is no memory for to pickle it."""

    def __reduce__(self):
        raise MemoryError


def test_memory_that_runs_out_while_a_task_is_sent_is_lack_of_memory():
    with Worker(threads=1) as worker:
        with pytest.raises(WorkerError, match=r"memory ran out while aligning .*Free memory"):
            worker.run("aligning", len, [_TooLargeToSend()])
        assert worker.run("adding", sum, [1, 2]) == 3


def _leaves_no_memory_for_anything() -> None:
    def lacking(*_: object, **__: object) -> None:
        raise MemoryError("not even to look at the memory")

    process_executor._get_memory_usage = lacking  # what loky does after each task
    raise MemoryError("of the task")


def test_a_process_that_lacks_memory_after_its_task_ends_without_a_traceback(capfd):
    with Worker(threads=1) as worker, pytest.raises(WorkerError, match=r"memory ran out while meshing \(of the task"):
        worker.run("meshing", _leaves_no_memory_for_anything)
    told = "".join(capfd.readouterr())
    assert "Traceback" not in told, told


@pytest.mark.parametrize(
    ("of", "thread"),
    [(process_executor._ExecutorManagerThread, "start"), (process_executor._SafeQueue, "_start_thread")],
    ids=["results", "tasks"],
)
def test_where_memory_lacks_for_a_thread_beside_the_process_the_next_task_runs(of, thread, capfd, monkeypatch):
    """loky starts threads that take results and send tasks: without the first the next task was never answered."""

    def lacking(_: object) -> None:
        raise RuntimeError("can't start new thread")

    with Worker(threads=1) as worker:
        with monkeypatch.context() as without:
            without.setattr(of, thread, lacking)
            with pytest.raises(WorkerError, match="memory ran out while meshing"):
                worker.run("meshing", sum, [1, 2])
        assert worker.run("adding", sum, [1, 2]) == 3
        time.sleep(2.0)  # a process that was left would have started by now
    told = "".join(capfd.readouterr())
    assert "Traceback" not in told, told


class _NotForTheCaller:
    """What a child can send and its caller cannot read."""

    def __reduce__(self):
        return _refused, (os.getpid(),)


def _refused(maker: int) -> None:
    if os.getpid() != maker:
        raise ValueError("not here")


def test_after_a_result_that_cannot_be_read_the_next_task_runs():
    with Worker(threads=1) as worker:
        with pytest.raises(process_executor.BrokenProcessPool, match="un-serialize"):
            worker.run("meshing", _NotForTheCaller)
        assert worker.run("adding", sum, [1, 2]) == 3


def test_a_task_whose_answer_no_thread_takes_is_ended(monkeypatch):
    """As where there is no memory to tell that there is none."""
    with Worker(threads=1) as worker:
        with monkeypatch.context() as without:
            without.setattr(process_executor._ExecutorManagerThread, "run", lambda _: None)
            with pytest.raises(WorkerError, match="memory ran out while meshing, in the process that waits for it"):
                worker.run("meshing", sum, [1, 2])
        assert worker.run("adding", sum, [1, 2]) == 3


@pytest.mark.parametrize(("task", "signal_name"), [(_crash, "SIGSEGV"), (_killed, "SIGKILL")])
def test_death_is_an_error_that_says_so_and_the_next_task_runs(task, signal_name):
    with Worker(threads=1) as worker:
        with pytest.raises(WorkerError, match=rf"registering Load1 died .*{signal_name}"):
            worker.run("registering Load1", task)
        process, _ = worker.run("asking", _process)
    assert process != os.getpid()


def test_a_process_that_is_killed_between_tasks_fails_none():
    with Worker(threads=1) as worker:
        first, _ = worker.run("asking", _process)
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: worker._executor._flags.broken)
        assert worker.run("asking", _process)[0] != first


def test_its_own_errors_come_back_as_they_are():
    with Worker(threads=1) as worker, pytest.raises(RegistrationError, match="no overlap"):
        worker.run("registering", _fails)


def test_one_process_serves_many_tasks_with_the_threads_asked_for():
    with Worker(threads=2) as worker:
        first, threads = worker.run("asking", _process)
        second, _ = worker.run("asking", _process)
    assert first == second
    assert threads == "2"


def test_a_started_worker_has_imported_what_it_was_told_and_is_the_first_to_be_used():
    used = []
    with Worker(threads=1) as first:
        first.start("wave")
        tasks = [lambda worker: used.append((worker, worker.run("asking", _imports, "wave")))]
        each_in_workers(tasks, lambda task, worker: task(worker), at_once=2, threads=1, first=first)
        assert used == [(first, True)]
    with Worker(threads=1) as other:
        assert not other.run("asking", _imports, "wave")


def test_a_started_worker_is_ready_to_run_compiled_loops():
    with Worker(threads=1) as worker:
        worker.start("dvc.images.tissue")
        assert worker.run("asking", _imports, "numba.cpython.setobj")  # which numba imports for its first loop


def test_a_worker_that_is_killed_from_outside_ends_its_task_at_once():
    worker = Worker(threads=1)
    worker.run("asking", _process)
    began = time.monotonic()
    with pytest.raises(WorkerError, match="sleeping"):
        worker.run("sleeping", time.sleep, LONG_S, watch=soon(worker.kill))
    assert time.monotonic() - began < AT_ONCE_S
    worker.close()


def test_an_interrupt_while_the_process_starts_does_not_wait_for_its_task():
    began = time.monotonic()
    worker = Worker(threads=1)
    executor = worker._running()
    worker._submitted(executor, time.sleep, LONG_S)
    worker.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert executor._flags.kill_workers  # which one that had just begun to wait for a task would outlive
    assert time.monotonic() - began < AT_ONCE_S


def test_an_interrupt_leaves_no_process_and_the_next_task_has_a_fresh_one(monkeypatch):
    """As in a notebook, where the worker is still there after it."""
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with Worker(threads=1) as worker:
            first, _ = worker.run("asking", _process)
            with pytest.raises(KeyboardInterrupt):
                worker.run("sleeping", time.sleep, LONG_S, watch=soon(lambda: os.kill(os.getpid(), signal.SIGINT)))
            began = time.monotonic()
            assert worker.run("asking", _process)[0] != first
            assert time.monotonic() - began < AT_ONCE_S
            wait_for(lambda: is_gone(first))
    finally:
        signal.signal(signal.SIGINT, usual)


def test_an_interrupted_registration_leaves_no_process_and_the_next_begins(tiny_pair):
    def interrupt(stage: str, fraction: float) -> None:
        raise KeyboardInterrupt

    def workers() -> set[int]:
        found = set[int]()
        for one in psutil.Process().children():
            with suppress(psutil.Error):  # it has just ended
                found |= {one.pid} if "popen_loky" in " ".join(one.cmdline()) else set()
        return found

    before = workers()
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            dvc.register(
                tiny_pair.reference, tiny_pair.loaded, bone=tiny_pair.labels.region("bone"), progress=interrupt
            )
        wait_for(lambda: workers() <= before)


def test_a_worker_that_is_killed_while_its_process_starts_runs_no_task():
    worker = Worker(threads=1)
    began = time.monotonic()
    running = worker._running
    worker._running = lambda: (running(), worker.kill())[0]  # type: ignore[method-assign]
    with pytest.raises(WorkerError, match="sleeping"):
        worker.run("sleeping", time.sleep, LONG_S)
    worker.close()
    assert time.monotonic() - began < AT_ONCE_S
    with pytest.raises(WorkerError, match="ended before its task began"):
        Worker.run(worker, "asking", _process)


def test_each_item_is_done_once_and_one_that_fails_ends_all() -> None:
    """Three items on two workers; then one whose task raises: its error comes up, and no worker is left."""
    done: list[tuple[int, int]] = []
    used: set[Worker] = set()

    def task(item: int, worker: Worker) -> None:
        used.add(worker)
        done.append((item, worker.run("a square", pow, item, 2)))

    each_in_workers([1, 2, 3], task, at_once=2, threads=1)
    assert sorted(done) == [(1, 1), (2, 4), (3, 9)]
    assert 1 <= len(used) <= 2

    def wrong(item: int, worker: Worker) -> None:
        worker.run("a square", pow, item, 2)
        used.add(worker)
        raise KeyError(item)

    used.clear()
    with pytest.raises(KeyError):
        each_in_workers([1], wrong, at_once=1, threads=1)
    assert all(worker._executor is None for worker in used)


def _slow_to_fast(item: int) -> tuple[int, int]:
    time.sleep(0.3 / item)
    return item, os.getpid()


def _fails_at_two(item: int) -> int:
    if item == 2:
        raise RegistrationError("two")
    return item


def test_a_map_over_processes_keeps_the_order_and_raises_the_error_of_a_call():
    with side_by_side("counting", 2) as each:
        found = list(each(_slow_to_fast, [1, 2, 3, 4]))
        again = list(each(_slow_to_fast, [5, 6]))
    assert [item for item, _ in (*found, *again)] == [1, 2, 3, 4, 5, 6]
    processes = {process for _, process in (*found, *again)}
    assert len(processes) <= 2
    assert os.getpid() not in processes
    with pytest.raises(RegistrationError, match="two"), side_by_side("counting", 2) as each:
        list(each(_fails_at_two, [1, 2, 3]))
    with side_by_side("counting", 1) as each:  # one at a time is in a process of its own, too
        ((item, process),) = each(_slow_to_fast, [9])
    assert (item, process != os.getpid()) == (9, True)


def holding(megabytes: int) -> int:
    """Take memory and keep it; which process did."""
    holding.kept = bytearray(megabytes * 2**20)  # type: ignore[attr-defined]
    return os.getpid()


@pytest.mark.full_size  # it waits for what loky does now and then
def test_a_process_that_keeps_memory_is_kept_for_the_next_task():
    with Worker(threads=1) as worker:
        first = worker.run("holding memory", holding, 1)
        time.sleep(1.5)  # loky looks once a second
        worker.run("holding memory", holding, 500)
        time.sleep(1.5)
        assert worker.run("holding memory", holding, 600) == first
        assert worker.run("holding memory", holding, 1) == first


def test_what_nobody_waits_for_is_done_before_the_next_task_and_may_fail(tmp_path) -> None:
    with Worker(1) as worker:
        worker.beforehand(_fails)
        worker.beforehand(partial(os.mkdir, tmp_path / "made"))
        assert worker.run("looking", (tmp_path / "made").is_dir)
