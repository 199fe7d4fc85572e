"""How an image was acquired is read from its header, and nothing else is: no name, number or date of a person."""

from __future__ import annotations

import json
from dataclasses import astuple
from pathlib import Path
from typing import Any

import pydicom
import pytest

from dvc.io.images.scan_parameters import ScanParameters, read_scan_parameters
from tests.dicomfiles import FRAMES, MEASURES, ORIENTATION, item, write_classic, write_enhanced
from tests.planted import BORN, DATE, NAME, NUMBER, PLACE, PLANTED

EXPECTED = ScanParameters("Siemens", "MAGNETOM Skyra fit", 3.0, "3D gradient echo, segmented k-space, spoiled",
                          "*fl3d1_ns", 8.2, 3.69, 12.0, "256 x 192")  # fmt: skip
HEADER = {
    "Manufacturer": "SIEMENS Healthineers", "ManufacturerModelName": "MAGNETOM Skyra fit", "MagneticFieldStrength": "3",
    "ScanningSequence": "GR", "SequenceVariant": ["SK", "SP"], "MRAcquisitionType": "3D", "SequenceName": "*fl3d1_ns",
    "RepetitionTime": "8.2", "EchoTime": "3.69", "FlipAngle": "12", "AcquisitionMatrix": [0, 256, 192, 0],
}  # fmt: skip
SIDECAR = {
    "Manufacturer": "Siemens", "ManufacturersModelName": "MAGNETOM Skyra fit", "MagneticFieldStrength": 3,
    "ScanningSequence": "GR", "SequenceVariant": "SK_SP", "MRAcquisitionType": "3D", "SequenceName": "*fl3d1_ns",
    "RepetitionTime": 0.0082, "EchoTime": 0.00369, "FlipAngle": 12, "BaseResolution": 256, "AcquisitionMatrixPE": 192,
}  # fmt: skip


def with_header(folder: Path, **elements: Any) -> Path:
    """A classic series whose headers have these elements."""
    write_classic(folder, [("1", "0")] * 8)
    for path in folder.iterdir():
        header = pydicom.dcmread(path)
        for name, value in elements.items():
            setattr(header, name, value)
        header.save_as(path)
    return folder


def beside(folder: Path, told: object) -> Path:
    """A NIfTI file's place, with the JSON file of dcm2niix beside it."""
    (folder / "Load0.json").write_text(told if isinstance(told, str) else json.dumps(told))
    return folder / "Load0.nii.gz"


def test_standard_elements_of_a_series_are_read(tmp_path: Path) -> None:
    assert read_scan_parameters(with_header(tmp_path / "series", **HEADER)) == EXPECTED


def test_functional_groups_of_an_enhanced_file_are_read(tmp_path: Path) -> None:
    shared = item(
        PlaneOrientationSequence=[item(**ORIENTATION)],
        PixelMeasuresSequence=[item(**MEASURES)],
        MREchoSequence=[item(EffectiveEchoTime=3.69)],
        MRTimingAndRelatedParametersSequence=[item(RepetitionTime="8.2", FlipAngle="12")],
        MRFOVGeometrySequence=[
            item(MRAcquisitionFrequencyEncodingSteps=256, MRAcquisitionPhaseEncodingStepsInPlane=192)
        ],
    )
    own = {"Manufacturer": "Philips Medical Systems", "ManufacturerModelName": "Ingenia Elition X",
           "MagneticFieldStrength": "3", "EchoPulseSequence": "GRADIENT", "MRAcquisitionType": "3D",
           "PulseSequenceName": "T1FFE"}  # fmt: skip
    path = write_enhanced(tmp_path / "enhanced.dcm", FRAMES, shared=shared, **own)
    assert astuple(read_scan_parameters(path)) == (
        "Philips", "Ingenia Elition X", 3.0, "3D gradient echo", "T1FFE", 8.2, 3.69, 12.0, "256 x 192"
    )  # fmt: skip


def test_the_json_file_of_dcm2niix_is_read_in_its_units(tmp_path: Path) -> None:
    assert read_scan_parameters(beside(tmp_path, SIDECAR)) == EXPECTED
    assert read_scan_parameters(tmp_path / "Load1.nii.gz") == ScanParameters()  # no file beside this one


@pytest.mark.parametrize(
    ("maker", "model"),
    [("GE MEDICAL SYSTEMS", "SIGNA Architect"), ("GE MEDICAL SYSTEMS", "DISCOVERY MR750w"), ("UIH", "uMR 790"),
     ("SIEMENS", "MAGNETOM Free.Max"), ("Canon Medical", "Vantage Titan 1.5T"), ("Philips", "Achieva dStream")],
)  # fmt: skip
def test_known_scanners_are_told_as_their_headers_have_them(tmp_path: Path, maker: str, model: str) -> None:
    found = read_scan_parameters(beside(tmp_path, {"Manufacturer": maker, "ManufacturersModelName": model}))
    assert found.scanner == model
    assert found.manufacturer is not None


@pytest.mark.parametrize("words", [*PLANTED, f"Siemens {NAME}", f"Skyra {NUMBER}", f"fl3d {NAME}", "Skyra Dulcinea"])
def test_a_patient_in_any_element_gets_no_further(tmp_path: Path, words: str) -> None:
    texts = ("Manufacturer", "ManufacturerModelName", "SequenceName")
    found = read_scan_parameters(with_header(tmp_path / "series", **dict.fromkeys(texts, words[:16])))
    as_numbers = dict.fromkeys(SIDECAR, DATE)
    told = f"{found} {read_scan_parameters(beside(tmp_path, dict.fromkeys(SIDECAR, words)))}"
    told += str(read_scan_parameters(beside(tmp_path, as_numbers)))
    for one in (*PLANTED, "Dulcinea", "Toboso", BORN[:4], PLACE[:6]):
        assert one not in told


@pytest.mark.parametrize(
    "told",
    ["{", "[]", "", '{"RepetitionTime": NaN}', {"RepetitionTime": "soon", "EchoTime": [1], "FlipAngle": True},
     {"ScanningSequence": {"a": 1}, "SequenceVariant": 7, "Manufacturer": {"a": NAME}}, {"BaseResolution": "x"}],
)  # fmt: skip
def test_what_cannot_be_read_tells_nothing(tmp_path: Path, told: object) -> None:
    assert read_scan_parameters(beside(tmp_path, told)) == ScanParameters()


def test_a_damaged_series_tells_nothing(tmp_path: Path) -> None:
    (tmp_path / "series").mkdir()
    (tmp_path / "series" / "1.dcm").write_bytes(bytes(128) + b"DICM" + b"\x01" * 90)
    assert read_scan_parameters(tmp_path / "series") == ScanParameters()
    assert read_scan_parameters(tmp_path / "nowhere") == ScanParameters()
