"""Displacement images of other tools: read in any frame that is declared, refused where it is not."""

from __future__ import annotations

import re
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from dvc.deformation import Deformation, SampledDisplacement
from dvc.displacementfile import read_displacement
from dvc.errors import ImageFileError, InputError
from dvc.image import Grid

OBLIQUE = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
PERMUTED = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MIRROR = np.diag([1.0, 1.0, -1.0])


def vectors(grid: Grid) -> np.ndarray:
    return np.random.default_rng(10).normal(size=(*grid.shape, 3)).astype(np.float32)


def write_with_sitk(path: Path, grid: Grid, values: np.ndarray) -> None:
    image = sitk.GetImageFromArray(np.ascontiguousarray(values.transpose(2, 1, 0, 3)), isVector=True)
    image.SetSpacing(grid.spacing_mm.tolist())
    image.SetOrigin(grid.origin_mm.tolist())
    image.SetDirection(grid.direction.ravel().tolist())
    sitk.WriteImage(image, str(path))


def write_nifti(path: Path, grid: Grid, values: np.ndarray) -> None:
    image = nibabel.Nifti1Image(values[:, :, :, None, :], np.diag([-1.0, -1.0, 1.0, 1.0]) @ grid.affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)


def assert_same(read: Deformation, grid: Grid, values: np.ndarray) -> None:
    assert isinstance(read, SampledDisplacement)
    assert read.grid.same_as(grid, tolerance_voxels=1e-5)
    np.testing.assert_array_equal(read.displacement_mm, values)


@pytest.mark.parametrize("direction", [np.eye(3), OBLIQUE, OBLIQUE @ PERMUTED, OBLIQUE @ MIRROR])
@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".nii.gz"])
def test_displacement_images(tmp_path: Path, suffix: str, direction: np.ndarray) -> None:
    grid = Grid((4, 5, 6), (1.0, 1.5, 2.0), (10.0, -20.0, 30.0), direction)
    values, path = vectors(grid), tmp_path / f"u{suffix}"
    values[1, 2, 3] = np.nan
    if suffix == ".nii.gz":
        write_nifti(path, grid, values)
        with pytest.raises(ImageFileError, match="found none"):
            read_displacement(path)
        assert_same(read_displacement(path, frame="RAS"), grid, values * np.float32([-1, -1, 1]))
        (tmp_path / "u.json").write_text('{"frame": "LPS", "unit": "mm"}')
        with pytest.raises(ImageFileError, match=r"\['LPS', 'RAS'\]"):
            read_displacement(path, frame="RAS")
    else:
        write_with_sitk(path, grid, values)
    assert_same(read_displacement(path), grid, values)


def test_nrrd_in_another_space_needs_the_frame(tmp_path: Path) -> None:
    grid = Grid((4, 5, 6), (1.0, 1.5, 2.0), (10.0, -20.0, 30.0))
    values, path = vectors(grid), tmp_path / "u.nrrd"
    write_with_sitk(path, grid, values)
    path.write_bytes(path.read_bytes().replace(b"left-posterior-superior", b"right-anterior-superior", 1))
    with pytest.raises(ImageFileError, match="frame"):
        read_displacement(path)
    read = read_displacement(path, frame="RAS")
    np.testing.assert_array_equal(read.displacement_mm, values * np.float32([-1, -1, 1]))
    np.testing.assert_allclose(read.grid.origin_mm, [-10.0, 20.0, 30.0])


@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".nii", ".nii.gz"])
def test_refuses_truncated_displacement_images(tmp_path: Path, suffix: str) -> None:
    grid = Grid((14, 15, 16), (1.0, 1.5, 2.0), (10.0, -20.0, 30.0))
    path = tmp_path / f"u{suffix}"
    (write_nifti if ".nii" in suffix else write_with_sitk)(path, grid, vectors(grid))
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.6)])
    with pytest.raises(ImageFileError, match=re.escape(str(path))):
        read_displacement(path, frame="LPS")


def test_refuses_other_images(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such"):
        read_displacement(tmp_path / "u.mha")
    sitk.WriteImage(sitk.Image(4, 5, 6, sitk.sitkFloat32), str(tmp_path / "scalar.mha"))
    with pytest.raises(ImageFileError, match="1 components per voxel"):
        read_displacement(tmp_path / "scalar.mha")
    nibabel.save(nibabel.Nifti1Image(np.zeros((4, 5, 6, 3), np.float32), np.eye(4)), tmp_path / "4d.nii")
    with pytest.raises(ImageFileError, match=r"shape \(4, 5, 6, 3\)"):
        read_displacement(tmp_path / "4d.nii", frame="LPS")
    image = nibabel.Nifti1Image(np.zeros((4, 5, 6, 1, 3), np.float32), np.eye(4))
    image.header.set_xyzt_units("meter")
    nibabel.save(image, tmp_path / "metres.nii")
    with pytest.raises(ImageFileError, match="lengths in meter"):
        read_displacement(tmp_path / "metres.nii", frame="LPS")
    image = nibabel.Nifti1Image(np.zeros((4, 5, 6, 1, 3), np.float32), np.eye(4))
    image.set_qform(np.diag([-1.0, -1.0, 1.0, 1.0]), code=1)
    image.set_sform(np.eye(4), code=1)
    nibabel.save(image, tmp_path / "two.nii")
    with pytest.raises(ImageFileError, match="qform and sform"):
        read_displacement(tmp_path / "two.nii", frame="LPS")
    grid = Grid((4, 5, 6), (1.0, 1.5, 2.0), (10.0, -20.0, 30.0))
    write_with_sitk(tmp_path / "cm.mha", grid, vectors(grid))
    (tmp_path / "cm.json").write_text('{"frame": "LPS", "unit": "cm"}')
    with pytest.raises(ImageFileError, match="in mm on the reference"):
        read_displacement(tmp_path / "cm.mha")
