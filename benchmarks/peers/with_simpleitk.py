"""SimpleITK: B-spline, normalised correlation, LBFGS-B.

LBFGS-B refuses SimpleITK's own refinement of the control grid between levels (it wants as many scales as the coarse
grid has parameters), so each level is a registration of its own, begun at the refined B-spline of the one before.
"""

import numpy as np
import SimpleITK as sitk
from exchange import arguments

COARSEST_MM = 32.0  # control points; halved at each level
# Shrink factor, smoothing (mm), part of the voxels sampled, iterations: by level. No level at 4 mm, and few
# samples: time grows with samples times parameters, and 8 mm on a tenth of the voxels had not ended after 6 minutes.
LEVELS = ((4, 3.0, 1.0, 40), (2, 1.5, 0.5, 40), (1, 0.8, 0.06, 50))
SEED = 1


def main() -> None:
    folder, threads = arguments()
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(threads)
    fixed = sitk.ReadImage(str(folder / "reference.mha"), sitk.sitkFloat32)
    moving = sitk.ReadImage(str(folder / "loaded.mha"), sitk.sitkFloat32)
    mask = sitk.BinaryDilate(sitk.ReadImage(str(folder / "mask.mha"), sitk.sitkUInt8), [4, 4, 4])
    mesh = [max(1, round(n * s / COARSEST_MM)) for n, s in zip(fixed.GetSize(), fixed.GetSpacing(), strict=True)]
    spline = sitk.BSplineTransformInitializer(fixed, mesh, 3)
    for number, (shrink, smoothing_mm, sampled, iterations) in enumerate(LEVELS):
        if number:
            spline = _refined(fixed, spline)
        method = sitk.ImageRegistrationMethod()
        method.SetMetricAsCorrelation()
        method.SetMetricFixedMask(mask)
        method.SetMetricSamplingStrategy(method.RANDOM if sampled < 1.0 else method.NONE)
        method.SetMetricSamplingPercentage(sampled, SEED)
        method.SetInterpolator(sitk.sitkLinear)
        method.SetShrinkFactorsPerLevel([shrink])
        method.SetSmoothingSigmasPerLevel([smoothing_mm])
        method.SmoothingSigmasAreSpecifiedInPhysicalUnitsOn()
        method.SetOptimizerAsLBFGSB(
            gradientConvergenceTolerance=1e-9,
            numberOfIterations=iterations,
            maximumNumberOfCorrections=8,
            maximumNumberOfFunctionEvaluations=2 * iterations,
            costFunctionConvergenceFactor=1e3,
        )
        method.SetInitialTransform(spline, inPlace=True)
        method.Execute(fixed, moving)
        print(method.GetOptimizerIteration(), method.GetOptimizerStopConditionDescription(), method.GetMetricValue())
    sitk.WriteTransform(spline, str(folder / "found.tfm"))


def _refined(domain: sitk.Image, spline: sitk.BSplineTransform) -> sitk.BSplineTransform:
    """The same B-spline with twice as many control points along each axis."""
    mesh = spline.GetTransformDomainMeshSize()
    c = np.reshape(spline.GetParameters(), (3, *(n + 3 for n in mesh[::-1])))
    for axis in (1, 2, 3):
        c = np.moveaxis(c, axis, 0)
        finer = np.empty((2 * len(c) - 3, *c.shape[1:]))
        finer[0::2] = (c[:-1] + c[1:]) / 2
        finer[1::2] = (c[:-2] + 6 * c[1:-1] + c[2:]) / 8
        c = np.moveaxis(finer, 0, axis)
    refined = sitk.BSplineTransformInitializer(domain, [2 * n for n in mesh], 3)
    refined.SetParameters(c.ravel().tolist())
    return refined


if __name__ == "__main__":
    main()
