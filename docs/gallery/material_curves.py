"""Published constitutive models of fat, pulled and compressed along one axis."""

import matplotlib.pyplot as plt
import numpy as np

import dvc
import fe

plt.style.use(dvc.FIGURE_STYLE)
stretch = np.linspace(0.6, 1.4, 81)
for name in fe.published_names():
    materials = fe.material_set(name).materials
    fat = materials.get("fat") or materials["all"]
    low, high = fat.stable_range("uniaxial")
    stable = (stretch >= low) & (stretch <= high)
    plt.plot(stretch[stable], 1000.0 * fat.nominal_stress(stretch[stable], "uniaxial"), label=name)

trebbi = fe.material_set("trebbi").materials["fat"]
young_kpa = 1000.0 * np.diff(trebbi.nominal_stress([0.999, 1.001]))[0] / 0.002
print(f"trebbi: {young_kpa:.1f} kPa, three times the shear modulus of {1000.0 * trebbi.shear_modulus_mpa:.2f} kPa")
assert abs(young_kpa / (3000.0 * trebbi.shear_modulus_mpa) - 1.0) < 0.001

plt.gca().set(xlabel="stretch", ylabel="nominal stress, kPa", ylim=(-60, 40))
plt.legend()
plt.savefig("material_curves.webp")
