"""Strain from a transform that elastix, ITK or 3D Slicer wrote."""

import matplotlib.pyplot as plt
import numpy as np
import SimpleITK as sitk

import dvc

spline = sitk.BSplineTransform(3, 3)  # stands for your own: .tfm, .h5, or the last TransformParameters.*.txt
spline.SetTransformDomainPhysicalDimensions((40.0, 40.0, 40.0))
spline.SetTransformDomainMeshSize((5, 5, 5))
spline.SetParameters(np.random.default_rng(1).normal(0.0, 1.0, len(spline.GetParameters())))
sitk.WriteTransform(spline, "transform.tfm")

found = dvc.read_transform("transform.tfm")
points = np.stack(np.meshgrid([20.0], np.linspace(1, 39, 77), np.linspace(1, 39, 77), indexing="ij"), -1).reshape(-1, 3)
u, gradient = found.evaluate(points)  # exact derivatives of the spline, not differences
strain = dvc.StrainField.from_gradient(gradient)

itk = np.array([spline.TransformPoint(point) for point in points.tolist()]) - points
assert np.abs(u - itk).max() < 1e-9

plt.style.use(dvc.FIGURE_STYLE)
plt.imshow(strain.max_shear.reshape(77, 77).T, origin="lower", extent=(1, 39, 1, 39))
plt.gca().set(xlabel="y, mm", ylabel="z, mm")
plt.colorbar(label="maximum shear strain")
plt.savefig("transform.webp")
