"""Whether the run that wrote a result reached its end, by its log or deck beside it, or by its time."""

import re
from contextlib import suppress
from math import isfinite
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

from dvc.errors import ImageFileError
from dvc.io.meshes.calculix import is_closed, time_reached as time_in_frd
from dvc.io.meshes.febio import time_reached as time_in_xplt

_BANNER = "F O R   B I O M E C H A N I C S"  # of every log of FEBio
_END_BYTES = 1 << 16
_NEARLY = 1.0 - 1e-3  # of the time of a run


class EarlyEnd(NamedTuple):
    """Why a result may not be that of the whole load."""

    reason: str  # a clause whose subject is the run
    certain: bool  # from its log or deck; otherwise only its time is unusual


def early_end(place: Path) -> EarlyEnd | None:
    """Why the run that wrote a result may have ended early; None where nothing says so.

    FEBio (.xplt, .vtk) says in its log how a run ended, and at what time. Without a log, and for CalculiX (.frd), the
    time of the last state is compared with the time of all steps in the deck. These files lie beside the result and
    have its name, for .vtk without the number of the state. Without a deck, CalculiX' result must have its last line.
    What was exported from a run (.vtu, .msh, .csv) is judged by the result, log or status file (.sta) of the same name.
    ImageFileError for a damaged result.
    """
    kind = place.suffix.lower()
    if kind in (".xplt", ".vtk"):
        run = place.with_name(re.sub(r"\.\d+$", "", place.stem) if kind == ".vtk" else place.stem)  # Load1.5.vtk
        log, deck = Path(f"{run}.log"), Path(f"{run}.feb")
        said = _ends_of(log)
        time = time_in_xplt(place) if kind == ".xplt" else _time_in_vtk(place)
        whole = _febio_time(deck)
        at = "" if time is None else f" at time {time:g}" + (f" of {whole:g}" if whole else "")
        if "N O R M A L   T E R M I N A T I O N" in said:
            *_, last = (None, *map(float, re.findall(r"converged at time : (\d+(?:\.\d*)?(?:[eE][-+]?\d+)?)\s", said)))
            if time is None or last is None or time >= _NEARLY * last:
                return None
            reason = f"reached its end at time {last:g} ({log.name}), but {place.name} stops at time {time:g}"
            return EarlyEnd(reason, certain=True)
        if "E R R O R   T E R M I N A T I O N" in said:
            return EarlyEnd(f"ended with ERROR TERMINATION{at} ({log.name})", certain=True)
        if _BANNER in said:
            return EarlyEnd(
                f"did not finish: its log ({log.name}) has no termination message, and it stopped{at}", certain=True
            )
        return _compared(time, whole, deck.name)
    if kind == ".frd":
        time, whole = time_in_frd(place), _calculix_time(place.with_suffix(".inp"))
        if whole is None and time is not None and not is_closed(place):
            reason = f"did not finish: its result has no last line (9999), and it stopped at time {time:g}"
            return EarlyEnd(reason, certain=True)
        return _compared(time, whole, f"{place.stem}.inp")
    return _of_the_run_beside(place)


def _of_the_run_beside(place: Path) -> EarlyEnd | None:
    """The end of the run from which a file was exported."""
    for result in map(place.with_suffix, (".xplt", ".frd")):
        if result.is_file():
            with suppress(ImageFileError):  # it is not what is compared
                if (end := early_end(result)) is not None:
                    return end
    log, status, deck = map(place.with_suffix, (".log", ".sta", ".inp"))
    said = _ends_of(log)
    if "E R R O R   T E R M I N A T I O N" in said:
        return EarlyEnd(f"ended with ERROR TERMINATION ({log.name})", certain=True)
    if _BANNER in said and "N O R M A L   T E R M I N A T I O N" not in said:
        return EarlyEnd(f"has no end in its log ({log.name})", certain=True)
    said = _ends_of(status)
    if "THE ANALYSIS HAS NOT BEEN COMPLETED" in said:  # Abaqus
        return EarlyEnd(f"was not completed ({status.name})", certain=True)
    times = re.findall(r"^(?:\s+\d+){4}\s+(\d*\.\d+(?:E[+-]\d+)?)(?:\s+[.\dE+-]+){2}\s*$", said, re.MULTILINE)
    return _compared(float(times[-1]), _calculix_time(deck), deck.name) if times else None


def _compared(time: float | None, whole: float | None, deck: str) -> EarlyEnd | None:
    if time is None:
        return None
    if whole is not None:
        ended = time >= _NEARLY * whole
        return None if ended else EarlyEnd(f"ended at time {time:g} of {whole:g} ({deck})", certain=True)
    if abs(time - round(time)) > 1.0 - _NEARLY:
        return EarlyEnd(f"ended at time {time:g}, which may be before the end of its load", certain=False)
    return None


def _time_in_vtk(place: Path) -> float | None:
    """The time that FEBio writes as the title of a state in VTK's format; None where the title is another."""
    try:
        with place.open("rb") as file:
            title = re.fullmatch(
                rb"# vtk DataFile[^\n]*\ntime ([-+.0-9eE]+)\s*\n", file.readline(256) + file.readline(256)
            )
            return None if title is None or not isfinite(float(title[1])) else float(title[1])
    except (OSError, ValueError):
        return None


def _text(file: Path) -> str:
    try:
        return file.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _ends_of(file: Path) -> str:
    """Beginning and end of a log, which tell whose it is and how the run ended; between them may lie gigabytes."""
    try:
        with file.open("rb") as log:
            begin = log.read(_END_BYTES)
            log.seek(max(len(begin), file.stat().st_size - _END_BYTES))
            return (begin + log.read()).decode("utf-8", errors="replace")
    except OSError:
        return ""


def _febio_time(deck: Path) -> float | None:
    """The time of all steps of an FEBio deck; None where it cannot be told."""
    try:
        root = ElementTree.fromstring(_text(deck))
        controls = root.findall("./Step//Control") or root.findall("./Control")
        times = [float(one.findtext("time_steps") or "") * float(one.findtext("step_size") or "") for one in controls]
    except (ElementTree.ParseError, ValueError):
        return None
    return sum(times) or None


def _calculix_time(deck: Path) -> float | None:
    """The time of all steps of a CalculiX deck, which are 1 long unless they say otherwise; None where it has none."""
    lines = [line for raw in _text(deck).splitlines() if (line := raw.strip()) and not line.startswith("**")]
    if any(re.search(r"TIME RESET|TOTAL TIME AT START|PERTURBATION", line, re.IGNORECASE) for line in lines):
        return None  # the total time is not the sum of the steps
    times = []
    for number, line in enumerate(lines):
        if not re.match(r"\*(STATIC|VISCO|DYNAMIC|COUPLED TEMPERATURE-DISPLACEMENT)\b", line, re.IGNORECASE):
            continue
        following = lines[number + 1] if number + 1 < len(lines) else "*"
        numbers = [] if following.startswith("*") else following.split(",")
        try:
            times.append(float(numbers[1]) if len(numbers) > 1 and numbers[1].strip() else 1.0)
        except ValueError:
            return None
    return sum(times) or None
