"""Displacement of a model extrapolated over a whole image, for forward-model comparison (levelling).

A measurement smooths and a model does not. Levelling simulates the measurement of a model: its displacement warps the
unloaded image, fresh noise is added, and the pair is registered like the scans.
"""

from itertools import product

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

from dvc import Grid, SampledDisplacement, evaluate_on_grid
from dvc.arrays import BoolArray, FloatArray
from dvc.deformation.nodal import OnMesh
from dvc.errors import InputError

LEVELLED = "-levelled"
"""Suffix of the name of a levelled model."""

_SMOOTH_MM, _ROUNDS, _MENDING, _LEAST_VOLUME = 2.0, 40, 12, 0.1


def extrapolated(model: OnMesh, grid: Grid, bone: BoolArray) -> SampledDisplacement:
    """A model's displacement at every voxel of the unloaded image's grid; ``bone`` (ni, nj, nk) bool on the same grid.

    It is as simulated inside the model's mesh, zero in bone, and smoothly extrapolated elsewhere. InputError if no
    voxel lies in the mesh.
    """
    at = grid.indices_of(np.array(list(product(*model.mesh.bounds_mm.T))))
    ends = np.clip([np.floor(at.min(axis=0)), np.ceil(at.max(axis=0)) + 1], 0, grid.shape).astype(int)
    box = np.zeros(grid.shape, dtype=bool)
    box[tuple(map(slice, *ends))] = True
    u = np.full((*grid.shape, 3), np.nan)
    u[box] = evaluate_on_grid(model, grid, box)[0]
    inside = np.isfinite(u).all(axis=-1)
    if not inside.any():
        raise InputError("No voxel of the image lies in the mesh of the model. Check unit and frame of the model.")
    u[bone & ~inside] = 0.0
    known = inside | bone
    nearest = distance_transform_edt(~known, sampling=grid.spacing_mm, return_distances=False, return_indices=True)
    whole: FloatArray = u[tuple(nearest)]
    for _ in range(_ROUNDS):
        whole = np.where(known[..., None], u, _smoothed(grid, whole))
    return _unfolded(grid, whole)


def _smoothed(grid: Grid, u: FloatArray) -> FloatArray:
    return np.asarray(gaussian_filter(u, _SMOOTH_MM / grid.spacing_mm, mode="nearest", axes=(0, 1, 2)))


def _unfolded(grid: Grid, u: FloatArray) -> SampledDisplacement:
    """The displacement, smoothed repeatedly around the voxels at which its spline folds.

    The displacement of a model is linear in each cell, and the spline through the voxels overshoots at nearly flat
    cells.
    """
    width = _SMOOTH_MM / grid.spacing_mm
    inner = np.zeros(grid.shape, dtype=bool)
    inner[1:-1, 1:-1, 1:-1] = True
    for _ in range(_MENDING):
        field = SampledDisplacement(grid, u)
        _, H = evaluate_on_grid(field, grid, inner)
        folded = np.zeros(grid.shape, dtype=bool)
        folded[inner] = np.linalg.det(H + np.eye(3)) < _LEAST_VOLUME
        if not folded.any():
            break
        weight = np.clip(gaussian_filter(folded.astype(np.float64), width) * 8.0 * np.pi**1.5 * width.prod(), 0.0, 1.0)
        u = u + weight[..., None] * (_smoothed(grid, u) - u)
    return field
