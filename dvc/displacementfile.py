"""Displacement images: three components per voxel, read to a Deformation."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import SimpleITK as sitk
from nibabel.filebasedimages import ImageFileError as NiftiError

from dvc.arrays import FloatArray
from dvc.deformation import SampledDisplacement
from dvc.errors import ImageFileError, InputError
from dvc.image import Grid
from dvc.nrrd import nrrd_fields

StrPath = str | os.PathLike[str]

_LPS_FROM_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def read_displacement(path: StrPath, frame: str | None = None) -> SampledDisplacement:
    """Read a displacement image, in mm: three components per voxel (.nii, .nii.gz, .nrrd, .nhdr, .mha, .mhd).

    Parameters
    ----------
    frame : {"LPS", "RAS"}, optional
        Frame of the components. It overrides nothing: where the file, or the JSON file of the same stem
        beside it (key "frame"), tells the frame too, both must agree. MetaImage is LPS, NRRD is LPS where
        its space is; NIfTI files differ by the program that wrote them, so that it must be told.

    Returns
    -------
    SampledDisplacement
        On the grid of the image; voxels that are NaN are undefined.

    Raises
    ------
    ImageFileError
        If the file is damaged, no 3D image of three components, or its place or frame is not known.
    """
    place = Path(path)
    if not place.is_file():
        raise InputError(f"{place}: no such displacement image. Check the path.")
    name = place.name.lower()
    told = {frame, _frame_beside(place)} - {None}
    nifti = name.endswith((".nii", ".nii.gz"))
    try:
        image, known = _nifti_vectors(place) if nifti else _itk_vectors(place)
    except (RuntimeError, OSError, EOFError, ValueError, NiftiError) as failure:
        if isinstance(failure, InputError):
            raise
        reason = (str(failure).strip().splitlines() or ["no reason given"])[-1].strip()
        raise ImageFileError(f"{place}: not readable as a displacement image ({reason}).") from failure
    frames = sorted(str(f) for f in told | ({known} - {None}))
    if len(frames) != 1 or frames[0] not in ("LPS", "RAS"):
        raise ImageFileError(
            f"{place}: the components' frame must be LPS or RAS, and told alike wherever it is told; "
            f"found {frames or 'none'}. Pass frame=, or set 'frame' in the JSON file beside it."
        )
    grid, values = image
    try:
        return SampledDisplacement(grid, values * (1.0 if frames[0] == "LPS" else np.array([-1.0, -1.0, 1.0])))
    except InputError as wrong:
        raise ImageFileError(f"{place}: {wrong}") from wrong


def _frame_beside(path: Path) -> str | None:
    stem = path.name.removesuffix(".gz").rsplit(".", maxsplit=1)[0]
    beside = path.with_name(stem + ".json")
    if not beside.is_file():
        return None
    try:
        told = json.loads(beside.read_text())
        frame, unit = told.get("frame"), told.get("unit", "mm")
    except (OSError, ValueError, AttributeError) as failure:
        raise ImageFileError(f"{beside}: not readable as a JSON object ({failure}).") from failure
    if unit != "mm" or told.get("configuration", "reference") != "reference":
        raise ImageFileError(f"{beside}: a displacement in mm on the reference configuration is needed; got {told}.")
    return None if frame is None else str(frame)


def _itk_vectors(path: Path) -> tuple[tuple[Grid, FloatArray], str | None]:
    image = sitk.ReadImage(os.fspath(path))
    if image.GetDimension() != 3 or image.GetNumberOfComponentsPerPixel() != 3:
        size, count = image.GetSize(), image.GetNumberOfComponentsPerPixel()
        raise ImageFileError(f"{path}: size {size}, {count} components per voxel; a displacement is 3D, with three.")
    known: str | None = "LPS"
    if path.suffix.lower() in (".nrrd", ".nhdr"):
        fields = nrrd_fields(path)[0]  # ITK turns the grid to LPS, but not the components
        in_lps = fields.get("space", "").lower() in ("left-posterior-superior", "lps")
        known = "LPS" if in_lps and "measurement frame" not in fields else None
    return (
        grid_of(image),
        np.asarray(sitk.GetArrayFromImage(image).transpose(2, 1, 0, 3), dtype=np.float64),
    ), known


def _nifti_vectors(path: Path) -> tuple[tuple[Grid, FloatArray], None]:
    image: Any = nibabel.load(path)
    shape, header = image.shape, image.header
    if len(shape) != 5 or shape[3:] != (1, 3):
        raise ImageFileError(f"{path}: a NIfTI of shape {shape}; a displacement is (ni, nj, nk, 1, 3).")
    if header.get_xyzt_units()[0] not in ("mm", "unknown"):
        raise ImageFileError(f"{path}: lengths in {header.get_xyzt_units()[0]}; a displacement in mm is needed.")
    qform, sform = header.get_qform(coded=True)[0], header.get_sform(coded=True)[0]
    if qform is None and sform is None:
        raise ImageFileError(f"{path}: neither qform nor sform says where the image lies. Set one of them.")
    grids = [_grid_from_ras(affine, shape[:3]) for affine in (sform, qform) if affine is not None]
    if not grids[0].same_as(grids[-1], tolerance_voxels=0.1):
        raise ImageFileError(f"{path}: qform and sform place the image differently. Remove the one that is wrong.")
    return (grids[0], np.asarray(image.dataobj, dtype=np.float64)[:, :, :, 0, :]), None


def _grid_from_ras(affine: FloatArray, shape: tuple[int, int, int]) -> Grid:
    lps = _LPS_FROM_RAS @ affine
    spacing = np.linalg.norm(lps[:3, :3], axis=0)
    return Grid(shape, spacing, lps[:3, 3], lps[:3, :3] / np.where(spacing > 0, spacing, 1.0))


def grid_of(image: Any) -> Grid:
    """Read the grid of a SimpleITK image, which is LPS mm already."""
    size = image.GetSize()
    direction = np.reshape(image.GetDirection(), (3, 3))
    return Grid((size[0], size[1], size[2]), np.array(image.GetSpacing()), np.array(image.GetOrigin()), direction)
