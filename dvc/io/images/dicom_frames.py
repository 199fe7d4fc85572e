"""One frame of a DICOM image: its place, what it shows and how its values are scaled, from a file of one or of many.

Only what is needed of each header is read: no name, number or date of a patient; no message quotes a damaged header.
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
_NEEDED = ("SeriesInstanceUID", "Rows", "Columns", "BitsAllocated")
_PLACE = ("PixelSpacing", "ImagePositionPatient", "ImageOrientationPatient")
_TAGS = [
    *_NEEDED, *_PLACE, "SOPClassUID", "ImageType", "ComplexImageComponent", "EchoTime", "EchoNumbers", "NumberOfFrames",
    "SamplesPerPixel", "PhotometricInterpretation", "RescaleSlope", "RescaleIntercept", "ConcatenationUID",
    "InConcatenationTotalNumber", "DimensionIndexSequence", "SharedFunctionalGroupsSequence",
    "PerFrameFunctionalGroupsSequence",
]  # fmt: skip


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
"""What else distinguishes frames at the same place: stack, time point, index along other dimensions."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One slice of a DICOM image, in LPS."""

    path: Path
    number: int | None  # from 1, in its file; None in a file of one slice
    position_mm: FloatArray  # (3,) centre of the first voxel
    axes: FloatArray  # (2, 3) directions of increasing column and row
    spacing_mm: tuple[float, float]  # between columns, between rows
    kind: Kind
    slope: float  # value = slope * stored + intercept
    intercept: float
    labels: Labels = ()

    @property
    def name(self) -> str:
        """The file's name, and the frame's number in a file of many."""
        return self.path.name if self.number is None else f"{self.path.name} (frame {self.number})"


@contextmanager
def damage_named(path: Path, problem: str = "not a readable DICOM file", remedy: str = "") -> Iterator[None]:
    """Turn whatever fails on a damaged file into an error that names the file, and the cause by its kind only.

    Elements of a header are decoded when they are first accessed, so any access may fail. The text of a failure may
    quote the header, so only its kind is given.
    """
    logger = logging.getLogger("pydicom")
    before = logger.disabled
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings and the log may quote the values of a header
            logger.disabled = True
            yield
    except ImageFileError:
        raise
    except Exception as error:
        advice = remedy or "damaged or cut short. Export it again."
        raise ImageFileError(f"{path}: {problem} ({type(error).__name__}): {advice}") from None
    finally:
        logger.disabled = before


def read_image_header(path: Path) -> Any | None:
    """The needed part of the header of a grey-value DICOM image; None for other DICOM objects, such as reports."""
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
    number: int | None,
    place: dict[str, Any],
    scaling: tuple[Any, Any],
    shows: tuple[Any, Any, str],
    labels: Labels = (),
) -> Frame:
    """Build a frame from elements of its header; refused if they are not finite, perpendicular or positive.

    `place` holds ImagePositionPatient, ImageOrientationPatient and PixelSpacing; `scaling` slope and intercept, None
    where missing; `shows` echo time (ms), numbers of echoes and image type.
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
    echo_ms = None if echo_time is None else round(float(echo_time), 2)
    echo = tuple(str(int(e)) for e in several(echoes))
    spacing = round(column_spacing, 4), round(row_spacing, 4)
    kind = Kind(str(header.SeriesInstanceUID), echo_ms, echo, image_type, columns, rows, *spacing)
    return Frame(path, number, position, axes, (column_spacing, row_spacing), kind, slope, intercept, labels)


def classic_frame(path: Path, header: Any) -> Frame:
    """Return the frame of a file that holds one slice."""
    place = {name: header.get(name) for name in _PLACE}
    scaling = header.get("RescaleSlope"), header.get("RescaleIntercept")
    image_type = "/".join(str(k) for k in several(header.get("ImageType"))[2:])
    return build_frame(
        path, header, None, place, scaling, (header.get("EchoTime"), header.get("EchoNumbers"), image_type)
    )
