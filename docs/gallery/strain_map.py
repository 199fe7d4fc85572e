"""Strain measured between the two images of a phantom heel."""

import numpy as np

import dvc
import phantoms

pair = phantoms.heel_pair(3, shape=(44, 50, 46), spacing_mm=2.3, load=0.6)
engine = dvc.GaussNewton(bending=4.0, volume=300.0)  # fixed to save time; by default chosen for each pair
measured = dvc.measure(pair.reference, pair.loaded, bone=pair.bone, labels=pair.labels, settings=dvc.Settings(engine))
print(measured)

fat = pair.labels.region("fat").inside & measured.maps.valid
true = dvc.strain_maps(pair.deformation, dvc.Mask(pair.reference.grid, fat)).max_shear
error = np.sqrt(np.mean((measured.max_shear - true)[fat] ** 2))
print(f"median max. shear in fat: {np.median(measured.max_shear[fat]):.3f}, error {error:.3f}")
assert error < 0.06

measured.plot("max_shear", largest=0.4).savefig("strain_map.webp", dpi=70)
