"""Enhanced (multi-frame) DICOM files, and the classic series of the same slices, for tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.tag import Tag
from pydicom.uid import (
    EnhancedMRImageStorage,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    MRImageStorage,
    RLELossless,
)
from scipy.spatial.transform import Rotation

from dvc.errors import ImageFileError, MrstrainError
from dvc.io.images.read import read_image

SERIES = "1.2.826.0.1.3680043.8.498.111111"
SHAPE = (5, 6, 8)  # columns, rows, slices
SPACING = (0.8, 1.25, 4.0)
TURN = Rotation.from_euler("xyz", [20.0, -35.0, 10.0], degrees=True).as_matrix()
ORIGIN = np.array([-30.0, 12.0, 250.0])
STORED = np.random.default_rng(2).integers(0, 4000, SHAPE).astype(np.int16)
SHUFFLED = [3, 0, 7, 5, 1, 6, 2, 4]
AXIAL = ["1", "0", "0", "0", "1", "0"]


def item(**elements: Any) -> Dataset:
    made = Dataset()
    for name, value in elements.items():
        setattr(made, name, value)
    return made


def place_of(k: float) -> dict[str, list[str]]:
    """Position of slice k, to be written in either kind of file."""
    return {"ImagePositionPatient": [f"{v:.6f}" for v in ORIGIN + TURN[:, 2] * SPACING[2] * k]}


ORIENTATION = {"ImageOrientationPatient": [f"{v:.8f}" for v in (*TURN[:, 0], *TURN[:, 1])]}
MEASURES = {"PixelSpacing": [str(SPACING[1]), str(SPACING[0])], "SliceThickness": "3.0"}


def groups(
    k: int,
    *,
    at: float | None = None,
    scaling: tuple[str, str] | None = ("1", "0"),
    echo: float | None = None,
    shows: Sequence[str] = ("ORIGINAL", "PRIMARY", "M", "NONE"),
    component: str = "MAGNITUDE",
    indices: Sequence[int] | None = None,
    stack: str = "1",
    time: int = 1,
    **macros: Dataset | None,
) -> Dataset:
    """Functional groups of a frame that shows slice k; ``at`` puts it elsewhere; None leaves a group out."""
    content = item(StackID=stack, InStackPositionNumber=100 - k, TemporalPositionIndex=time)
    content.DimensionIndexValues = list(indices or (1, k + 1, time))
    found = {
        "FrameContentSequence": content,
        "PlanePositionSequence": item(**place_of(k if at is None else at)),
        "MRImageFrameTypeSequence": item(FrameType=list(shows), ComplexImageComponent=component),
        "PixelValueTransformationSequence": scaling
        and item(RescaleIntercept=scaling[1], RescaleSlope=scaling[0], RescaleType="US"),
        "MREchoSequence": echo and item(EffectiveEchoTime=echo),
        **macros,
    }
    own = Dataset()
    for name, group in found.items():
        if group is not None:
            setattr(own, name, [group])
    own.slice_shown = k  # not an element: for the writer
    return own


FRAMES = tuple(groups(k) for k in SHUFFLED)


def write_enhanced(
    path: Path,
    frames: Sequence[Dataset] = FRAMES,
    *,
    shared: Dataset | None = None,
    change: Callable[[Any], None] | None = None,
    syntax: Any = ExplicitVRLittleEndian,
    offset: int = 0,
    **fields: Any,
) -> Path:
    """Write an enhanced MR file; ``offset`` is added to what it stores."""
    path.parent.mkdir(exist_ok=True)
    if shared is None:
        shared = Dataset()
        shared.PlaneOrientationSequence = [item(**ORIENTATION)]
        shared.PixelMeasuresSequence = [item(**MEASURES)]
        shared.MREchoSequence = [item(EffectiveEchoTime=6.3)]
    whole = Dataset()
    whole.file_meta = FileMetaDataset()
    whole.file_meta.TransferSyntaxUID = syntax if syntax != RLELossless else ExplicitVRLittleEndian
    dimensions = [Tag("StackID"), Tag("InStackPositionNumber"), Tag("TemporalPositionIndex")]
    values = {
        "SOPClassUID": EnhancedMRImageStorage,
        "SOPInstanceUID": "1.2.3.1",
        "SeriesInstanceUID": SERIES,
        "PatientName": "Doe^Jane",
        "PatientID": "ID-12345",
        "ImageType": ["ORIGINAL", "PRIMARY", "M", "NONE"],
        "Modality": "MR",
        "NumberOfFrames": len(frames),
        "Rows": SHAPE[1],
        "Columns": SHAPE[0],
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "BitsAllocated": 16,
        "BitsStored": 16,
        "HighBit": 15,
        "PixelRepresentation": 1,
        "DimensionIndexSequence": [item(DimensionIndexPointer=d) for d in dimensions],
        "SharedFunctionalGroupsSequence": [shared],
        "PerFrameFunctionalGroupsSequence": list(frames),
    } | fields
    for key, value in values.items():
        if value is not None:
            setattr(whole, key, value)
    big = syntax == ExplicitVRBigEndian
    stored = [STORED[:, :, g.slice_shown].T + offset for g in frames]
    whole.PixelData = np.array(stored, dtype=">i2" if big else "<i2").tobytes()
    whole["PixelData"].VR = "OW"
    if change is not None:
        change(whole)
    if syntax == RLELossless:
        whole.compress(RLELossless)
    settings = {"little_endian": False, "implicit_vr": False} if big else {}
    pydicom.dcmwrite(path, whole, enforce_file_format=True, **settings)
    return path


def write_classic(folder: Path, scaling: Sequence[tuple[str, str]]) -> Path:
    """Write the same slices as a classic series."""
    folder.mkdir()
    for k in range(SHAPE[2]):
        fields = place_of(k) | ORIENTATION | {"PixelSpacing": MEASURES["PixelSpacing"]}
        fields |= {"RescaleSlope": scaling[k][0], "RescaleIntercept": scaling[k][1], "EchoTime": "6.3"}
        path = write_enhanced(folder / f"{k}.dcm", [groups(k)], SOPClassUID=MRImageStorage, **fields)
        header = pydicom.dcmread(path)
        for name in ("NumberOfFrames", "Dimension", "SharedFunctionalGroups", "PerFrameFunctionalGroups"):
            for element in list(header):
                if element.keyword.startswith(name):
                    del header[element.tag]
        header.save_as(path)
    return folder


def refused(place: Path, message: str, kind: type[MrstrainError] = ImageFileError, **options: Any) -> str:
    """Return the message of the refusal, which names the file and no patient."""
    with pytest.raises(kind, match=message) as caught:
        read_image(place, **options)
    told = str(caught.value)
    assert str(place) in told
    assert "Doe" not in told
    assert "12345" not in told
    return told
