"""One physical volume, written in many ways, is read as the same values at the same points."""

from __future__ import annotations

import gzip
import itertools
from pathlib import Path

import nibabel
import numpy as np
import pydicom
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from dvc.errors import ImageFileError, InputError
from dvc.images.image import Grid
from dvc.io.images.read import read_image
from tests.dicomfiles import write_classic

_SHAPE = (6, 7, 9)
_SPACING = (1.5, 1.0, 2.5)
_CENTRE = np.array([-40.0, 25.0, 310.0])
_ROTATIONS = {
    "straight": np.eye(3),
    "oblique": Rotation.from_euler("xyz", [20.0, -35.0, 10.0], degrees=True).as_matrix(),
}
_CODES = ["RAS", "LAS", "LPS", "RPI", "PSR", "IAL", "SLA", "ASR"]
_MESSAGE_LIMIT = 700


def _truth(points_mm: np.ndarray) -> np.ndarray:
    """A smooth function of the place that no flip, permutation or shift of an axis leaves alone."""
    x, y, z = np.moveaxis((points_mm - _CENTRE) / 10.0, -1, 0)
    return np.sin(x) + 0.7 * y + 0.2 * y * y + np.exp(0.3 * z) + 0.4 * x * z


def _grid(direction: np.ndarray) -> Grid:
    middle = (np.array(_SHAPE) - 1) / 2.0
    return Grid(_SHAPE, _SPACING, _CENTRE - direction @ (np.array(_SPACING) * middle), direction)


def _ras(grid: Grid) -> np.ndarray:
    return np.diag([-1.0, -1.0, 1.0, 1.0]) @ grid.affine


def _written(path: Path, grid: Grid, code: str = "LPS") -> Path:
    """The volume in a file, its voxels ordered as ``code`` (NIfTI) by libraries other than the one tested."""
    values = _truth(grid.points()).astype(np.float32)
    if ".nii" in path.name:
        image = nibabel.Nifti1Image(values, _ras(grid))
        have = nibabel.orientations.io_orientation(image.affine)
        want = nibabel.orientations.axcodes2ornt(tuple(code))
        image = image.as_reoriented(nibabel.orientations.ornt_transform(have, want))
        image.set_qform(image.affine, code=1)
        image.set_sform(image.affine, code=1)
        image.header.set_xyzt_units("mm")
        nibabel.save(image, path)
    else:
        image = sitk.GetImageFromArray(values.transpose(2, 1, 0))
        image.SetSpacing(grid.spacing_mm.tolist())
        image.SetOrigin(grid.origin_mm.tolist())
        image.SetDirection(grid.direction.ravel().tolist())
        sitk.WriteImage(image, str(path), useCompression="c" in path.stem)
    return path


@pytest.mark.parametrize("rotation", _ROTATIONS)
@pytest.mark.parametrize(
    ("name", "code"),
    [(f"a.{s}", c) for s, c in itertools.product(("nii", "nii.gz"), _CODES)]
    + [(f"{n}.{s}", "LPS") for n, s in itertools.product(("plain", "c"), ("nrrd", "nhdr", "mha", "mhd"))],
)
def test_every_format_gives_the_same_values_at_the_same_points(
    tmp_path: Path, rotation: str, name: str, code: str
) -> None:
    grid = _grid(_ROTATIONS[rotation])
    image = read_image(_written(tmp_path / name, grid, code))
    # single precision of values of order 5, and of affines in NIfTI headers (300 mm): 3e-5 mm, slope 1 per mm
    np.testing.assert_allclose(image.values, _truth(image.grid.points()), atol=1e-5)
    low, high = grid.bounds_mm()
    np.testing.assert_allclose(image.grid.bounds_mm(), (low, high), atol=1e-4)
    assert not image.values.flags.writeable


@pytest.mark.parametrize("rotation", _ROTATIONS)
@pytest.mark.parametrize("code", _CODES)
def test_flips_and_permutations_are_equal_once_turned_toward_lps(tmp_path: Path, rotation: str, code: str) -> None:
    grid = _grid(_ROTATIONS[rotation])
    turned = read_image(_written(tmp_path / "a.nii.gz", grid, code)).toward_lps()
    expected = _truth(grid.toward_lps().points()).astype(np.float32)
    np.testing.assert_array_equal(turned.values, expected)
    assert turned.grid.same_as(grid.toward_lps(), tolerance_voxels=1e-4)


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a.nrrd", "a.mha"])
def test_reading_agrees_with_simpleitk(tmp_path: Path, name: str) -> None:
    path = _written(tmp_path / name, _grid(_ROTATIONS["oblique"]), "PSR")
    image, other = read_image(path), sitk.ReadImage(str(path))
    np.testing.assert_array_equal(image.values, sitk.GetArrayFromImage(other).transpose(2, 1, 0))
    np.testing.assert_allclose(image.grid.origin_mm, other.GetOrigin(), atol=1e-4)
    np.testing.assert_allclose(image.grid.direction.ravel(), other.GetDirection(), atol=1e-6)
    np.testing.assert_allclose(image.grid.spacing_mm, other.GetSpacing(), atol=1e-6)


@pytest.mark.parametrize("suffix", ["nii", "nii.gz", "nrrd", "mha"])
class TestRefusedValues:
    """Images whose values or sizes make no sense to register."""

    def _save(self, tmp_path: Path, suffix: str, values: np.ndarray) -> Path:
        path = tmp_path / f"a.{suffix}"
        if suffix.startswith("nii"):
            nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), path)
        else:
            sitk.WriteImage(sitk.GetImageFromArray(values.T), str(path))
        return path

    def test_constant(self, tmp_path: Path, suffix: str) -> None:
        path = self._save(tmp_path, suffix, np.full((5, 5, 5), 7.0, np.float32))
        with pytest.raises(ImageFileError, match=r"constant \(all voxels are 7\)"):
            read_image(path)

    @pytest.mark.parametrize("shape", [(8, 8), (8, 8, 1), (8, 8, 3)])
    def test_too_few_slices(self, tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
        path = self._save(tmp_path, suffix, np.arange(np.prod(shape), dtype=np.float32).reshape(shape))
        with pytest.raises(ImageFileError, match=r"at least 4 slices|3D image is needed"):
            read_image(path)

    def test_not_finite(self, tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture) -> None:
        values = np.arange(5 * 6 * 7, dtype=np.float32).reshape(5, 6, 7)
        values[2, 3, 4], values[4, 0, 1] = np.nan, -np.inf
        path = self._save(tmp_path, suffix, values)
        with pytest.raises(InputError, match=r"2 of 210 voxels .* first at index \(2, 3, 4\)"):
            read_image(path)
        caplog.clear()
        image = read_image(path, allow_missing=True)
        assert np.argwhere(image.missing).tolist() == [[2, 3, 4], [4, 0, 1]]
        assert "2 of 210 voxels" in caplog.text
        np.testing.assert_array_equal(image.values[~image.missing], values[np.isfinite(values)])

    def test_nothing_finite(self, tmp_path: Path, suffix: str) -> None:
        path = self._save(tmp_path, suffix, np.full((5, 5, 5), np.nan, np.float32))
        with pytest.raises(ImageFileError, match="no voxel has a finite value"):
            read_image(path, allow_missing=True)

    def test_beyond_single_precision(self, tmp_path: Path, suffix: str) -> None:
        values = np.arange(125, dtype=np.float64).reshape(5, 5, 5)
        values[1, 1, 1] = 1e300
        with pytest.raises(InputError, match=r"1 of 125 voxels .* \(1, 1, 1\)"):
            read_image(self._save(tmp_path, suffix, values))


@pytest.mark.parametrize("suffix", ["nii", "nii.gz", "nrrd", "mha", "nhdr", "mhd"])
def test_size_is_limited_from_the_header(tmp_path: Path, suffix: str) -> None:
    path = _written(tmp_path / f"a.{suffix}", _grid(np.eye(3)))
    read_image(path, max_bytes=4 * 6 * 7 * 9)
    with pytest.raises(ImageFileError, match=r"6 x 7 x 9 voxels, about .* the limit is"):
        read_image(path, max_bytes=4 * 6 * 7 * 9 - 1)


@pytest.mark.parametrize("suffix", ["nii", "nii.gz", "nrrd", "mha"])
@pytest.mark.parametrize("kept", [0.0, 0.02, 0.6, 0.99])
def test_a_file_cut_short_is_refused(tmp_path: Path, suffix: str, kept: float) -> None:
    for name in (f"plain.{suffix}", f"c.{suffix}"):
        path = _written(tmp_path / name, _grid(np.eye(3)))
        content = path.read_bytes()
        path.write_bytes(content[: int(kept * len(content))])
        with pytest.raises(ImageFileError, match=rf"{name}: "):
            read_image(path)


def test_a_whole_stream_of_too_few_voxels_is_refused(tmp_path: Path) -> None:
    path = _written(tmp_path / "a.nii.gz", _grid(np.eye(3)))
    path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes())[:-4]))
    with pytest.raises(ImageFileError, match=r"incomplete: the header needs 1864 bytes .* has 1860"):
        read_image(path)


@pytest.mark.parametrize("suffix", ["nii.gz", "nrrd", "mha"])
def test_damaged_compressed_voxels_are_refused(tmp_path: Path, suffix: str) -> None:
    path = _written(tmp_path / f"c.{suffix}", _grid(np.eye(3)))
    content = bytearray(path.read_bytes())
    content[-30] ^= 0xFF
    path.write_bytes(bytes(content))
    with pytest.raises(ImageFileError, match=r"damaged|incomplete"):
        read_image(path)


@pytest.mark.parametrize("suffix", ["nii.gz", "nrrd", "mha"])
def test_a_wrong_checksum_is_refused(tmp_path: Path, suffix: str) -> None:
    path = _written(tmp_path / f"c.{suffix}", _grid(np.eye(3)))
    content = bytearray(path.read_bytes())
    # gzip ends with CRC-32 and length, zlib (MetaImage) with Adler-32
    content[-6 if suffix != "mha" else -2] ^= 0x01
    path.write_bytes(bytes(content))
    with pytest.raises(ImageFileError, match="damaged"):
        read_image(path)


@pytest.mark.parametrize("suffix", ["nii", "nii.gz", "nrrd", "mha"])
def test_voxels_beyond_the_header_are_refused(tmp_path: Path, suffix: str) -> None:
    path = _written(tmp_path / f"plain.{suffix}", _grid(np.eye(3)))
    if suffix == "nii.gz":
        path.write_bytes(gzip.compress(gzip.decompress(path.read_bytes()) + bytes(9999)))
    else:
        path.write_bytes(path.read_bytes() + bytes(9999))
    with pytest.raises(ImageFileError, match="do not match"):
        read_image(path)


def test_unknown_kinds_of_file_are_refused_with_a_list(tmp_path: Path) -> None:
    for name in ("a.gipl", "a.vtk", "a.png", "a.img", "a"):
        (tmp_path / name).write_bytes(b"x" * 200)
        with pytest.raises(ImageFileError, match=r"Supported: \.nii, \.nii\.gz, .*DICOM"):
            read_image(tmp_path / name)
    with pytest.raises(InputError, match="no such file"):
        read_image(tmp_path / "missing.nii")


def test_options_that_do_not_fit_the_file_are_refused(tmp_path: Path) -> None:
    path = _written(tmp_path / "a.nrrd", _grid(np.eye(3)))
    with pytest.raises(InputError, match="for DICOM files and folders"):
        read_image(path, series="123")
    with pytest.raises(InputError, match="for 4D files"):
        read_image(tmp_path, volume=1)
    with pytest.raises(ImageFileError, match="volume=1 does not exist"):
        read_image(path, volume=1)


@pytest.mark.parametrize("suffix", ["nii", "nrrd", "mha"])
def test_messages_are_short_enough_to_be_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"\xff\x00garbage" * 5000)
    with pytest.raises(ImageFileError) as caught:
        read_image(path)
    assert len(str(caught.value)) - len(str(path)) < _MESSAGE_LIMIT


@pytest.mark.parametrize(
    ("name", "volume", "shape", "spacing"),
    [
        ("leg-mr/fat.nii.gz", None, (320, 320, 23), (1.5, 1.5, 6.0)),
        ("brain-pair/example4d.nii.gz", 1, (128, 96, 24), (2.0, 2.0, 2.2)),
        (
            "knee-labels/SAG_3D_DESS_RIGHT_bones_cart_men_fib-label.nrrd",
            None,
            (384, 384, 160),
            (0.3646, 0.3646, 0.7),
        ),
        ("lung-landmarks/3DCT_lung.mha", None, (115, 157, 129), (1.366, 1.366, 2.5)),
    ],
)
def test_real_files_agree_with_simpleitk(
    real_data: Path, name: str, volume: int | None, shape: tuple[int, ...], spacing: tuple[float, ...]
) -> None:
    image = read_image(real_data / name, volume=volume)
    other = sitk.ReadImage(str(real_data / name))
    if volume is not None:
        other = other[:, :, :, volume]
    assert image.grid.shape == shape
    np.testing.assert_allclose(image.grid.spacing_mm, spacing, atol=1e-4)
    np.testing.assert_array_equal(image.values, sitk.GetArrayViewFromImage(other).transpose(2, 1, 0))
    theirs = Grid(shape, other.GetSpacing(), other.GetOrigin(), np.reshape(other.GetDirection(), (3, 3)))
    assert image.grid.same_as(theirs, tolerance_voxels=1e-3)


def test_a_real_4d_file_is_refused_with_its_number_of_volumes(real_data: Path) -> None:
    with pytest.raises(ImageFileError, match=r"contains 2 volumes; one is needed.*volume=N.* with N from 0 to 1"):
        read_image(real_data / "brain-pair" / "example4d.nii.gz")


@pytest.mark.parametrize(
    ("edge", "says"),
    [
        (0.8, None), ((0.3, 0.3, 10.0), None),
        (0.0008, r"0\.0\d+ mm across.*in metres"), (800.0, r"\d m across.*in micrometres"),
        ((0.0016, 0.0016, 1.6), r"voxels are 0\.0016 x 0\.0016 x 1\.6 mm.* factor of 1000\..* unit, such as metres"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("ending", [".nii.gz", ".nrrd", ".mha"])
def test_a_size_that_no_body_part_has_is_refused_with_its_likely_unit(tmp_path, edge, says, ending):
    sitk_image = sitk.GetImageFromArray(np.random.default_rng(1).normal(50.0, 1.0, (20, 21, 22)).astype(np.float32))
    sitk_image.SetSpacing(np.broadcast_to(edge, 3).tolist())
    path = tmp_path / f"image{ending}"
    sitk.WriteImage(sitk_image, str(path))
    if says is None:
        assert read_image(path).grid.shape == (22, 21, 20)
        return
    with pytest.raises(ImageFileError, match=says) as refused:
        read_image(path)
    assert path.name in str(refused.value)


def test_a_size_that_no_body_part_has_is_refused_in_dicom(tmp_path):
    series = tmp_path / "series"
    write_classic(series, [("1", "0")] * 8)
    for path in series.iterdir():
        one = pydicom.dcmread(path)
        one.PixelSpacing = ["800", "800"]
        one.ImagePositionPatient = [1000.0 * float(v) for v in one.ImagePositionPatient]
        one.save_as(path)
    with pytest.raises(ImageFileError, match=r"\d m across.*in micrometres"):
        read_image(series)
