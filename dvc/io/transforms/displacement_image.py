"""Displacement images: three components per voxel, read to a Deformation with the checks of every other image."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np

from dvc.deformation.protocol import SampledDisplacement
from dvc.errors import ImageFileError, InputError
from dvc.io.images.nrrd import nrrd_fields
from dvc.io.images.read import read_header
from dvc.io.images.stored import Voxels

StrPath = str | os.PathLike[str]


def read_displacement(path: StrPath, frame: str | None = None) -> SampledDisplacement:
    """Read a displacement image, in mm: three components per voxel (.nii, .nii.gz, .nrrd, .nhdr, .mha, .mhd).

    Parameters
    ----------
    frame : {"LPS", "RAS"}, optional
        Frame of the components. Where the file, or the JSON file of the same stem beside it (key "frame"), gives the
        frame too, both must agree. MetaImage is LPS, NRRD is LPS where its space is; NIfTI files differ by the
        program that wrote them, so that it must be given.

    Returns
    -------
    SampledDisplacement
        On the grid of the image; voxels that are NaN are undefined.

    Raises
    ------
    InputError
        If there is no such file.
    ImageFileError
        If the file is damaged, not a 3D image of three components, in another unit than mm, or holds infinite
        values, or if its geometry or frame is missing or contradictory.
    """
    place = Path(path)
    if not place.is_file():
        raise InputError(f"{place}: no such displacement image. Check the path.")
    declared = {frame, _frame_beside(place)} - {None}
    try:
        stored = read_header(place, vectors=True)
        if stored.unit != "mm":
            raise ImageFileError(f"{place}: lengths in {stored.unit}; a displacement in mm is needed.")
        known, values = _frame_of_header(place), stored.load()
    except OSError as failure:
        raise ImageFileError(f"{place}: not readable as a displacement image ({failure}).") from failure
    frames = sorted(str(f) for f in declared | ({known} - {None}))
    if len(frames) != 1 or frames[0] not in ("LPS", "RAS"):
        raise ImageFileError(
            f"{place}: the components' frame must be LPS or RAS, and told alike wherever it is told; "
            f"found {frames or 'none'}. Pass frame=, or set 'frame' in the JSON file beside it."
        )
    _refuse_infinite(place, values)
    signs = np.array([1.0, 1.0, 1.0] if frames[0] == "LPS" else [-1.0, -1.0, 1.0])
    try:
        return SampledDisplacement(stored.grid, values * signs)
    except InputError as wrong:
        raise ImageFileError(f"{place}: {wrong}") from wrong


def _frame_beside(path: Path) -> str | None:
    stem = path.name.removesuffix(".gz").rsplit(".", maxsplit=1)[0]
    beside = path.with_name(stem + ".json")
    if not beside.is_file():
        return None
    try:
        header = json.loads(beside.read_text(encoding="utf-8"))
        frame, unit = header.get("frame"), header.get("unit", "mm")
    except (OSError, ValueError, AttributeError) as failure:
        raise ImageFileError(f"{beside}: not readable as a JSON object ({failure}).") from failure
    if unit != "mm" or header.get("configuration", "reference") != "reference":
        raise ImageFileError(f"{beside}: a displacement in mm on the reference configuration is needed; got {header}.")
    return None if frame is None else str(frame)


def _frame_of_header(place: Path) -> str | None:
    """Frame of the components, where the format fixes it."""
    name = place.name.lower()
    if name.endswith((".mha", ".mhd")):
        return "LPS"
    if not name.endswith((".nrrd", ".nhdr")):
        return None
    fields = nrrd_fields(place)[0]
    in_lps = fields.get("space", "").lower() in ("left-posterior-superior", "lps")
    return "LPS" if in_lps and "measurement frame" not in fields else None


def _refuse_infinite(place: Path, values: Voxels) -> None:
    infinite = np.isinf(values).any(axis=-1)
    if infinite.any():
        first = tuple(int(n) for n in np.argwhere(infinite)[0])
        raise ImageFileError(
            f"{place}: the displacement of {int(infinite.sum())} of {infinite.size} voxels is infinite, the first at "
            f"index {first}. Where it is not known, it is NaN: repair the file, or make it again."
        )
