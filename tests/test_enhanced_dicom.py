"""Enhanced (multi-frame) DICOM: the same image as the classic series of the same slices, or refused with the cause."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.dataset import Dataset, FileMetaDataset
from pydicom.encaps import encapsulate, generate_frames
from pydicom.tag import Tag
from pydicom.uid import (
    DeflatedExplicitVRLittleEndian,
    EnhancedCTImageStorage,
    EnhancedMRImageStorage,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    HTJ2KLossless,
    ImplicitVRLittleEndian,
    LegacyConvertedEnhancedMRImageStorage,
    MRImageStorage,
    RLELossless,
    SegmentationStorage,
)
from scipy.spatial.transform import Rotation

from dvc.dicom import is_multiframe
from dvc.errors import ImageFileError, InputError, MrstrainError
from dvc.imagefile import estimate_size, read_image

_SERIES = "1.2.826.0.1.3680043.8.498.111111"
_SHAPE = (5, 6, 8)  # columns, rows, slices
_SPACING = (0.8, 1.25, 4.0)
_TURN = Rotation.from_euler("xyz", [20.0, -35.0, 10.0], degrees=True).as_matrix()
_ORIGIN = np.array([-30.0, 12.0, 250.0])
_STORED = np.random.default_rng(2).integers(0, 4000, _SHAPE).astype(np.int16)
_SHUFFLED = [3, 0, 7, 5, 1, 6, 2, 4]
_UNIT = ["1", "0", "0", "0", "1", "0"]


def _item(**elements: Any) -> Dataset:
    item = Dataset()
    for name, value in elements.items():
        setattr(item, name, value)
    return item


def _place(k: float) -> dict[str, list[str]]:
    """Position of slice k, to be written in either kind of file."""
    return {"ImagePositionPatient": [f"{v:.6f}" for v in _ORIGIN + _TURN[:, 2] * _SPACING[2] * k]}


_ORIENTATION = {"ImageOrientationPatient": [f"{v:.8f}" for v in (*_TURN[:, 0], *_TURN[:, 1])]}
_MEASURES = {"PixelSpacing": [str(_SPACING[1]), str(_SPACING[0])], "SliceThickness": "3.0"}


def _groups(
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
    content = _item(StackID=stack, InStackPositionNumber=100 - k, TemporalPositionIndex=time)
    content.DimensionIndexValues = list(indices or (1, k + 1, time))
    found = {
        "FrameContentSequence": content,
        "PlanePositionSequence": _item(**_place(k if at is None else at)),
        "MRImageFrameTypeSequence": _item(FrameType=list(shows), ComplexImageComponent=component),
        "PixelValueTransformationSequence": scaling
        and _item(RescaleIntercept=scaling[1], RescaleSlope=scaling[0], RescaleType="US"),
        "MREchoSequence": echo and _item(EffectiveEchoTime=echo),
        **macros,
    }
    own = Dataset()
    for name, item in found.items():
        if item is not None:
            setattr(own, name, [item])
    own.slice_shown = k  # not an element: for the writer
    return own


_ALL = tuple(_groups(k) for k in _SHUFFLED)


def _write(
    path: Path,
    frames: Sequence[Dataset] = _ALL,
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
        shared.PlaneOrientationSequence = [_item(**_ORIENTATION)]
        shared.PixelMeasuresSequence = [_item(**_MEASURES)]
        shared.MREchoSequence = [_item(EffectiveEchoTime=6.3)]
    whole = Dataset()
    whole.file_meta = FileMetaDataset()
    whole.file_meta.TransferSyntaxUID = syntax if syntax != RLELossless else ExplicitVRLittleEndian
    dimensions = [Tag("StackID"), Tag("InStackPositionNumber"), Tag("TemporalPositionIndex")]
    values = {
        "SOPClassUID": EnhancedMRImageStorage,
        "SOPInstanceUID": "1.2.3.1",
        "SeriesInstanceUID": _SERIES,
        "PatientName": "Doe^Jane",
        "PatientID": "ID-12345",
        "ImageType": ["ORIGINAL", "PRIMARY", "M", "NONE"],
        "Modality": "MR",
        "NumberOfFrames": len(frames),
        "Rows": _SHAPE[1],
        "Columns": _SHAPE[0],
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "BitsAllocated": 16,
        "BitsStored": 16,
        "HighBit": 15,
        "PixelRepresentation": 1,
        "DimensionIndexSequence": [_item(DimensionIndexPointer=d) for d in dimensions],
        "SharedFunctionalGroupsSequence": [shared],
        "PerFrameFunctionalGroupsSequence": list(frames),
    } | fields
    for key, value in values.items():
        if value is not None:
            setattr(whole, key, value)
    big = syntax == ExplicitVRBigEndian
    stored = [_STORED[:, :, g.slice_shown].T + offset for g in frames]
    whole.PixelData = np.array(stored, dtype=">i2" if big else "<i2").tobytes()
    whole["PixelData"].VR = "OW"
    if change is not None:
        change(whole)
    if syntax == RLELossless:
        whole.compress(RLELossless)
    settings = {"little_endian": False, "implicit_vr": False} if big else {}
    pydicom.dcmwrite(path, whole, enforce_file_format=True, **settings)
    return path


def _classic(folder: Path, scaling: Sequence[tuple[str, str]]) -> Path:
    """Write the same slices as a classic series."""
    folder.mkdir()
    for k in range(_SHAPE[2]):
        fields = _place(k) | _ORIENTATION | {"PixelSpacing": _MEASURES["PixelSpacing"]}
        fields |= {"RescaleSlope": scaling[k][0], "RescaleIntercept": scaling[k][1], "EchoTime": "6.3"}
        path = _write(folder / f"{k}.dcm", [_groups(k)], SOPClassUID=MRImageStorage, **fields)
        header = pydicom.dcmread(path)
        for name in ("NumberOfFrames", "Dimension", "SharedFunctionalGroups", "PerFrameFunctionalGroups"):
            for element in list(header):
                if element.keyword.startswith(name):
                    del header[element.tag]
        header.save_as(path)
    return folder


def _refused(place: Path, message: str, kind: type[MrstrainError] = ImageFileError, **options: Any) -> str:
    """Return the message of the refusal, which names the file and no patient."""
    with pytest.raises(kind, match=message) as caught:
        read_image(place, **options)
    told = str(caught.value)
    assert str(place) in told
    assert "Doe" not in told
    assert "12345" not in told
    return told


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
    scaling = [(f"{0.37 * (k + 1):.6g}", f"{-7.3 * k:.6g}") for k in range(_SHAPE[2])]
    path = _write(tmp_path / "e" / "e.dcm", [_groups(k, scaling=scaling[k]) for k in _SHUFFLED], syntax=syntax)
    image = read_image(path)
    _assert_same(image, read_image(_classic(tmp_path / "classic", scaling)))
    _assert_same(image, read_image(path.parent))
    scaled = _STORED * [float(s) for s, _ in scaling] + [float(i) for _, i in scaling]
    np.testing.assert_allclose(image.values, scaled, rtol=1e-6, atol=1e-3)
    np.testing.assert_allclose(image.grid.spacing_mm, _SPACING, atol=1e-5)
    np.testing.assert_allclose(image.grid.origin_mm, _ORIGIN, atol=1e-5)
    np.testing.assert_allclose(image.grid.direction, _TURN, atol=1e-6)
    assert estimate_size(path) == 4 * image.values.size
    assert is_multiframe(path)


def test_the_grid_agrees_with_simpleitk(tmp_path: Path) -> None:
    path = _write(tmp_path / "e.dcm", [_groups(k) for k in range(_SHAPE[2])])  # it takes frames as they are stored
    image, other = read_image(path), sitk.ReadImage(str(path))
    np.testing.assert_array_equal(sitk.GetArrayFromImage(other).transpose(2, 1, 0), image.values)
    np.testing.assert_allclose(other.GetOrigin(), image.grid.origin_mm, atol=1e-6)
    np.testing.assert_allclose(other.GetSpacing(), image.grid.spacing_mm, atol=1e-5)
    np.testing.assert_allclose(np.reshape(other.GetDirection(), (3, 3)), image.grid.direction, atol=1e-6)


def test_groups_may_be_shared_or_of_each_frame(tmp_path: Path) -> None:
    macros = {"PlaneOrientationSequence": _item(**_ORIENTATION), "PixelMeasuresSequence": _item(**_MEASURES)}
    frames = [_groups(k, scaling=None, **macros) for k in _SHUFFLED]
    shared = Dataset()
    shared.PixelValueTransformationSequence = [_item(RescaleIntercept="-5", RescaleSlope="2")]
    shared.PlanePositionSequence = [_item(**_place(99))]  # each frame's own counts
    for holder in (shared, None):
        image = read_image(_write(tmp_path / "e.dcm", frames, shared=holder))
        np.testing.assert_array_equal(image.values, _STORED * 2.0 - 5.0 if holder else _STORED)


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
    packed = [_jpeg2000(stored[k], tmp_path / "scratch.dcm") for k in _SHUFFLED]

    def compress(header: Any, kept: int = 8) -> None:
        header.file_meta.TransferSyntaxUID = packed[0][1]
        header.PixelData = encapsulate([p[0] for p in packed[:kept]])
        header["PixelData"].is_undefined_length = True

    frames = [_groups(k, scaling=(str(k + 1), "-5")) for k in _SHUFFLED]
    size = {"Rows": 40, "Columns": 48, "PixelRepresentation": 0}
    path = _write(tmp_path / "e.dcm", frames, change=compress, **size)
    inverted = _write(tmp_path / "i.dcm", frames, change=compress, PhotometricInterpretation="MONOCHROME1", **size)
    expected = stored.transpose(2, 1, 0) * (np.arange(8) + 1.0) - 5.0
    for written in (path, inverted):  # of display alone
        np.testing.assert_array_equal(read_image(written).values, expected)
    _refused(
        _write(tmp_path / "few.dcm", frames, change=lambda h: compress(h, 5), **size),
        "claims 8 frames, the file holds 5",
    )
    _refused(_write(tmp_path / "size.dcm", frames, change=compress, **(size | {"Rows": 41})), "another size|decoded")
    path.write_bytes(path.read_bytes()[:-300])
    _refused(path, "damaged|cut short")


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
    ({"PlaneOrientationSequence": _item(ImageOrientationPatient=_UNIT)}, "stacked along (0.00, 0.00, 1.00)"),
    ({"PixelMeasuresSequence": _item(PixelSpacing=["2", "2"])}, "voxels of 2 x 2 mm"),
]


@pytest.mark.parametrize(("other", "told"), _CHOICES, ids=[told for _, told in _CHOICES])
def test_several_images_in_a_file_are_listed_and_chosen_from(tmp_path: Path, other: dict[str, Any], told: str) -> None:
    moved = other.pop("at", 0.0) if "at" in other else 0.0
    both = [g for k in _SHUFFLED for g in (_groups(k), _groups(k, at=k + moved, scaling=("3", "0"), **other))]
    path = _write(tmp_path / "e" / "e.dcm", both)
    message = _refused(path, "the file holds several echoes, image types, orientations, stacks or time p", InputError)
    lines = message.splitlines()[1:]
    assert [line.split(":")[0].strip() for line in lines] == ["111111/1", "111111/2"]
    assert "8 slices of 5 x 6" in lines[0]
    own = 1 if told in lines[0] else 2
    assert told in lines[own - 1]
    if "PlaneOrientationSequence" not in other:  # there the slices are sheared
        np.testing.assert_array_equal(read_image(path, series=f"111111/{own}").values, 3.0 * _STORED)
    np.testing.assert_array_equal(read_image(path.parent, series=f"111111/{3 - own}").values, _STORED)
    _refused(path, "fits 0 of the DICOM series", InputError, series="111111/3")
    _refused(path.parent, "the folder holds several", InputError)


def test_a_long_list_is_shortened_and_all_of_it_can_be_chosen(tmp_path: Path) -> None:
    times = [_groups(k, time=t, scaling=(str(t), "0")) for t in range(1, 61) for k in (2, 0, 3, 1)]
    message = _refused(_write(tmp_path / "e.dcm", times), "and 20 more", InputError)
    assert len(message.splitlines()) == 42
    np.testing.assert_array_equal(read_image(tmp_path / "e.dcm", series="111111/60").values, 60.0 * _STORED[:, :, :4])


def test_labels_that_go_with_the_place_part_nothing(tmp_path: Path) -> None:
    each = [_groups(k, stack=str(k), time=k + 1) for k in _SHUFFLED]
    np.testing.assert_array_equal(read_image(_write(tmp_path / "each.dcm", each)).values, _STORED)


def test_private_groups_beside_the_standard_ones_do_not_count(tmp_path: Path) -> None:
    """Philips repeats the position, moved by half a voxel, and adds a scale of its own, in private elements."""
    frames = [_groups(k, indices=(k + 1, 1, 1)) for k in _SHUFFLED]  # indices in another order than they say, too
    for k, groups in zip(_SHUFFLED, frames, strict=True):
        block = groups.private_block(0x2005, "Philips MR Imaging DD 005", create=True)
        private = _item(**_place(k + 0.5), ImageOrientationPatient=_UNIT, RescaleSlope="17", PatientName="Doe^Jane")
        private.private_block(0x2005, "Philips MR Imaging DD 001", create=True).add_new(0x0E, "FL", 0.01 * k)
        block.add_new(0x0F, "SQ", [private])
    image = read_image(_write(tmp_path / "e.dcm", frames))
    np.testing.assert_array_equal(image.values, _STORED)
    np.testing.assert_allclose(image.grid.origin_mm, _ORIGIN, atol=1e-5)


@pytest.mark.parametrize("stored_as", [LegacyConvertedEnhancedMRImageStorage, EnhancedCTImageStorage])
def test_converted_mr_and_ct_are_read(tmp_path: Path, stored_as: Any) -> None:
    echoes = {0: "6.3", 1: "80"}
    frames = []
    for echo, told in echoes.items():
        converted = {"UnassignedPerFrameConvertedAttributesSequence": _item(EchoTime=told, EchoNumbers=echo + 1)}
        macros = {"MRImageFrameTypeSequence": None, "PlaneOrientationSequence": _item(**_ORIENTATION)}
        macros |= {"CTImageFrameTypeSequence": _item(FrameType=["ORIGINAL", "PRIMARY", "AXIAL"])}
        macros |= {"PixelMeasuresSequence": _item(**_MEASURES)}
        frames += [_groups(k, scaling=(str(echo + 1), "0"), **macros, **converted) for k in _SHUFFLED]
    path = _write(tmp_path / "e.dcm", frames, shared=Dataset(), SOPClassUID=stored_as)
    assert "echo time 80 ms, echo 2, image type AXIAL" in _refused(path, "several", InputError)
    np.testing.assert_array_equal(read_image(path, series="/2").values, 2.0 * _STORED)


def test_an_image_in_several_files(tmp_path: Path) -> None:
    single = tmp_path / "single"  # as some scanners do: enhanced files of one frame
    for k in range(_SHAPE[2]):
        _write(single / f"{k * 5 % 7}{k}.dcm", [_groups(k)])
    np.testing.assert_array_equal(read_image(single).values, _STORED)
    _refused(single / "00.dcm", "Give its folder instead")
    assert not is_multiframe(single / "00.dcm")
    parts = tmp_path / "parts"  # one image, stored in two files
    for name, held in (("b", _SHUFFLED[:4]), ("a", _SHUFFLED[4:])):
        frames = [_groups(k) for k in held]
        _write(parts / f"{name}.dcm", frames, ConcatenationUID="1.2.9", InConcatenationTotalNumber=2)
    np.testing.assert_array_equal(read_image(parts).values, _STORED)
    _refused(parts / "a.dcm", "Give its folder instead")
    (parts / "a.dcm").unlink()
    _refused(parts, "stored in 2 files, of which 1 are here")


def test_a_folder_with_a_file_for_each_time_point(tmp_path: Path) -> None:
    for t in (1, 2):
        _write(tmp_path / "e" / f"{t}.dcm", [_groups(k, time=t) for k in _SHUFFLED], offset=t)
    message = _refused(tmp_path / "e", "the folder holds several", InputError)
    assert re.findall(r"time point (\d)", message) == ["1", "2"]
    np.testing.assert_array_equal(read_image(tmp_path / "e", series="111111/2").values, _STORED + 2.0)
    for t in (1, 2):
        _write(tmp_path / "e" / f"{t}.dcm", offset=t)
    _refused(tmp_path / "e", r"8 slices lie where another one does .*1\.dcm \(frame 2\).*Two acquisitions or copies")
    np.testing.assert_array_equal(read_image(tmp_path / "e" / "2.dcm").values, _STORED + 2.0)


def test_enhanced_and_classic_series_in_one_folder(tmp_path: Path) -> None:
    folder = _classic(tmp_path / "s", [("2", "0")] * _SHAPE[2])
    _write(folder / "e.dcm", SeriesInstanceUID=_SERIES[:-6] + "333333")
    _refused(folder, "2 DICOM series", InputError)
    np.testing.assert_array_equal(read_image(folder, series="111111").values, 2.0 * _STORED)
    np.testing.assert_array_equal(read_image(folder, series="333333").values, _STORED)


def _without(name: str, of: int = 3) -> list[Dataset]:
    return [_groups(k, **({name: None} if k == of else {})) for k in _SHUFFLED]


def _strip(name: str) -> Callable[[Any], None]:
    return lambda header: delattr(header.SharedFunctionalGroupsSequence[0], name)


def _cut(header: Any) -> None:
    header.PixelData = header.PixelData[:-20]


_PLACED = [_groups(k) for k in range(8)]
_REFUSALS: dict[str, tuple[dict[str, Any], str]] = {
    "gap": ({"frames": [g for g in _PLACED if g.slice_shown != 4]}, r"1 gaps .*\(frame 4\) and .*\(frame 5\)"),
    "twice": ({"frames": [*_ALL, _groups(4)]}, r"1 slices lie where .*frame 8\) and .*frame 9.*which frame belongs"),
    "uneven": ({"frames": [_groups(k, at=k + 0.3 * (k == 4)) for k in range(8)]}, "not evenly stacked"),
    "one group": ({"frames": [*_ALL[:-1]], "NumberOfFrames": 8}, "claims 8 frames and describes 7"),
    "no groups": ({"PerFrameFunctionalGroupsSequence": None}, "claims 8 frames and describes 0"),
    "position": ({"frames": _without("PlanePositionSequence")}, "without ImagePositionPatient in .* of frame 1"),
    "orientation": ({"change": _strip("PlaneOrientationSequence")}, "without ImageOrientationPatient in .* frame 1"),
    "spacing": ({"change": _strip("PixelMeasuresSequence")}, "without PixelSpacing in the functional groups"),
    "scaling": ({"frames": _without("PixelValueTransformationSequence", 0)}, "without RescaleSlope, .* of frame 2"),
    "slope": ({"frames": [*_ALL[:-1], _groups(4, scaling=("1e999", "0"))]}, "frame 8: .*not finite"),
    "no width": (
        {"frames": [_groups(k, PixelMeasuresSequence=_item(PixelSpacing=["0", "1"])) for k in range(8)]},
        "5 x 6 voxels of 1 x 0 mm; all must be positive",
    ),
    "pixels": ({"change": _cut}, "cut short: 8 frames of 5 x 6 voxels need 480 bytes, it holds 460"),
    "no pixels": ({"change": lambda header: delattr(header, "PixelData")}, "without pixels"),
    "terabytes": ({"Rows": 65535, "Columns": 65535}, "65535 x 65535 x 8 voxels, about 128.0 GiB"),
    "frames": ({"NumberOfFrames": 2**31 - 1}, "claims 2147483647 frames and describes 8"),
    "colour": ({"PhotometricInterpretation": "RGB", "SamplesPerPixel": 3}, "in colour"),
    "mask": ({"SOPClassUID": SegmentationStorage}, "of a kind that is not read.*dcm2niix"),
    "one": ({"frames": [_groups(0), _groups(1, stack="2")]}, "a single slice|at least 4 slices"),
}


@pytest.mark.parametrize("name", _REFUSALS)
def test_what_cannot_be_an_image_is_refused(tmp_path: Path, name: str) -> None:
    options, message = _REFUSALS[name]
    _refused(_write(tmp_path / "e" / "e.dcm", **options), message)
    with pytest.raises(ImageFileError, match=message):
        read_image(tmp_path / "e")


def test_a_compression_that_nothing_here_decodes_is_refused(tmp_path: Path) -> None:
    def compress(header: Any) -> None:
        header.file_meta.TransferSyntaxUID = HTJ2KLossless
        header.PixelData = encapsulate([bytes(100)] * 8)
        header["PixelData"].is_undefined_length = True

    _refused(_write(tmp_path / "e.dcm", change=compress), "cannot be decoded .*dcm2niix")


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, RLELossless], ids=lambda s: s.name)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, syntax: Any) -> None:
    whole = _write(tmp_path / "e.dcm", syntax=syntax).read_bytes()
    for kept in np.linspace(0, len(whole) - 12, 60).astype(int):
        (tmp_path / "e.dcm").write_bytes(whole[:kept])
        _refused(tmp_path / "e.dcm", "damaged|cut short")


@pytest.mark.parametrize("enhanced", [True, False], ids=["enhanced", "classic"])
def test_bytes_that_are_damaged_give_no_other_error(tmp_path: Path, enhanced: bool) -> None:
    place = tmp_path / "s"
    path = _write(place / "e.dcm") if enhanced else _classic(place, [("1", "0")] * 8) / "7.dcm"
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
    whole = (_classic(tmp_path / "s", [("1", "0")] * 8) / "7.dcm").read_bytes()  # the last in space: no gap
    for kept in (140, 175, 300, 345, 360):
        (tmp_path / "s" / "7.dcm").write_bytes(whole[:kept])
        _refused(tmp_path / "s", r"7\.dcm: .*(damaged|cut short)")


def test_what_a_header_holds_by_mistake_is_not_quoted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    slopes = {"frames": [_groups(k, scaling=("12345678", "0")) for k in _SHUFFLED]}
    for options in (slopes, {"NumberOfFrames": 12345678}):
        path = _write(tmp_path / "e.dcm", **options)
        path.write_bytes(path.read_bytes().replace(b"12345678", b"Doe^Jane"))
        _refused(path, "damaged")
    assert "Doe" not in caplog.text
