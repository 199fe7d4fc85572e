"""How loops are compiled: by numba, which stores them for the next run, with a checksum for each that is stored.

numba reads what it has stored without a check. A file that a full disk or a crash has cut ended every later run. And it
compiles a loop again if its own file has changed, but not if that of a function that it calls has.
"""

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
_FORMAT = "key and code"  # of a file: what was stored in another is damaged to this program, and to that one


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """As `numba.njit`; a stored loop that is damaged is compiled again, and one that cannot be stored is used once."""

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            kernel = numba.njit(**options)(function)
        except RuntimeError:  # neither the package's folder nor the home folder can be written to
            return numba.njit(**options | {"cache": False})(function)
        if (stored := getattr(kernel._cache, "_cache_file", None)) is not None:
            stored.__class__ = _CheckedFile
            stored.kernel = kernel
        return kernel

    return compiled


def prepare() -> None:
    """Load what numba needs for its first loop, a third of a second: for a process that waits for its task."""
    cpu_target.target_context.refresh()


class _CheckedFile(IndexDataCacheFile):  # type: ignore[misc]  # numba carries no types
    """numba's files of one function, an index and the code for each kind of arguments, with checksums at their ends."""

    kernel: Any

    @property
    def _source_stamp(self) -> list[object]:
        """The stamps, taken when each was imported, of all sources that the stored code was made from."""
        stores = (getattr(one._cache, "_cache_file", None) for one in _called(self.kernel, []))
        return [vars(store)["_source_stamp"] for store in stores if store is not None]

    def save(self, key: Any, data: Any) -> None:
        """Store code with its key: two processes that store at once may give two keys the same file."""
        with suppress(OSError):  # a full disk
            super().save(key, (key, data))

    def load(self, key: Any) -> Any:
        match super().load(key):
            case (stored, data) if stored == key:
                return data
        return None

    def _dump(self, content: Any) -> bytes:
        dumped: bytes = super()._dump(content)
        return dumped + sha256(dumped + self._salt).digest()

    @property
    def _salt(self) -> bytes:
        """Makes a checksum one of these sources: a file of that name may hold code from others, or without a key."""
        return repr((_FORMAT, self._source_stamp)).encode()

    def _load_index(self) -> dict[Any, Any]:
        head = pickle.dumps(self._version, protocol=-1)
        return super()._load_index() if _whole(Path(self._index_path), self._salt, head) else {}

    def _load_data(self, name: str) -> Any:
        if not _whole(place := Path(self._data_path(name)), self._salt):
            raise OSError(f"{place} is damaged")  # by which numba knows that it has to compile
        return super()._load_data(name)


def _called(kernel: Any, seen: list[Any]) -> Iterator[Any]:
    """A compiled function, those that it calls by a global name, and those that they call."""
    seen.append(kernel)
    yield kernel
    function = kernel.py_func
    for name in function.__code__.co_names:
        used = function.__globals__.get(name)
        if isinstance(used, Dispatcher) and used not in seen:
            yield from _called(used, seen)


def _whole(path: Path, salt: bytes, head: bytes = b"") -> bool:
    """Whether a file begins with a head, and the rest ends with the checksum of it and the salt."""
    try:
        content = path.read_bytes()
    except OSError:
        return False
    dumped = content[len(head) : -_DIGEST]
    return content.startswith(head) and content[-_DIGEST:] == sha256(dumped + salt).digest()
