"""`init`: a study file, written from what a folder holds."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import jinja2

from dvc.errors import InputError, OutputError
from dvc.whole import write_whole
from fe.published import published_names
from mrstrain.inputs import IMAGE_ENDINGS as IMAGES
from mrstrain.loads import LOADS
from mrstrain.modelfiles import ENDINGS
from mrstrain.studyfile import FILE

_UNLOADED = re.compile(r"load[ _-]?0|unloaded|no[ _-]?load|baseline", re.IGNORECASE)
_AGAIN = re.compile(r"again|repeat|rescan|retest", re.IGNORECASE)
_LOADED = re.compile(r"load[ _-]?[1-9]\d*|loaded", re.IGNORECASE)
_LABELS = re.compile(r"label|tissue|seg", re.IGNORECASE)
_TO_MESH = re.compile(r"to[ _-]?mesh", re.IGNORECASE)
_BONE = re.compile(r"calcaneus|calcaneum|bone", re.IGNORECASE)
_VARIANT = "-as-published"  # a set in another reading of its numbers
_TABLES = (".csv", ".txt", ".label", ".ctbl")


@dataclass(slots=True)
class Found:
    """What a folder holds, by the role that its names suggest; names relative to it."""

    load0: str | None = None
    repeat: str | None = None
    loads: dict[str, str] = field(default_factory=dict)
    labels: str | None = None
    names: str | None = None
    bone_mask: str | None = None
    mesh_labels: str | None = None
    mesh_names: str | None = None
    results: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Begun:
    """What `init` wrote."""

    path: Path
    found: Found

    def summary(self) -> list[str]:
        """A few lines for a person."""
        found = self.found
        lines = [f"Load0: {found.load0 or 'NOT FOUND'}", f"Loads: {', '.join(found.loads.values()) or 'NONE FOUND'}"]
        lines += [f"Labels: {found.labels or 'NOT FOUND'}", f"Repeat scan: {found.repeat or 'none'}"]
        lines += [f"Results of other codes: {', '.join(found.results)}"] if found.results else []
        return [
            *lines,
            f"Study file: {self.path}. Put the forces in; then: mrstrain check {self.path.parent}",
        ]


def init(folder: Path | str) -> Begun:
    """Write a study file with comments from the files in a folder.

    Parameters
    ----------
    folder : path
        With the images, the label map and its names, and perhaps results of other codes in folders of their own.

    Raises
    ------
    InputError
        If there is no such folder, or two files seem to be the unloaded image.
    OutputError
        If it has a study file already.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError(f"{place} is no folder.")
    target = place / FILE
    if target.exists():
        raise OutputError(f"{target} is there already; remove it to have it written anew.")
    found = _look(place)
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    template = environment.from_string((files("mrstrain") / "templates" / "study.toml.j2").read_text(encoding="utf-8"))
    forces = {load.name: (load.normal_n, load.shear_n) for load in LOADS}
    sets = [name for name in published_names() if not name.endswith(_VARIANT)]
    write_whole(target, template.render(found=found, forces=forces, sets=sets))
    return Begun(target, found)


def _look(place: Path) -> Found:
    found = Found()
    images = sorted(p.name for p in place.iterdir() if p.name.lower().endswith(IMAGES) and p.is_file())
    images += sorted(p.name for p in place.iterdir() if p.is_dir() and any(p.glob("*.dcm")))
    for name in images:
        stem = _stem(name)
        if _LABELS.search(stem):
            if _TO_MESH.search(stem):
                found.mesh_labels = found.mesh_labels or name
            else:
                found.labels = found.labels or name
        elif _BONE.search(stem):
            found.bone_mask = found.bone_mask or name
        elif _UNLOADED.search(stem):
            if _AGAIN.search(stem):
                found.repeat = found.repeat or name
                continue
            if found.load0 is not None:
                raise InputError(f"{place}: both {found.load0} and {name} seem to be the unloaded image; rename one.")
            found.load0 = name
        elif _LOADED.search(stem) and not _AGAIN.search(stem):
            found.loads[stem] = name
    found.names = _table(place, found.labels)
    found.mesh_names = _table(place, found.mesh_labels)
    for inside in sorted(p for p in place.iterdir() if p.is_dir() and p.name not in images):
        if any((inside / (load + ending)).is_file() for load in found.loads for ending in ENDINGS):
            found.results.append(inside.name)
    return found


def _stem(name: str) -> str:
    return next((name[: -len(s)] for s in IMAGES if name.lower().endswith(s)), name)


def _table(place: Path, image: str | None) -> str | None:
    """The table of names that is called as a label map."""
    if image is None:
        return None
    return next((_stem(image) + e for e in _TABLES if (place / (_stem(image) + e)).is_file()), None)
