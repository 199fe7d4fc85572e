"""Voxels of DICOM frames, decoded and scaled; a file of many frames is read once."""

import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate, generate_frames
from pydicom.pixels.utils import iter_pixels

from dvc.arrays import Float32Array
from dvc.errors import ImageFileError
from dvc.io.images.dicom_frames import CONVERT, Frame, damage_named
from dvc.io.images.stored import Voxels

_OF_A_FRAME = [  # what describes the pixels of one
    "Rows", "Columns", "SamplesPerPixel", "PhotometricInterpretation", "BitsAllocated", "BitsStored", "HighBit",
    "PixelRepresentation",
]  # fmt: skip
_OF_ALL = ["NumberOfFrames", "PlanarConfiguration", "ExtendedOffsetTable", "ExtendedOffsetTableLengths", "PixelData"]


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
            values[k] = stored
            values[k] *= np.float32(frames[k].slope)
            values[k] += np.float32(frames[k].intercept)
    return values


def _stored(path: Path, numbers: list[int], shape: tuple[int, int]) -> Iterator[Voxels]:
    """Stored values (rows, columns) of some frames of a file, numbered from 0, in the order given."""
    with damage_named(path):
        header = pydicom.dcmread(path, specific_tags=[*_OF_A_FRAME, *_OF_ALL])
        data = header.get("PixelData")
    if data is None:
        raise ImageFileError(f"{path}: a DICOM file without pixels: damaged or cut short. Export it again.")
    unusual = f"damaged or cut short, or an unusual compression. {CONVERT}"
    with damage_named(path, "its pixels cannot be decoded", unusual):
        syntax = header.file_meta.get("TransferSyntaxUID")
        packed = syntax is not None and syntax.is_encapsulated
        count = int(header.get("NumberOfFrames") or 1)
        needed = count * shape[0] * shape[1] * int(header.BitsAllocated) // 8
        if not packed and len(data) < needed:
            frames = f"{count} frames of " if count > 1 else ""
            raise ImageFileError(
                f"{path}: the file is cut short: {frames}{shape[1]} x {shape[0]} voxels need {needed} bytes, it holds "
                f"{len(data)}. Copy or export it again."
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
        raise ImageFileError(
            f"{path}: the header claims {count} frames, the file holds {len(packed)} compressed ones: damaged or cut "
            "short. Copy or export it again."
        )
    bare = Dataset()
    for name in _OF_A_FRAME:
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
                raise ImageFileError(f"{path}: its pixels have another size than the header says; damaged.")
            yield values[0]
