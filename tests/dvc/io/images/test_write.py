"""Writers: what is written is read back the same, whole or not at all, and without a patient."""

from __future__ import annotations

import gzip
import json
import os
import resource
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from dvc import atomic_files as whole
from dvc.errors import ImageFileError, InputError, OutputError
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.io.images.labels import read_labels, read_mask
from dvc.io.images.read import read_header, read_image
from dvc.io.images.write import refuse_overwriting_inputs, write_image, write_labels, write_mask, write_vectors

_SUFFIXES = ["nii", "nii.gz", "nrrd", "mha"]
_SHAPE = (5, 6, 7)
_DIRECTIONS = {
    "LPS": np.eye(3),
    "RAS": np.diag([-1.0, -1.0, 1.0]),
    "mirrored": np.diag([1.0, -1.0, 1.0])[:, [2, 0, 1]],
    "oblique": Rotation.from_euler("xyz", [20.0, -35.0, 170.0], degrees=True).as_matrix(),
}
_RNG = np.random.default_rng(6)


def _grid(direction: str = "oblique") -> Grid:
    return Grid(_SHAPE, (1.5, 1.0, 2.5), (-40.0, 25.0, 310.0), _DIRECTIONS[direction])


def _image(direction: str = "oblique") -> Image:
    values = _RNG.normal(size=_SHAPE).astype(np.float32)
    values[1, 2, 3] = np.nan
    return Image(_grid(direction), values)


def _tensors(components: int) -> np.ndarray:
    values = _RNG.normal(size=(*_SHAPE, components)).astype(np.float32)
    values[0, 0, 0] = np.nan
    return values


def _as_itk_reads(values: np.ndarray, suffix: str) -> np.ndarray:
    """Readers built on ITK turn a NaN of a NIfTI file, and of no other, into zero."""
    return np.nan_to_num(values) if suffix.startswith("nii") else values


@pytest.mark.parametrize("suffix", _SUFFIXES)
@pytest.mark.parametrize("direction", _DIRECTIONS)
class TestRoundTrip:
    """Written, then read back here and by another library."""

    def test_image(self, tmp_path: Path, suffix: str, direction: str) -> None:
        image, path = _image(direction), tmp_path / f"a.{suffix}"
        write_image(path, image)
        back = read_image(path, allow_missing=True)
        np.testing.assert_array_equal(back.values, image.values)
        # single precision in NIfTI headers only
        tolerance = 1e-6 if suffix.startswith("nii") else 1e-14
        np.testing.assert_allclose(back.grid.affine, image.grid.affine, rtol=tolerance, atol=2 * tolerance)
        other = sitk.ReadImage(str(path))
        theirs = sitk.GetArrayFromImage(other).transpose(2, 1, 0)
        np.testing.assert_array_equal(theirs, _as_itk_reads(image.values, suffix))
        np.testing.assert_allclose(other.GetOrigin(), image.grid.origin_mm, rtol=1e-6)
        np.testing.assert_allclose(np.reshape(other.GetDirection(), (3, 3)), image.grid.direction, atol=1e-6)

    def test_mask(self, tmp_path: Path, suffix: str, direction: str) -> None:
        mask, path = Mask(_grid(direction), _RNG.random(_SHAPE) < 0.3), tmp_path / f"a.{suffix}"
        write_mask(path, mask)
        back = read_mask(path, mask.grid)
        np.testing.assert_array_equal(back.inside, mask.inside)
        assert sitk.ReadImage(str(path)).GetPixelID() == sitk.sitkUInt8

    def test_vectors(self, tmp_path: Path, suffix: str, direction: str) -> None:
        values, path, grid = _tensors(3), tmp_path / f"a.{suffix}", _grid(direction)
        write_vectors(path, grid, values, ("x", "y", "z"), "displacement u", "LPS", unit="mm")
        other = sitk.ReadImage(str(path))
        assert (other.GetDimension(), other.GetNumberOfComponentsPerPixel()) == (3, 3)
        theirs = sitk.GetArrayFromImage(other).transpose(2, 1, 0, 3)
        np.testing.assert_array_equal(theirs, _as_itk_reads(values, suffix))
        np.testing.assert_allclose(other.GetOrigin(), grid.origin_mm, rtol=1e-6)


@pytest.mark.parametrize("suffix", _SUFFIXES)
@pytest.mark.parametrize("count", [2, 5])
def test_any_number_of_components_comes_back(tmp_path: Path, suffix: str, count: int) -> None:
    values, path = _tensors(count), tmp_path / f"a.{suffix}"
    write_vectors(path, _grid(), values, [f"tissue {n}" for n in range(count)], "probability", "invariant", unit="1")
    stored = read_header(path, vectors=True, components=count)
    np.testing.assert_array_equal(stored.load(), values)
    assert stored.grid.same_as(_grid())
    with pytest.raises(ImageFileError, match=r"vectors of 4 are needed|a displacement image has"):
        read_header(path, vectors=True, components=4)


@pytest.mark.parametrize("suffix", _SUFFIXES)
@pytest.mark.parametrize(("largest", "pixel"), [(3, sitk.sitkUInt8), (300, sitk.sitkUInt16), (70000, sitk.sitkInt32)])
def test_labels_come_back_with_their_names(tmp_path: Path, suffix: str, largest: int, pixel: int) -> None:
    labels = _RNG.integers(0, 3, _SHAPE)
    labels[0, 0, 0] = largest
    names = {1: "fat, plantar", 2: "muscle", largest: 'skin "outer"'}
    path = tmp_path / f"tissues.{suffix}"
    write_labels(path, LabelMap(_grid(), labels, names))
    back = read_labels(path, tmp_path / "tissues.csv")
    np.testing.assert_array_equal(back.labels, labels)
    assert back.names == names
    assert sitk.ReadImage(str(path)).GetPixelID() == pixel


@pytest.mark.parametrize("suffix", ["nii", "nii.gz"])
def test_nifti_headers_are_unambiguous(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    write_vectors(path, _grid(), _tensors(3), ("x", "y", "z"), "displacement u", "LPS", unit="mm")
    image = nibabel.load(path)
    header = image.header
    assert image.shape == (*_SHAPE, 1, 3)
    assert (int(header["qform_code"]), int(header["sform_code"])) == (1, 1)
    assert (int(header["intent_code"]), int(header["xyzt_units"]) & 7) == (1007, 2)
    np.testing.assert_allclose(header.get_qform(), header.get_sform(), atol=1e-4)
    np.testing.assert_allclose(image.affine, np.diag([-1, -1, 1, 1]) @ _grid().affine, atol=1e-4)


@pytest.mark.parametrize("suffix", ["nii.gz", "nrrd"])
def test_tensors_are_plain_and_declared(tmp_path: Path, suffix: str) -> None:
    values, path = _tensors(6), tmp_path / f"strain.{suffix}"
    names = ("xx", "xy", "xz", "yy", "yz", "zz")
    write_vectors(path, _grid(), values, names, "Green-Lagrange strain", unit="1")
    if suffix == "nii.gz":
        image = nibabel.load(path)
        assert int(image.header["intent_code"]) == 0
        np.testing.assert_array_equal(np.asarray(image.dataobj), values[:, :, :, None, :])
    else:
        np.testing.assert_array_equal(sitk.GetArrayFromImage(sitk.ReadImage(str(path))).transpose(2, 1, 0, 3), values)
    assert json.loads((tmp_path / "strain.json").read_text()) == {
        "file": path.name,
        "meaning": "Green-Lagrange strain",
        "components": list(names),
        "frame": "LPS",
        "unit": "1",
        "configuration": "reference",
        "missing": "NaN",
    }


def test_vectors_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    path, grid, xyz = tmp_path / "a.nii", _grid(), ("x", "y", "z")
    with pytest.raises(InputError, match="values have shape"):
        write_vectors(path, grid, np.zeros((*_SHAPE, 2)), xyz, "u", unit="mm")
    with pytest.raises(InputError, match="got 'RAS'"):
        write_vectors(path, grid, _tensors(3), xyz, "u", "RAS", unit="mm")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", _SUFFIXES)
def test_equal_images_give_equal_files(tmp_path: Path, suffix: str) -> None:
    image = _image()
    for name in ("a", "b"):
        write_image(tmp_path / f"{name}.{suffix}", image)
    assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


@pytest.mark.parametrize("suffix", _SUFFIXES)
def test_a_full_disk_leaves_the_old_file_and_nothing_else(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(b"what was there")
    grid = Grid((64, 64, 64), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    image = Image(grid, _RNG.normal(size=grid.shape))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(OutputError, match=r"cannot be written.*the disk has space"):
            write_image(path, image)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert path.read_bytes() == b"what was there"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", _SUFFIXES)
def test_a_folder_that_cannot_be_written_to(tmp_path: Path, suffix: str) -> None:
    (tmp_path / "file").write_text("no folder")
    for folder in ("missing", "file"):
        with pytest.raises(OutputError, match="Check that the folder exists"):
            write_image(tmp_path / folder / f"a.{suffix}", _image())
    if os.getuid() != 0:  # root may write anywhere
        closed = tmp_path / "closed"
        closed.mkdir(mode=0o500)
        with pytest.raises(OutputError, match="may be written"):
            write_image(closed / f"a.{suffix}", _image())


@pytest.mark.parametrize("suffix", _SUFFIXES)
def test_an_interruption_leaves_nothing(tmp_path: Path, suffix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(whole.os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_image(tmp_path / f"a.{suffix}", _image())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["a.png", "a.mhd", "a.nhdr", "a", ".nii", "a.nii.bz2"])
def test_other_kinds_of_file_are_not_written(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutputError, match="this output format is not supported"):
        write_image(tmp_path / name, _image())


@pytest.mark.parametrize("suffix", _SUFFIXES)
def test_nothing_of_a_patient_passes_from_input_to_output(tmp_path: Path, suffix: str) -> None:
    source = nibabel.Nifti1Image(_RNG.normal(size=_SHAPE).astype(np.float32), np.eye(4))
    source.header["descrip"] = b"Doe^Jane 19500101"
    source.header["db_name"] = b"ID-12345"
    source.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", b"Doe^Jane"))
    nibabel.save(source, tmp_path / "in.nii")
    assert b"Doe^Jane" in (tmp_path / "in.nii").read_bytes()
    write_image(tmp_path / f"out.{suffix}", read_image(tmp_path / "in.nii"))
    content = (tmp_path / f"out.{suffix}").read_bytes()
    if suffix == "nii.gz":
        content = gzip.decompress(content)
    assert b"Doe" not in content
    assert b"12345" not in content


class TestOverwriting:
    """Outputs that are inputs."""

    def test_the_same_file_by_any_name(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        source = tmp_path / "a.nii"
        source.write_bytes(b"x")
        (tmp_path / "link.nii").symlink_to(source)
        (tmp_path / "hard.nii").hardlink_to(source)
        monkeypatch.chdir(tmp_path)
        for output in (source, "a.nii", tmp_path / "sub" / ".." / "a.nii", "link.nii", "hard.nii"):
            with pytest.raises(OutputError, match="would overwrite the input"):
                refuse_overwriting_inputs([tmp_path / "fine.nii", output], [tmp_path / "b.nii", source])
        assert source.read_bytes() == b"x"

    def test_within_a_folder_of_slices(self, tmp_path: Path) -> None:
        (tmp_path / "dicom").mkdir()
        with pytest.raises(OutputError, match="would be inside it"):
            refuse_overwriting_inputs([tmp_path / "dicom" / "out" / "u.nii"], [tmp_path / "dicom"])

    def test_beside_is_fine(self, tmp_path: Path) -> None:
        (tmp_path / "a.nii").write_bytes(b"x")
        refuse_overwriting_inputs([tmp_path / "a.nii.gz", tmp_path / "out"], [tmp_path / "a.nii"])
