"""What was measured: the loads in a folder that `register` or `strain` wrote."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from dvc.deformation.protocol import Deformation, Within
from dvc.errors import InputError
from dvc.io.images.labels import read_mask
from dvc.io.transforms.bordered_spline import NAME as BORDERS
from dvc.io.transforms.displacement_image import read_displacement
from dvc.io.transforms.read import read_transform
from dvc.trust.error_model import ErrorTable, read_error_model
from dvc.trust.verdict import Verdict

_FIELD, _VALID = "displacement.nii.gz", "valid.nii.gz"
_REPEAT = "repeat"  # a repeat scan is no load


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """One load as it was measured.

    Attributes
    ----------
    load : str
    folder : Path
    table : ErrorTable or None
        Error of the maximal shear, where it is known.
    verdict : Verdict or None
        On the registration.
    aligned_on : str
        "bone", "image" or "none"; empty where it is not told.
    """

    load: str
    folder: Path
    table: ErrorTable | None
    verdict: Verdict | None
    aligned_on: str = ""

    @property
    def field(self) -> Path:
        """The displacement image."""
        return self.folder / _FIELD

    @property
    def files(self) -> list[Path]:
        """What is read of the displacement."""
        jumping = self.folder / BORDERS
        return [jumping, self.folder / _VALID] if jumping.is_file() else [self.field]

    def deformation(self) -> Deformation:
        """Displacement of tissue relative to its bone: with its jumps of strain at borders, where it has any."""
        if (self.folder / BORDERS).is_file():
            return Within(spline_in(self.folder), read_mask(self.folder / _VALID), margin_voxels=0)
        return read_displacement(self.field)


def spline_in(folder: Path) -> Deformation:
    """The displacement of tissue relative to its bone that `register` found for one load.

    With its own gradient, where the engine has a file that holds it; otherwise its displacement image.
    """
    for name in (BORDERS, "TransformParameters.0.txt"):
        if (folder / name).is_file():
            return read_transform(folder / name)
    if (folder / "transform.h5").is_file() and (folder / _FIELD).is_file():
        return read_displacement(folder / _FIELD)
    raise InputError(f"{folder} has neither {BORDERS} nor TransformParameters.0.txt: register this load again.")


def measurements_in(place: Path, loads: Sequence[str] = ()) -> list[Measurement]:
    """The loads in a folder that `register` or `strain` wrote, or the one whose folder it is; or some of them by name.

    Raises
    ------
    InputError
        If there is none, or one that is asked for is missing.
    """
    folders = [place] if (place / _FIELD).is_file() else sorted(p.parent for p in place.glob(f"*/{_FIELD}"))
    folders = [f for f in folders if f == place or f.name != _REPEAT]
    if not folders:
        raise InputError(
            f"{place}: no results of `register` or `strain` here (LOAD/{_FIELD}). Give the folder they wrote."
        )
    absent = [load for load in loads if load not in [f.resolve().name for f in folders]]
    if absent:
        raise InputError(f"{place} has no results of {', '.join(absent)}.")
    found = []
    for folder in folders:
        if loads and folder.resolve().name not in loads:
            continue
        model = folder / "error_model.json"
        table = read_error_model(model).tables[0] if model.is_file() else None
        verdict, aligned_on = None, ""
        if (folder / "quality.json").is_file():
            told = json.loads((folder / "quality.json").read_text(encoding="utf-8"))
            verdict = Verdict(told["verdict"]["level"], tuple(told["verdict"]["reasons"]))
            aligned_on = str(told.get("alignment", {}).get("on", ""))
        found.append(Measurement(folder.resolve().name, folder, table, verdict, aligned_on))
    return found
