"""What a result was made from: versions, kind of machine, parameters, seeds, hashes. No name of a person or a host."""

from __future__ import annotations

import hashlib
import os
import platform
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dvc.software import distribution_versions
from dvc.worker import usable_cores
from mrstrain.records.doctor import usable_memory_bytes

_BLOCK = 1 << 20


_NAMED = re.compile(
    rb'^\s*(?:ElementDataFile\s*=|data file:|\(InitialTransformParameter\w*\s+"|\(TransformFileName\s+")'
    rb'\s*([^"\r\n]+)',
    re.MULTILINE | re.IGNORECASE,
)


def file_hash(path: Path) -> str:
    """SHA-256 of a file and of the files that it names; of a folder, of its files' names and contents in order.

    Headers name the file of their voxels (.mhd, .nhdr), elastix transforms their initial transform.
    """
    digest = hashlib.sha256()
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else _with_named(path)
    for file in files:
        if path.is_dir():
            digest.update(str(file.relative_to(path)).encode())
        with file.open("rb") as stream:
            while block := stream.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()


def _with_named(path: Path) -> list[Path]:
    found, waiting = [path], [path]
    while waiting:
        file = waiting.pop()
        if file.suffix.lower() not in (".mhd", ".nhdr", ".txt"):
            continue
        for name in _NAMED.findall(file.read_bytes()[:_BLOCK]):
            told = Path(name.decode(errors="replace").strip())
            named = next((p for p in (file.parent / told, file.parent / told.name) if p.is_file()), file)
            if named.is_file() and named not in found:
                found.append(named)
                waiting.append(named)
    return found


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that figures depend on."""
    here = {"python": platform.python_version(), "system": f"{platform.system()} {platform.machine()}"}
    return here | distribution_versions()


def machine() -> dict[str, object]:
    """The kind of machine that this is: processor, cores and memory that may be used."""
    memory = usable_memory_bytes()
    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "memory_gib": None if memory is None else round(memory / 2**30, 1),
    }


def _processor() -> str:
    try:  # where Linux has its name; `platform` has none there
        told = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
    except OSError:
        told = None
    return told[1].strip() if told else platform.processor() or platform.machine()


def provenance(
    command: str, inputs: Mapping[str, Path | list[Path]], parameters: Mapping[str, object]
) -> dict[str, object]:
    """A record to be kept beside a result.

    Parameters
    ----------
    command : str
        Name of the command or function.
    inputs : mapping
        Role to file or files; only file names and hashes are kept.
    parameters : mapping
        Everything else that the result depends on, as plain values.
    """
    files: dict[str, list[dict[str, str]]] = {}
    for role, given in inputs.items():
        paths = [given] if isinstance(given, Path) else given
        files[role] = [{"name": p.name, "sha256": file_hash(p)} for p in paths]
    return {
        "command": command,
        "made_utc": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "versions": versions(),
        "machine": machine(),
        "inputs": files,
        "parameters": dict(parameters),
    }


def without_folders(told: Any, home: Path) -> Any:
    """Values without the place of a study: paths in its folder from there, files outside by their names alone.

    A study that is moved as a whole so stays the same; and folders may name a patient, so one outside is "a folder".
    """
    if isinstance(told, Mapping):
        return {key: without_folders(value, home) for key, value in told.items()}
    if isinstance(told, list | tuple):
        return [without_folders(value, home) for value in told]
    if not isinstance(told, str):
        return told
    place = Path(os.path.normpath(home / told))
    if not place.is_relative_to(home):
        return "a folder" if place.is_dir() else place.name
    return place.relative_to(home).as_posix() if os.path.isabs(told) else told
