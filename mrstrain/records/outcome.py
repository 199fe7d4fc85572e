"""What a function that leaves files has to tell of them."""

import errno
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dvc.memory import TOO_LITTLE_MEMORY, is_lack_of_memory

_SHORT = 80  # characters of a path
_OF_DISKS = (errno.ENOSPC, errno.EROFS, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Where results are, what is told of them, and whether all that was wanted was reached."""

    out: Path
    lines: tuple[str, ...]
    complete: bool = True

    def summary(self) -> list[str]:
        """A few lines for a person; where to look is the last."""
        return list(self.lines)


def lack_of_machine(failure: BaseException) -> str:
    """What this machine lacks, in a sentence and what to do, if a failure comes from that; empty for any other.

    >>> lack_of_machine(MemoryError())
    'The memory ran out. Free memory, use fewer --workers, crop the images, or use a coarser mesh.'
    >>> lack_of_machine(OSError(28, "No space left on device", "/tmp/a"))
    '/tmp/a: No space left on device. Free disk space or change the permissions, then run it again.'
    """
    if is_lack_of_memory(failure):
        said = re.sub(r"/\S*/", "", str(failure))  # a library by its name: the memory is to blame, not its folder
        said = f" ({said})" if said else ""
        return f"The memory ran out{said}. {TOO_LITTLE_MEMORY}"
    if isinstance(failure, OSError) and failure.errno in _OF_DISKS:
        what = f"{failure.filename or tempfile.gettempdir()}: {failure.strerror}"
        return f"{what}. Free disk space or change the permissions, then run it again."
    return ""


def wrong_path(failure: BaseException) -> str:
    """What is wrong with a path that the system does not take, in a sentence; empty for any other failure.

    >>> wrong_path(OSError(36, "File name too long", "/tmp/a"))
    '/tmp/a: File name too long. Check this path.'
    """
    if isinstance(failure, OSError) and failure.errno in (errno.ENAMETOOLONG, errno.ELOOP) and failure.filename:
        named = str(failure.filename)
        short = named if len(named) <= _SHORT else f"{named[:_SHORT]}..."
        return f"{short}: {failure.strerror}. Check this path."
    if isinstance(failure, RuntimeError) and str(failure).startswith("Symlink loop from"):  # of pathlib
        return f"{failure}: this link leads to itself. Check this path."
    return ""


def with_reasons(what: str, reasons: Sequence[str]) -> str:
    """A sentence and its reasons: one follows it, several are listed below it, a line for each.

    >>> print(with_reasons("Every simulation failed.", ["Load1: it folds."]))
    Every simulation failed. Load1: it folds.
    >>> print(with_reasons("Every simulation failed.", ["Load1: it folds.", "Load2: no memory."]))
    Every simulation failed.
      Load1: it folds.
      Load2: no memory.
    """
    return " ".join([what, *reasons]) if len(reasons) < 2 else "\n  ".join([what, *reasons])
