"""How loops are compiled: by numba, which stores them for the next run, with a checksum for each that is stored.

numba reads what it has stored without a check. A file that a full disk or a crash has cut ended every later run. And it
compiles a loop again if its own file has changed, but not if that of a function that it calls has.
"""

import os
import pickle
from collections.abc import Callable, Iterator
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import numba
from numba.core.caching import IndexDataCacheFile
from numba.core.dispatcher import Dispatcher
from numba.core.registry import cpu_target

_DIGEST = sha256().digest_size


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """As `numba.njit`; a stored loop that is damaged is compiled again, and one that cannot be stored is used once."""

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            kernel = numba.njit(**options)(function)
        except RuntimeError:  # neither the package's folder nor the home folder can be written to
            return numba.njit(**options | {"cache": False})(function)
        if (stored := getattr(kernel._cache, "_cache_file", None)) is not None:
            stored.__class__ = _CheckedFile
            stored.function = function
        return kernel

    return compiled


def prepare() -> None:
    """Load what numba needs for its first loop, a third of a second: for a process that waits for its task."""
    cpu_target.target_context.refresh()


class _CheckedFile(IndexDataCacheFile):  # type: ignore[misc]  # numba carries no types
    """numba's files of one function, an index and the code for each kind of arguments, with checksums at their ends."""

    function: Callable[..., Any]

    @property
    def _source_stamp(self) -> list[tuple[float, int]]:
        """Time and size of all sources that the stored code was made from."""
        found = (os.stat(file) for file in sorted({f.__code__.co_filename for f in _called(self.function, [])}))
        return [(one.st_mtime, one.st_size) for one in found]

    def save(self, key: Any, data: Any) -> None:
        with suppress(OSError):  # a full disk
            super().save(key, data)

    def _dump(self, content: Any) -> bytes:
        dumped: bytes = super()._dump(content)
        return dumped + sha256(dumped).digest()

    def _load_index(self) -> dict[Any, Any]:
        head = pickle.dumps(self._version, protocol=-1)
        return super()._load_index() if _whole(Path(self._index_path), head) else {}

    def _load_data(self, name: str) -> Any:
        if not _whole(place := Path(self._data_path(name))):
            raise OSError(f"{place} is damaged")  # by which numba knows that it has to compile
        return super()._load_data(name)


def _called(function: Callable[..., Any], seen: list[Callable[..., Any]]) -> Iterator[Callable[..., Any]]:
    """A function, and those compiled ones that it calls, and that they call."""
    seen.append(function)
    yield function
    for name in function.__code__.co_names:
        used = function.__globals__.get(name)
        if isinstance(used, Dispatcher) and used.py_func not in seen:
            yield from _called(used.py_func, seen)


def _whole(path: Path, head: bytes = b"") -> bool:
    """Whether a file begins with a head, and the rest ends with its checksum."""
    try:
        content = path.read_bytes()
    except OSError:
        return False
    dumped = content[len(head) : -_DIGEST]
    return content.startswith(head) and content[-_DIGEST:] == sha256(dumped).digest()
