"""Writing a registration's result as transform files of elastix and of ITK."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import SimpleITK as sitk

from dvc.arrays import FloatArray
from dvc.atomic_files import whole_file, write_whole
from dvc.deformation.bordered_spline import BorderedSpline, Spline
from dvc.deformation.bspline import BSpline
from dvc.deformation.protocol import RigidMotion
from dvc.errors import InputError
from dvc.images.image import Grid
from dvc.io.transforms.elastix_text import Value, format_parameters

StrPath = str | os.PathLike[str]

ELASTIX_FILES = ("TransformParameters.0.txt", "TransformParameters.1.txt")
"""Names of the files of a chain: a B-spline, and the rigid motion that follows."""
_NO_INITIAL = "NoInitialTransform"


def write_elastix_transform(folder: StrPath, bspline: BSpline, then: RigidMotion | None, reference: Grid) -> list[Path]:
    """Write ``x = R (X + u(X)) + t`` as a chain of elastix transform files that transformix reads.

    TransformParameters.0.txt holds the B-spline; TransformParameters.1.txt, where ``then`` is given, the
    motion that follows, with the first as its initial transform. Coefficients are written with all their
    digits.

    Parameters
    ----------
    folder : existing folder
    bspline : BSpline
    then : RigidMotion, optional
        The motion (R, t) after the B-spline.
    reference : Grid
        The grid that transformix resamples a moving image to; either handedness.

    Returns
    -------
    list of Path
        The files; the last is the one to give to transformix.

    Raises
    ------
    OutputError
        If a file cannot be written; nothing is left under its name.
    """
    control = bspline.control
    stages: list[dict[str, Sequence[Value]]] = [
        {
            # RecursiveBSplineTransform is the same map, but elastix then gives I - H as its Jacobian.
            "Transform": ["BSplineTransform"],
            "NumberOfParameters": [bspline.coefficients_mm.size],
            "TransformParameters": np.concatenate([c.ravel(order="F") for c in bspline.coefficients_mm]).tolist(),
            "InitialTransformParameterFileName": [_NO_INITIAL],
            "GridSize": list(control.shape),
            "GridIndex": [0, 0, 0],
            "GridSpacing": control.spacing_mm.tolist(),
            "GridOrigin": control.origin_mm.tolist(),
            "GridDirection": control.direction.T.ravel().tolist(),
            "BSplineTransformSplineOrder": [3],
            "UseCyclicTransform": [False],
        }
    ]
    if then is not None:
        stages.append(
            {
                "Transform": ["EulerTransform"],
                "NumberOfParameters": [6],
                "TransformParameters": [*_euler_angles(then.rotation), *then.translation_mm.tolist()],
                "InitialTransformParameterFileName": [ELASTIX_FILES[0]],
                "CenterOfRotationPoint": [0.0, 0.0, 0.0],
                "ComputeZYX": [False],
            }
        )
    image: dict[str, Sequence[Value]] = {
        "HowToCombineTransforms": ["Compose"],
        "FixedImageDimension": [3],
        "MovingImageDimension": [3],
        "FixedInternalImagePixelType": ["float"],
        "MovingInternalImagePixelType": ["float"],
        "Size": list(reference.shape),
        "Index": [0, 0, 0],
        "Spacing": reference.spacing_mm.tolist(),
        "Origin": reference.origin_mm.tolist(),
        "Direction": reference.direction.T.ravel().tolist(),
        "UseDirectionCosines": [True],
        "ResampleInterpolator": ["FinalBSplineInterpolator"],
        "FinalBSplineInterpolationOrder": [3],
        "Resampler": ["DefaultResampler"],
        "DefaultPixelValue": [0],
        "ResultImageFormat": ["nii.gz"],
        "ResultImagePixelType": ["float"],
        "CompressResultImage": [True],
    }
    written = []
    for name, stage in zip(ELASTIX_FILES, stages, strict=False):
        path = Path(folder) / name
        write_whole(path, format_parameters({**stage, **image}))
        written.append(path)
    return written


def _euler_angles(rotation: FloatArray) -> list[float]:
    """Angles (x, y, z) of R = Rz Rx Ry."""
    x = np.arctan2(rotation[2, 1], np.hypot(rotation[2, 0], rotation[2, 2]))
    y = np.arctan2(-rotation[2, 0], rotation[2, 2])
    # From Rz Rx = R Ry^T and not from R: where x is close to a right angle, y is hardly determined, and z
    # must be the one that belongs to the y chosen.
    z = np.arctan2(
        rotation[1, 0] * np.cos(y) + rotation[1, 2] * np.sin(y),
        rotation[0, 0] * np.cos(y) + rotation[0, 2] * np.sin(y),
    )
    return [float(x), float(y), float(z)]


def write_itk_transform(path: StrPath, bspline: Spline, then: RigidMotion | None = None) -> Path:
    """Write ``x = R (X + u(X)) + t`` as an ITK composite transform (.h5 or .tfm), as 3D Slicer reads it.

    ITK has no spline with borders: of a `BorderedSpline` u is written at the voxels on which it was found, the box
    around the tissue. Between them ITK interpolates linearly; outside the box, as outside a B-spline, it takes u as 0.

    Raises
    ------
    InputError
        If the name ends in neither.
    OutputError
        If the file cannot be written; nothing is left under its name.
    """
    place = Path(path)
    if place.suffix.lower() not in (".h5", ".tfm"):
        raise InputError(f"{place}: ITK transforms are written as .h5 or .tfm; choose one of these endings.")
    composite = sitk.CompositeTransform(3)
    if then is not None:  # what is added last acts first
        motion = sitk.AffineTransform(3)
        motion.SetMatrix(then.rotation.ravel().tolist())
        motion.SetTranslation(then.translation_mm.tolist())
        composite.AddTransform(motion)
    if isinstance(bspline, BorderedSpline):
        grid = bspline.borders.grid
        u = bspline.displacement(grid.points().reshape(-1, 3)).reshape(*grid.shape, 3)
        composite.AddTransform(sitk.DisplacementFieldTransform(_itk_image(grid, u)))
    else:
        images = [_itk_image(bspline.control, component) for component in bspline.coefficients_mm]
        composite.AddTransform(sitk.BSplineTransform(images, 3))
    with whole_file(place) as part:
        try:
            sitk.WriteTransform(composite, os.fspath(part))
        except RuntimeError as failure:
            raise OSError(str(failure)) from failure
    return place


def _itk_image(grid: Grid, values: FloatArray) -> sitk.Image:
    """Values (ni, nj, nk) or (ni, nj, nk, components) as an image of ITK."""
    reordered = np.ascontiguousarray(np.moveaxis(values, (0, 1, 2), (2, 1, 0)))
    image = sitk.GetImageFromArray(reordered, isVector=values.ndim == 4)
    image.SetSpacing(grid.spacing_mm.tolist())
    image.SetOrigin(grid.origin_mm.tolist())
    image.SetDirection(grid.direction.ravel().tolist())
    return image
