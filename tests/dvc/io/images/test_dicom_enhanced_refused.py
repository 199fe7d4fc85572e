"""Enhanced (multi-frame) DICOM that is damaged, incomplete or no image: refused with the cause, and without a name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate
from pydicom.uid import (
    ExplicitVRLittleEndian,
    HTJ2KLossless,
    RLELossless,
    SegmentationStorage,
)

from dvc.errors import ImageFileError, InputError
from dvc.io.images.read import read_image
from tests.dicomfiles import FRAMES, SHUFFLED, groups, item, refused, write_classic, write_enhanced


def _without(name: str, of: int = 3) -> list[Dataset]:
    return [groups(k, **({name: None} if k == of else {})) for k in SHUFFLED]


def _strip(name: str) -> Callable[[Any], None]:
    return lambda header: delattr(header.SharedFunctionalGroupsSequence[0], name)


def _cut(header: Any) -> None:
    header.PixelData = header.PixelData[:-20]


_PLACED = [groups(k) for k in range(8)]
_REFUSALS: dict[str, tuple[dict[str, Any], str]] = {
    "gap": ({"frames": [g for g in _PLACED if g.slice_shown != 4]}, r"1 gaps .*\(frame 4\) and .*\(frame 5\)"),
    "twice": (
        {"frames": [*FRAMES, groups(4)]},
        r"1 slices have the position .*frame 8\) and .*frame 9.*state the volume of each frame",
    ),
    "uneven": ({"frames": [groups(k, at=k + 0.3 * (k == 4)) for k in range(8)]}, "not evenly stacked"),
    "one group": ({"frames": [*FRAMES[:-1]], "NumberOfFrames": 8}, "claims 8 frames, but describes 7"),
    "no groups": ({"PerFrameFunctionalGroupsSequence": None}, "claims 8 frames, but describes 0"),
    "position": ({"frames": _without("PlanePositionSequence")}, "lacks ImagePositionPatient in .* of frame 1"),
    "orientation": ({"change": _strip("PlaneOrientationSequence")}, "lacks ImageOrientationPatient in .* frame 1"),
    "spacing": ({"change": _strip("PixelMeasuresSequence")}, "lacks PixelSpacing in the functional groups"),
    "scaling": ({"frames": _without("PixelValueTransformationSequence", 0)}, "lacks RescaleSlope, .* of frame 2"),
    "slope": ({"frames": [*FRAMES[:-1], groups(4, scaling=("1e999", "0"))]}, "frame 8: .*not finite"),
    "no width": (
        {"frames": [groups(k, PixelMeasuresSequence=item(PixelSpacing=["0", "1"])) for k in range(8)]},
        "5 x 6 voxels of 1 x 0 mm; all must be positive",
    ),
    "pixels": ({"change": _cut}, "incomplete: 8 frames of 5 x 6 voxels need 480 bytes, but it has 460"),
    "no pixels": ({"change": lambda header: delattr(header, "PixelData")}, "has no pixels"),
    "terabytes": ({"Rows": 65535, "Columns": 65535}, "65535 x 65535 x 8 voxels, about 128.0 GiB"),
    "frames": ({"NumberOfFrames": 2**31 - 1}, "claims 2147483647 frames, but describes 8"),
    "colour": ({"PhotometricInterpretation": "RGB", "SamplesPerPixel": 3}, "in colour"),
    "mask": ({"SOPClassUID": SegmentationStorage}, "only enhanced MR and CT images.*dcm2niix"),
    "one": ({"frames": [groups(0), groups(1, stack="2")]}, "a single slice|at least 4 slices"),
}


@pytest.mark.parametrize("name", _REFUSALS)
def test_what_cannot_be_an_image_is_refused(tmp_path: Path, name: str) -> None:
    options, message = _REFUSALS[name]
    refused(write_enhanced(tmp_path / "e" / "e.dcm", **options), message)
    with pytest.raises(ImageFileError, match=message):
        read_image(tmp_path / "e")


def test_a_compression_that_nothing_here_decodes_is_refused(tmp_path: Path) -> None:
    def compress(header: Any) -> None:
        header.file_meta.TransferSyntaxUID = HTJ2KLossless
        header.PixelData = encapsulate([bytes(100)] * 8)
        header["PixelData"].is_undefined_length = True

    refused(write_enhanced(tmp_path / "e.dcm", change=compress), "cannot be decoded .*dcm2niix")


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, RLELossless], ids=lambda s: s.name)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, syntax: Any) -> None:
    whole = write_enhanced(tmp_path / "e.dcm", syntax=syntax).read_bytes()
    for kept in np.linspace(0, len(whole) - 12, 60).astype(int):
        (tmp_path / "e.dcm").write_bytes(whole[:kept])
        refused(tmp_path / "e.dcm", "damaged|incomplete")


@pytest.mark.parametrize("enhanced", [True, False], ids=["enhanced", "classic"])
def test_bytes_that_are_damaged_give_no_other_error(tmp_path: Path, enhanced: bool) -> None:
    place = tmp_path / "s"
    path = write_enhanced(place / "e.dcm") if enhanced else write_classic(place, [("1", "0")] * 8) / "7.dcm"
    for other in place.iterdir():
        if other != path:
            other.unlink()  # for speed
    whole = path.read_bytes()
    rng, told = np.random.default_rng(4), []
    pixels = whole.rindex(b"\xe0\x7f\x10\x00")
    for _ in range(150):
        damaged = bytearray(whole)
        for at in rng.integers(132, pixels + 12, rng.integers(1, 4)):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read_image(place)
        except InputError as refusal:  # ImageFileError, too
            told.append(str(refusal))
    assert len(told) > 20
    assert not any("Doe" in text for text in told)


def test_a_file_cut_within_its_first_elements_is_not_left_out(tmp_path: Path) -> None:
    whole = (write_classic(tmp_path / "s", [("1", "0")] * 8) / "7.dcm").read_bytes()  # the last in space: no gap
    for kept in (140, 175, 300, 345, 360):
        (tmp_path / "s" / "7.dcm").write_bytes(whole[:kept])
        refused(tmp_path / "s", r"7\.dcm: .*(damaged|incomplete)")


def test_what_a_header_holds_by_mistake_is_not_quoted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    slopes = {"frames": [groups(k, scaling=("12345678", "0")) for k in SHUFFLED]}
    for options in (slopes, {"NumberOfFrames": 12345678}):
        path = write_enhanced(tmp_path / "e.dcm", **options)
        path.write_bytes(path.read_bytes().replace(b"12345678", b"Doe^Jane"))
        refused(path, "damaged")
    assert "Doe" not in caplog.text
