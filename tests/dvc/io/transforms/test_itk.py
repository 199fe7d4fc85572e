"""ITK's transform files: what we write is the same map to SimpleITK, and what it writes is the same map to us."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Composed, RigidMotion, SampledDisplacement
from dvc.errors import InputError
from dvc.images.image import Grid
from dvc.io.transforms.read import read_transform
from dvc.io.transforms.write import write_itk_transform
from dvc.worker import Worker

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


@pytest.mark.parametrize(  # an HDF5 file takes a second
    ("suffix", "direction"),
    [(".h5", OBLIQUE @ MIRROR), *((".tfm", d) for d in (np.eye(3), OBLIQUE, OBLIQUE @ PERMUTED, OBLIQUE @ MIRROR))],
)
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


@pytest.mark.parametrize(
    ("kind", "suffix"),
    [
        *((kind, ".tfm") for kind in itk_transforms()),
        ("composite", ".h5"),
        ("composite", ".txt"),
        ("similarity", ".mat"),
    ],
)
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


def damaged(path: Path, change: Callable[[bytes], bytes]) -> Path:
    """A B-spline after an affine map as a file of ITK, its bytes changed; .mat has the affine map alone."""
    if path.suffix == ".mat":
        sitk.WriteTransform(itk_transforms()["affine"], str(path))
    else:
        write_itk_transform(path, spline(OBLIQUE), MOTION)
    path.write_bytes(change(path.read_bytes()))
    return path


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("cut.tfm", lambda b: b[: len(b) // 2], "last line has no end"),
        ("cut.tfm", lambda b: b[: b.rindex(b"FixedParameters")], "the BSplineTransform lacks numbers"),
        ("cut.tfm", lambda b: b[: b.index(b"#Transform 1")], "no transform"),
        ("count.tfm", lambda b: b.replace(b"FixedParameters: 8 9", b"FixedParameters: 8 8"), r"grid of \[8\.0, 8\.0"),
        ("large.tfm", lambda b: b.replace(b"FixedParameters: 8 9", b"FixedParameters: 8 1e308"), "on a grid of"),
        ("nan.tfm", lambda b: b.replace(b"FixedParameters: 8 9", b"FixedParameters: nan 9"), "not finite"),
        ("word.tfm", lambda b: b.replace(b"FixedParameters", b"FixedParamaters"), "unexpected line 'FixedParamaters"),
        ("bytes.tfm", lambda b: b.replace(b"BSpline", b"BSpl\xffne"), "can't decode"),
        ("kind.tfm", lambda b: b.replace(b"BSplineTransform_d", b"BSplineTransformxd"), "is no transform"),
        ("cut.mat", lambda b: b[:-1], "cannot be read as an ITK transform file"),
        ("cut.mat", lambda b: b[: b.index(b"fixed") - 20], "without their fixed"),
        ("bytes.mat", lambda b: b.replace(b"Affine", b"\xffffine"), "can't decode"),
        ("nan.mat", lambda b: b[:-8] + np.array(np.nan).tobytes(), "not finite"),
        ("rows.mat", lambda b: b[:4] + b"\xff\xff\xff\xff" + b[8:], "not one of numbers in a column"),
        ("cut.h5", lambda b: b[:-1], "incomplete or damaged: it has"),
        ("more.h5", lambda b: b[:5000] + b[4900:5000] + b[5000:], "incomplete or damaged: it has"),
        ("text.h5", lambda b: b"#Insight" * 20, "no HDF5 file"),
        ("heap.h5", lambda b: b.replace(b"GCOL", b"GCOM"), "cannot be read as an ITK transform file"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_refused(tmp_path: Path, name: str, change: Callable[[bytes], bytes], message: str) -> None:
    path = damaged(tmp_path / name, change)
    with pytest.raises(InputError, match=message) as refusal:
        read_transform(path)
    assert str(path) in str(refusal.value)


def _dies(_: Path) -> None:
    os._exit(3)


def _does_not_end(_: Path) -> None:
    time.sleep(60.0)


@pytest.mark.parametrize(
    ("reader", "most_s", "message"), [(_dies, 60.0, "ended the process"), (_does_not_end, 0.5, "timed out")]
)
def test_a_file_that_harms_its_reader_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reader: Callable[[Path], None], most_s: float, message: str
) -> None:
    path = damaged(tmp_path / "map.h5", bytes)
    monkeypatch.setattr("dvc.io.transforms.itk_file._MOST_S", most_s)
    monkeypatch.setattr("dvc.io.transforms.itk_file._read", reader)
    with pytest.raises(InputError, match=rf"map\.h5: .*{message}"):
        read_transform(path)


def test_a_process_that_takes_long_to_start_is_no_fault_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a machine that swaps its memory to disk: the time limit is that of reading."""
    path, now, running = damaged(tmp_path / "map.h5", bytes), [0.0], Worker._running

    def slow(worker: Worker) -> object:
        now[0] += 100.0 if worker._executor is None else 0.0
        return running(worker)

    monkeypatch.setattr(Worker, "_running", slow)
    monkeypatch.setattr("dvc.io.transforms.itk_file.time", SimpleNamespace(monotonic=lambda: now[0]))
    assert isinstance(read_transform(path), Composed)
    assert now == [100.0]
