"""The frames of a DICOM file: their places, what they show, and their values.

Only what is needed of a header is read: no name, number or date of a patient; no message quotes a damaged header. What
the standard puts into the functional groups of enhanced (multi-frame) files is read only from there, each frame's own
first, then the shared ones: scanners repeat some of it, with other values, in private elements beside them.

References
----------
.. [1] DICOM PS3.3, Image Plane Module (C.7.6.2), Multi-frame Functional Groups Module (C.7.6.16) and Multi-frame
   Dimension Module (C.7.6.17): https://dicom.nema.org/medical/dicom/current/output/html/part03.html
"""

import logging
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pydicom
from pydicom.datadict import keyword_for_tag
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate, generate_frames
from pydicom.pixels.utils import iter_pixels

from dvc.arrays import Float32Array, FloatArray
from dvc.errors import ImageFileError
from dvc.io.images.stored import Voxels

CONVERT = "Convert it to NIfTI, for example with dcm2niix, and pass the .nii.gz file."
_SAME_DIRECTION = 1e-3
_NEEDED = ("SeriesInstanceUID", "Rows", "Columns", "BitsAllocated")
_PLACE = ("PixelSpacing", "ImagePositionPatient", "ImageOrientationPatient")
_TAGS = [
    *_NEEDED, *_PLACE, "SOPClassUID", "ImageType", "ComplexImageComponent", "EchoTime", "EchoNumbers", "NumberOfFrames",
    "SamplesPerPixel", "PhotometricInterpretation", "RescaleSlope", "RescaleIntercept", "ConcatenationUID",
    "InConcatenationTotalNumber", "DimensionIndexSequence", "SharedFunctionalGroupsSequence",
    "PerFrameFunctionalGroupsSequence",
]  # fmt: skip
STACK, TIME_POINT = "stack", "time point"

_ENHANCED = [f"{origin}Enhanced{of}ImageStorage" for origin in ("", "LegacyConverted") for of in ("MR", "CT")]
_SCALING = {"RescaleSlope": 1.0, "RescaleIntercept": 0.0}  # and what a missing one stands for
_GROUP_OF = {
    "ImagePositionPatient": "PlanePositionSequence", "ImageOrientationPatient": "PlaneOrientationSequence",
    "PixelSpacing": "PixelMeasuresSequence",
} | dict.fromkeys(_SCALING, "PixelValueTransformationSequence")  # fmt: skip
_FRAME_TYPES = ("MRImageFrameTypeSequence", "CTImageFrameTypeSequence")
_CONVERTED = ("UnassignedPerFrameConvertedAttributesSequence", "UnassignedSharedConvertedAttributesSequence")
_OF_PIXELS = [  # of one frame
    "Rows", "Columns", "SamplesPerPixel", "PhotometricInterpretation", "BitsAllocated", "BitsStored", "HighBit",
    "PixelRepresentation",
]  # fmt: skip
_OF_ALL = ["NumberOfFrames", "PlanarConfiguration", "ExtendedOffsetTable", "ExtendedOffsetTableLengths", "PixelData"]


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
    """Turn whatever fails on a damaged file, at any access, into an error that names the file and the kind of failure.

    Its text is left out, because it may quote the header.
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
        advice = remedy or "the file is damaged or incomplete. Export it again."
        raise ImageFileError(f"{path}: {problem} ({type(error).__name__}): {advice}") from None
    finally:
        logger.disabled = before


def read_frames(path: Path) -> tuple[list[Frame], tuple[str, int] | None]:
    """Frames of a file, none if it is no image (a report); UID and number of files of the image that it belongs to."""
    with damage_named(path):
        header = pydicom.dcmread(path, stop_before_pixels=True, specific_tags=list(_TAGS))
        kind = header.get("SOPClassUID") or header.file_meta.get("MediaStorageSOPClassUID") or ""
        stored = pydicom.uid.UID(str(kind))
        if "Rows" not in header:
            # Every object of a series names it; a file that does not, was cut before.
            whole = bool(stored) and "SeriesInstanceUID" in header
            if stored == pydicom.uid.MediaStorageDirectoryStorage or (whole and "Image Storage" not in stored.name):
                return [], None
        enhanced = "PerFrameFunctionalGroupsSequence" in header or "Enhanced" in stored.name
        kinds = [str(k) for k in _several(header.get("ImageType"))]
        if not enhanced and ("MOSAIC" in kinds or int(header.get("NumberOfFrames") or 1) > 1):
            problem = "this is a mosaic or a multi-frame DICOM file without frame positions, which is not supported"
            raise ImageFileError(f"{path}: {problem}. {CONVERT}")
        needed = _NEEDED if enhanced else (*_NEEDED, *_PLACE)
        _refuse_missing(path, [name for name in needed if header.get(name) is None])
        colour = str(header.get("PhotometricInterpretation", ""))
        if not colour.startswith("MONOCHROME") or int(header.get("SamplesPerPixel", 1)) != 1:
            raise ImageFileError(f"{path}: the DICOM image is in colour; grey values (MONOCHROME) are needed.")
        if enhanced and stored.keyword not in _ENHANCED:
            problem = "of multi-frame DICOM files, only enhanced MR and CT images are supported"
            raise ImageFileError(f"{path}: {problem}. {CONVERT}")
        uid, total = header.get("ConcatenationUID"), header.get("InConcatenationTotalNumber")
        frames = _enhanced_frames(path, header) if enhanced else [_classic_frame(path, header)]
        return frames, (str(uid), int(total)) if uid and total else None


def _refuse_missing(path: Path, missing: Sequence[str], where: str = "") -> None:
    if missing:
        problem = f"the DICOM header lacks {', '.join(missing)}{where}"
        raise ImageFileError(
            f"{path}: {problem}; it is damaged, or the image has no position in space. Export it again."
        )


def _several(value: Any) -> list[Any]:
    """The values of an element that may hold none, one or several."""
    if value is None:
        return []
    return [value] if isinstance(value, str | int | float) else list(value)


def _build_frame(path: Path, header: Any, number: int | None, own: dict[str, Any], labels: Labels = ()) -> Frame:
    """Build a frame of its ``own`` elements; refused if they are not finite, perpendicular or positive.

    ``own`` holds place (ImagePositionPatient, ImageOrientationPatient, PixelSpacing) and scaling, echo time (ms) and
    numbers of echoes, which are None where missing, and the parts of the image type that are shown.
    """
    axes = np.array([float(v) for v in own["ImageOrientationPatient"]]).reshape(2, 3)
    position = np.array([float(v) for v in own["ImagePositionPatient"]]).reshape(3)
    row_spacing, column_spacing = (float(v) for v in own["PixelSpacing"])
    slope, intercept = (float(usual if own[name] is None else own[name]) for name, usual in _SCALING.items())
    which = "" if number is None else f", frame {number}"
    if not np.isfinite([*axes.ravel(), *position, row_spacing, column_spacing, slope, intercept]).all():
        raise ImageFileError(
            f"{path}{which}: the DICOM header is damaged (values that are not finite). Export it again."
        )
    if abs(axes[0] @ axes[1]) > _SAME_DIRECTION or np.abs(np.linalg.norm(axes, axis=1) - 1).max() > _SAME_DIRECTION:
        damage = "row and column directions not perpendicular"
        raise ImageFileError(f"{path}{which}: the header is damaged ({damage}). Export it again.")
    columns, rows = int(header.Columns), int(header.Rows)
    if min(row_spacing, column_spacing) <= 0 or min(columns, rows) < 1:
        voxels = f"{columns} x {rows} voxels of {column_spacing:g} x {row_spacing:g} mm"
        raise ImageFileError(f"{path}{which}: {voxels}; all must be positive. The header is damaged. Export it again.")
    echo_ms = None if own["EchoTime"] is None else round(float(own["EchoTime"]), 2)
    echo = tuple(str(int(e)) for e in _several(own["EchoNumbers"]))
    image_type = "/".join(map(str, own["ImageType"]))
    spacing = round(column_spacing, 4), round(row_spacing, 4)
    kind = Kind(str(header.SeriesInstanceUID), echo_ms, echo, image_type, columns, rows, *spacing)
    return Frame(path, number, position, axes, (column_spacing, row_spacing), kind, slope, intercept, labels)


def _classic_frame(path: Path, header: Any) -> Frame:
    own = {name: header.get(name) for name in (*_PLACE, *_SCALING, "EchoTime", "EchoNumbers")}
    return _build_frame(path, header, None, own | {"ImageType": _several(header.get("ImageType"))[2:]})


def _enhanced_frames(path: Path, header: Any) -> list[Frame]:
    """Frames of an enhanced MR or CT image, in the order of the file; refused if one is not described."""
    each = list(header.get("PerFrameFunctionalGroupsSequence") or [])
    count = int(header.get("NumberOfFrames") or 0)
    if count < 1 or len(each) != count:
        raise ImageFileError(
            f"{path}: the header claims {count} frames, but describes {len(each)} (functional groups). The file is "
            "damaged, incomplete, or was stripped by an anonymizer. Export it again."
        )
    shared = (list(header.get("SharedFunctionalGroupsSequence") or []) or [{}])[0]
    indices = header.get("DimensionIndexSequence") or []
    dimensions = [keyword_for_tag(index.get("DimensionIndexPointer") or 0) for index in indices]
    scaled = any(_group(_GROUP_OF["RescaleSlope"], groups, shared) is not None for groups in each)
    frames = []
    for number, groups in enumerate(each, start=1):
        own = {name: (_group(group, groups, shared) or {}).get(name) for name, group in _GROUP_OF.items()}
        missing = [name for name, value in own.items() if value is None and (scaled or name in _PLACE)]
        _refuse_missing(path, missing, f" in the functional groups of frame {number}")
        labels = _labels(_group("FrameContentSequence", groups, shared), dimensions)
        frames.append(_build_frame(path, header, number, own | _shown(header, groups, shared), labels))
    return frames


def _group(name: str, *groups: Any) -> Any | None:
    """Return the first item of a functional group: the frame's own, else the shared one."""
    return next((items[0] for holder in groups if (items := holder.get(name))), None)


def _shown(header: Any, *groups: Any) -> dict[str, Any]:
    """Echo time (ms), numbers of echoes and image type of a frame."""
    converted = [_group(name, *groups) or {} for name in _CONVERTED]
    echo_times = [(_group("MREchoSequence", *groups) or {}).get("EffectiveEchoTime")]
    echo_times += [c.get("EchoTime") for c in converted]
    frame_type: Any = next((t for name in _FRAME_TYPES if (t := _group(name, *groups)) is not None), {})
    image_type = _several(frame_type.get("FrameType")) or _several(header.get("ImageType"))
    component = frame_type.get("ComplexImageComponent") or header.get("ComplexImageComponent")
    return {
        "EchoTime": next((t for t in echo_times if t is not None), None),
        "EchoNumbers": next((e for c in converted if (e := c.get("EchoNumbers")) is not None), None),
        "ImageType": [*image_type[2:], *_several(component)],
    }


def _labels(content: Any | None, dimensions: list[str]) -> Labels:
    if content is None:
        return ()
    labels: list[tuple[str, str | int]] = [(STACK, str(content.StackID))] if content.get("StackID") else []
    if content.get("TemporalPositionIndex"):
        labels.append((TIME_POINT, int(content.TemporalPositionIndex)))
    for k, index in enumerate(_several(content.get("DimensionIndexValues"))):
        # Some scanners list the dimensions in another order than the indices: the name is a hint, no more.
        name = dimensions[k] if k < len(dimensions) else ""
        labels.append((f"dimension {k + 1}" + (f" ({name})" if name else ""), int(index)))
    return tuple(labels)


def read_values(frames: Sequence[Frame]) -> Float32Array:
    """Rescaled values (frames, rows, columns) of frames of one size, in the order given."""
    kind = frames[0].kind
    values = np.empty((len(frames), kind.rows, kind.columns), dtype=np.float32)
    places: dict[Path, list[int]] = {}
    for k, frame in enumerate(frames):
        places.setdefault(frame.path, []).append(k)
    for path, own in places.items():
        numbers = [(frames[k].number or 1) - 1 for k in own]
        for k, stored in zip(own, _stored(path, numbers, (kind.rows, kind.columns)), strict=True):
            if stored.shape != values[k].shape:
                raise ImageFileError(
                    f"{path}: the file has {' x '.join(map(str, stored.shape))} values where its header describes "
                    f"{kind.rows} x {kind.columns}; it is damaged. Copy or export it again."
                )
            values[k] = stored
            values[k] *= np.float32(frames[k].slope)
            values[k] += np.float32(frames[k].intercept)
    return values


def _stored(path: Path, numbers: list[int], shape: tuple[int, int]) -> Iterator[Voxels]:
    """Stored values (rows, columns) of some frames of a file, numbered from 0, in the order given."""
    with damage_named(path):
        header = pydicom.dcmread(path, specific_tags=[*_OF_PIXELS, *_OF_ALL])
        data = header.get("PixelData")
    if data is None:
        raise ImageFileError(f"{path}: the DICOM file has no pixels; it is damaged or incomplete. Export it again.")
    unusual = f"the file is damaged or incomplete, or its compression is not supported. {CONVERT}"
    with damage_named(path, "the pixels cannot be decoded", unusual):
        syntax = header.file_meta.get("TransferSyntaxUID")
        packed = syntax is not None and syntax.is_encapsulated
        count = int(header.get("NumberOfFrames") or 1)
        needed = count * shape[0] * shape[1] * int(header.BitsAllocated) // 8
        if not packed and len(data) < needed:
            frames = f"{count} frames of " if count > 1 else ""
            raise ImageFileError(
                f"{path}: the file is incomplete: {frames}{shape[1]} x {shape[0]} voxels need {needed} bytes, but it "
                f"has {len(data)}. Copy or export it again."
            )
        if packed and syntax != pydicom.uid.RLELossless:
            yield from _decoded_by_itk(path, header, numbers, count)
        elif count == 1:
            yield header.pixel_array
        else:
            yield from iter_pixels(header, indices=numbers, raw=True)


def _decoded_by_itk(path: Path, header: Any, numbers: list[int], count: int) -> Iterator[Voxels]:
    """Decode JPEG, JPEG-LS or JPEG 2000, for which the other reader needs plugins.

    ITK gets each frame as a bare file of its own: of one with many frames it would scale all by the first one's slope.
    """
    import SimpleITK as sitk  # only compressed files need it

    tables = header.get("ExtendedOffsetTable"), header.get("ExtendedOffsetTableLengths")
    offsets = (tables[0], tables[1]) if tables[0] and tables[1] else None
    packed = list(generate_frames(header.PixelData, number_of_frames=count, extended_offsets=offsets))
    if len(packed) != count:
        claim = f"the header claims {count} frames, but the file has {len(packed)}"
        raise ImageFileError(f"{path}: {claim}; it is damaged or incomplete. Copy or export it again.")
    bare = Dataset()
    for name in _OF_PIXELS:
        if name in header:
            setattr(bare, name, header.get(name))
    bare.SOPClassUID = pydicom.uid.MRImageStorage
    bare.SOPInstanceUID = "2.25.1"
    bare.PhotometricInterpretation = "MONOCHROME2"  # the other one would be inverted
    bare.file_meta = FileMetaDataset()
    bare.file_meta.TransferSyntaxUID = header.file_meta.TransferSyntaxUID
    with tempfile.TemporaryDirectory() as folder:
        one = Path(folder) / "frame.dcm"
        for number in numbers:
            bare.PixelData = encapsulate([packed[number]])
            pydicom.dcmwrite(one, bare, enforce_file_format=True)
            values = sitk.GetArrayFromImage(sitk.ReadImage(str(one)))
            if values.shape != (1, int(header.Rows), int(header.Columns)):
                damage = "pixels and header differ in image size"
                raise ImageFileError(f"{path}: the file is damaged ({damage}). Export it again.")
            yield values[0]
