"""Transform files against the programs they come from: transformix itself, and SimpleITK."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import SimpleITK as sitk
from scipy.spatial.transform import Rotation

from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import Affine, Composed, RigidMotion, evaluate_on_grid
from dvc.errors import InputError, OutputError, ParameterError
from dvc.images.image import Grid
from dvc.io.transforms.elastix_text import format_parameters, parse_parameters
from dvc.io.transforms.read import Added, bspline_from_elastix, read_transform, rigid_from_elastix
from dvc.io.transforms.write import write_elastix_transform, write_itk_transform
from dvc.worker import Worker

OBLIQUE = Rotation.from_euler("xyz", [20, -35, 50], degrees=True).as_matrix()
PERMUTED = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
MIRROR = np.diag([1.0, 1.0, -1.0])
MOTION = RigidMotion(Rotation.from_euler("xyz", [9, -14, 21], degrees=True).as_matrix(), np.array([3.0, -5.0, 2.0]))
SHAPE = (10, 11, 12)


def transformed(files: dict[str, Path]) -> dict[str, np.ndarray]:
    """What transformix says of every case, for a worker: native code may crash."""
    import itk

    image = itk.image_from_array(np.zeros((5, 5, 5), np.float32))

    def run(file: Path, *, points: bool) -> tuple[Any, Path]:
        out = file.parent / "out"
        out.mkdir(exist_ok=True)
        method = itk.TransformixFilter[itk.Image[itk.F, 3]].New()
        method.SetMovingImage(image)
        method.SetTransformParameterFileName(str(file))
        if points:
            method.SetFixedPointSetFileName(str(file.parent / "points.txt"))
        else:
            method.SetComputeDeformationField(True)
            method.SetComputeSpatialJacobian(True)
        method.SetOutputDirectory(str(out))
        method.SetLogToConsole(False)
        method.UpdateLargestPossibleRegion()
        return method, out

    found = {}
    for name, file in files.items():
        method, out = run(file, points=False)
        found[name + ".u"] = itk.array_from_image(method.GetOutputDeformationField())
        (jacobian,) = out.glob("fullSpatialJacobian*")
        found[name + ".F"] = sitk.GetArrayFromImage(sitk.ReadImage(str(jacobian)))
        _, out = run(file, points=True)
        rows = (out / "outputpoints.txt").read_text().splitlines()
        told = [row.split("OutputPoint = [")[1].split("]")[0].split() for row in rows]
        found[name + ".x"] = np.array(told, dtype=float)
    return found


def spline(direction: np.ndarray, seed: int = 1, size_mm: float = 0.6) -> BSpline:
    """A random B-spline whose valid region is centred on the world's origin."""
    shape, spacing = (8, 9, 10), np.array([4.0, 5.0, 3.5])
    origin = -direction @ (spacing * (np.array(shape) - 1) / 2)
    control = Grid(shape, spacing, origin, direction)
    return BSpline(control, np.random.default_rng(seed).normal(scale=size_mm, size=(3, *shape)))


def image_grid(direction: np.ndarray) -> Grid:
    """A grid inside the valid region of ``spline`` of any direction."""
    spacing = np.array([0.8, 0.7, 0.6])
    return Grid(SHAPE, spacing, -direction @ (spacing * (np.array(SHAPE) - 1) / 2), direction)


def stage(kind: str, numbers: list[float], grid: Grid, **more: list[object]) -> str:
    """Text of one elastix transform file; the code under test only formats the numbers."""
    values = {
        "Transform": [kind],
        "NumberOfParameters": [len(numbers)],
        "TransformParameters": [float(v) for v in numbers],
        "InitialTransformParameterFileName": ["NoInitialTransform"],
        "HowToCombineTransforms": ["Compose"],
        "FixedImageDimension": [3],
        "MovingImageDimension": [3],
        "FixedInternalImagePixelType": ["float"],
        "MovingInternalImagePixelType": ["float"],
        "Size": list(grid.shape),
        "Index": [0, 0, 0],
        "Spacing": grid.spacing_mm.tolist(),
        "Origin": grid.origin_mm.tolist(),
        "Direction": grid.direction.T.ravel().tolist(),
        "UseDirectionCosines": [True],
        "ResampleInterpolator": ["FinalBSplineInterpolator"],
        "FinalBSplineInterpolationOrder": [3],
        "Resampler": ["DefaultResampler"],
        "DefaultPixelValue": [0],
        "ResultImageFormat": ["nii.gz"],
        "ResultImagePixelType": ["float"],
    }
    return format_parameters({**values, **more})


def chain(folder: Path, *stages: str) -> Path:
    """Write stages so that each has the one before as its initial transform; return the last."""
    name = "NoInitialTransform"
    for number, text in enumerate(stages):
        path = folder / f"T{number}.txt"
        path.write_text(text.replace('FileName "NoInitialTransform"', f'FileName "{name}"'))
        name = path.name
    return folder / name


def spline_stage(bspline: BSpline, grid: Grid, **more: list[object]) -> str:
    control = bspline.control
    numbers = np.concatenate([c.ravel(order="F") for c in bspline.coefficients_mm]).tolist()
    geometry: dict[str, list[object]] = {
        "GridSize": list(control.shape),
        "GridIndex": [0, 0, 0],
        "GridSpacing": control.spacing_mm.tolist(),
        "GridOrigin": control.origin_mm.tolist(),
        "GridDirection": control.direction.T.ravel().tolist(),
        "BSplineTransformSplineOrder": [3],
        "UseCyclicTransform": [False],
    }
    return stage("BSplineTransform", numbers, grid, **{**geometry, **more})


EULER = [0.1, -0.2, 0.15, 0.6, -0.4, 0.3]


def make_cases(folder: Path) -> dict[str, tuple[Path, Grid]]:
    """Every kind of chain: name -> (file to give to transformix, image grid)."""
    cases: dict[str, tuple[Path, Grid]] = {}

    def place(name: str) -> Path:
        (folder / name).mkdir()
        return folder / name

    for name, control, image in (
        ("aligned", np.eye(3), np.eye(3)),
        ("oblique", OBLIQUE, OBLIQUE),
        ("permuted", OBLIQUE, OBLIQUE @ PERMUTED),
        ("left-handed", OBLIQUE @ MIRROR, OBLIQUE @ MIRROR),
        ("askew", OBLIQUE, np.eye(3)),
    ):
        grid = image_grid(image)
        cases[name] = (write_elastix_transform(place(name), spline(control), None, grid)[-1], grid)
    grid = image_grid(OBLIQUE)
    files = write_elastix_transform(place("spline then motion"), spline(OBLIQUE), MOTION, grid)
    cases["spline then motion"] = (files[-1], grid)
    centred: dict[str, list[object]] = {"CenterOfRotationPoint": [2.0, -1.0, 3.0]}
    add: dict[str, list[object]] = {"HowToCombineTransforms": ["Add"]}
    euler = stage("EulerTransform", EULER, grid, **centred)
    zyx = stage("EulerTransform", EULER, grid, **centred, ComputeZYX=[True])
    affine = stage("AffineTransform", [1.1, 0.05, 0, 0, 0.95, 0.1, -0.05, 0, 1, 1, -2, 0.5], grid, **centred)
    similar = stage("SimilarityTransform", [0.1, -0.05, 0.2, 1.0, 0.5, -1.0, 1.05], grid, **centred)
    shift = stage("TranslationTransform", [0.5, -0.25, 1.5], grid)
    b = spline(OBLIQUE)
    moved_index = spline_stage(
        b,
        grid,
        GridIndex=[-2, 1, 3],
        GridOrigin=(b.control.origin_mm - OBLIQUE @ (b.control.spacing_mm * [-2, 1, 3])).tolist(),
    )
    for name, stages in {
        "motion then spline": (euler, spline_stage(b, grid)),
        "zyx, affine, translation": (zyx, affine, shift),
        "similarity": (similar,),
        "grid index": (moved_index,),
        "recursive": (spline_stage(b, grid).replace("BSplineTransform", "RecursiveBSplineTransform", 1),),
        "splines added": (spline_stage(b, grid), spline_stage(spline(OBLIQUE, seed=2), grid, **add)),
        "affine and spline added": (affine, spline_stage(b, grid, **add)),
    }.items():
        cases[name] = (chain(place(name), *stages), grid)
    # Voxels on, and to both sides of, the faces of the valid region; every number here is exact in binary.
    rng = np.random.default_rng(3)
    square = BSpline(Grid((6, 6, 6), (4.0,) * 3, (-8.0,) * 3), rng.normal(size=(3, 6, 6, 6)))
    grid = Grid((9, 9, 9), (2.0,) * 3, (-6.0,) * 3)
    cases["borders"] = (write_elastix_transform(place("borders"), square, None, grid)[-1], grid)
    return cases


CASE_NAMES = [
    "aligned",
    "oblique",
    "permuted",
    "left-handed",
    "askew",
    "spline then motion",
    "motion then spline",
    "zyx, affine, translation",
    "similarity",
    "grid index",
    "recursive",
    "splines added",
    "affine and spline added",
    "borders",
]


@pytest.fixture(scope="session")
def cases(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[Path, Grid]]:
    made = make_cases(tmp_path_factory.mktemp("transformix"))
    assert sorted(made) == sorted(CASE_NAMES)
    return made


@pytest.fixture(scope="session")
def transformix(cases: dict[str, tuple[Path, Grid]], worker: Worker, computed_once) -> dict[str, np.ndarray]:
    """What transformix says of every case: displacement, F and points."""
    for file, grid in cases.values():
        rows = [" ".join(repr(float(v)) for v in p) for p in off_grid_points(grid)]
        (file.parent / "points.txt").write_text("\n".join(["point", str(len(rows)), *rows]) + "\n")
    files = {name: file for name, (file, _) in cases.items()}
    return computed_once("transformix", lambda: worker.run("transformix", transformed, files))


def off_grid_points(grid: Grid) -> np.ndarray:
    indices = np.random.default_rng(5).uniform(0.3, np.array(grid.shape) - 1.3, size=(40, 3))
    return grid.points_at(indices)


@pytest.mark.parametrize("name", CASE_NAMES)
def test_equals_transformix(name: str, cases: dict[str, tuple[Path, Grid]], transformix: dict[str, np.ndarray]) -> None:
    file, grid = cases[name]
    deformation = read_transform(file)
    u, H = evaluate_on_grid(deformation, grid)
    their_u = transformix[name + ".u"].transpose(2, 1, 0, 3).reshape(-1, 3)
    their_H = transformix[name + ".F"].transpose(2, 1, 0, 3).reshape(-1, 3, 3) - np.eye(3)
    if name == "recursive":
        their_H = -their_H  # as of itk-elastix 0.25.4; the same map under the name BSplineTransform is right
    defined = np.isfinite(u).all(axis=1)
    np.testing.assert_allclose(u[defined], their_u[defined], rtol=0, atol=1e-5)  # theirs is single precision
    np.testing.assert_allclose(H[defined], their_H[defined], rtol=0, atol=1e-6)
    assert np.abs(u[defined]).max() > 0.1
    points = off_grid_points(grid)
    x = points + deformation.displacement(points)
    known = np.isfinite(x).all(axis=1)
    np.testing.assert_allclose(x[known], transformix[name + ".x"][known], rtol=0, atol=1e-5)  # printed to 1e-6
    if name == "borders":
        identity = (their_u == 0).all(axis=1) & (their_H == 0).all(axis=(1, 2))
        assert np.array_equal(identity, ~defined)
        assert np.array_equal(~np.isfinite(H).all(axis=(1, 2)), ~defined)
        inside = defined.reshape(grid.shape)
        assert inside[1:7, 1:7, 1:7].all()  # -4 mm, the near faces, to 6 mm
        assert inside.sum() == 6**3  # not 8 mm, the far faces
    else:
        assert defined.all()
        assert known.all()


def test_kinds_read_back(cases: dict[str, tuple[Path, Grid]]) -> None:
    kinds = {name: type(read_transform(file)) for name, (file, _) in cases.items()}
    assert kinds["aligned"] is BSpline
    assert kinds["splines added"] is BSpline
    assert kinds["similarity"] is Affine
    assert kinds["affine and spline added"] is Added
    composed = read_transform(cases["spline then motion"][0])
    assert isinstance(composed, Composed)
    assert [type(part) for part in composed.parts] == [BSpline, RigidMotion]


def test_written_elastix_transform_is_read_back_to_the_last_digit(tmp_path: Path) -> None:
    b = spline(OBLIQUE @ MIRROR)
    first, second = write_elastix_transform(tmp_path, b, MOTION, image_grid(OBLIQUE))
    again = bspline_from_elastix(parse_parameters(first.read_text()))
    assert np.array_equal(again.coefficients_mm, b.coefficients_mm)
    assert again.control.same_as(b.control, tolerance_voxels=0.0)
    motion = rigid_from_elastix(parse_parameters(second.read_text()))
    np.testing.assert_allclose(motion.rotation, MOTION.rotation, rtol=0, atol=1e-15)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "TransformParameters.0.txt",
        "TransformParameters.1.txt",
    ]


@pytest.mark.parametrize("angles", [[90, 30, -20], [-90, 10, 40], [180, 0, 0], [0, 180, 0], [89.9999999, 40, 5]])
def test_right_angles_survive_euler_angles(tmp_path: Path, angles: list[float]) -> None:
    rotation = Rotation.from_euler("ZXY", [angles[2], angles[0], angles[1]], degrees=True).as_matrix()
    motion = RigidMotion(rotation, np.array([1.0, 2.0, 3.0]))
    files = write_elastix_transform(tmp_path, spline(np.eye(3)), motion, image_grid(np.eye(3)))
    again = rigid_from_elastix(parse_parameters(files[1].read_text()))
    np.testing.assert_allclose(again.rotation, rotation, rtol=0, atol=1e-15)


# --- refusals ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (('UseCyclicTransform "false"', 'UseCyclicTransform "true"'), "cyclic"),
        (("SplineOrder 3", "SplineOrder 2"), "cubic"),
        (("BSplineTransform", "SplineKernelTransform"), "SplineKernelTransform.* is not supported"),
        (("GridSpacing 4.0", "GridSpacing -4.0"), "Voxel spacing"),
        (("GridSize 8", "GridSize 7"), "TransformParameters has 2160 numbers; 1890"),
        (("GridSize 8", "GridSize eight"), "GridSize has a value that is not a number"),
        (("GridSize 8", "GridSize nan"), "GridSize has numbers that are not finite"),
        (("GridSize 8", "GridSize 1e300"), "GridSize must be three whole numbers"),
        (("GridSize 8", "GridSize 8_0"), "GridSize has a value that is not a number"),
        (("FixedImageDimension 3", "FixedImageDimension 2"), "FixedImageDimension is 2"),
        (("(GridOrigin", "(GridOrigins"), "GridOrigin is missing"),
        (("TransformParameters 0", "TransformParameters nan 0"), "2161"),
        (("(Size", "(Size 1)\n(Size"), "line .*Size is given more than once"),
        (('"NoInitialTransform"', '"gone.txt"'), r"'gone\.txt' is missing"),
        (('"NoInitialTransform"', '"TransformParameters.0.txt"'), "back to this file"),
        (('UseDirectionCosines "true"', 'UseDirectionCosines "false"'), "not in LPS"),
        (
            ("(Size", '(UseBinaryFormatForTransformationParameters "true")\n(Size'),
            "binary",
        ),
    ],
)
def test_refuses_elastix_files(tmp_path: Path, change: tuple[str, str], message: str) -> None:
    b = BSpline(spline(OBLIQUE).control, np.zeros((3, 8, 9, 10)))
    (path,) = write_elastix_transform(tmp_path, b, None, image_grid(OBLIQUE))
    text = path.read_text()
    assert change[0] in text
    path.write_text(text.replace(*change, 1))
    with pytest.raises((ParameterError, InputError), match=message) as refused:
        read_transform(path)
    assert str(path) in str(refused.value)


def test_refuses_a_diverged_spline_but_hands_it_to_the_caller_of_a_map(tmp_path: Path) -> None:
    b = BSpline(spline(OBLIQUE).control, np.full((3, 8, 9, 10), np.nan))
    (path,) = write_elastix_transform(tmp_path, b, None, image_grid(OBLIQUE))
    with pytest.raises(ParameterError, match="diverged"):
        read_transform(path)
    assert np.isnan(bspline_from_elastix(parse_parameters(path.read_text())).coefficients_mm).all()


def test_refuses_wrong_combination_and_unknown_rigid(tmp_path: Path) -> None:
    grid = image_grid(OBLIQUE)
    files = write_elastix_transform(tmp_path, spline(OBLIQUE), MOTION, grid)
    files[1].write_text(files[1].read_text().replace('"Compose"', '"Multiply"'))
    with pytest.raises(ParameterError, match="it is 'Multiply'"):
        read_transform(files[1])
    with pytest.raises(ParameterError, match="supported: EulerTransform"):
        rigid_from_elastix({"Transform": ("AffineTransform",)})


def test_refuses_missing_truncated_and_two_dimensional_files(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such transform file"):
        read_transform(tmp_path / "none.txt")
    whole = write_itk_transform(tmp_path / "map.h5", spline(OBLIQUE))
    cut = tmp_path / "cut.h5"
    cut.write_bytes(whole.read_bytes()[:3000])
    with pytest.raises(InputError, match=re.escape(str(cut))):
        read_transform(cut)
    sitk.WriteTransform(sitk.Euler2DTransform(), str(tmp_path / "flat.tfm"))
    with pytest.raises(InputError, match="2D transform"):
        read_transform(tmp_path / "flat.tfm")
    (tmp_path / "noise.txt").write_bytes(bytes(range(256)))
    with pytest.raises(InputError, match=r"noise\.txt"):
        read_transform(tmp_path / "noise.txt")


def test_refuses_outputs_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        write_elastix_transform(tmp_path / "none", spline(OBLIQUE), None, image_grid(OBLIQUE))
    with pytest.raises(OutputError, match="cannot be written"):
        write_itk_transform(tmp_path / "none" / "map.h5", spline(OBLIQUE))
    with pytest.raises(InputError, match=r"\.h5 or \.tfm"):
        write_itk_transform(tmp_path / "map.nii", spline(OBLIQUE))
