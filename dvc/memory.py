"""Memory of a process: what is handed back to the system, and how its lack shows."""

import ctypes
import gc
from contextlib import suppress

TOO_LITTLE_MEMORY = "Free memory, use fewer --workers, crop the images, or use a coarser mesh."
"""What to do where memory ran out."""
# What the system says of memory for a library, a process or a thread, each in an error of another kind; and the line of
# a traceback that loky gives as text, as where there is no memory to send a task.
_NO_MEMORY = (
    "failed to map segment", "Cannot allocate memory", "can't start new thread", "paging file is too small",
    "\nMemoryError",
)  # fmt: skip


def is_lack_of_memory(failure: BaseException | None) -> bool:
    """Whether an error, one that caused it, or one that it came up in the handling of, says that memory ran out.

    >>> is_lack_of_memory(ImportError("_core.so: failed to map segment from shared object"))
    True
    """
    while failure is not None:
        if isinstance(failure, MemoryError) or any(sign in str(failure) for sign in _NO_MEMORY):
            return True
        failure = failure.__cause__ or (None if failure.__suppress_context__ else failure.__context__)
    return False


def hand_memory_back() -> None:
    """Give freed memory, which glibc keeps for what comes next, back to the system: after a task that needed much."""
    with suppress(OSError, AttributeError, TypeError, MemoryError):  # another C library, or no memory even for this
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
