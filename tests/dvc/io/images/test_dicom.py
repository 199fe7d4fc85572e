"""DICOM series: put together by position, refused where slices are missing, doubled, mixed or damaged."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from pydicom.dataset import FileDataset, FileMetaDataset
from pydicom.uid import (
    EnhancedMRImageStorage,
    ExplicitVRBigEndian,
    ExplicitVRLittleEndian,
    ImplicitVRLittleEndian,
    MRImageStorage,
    RLELossless,
)
from scipy.spatial.transform import Rotation

import dvc
from dvc.errors import ImageFileError, InputError
from dvc.io.images.read import read_image

_SERIES = "1.2.826.0.1.3680043.8.498.111111"
_OTHER = "1.2.826.0.1.3680043.8.498.222222"
_ROWS, _COLUMNS, _SLICES = 6, 5, 8
_SPACING = (0.8, 1.25, 4.0)  # between columns, rows, slices
_TURN = Rotation.from_euler("xyz", [20.0, -35.0, 10.0], degrees=True).as_matrix()
_ORIGIN = np.array([-30.0, 12.0, 250.0])
_PIXELS_CUT = (ExplicitVRLittleEndian, 0.97)
_STORED = np.random.default_rng(2).integers(0, 4000, (_COLUMNS, _ROWS, _SLICES)).astype(np.int16)


def _write(
    folder: Path,
    k: int,
    *,
    name: str | None = None,
    change: Callable[[Any], None] | None = None,
    syntax: Any = ExplicitVRLittleEndian,
    at: float | None = None,
    **fields: Any,
) -> Path:
    """One slice of an oblique stack; ``at`` moves it along the normal, in slices."""
    folder.mkdir(exist_ok=True)
    meta = FileMetaDataset()
    meta.MediaStorageSOPClassUID = fields.get("SOPClassUID", MRImageStorage)
    meta.MediaStorageSOPInstanceUID = f"1.2.3.{k + 1}"
    meta.TransferSyntaxUID = syntax if syntax != RLELossless else ExplicitVRLittleEndian
    slice_ = FileDataset("", {}, file_meta=meta, preamble=bytes(128))
    position = _ORIGIN + _TURN[:, 2] * _SPACING[2] * (k if at is None else at)
    big = syntax == ExplicitVRBigEndian
    values: dict[str, Any] = {
        "SOPClassUID": MRImageStorage,
        "SOPInstanceUID": f"1.2.3.{k + 1}",
        "SeriesInstanceUID": _SERIES,
        "PatientName": "Doe^Jane",
        "PatientID": "ID-12345",
        "ImageType": ["ORIGINAL", "PRIMARY", "M"],
        "Modality": "MR",
        "EchoTime": "6.3",
        "EchoNumbers": 1,
        "InstanceNumber": 100 - k,  # against the order in space: numbers must not count
        "ImagePositionPatient": [f"{v:.6f}" for v in position],
        "ImageOrientationPatient": [f"{v:.8f}" for v in (*_TURN[:, 0], *_TURN[:, 1])],
        "PixelSpacing": [str(_SPACING[1]), str(_SPACING[0])],
        "Rows": _ROWS,
        "Columns": _COLUMNS,
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "BitsAllocated": 16,
        "BitsStored": 16,
        "HighBit": 15,
        "PixelRepresentation": 1,
    }
    for key, value in (values | fields).items():
        if value is not None:
            setattr(slice_, key, value)
    slice_.PixelData = _STORED[:, :, k].T.astype(">i2" if big else "<i2").tobytes()
    slice_["PixelData"].VR = "OW"
    if change is not None:
        change(slice_)
    if syntax == RLELossless:
        slice_.compress(RLELossless)
    path = folder / (name or f"slice{(k * 5) % 17:02d}.dcm")  # names are no order either
    pydicom.dcmwrite(
        path,
        slice_,
        enforce_file_format=True,
        little_endian=None if not big else False,
        implicit_vr=None if not big else False,
    )
    return path


def _series(folder: Path, slices: range = range(_SLICES), **options: Any) -> Path:
    for k in slices:
        _write(folder, k, **options)
    return folder


@pytest.mark.parametrize(
    "syntax",
    [ExplicitVRLittleEndian, ImplicitVRLittleEndian, ExplicitVRBigEndian, RLELossless],
    ids=lambda s: s.name,
)
def test_a_series_is_put_together_by_position(tmp_path: Path, syntax: Any) -> None:
    image = read_image(_series(tmp_path / "s", syntax=syntax))
    np.testing.assert_array_equal(image.values, _STORED)
    np.testing.assert_allclose(image.grid.spacing_mm, _SPACING, atol=1e-5)
    np.testing.assert_allclose(image.grid.origin_mm, _ORIGIN, atol=1e-5)
    np.testing.assert_allclose(image.grid.direction, _TURN, atol=1e-6)


def test_the_grid_agrees_with_simpleitk(tmp_path: Path) -> None:
    image = read_image(_series(tmp_path / "s"))
    reader = sitk.ImageSeriesReader()
    reader.SetFileNames(reader.GetGDCMSeriesFileNames(str(tmp_path / "s")))
    other = reader.Execute()
    np.testing.assert_array_equal(sitk.GetArrayFromImage(other).transpose(2, 1, 0), image.values)
    np.testing.assert_allclose(other.GetOrigin(), image.grid.origin_mm, atol=1e-6)
    np.testing.assert_allclose(other.GetSpacing(), image.grid.spacing_mm, atol=1e-5)
    np.testing.assert_allclose(np.reshape(other.GetDirection(), (3, 3)), image.grid.direction, atol=1e-6)


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, RLELossless], ids=lambda s: s.name)
def test_slope_and_intercept_are_those_of_each_slice(tmp_path: Path, syntax: Any) -> None:
    for k in range(_SLICES):
        _write(tmp_path / "s", k, syntax=syntax, RescaleSlope=str(0.5 * (k + 1)), RescaleIntercept="-7")
    expected = _STORED * (0.5 * (np.arange(_SLICES) + 1)) - 7
    np.testing.assert_array_equal(read_image(tmp_path / "s").values, expected)


@pytest.mark.parametrize("compressor", ["JPEG", "JPEG2000"])
def test_compressed_slices_are_decoded_and_rescaled(tmp_path: Path, compressor: str) -> None:
    stored = np.random.default_rng(3).integers(0, 4000, (4, 40, 48)).astype(np.uint16)
    writer = sitk.ImageFileWriter()
    writer.UseCompressionOn()
    writer.SetCompressor(compressor)
    for k in range(4):
        image = sitk.GetImageFromArray(stored[k : k + 1])
        image.SetMetaData("0008|0060", "MR")
        image.SetMetaData("0008|0016", MRImageStorage)
        path = tmp_path / f"{k}.dcm"
        writer.SetFileName(str(path))
        writer.Execute(image)
        header = pydicom.dcmread(path)
        assert header.file_meta.TransferSyntaxUID.is_encapsulated
        header.SeriesInstanceUID = _SERIES
        header.ImagePositionPatient = ["0", "0", str(3 * k)]
        header.ImageOrientationPatient = ["1", "0", "0", "0", "1", "0"]
        header.PixelSpacing = ["0.5", "0.5"]
        header.RescaleSlope, header.RescaleIntercept = "2", "-5"
        header.save_as(path)
    np.testing.assert_array_equal(read_image(tmp_path).values, stored.transpose(2, 1, 0) * 2.0 - 5.0)
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(ImageFileError, match=r"3\.dcm: .*(damaged|incomplete)"):
        read_image(tmp_path)


@pytest.mark.parametrize("missing", [1, 3, 6])
def test_a_gap_is_refused_by_position(tmp_path: Path, missing: int) -> None:
    folder = tmp_path / "s"
    for number, k in enumerate(k for k in range(_SLICES) if k != missing):
        _write(folder, k, InstanceNumber=number + 1)  # the numbers show no gap
    with pytest.raises(ImageFileError, match=r"slices are missing.* 1 gaps .* 4 mm; the first, of 8 mm"):
        read_image(folder)


def test_numbers_with_gaps_do_not_matter(tmp_path: Path) -> None:
    folder = tmp_path / "s"
    for k in range(_SLICES):
        _write(folder, k, InstanceNumber=1 + 8 * k)
    np.testing.assert_array_equal(read_image(folder).values, _STORED)


@pytest.mark.parametrize("doubled", [0, 4, 7])
def test_a_duplicate_is_refused_by_position(tmp_path: Path, doubled: int) -> None:
    folder = _series(tmp_path / "s")
    extra = _write(folder, doubled, name="extra.dcm", InstanceNumber=999)
    with pytest.raises(ImageFileError, match=rf"1 slices have the position of another slice .*{extra.name}"):
        read_image(folder)


def test_uneven_and_tilted_stacks_are_refused(tmp_path: Path) -> None:
    for k in range(_SLICES):
        _write(tmp_path / "uneven", k, at=k + (0.3 if k == 4 else 0.0))
        position = _ORIGIN + _TURN[:, 2] * 4.0 * k + _TURN[:, 1] * 0.5 * k
        _write(tmp_path / "tilted", k, ImagePositionPatient=[f"{v:.6f}" for v in position])
    for name in ("uneven", "tilted"):
        with pytest.raises(ImageFileError, match="not evenly stacked"):
            read_image(tmp_path / name)


def test_mixed_series_are_listed_and_chosen_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = _series(tmp_path / "s")
    for k in range(_SLICES):
        _write(folder, k, name=f"other{k}.dcm", SeriesInstanceUID=_OTHER, EchoTime="50", RescaleSlope="2")
    with pytest.raises(InputError, match="contains 2 DICOM series") as caught:
        read_image(folder)
    message = str(caught.value)
    assert "111111: 8 slices of 5 x 6, echo time 6.3 ms" in message
    assert "222222: 8 slices of 5 x 6, echo time 50 ms" in message
    assert "Doe" not in message
    assert "12345" not in message
    command = re.search(r"dvc\.write_image\(.*\)\)", message)
    assert command is not None
    monkeypatch.chdir(tmp_path)
    eval(command[0], {"dvc": dvc, "NAME": "222222"})  # the next step that is told works as it stands
    np.testing.assert_array_equal(read_image("one.nii.gz").values, 2 * _STORED)
    np.testing.assert_array_equal(read_image(folder, series="111111").values, _STORED)
    np.testing.assert_array_equal(read_image(folder, series=_OTHER).values, 2 * _STORED)
    for wrong in ("333333", "8.498", "/1"):
        with pytest.raises(InputError, match=r"matches \d of the DICOM series"):
            read_image(folder, series=wrong)


@pytest.mark.parametrize(
    ("fields", "told"),
    [
        ({"EchoTime": "80", "EchoNumbers": 2}, "echo time 80 ms, echo 2"),
        ({"ImageType": ["ORIGINAL", "PRIMARY", "P"]}, "image type P"),
        ({"ImageOrientationPatient": ["1", "0", "0", "0", "1", "0"]}, "stacked along (0.00, 0.00, 1.00)"),
    ],
    ids=["echoes", "image types", "orientations"],
)
def test_several_stacks_of_one_series(tmp_path: Path, fields: dict[str, Any], told: str) -> None:
    folder = _series(tmp_path / "s")
    for k in range(_SLICES):
        _write(folder, k, name=f"other{k}.dcm", **fields)
    with pytest.raises(InputError, match="several echoes, image types, orientations") as caught:
        read_image(folder)
    lines = str(caught.value).splitlines()[1:]
    assert [line.split(":")[0].strip() for line in lines] == ["111111/1", "111111/2"]
    own = 2 if told in lines[0] else 1
    assert told in lines[2 - own]
    np.testing.assert_array_equal(read_image(folder, series=f"111111/{own}").values, _STORED)


@pytest.mark.parametrize("syntax", [ExplicitVRLittleEndian, RLELossless], ids=lambda s: s.name)
@pytest.mark.parametrize("kept", [0.0, 0.2, 0.5, 0.97])
def test_a_slice_cut_short_is_refused(tmp_path: Path, syntax: Any, kept: float) -> None:
    folder = _series(tmp_path / "s", syntax=syntax)
    last = _write(folder, _SLICES - 1, syntax=syntax)  # the last one in space: it would leave no gap
    content = last.read_bytes()
    last.write_bytes(content[: int(kept * len(content))])
    message = "incomplete: 5 x 6 voxels need 60 bytes" if (syntax, kept) == _PIXELS_CUT else "(damaged|incomplete)"
    with pytest.raises(ImageFileError, match=rf"{last.name}: .*{message}"):
        read_image(folder)


def test_a_slice_with_more_voxels_than_its_header_describes_is_refused(tmp_path: Path) -> None:
    folder = _series(tmp_path / "s")
    last = _write(folder, _SLICES - 1)
    header = pydicom.dcmread(last)
    header.PixelData = 4 * header.PixelData
    header.save_as(last)
    with pytest.raises(ImageFileError, match=rf"{last.name}: the file has 4 x 6 x 5 values .* describes 6 x 5; it is"):
        read_image(folder)


def test_other_files_in_the_folder_are_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    folder = _series(tmp_path / "s")
    (folder / "README.txt").write_text("about these images")
    (folder / ".hidden").write_bytes(b"x")
    (folder / "sub").mkdir()
    report = _write(folder, 0, name="report", SOPClassUID="1.2.840.10008.5.1.4.1.1.88.11", Rows=None)
    assert report.exists()
    np.testing.assert_array_equal(read_image(folder).values, _STORED)
    assert "2 files are not DICOM images and were skipped" in caplog.text


def _frames(header: Any) -> None:
    header.NumberOfFrames = 3
    header.PixelData = header.PixelData * 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"SOPClassUID": EnhancedMRImageStorage}, r"claims 0 frames, but describes 0 \(functional groups\)"),
        ({"change": _frames}, "multi-frame.*dcm2niix"),
        ({"ImageType": ["ORIGINAL", "PRIMARY", "M", "MOSAIC"]}, "mosaic.*dcm2niix"),
        ({"PhotometricInterpretation": "RGB"}, "in colour"),
        ({"ImagePositionPatient": None}, "lacks ImagePositionPatient"),
        ({"SeriesInstanceUID": None, "PixelSpacing": None}, "lacks SeriesInstanceUID, PixelSpacing"),
        ({"ImageOrientationPatient": ["1", "0", "0", "1", "0", "0"]}, "not perpendicular"),
        ({"Rows": None}, "lacks Rows"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_slices_that_cannot_be_used(tmp_path: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ImageFileError, match=message) as caught:
        read_image(_series(tmp_path / "s", **options))
    assert "Doe" not in str(caught.value)


def test_too_few_slices_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageFileError, match="a single slice"):
        read_image(_series(tmp_path / "one", range(1)))
    with pytest.raises(ImageFileError, match="at least 4 slices"):
        read_image(_series(tmp_path / "three", range(3)))


def test_a_single_file_or_a_folder_without_images(tmp_path: Path) -> None:
    folder = _series(tmp_path / "s")
    for name in ("slice00.dcm", "noSuffix"):
        shutil.copy(folder / "slice00.dcm", tmp_path / name)
        with pytest.raises(ImageFileError, match="Pass its folder instead"):
            read_image(tmp_path / name)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ImageFileError, match="no DICOM images in this folder"):
        read_image(tmp_path / "empty")


def test_the_size_is_limited(tmp_path: Path) -> None:
    folder = _series(tmp_path / "s")
    with pytest.raises(ImageFileError, match="5 x 6 x 8 voxels"):
        read_image(folder, max_bytes=4 * 5 * 6 * 8 - 1)


def test_a_real_knee(real_data: Path, tmp_path: Path) -> None:
    image = read_image(real_data / "knee-dicom")
    assert image.grid.shape == (256, 256, 24)
    np.testing.assert_allclose(image.grid.spacing_mm, (0.625, 0.625, 4.0), atol=1e-4)
    reader = sitk.ImageSeriesReader()
    files = reader.GetGDCMSeriesFileNames(str(real_data / "knee-dicom"))
    # its own warning of uneven slices concerns 0.001 mm
    other = [sitk.GetArrayFromImage(sitk.ReadImage(name))[0].T for name in files]
    np.testing.assert_array_equal(image.values, np.stack(other, axis=-1))
    for k in (3, 14):
        point = sitk.ReadImage(files[k]).GetOrigin()
        np.testing.assert_allclose(image.grid.indices_of(np.array(point)), [0, 0, k], atol=2e-3)
    shutil.copytree(real_data / "knee-dicom", tmp_path / "knee", copy_function=shutil.copyfile)
    (tmp_path / "knee").chmod(0o755)
    (tmp_path / "knee" / Path(files[10]).name).unlink()
    with pytest.raises(ImageFileError, match="of 8 mm"):
        read_image(tmp_path / "knee")
