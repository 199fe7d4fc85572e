"""Names and dates of a patient in the headers of input files, and a search for them in every byte of the outputs."""

from __future__ import annotations

import base64
import binascii
import gzip
import io
import json
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pydicom
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import EnhancedMRImageStorage, ExplicitVRLittleEndian, MRImageStorage

from dvc import Image
from tests.dicomfiles import item

NAME, NUMBER, PLACE, DATE, BORN = "Quixote^Dulcinea", "MRN-7719404", "Toboso General", "19470823", "1947-08-23"
PLANTED = (NAME, NAME.partition("^")[0], NUMBER, PLACE, DATE, BORN)
_DEPTH = 3  # of packed contents within packed contents
_PACKED = re.compile(rb"\x78[\x01\x5e\x9c\xda]|\x1f\x8b\x08|PK\x03\x04")
_BASE64 = re.compile(rb"[A-Za-z0-9+/]{64,}={0,2}")


def plant_in_nifti(path: Path) -> None:
    """Write the names into all texts of a NIfTI header, and into an extension."""
    image = nibabel.load(path)
    for field, text in (("descrip", f"{NAME} {DATE}"), ("db_name", NUMBER), ("intent_name", NUMBER)):
        image.header[field] = text.encode()
    image.header["aux_file"] = PLACE.encode()
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", f"{NAME} {BORN} {PLACE}".encode()))
    nibabel.save(image, path)


def plant_beside(path: Path) -> None:
    """Write the names into a JSON file of dcm2niix beside a NIfTI file, with a number and a code that may be told."""
    told = {"PatientName": NAME, "PatientID": NUMBER, "PatientBirthDate": BORN, "InstitutionName": PLACE}
    told |= {"Manufacturer": NAME, "ManufacturersModelName": NUMBER, "SequenceName": PLACE, "AcquisitionDate": DATE}
    scan = {"MagneticFieldStrength": 3, "ScanningSequence": "GR", "RepetitionTime": NUMBER, "EchoTime": DATE}
    path.with_name(path.name.removesuffix(".nii.gz") + ".json").write_text(json.dumps(told | scan))


def plant_in_nrrd(path: Path) -> None:
    """Write the names into an NRRD header: a comment, the content, and keys with values."""
    head, _, data = path.read_bytes().partition(b"\n\n")
    more = f"\n# {NAME} {BORN}\ncontent: {PLACE}\nPatientName:={NAME}\nDICOM_0010_0020:={NUMBER}\nDate:={DATE}"
    path.write_bytes(head + more.encode() + b"\n\n" + data)


def write_dicom(folder: Path, image: Image) -> None:
    """An image as a classic DICOM series with the names in it."""
    folder.mkdir()
    around, scaling, places = _geometry(image)
    for k, place in enumerate(places):
        own = {"SOPInstanceUID": f"1.2.3.{k + 1}", **around, **scaling, **place, "ImageComments": PLACE}
        _write(folder / f"{k:03d}.dcm", MRImageStorage, own, _stored(image, scaling)[k : k + 1])


def write_enhanced_dicom(path: Path, image: Image) -> None:
    """An image as one enhanced (multi-frame) DICOM file with the names in it, also in its sequences and frames."""
    around, scaling, places = _geometry(image)
    measures = {"PixelSpacing": around.pop("PixelSpacing"), "SliceThickness": str(image.grid.spacing_mm[2])}
    shared = {
        "PlaneOrientationSequence": [item(ImageOrientationPatient=around.pop("ImageOrientationPatient"))],
        "PixelMeasuresSequence": [item(**measures)], "PixelValueTransformationSequence": [item(**scaling)],
    }  # fmt: skip
    frames = [
        item(
            PlanePositionSequence=[item(**place)],
            FrameContentSequence=[item(FrameComments=f"{NAME} {BORN}", StackID="1", InStackPositionNumber=k)],
            FrameAnatomySequence=[item(AnatomicRegionSequence=[item(CodeMeaning=f"heel of {NAME}")])],
        )
        for k, place in enumerate(places, start=1)
    ]
    asked = item(RequestedProcedureDescription=NAME, ReasonForTheRequestedProcedure=PLACE)
    own = {
        "SOPInstanceUID": "1.2.3.1", **around, "NumberOfFrames": len(frames), "RequestAttributesSequence": [asked],
        "SharedFunctionalGroupsSequence": [item(**shared)], "PerFrameFunctionalGroupsSequence": frames,
    }  # fmt: skip
    _write(path, EnhancedMRImageStorage, own, _stored(image, scaling))


def _geometry(image: Image) -> tuple[dict[str, Any], dict[str, str], list[dict[str, list[str]]]]:
    """Elements of an image and its patient, of the scaling of its values, and the place of each slice."""
    grid, axes = image.grid, np.asarray(image.grid.direction)
    around = {
        "SeriesInstanceUID": "1.2.3", "ImageType": ["ORIGINAL", "PRIMARY", "M", "NONE"], "Modality": "MR",
        "ImageOrientationPatient": [f"{v:.8f}" for v in (*axes[:, 0], *axes[:, 1])],
        "PixelSpacing": [f"{grid.spacing_mm[1]:.6g}", f"{grid.spacing_mm[0]:.6g}"], "Columns": grid.shape[0],
        "Rows": grid.shape[1], "PatientName": NAME, "PatientID": NUMBER, "InstitutionName": PLACE,
        "Manufacturer": f"SIEMENS {NAME}", "ManufacturerModelName": NAME, "SequenceName": NAME, "FlipAngle": "12",
        "PatientBirthDate": DATE, "StudyDate": DATE, "SeriesDescription": NAME, "ReferringPhysicianName": NAME,
    }  # fmt: skip
    places = np.asarray(grid.origin_mm) + np.arange(grid.shape[2])[:, None] * axes[:, 2] * grid.spacing_mm[2]
    scaling = {"RescaleSlope": f"{image.values.max() / 4000.0:.8g}", "RescaleIntercept": "0", "RescaleType": "US"}
    return around, scaling, [{"ImagePositionPatient": [f"{v:.6f}" for v in place]} for place in places]


def _stored(image: Image, scaling: dict[str, str]) -> np.ndarray:
    """Slices, rows, columns as they are stored."""
    return np.rint(image.values.T / float(scaling["RescaleSlope"])).astype("<i2")


def _write(path: Path, kind: str, elements: dict[str, Any], stored: np.ndarray) -> None:
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID, meta.TransferSyntaxUID = kind, ExplicitVRLittleEndian
    meta.MediaStorageSOPInstanceUID = elements["SOPInstanceUID"]
    one = FileDataset("", {}, file_meta=meta, preamble=bytes(128))
    for field, value in {
        "SOPClassUID": kind, **elements, "SamplesPerPixel": 1, "PhotometricInterpretation": "MONOCHROME2",
        "BitsAllocated": 16, "BitsStored": 16, "HighBit": 15, "PixelRepresentation": 1, "PixelData": stored.tobytes(),
    }.items():  # fmt: skip
        setattr(one, field, value)
    one["PixelData"].VR = "OW"
    pydicom.dcmwrite(path, one, enforce_file_format=True)


def planted_in(folder: Path, words: tuple[str, ...] = PLANTED) -> list[str]:
    """Where a word occurs in the name or in any byte of a file, also where that is compressed or in base64."""
    codes = "utf-8", "utf-16-le", "utf-16-be", "utf-32-le"
    forms = {word: [word.encode(code) for code in codes] for word in words}
    found = []
    for path in sorted(folder.rglob("*")):
        contents = [str(path.relative_to(folder)).encode()]
        contents += _contents(path.read_bytes()) if path.is_file() else []
        found += [f"{path}: {w}" for w, as_bytes in forms.items() if any(b in c for b in as_bytes for c in contents)]
    return found


def _contents(content: bytes, depth: int = 0) -> Iterator[bytes]:
    """A content, and what is packed in it, wherever that begins."""
    yield content
    if depth == _DEPTH:
        return
    for begin in _PACKED.finditer(content):
        yield from (one for packed in _unpacked(content[begin.start() :]) for one in _contents(packed, depth + 1))
    for text in _BASE64.findall(content):
        try:
            yield from _contents(base64.b64decode(text[: len(text) // 4 * 4]), depth + 1)
        except binascii.Error:
            continue


def _unpacked(content: bytes) -> list[bytes]:
    try:
        if content.startswith(b"PK"):
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                return [archive.read(name) for name in archive.namelist()]
        if content.startswith(b"\x1f"):
            with gzip.open(io.BytesIO(content)) as stream:
                return [stream.read()]
        return [zlib.decompressobj().decompress(content)]
    except (OSError, EOFError, ValueError, RuntimeError, zlib.error, zipfile.BadZipFile):
        return []
