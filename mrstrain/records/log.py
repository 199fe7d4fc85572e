"""The log of a command: all that it did and told, in full, in a text file beside its results.

What any module of the packages gives to its logger, at level INFO or above, stands in it.
"""

import logging
import os
import re
import shlex
import sys
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from dvc.errors import InputError
from mrstrain import __version__
from mrstrain.records.provenance import without_places

LOG = "log.txt"
_DICOM = ("", ".dcm", ".ima")
_PACKAGES = ("dvc", "fe", "phantoms", "validate", "mrstrain")
_ELSEWHERE = re.compile(r"(?<![\w.:/\\-])(?:file:|~|[A-Za-z]:)?[/\\]{1,3}(?:[^\s'\"/\\:,;()]+[/\\])+")
_open = list["CommandLog"]()
_log = logging.getLogger(__name__)


def append(place: Path, lines: Sequence[str]) -> None:
    """Append lines to a file, which is closed each time; lines that a full disk does not take stop nothing."""
    with suppress(OSError), place.open("a", encoding="utf-8", errors="backslashreplace") as file:
        file.writelines(f"{line}\n" for line in lines)


def timed(text: str) -> list[str]:
    """The lines of a text, each with the current time (UTC)."""
    return [f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%S}Z {line}" for line in text.splitlines()]


def begin_logs() -> None:
    """Write what the command that runs has told so far: from now on, its output folder is there."""
    for log in _open:
        log.begin()


class CommandLog(logging.Handler):
    """Appends all that is logged to the log of a command; until the output folder is there, it is kept in memory.

    Paths of the command line have no folders in it, as these may name a patient; nor do other absolute paths.
    """

    def __init__(self, out: Path, typed: Sequence[str], *, one_file: bool) -> None:
        super().__init__()
        self.out = out
        self.place = out.with_name(f"{Path(out.name.removesuffix('.gz')).stem}.log") if one_file else out / LOG
        self.begun = False
        self._waiting = list[str]()
        self._places = _places(typed)
        self._existed = self.place.exists()
        self._made = [folder for folder in self.place.parents if not folder.exists()]

    def emit(self, record: logging.LogRecord) -> None:
        """Append a record, with the traceback of its error; one that cannot be written stops nothing."""
        try:
            text = record.getMessage()
            if record.exc_info and record.exc_info[1] is not None:
                text += "\n" + "".join(traceback.format_exception(record.exc_info[1])).rstrip()
            lines = timed(self.impersonal(text))
            if self.begun:
                append(self.place, lines)
            else:
                self._waiting += lines
        except Exception:
            self.handleError(record)

    def impersonal(self, text: str) -> str:
        """A text without the folders of its paths."""
        return _ELSEWHERE.sub("", without_places(text, self._places))

    def begin(self) -> None:
        """Write what has been kept so far."""
        self.acquire()  # as other threads may log at the same time
        try:
            if not self.begun and self.place.parent.is_dir():
                self.begun = True
                append(self.place, self._waiting)
        finally:
            self.release()

    def remove_if_alone(self) -> None:
        """Remove the log, and the folders made for it, if it is new and the command has left nothing else."""
        with suppress(OSError):
            nothing = [*self.out.iterdir()] == [self.place] if self.place.parent == self.out else not self.out.exists()
            if self.begun and nothing and not self._existed:
                self.begun = False
                self.place.unlink()
                for folder in self._made:
                    folder.rmdir()


@contextmanager
def logged(out: Path, typed: Sequence[str], *, one_file: bool = False) -> Iterator[CommandLog]:
    """Log a command that writes to ``out``: a folder, or ``one_file`` with others beside it.

    ``typed`` is the command line. If an error ends the block, its traceback is logged, and where the log is becomes a
    note of the error. A refused or interrupted command that has no results has no log either.
    """
    log, began = CommandLog(out, typed, one_file=one_file), time.monotonic()
    loggers = {logging.getLogger(name): logging.getLogger(name).level for name in _PACKAGES}
    root = logging.getLogger()
    root.addHandler(log)
    _open.append(log)
    for logger in loggers:
        logger.setLevel(logging.INFO)
    logging.captureWarnings(True)
    try:
        _log.info("mrstrain %s: %s", __version__, shlex.join(map(log.impersonal, typed)))
        yield log
        _log.info("Finished after %.1f s", time.monotonic() - began)
    except BaseException as error:
        failed = isinstance(error, Exception)
        words = "Failed" if failed else "Interrupted"
        _log.info("%s after %.1f s", words, time.monotonic() - began, exc_info=error if failed else None)
        if not failed or isinstance(error, InputError) or isinstance(error.__cause__, InputError):
            log.remove_if_alone()
        if log.begun:
            error.add_note(f"Log: {log.place}")
        raise
    finally:
        logging.captureWarnings(False)
        for logger, level in loggers.items():
            logger.setLevel(level)
        _open.remove(log)
        root.removeHandler(log)


def _places(typed: Sequence[str]) -> dict[Path, tuple[str, str]]:
    """Folders above the paths of a command line, and those of Python and this machine, by what is written instead."""
    values = [word.partition("=")[2] if word.startswith("-") else word for word in typed]
    given = {Path(os.path.normpath(value)).parent for value in values if os.sep in value}
    there = {folder for folder in given if folder.name not in ("", "..")}
    there |= {way(folder) for folder in given for way in (Path.absolute, Path.resolve)}
    there |= {Path(place) for place in sys.path if os.path.isabs(place)} | {Path.cwd()}
    alone = {folder: "a folder" if len(folder.parts) > 1 else str(folder) for folder in there}  # a word, such as "data"
    series = {Path(os.path.normpath(value)) for value in values if _is_dicom(Path(value))}
    alone |= dict.fromkeys(series, "a folder")
    return {folder: ("", alone[folder]) for folder in there | series} | {Path.home(): (f"~{os.sep}", "~")}


def _is_dicom(folder: Path) -> bool:
    """Whether a folder holds files as those of a DICOM series are called; it often has the name of a patient."""
    try:
        return folder.is_dir() and any(
            file.suffix.lower() in _DICOM and not file.name.startswith(".") and file.is_file()
            for file in folder.iterdir()
        )
    except (OSError, ValueError):
        return False
