"""ITK's transform files: what we write is the same map to SimpleITK, and what it writes is the same map to us."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Composed, RigidMotion, SampledDisplacement
from dvc.images.image import Grid
from dvc.io.transforms.read import read_transform
from dvc.io.transforms.write import write_itk_transform

OBLIQUE = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
PERMUTED = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MIRROR = np.diag([1.0, 1.0, -1.0])
MOTION = RigidMotion(Rotation.from_euler("xyz", [9, -14, 21], degrees=True).as_matrix(), np.array([3.0, -5.0, 2.0]))


def spline(direction: np.ndarray) -> BSpline:
    """A random B-spline around the world's origin."""
    control = Grid((8, 9, 10), (4.0, 5.0, 3.5), -direction @ np.array([14.0, 20.0, 15.75]), direction)
    return BSpline(control, np.random.default_rng(1).normal(scale=0.6, size=(3, 8, 9, 10)))


def test_a_transform_that_is_written_again_has_the_same_values_and_another_time(tmp_path: Path) -> None:
    first = write_itk_transform(tmp_path / "first.h5", spline(OBLIQUE), MOTION)
    time.sleep(1.1)  # HDF5 counts seconds
    again = write_itk_transform(tmp_path / "again.h5", spline(OBLIQUE), MOTION)
    assert first.read_bytes() != again.read_bytes()
    one, other = (sitk.ReadTransform(str(path)).Downcast() for path in (first, again))
    for n in range(2):
        assert one.GetNthTransform(n).GetParameters() == other.GetNthTransform(n).GetParameters()
        assert one.GetNthTransform(n).GetFixedParameters() == other.GetNthTransform(n).GetFixedParameters()


@pytest.mark.parametrize("suffix", [".h5", ".tfm"])
@pytest.mark.parametrize("direction", [np.eye(3), OBLIQUE, OBLIQUE @ PERMUTED, OBLIQUE @ MIRROR])
@pytest.mark.parametrize("then", [None, MOTION])
def test_itk_transform_is_the_same_map(
    tmp_path: Path, suffix: str, direction: np.ndarray, then: RigidMotion | None
) -> None:
    b = spline(direction)
    path = write_itk_transform(tmp_path / f"map{suffix}", b, then)
    points = np.random.default_rng(6).uniform(-4, 4, size=(50, 3))
    ours = Composed([b, then]) if then else b
    theirs = sitk.ReadTransform(str(path))
    x = points + ours.displacement(points)
    np.testing.assert_allclose([theirs.TransformPoint(p) for p in points.tolist()], x, rtol=0, atol=1e-9)
    np.testing.assert_allclose(points + read_transform(path).displacement(points), x, rtol=0, atol=1e-9)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_itk_valid_region(tmp_path: Path) -> None:
    """ITK's region is ours and its far face: identity elsewhere."""
    b = BSpline(Grid((6, 6, 6), (4.0,) * 3, (-8.0,) * 3), np.ones((3, 6, 6, 6)))
    theirs = sitk.ReadTransform(str(write_itk_transform(tmp_path / "map.h5", b)))
    along = np.array([-4.5, -4.0, 0.0, 7.5, 8.0, 8.5])
    moved = [theirs.TransformPoint((x, 0.0, 0.0))[1] == pytest.approx(1.0) for x in along]
    ours = np.isfinite(b.displacement(np.array([[x, 0.0, 0.0] for x in along]))[:, 0])
    assert moved == [False, True, True, True, True, False]
    assert ours.tolist() == [False, True, True, True, False, False]


def itk_transforms() -> dict[str, sitk.Transform]:
    centre = (2.0, -1.0, 3.0)
    euler = sitk.Euler3DTransform(centre, 0.1, -0.2, 0.3, (1.0, 2.0, -1.0))
    euler.SetComputeZYX(True)
    versor = sitk.VersorRigid3DTransform()
    versor.SetCenter(centre)
    versor.SetRotation((0.0, 0.6, 0.8), 0.4)
    versor.SetTranslation((3.0, 0.0, 1.0))
    turn = sitk.VersorTransform((0.0, 0.6, 0.8), 0.4)
    turn.SetCenter(centre)
    similarity = sitk.Similarity3DTransform(1.1, (1.0, 0.0, 0.0), 0.3, (1.0, 2.0, 3.0), centre)
    skewed = sitk.ScaleSkewVersor3DTransform()
    skewed.SetParameters((0.1, 0.2, -0.1, 1.0, 2.0, 3.0, 1.1, 0.9, 1.05, 0.01, 0.02, 0.03, 0.01, 0.02, 0.03))
    skewed.SetCenter(centre)
    affine = sitk.AffineTransform((1.1, 0.1, 0.0, 0.0, 0.9, 0.05, 0.0, 0.0, 1.0), (1.0, 2.0, 3.0), centre)
    scale = sitk.ScaleTransform(3, (1.1, 0.9, 1.2))
    scale.SetCenter(centre)
    shift = sitk.TranslationTransform(3, (1.0, -2.0, 0.5))
    return {
        "euler": euler,
        "versor rigid": versor,
        "versor": turn,
        "similarity": similarity,
        "scale skew": skewed,
        "affine": affine,
        "scale": scale,
        "translation": shift,
        "identity": sitk.Transform(3, sitk.sitkIdentity),
        "composite": sitk.CompositeTransform([euler, affine, similarity]),
    }


@pytest.mark.parametrize("suffix", [".h5", ".tfm", ".txt"])
@pytest.mark.parametrize("kind", list(itk_transforms()))
def test_reads_itk_kinds(tmp_path: Path, kind: str, suffix: str) -> None:
    transform = itk_transforms()[kind]
    path = tmp_path / f"transform{suffix}"
    sitk.WriteTransform(transform, str(path))
    points = np.random.default_rng(7).uniform(-50, 50, size=(20, 3))
    read = read_transform(path)
    x = [transform.TransformPoint(p) for p in points.tolist()]
    np.testing.assert_allclose(points + read.displacement(points), x, rtol=0, atol=1e-11)
    if kind in ("euler", "versor rigid", "versor", "identity"):
        assert isinstance(read, RigidMotion)


def test_itk_displacement_field(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    image = sitk.GetImageFromArray(rng.normal(size=(7, 6, 5, 3)), isVector=True)
    image.SetSpacing((1.0, 1.5, 2.0))
    image.SetDirection(OBLIQUE.ravel().tolist())
    transform = sitk.DisplacementFieldTransform(sitk.Image(image))
    sitk.WriteTransform(transform, str(tmp_path / "field.h5"))
    read = read_transform(tmp_path / "field.h5")
    assert isinstance(read, SampledDisplacement)
    points = read.grid.points()[1:-1, 1:-1, 1:-1].reshape(-1, 3)
    x = [transform.TransformPoint(p) for p in points.tolist()]
    np.testing.assert_allclose(points + read.displacement(points), x, rtol=0, atol=1e-9)


def test_elastix_file_that_names_an_itk_file(tmp_path: Path) -> None:
    write_itk_transform(tmp_path / "map.h5", spline(OBLIQUE), MOTION)
    (tmp_path / "T.txt").write_text('(Transform "File")\n(TransformFileName "map.h5")\n')
    assert isinstance(read_transform(tmp_path / "T.txt"), Composed)
