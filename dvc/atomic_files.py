"""Files and folders that take their name only when they are complete, or leave nothing behind."""

import csv
import io
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from dvc.errors import OutputError


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Give a name of the same ending, in the same folder, to write under; it becomes ``path`` in one step.

    OutputError if the file cannot be written; what was begun is removed, and an older file of that name is still there.
    """
    part = path.with_name(f".{os.getpid()}.partial.{path.name}")
    try:
        yield part
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        advice = "Check that the folder exists and is writable, and that the disk has space."
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}). {advice}") from error
    finally:
        with suppress(OSError):
            part.unlink()


def remove_partial(folder: Path) -> None:
    """Remove what a process that has ended had begun to write into a folder with `whole_file`, if there is one."""
    import psutil

    for part in folder.glob(".*.partial.*"):
        number = part.name.split(".")[1]
        if number.isdecimal() and not psutil.pid_exists(int(number)):
            with suppress(OSError):
                part.unlink()


def write_whole(path: Path, text: str) -> None:
    """Write a text file (UTF-8, lines ending as they are given), whole or not at all; errors as `whole_file`."""
    with whole_file(path) as part:
        part.write_text(text, encoding="utf-8", newline="")


def write_json(path: Path, content: Mapping[str, object]) -> None:
    """Write JSON whole or not at all; NaN is refused, as JSON has none."""
    write_whole(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def write_csv(path: Path, head: Iterable[str], rows: Iterable[Iterable[object]]) -> None:
    """Write a table as a CSV file whole or not at all; floats have six significant digits."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(head)
    writer.writerows([f"{value:.6g}" if isinstance(value, float) else value for value in row] for row in rows)
    write_whole(path, text.getvalue())


@contextmanager
def whole_folder(final: Path) -> Iterator[Path]:
    """Give a folder to fill; it takes its final name when the block ends well, and is removed if not.

    An older folder of that name is replaced only then. OutputError if it cannot be made or renamed, or a disk is full.
    """
    try:
        partial = Path(tempfile.mkdtemp(prefix=f".{final.name}.", suffix=".partial", dir=final.parent))
        try:
            partial.chmod(0o755)
            yield partial
            _put_in_place(partial, final)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
        _remove_left(final)
    except OSError as error:
        advice = "Check the permissions of the folder and the disk space. No incomplete results were left."
        raise OutputError(f"{final}: results cannot be written ({error.strerror or error}). {advice}") from error


def _put_in_place(partial: Path, final: Path) -> None:
    """Move a complete folder to its final name; an older folder of that name stays until then."""
    if not final.exists():
        partial.replace(final)
        return
    name = f".{final.name}."
    with tempfile.TemporaryDirectory(".old", name, final.parent, ignore_cleanup_errors=True) as aside:
        old = final.replace(Path(aside) / final.name)
        try:
            partial.replace(final)
        except OSError:
            old.replace(final)
            raise


def _remove_left(final: Path) -> None:
    """Remove incomplete and replaced copies of this folder that killed processes left behind."""
    left = re.compile(rf"\.{re.escape(final.name)}\.\w{{8}}\.(partial|old)")
    for folder in final.parent.iterdir():
        if left.fullmatch(folder.name):
            shutil.rmtree(folder, ignore_errors=True)
