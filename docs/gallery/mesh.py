"""A label map made into a mesh of tetrahedra."""

import matplotlib.pyplot as plt
import numpy as np

import dvc
import fe
import phantoms

heel = phantoms.Heel(seed=1, size=0.7, pad_mm=12.0)
labels = phantoms.labels_to_mesh(heel, phantoms.labels_of(heel, phantoms.heel_grid(spacing_mm=1.3)))
mesh, quality = fe.mesh_labels(labels, edge_mm=5.0, bones=["bone"])
fe.write_tet_mesh("heel.vtu", mesh)

for name, cells in mesh.regions.items():
    meshed = mesh.volumes_mm3[cells].sum() / 1000.0
    drawn = labels.region(name).inside.sum() * labels.grid.voxel_volume_mm3 / 1000.0
    print(f"{name}: {len(cells)} cells, {meshed:.1f} mL of {drawn:.1f}")
print(f"smallest dihedral angle {quality.least_angle_deg:.0f} degrees")
assert quality.least_angle_deg > 5.0

plt.style.use(dvc.FIGURE_STYLE)
axes = plt.figure().add_subplot(projection="3d")
for name in ("skin", "bone", "cut"):
    axes.plot_trisurf(*mesh.points_mm.T, triangles=mesh.facets[name], linewidth=0.1, edgecolor="k", alpha=0.8)
axes.set(xlabel="L, mm", ylabel="P, mm", zlabel="S, mm", box_aspect=np.ptp(mesh.points_mm, axis=0))
plt.savefig("mesh.webp")
