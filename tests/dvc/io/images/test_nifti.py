"""NIfTI headers: what is contradictory is refused, what is merely unusual is read and told."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import dvc
from dvc.errors import ImageFileError
from dvc.io.images.read import read_image

_AFFINE = np.diag([1.5, 1.0, 2.5, 1.0])
_AFFINE[:3, 3] = [10.0, -20.0, 30.0]
_VALUES = np.random.default_rng(4).normal(100.0, 20.0, (5, 6, 7)).astype(np.float32)


def _save(
    path: Path, change: Callable[[Any], None] | None = None, values: Any = _VALUES, affine: Any = _AFFINE
) -> Path:
    """Write with nibabel, then change fields of the header in place, as another program might."""
    image = nibabel.Nifti1Image(values, affine)
    image.set_qform(affine, code=1)
    image.set_sform(affine, code=1)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)
    if change is not None:
        content = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        header = nibabel.Nifti1Header(content[:348], check=False)
        change(header)
        content = header.binaryblock + content[348:]
        path.write_bytes(gzip.compress(content) if path.suffix == ".gz" else content)
    return path


def _sets(**fields: Any) -> Callable[[Any], None]:
    def change(header: Any) -> None:
        for name, value in fields.items():
            header[name] = value

    return change


def _qform(affine: np.ndarray) -> Callable[[Any], None]:
    return lambda header: header.set_qform(affine, code=1)


def test_qform_and_sform_that_disagree_are_refused(tmp_path: Path) -> None:
    turned = _AFFINE.copy()
    turned[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix() @ _AFFINE[:3, :3]
    with pytest.raises(ImageFileError, match="qform and sform differ: they place the image corners"):
        read_image(_save(tmp_path / "a.nii", _qform(turned)))


@pytest.mark.parametrize(("shift_mm", "refused"), [(0.04, False), (0.06, True)])
def test_a_small_fraction_of_a_voxel_is_allowed(tmp_path: Path, shift_mm: float, refused: bool) -> None:
    shifted = _AFFINE.copy()
    shifted[1, 3] += shift_mm  # along the axis of 1 mm voxels: 5 % of a voxel is the limit
    path = _save(tmp_path / "a.nii", _qform(shifted))
    if refused:
        with pytest.raises(ImageFileError, match="qform and sform"):
            read_image(path)
    else:
        np.testing.assert_allclose(read_image(path).grid.origin_mm, [-10, 20, 30], atol=1e-6)  # the sform's


def test_a_disagreement_at_the_far_corner_counts(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=(200, 5, 5)).astype(np.float32)
    turned = _AFFINE.copy()
    turned[:3, :3] = Rotation.from_euler("z", 0.05, degrees=True).as_matrix() @ _AFFINE[:3, :3]
    with pytest.raises(ImageFileError, match="qform and sform"):
        read_image(_save(tmp_path / "a.nii", _qform(turned), values))


@pytest.mark.parametrize("unused", ["qform", "sform"])
def test_one_orientation_with_the_other_switched_off_is_enough(tmp_path: Path, unused: str) -> None:
    fields = {f"{unused}_code": 0} | ({"quatern_b": 0.7} if unused == "qform" else {"srow_x": [9, 9, 9, 9]})
    image = read_image(_save(tmp_path / "a.nii", _sets(**fields)))
    np.testing.assert_allclose(image.grid.affine, np.diag([-1, -1, 1, 1]) @ _AFFINE, atol=1e-6)


def test_no_orientation_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageFileError, match="the header has no orientation"):
        read_image(_save(tmp_path / "a.nii", _sets(qform_code=0, sform_code=0)))


@pytest.mark.parametrize("qfac", [1, -1])
@pytest.mark.parametrize("angles", [(0, 0, 0), (180, 0, 0), (0, 180, 0), (0, 0, 180), (30, -70, 110), (179.9, 0, 0)])
def test_the_qform_agrees_with_nibabel(tmp_path: Path, qfac: int, angles: tuple[float, ...]) -> None:
    affine = _AFFINE.copy()
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    affine[:3, :3] = turn @ np.diag([1.5, 1.0, 2.5 * qfac])

    def change(header: Any) -> None:
        header.set_qform(affine, code=1)
        header["sform_code"] = 0

    image = read_image(_save(tmp_path / "a.nii", change))
    np.testing.assert_allclose(np.diag([-1, -1, 1, 1]) @ image.grid.affine, affine, atol=5e-4)  # half turns
    theirs = nibabel.load(tmp_path / "a.nii").affine
    np.testing.assert_allclose(np.diag([-1, -1, 1, 1]) @ image.grid.affine, theirs, atol=1e-6)


def test_orientations_near_a_half_turn_agree_in_large_images(tmp_path: Path) -> None:
    # Axial images are nearly a half turn from RAS, where the quaternion holds few digits of a small tilt.
    rng = np.random.default_rng(5)
    values = np.zeros((1024, 4, 4), np.float32)
    values[0] = 1.0
    refused = 0
    for _ in range(60):
        tilt = Rotation.from_rotvec(rng.normal(size=3) * 10 ** rng.uniform(-5, -2))
        affine = np.eye(4)
        affine[:3, :3] = (Rotation.from_rotvec([0, 0, np.pi]) * tilt).as_matrix() * 0.4
        try:
            read_image(_save(tmp_path / "a.nii", values=values, affine=affine))
        except ImageFileError:
            refused += 1
    assert refused == 0


def test_a_qfac_of_zero_means_one(tmp_path: Path) -> None:
    def change(header: Any) -> None:
        header["sform_code"] = 0
        header["pixdim"][0] = 0

    image = read_image(_save(tmp_path / "a.nii", change))
    np.testing.assert_allclose(image.grid.affine, np.diag([-1, -1, 1, 1]) @ _AFFINE, atol=1e-6)


@pytest.mark.parametrize("shear", [0.002, 0.3])
def test_a_sheared_affine_is_refused(tmp_path: Path, shear: float) -> None:
    def change(header: Any) -> None:
        header["qform_code"] = 0
        header["srow_x"] = [1.5, shear, 0.0, 10.0]

    with pytest.raises(ImageFileError, match="sheared"):
        read_image(_save(tmp_path / "a.nii", change))


@pytest.mark.parametrize(("code", "factor", "name"), [(1, 1000.0, "metres"), (3, 0.001, "microns")])
def test_other_units_are_converted_and_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, code: int, factor: float, name: str
) -> None:
    affine = _AFFINE / factor
    affine[3, 3] = 1.0
    image = read_image(_save(tmp_path / "a.nii", _sets(xyzt_units=code + 8), affine=affine))
    np.testing.assert_allclose(image.grid.affine, np.diag([-1, -1, 1, 1]) @ _AFFINE, rtol=1e-6, atol=1e-6)
    assert f"converted from {name} to mm" in caplog.text


def test_unknown_units_are_taken_as_mm_and_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    image = read_image(_save(tmp_path / "a.nii", _sets(xyzt_units=0)))
    np.testing.assert_allclose(image.grid.spacing_mm, [1.5, 1.0, 2.5])
    assert "mm is assumed" in caplog.text


def test_mm_are_nothing_to_tell(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    read_image(_save(tmp_path / "a.nii.gz"))
    assert caplog.text == ""


@pytest.mark.parametrize("code", [4, 5, 6, 7])
def test_units_that_do_not_exist_are_refused(tmp_path: Path, code: int) -> None:
    with pytest.raises(ImageFileError, match="unknown unit of length"):
        read_image(_save(tmp_path / "a.nii", _sets(xyzt_units=code)))


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_a_volume_of_a_4d_file(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    series = np.random.default_rng(1).normal(size=(5, 6, 7, 3)).astype(np.float32)
    path = _save(tmp_path / name, values=series)
    with pytest.raises(ImageFileError, match=r"contains 3 volumes.* with N from 0 to 2") as caught:
        read_image(path)
    command = re.search(r"dvc\.write_image\(.*\)\)", str(caught.value))
    assert command is not None
    monkeypatch.chdir(tmp_path)
    eval(command[0], {"dvc": dvc, "N": 1})  # the next step that is told works as it stands
    np.testing.assert_array_equal(read_image("one.nii.gz").values, series[..., 1])
    for volume in range(3):
        np.testing.assert_array_equal(read_image(path, volume=volume).values, series[..., volume])
    for volume in (-1, 3):
        with pytest.raises(ImageFileError, match=rf"volume={volume} does not exist"):
            read_image(path, volume=volume)
    # the first volume of a file whose last one is cut short is not trusted either
    content = path.read_bytes()
    path.write_bytes(content[:-50])
    with pytest.raises(ImageFileError, match="incomplete"):
        read_image(path, volume=0)


def test_a_4d_file_with_one_volume_is_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    path = _save(tmp_path / "a.nii", values=_VALUES[..., None])
    np.testing.assert_array_equal(read_image(path).values, _VALUES)
    assert "with one volume" in caplog.text


def test_a_vector_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ImageFileError, match="vectors or tensors"):
        read_image(_save(tmp_path / "a.nii", values=np.zeros((5, 6, 7, 1, 3), np.float32)))


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz"])
def test_a_header_that_claims_terabytes_is_refused_with_the_estimate(tmp_path: Path, name: str) -> None:
    path = _save(tmp_path / name, lambda header: header["dim"].__setitem__(slice(1, 4), [30000, 30000, 30000]))
    with pytest.raises(ImageFileError, match=r"30000 x 30000 x 30000 voxels, about 100,\d+\.\d GiB"):
        read_image(path)


def test_a_header_that_claims_gigabytes_is_refused_before_memory_is_taken(tmp_path: Path) -> None:
    path = _save(tmp_path / "a.nii.gz", lambda header: header["dim"].__setitem__(slice(1, 4), [1500, 1500, 1500]))
    with pytest.raises(ImageFileError, match=r"incomplete|3\.75 m across"):
        read_image(path)


@pytest.mark.parametrize(
    "fields",
    [
        {"dim": [3, 5, -6, 7, 1, 1, 1, 1]},
        {"dim": [0, 5, 6, 7, 1, 1, 1, 1]},
        {"dim": [99, 5, 6, 7, 1, 1, 1, 1]},
        {"datatype": 9999},
        {"datatype": 32},  # complex
        {"datatype": 128},  # colour
        {"vox_offset": np.nan},
        {"vox_offset": -8.0},
        {"srow_x": [np.nan, 0, 0, 0]},
        {"srow_x": [0, 0, 0, 0], "qform_code": 0},
        {"quatern_b": 3.0},
        {"magic": b"ni1"},
        {"magic": b"abc"},
    ],
    ids=str,
)
def test_damaged_or_unsuitable_headers_are_refused(tmp_path: Path, fields: dict[str, Any]) -> None:
    with pytest.raises(ImageFileError, match=r"a\.nii: "):
        read_image(_save(tmp_path / "a.nii", _sets(**fields)))


@pytest.mark.parametrize("dtype", ["u1", "i1", "<i2", ">i2", "u2", "i4", "u4", "f4", ">f4", "f8"])
@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
def test_number_types_and_both_versions(tmp_path: Path, dtype: str, kind: Any) -> None:
    values = np.random.default_rng(2).integers(0, 100, (5, 6, 7)).astype(dtype)
    header = kind.header_class(endianness=">" if dtype.startswith(">") else "<")
    header.set_data_dtype(dtype)
    header.set_xyzt_units("mm")
    nibabel.save(kind(values, _AFFINE, header), tmp_path / "a.nii.gz")
    np.testing.assert_array_equal(read_image(tmp_path / "a.nii.gz").values, values)


@pytest.mark.parametrize("dtype", ["u1", "i2", "i4", "f4"])
def test_slope_and_intercept_are_applied(tmp_path: Path, dtype: str) -> None:
    values = np.random.default_rng(3).integers(0, 100, (5, 6, 7)).astype(dtype)
    path = _save(tmp_path / "a.nii", _sets(scl_slope=0.25, scl_inter=-3.0), values)
    np.testing.assert_array_equal(read_image(path).values, values * 0.25 - 3.0)


@pytest.mark.parametrize("slope", [0.0, np.nan, np.inf])
def test_a_slope_that_means_none_is_left_out(tmp_path: Path, slope: float) -> None:
    path = _save(tmp_path / "a.nii", _sets(scl_slope=slope, scl_inter=5.0))
    np.testing.assert_array_equal(read_image(path).values, _VALUES)


def test_a_gzip_file_of_several_members_is_read(tmp_path: Path) -> None:
    path = _save(tmp_path / "a.nii.gz")
    content = gzip.decompress(path.read_bytes())
    path.write_bytes(b"".join(gzip.compress(content[i : i + 200]) for i in range(0, len(content), 200)) + bytes(7))
    np.testing.assert_array_equal(read_image(path).values, _VALUES)
