"""Names of loads, material sets and models, which become names of files: none leads out of the folder of results."""

import difflib
import os
import shlex
import stat
import subprocess
import unicodedata
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from dvc.errors import InputError

_MOST_BYTES = 200  # file systems take 255, of which endings need some
_MOST_OF_A_PATH = 255
_ALIKE = 0.75  # of two names without their endings, by difflib: some letters too few, too many or exchanged
_DEVICES = {"con", "prn", "aux", "nul"} | {f"{port}{n}" for port in ("com", "lpt") for n in "0123456789¹²³"}


def as_file_name(text: str) -> str:
    """The text unchanged; ValueError if it cannot name a file or a folder on every system.

    >>> as_file_name("Load 1")
    'Load 1'
    """
    unfit = any(c in '/\\:*?"<>|' or not c.isprintable() for c in text)
    if unfit or not text or text != text.strip() or "." in (text[0], text[-1]):
        raise ValueError(
            "is used as a folder name: it must not be empty, contain slashes, colons, quotes or other special "
            "characters, or begin or end with a dot or a space"
        )
    if text.partition(".")[0].strip().casefold() in _DEVICES:
        raise ValueError("is reserved on Windows; choose another name")
    if len(text.encode(errors="replace")) > _MOST_BYTES:
        raise ValueError(f"is too long for a folder name: at most {_MOST_BYTES} bytes")
    return text


def refuse_path(path: str | os.PathLike[str]) -> None:
    """InputError for a path that no file can have: empty, with a null character, a name of more than 255 bytes.

    And for a pipe or a device, such as /dev/fd/63: reading it might never end.
    """
    text = os.fspath(path)
    if not text:
        raise InputError("The path of a file or folder is empty. Give its name, or leave the option out.")
    if "\0" in text:
        raise InputError(f"{text!r} has a null character (\\u0000), which no path has. Type it again.")
    sizes = {part: len(part.encode(errors="replace")) for part in text.split(os.sep)}
    longest = max(sizes, key=lambda part: sizes[part])
    if (size := sizes[longest]) > _MOST_OF_A_PATH:
        raise InputError(
            f"{longest[:40]}...: a name of {size} bytes; file systems take {_MOST_OF_A_PATH}. Choose a shorter one."
        )
    try:
        kind = os.stat(text).st_mode
    except (OSError, ValueError):  # there is none, which whoever reads it says
        return
    if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
        raise InputError(f"{text}: a pipe or device. Give a regular file or a folder.")


def refuse_missing(path: str | os.PathLike[str]) -> None:
    """InputError for a path at which there is nothing; one that cannot be looked at is left to who reads it."""
    with suppress(PermissionError):
        try:
            os.stat(path)
        except (FileNotFoundError, NotADirectoryError):
            raise InputError(missing(path)) from None


def _digits(name: str) -> list[str]:
    return [letter for letter in name if letter.isdigit()]  # Load1 is no misspelt Load2


def missing(path: str | os.PathLike[str], what: str = "file or folder", advice: str = "Check the path.") -> str:
    """The message for a path at which there is nothing: the folder that is missing, or a name that is nearly the same.

    >>> missing("no/such/folder/Load0.nii.gz")
    "no/such/folder/Load0.nii.gz: no such file or folder, since there is no folder 'no'. Check the path."
    """
    place = Path(path)
    gone = [folder for folder in place.parents if not folder.is_dir()]
    if gone:
        return f"{place}: no such {what}, since there is no folder '{gone[-1]}'. {advice}"
    try:
        beside = [name for name in sorted(os.listdir(place.parent)) if _digits(name) == _digits(place.name)]
    except OSError:
        beside = []
    by_stem = {name.partition(".")[0]: name for name in beside}
    likely = difflib.get_close_matches(place.name.partition(".")[0], by_stem, 1, _ALIKE)
    meant = f"Did you mean '{by_stem[likely[0]]}', which is there?" if likely else advice
    return f"{place}: no such {what}. {meant}"


def is_utf8(path: os.PathLike[str]) -> bool:
    """Whether a path can be written in UTF-8, as native libraries need it; one of an old file system may not be."""
    try:
        os.fspath(path).encode()
    except UnicodeEncodeError:
        return False
    return True


def as_typed(path: str | os.PathLike[str]) -> str:
    """A path, or another value, as it is typed in a command: in quotation marks where a shell would misread it.

    >>> as_typed("results/Load1")
    'results/Load1'
    """
    text = os.fspath(path)
    return subprocess.list2cmdline([text]) if os.name == "nt" else shlex.quote(text)


def one_spelling(name: str) -> str:
    """The same text for all names that some file systems take for one: without case, each accent stored in one way."""
    return unicodedata.normalize("NFC", unicodedata.normalize("NFC", name).casefold())


def clash(names: Iterable[str]) -> str:
    """The first name that is there twice, or the first two that some file systems take for one; empty if all differ.

    >>> clash(["Load1", "Load2", "Load1"])
    "'Load1'"
    >>> clash(["Load1", "load1"])
    "'Load1' and 'load1' (case is ignored)"
    """
    seen: dict[str, str] = {}
    for name in names:
        if (first := seen.get(one_spelling(name))) is not None:
            return f"'{name}'" if first == name else f"'{first}' and '{name}' (case is ignored)"
        seen[one_spelling(name)] = name
    return ""


def refuse_as_file_name(of: str, name: str, where: str = "") -> None:
    """InputError if the name ``of`` something, such as a load, cannot name a file; ``where`` is the file it is in."""
    try:
        as_file_name(name)
    except ValueError as wrong:
        shown = name if len(name) <= _MOST_BYTES else f"{name[:40]}..."
        raise InputError(f"{where and where + ': '}The name of the {of} {shown!r} {wrong}.") from wrong
