"""Compiled loops that several threads share.

A kernel is compiled without numba's own parallel loops, which take more than twice as long to compile, and which some
platforms do not allow from several threads of Python at once.
"""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from queue import Empty, SimpleQueue

_PARTS = 4  # for each thread: what one part takes longer, another makes up for


def usable_cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Threads:
    """The threads that this process computes on: NUMBA_NUM_THREADS, or as many as there are cores."""

    def __init__(self, count: int) -> None:
        self.count = count
        # Beside the caller's own; starts them when there is work.
        self.pool = ThreadPoolExecutor(max(1, count - 1), "compiled")


def _asked() -> int:
    told = os.environ.get("NUMBA_NUM_THREADS", "").strip()
    return int(told) if told.isdecimal() and int(told) > 0 else usable_cores()


_threads = [_Threads(_asked())]


def count() -> int:
    """Number of threads that this process computes on."""
    return _threads[-1].count


def use(count: int) -> None:
    """Compute on so many threads from now on."""
    _threads[-1] = _Threads(count)


if hasattr(os, "register_at_fork"):  # a forked process inherits the pool, but none of its threads
    os.register_at_fork(after_in_child=lambda: use(count()))


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
    ends = [size * part // parts for part in range(parts + 1)]
    left = SimpleQueue[int]()
    for part in range(parts):
        left.put(part)

    def take() -> None:
        with suppress(Empty):
            while True:
                part = left.get_nowait()
                kernel(ends[part], ends[part + 1], *arguments)

    others = [threads.pool.submit(take) for _ in range(min(threads.count, parts) - 1)]
    try:
        take()
    finally:
        for other in others:
            if not other.cancel():
                other.result()
