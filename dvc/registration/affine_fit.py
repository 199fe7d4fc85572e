"""Affine registration of two subjects' images, as a start for a non-rigid one."""

import numpy as np
import SimpleITK as sitk

from dvc.deformation.protocol import Affine, RigidMotion
from dvc.errors import RegistrationError
from dvc.images.image import Image, Mask
from dvc.images.itk_image import to_sitk
from dvc.images.resample import fill_missing
from dvc.threads import usable_cores

_LEVELS = ((4, 4.0, 1.0), (2, 2.0, 0.3))  # shrinking, smoothing (mm) and share of the voxels that are compared
_FIRST_STEP_MM, _LAST_STEP_MM, _STEPS, _SHORTER = 2.0, 1e-3, 100, 0.6


def affine_fit(reference: Image, other: Image, body: Mask, other_body: Mask) -> Affine:
    """Affine map, LPS mm, from points of a reference image to those of another image, by the highest correlation.

    The search starts with the centroids of the two bodies (masks on the grids of the images) on each other, so both
    must lie roughly in the same orientation. RegistrationError if the images do not overlap.
    """
    fit, start, middle = sitk.ImageRegistrationMethod(), sitk.AffineTransform(3), body.points().mean(axis=0)
    start.SetCenter(middle.tolist())
    start.SetTranslation((other_body.points().mean(axis=0) - middle).tolist())
    shrinking, smoothing, shares = zip(*_LEVELS, strict=True)
    fit.SetMetricAsCorrelation()
    fit.SetMetricSamplingStrategy(fit.REGULAR)
    fit.SetMetricSamplingPercentagePerLevel(shares)
    fit.SetShrinkFactorsPerLevel(shrinking)
    fit.SetSmoothingSigmasPerLevel(smoothing)
    fit.SmoothingSigmasAreSpecifiedInPhysicalUnitsOn()
    fit.SetInterpolator(sitk.sitkLinear)
    fit.SetOptimizerAsRegularStepGradientDescent(_FIRST_STEP_MM, _LAST_STEP_MM, _STEPS, relaxationFactor=_SHORTER)
    fit.SetOptimizerScalesFromPhysicalShift()
    fit.SetInitialTransform(start, inPlace=True)
    fit.SetNumberOfThreads(usable_cores())
    images = [to_sitk(one.grid, fill_missing(one).values) for one in (reference, other)]
    try:
        fit.Execute(*images)
    except RuntimeError as failure:
        raise RegistrationError(
            "The affine registration of the two images failed: they do not overlap. Check that both show the same part "
            "of the body."
        ) from failure
    matrix, centre = np.reshape(start.GetMatrix(), (3, 3)), np.array(start.GetCenter())
    return Affine(matrix, np.array(start.GetTranslation()) + centre - matrix @ centre)


def parts_of(affine: Affine, body: Mask) -> tuple[RigidMotion, Affine]:
    """An affine map as a rigid motion after a stretch that keeps the centroid of a body: x -> rigid(stretch(x))."""
    left, _, right = np.linalg.svd(affine.matrix)
    middle = body.points().mean(axis=0)
    rotation = left @ right
    rigid = RigidMotion(rotation, affine.matrix @ middle + affine.translation_mm - rotation @ middle)
    stretch = rotation.T @ affine.matrix
    return rigid, Affine(stretch, middle - stretch @ middle)
