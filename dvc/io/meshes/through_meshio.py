"""Mesh files that meshio reads, with its many kinds of failure and its printing in one place."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from meshio._mesh import topological_dimension

from dvc.errors import ImageFileError

_log = logging.getLogger("dvc.io.meshes.read")

# meshio 5.3.5 reads and writes these cells, but has left them out of its own table of dimensions, and fails on them.
topological_dimension.update({"wedge15": 3, "pyramid13": 3})


def read_through_meshio(path: Path, read: Callable[[str], Any]) -> Any:
    """Read a file by one of meshio's readers; refused if that fails, for whatever reason."""
    with silenced() as said, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return read(str(path))
        except Exception as error:
            # meshio meets damaged files with whatever Python raises: KeyError, ValueError, IndexError ...
            reason = " ".join(f"{type(error).__name__}: {error} {said.getvalue()}".split())
            raise ImageFileError(
                f"{path} cannot be read as a mesh ({reason}). It is damaged, or of a variant that is not "
                "read; write it again as VTU."
            ) from error


@contextlib.contextmanager
def silenced() -> Iterator[io.StringIO]:
    """Keep what meshio prints off the terminal, and log it."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        yield said
    if said.getvalue().strip():
        _log.info("meshio: %s", " ".join(said.getvalue().split()))
