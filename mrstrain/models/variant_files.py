"""Folders with variants of models: results of a model with one input changed, and a file that says which."""

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from dvc.errors import InputError
from dvc.own_files import parse_toml
from dvc.tables import refuse_damaged_toml
from mrstrain.options.model import Options, Real

MESH = "mesh"
"""Name of the input that stands for the mesh."""
VARIANT = "variant.toml"
"""File in the folder of a variant: model, input, steps, and optionally the folder of the solution that it is compared
with (base), relative to its own."""


class VariantRecord(Options):
    """What a ``variant.toml`` says."""

    model: str
    input: str
    steps: Real
    base: str | None = None

    @classmethod
    def of_folders(cls, model: str, name: str, steps: float, base: Path | None, folder: Path) -> Self:
        """The record of a variant in a folder, compared with the solution in another folder or with the model."""
        beside = None if base is None else Path(os.path.relpath(base, folder)).as_posix()
        return cls(model=model, input=name, steps=steps, base=beside)

    @property
    def text(self) -> str:
        """The text of the file."""
        lines = [f"model = {json.dumps(self.model)}", f"input = {json.dumps(self.input)}", f"steps = {self.steps!r}"]
        return "\n".join([*lines, *([f"base = {json.dumps(self.base)}"] if self.base else [])]) + "\n"


@dataclass(frozen=True, slots=True)
class VariantFolder:
    """A folder with the results of a model with one input changed."""

    place: Path
    record: VariantRecord

    @property
    def base(self) -> Path | None:
        """Folder of the solution with which it is compared; None for the model itself."""
        return None if self.record.base is None else self.place / self.record.base


def variant_folders(places: Iterable[Path]) -> list[VariantFolder]:
    """The variants in these folders, and in folders below them.

    InputError if a folder has none, or a file is not valid.
    """
    found = []
    for place in places:
        files = sorted(place.rglob(VARIANT))
        if not files:
            raise InputError(
                f"{place}: no folder in it has a file {VARIANT}, which names the model, the input that was changed, "
                "and by how many standard uncertainties (steps)."
            )
        found += [VariantFolder(file.parent, _read(file)) for file in files]
    return found


def _read(file: Path) -> VariantRecord:
    try:
        text = file.read_text(encoding="utf-8-sig")
        content = parse_toml(text)
    except (OSError, ValueError) as error:
        raise InputError(f"{file} is not a valid TOML file ({error}).") from error
    refuse_damaged_toml(file, text, content)
    try:
        record = VariantRecord.of(content)
    except InputError as error:
        raise InputError(f"{file}: {error}") from error
    if record.steps == 0.0:
        raise InputError(f"{file}: steps is 0; give the change of the input in standard uncertainties.")
    return record
