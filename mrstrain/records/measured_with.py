"""What a measurement was made with, by the record beside it. Its files are found again by their names and contents."""

import glob
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from dvc.errors import InputError
from dvc.io.result_folder import PROVENANCE, ResultFolder
from dvc.own_files import read_json
from mrstrain.records.provenance import file_hash

_WHAT = {
    "load0": "unloaded image", "bone": "bone mask", "tissue": "mask of the body", "labels": "label map",
    "names": "table of label names",
}  # fmt: skip
"""Inputs of a subject: roles in a record, and what they are."""
_HOW = {"bone_label": "bone label", "engine": "engine", "borders": "tissue interfaces", "stages": "elastix parameters"}
"""Parameters that loads of one subject have in common, in the same way."""
_FOLDERS = 4  # of a load, its series, the results of a study, the study


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredWith:
    """The inputs and parameters that the record of a measurement tells.

    A record holds names and hashes, and no folders, which may name a patient. A file is looked for in the folder of the
    record, those above it and the working directory, and in the folders in these; so results may be moved together
    with what they were made from.
    """

    path: Path  # the record
    inputs: Mapping[str, tuple[str, str]]  # role: name and SHA-256
    parameters: Mapping[str, Any]

    @classmethod
    def read(cls, folder: Path) -> Self | None:
        """The record in the folder of a load; None if there is none.

        InputError is raised if the file is no record of a measurement.
        """
        path = folder / PROVENANCE
        if not path.is_file():
            return None
        try:
            record = read_json(path)
            listed = {role: record["inputs"][role] for role in _WHAT if record["inputs"].get(role)}
            inputs = {role: (str(files[0]["name"]), str(files[0]["sha256"])) for role, files in listed.items()}
            return cls(path, inputs, dict(record["parameters"]))
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as failure:
            raise InputError(
                f"{path}: not the record of a measurement ({failure!r}). Copy the folder again, or register again."
            ) from failure

    @classmethod
    def shared(cls, loads: Sequence[ResultFolder], instead: str, about: Sequence[str] = (*_WHAT, *_HOW)) -> Self:
        """The record of all loads of a subject, which have to be alike in what is asked ``about``: inputs, parameters.

        InputError is raised if a load has none, or if loads differ; its message says what to give ``instead``.
        """
        first, *others = [cls._of(load, instead) for load in loads]
        for other in others:
            for name in about:
                if other._told(name) != first._told(name):
                    raise InputError(
                        f"{first.path} and {other.path}: the loads were not measured with the same "
                        f"{(_WHAT | _HOW)[name]}. Give {instead}, or take one load."
                    )
        return first

    @classmethod
    def _of(cls, load: ResultFolder, instead: str) -> Self:
        found = cls.read(load.folder)
        if found is None:
            raise InputError(
                f"{load.folder / PROVENANCE} is missing, so the inputs of the measurement are unknown. Give {instead}."
            )
        return found

    def _told(self, name: str) -> object:
        return self.inputs.get(name) if name in _WHAT else self.parameters.get(name)

    def file(self, role: str, instead: str = "") -> Path | None:
        """The file that was measured with, where it is now; None if the measurement was made without it.

        InputError is raised if it is gone or was changed; its message says what to give ``instead``, by default the
        option called as the role.
        """
        if role not in self.inputs:
            return None
        name, sha256 = self.inputs[role]
        instead = instead or f"the file to use as {role} (--{role})"
        return self.find(name, lambda place: file_hash(place) == sha256, _WHAT[role], instead)

    def find(self, name: str, is_same: Callable[[Path], bool], what: str, instead: str) -> Path:
        """A file by its name and contents; errors as those of `file`."""
        changed = None
        for place in self._places(name):
            if is_same(place):
                return place
            changed = changed or place
        if changed is not None:
            raise InputError(
                f"{self.path}: {changed} is not the {what} of the measurement (its contents differ). Restore the one "
                f"that was used, or give {instead}."
            )
        raise InputError(
            f"{self.path}: the {what} {name} of the measurement was found neither in the folders around the results "
            f"nor in the working directory. Give {instead}."
        )

    def _places(self, name: str) -> Iterator[Path]:
        """Where a file of this name lies, the nearest first; as seen from the working directory where it is below."""
        here = Path.cwd()
        for folder in dict.fromkeys((*self.path.absolute().parents[:_FOLDERS], here)):
            for place in (folder / name, *sorted(folder.glob(f"*/{glob.escape(name)}"))):
                if place.exists():
                    yield place.relative_to(here) if place.is_relative_to(here) else place
