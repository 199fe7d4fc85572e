"""A model from another code, in metres and RAS, read into the frame of the image."""

import matplotlib.pyplot as plt
import meshio
import numpy as np
import pyvista as pv

import dvc
import validate

# What Abaqus would have written: bricks in an input file, and a table of nodal displacements, here a shear along P.
bricks = pv.StructuredGrid(*np.meshgrid(*3 * [np.linspace(0.0, 0.02, 11)], indexing="ij")).cast_to_unstructured_grid()
meshio.write_points_cells("block.inp", bricks.points, [("hexahedron", bricks.cells.reshape(-1, 9)[:, 1:])])
u = np.zeros_like(bricks.points)
u[:, 1] = -10.0 * bricks.points[:, 2] ** 2  # RAS: y points to the front
table = np.column_stack([np.arange(1, len(u) + 1), u])
np.savetxt("Load1.csv", table, "%.9g", ",", header="Node Label,U-U1,U-U2,U-U3", comments="")

model = validate.read_result("mine", "Load1.csv", mesh="block.inp", unit="m", frame="RAS").deformation
y, z = np.meshgrid(np.linspace(-19.0, -1.0, 73), np.linspace(1.0, 19.0, 73))
u_mm, gradient = model.evaluate(np.column_stack([np.full(y.size, -10.0), y.ravel(), z.ravel()]))  # LPS, mm
assert np.isclose(u_mm[:, 1].max(), 10.0 * 0.019**2 * 1000.0, atol=0.02)

shear = dvc.StrainField.from_gradient(gradient).max_shear.reshape(y.shape)
plt.style.use(dvc.FIGURE_STYLE)
plt.imshow(shear, origin="lower", extent=(-19, -1, 1, 19))
plt.gca().set(xlabel="P, mm", ylabel="S, mm")
plt.colorbar(label="maximum shear strain")
plt.savefig("other_code.webp")
