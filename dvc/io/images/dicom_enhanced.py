"""Frames of enhanced (multi-frame) DICOM files, from their functional groups: each frame's own, then the shared ones.

What the standard puts into functional groups is read only from there: scanners repeat some of it, with other values, in
private elements beside them.

References: DICOM PS3.3, Multi-frame Functional Groups Module (C.7.6.16) and Multi-frame Dimension Module (C.7.6.17),
https://dicom.nema.org/medical/dicom/current/output/html/part03.html
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydicom.datadict import keyword_for_tag
from pydicom.uid import (
    EnhancedCTImageStorage,
    EnhancedMRImageStorage,
    LegacyConvertedEnhancedCTImageStorage,
    LegacyConvertedEnhancedMRImageStorage,
)

from dvc.errors import ImageFileError
from dvc.io.images.dicom_frames import CONVERT, Frame, Labels, build_frame, class_of, refuse_missing, several

STACK, TIME_POINT = "stack", "time point"

_READ = (
    EnhancedMRImageStorage,
    LegacyConvertedEnhancedMRImageStorage,
    EnhancedCTImageStorage,
    LegacyConvertedEnhancedCTImageStorage,
)
_PLACE = (
    ("PlanePositionSequence", "ImagePositionPatient"),
    ("PlaneOrientationSequence", "ImageOrientationPatient"),
    ("PixelMeasuresSequence", "PixelSpacing"),
)
_SCALING = "PixelValueTransformationSequence"
_FRAME_TYPES = ("MRImageFrameTypeSequence", "CTImageFrameTypeSequence")
_CONVERTED = ("UnassignedPerFrameConvertedAttributesSequence", "UnassignedSharedConvertedAttributesSequence")


def is_enhanced(header: Any) -> bool:
    """Whether a header describes its frames in functional groups, or should."""
    return "PerFrameFunctionalGroupsSequence" in header or "Enhanced" in class_of(header).name


def enhanced_frames(path: Path, header: Any) -> list[Frame]:
    """Frames of an enhanced MR or CT image, in the order of the file.

    Refused if a frame is not described, or lacks its position, orientation, spacing or, where others have it, its
    scaling.
    """
    if class_of(header) not in _READ:
        raise ImageFileError(
            f"{path}: a multi-frame DICOM file of a kind that is not read; enhanced MR and CT images are. {CONVERT}"
        )
    own = list(header.get("PerFrameFunctionalGroupsSequence") or [])
    count = int(header.get("NumberOfFrames") or 0)
    if count < 1 or len(own) != count:
        raise ImageFileError(
            f"{path}: the header claims {count} frames and describes {len(own)} (functional groups): damaged, cut "
            "short, or stripped by an anonymizer. Export it again."
        )
    shared = (list(header.get("SharedFunctionalGroupsSequence") or []) or [{}])[0]
    dimensions = [
        keyword_for_tag(d.get("DimensionIndexPointer") or 0) for d in header.get("DimensionIndexSequence") or []
    ]
    scaled = any(_group(_SCALING, groups, shared) is not None for groups in own)
    return [_frame(path, header, number, (groups, shared), dimensions, scaled) for number, groups in enumerate(own, 1)]


def _group(name: str, *groups: Any) -> Any | None:
    """Return the first item of a functional group: the frame's own, else the shared one."""
    for holder in groups:
        items = holder.get(name)
        if items:
            return items[0]
    return None


def _frame(path: Path, header: Any, number: int, groups: tuple[Any, Any], dimensions: list[str], scaled: bool) -> Frame:
    place = {name: (_group(macro, *groups) or {}).get(name) for macro, name in _PLACE}
    scaling = _group(_SCALING, *groups) or {}
    slope, intercept = scaling.get("RescaleSlope"), scaling.get("RescaleIntercept")
    missing = [name for name, value in place.items() if value is None]
    if scaled:
        missing += [name for name, v in (("RescaleSlope", slope), ("RescaleIntercept", intercept)) if v is None]
    refuse_missing(path, missing, f" in the functional groups of frame {number}")
    labels = _labels(_group("FrameContentSequence", *groups), dimensions)
    return build_frame(path, header, number, place, (slope, intercept), _shown(header, groups), labels)


def _shown(header: Any, groups: tuple[Any, Any]) -> tuple[Any, Any, str]:
    """Echo time (ms), numbers of echoes and image type of a frame."""
    converted = [_group(name, *groups) or {} for name in _CONVERTED]
    echo_time = (_group("MREchoSequence", *groups) or {}).get("EffectiveEchoTime")
    if echo_time is None:
        echo_time = next((c.get("EchoTime") for c in converted if c.get("EchoTime") is not None), None)
    echoes = next((c.get("EchoNumbers") for c in converted if c.get("EchoNumbers") is not None), None)
    frame_type: Any = next((t for name in _FRAME_TYPES if (t := _group(name, *groups)) is not None), {})
    image_type = several(frame_type.get("FrameType")) or several(header.get("ImageType"))
    component = frame_type.get("ComplexImageComponent") or header.get("ComplexImageComponent")
    return echo_time, echoes, "/".join(str(k) for k in (*image_type[2:], *several(component)))


def _labels(content: Any | None, dimensions: list[str]) -> Labels:
    if content is None:
        return ()
    labels: list[tuple[str, str | int]] = []
    if content.get("StackID"):
        labels.append((STACK, str(content.StackID)))
    if content.get("TemporalPositionIndex"):
        labels.append((TIME_POINT, int(content.TemporalPositionIndex)))
    for k, index in enumerate(several(content.get("DimensionIndexValues"))):
        # Some scanners list the dimensions in another order than the indices: the name is a hint, no more.
        name = dimensions[k] if k < len(dimensions) else ""
        labels.append((f"dimension {k + 1}" + (f" ({name})" if name else ""), int(index)))
    return tuple(labels)
