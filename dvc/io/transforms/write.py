"""Writing a registration's result as transform files of elastix and of ITK."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from dvc.arrays import FloatArray
from dvc.atomic_files import whole_file, write_whole
from dvc.deformation.bspline import BSpline
from dvc.deformation.interface_spline import InterfaceSpline
from dvc.deformation.protocol import Deformation, RigidMotion, displacement_on_grid
from dvc.errors import InputError
from dvc.images.image import Grid
from dvc.images.itk_image import to_sitk
from dvc.io import StrPath
from dvc.io.transforms.elastix_text import Value, format_parameters
from dvc.io.transforms.interface_spline import FILE as INTERFACE_SPLINE, write_interface_spline

ELASTIX_FILES = ("TransformParameters.0.txt", "TransformParameters.1.txt")
"""Names of the files of a chain: a B-spline, and the rigid motion that follows."""
_NO_INITIAL = "NoInitialTransform"


def write_elastix_transform(folder: StrPath, bspline: BSpline, then: RigidMotion | None, reference: Grid) -> list[Path]:
    """Write ``x = R (X + u(X)) + t`` as a chain of elastix transform files that transformix reads; the last is for it.

    TransformParameters.0.txt holds the B-spline; TransformParameters.1.txt, where `then` (R, t) is given, the motion
    that follows, with the first as its initial transform. transformix resamples moving images to `reference`.
    """
    control = bspline.control
    image: dict[str, Sequence[Value]] = {
        "HowToCombineTransforms": ["Compose"], "FixedImageDimension": [3], "MovingImageDimension": [3],
        "FixedInternalImagePixelType": ["float"], "MovingInternalImagePixelType": ["float"],
        "Size": list(reference.shape), "Index": [0, 0, 0],
        "Spacing": reference.spacing_mm.tolist(), "Origin": reference.origin_mm.tolist(),
        "Direction": reference.direction.T.ravel().tolist(), "UseDirectionCosines": [True],
        "ResampleInterpolator": ["FinalBSplineInterpolator"], "FinalBSplineInterpolationOrder": [3],
        "Resampler": ["DefaultResampler"], "DefaultPixelValue": [0],
        "ResultImageFormat": ["nii.gz"], "ResultImagePixelType": ["float"], "CompressResultImage": [True],
    }  # fmt: skip
    stages: list[dict[str, Sequence[Value]]] = [{
        # RecursiveBSplineTransform is the same map, but elastix then gives I - H as its Jacobian.
        "Transform": ["BSplineTransform"],
        "NumberOfParameters": [bspline.coefficients_mm.size],
        "TransformParameters": np.concatenate([c.ravel(order="F") for c in bspline.coefficients_mm]).tolist(),
        "InitialTransformParameterFileName": [_NO_INITIAL],
        "GridSize": list(control.shape), "GridIndex": [0, 0, 0],
        "GridSpacing": control.spacing_mm.tolist(), "GridOrigin": control.origin_mm.tolist(),
        "GridDirection": control.direction.T.ravel().tolist(),
        "BSplineTransformSplineOrder": [3], "UseCyclicTransform": [False],
    }]  # fmt: skip
    if then is not None:
        stages.append({
            "Transform": ["EulerTransform"], "NumberOfParameters": [6],
            "TransformParameters": [*_euler_angles(then.rotation), *then.translation_mm.tolist()],
            "InitialTransformParameterFileName": [ELASTIX_FILES[0]],
            "CenterOfRotationPoint": [0.0, 0.0, 0.0], "ComputeZYX": [False],
        })  # fmt: skip
    files = [Path(folder) / name for name, _ in zip(ELASTIX_FILES, stages, strict=False)]
    for file, stage in zip(files, stages, strict=True):
        write_whole(file, format_parameters({**stage, **image}))
    return files


def _euler_angles(rotation: FloatArray) -> list[float]:
    """Angles (x, y, z) of R = Rz Rx Ry."""
    x = np.arctan2(rotation[2, 1], np.hypot(rotation[2, 0], rotation[2, 2]))
    y = np.arctan2(-rotation[2, 0], rotation[2, 2])
    # From Rz Rx = R Ry^T and not from R: where x is close to a right angle, y is hardly determined, and z must fit it.
    cos_z, sin_z = rotation[:2, 0] * np.cos(y) + rotation[:2, 2] * np.sin(y)
    z = np.arctan2(sin_z, cos_z)
    return [float(x), float(y), float(z)]


def write_itk_transform(
    path: StrPath, displacement: Deformation, then: RigidMotion | None = None, grid: Grid | None = None
) -> Path:
    """Write ``x = R (X + u(X)) + t`` as an ITK composite transform (.h5 or .tfm), as 3D Slicer reads it.

    A B-spline is written as one. ITK has no spline with strain discontinuities: of an `InterfaceSpline` u is written at
    the voxels of its interfaces, the box around the tissue, and of any other displacement at those of `grid`. Between
    them ITK interpolates linearly; outside the box, as outside a B-spline, it takes u as 0.
    """
    place = Path(path)
    if place.suffix.lower() not in (".h5", ".tfm"):
        raise InputError(f"{place}: the name of an ITK transform must end in .h5 or .tfm.")
    composite = sitk.CompositeTransform(3)
    if then is not None:  # what is added last acts first
        motion = sitk.AffineTransform(3)
        motion.SetMatrix(then.rotation.ravel().tolist())
        motion.SetTranslation(then.translation_mm.tolist())
        composite.AddTransform(motion)
    composite.AddTransform(_itk_part(displacement, grid))
    with whole_file(place) as part:
        try:
            sitk.WriteTransform(composite, os.fspath(part))
        except RuntimeError as failure:
            raise OSError(str(failure)) from failure
    return place


def _itk_part(displacement: Deformation, grid: Grid | None) -> sitk.Transform:
    """A B-spline as one; any other displacement as a field at the voxels of a grid, 0 where it is not defined."""
    match displacement:
        case BSpline(control=control, coefficients_mm=coefficients):
            return sitk.BSplineTransform([to_sitk(control, c) for c in coefficients], 3)
        case InterfaceSpline(borders=borders):
            grid = borders.grid
    if grid is None:
        raise InputError(f"Writing a {type(displacement).__name__} for ITK needs the grid of its displacement field.")
    return sitk.DisplacementFieldTransform(
        to_sitk(grid, np.nan_to_num(displacement_on_grid(displacement, grid, np.float64), copy=False))
    )


def write_displacement_as_found(found: Deformation, folder: Path, then: RigidMotion | None, reference: Grid) -> None:
    """Write a displacement with its own gradient, if a file can hold its kind, and the motion `then` (R, t).

    A `BSpline` goes into elastix' text files (grid of transformix: `reference`), an `InterfaceSpline` into one of ours.
    """
    match found:
        case BSpline():
            write_elastix_transform(folder, found, then, reference)
        case InterfaceSpline():
            write_interface_spline(folder / INTERFACE_SPLINE, found)
