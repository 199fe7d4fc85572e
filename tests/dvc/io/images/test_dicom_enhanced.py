"""Enhanced (multi-frame) DICOM: the same image as the classic series of the same slices, or a list to choose from."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.dataset import Dataset
from pydicom.encaps import encapsulate, generate_frames
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    EnhancedCTImageStorage,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    LegacyConvertedEnhancedMRImageStorage,
    RLELossless,
)

from dvc.errors import InputError
from dvc.io.images.dicom import is_multiframe
from dvc.io.images.read import read_image
from tests.dicomfiles import (
    AXIAL,
    MEASURES,
    ORIENTATION,
    ORIGIN,
    SERIES,
    SHAPE,
    SHUFFLED,
    SPACING,
    STORED,
    TURN,
    groups,
    item,
    place_of,
    refused,
    write_classic,
    write_enhanced,
)


def _assert_same(image: Any, other: Any) -> None:
    np.testing.assert_array_equal(image.values, other.values)
    assert image.grid.shape == other.grid.shape
    for name in ("spacing_mm", "origin_mm", "direction"):
        np.testing.assert_array_equal(getattr(image.grid, name), getattr(other.grid, name))


@pytest.mark.parametrize(
    "syntax",
    [
        ExplicitVRLittleEndian,
        ImplicitVRLittleEndian,
        ExplicitVRBigEndian,
        DeflatedExplicitVRLittleEndian,
        RLELossless,
    ],
    ids=lambda s: s.name,
)
def test_it_is_the_same_image_as_the_classic_series(tmp_path: Path, syntax: Any) -> None:
    scaling = [(f"{0.37 * (k + 1):.6g}", f"{-7.3 * k:.6g}") for k in range(SHAPE[2])]
    path = write_enhanced(tmp_path / "e" / "e.dcm", [groups(k, scaling=scaling[k]) for k in SHUFFLED], syntax=syntax)
    image = read_image(path)
    _assert_same(image, read_image(write_classic(tmp_path / "classic", scaling)))
    _assert_same(image, read_image(path.parent))
    scaled = STORED * [float(s) for s, _ in scaling] + [float(i) for _, i in scaling]
    np.testing.assert_allclose(image.values, scaled, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(image.grid.spacing_mm, SPACING, atol=1e-5)
    np.testing.assert_allclose(image.grid.origin_mm, ORIGIN, atol=1e-5)
    np.testing.assert_allclose(image.grid.direction, TURN, atol=1e-6)
    assert is_multiframe(path)


def test_the_grid_agrees_with_simpleitk(tmp_path: Path) -> None:
    path = write_enhanced(
        tmp_path / "e.dcm", [groups(k) for k in range(SHAPE[2])]
    )  # it takes frames as they are stored
    image, other = read_image(path), sitk.ReadImage(str(path))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(other).transpose(2, 1, 0), image.values)
    np.testing.assert_allclose(other.GetOrigin(), image.grid.origin_mm, atol=1e-6)
    np.testing.assert_allclose(other.GetSpacing(), image.grid.spacing_mm, atol=1e-5)
    np.testing.assert_allclose(np.reshape(other.GetDirection(), (3, 3)), image.grid.direction, atol=1e-6)


def test_groups_may_be_shared_or_of_each_frame(tmp_path: Path) -> None:
    macros = {"PlaneOrientationSequence": item(**ORIENTATION), "PixelMeasuresSequence": item(**MEASURES)}
    frames = [groups(k, scaling=None, **macros) for k in SHUFFLED]
    shared = Dataset()
    shared.PixelValueTransformationSequence = [item(RescaleIntercept="-5", RescaleSlope="2")]
    shared.PlanePositionSequence = [item(**place_of(99))]  # each frame's own counts
    for holder in (shared, None):
        image = read_image(write_enhanced(tmp_path / "e.dcm", frames, shared=holder))
        np.testing.assert_array_equal(image.values, STORED * 2.0 - 5.0 if holder else STORED)


def _jpeg2000(stored: np.ndarray, scratch: Path) -> bytes:
    """One frame, compressed without loss."""
    writer = sitk.ImageFileWriter()
    writer.UseCompressionOn()
    writer.SetCompressor("JPEG2000")
    writer.SetFileName(str(scratch))
    writer.Execute(sitk.GetImageFromArray(stored[None]))
    header = pydicom.dcmread(scratch)
    scratch.unlink()
    return next(generate_frames(header.PixelData, number_of_frames=1)), header.file_meta.TransferSyntaxUID


def test_compressed_frames_are_decoded_and_scaled_by_their_own_slope(tmp_path: Path) -> None:
    stored = np.random.default_rng(3).integers(0, 4000, (8, 40, 48)).astype(np.uint16)
    packed = [_jpeg2000(stored[k], tmp_path / "scratch.dcm") for k in SHUFFLED]

    def compress(header: Any, kept: int = 8) -> None:
        header.file_meta.TransferSyntaxUID = packed[0][1]
        header.PixelData = encapsulate([p[0] for p in packed[:kept]])
        header["PixelData"].is_undefined_length = True

    frames = [groups(k, scaling=(str(k + 1), "-5")) for k in SHUFFLED]
    size = {"Rows": 40, "Columns": 48, "PixelRepresentation": 0}
    path = write_enhanced(tmp_path / "e.dcm", frames, change=compress, **size)
    inverted = write_enhanced(
        tmp_path / "i.dcm", frames, change=compress, PhotometricInterpretation="MONOCHROME1", **size
    )
    expected = stored.transpose(2, 1, 0) * (np.arange(8) + 1.0) - 5.0
    for written in (path, inverted):  # of display alone
        np.testing.assert_array_equal(read_image(written).values, expected)
    refused(
        write_enhanced(tmp_path / "few.dcm", frames, change=lambda h: compress(h, 5), **size),
        "claims 8 frames, but the file has 5",
    )
    refused(
        write_enhanced(tmp_path / "size.dcm", frames, change=compress, **(size | {"Rows": 41})), "another size|decoded"
    )
    path.write_bytes(path.read_bytes()[:-300])
    refused(path, "damaged|incomplete")


_PHASE = {"shows": ("ORIGINAL", "PRIMARY", "P", "NONE"), "component": "PHASE"}
_CHOICES: list[tuple[dict[str, Any], str]] = [
    ({"echo": 80.0}, "echo time 80 ms"),
    (_PHASE, "image type P/NONE/PHASE"),
    ({"shows": ("DERIVED", "PRIMARY", "DIXON", "FAT")}, "image type DIXON/FAT/MAGNITUDE"),
    ({"stack": "2"}, "stack 2"),
    ({"stack": "2", "at": 40.0}, "stack 2"),
    ({"stack": "Doe"}, "stack with a name"),
    ({"time": 2}, "time point 2"),
    ({"indices": (1, 1, 2)}, "dimension 3 (TemporalPositionIndex) 2"),
    ({"PlaneOrientationSequence": item(ImageOrientationPatient=AXIAL)}, "stacked along (0.00, 0.00, 1.00)"),
    ({"PixelMeasuresSequence": item(PixelSpacing=["2", "2"])}, "voxels of 2 x 2 mm"),
]


@pytest.mark.parametrize(("other", "told"), _CHOICES, ids=[told for _, told in _CHOICES])
def test_several_images_in_a_file_are_listed_and_chosen_from(tmp_path: Path, other: dict[str, Any], told: str) -> None:
    moved, other = other.get("at", 0.0), {name: value for name, value in other.items() if name != "at"}
    both = [g for k in SHUFFLED for g in (groups(k), groups(k, at=k + moved, scaling=("3", "0"), **other))]
    path = write_enhanced(tmp_path / "e" / "e.dcm", both)
    message = refused(path, "this file contains several echoes, image types, orientations, stacks or time", InputError)
    lines = message.splitlines()[1:]
    assert [line.split(":")[0].strip() for line in lines] == ["111111/1", "111111/2"]
    assert "8 slices of 5 x 6" in lines[0]
    own = 1 if told in lines[0] else 2
    assert told in lines[own - 1]
    if "PlaneOrientationSequence" not in other:  # there the slices are sheared
        np.testing.assert_array_equal(read_image(path, series=f"111111/{own}").values, 3.0 * STORED)
    np.testing.assert_array_equal(read_image(path.parent, series=f"111111/{3 - own}").values, STORED)
    refused(path, "matches 0 of the DICOM series", InputError, series="111111/3")
    refused(path.parent, "this folder contains several", InputError)


def test_a_long_list_is_shortened_and_all_of_it_can_be_chosen(tmp_path: Path) -> None:
    times = [groups(k, time=t, scaling=(str(t), "0")) for t in range(1, 61) for k in (2, 0, 3, 1)]
    message = refused(write_enhanced(tmp_path / "e.dcm", times), "and 20 more", InputError)
    assert len(message.splitlines()) == 42
    np.testing.assert_array_equal(read_image(tmp_path / "e.dcm", series="111111/60").values, 60.0 * STORED[:, :, :4])


def test_labels_that_go_with_the_place_part_nothing(tmp_path: Path) -> None:
    each = [groups(k, stack=str(k), time=k + 1) for k in SHUFFLED]
    np.testing.assert_array_equal(read_image(write_enhanced(tmp_path / "each.dcm", each)).values, STORED)


def test_private_groups_beside_the_standard_ones_do_not_count(tmp_path: Path) -> None:
    """Philips repeats the position, moved by half a voxel, and adds a scale of its own, in private elements."""
    frames = [groups(k, indices=(k + 1, 1, 1)) for k in SHUFFLED]  # indices in another order than they say, too
    for k, own in zip(SHUFFLED, frames, strict=True):
        block = own.private_block(0x2005, "Philips MR Imaging DD 005", create=True)
        private = item(**place_of(k + 0.5), ImageOrientationPatient=AXIAL, RescaleSlope="17", PatientName="Doe^Jane")
        private.private_block(0x2005, "Philips MR Imaging DD 001", create=True).add_new(0x0E, "FL", 0.01 * k)
        block.add_new(0x0F, "SQ", [private])
    image = read_image(write_enhanced(tmp_path / "e.dcm", frames))
    np.testing.assert_array_equal(image.values, STORED)
    np.testing.assert_allclose(image.grid.origin_mm, ORIGIN, atol=1e-5)


@pytest.mark.parametrize("stored_as", [LegacyConvertedEnhancedMRImageStorage, EnhancedCTImageStorage])
def test_converted_mr_and_ct_are_read(tmp_path: Path, stored_as: Any) -> None:
    echoes = {0: "6.3", 1: "80"}
    frames = []
    for echo, told in echoes.items():
        converted = {"UnassignedPerFrameConvertedAttributesSequence": item(EchoTime=told, EchoNumbers=echo + 1)}
        macros = {"MRImageFrameTypeSequence": None, "PlaneOrientationSequence": item(**ORIENTATION)}
        macros |= {"CTImageFrameTypeSequence": item(FrameType=["ORIGINAL", "PRIMARY", "AXIAL"])}
        macros |= {"PixelMeasuresSequence": item(**MEASURES)}
        frames += [groups(k, scaling=(str(echo + 1), "0"), **macros, **converted) for k in SHUFFLED]
    path = write_enhanced(tmp_path / "e.dcm", frames, shared=Dataset(), SOPClassUID=stored_as)
    assert "echo time 80 ms, echo 2, image type AXIAL" in refused(path, "several", InputError)
    np.testing.assert_array_equal(read_image(path, series="/2").values, 2.0 * STORED)


def test_an_image_in_several_files(tmp_path: Path) -> None:
    single = tmp_path / "single"  # as some scanners do: enhanced files of one frame
    for k in range(SHAPE[2]):
        write_enhanced(single / f"{k * 5 % 7}{k}.dcm", [groups(k)])
    np.testing.assert_array_equal(read_image(single).values, STORED)
    refused(single / "00.dcm", "Pass its folder instead")
    assert not is_multiframe(single / "00.dcm")
    parts = tmp_path / "parts"  # one image, stored in two files
    for name, held in (("b", SHUFFLED[:4]), ("a", SHUFFLED[4:])):
        frames = [groups(k) for k in held]
        write_enhanced(parts / f"{name}.dcm", frames, ConcatenationUID="1.2.9", InConcatenationTotalNumber=2)
    np.testing.assert_array_equal(read_image(parts).values, STORED)
    refused(parts / "a.dcm", "Pass its folder instead")
    (parts / "a.dcm").unlink()
    refused(parts, "stored in 2 files, but only 1 are in this folder")


def test_a_folder_with_a_file_for_each_time_point(tmp_path: Path) -> None:
    for t in (1, 2):
        write_enhanced(tmp_path / "e" / f"{t}.dcm", [groups(k, time=t) for k in SHUFFLED], offset=t)
    message = refused(tmp_path / "e", "this folder contains several", InputError)
    assert re.findall(r"time point (\d)", message) == ["1", "2"]
    np.testing.assert_array_equal(read_image(tmp_path / "e", series="111111/2").values, STORED + 2.0)
    for t in (1, 2):
        write_enhanced(tmp_path / "e" / f"{t}.dcm", offset=t)
    refused(
        tmp_path / "e", r"8 slices have the position of another slice .*1\.dcm \(frame 2\).*Two acquisitions or copies"
    )
    np.testing.assert_array_equal(read_image(tmp_path / "e" / "2.dcm").values, STORED + 2.0)


def test_enhanced_and_classic_series_in_one_folder(tmp_path: Path) -> None:
    folder = write_classic(tmp_path / "s", [("2", "0")] * SHAPE[2])
    write_enhanced(folder / "e.dcm", SeriesInstanceUID=SERIES[:-6] + "333333")
    refused(folder, "2 DICOM series", InputError)
    np.testing.assert_array_equal(read_image(folder, series="111111").values, 2.0 * STORED)
    np.testing.assert_array_equal(read_image(folder, series="333333").values, STORED)
