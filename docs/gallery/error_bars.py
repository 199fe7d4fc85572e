"""Error bars, compared with the true error of a phantom."""

import matplotlib.pyplot as plt
import numpy as np

import dvc
import phantoms

heel = phantoms.Heel(seed=4)
grid = phantoms.heel_grid(spacing_mm=1.2)
labels, motion = phantoms.labels_of(heel, grid), phantoms.under_load(heel, "Load1")
unloaded = phantoms.scan(heel, grid, snr=25.0, number=0)
loaded = phantoms.scan(heel, grid, motion, phantoms.random_foot_motion(4, 1), snr=25.0, number=1)
measured = dvc.measure(unloaded, loaded, bone=labels.region("bone"), labels=labels)

fat = labels.region("fat").inside & np.isfinite(measured.sigma)
true = dvc.strain_maps(motion, dvc.Mask(grid, fat)).max_shear
error = (measured.max_shear - measured.bias - true)[fat] / measured.sigma[fat]
held = np.mean(np.abs(error) < 1.96)
print(f"{100 * held:.0f} % of the voxels of fat lie within 1.96 standard uncertainties")
assert held > 0.85

plt.style.use(dvc.FIGURE_STYLE)
plt.hist(error, bins=60, range=(-5, 5), density=True)
z = np.linspace(-5, 5, 201)
plt.plot(z, np.exp(-(z**2) / 2) / np.sqrt(2 * np.pi), "k")
plt.gca().set(xlabel="(true error − bias) / standard uncertainty", yticks=[])
plt.savefig("error_bars.webp")
