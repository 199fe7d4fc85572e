"""A block of fat under skin, pressed and then sheared by a plate."""

import numpy as np

import dvc
import fe

values = np.full((7, 12, 12), 1)  # fat
values[0], values[-2:] = 2, 3  # skin, bone
grid = dvc.Grid(values.shape, spacing_mm=(2.5, 2.5, 2.5), origin_mm=(0.0, 0.0, 0.0))
mesh, _ = fe.mesh_labels(dvc.LabelMap(grid, values, {1: "fat", 2: "skin", 3: "bone"}), edge_mm=4.0)

plate = fe.Plate(normal=(-1, 0, 0), shear=(0, 1, 0))
loads = [fe.LoadStep("press", normal_n=6.0), fe.LoadStep("shear", normal_n=6.0, shear_n=2.0)]
simulation = fe.simulate(mesh, "trebbi", plate, loads)
print(simulation)

sheared = simulation.state("shear")
assert np.allclose(sheared.force_n[:2], [6.0, 2.0], atol=0.01)

simulation.plot().savefig("plate.webp", dpi=70)
