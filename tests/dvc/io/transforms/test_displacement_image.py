"""Displacement images of other tools: read in any frame that is declared, refused where it is not."""

from __future__ import annotations

import gzip
import re
from collections.abc import Callable
from pathlib import Path

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

import dvc
from dvc.deformation.protocol import Deformation, SampledDisplacement
from dvc.errors import ImageFileError, InputError
from dvc.images.image import Grid
from dvc.io.transforms.read import read_displacement

OBLIQUE = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
PERMUTED = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MIRROR = np.diag([1.0, 1.0, -1.0])


def vectors(grid: Grid) -> np.ndarray:
    return np.random.default_rng(10).normal(size=(*grid.shape, 3)).astype(np.float32)


def write_with_sitk(path: Path, grid: Grid, values: np.ndarray, compressed: bool = False) -> None:
    image = sitk.GetImageFromArray(np.ascontiguousarray(values.transpose(2, 1, 0, 3)), isVector=True)
    image.SetSpacing(grid.spacing_mm.tolist())
    image.SetOrigin(grid.origin_mm.tolist())
    image.SetDirection(grid.direction.ravel().tolist())
    sitk.WriteImage(image, str(path), useCompression=compressed)


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
    with pytest.raises(ImageFileError, match="lengths are in metres"):
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
    with pytest.raises(ImageFileError, match="in mm in the reference"):
        read_displacement(tmp_path / "cm.mha")


GRID = Grid((12, 10, 8), (0.8, 0.8, 0.8), (-40.0, -30.0, -20.0))


def flipped(content: bytes, at: int) -> bytes:
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def replaced(*pairs: tuple[str, str]) -> Callable[[bytes], bytes]:
    """Lines of a text header exchanged, each there once."""

    def change(content: bytes) -> bytes:
        for old, new in pairs:
            assert content.count(old.encode()) == 1, old
            content = content.replace(old.encode(), new.encode())
        return content

    return change


def with_header(**fields: object) -> Callable[[bytes], bytes]:
    """Fields of a NIfTI header set in place, as another program might."""

    def change(content: bytes) -> bytes:
        plain = gzip.decompress(content)
        header = nibabel.Nifti1Header(plain[:348], check=False)
        for name, value in fields.items():
            header[name] = value
        return gzip.compress(header.binaryblock + plain[348:])

    return change


def written(
    folder: Path, suffix: str, change: Callable[[bytes], bytes] = bytes, values: np.ndarray | None = None
) -> Path:
    """A compressed displacement image, then changed."""
    path, values = folder / f"u{suffix}", vectors(GRID) if values is None else values
    if suffix == ".nii.gz":
        write_nifti(path, GRID, values)
    else:
        write_with_sitk(path, GRID, values, compressed=True)
    assert_same(read_displacement(path, frame="LPS"), GRID, values)
    path.write_bytes(change(path.read_bytes()))
    return path


@pytest.mark.parametrize("suffix", [".mha", ".nrrd", ".nii.gz"])
@pytest.mark.parametrize(
    ("damage", "cause"),
    [
        (lambda content: content[: int(len(content) * 0.6)], "incomplete"),
        (lambda content: content[:-4], "incomplete|have no end"),
        (lambda content: flipped(content, len(content) // 2), "compressed voxels are damaged"),
        (lambda content: flipped(content, -4 if b"MET_FLOAT" in content else -8), "damaged"),  # zlib, gzip
    ],
    ids=["truncated", "end cut off", "bit flipped", "wrong checksum"],
)
def test_refuses_damaged_compressed_vectors(
    tmp_path: Path, suffix: str, damage: Callable[[bytes], bytes], cause: str
) -> None:
    path = written(tmp_path, suffix, damage)
    with pytest.raises(ImageFileError, match=cause) as refusal:
        read_displacement(path, frame="LPS")
    assert str(refusal.value).startswith(str(path))


@pytest.mark.parametrize(("shift_voxels", "refused"), [(0.04, False), (0.06, True)])
def test_qform_and_sform_agree_as_closely_as_those_of_images(
    tmp_path: Path, shift_voxels: float, refused: bool
) -> None:
    content = gzip.decompress(written(tmp_path, ".nii.gz").read_bytes())
    start = float(nibabel.Nifti1Header(content[:348]).get_sform()[0, 3])
    moved = with_header(qoffset_x=start + 0.8 * shift_voxels, qform_code=1)
    path = written(tmp_path, ".nii.gz", moved)
    if refused:
        with pytest.raises(ImageFileError, match=r"qform and sform .* 0\.06 voxels"):
            read_displacement(path, frame="LPS")
    else:
        assert read_displacement(path, frame="LPS").grid.same_as(GRID, tolerance_voxels=1e-5)  # the sform's


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha"])
def test_the_grid_is_that_of_an_image_of_the_same_header(tmp_path: Path, suffix: str) -> None:
    grid = Grid(GRID.shape, (0.8, 1.1, 1.3), (10.0, -20.0, 30.0), OBLIQUE)
    values = vectors(grid)
    dvc.write_image(tmp_path / f"a{suffix}", dvc.Image(grid, values[..., 0]))
    dvc.write_vectors(tmp_path / f"u{suffix}", grid, values, ("x", "y", "z"), "displacement", unit="mm")
    read = read_displacement(tmp_path / f"u{suffix}")
    np.testing.assert_array_equal(read.grid.affine, dvc.read_image(tmp_path / f"a{suffix}").grid.affine)
    np.testing.assert_array_equal(read.displacement_mm, values)


@pytest.mark.parametrize(
    ("suffix", "change"),
    [
        (".nii.gz", with_header(srow_y=[0.2, -0.8, 0.0, 30.0])),
        (".nrrd", replaced(("(0,0.80000000000000004,0)", "(0.2,0.80000000000000004,0)"))),
        (".mha", replaced(("TransformMatrix = 1 0 0 0 1 0 0 0 1", "TransformMatrix = 1 0 0 0.2 1 0 0 0 1"))),
    ],
)
def test_refuses_a_sheared_affine(tmp_path: Path, suffix: str, change: Callable[[bytes], bytes]) -> None:
    path = written(tmp_path, suffix, change)
    with pytest.raises(ImageFileError, match="sheared"):
        read_displacement(path, frame="LPS")


@pytest.mark.parametrize(
    ("suffix", "change"),
    [
        (".nii.gz", with_header(xyzt_units=1)),
        (".nii.gz", with_header(xyzt_units=3)),
        (".nrrd", replaced(("encoding: gzip", 'space units: "cm" "cm" "cm"\nencoding: gzip'))),
        (".mha", replaced(("ElementType", "DistanceUnits = m\nElementType"))),
    ],
)
def test_refuses_other_units_than_mm(tmp_path: Path, suffix: str, change: Callable[[bytes], bytes]) -> None:
    # Lengths of an image are converted; whether the components are in the header's unit, no header says.
    path = written(tmp_path, suffix, change)
    with pytest.raises(ImageFileError, match=r"lengths are in .* a displacement in mm is needed"):
        read_displacement(path, frame="LPS")


@pytest.mark.parametrize(
    ("suffix", "change"),
    [
        (".nii.gz", with_header(dim=[5, 30000, 30000, 30000, 1, 3, 1, 1])),
        (".nrrd", replaced(("sizes: 3 12 10 8", "sizes: 3 30000 30000 30000"))),
        (".mha", replaced(("DimSize = 12 10 8", "DimSize = 30000 30000 30000"))),
    ],
)
def test_refuses_a_header_that_claims_terabytes(tmp_path: Path, suffix: str, change: Callable[[bytes], bytes]) -> None:
    path = written(tmp_path, suffix, change)
    with pytest.raises(ImageFileError, match=r"about 301,749\.8 GiB|about 301,7"):
        read_displacement(path, frame="LPS")


@pytest.mark.parametrize("suffix", [".nii.gz", ".nrrd", ".mha"])
def test_refuses_infinite_displacements(tmp_path: Path, suffix: str) -> None:
    values = vectors(GRID)
    values[1, 2, 3] = np.nan
    path = written(tmp_path, suffix, values=values)
    at = {(2, 3, 4): np.inf, (5, 6, 7): -np.inf}
    for voxel, value in at.items():
        values[*voxel, 1] = value
    (write_nifti if suffix == ".nii.gz" else write_with_sitk)(path, GRID, values)
    with pytest.raises(ImageFileError, match=r"2 of 960 voxels is infinite, the first at index \(2, 3, 4\)"):
        read_displacement(path, frame="LPS")


def test_vectors_stored_as_scaled_integers(tmp_path: Path) -> None:
    whole = np.random.default_rng(3).integers(-3000, 3000, (*GRID.shape, 3)).astype(np.int16)
    write_nifti(tmp_path / "u.nii.gz", GRID, whole)
    path = tmp_path / "u.nii.gz"
    path.write_bytes(with_header(scl_slope=0.001, scl_inter=0.5)(path.read_bytes()))
    np.testing.assert_allclose(
        read_displacement(path, frame="LPS").displacement_mm, 0.001 * whole + 0.5, rtol=0, atol=1e-6
    )


def test_refuses_colours(tmp_path: Path) -> None:
    path = written(tmp_path, ".nrrd", replaced(("kinds: vector", "kinds: RGB-color")))
    with pytest.raises(ImageFileError, match="of kind rgb-color"):
        read_displacement(path)
