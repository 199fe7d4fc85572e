"""DICOM series: slices put together by their position in space, never by their numbers.

Only what is needed of each header is looked at: no name, number or date of a patient is read.

References
----------
.. [1] DICOM PS3.3, Image Plane Module (C.7.6.2): https://dicom.nema.org/medical/dicom/current/output/html/part03.html
"""

from __future__ import annotations

import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pydicom

from dvc.arrays import Float32Array, FloatArray
from dvc.errors import ImageFileError, InputError
from dvc.image import Grid
from dvc.storedvolume import MAX_BYTES, refuse_if_too_large

_log = logging.getLogger("dvc.images")

_TAGS = [
    "SOPClassUID",
    "SeriesInstanceUID",
    "ImageType",
    "EchoTime",
    "EchoNumbers",
    "Rows",
    "Columns",
    "PixelSpacing",
    "ImagePositionPatient",
    "ImageOrientationPatient",
    "NumberOfFrames",
    "SamplesPerPixel",
    "PhotometricInterpretation",
    "BitsAllocated",
    "BitsStored",
    "HighBit",
    "PixelRepresentation",
    "PlanarConfiguration",
    "RescaleSlope",
    "RescaleIntercept",
]
_NEEDED = (
    "SeriesInstanceUID",
    "Rows",
    "Columns",
    "PixelSpacing",
    "ImagePositionPatient",
    "ImageOrientationPatient",
    "BitsAllocated",
)
_SUFFIXES = (".dcm", ".ima")
_SAME_PLACE_MM = 0.01
_SAME_DIRECTION = 1e-3
_OFF_PLACE = 0.1  # of a voxel
_CONVERT = "Convert it to NIfTI, for example with dcm2niix, and give the .nii.gz file."


@dataclass(frozen=True, slots=True, eq=False)
class _Slice:
    path: Path
    position_mm: FloatArray
    axes: FloatArray  # (2, 3): directions of increasing column and row
    spacing_mm: tuple[float, float]  # between columns, between rows
    kind: tuple[Any, ...]  # series, echo time, echo number, image type, columns, rows, rounded spacing
    slope: float
    intercept: float


def is_dicom(path: Path) -> bool:
    """Whether a file looks like DICOM, from its first bytes or its suffix."""
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM" or path.suffix.lower() in _SUFFIXES


def read_dicom_series(
    folder: Path, *, series: str | None = None, max_bytes: int = MAX_BYTES
) -> tuple[Grid, Float32Array]:
    """Grid (LPS mm) and values (columns, rows, slices) of a folder with one DICOM series.

    Slices are ordered along the normal of their plane; rescale slope and intercept of each are applied.

    Parameters
    ----------
    folder : folder whose files, not those of its subfolders, are the series
    series : str, optional
        Which one of several: the end of the series' UID, and "/n" for the n-th stack of a series with
        several echoes, image types or orientations, as the refusal lists them.

    Raises
    ------
    InputError
        If the folder holds several series or echoes and ``series`` does not pick one.
    ImageFileError
        If there is no DICOM image, a file is damaged, a slice is missing or there twice, slices are sheared
        or of several frames, or voxels are not single grey values.
    """
    stacks = _named_stacks(_stacks(_slices(folder)))
    if not stacks:
        raise ImageFileError(f"{folder}: no DICOM image in this folder (subfolders are not searched).")
    name = _picked(folder, stacks, series)
    grid, ordered = _assembled(folder, stacks[name])
    refuse_if_too_large(folder, grid.shape, max_bytes)
    columns, rows, count = grid.shape
    values = np.empty((count, rows, columns), dtype=np.float32)
    for k, one in enumerate(ordered):
        values[k] = _pixels(one)
    return grid, values.transpose(2, 1, 0)


def _slices(folder: Path) -> list[_Slice]:
    found, skipped = [], 0
    for path in sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith(".")):
        one = _slice(path) if is_dicom(path) else None
        skipped += one is None
        if one is not None:
            found.append(one)
    if skipped and found:
        _log.info("%s: %d files that are no DICOM images left out", folder, skipped)
    return found


def _read(path: Path, tags: list[str], pixels: bool) -> Any:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they may quote the values of a header
            return pydicom.dcmread(path, stop_before_pixels=not pixels, specific_tags=tags)
    except Exception as error:
        # The cause is named by its kind only: its text may quote the header.
        raise ImageFileError(
            f"{path}: not a readable DICOM file ({type(error).__name__}): damaged or cut short. Export it again."
        ) from None


def _slice(path: Path) -> _Slice | None:
    header = _read(path, _TAGS, pixels=False)
    stored_as = header.get("SOPClassUID", header.file_meta.get("MediaStorageSOPClassUID"))
    described = stored_as is not None and "Rows" in header
    if stored_as is not None and not described and "Image Storage" not in pydicom.uid.UID(stored_as).name:
        return None  # a report, a presentation state, the folder's index
    kinds = [str(k) for k in _several(header.get("ImageType"))]
    if int(header.get("NumberOfFrames") or 1) > 1 or "MOSAIC" in kinds or "Enhanced" in _class_name(stored_as):
        raise ImageFileError(f"{path}: an enhanced (multi-frame) or mosaic DICOM file, which is not read. {_CONVERT}")
    missing = [name for name in _NEEDED if header.get(name) is None]
    if missing:
        raise ImageFileError(
            f"{path}: a DICOM image without {', '.join(missing)}: damaged, or not a slice with a place in space."
        )
    colour = str(header.get("PhotometricInterpretation", ""))
    if not colour.startswith("MONOCHROME") or int(header.get("SamplesPerPixel", 1)) != 1:
        raise ImageFileError(f"{path}: a DICOM image in colour ({colour}); grey values (MONOCHROME) are needed.")
    try:
        axes = np.array([float(v) for v in header.ImageOrientationPatient]).reshape(2, 3)
        position = np.array([float(v) for v in header.ImagePositionPatient])
        row_spacing, column_spacing = (float(v) for v in header.PixelSpacing)
        slope = float(1.0 if header.get("RescaleSlope") is None else header.RescaleSlope)
        intercept = float(header.get("RescaleIntercept") or 0.0)
        echo_time = None if header.get("EchoTime") is None else round(float(header.EchoTime), 2)
    except (TypeError, ValueError):
        raise ImageFileError(f"{path}: the DICOM header holds values that are not numbers; damaged.") from None
    if abs(axes[0] @ axes[1]) > _SAME_DIRECTION or np.abs(np.linalg.norm(axes, axis=1) - 1).max() > _SAME_DIRECTION:
        raise ImageFileError(f"{path}: its rows and columns are not perpendicular unit vectors; the header is damaged.")
    size = (int(header.Columns), int(header.Rows), round(column_spacing, 4), round(row_spacing, 4))
    echo = tuple(str(e) for e in _several(header.get("EchoNumbers")))
    kind = (str(header.SeriesInstanceUID), echo_time, echo, "/".join(kinds[2:]), *size)
    return _Slice(path, position, axes, (column_spacing, row_spacing), kind, slope, intercept)


def _several(value: Any) -> list[Any]:
    if value is None:
        return []
    return [value] if isinstance(value, str | int | float) else list(value)


def _class_name(uid: Any) -> str:
    return pydicom.uid.UID(uid).name if uid is not None else ""


def _stacks(slices: list[_Slice]) -> list[list[_Slice]]:
    """Slices of the same kind and orientation together."""
    stacks: list[list[_Slice]] = []
    for one in slices:
        for stack in stacks:
            if stack[0].kind == one.kind and np.abs(stack[0].axes - one.axes).max() < _SAME_DIRECTION:
                stack.append(one)
                break
        else:
            stacks.append([one])
    return stacks


def _named_stacks(stacks: list[list[_Slice]]) -> dict[str, list[_Slice]]:
    """Name stacks by the shortest end of their series UID that tells them apart, numbered within a series."""
    uids = sorted({stack[0].kind[0] for stack in stacks})
    digits = 6
    while len({uid[-digits:] for uid in uids}) < len(uids):
        digits += 1
    named = {}
    for uid in uids:
        # By echo and position, so that numbers do not depend on the files' names.
        own = sorted(
            (s for s in stacks if s[0].kind[0] == uid),
            key=lambda s: (str(s[0].kind[1:]), s[0].axes.round(2).tolist()),
        )
        for number, stack in enumerate(own, start=1):
            named[uid[-digits:] + (f"/{number}" if len(own) > 1 else "")] = stack
    return named


def _picked(folder: Path, stacks: dict[str, list[_Slice]], series: str | None) -> str:
    wanted, _, number = (series or "").strip().rpartition("/") if "/" in (series or "") else (series or "", "", "")
    matching = [
        name
        for name, stack in stacks.items()
        if stack[0].kind[0].endswith(wanted) and (not number or name.endswith(f"/{number}"))
    ]
    if len(matching) == 1:
        return matching[0]
    listing = "\n".join(f"  {name}: {_described(stack)}" for name, stack in stacks.items())
    if series is None:
        uids = {stack[0].kind[0] for stack in stacks.values()}
        what = f"{len(uids)} DICOM series" if len(uids) > 1 else "several echoes, image types or orientations"
        problem = f"the folder holds {what}; one is needed"
    else:
        problem = f"series='{series}' fits {len(matching)} of the DICOM series in this folder"
    raise InputError(
        f"{folder}: {problem}. Move the files of one into a folder of its own, or write it to a file: in Python, "
        f'dvc.write_image("one.nii.gz", dvc.read_image("{folder}", series=NAME)) with a NAME out of this list:\n'
        f"{listing}"
    )


def _described(stack: list[_Slice]) -> str:
    _, echo_time, echo, image_type, columns, rows, _, _ = stack[0].kind
    normal = np.cross(*stack[0].axes)
    parts = [f"{len(stack)} slices of {columns} x {rows}"]
    parts += [f"echo time {echo_time:g} ms"] if echo_time is not None else []
    parts += [f"echo {'/'.join(echo)}"] if echo else []
    parts += [f"image type {image_type}"] if image_type else []
    parts += ["stacked along ({})".format(", ".join(f"{v:.2f}" for v in normal + 0.0))]
    return ", ".join(parts)


def _assembled(folder: Path, stack: list[_Slice]) -> tuple[Grid, list[_Slice]]:
    """Find the grid of a stack of parallel slices; return it and the slices in its order."""
    x = stack[0].axes[0] / np.linalg.norm(stack[0].axes[0])
    normal = np.cross(x, stack[0].axes[1])
    normal /= np.linalg.norm(normal)
    ordered = sorted(stack, key=lambda s: float(s.position_mm @ normal))
    positions = np.array([s.position_mm for s in ordered])
    along = positions @ normal
    if len(ordered) < 2:
        raise ImageFileError(f"{folder}: a single slice ({ordered[0].path.name}); a volume is needed.")
    steps = np.diff(along)
    twice = np.flatnonzero(steps < _SAME_PLACE_MM)
    if len(twice):
        pairs = "; ".join(f"{ordered[t].path.name} and {ordered[t + 1].path.name}" for t in twice[:3])
        raise ImageFileError(
            f"{folder}: {len(twice)} slices lie where another one does ({pairs}). Two acquisitions or "
            "copies are mixed: keep one of each."
        )
    usual = float(np.median(steps))
    gaps = np.flatnonzero(steps > 1.5 * usual)
    if len(gaps):
        first = gaps[0]
        raise ImageFileError(
            f"{folder}: slices are missing: {len(gaps)} gaps in a stack with a slice every {usual:.4g} mm; "
            f"the first, of {steps[first]:.4g} mm, between {ordered[first].path.name} and "
            f"{ordered[first + 1].path.name}. Export the whole series."
        )
    spacing = float(along[-1] - along[0]) / (len(ordered) - 1)
    uneven = float(np.abs(along - along[0] - spacing * np.arange(len(ordered))).max())
    aside = float(np.linalg.norm(positions - positions[0] - np.outer(along - along[0], normal), axis=1).max())
    column_spacing, row_spacing = stack[0].spacing_mm
    if uneven > _OFF_PLACE * spacing or aside > _OFF_PLACE * min(column_spacing, row_spacing):
        raise ImageFileError(
            f"{folder}: the slices are not evenly stacked: up to {uneven:.3g} mm off an even spacing of "
            f"{spacing:.4g} mm, and up to {aside:.3g} mm sideways (tilted gantry). Resample the series to a "
            "regular grid first."
        )
    columns, rows = stack[0].kind[4:6]
    direction = np.stack([x, np.cross(normal, x), normal], axis=1)
    sizes = np.array([column_spacing, row_spacing, spacing])
    return Grid((columns, rows, len(ordered)), sizes, positions[0], direction), ordered


def _pixels(one: _Slice) -> Float32Array:
    """Values (rows, columns) of a slice, rescaled."""
    header = _read(one.path, [*_TAGS, "PixelData"], pixels=True)
    data = header.get("PixelData")
    columns, rows = one.kind[4:6]
    if data is None:
        raise ImageFileError(f"{one.path}: a DICOM file without pixels: damaged or cut short. Export it again.")
    syntax = header.file_meta.get("TransferSyntaxUID")
    try:
        if syntax is not None and syntax.is_encapsulated and syntax != pydicom.uid.RLELossless:
            return _decoded_by_itk(one.path, (rows, columns))
        needed = columns * rows * int(header.BitsAllocated) // 8
        if len(data) < needed and (syntax is None or not syntax.is_encapsulated):
            raise ImageFileError(
                f"{one.path}: the file is cut short: {columns} x {rows} voxels need {needed} bytes, it holds "
                f"{len(data)}. Copy or export it again."
            )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            values = header.pixel_array.astype(np.float32)
    except ImageFileError:
        raise
    except Exception as error:
        raise ImageFileError(
            f"{one.path}: its pixels cannot be decoded ({type(error).__name__}): damaged or cut short, or an "
            f"unusual compression. {_CONVERT}"
        ) from None
    values *= np.float32(one.slope)
    values += np.float32(one.intercept)
    return np.asarray(values)


def _decoded_by_itk(path: Path, shape: tuple[int, int]) -> Float32Array:
    """Decode JPEG, JPEG-LS or JPEG 2000, for which the other reader needs plugins; it rescales as well."""
    import SimpleITK as sitk  # only compressed files need it

    values = sitk.GetArrayFromImage(sitk.ReadImage(str(path), sitk.sitkFloat32))
    if values.shape != (1, *shape):
        raise ImageFileError(f"{path}: the pixels are {values.shape[1:]}, the header says {shape}; damaged.")
    return np.asarray(values[0], dtype=np.float32)
