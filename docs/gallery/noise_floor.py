"""The noise floor: the apparent strain between two unloaded images."""

import matplotlib.pyplot as plt
import numpy as np

import dvc
import phantoms

pair = phantoms.heel_pair(3, shape=(44, 50, 46), spacing_mm=2.3, load=0.6)
settings = dvc.Settings(dvc.GaussNewton(bending=4.0, volume=300.0))  # those of the loaded pair
repeat = dvc.measure(pair.reference, pair.repeat, bone=pair.bone, settings=settings)

soft = (pair.labels.labels > 0) & ~pair.bone.inside & repeat.maps.valid
loaded = dvc.strain_maps(pair.deformation, dvc.Mask(pair.reference.grid, soft))
floor, strained = (np.median(max_shear[soft]) for max_shear in (repeat.max_shear, loaded.max_shear))
print(f"median max. shear: {floor:.3f} without load, {strained:.3f} under load")
assert floor < 0.03 < strained

plt.style.use(dvc.FIGURE_STYLE)
for max_shear, name in ((repeat.max_shear, "unloaded twice, measured"), (loaded.max_shear, "loaded, true")):
    plt.hist(max_shear[soft], bins=np.linspace(0, 0.3, 61), histtype="step", label=name)
plt.gca().set(xlabel="maximum shear strain", ylabel="voxels")
plt.legend()
plt.savefig("noise_floor.webp")
