"""Two published material sets compared with a measurement."""

import numpy as np

import dvc
import fe
import validate

values = np.full((9, 12, 12), 1)  # fat
values[0], values[-2:] = 2, 3  # skin, bone
grid = dvc.Grid(values.shape, spacing_mm=(2.5, 2.5, 2.5), origin_mm=(0.0, 0.0, 0.0))
labels = dvc.LabelMap(grid, values, {1: "fat", 2: "skin", 3: "bone"})
mesh, _ = fe.mesh_labels(labels, edge_mm=4.0)
plate, load = fe.Plate(normal=(-1, 0, 0), shear=(0, 1, 0)), fe.LoadStep("Load1", normal_n=15.0, shear_n=12.0)
simulated = {
    name: fe.simulate(mesh, name, plate, [load]).deformation("Load1") for name in ("trebbi", "erdemir", "luboz")
}

measured = simulated.pop("trebbi")  # stands for a measurement: dvc.Measurement.read("results/Load1")
models = [validate.FeResult.of(name, deformation) for name, deformation in simulated.items()]
comparison = validate.compare([validate.LoadCase.of("Load1", measured, models)], labels, bones=["bone"])
print(comparison)
area = {one.model: one.ml for one in comparison.areas if one.tissue == validate.ALL}
assert area["luboz"] < area["erdemir"]

comparison.plot("curves").savefig("compare.webp", dpi=80)
