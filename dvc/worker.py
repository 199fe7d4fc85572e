"""Work in child processes that may crash without taking the caller with them, as native code (elastix) can."""

import logging
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, TimeoutError as FutureTimeout, wait
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib import import_module
from typing import Any, TypeVar

from loky import ProcessPoolExecutor
from loky.backend.context import LokyContext
from loky.backend.process import LokyProcess
from loky.backend.utils import kill_process_tree
from loky.process_executor import BrokenProcessPool, ShutdownExecutorError, TerminatedWorkerError

from dvc.errors import WorkerError
from dvc.memory import TOO_LITTLE_MEMORY, hand_memory_back, is_lack_of_memory

_T = TypeVar("_T")
_I = TypeVar("_I")
Each = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]
"""`map`, or one that computes in several processes: a task and items, both picklable, give results in their order."""

_POLL_S = 0.5
_UNWIND_S = 5.0  # for threads to end after an error or interrupt
_MEMORY = {
    "MALLOC_ARENA_MAX": "2",  # glibc keeps memory for each thread otherwise: a fifth more
    # What glibc comes to by itself, unless it is told otherwise: Dask has its workers hand every freed array back to
    # the system, which clears the pages of the next one.
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(64 << 20),
}


def _is_for_the_log(record: logging.LogRecord) -> bool:
    """False for the traceback that loky logs where its own thread lacks memory; the task tells the cause."""
    return not (record.exc_info and is_lack_of_memory(record.exc_info[1]))


logging.getLogger("concurrent.futures").addFilter(_is_for_the_log)  # loky's


class _Child(LokyProcess):  # type: ignore[misc]
    """A child that ends without a traceback where memory runs out beside its task; the caller sees that it died."""

    def run(self) -> None:
        try:
            super().run()
        except Exception as failure:
            if not is_lack_of_memory(failure):
                raise
            sys.exit(1)


class _Children(LokyContext):  # type: ignore[misc]
    """How loky starts processes, with ours."""

    Process = _Child


_here: list[None] = []  # blocks of `in_this_process`
_parents: list[int] = []  # of this process, if it is a child of a `Worker`


@contextmanager
def in_this_process() -> Iterator[None]:
    """Let every `Worker` run its tasks in this process, which is a child itself: another would only need more memory.

    A task can then neither be killed nor crash alone.
    """
    _here.append(None)
    try:
        yield
    finally:
        _here.pop()


class Worker(AbstractContextManager["Worker", None]):
    """One child process that runs one task at a time; if it dies, that task fails and the next gets a fresh process.

    So it is after an interrupt, too, which ends the process with its task. A process that is seen to have died between
    tasks is replaced, and no task fails.

    Native code (ITK, numba, BLAS) may use ``threads`` threads in it: results of elastix are equal bit for bit only for
    equal numbers. It is kept alive between tasks, because the first use of elastix costs many seconds.
    """

    def __init__(self, threads: int) -> None:
        if threads < 1:
            raise ValueError(f"`threads` of a worker must be 1 or more; got {threads}.")
        self.threads = threads
        self._executor: ProcessPoolExecutor | None = None
        self._killed = False
        self._lock = threading.Lock()

    def start(self, *modules: str) -> None:
        """Start the child process, and let it import modules and what their loops need, beside the caller."""
        if _here:
            return
        with self._lock:
            for module in modules:
                self._submitted(self._running(), _imported, module)

    def beforehand(self, task: Callable[[], None]) -> None:
        """Let the child do a task before the next one; nobody waits for it, or learns how it ends."""
        if not _here:
            with self._lock, suppress(Exception):  # of which the next task tells
                self._submitted(self._running(), _then_hand_back, task)

    def run(self, what: str, task: Callable[..., _T], *args: Any, watch: Callable[[], None] | None = None) -> _T:
        """Run ``task(*args)`` in the child; its exceptions are raised here, and `WorkerError` if the child dies.

        A child whose memory runs out counts as one that died.

        ``what`` is the task in words ("registering Load1"); ``watch`` is called about twice a second meanwhile.
        """
        if _here:
            return _run_here(what, task, *args, watch=watch)
        with self._lock:
            executor = self._running()
            future: Future[_T] | None = None

            def watched() -> None:
                if self._killed:  # while the process was being started
                    executor.shutdown(wait=False, kill_workers=True)
                elif not _is_answered(executor) and future is not None and not future.done():
                    self._abandon(executor)
                    raise WorkerError(
                        f"The memory ran out while {what}, in the process that waits for it. {TOO_LITTLE_MEMORY}"
                    )
                elif watch is not None:
                    watch()

            try:
                future = self._submitted(executor, _then_hand_back, task, *args)
                return _result(future, watched)
            except (TerminatedWorkerError, ShutdownExecutorError) as died:
                executor.shutdown(wait=False, kill_workers=True)
                self._executor = None
                code = re.search(r"\{(.*)\}", str(died), re.DOTALL)
                raise WorkerError(
                    f"The process {what} died (exit code {code[1] if code else 'unknown'}): the system ended it, "
                    "most often for lack of memory, or native code crashed. Free memory or use fewer --workers. In "
                    "your own elastix parameter files with several metrics, set "
                    '(UseMultiThreadingForMetrics "false").'
                ) from died
            except Exception as failure:
                if isinstance(failure, BrokenProcessPool):  # which takes no other task
                    executor.shutdown(wait=False, kill_workers=True)
                    self._executor = None
                if not is_lack_of_memory(failure):
                    raise
                raise _lack_of_memory(what, failure) from failure
            finally:
                if future is not None and not future.done():  # an interrupt: the task would be waited for
                    executor.shutdown(wait=False, kill_workers=True)
                    self._executor = None

    def _submitted(self, executor: ProcessPoolExecutor, task: Callable[..., _T], *args: Any) -> "Future[_T]":
        """The task, sent to the child process; where it cannot be sent, the process is ended.

        Without memory for the thread that loky starts beside the process, nothing would take up its results, and the
        next task would be waited for without end.
        """
        try:
            return executor.submit(task, *args)  # type: ignore[no-any-return]
        except BaseException:
            self._abandon(executor)
            raise

    def _abandon(self, executor: ProcessPoolExecutor) -> None:
        """End the child process where loky's thread beside it does not run, which would end it."""
        for process in list(executor._processes.values()):
            kill_process_tree(process)
        executor.shutdown(wait=False)
        self._executor = None

    def _running(self) -> ProcessPoolExecutor:
        """The child process, started where there is none."""
        if self._killed:
            raise WorkerError("The process was ended before its task began. Run the command again.")
        if self._executor is not None and self._executor._flags.broken is not None:  # it died between tasks
            self._abandon(self._executor)
        if self._executor is None:
            count = str(self.threads)
            names = ("ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS")
            # elastix and meshes take memory and keep it: loky must not take that for a leak and end the process.
            environment = dict.fromkeys(names, count) | {"LOKY_MAX_MEMORY_LEAK_SIZE": "1e18"} | _MEMORY
            self._executor = ProcessPoolExecutor(
                1, context=_Children(), env=environment, initializer=_end_with, initargs=(os.getpid(),)
            )
        return self._executor

    def kill(self) -> None:
        """End the child process at once, whatever it does; a task in it, and any later one, raises `WorkerError`."""
        self._killed = True
        if (executor := self._executor) is not None:
            executor.shutdown(wait=False, kill_workers=True)

    def close(self) -> None:
        """End the child process."""
        with self._lock:
            if self._executor is not None:
                # loky takes the last word: without it, a child that `kill` has not ended yet would be waited for.
                self._executor.shutdown(wait=True, kill_workers=self._killed)
                self._executor = None

    def __exit__(self, error: type[BaseException] | None, *_: object) -> None:
        if error is not None:
            self.kill()
        self.close()


def each_in_workers(
    items: Iterable[_I], task: Callable[[_I, Worker], None], *, at_once: int, threads: int, first: Worker | None = None
) -> None:
    """Run ``task(item, worker)`` for every item, ``at_once`` at a time; an error or interrupt ends every worker.

    The ``first`` of them may have been started before.
    """
    with _workers(at_once, threads, first) as each:
        list(each(task, items))


@contextmanager
def side_by_side(what: str, at_once: int) -> Iterator[Each]:
    """A `map` whose calls run ``at_once`` at a time, each in a process of one thread, whose memory is given back.

    ``what`` the calls do in words ("comparing"); a call that fails ends the others, and its error is raised.
    """
    with _workers(at_once, 1) as each:
        yield lambda task, items: each(lambda item, worker: worker.run(what, task, item), items)


@contextmanager
def _workers(
    at_once: int, threads: int, first: Worker | None = None
) -> Iterator[Callable[[Callable[[Any, Worker], Any], Iterable[Any]], Any]]:
    """A `map` of tasks that get an item and a worker, one of so many that are kept to the end of the block."""
    local = threading.local()
    workers = [Worker(threads) for _ in range(at_once)]  # whose processes start when they are needed
    workers[0] = first or workers[0]
    idle = iter(workers)

    def one(task: Callable[[Any, Worker], Any], item: object) -> object:
        if not hasattr(local, "worker"):
            local.worker = next(idle)
        return task(item, local.worker)

    pool, begun = ThreadPoolExecutor(at_once), list[Future[Any]]()

    def each(task: Callable[[Any, Worker], Any], items: Iterable[Any]) -> Iterable[Any]:
        those = [pool.submit(one, task, item) for item in items]
        begun.extend(those)
        return map(_result, those)

    try:
        yield each
    except BaseException:
        pool.shutdown(wait=False, cancel_futures=True)  # first, so that no thread begins the next item
        for worker in workers:
            worker.kill()
        wait(begun, _UNWIND_S)  # a thread that computes in this process cannot be ended
        raise
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.close()


def _result(future: "Future[_T]", watch: Callable[[], None] = lambda: None) -> _T:
    """The result of a task, with ``watch`` called meanwhile.

    It is not waited for without end: a signal that reaches another thread is seen by this one when it runs again.
    """
    while True:
        try:
            return future.result(timeout=_POLL_S)
        except FutureTimeout:
            if future.done():
                raise  # the task itself timed out on something; not ours to hide
            watch()


def _run_here(what: str, task: Callable[..., _T], *args: Any, watch: Callable[[], None] | None) -> _T:
    """The result of a task that runs on a thread of this process."""
    try:
        with ThreadPoolExecutor(1) as beside:
            return _result(beside.submit(_then_hand_back, task, *args), watch or (lambda: None))
    except Exception as failure:
        if not is_lack_of_memory(failure):
            raise
        raise _lack_of_memory(what, failure) from failure


def _lack_of_memory(what: str, failure: Exception) -> WorkerError:
    return WorkerError(f"The memory ran out while {what} ({failure}). {TOO_LITTLE_MEMORY}")


def _is_answered(executor: ProcessPoolExecutor) -> bool:
    """Whether loky's thread runs that takes the answers of the child process."""
    thread = executor._executor_manager_thread
    return thread is None or thread.is_alive()


def _then_hand_back(task: Callable[..., _T], *args: Any) -> _T:
    """A task, and then its freed memory: the next task, or the caller, may need it while this process still lives."""
    try:
        return task(*args)
    finally:
        hand_memory_back()


@contextmanager
def ended_with_parent() -> Iterator[None]:
    """End this process with its parent even while native code holds the interpreter, where it is a child.

    A thread of Python, which looks for the parent otherwise, does not run then.
    """
    if not _parents or not hasattr(os, "fork"):
        yield
        return
    me = os.getpid()
    look = f"while kill -0 {_parents[-1]}; do kill -0 {me} || exit; sleep 1; done; kill -9 {me}"
    nowhere = subprocess.DEVNULL
    with subprocess.Popen(
        ["/bin/sh", "-c", look], process_group=0, stdin=nowhere, stdout=nowhere, stderr=nowhere
    ) as watcher:
        try:
            yield
        finally:
            watcher.kill()


def _imported(module: str) -> None:
    import_module(module)
    if (compiled := sys.modules.get("dvc.compiled")) is not None:
        compiled.prepare()


def _end_with(parent: int) -> None:
    """Let the child end when its parent is gone, and leave interrupts from the keyboard to the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _parents.append(parent)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    if hasattr(os, "fork"):  # elsewhere a child keeps the number of a parent that is gone
        threading.Thread(target=watch, daemon=True).start()
