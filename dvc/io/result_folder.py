"""The folder of results of one loaded image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dvc.arrays import Float32Array, FloatArray
from dvc.deformation.protocol import Deformation
from dvc.deformation.strain import StrainField
from dvc.deformation.strain_maps import TENSOR_COMPONENTS, StrainMaps
from dvc.images.image import Grid, Image, Mask
from dvc.io.images.write import write_image, write_mask, write_vectors
from dvc.io.meshes.read import MeshFile
from dvc.io.meshes.write import write_nodal_displacements, write_on_mesh
from dvc.trust.verdict import Verdict

_DISPLACEMENT = "displacement of tissue relative to its bone: u(X) = x - X at the voxels of the unloaded image"
_GREEN_LAGRANGE = "Green-Lagrange strain E = (F^T F - I) / 2"
_UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def write_maps(
    folder: Path, maps: StrainMaps, plate_axes: FloatArray | None = None, verdict: Verdict | None = None
) -> None:
    """Write displacement and strain maps as NIfTI on the reference grid, with their meaning in JSON beside.

    Parameters
    ----------
    plate_axes : (3, 3), optional
        Columns n (plate normal), s (shear), t (`dvc.deformation.strain.plate_axes`); the strain in these axes is
        written too.
    verdict : Verdict, optional
        Of a measurement; told in the JSON files.
    """
    write_displacement(folder, maps.grid, maps.displacement_mm, verdict)
    write_vectors(
        folder / "green_lagrange.nii.gz",
        maps.grid,
        maps.green_lagrange,
        TENSOR_COMPONENTS,
        _GREEN_LAGRANGE,
        unit="1",
        verdict=verdict,
    )
    if plate_axes is not None:
        write_vectors(
            folder / "green_lagrange_plate.nii.gz",
            maps.grid,
            in_axes(maps.green_lagrange, plate_axes),
            ("nn", "ns", "nt", "ss", "st", "tt"),
            f"{_GREEN_LAGRANGE} in the plate's axes: n outward normal, s shear direction, t = n x s; "
            f"columns of {np.round(plate_axes, 6).tolist()} in LPS",
            "invariant",
            unit="1",
            verdict=verdict,
        )
    write_image(folder / "max_shear.nii.gz", Image(maps.grid, maps.max_shear))
    write_image(folder / "jacobian.nii.gz", Image(maps.grid, maps.jacobian))
    write_mask(folder / "valid.nii.gz", Mask(maps.grid, maps.valid))


def write_displacement(folder: Path, grid: Grid, displacement_mm: Float32Array, verdict: Verdict | None = None) -> None:
    """Write the displacement as NIfTI and as NRRD, LPS mm."""
    for name in ("displacement.nrrd", "displacement.nii.gz"):  # the JSON beside them names the last
        write_vectors(
            folder / name, grid, displacement_mm, ("x", "y", "z"), _DISPLACEMENT, "LPS", unit="mm", verdict=verdict
        )


def in_axes(tensor: Float32Array, axes: FloatArray) -> Float32Array:
    """Symmetric tensors (..., 6) in other axes: E' = A^T E A, columns of A the new axes.

    Order of components: 11, 12, 13, 22, 23, 33.
    """
    full = np.empty((*tensor.shape[:-1], 3, 3), dtype=np.float32)
    for c, (i, j) in enumerate(_UPPER):
        full[..., i, j] = full[..., j, i] = tensor[..., c]
    turned = axes.T.astype(np.float32) @ full @ axes.astype(np.float32)
    return np.stack([turned[..., i, j] for i, j in _UPPER], axis=-1)


def write_mesh_results(
    folder: Path, mesh: MeshFile, deformation: Deformation, verdict: Verdict | None = None
) -> dict[str, int]:
    """Displacement and strain at the nodes and in the cells of a user's mesh.

    Returns
    -------
    dict
        ``nodes`` and ``cells``, and how many of each have no value.
    """
    u, H = deformation.evaluate(mesh.points_mm)
    at_nodes = StrainField.from_gradient(H)
    u_cells, H_cells = deformation.evaluate(mesh.centroids_mm)
    in_cells = StrainField.from_gradient(H_cells)
    write_on_mesh(
        folder / "mesh.vtu",
        mesh,
        {
            "displacement_mm": u,
            "green_lagrange": at_nodes.green_lagrange,
            "max_shear": at_nodes.max_shear,
            "jacobian": at_nodes.jacobian,
        },
        {
            "displacement_mm": u_cells,
            "green_lagrange": in_cells.green_lagrange,
            "max_shear": in_cells.max_shear,
            "jacobian": in_cells.jacobian,
        },
        verdict,
    )
    missing = write_nodal_displacements(folder / "nodal_displacements.csv", mesh, u, verdict)
    return {
        "nodes": len(u),
        "nodes_without_value": missing,
        "cells": mesh.cell_count,
        "cells_without_value": int(np.count_nonzero(~in_cells.valid)),
    }
