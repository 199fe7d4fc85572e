"""A hyperelastic material of your own, fitted to a test and checked for stability."""

import matplotlib.pyplot as plt
import numpy as np

import dvc
import fe

truth = fe.Ogden.of([0.004, 0.001], [4.0, -8.0])  # two terms: initial shear moduli (MPa) and exponents
stretch = np.linspace(0.6, 1.3, 15)
stress = truth.nominal_stress(stretch, "uniaxial") * np.random.default_rng(1).normal(1.0, 0.03, 15)

fitted = fe.fit([fe.Curve("uniaxial", stretch, stress)], "Yeoh")
mine = fitted.material
print(mine.description, "stable from", *mine.stable_range("uniaxial"))
assert abs(mine.shear_modulus_mpa / truth.shear_modulus_mpa - 1.0) < 0.3

plt.style.use(dvc.FIGURE_STYLE)
many = np.linspace(0.55, 1.35, 81)
plt.plot(stretch, 1000.0 * stress, "o", label="test")
for n, mode in enumerate(fe.MODES):  # a test in one direction says little about the others
    for law, line in ((truth, ":"), (mine, "-")):
        plt.plot(many, 1000.0 * law.nominal_stress(many, mode), line, color=f"C{n}", label=f"{law.law}, {mode}")
plt.gca().set(xlabel="stretch", ylabel="nominal stress, kPa", ylim=(-60, 20))
plt.legend()
plt.savefig("own_material.webp")
