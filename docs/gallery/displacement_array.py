"""The strain of a displacement that you have as an array."""

import matplotlib.pyplot as plt
import numpy as np

import dvc

grid = dvc.Grid((40, 40, 30), spacing_mm=(1.0, 1.0, 1.0), origin_mm=(0.0, 0.0, 0.0))
x, y, z = np.moveaxis(grid.points(), -1, 0)  # of every voxel, LPS mm
u = np.zeros((*grid.shape, 3))
u[..., 1] = 5.0 * np.exp(-((z - 15.0) ** 2) / 40.0)  # a layer slides along y

field = dvc.SampledDisplacement(grid, u)
maps = dvc.strain_maps(field, dvc.Mask(grid, np.ones(grid.shape, dtype=bool)))

gamma = u[..., 1] * (z - 15.0) / 20.0  # du_y/dz by hand
exact = np.abs(gamma) / 2.0 * np.sqrt(1.0 + gamma**2 / 4.0)
assert np.abs(maps.max_shear - exact)[:, :, 2:-2].max() < 0.002

plt.style.use(dvc.FIGURE_STYLE)
plt.imshow(maps.max_shear[20].T, origin="lower", extent=(0, 40, 0, 30))
plt.gca().set(xlabel="y, mm", ylabel="z, mm")
plt.colorbar(label="maximum shear strain")
plt.savefig("displacement_array.webp")
