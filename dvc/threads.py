"""Compiled loops that several threads share.

A kernel is compiled without numba's own parallel loops, which take more than twice as long to compile, and which some
platforms do not allow from several threads of Python at once.
"""

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from queue import SimpleQueue

_PARTS = 4  # for each thread: what one part takes longer, another makes up for
_MOST = 256  # threads, on any machine: elastix gives the same result only on as many threads as another machine had
_on_one_core: list[None] = []  # blocks of `on_one_core`
SMALL = 1 << 18
"""Numbers that one thread adds up before another is awake: a loop over fewer is not shared."""


def usable_cores() -> int:
    """Number of processor cores that this process may use."""
    if _on_one_core:
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def most_threads() -> int:
    """Number of threads above which a number is a mistake, and may take all of the memory."""
    return max(_MOST, usable_cores())


class _Loop:
    """Parts of a range, of which each thread takes the next until none is left."""

    def __init__(self, kernel: Callable[..., None], ends: list[int], arguments: tuple[object, ...]) -> None:
        self._kernel, self._ends, self._arguments = kernel, ends, arguments
        self._parts: Iterator[int] = iter(range(len(ends) - 1))  # whose next() no two threads get
        self._helping: list[threading.Thread] = []
        self._ended = SimpleQueue[BaseException | None]()

    def take(self) -> None:
        for part in self._parts:
            self._kernel(self._ends[part], self._ends[part + 1], *self._arguments)

    def help(self) -> None:
        """Take parts on another thread; what has begun after the last part was taken does nothing."""
        self._helping.append(threading.current_thread())  # before the first part: the caller waits for it
        failure = None
        try:
            self.take()
        except BaseException as error:
            failure = error
        self._ended.put(failure)

    def finish(self) -> None:
        """Wait for the threads that took parts, once none is left; raises what one of them did."""
        failures = list[BaseException]()
        ended = 0
        while ended < len(self._helping):  # counted anew each time: one that came too late may end first
            failure = self._ended.get()
            failures += [] if failure is None else [failure]
            ended += 1
        for failure in failures:
            raise failure


class _Threads:
    """The threads that this process computes on: NUMBA_NUM_THREADS, or as many as there are cores."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._loops = SimpleQueue[_Loop | None]()
        self._helpers: int | None = None  # threads beside the caller's own, once they are started
        self._starting = threading.Lock()

    def ask(self, loop: _Loop) -> None:
        """Let the threads beside the caller's own take parts of a loop; the first that is asked for starts them."""
        with self._starting:
            if self._helpers is None:
                self._helpers = self._start()
        for _ in range(self._helpers):
            self._loops.put(loop)

    def _start(self) -> int:
        """Start the threads; how many there is memory for, since the loops end without them, too."""
        for started in range(self.count - 1):
            try:
                threading.Thread(target=self._serve, name="compiled", daemon=True).start()
            except RuntimeError:
                return started
        return self.count - 1

    def _serve(self) -> None:
        while (loop := self._loops.get()) is not None:
            loop.help()
            del loop  # and the arrays that it holds

    def end(self) -> None:
        """End the threads; loops that they are in are finished."""
        for _ in range(self._helpers or 0):
            self._loops.put(None)


def _asked() -> int:
    told = os.environ.get("NUMBA_NUM_THREADS", "").strip()
    return int(told) if told.isdecimal() and int(told) > 0 else usable_cores()


_threads = [_Threads(_asked())]


def count() -> int:
    """Number of threads that this process computes on."""
    return _threads[-1].count


def use(count: int) -> None:
    """Compute on so many threads from now on."""
    _threads[-1].end()
    _threads[-1] = _Threads(count)


@contextmanager
def on_one_core() -> Iterator[None]:
    """Within the block, count on one core, here and in what is started side by side: where memory was short."""
    before = count()
    _on_one_core.append(None)
    use(1)
    try:
        yield
    finally:
        _on_one_core.pop()
        use(before)


def _forked() -> None:
    """A forked process has none of the threads of its parent."""
    _threads[-1] = _Threads(count())


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forked)


def in_parts(kernel: Callable[..., None], size: int, *arguments: object) -> None:
    """Run ``kernel(start, stop, *arguments)`` for parts that make up range(size), on all threads.

    A kernel lets go of the interpreter (`nogil`), and writes for each number of its range what no other does: the
    result is the same bit for bit on any number of threads. The caller's thread takes parts too, and has done what is
    short before another wakes.
    """
    threads = _threads[-1]
    parts = min(size, _PARTS * threads.count) if threads.count > 1 else 1
    if parts < 2:
        kernel(0, size, *arguments)
        return
    loop = _Loop(kernel, [size * part // parts for part in range(parts + 1)], arguments)
    threads.ask(loop)
    try:
        loop.take()
    finally:
        loop.finish()
