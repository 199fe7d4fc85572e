"""The written maps, opened in nibabel and in SimpleITK."""

import matplotlib.pyplot as plt
import nibabel as nib
import numpy as np
import SimpleITK as sitk

import dvc
import phantoms

heel, grid = phantoms.Heel(seed=1), phantoms.heel_grid(spacing_mm=2.5)
labels = phantoms.labels_of(heel, grid)
tissue = dvc.Mask(grid, labels.labels > 0)
subject = dvc.Subject(phantoms.scan(heel, grid, snr=25.0, number=0), tissue=tissue, labels=labels)
dvc.Measurement.from_deformation(phantoms.under_load(heel, "Load1"), subject).write("Load1")

shear = nib.load("Load1/max_shear.nii.gz")
u = sitk.ReadImage("Load1/displacement.nrrd")  # components are LPS in both copies; NRRD keeps NaN in ITK
index = np.unravel_index(np.nanargmax(shear.get_fdata()), shear.shape)
ras = shear.affine @ [*index, 1.0]
lps = u.TransformIndexToPhysicalPoint([int(i) for i in index])
print(f"largest max. shear {shear.get_fdata()[index]:.2f} at {ras[:3].round(1)} RAS, {np.round(lps, 1)} LPS")
assert np.allclose(ras[:3] * [-1, -1, 1], lps, atol=1e-3)

plt.style.use(dvc.FIGURE_STYLE)
plt.imshow(np.rot90(shear.get_fdata()[index[0]]), vmax=0.6)
plt.axis("off")
plt.colorbar(label="maximum shear strain")
plt.savefig("nibabel_simpleitk.webp")
