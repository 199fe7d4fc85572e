"""One frame of a DICOM image: its place, what it shows and how its values are scaled, from a file of one or of many.

Only what is needed of each header is looked at: no name, number or date of a patient is read, and no message quotes
what a damaged header holds.

References
----------
.. [1] DICOM PS3.3, Image Plane Module (C.7.6.2): https://dicom.nema.org/medical/dicom/current/output/html/part03.html
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pydicom

from dvc.arrays import FloatArray
from dvc.errors import ImageFileError

CONVERT = "Convert it to NIfTI, for example with dcm2niix, and give the .nii.gz file."
_SAME_DIRECTION = 1e-3
_TAGS = [
    "SOPClassUID",
    "SeriesInstanceUID",
    "ImageType",
    "ComplexImageComponent",
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
    "RescaleSlope",
    "RescaleIntercept",
    "ConcatenationUID",
    "InConcatenationTotalNumber",
    "DimensionIndexSequence",
    "SharedFunctionalGroupsSequence",
    "PerFrameFunctionalGroupsSequence",
]
_NEEDED = ("SeriesInstanceUID", "Rows", "Columns", "BitsAllocated")
_PLACE = ("PixelSpacing", "ImagePositionPatient", "ImageOrientationPatient")


class Kind(NamedTuple):
    """What the frames of one image have in common."""

    series: str
    echo_time_ms: float | None
    echo: tuple[str, ...]
    image_type: str
    columns: int
    rows: int
    column_spacing_mm: float  # rounded, as is the next
    row_spacing_mm: float


Labels = tuple[tuple[str, str | int], ...]
"""What else a file of many frames tells of one: its stack, its time point, its index along other dimensions."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One slice of a DICOM image.

    Parameters
    ----------
    path : file
    number : which frame of it, from 1; None in a file of one slice
    position_mm : (3,) centre of the first voxel, LPS
    axes : (2, 3) directions of increasing column and row, LPS
    spacing_mm : between columns, between rows
    kind : what it shares with other slices of the same image
    slope, intercept : value = slope * stored + intercept
    labels : what else may tell it from frames at the same place
    """

    path: Path
    number: int | None
    position_mm: FloatArray
    axes: FloatArray
    spacing_mm: tuple[float, float]
    kind: Kind
    slope: float
    intercept: float
    labels: Labels = ()

    @property
    def name(self) -> str:
        """The file's name, and the frame's number in a file of many."""
        return self.path.name if self.number is None else f"{self.path.name} (frame {self.number})"


@contextmanager
def _quiet(logger: logging.Logger) -> Iterator[None]:
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before


@contextmanager
def damage_named(path: Path, problem: str = "not a readable DICOM file", remedy: str = "") -> Iterator[None]:
    """Turn whatever fails on a damaged file into an error that names the file, and the cause by its kind only.

    Elements of a header are decoded when they are first looked at, so any access may fail.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they may quote the values of a header
            with _quiet(logging.getLogger("pydicom")):  # which says the same
                yield
    except ImageFileError:
        raise
    except Exception as error:
        # The cause is named by its kind only: its text may quote the header.
        advice = remedy or "damaged or cut short. Export it again."
        raise ImageFileError(f"{path}: {problem} ({type(error).__name__}): {advice}") from None


def read_image_header(path: Path) -> Any | None:
    """What is needed of the header of a DICOM image with grey values; None for other DICOM objects, such as reports.

    Raises
    ------
    ImageFileError
        If the file is damaged or cut short, in colour, or lacks what any image has.
    """
    header = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=list(_TAGS))
    stored_as = class_of(header)
    if "Rows" not in header and _is_no_image(header, stored_as):
        return None
    if "PerFrameFunctionalGroupsSequence" not in header and "Enhanced" not in stored_as.name:
        kinds = [str(k) for k in several(header.get("ImageType"))]
        if "MOSAIC" in kinds or int(header.get("NumberOfFrames") or 1) > 1:
            raise ImageFileError(
                f"{path}: a mosaic, or a multi-frame DICOM file that does not say where its frames lie; it is not "
                f"read. {CONVERT}"
            )
        refuse_missing(path, [name for name in (*_NEEDED, *_PLACE) if header.get(name) is None])
    refuse_missing(path, [name for name in _NEEDED if header.get(name) is None])
    colour = str(header.get("PhotometricInterpretation", ""))
    if not colour.startswith("MONOCHROME") or int(header.get("SamplesPerPixel", 1)) != 1:
        raise ImageFileError(f"{path}: a DICOM image in colour; grey values (MONOCHROME) are needed.")
    return header


def class_of(header: Any) -> pydicom.uid.UID:
    """The kind of DICOM object that a header belongs to."""
    return pydicom.uid.UID(str(header.get("SOPClassUID") or header.file_meta.get("MediaStorageSOPClassUID") or ""))


def _is_no_image(header: Any, stored_as: pydicom.uid.UID) -> bool:
    """Whether an object without rows is whole and no image: a report, a presentation state, the folder's index."""
    if stored_as == pydicom.uid.MediaStorageDirectoryStorage:
        return True
    # Every object of a series names it; a file that does not, was cut before.
    return bool(stored_as) and "SeriesInstanceUID" in header and "Image Storage" not in stored_as.name


def refuse_missing(path: Path, missing: Sequence[str], where: str = "") -> None:
    """Raise an error that names what an image lacks, if it lacks anything."""
    if missing:
        raise ImageFileError(
            f"{path}: a DICOM image without {', '.join(missing)}{where}: damaged, or not a slice with a place in "
            "space. Export it again."
        )


def several(value: Any) -> list[Any]:
    """Return the values of an element that may hold none, one or several."""
    if value is None:
        return []
    return [value] if isinstance(value, str | int | float) else list(value)


def build_frame(
    path: Path,
    header: Any,
    *,
    number: int | None,
    place: dict[str, Any],
    scaling: tuple[Any, Any],
    shows: tuple[Any, Any, str],
    labels: Labels = (),
) -> Frame:
    """Build a frame from elements of its header.

    Parameters
    ----------
    path, number, labels : as in `Frame`
    header : of the file
    place : ImagePositionPatient, ImageOrientationPatient and PixelSpacing
    scaling : slope, intercept; None where they are not told
    shows : echo time (ms), numbers of echoes, image type

    Raises
    ------
    ImageFileError
        If numbers are not finite, or rows and columns are not perpendicular unit vectors a positive distance apart.
    """
    axes = np.array([float(v) for v in place["ImageOrientationPatient"]]).reshape(2, 3)
    position = np.array([float(v) for v in place["ImagePositionPatient"]]).reshape(3)
    row_spacing, column_spacing = (float(v) for v in place["PixelSpacing"])
    slope = 1.0 if scaling[0] is None else float(scaling[0])
    intercept = 0.0 if scaling[1] is None else float(scaling[1])
    echo_time, echoes, image_type = shows
    which = "" if number is None else f", frame {number}"
    if not np.isfinite([*axes.ravel(), *position, row_spacing, column_spacing, slope, intercept]).all():
        raise ImageFileError(f"{path}{which}: the DICOM header holds values that are not finite numbers; damaged.")
    if abs(axes[0] @ axes[1]) > _SAME_DIRECTION or np.abs(np.linalg.norm(axes, axis=1) - 1).max() > _SAME_DIRECTION:
        raise ImageFileError(
            f"{path}{which}: its rows and columns are not perpendicular unit vectors; the header is damaged."
        )
    columns, rows = int(header.Columns), int(header.Rows)
    if min(row_spacing, column_spacing) <= 0 or min(columns, rows) < 1:
        raise ImageFileError(
            f"{path}{which}: {columns} x {rows} voxels of {column_spacing:g} x {row_spacing:g} mm; all must be "
            "positive. The header is damaged."
        )
    kind = Kind(
        str(header.SeriesInstanceUID),
        None if echo_time is None else round(float(echo_time), 2),
        tuple(str(int(e)) for e in several(echoes)),
        image_type,
        columns,
        rows,
        round(column_spacing, 4),
        round(row_spacing, 4),
    )
    return Frame(path, number, position, axes, (column_spacing, row_spacing), kind, slope, intercept, labels)


def classic_frame(path: Path, header: Any) -> Frame:
    """Return the frame of a file that holds one slice."""
    return build_frame(
        path,
        header,
        number=None,
        place={name: header.get(name) for name in _PLACE},
        scaling=(header.get("RescaleSlope"), header.get("RescaleIntercept")),
        shows=(
            header.get("EchoTime"),
            header.get("EchoNumbers"),
            "/".join(str(k) for k in several(header.get("ImageType"))[2:]),
        ),
    )
