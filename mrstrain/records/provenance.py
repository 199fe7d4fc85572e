"""Provenance of a result: versions, kind of machine, parameters, seeds, hashes; no name of a person or a host."""

import hashlib
import os
import platform
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dvc.own_files import read_json
from dvc.software import distribution_versions
from dvc.threads import usable_cores
from mrstrain.records.doctor import usable_memory_bytes

_BLOCK = 1 << 20
_REFERENCE = re.compile(
    rb'^\s*(?:ElementDataFile\s*=|data file:|\(InitialTransformParameter\w*\s+"|\(TransformFileName\s+")'
    rb'\s*([^"\r\n]+)',
    re.MULTILINE | re.IGNORECASE,
)


def file_hash(path: Path) -> str:
    """SHA-256 of a file and the files that it refers to; of a folder, of the names and contents of its files in order.

    Headers (.mhd, .nhdr) refer to the file of their voxels, elastix transforms to their initial transform.
    """
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else _with_referenced(path)
    for file in files:
        if path.is_dir():
            digest.update(str(file.relative_to(path)).encode())
        with file.open("rb") as stream:
            while block := stream.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _with_referenced(path: Path) -> list[Path]:
    files = [path]
    for file in files:  # grows while it is read
        if file.suffix.lower() not in (".mhd", ".nhdr", ".txt"):
            continue
        for name in _REFERENCE.findall(file.read_bytes()[:_BLOCK]):
            place = Path(name.decode(errors="replace").strip())
            candidates = (file.parent / place, file.parent / place.name)
            referenced = next((p for p in candidates if p.is_file()), file)
            if referenced not in files:
                files.append(referenced)
    return files


def versions() -> dict[str, str]:
    """Versions of Python, the system, and the packages that results depend on."""
    here = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    return here | distribution_versions()


def _processor() -> str:
    try:  # on Linux, where `platform` does not know the name
        model = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        model = None
    return model[1].strip() if model else platform.processor() or platform.machine()


def provenance(
    command: str, inputs: Mapping[str, Path | list[Path]], parameters: Mapping[str, object]
) -> dict[str, object]:
    """Provenance record that is written beside a result of a command or function.

    Of ``inputs``, file or files by role, only names and hashes are recorded; ``parameters`` are all other values that
    the result depends on, as plain values.
    """
    files = {
        role: [{"name": p.name, "sha256": file_hash(p)} for p in ([given] if isinstance(given, Path) else given)]
        for role, given in inputs.items()
    }
    memory = usable_memory_bytes()
    gib = None if memory is None else round(memory / 2**30, 1)
    return {
        "command": command, "made_utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"), "versions": versions(),
        "machine": {"processor": _processor(), "cores": usable_cores(), "memory_gib": gib}, "inputs": files,
        "parameters": dict(parameters),
    }  # fmt: skip


def read_record(place: Path) -> Mapping[str, Any]:
    """A record of provenance or of quality; an empty one where there is none, or none that can be read."""
    try:
        return read_json(place)
    except (OSError, ValueError):
        return {}


def without_folders(value: Any, home: Path) -> Any:
    """Values without the location of a study: paths are relative to its folder ``home``, or bare names outside it.

    The values of a study that is moved as a whole are then unchanged. A folder outside may name a patient, so it
    becomes "a folder".
    """
    if isinstance(value, Mapping):
        return {key: without_folders(one, home) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [without_folders(one, home) for one in value]
    if not isinstance(value, str | Path):
        return value
    place = Path(os.path.normpath(home / value))
    if not place.is_relative_to(home):
        return "a folder" if place.is_dir() else place.name
    return place.relative_to(home).as_posix() if os.path.isabs(value) else str(value)


def without_places(text: str, places: Mapping[Path, tuple[str, str]]) -> str:
    """A text without the locations of folders: what stands for one before a file within it, and for one alone."""
    for place in sorted(places, key=lambda one: -len(str(one))):  # inner folders first
        if place != place.parent:
            within, alone = places[place]
            begin = rf"(?<![\w.-]){re.escape(str(place))}"
            text = re.sub(begin + re.escape(os.sep), within.replace("\\", r"\\"), text)
            text = re.sub(rf"{begin}(?![\w.-])", alone, text)
    return text
