"""Signs that a model does not belong where it lies: slips of unit, frame or reference that would pass in silence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from dvc.errors import GeometryError
from dvc.image import LabelMap
from validate.mapping import tissues_of
from validate.sources import FeResult

_LEAST_OVERLAP, _GOOD_OVERLAP = 0.85, 0.95
_SAME_TISSUE = 0.8
_NEAR_BONE_MM, _AT_REST_MM = 1.5, 1.0
_VOLUME_CHANGE = 0.15


def misfits(result: FeResult, labels: LabelMap, bones: Sequence[str]) -> list[str]:
    """Check a model against the label map, and tell in sentences what is strange.

    Raises
    ------
    GeometryError
        If model and labelled soft tissue share less than 85 % of the smaller one's volume: it is somewhere else.
    """
    mesh, told = result.mesh, []
    tissue = tissues_of(mesh, labels, mesh.centroids_mm, by_mesh=False)
    names = [name for name in labels.names.values() if name not in bones]
    soft = np.isin(tissue, names)
    volume = mesh.volumes_mm3
    labelled = sum(np.count_nonzero(labels.labels == n) for n, name in labels.names.items() if name in names)
    smaller = min(float(volume.sum()), labelled * labels.grid.voxel_volume_mm3)
    overlap = float(volume[soft].sum()) / smaller
    if overlap < _LEAST_OVERLAP:
        raise GeometryError(
            f"{result.path}: only {overlap:.0%} of the model lies in the labelled soft tissue. It is turned, "
            "mirrored or moved against the image, or its label map is another's: check unit and frame, or give the "
            "map to the image's frame."
        )
    if overlap < _GOOD_OVERLAP:
        told.append(f"{result.name}: {overlap:.0%} of the model lies in the labelled soft tissue; is its frame right?")
    of_mesh = tissues_of(mesh, labels, mesh.centroids_mm, by_mesh=True)
    both = soft & np.isin(of_mesh, names)
    same = float(volume[both & (of_mesh == tissue)].sum() / max(volume[both].sum(), 1e-12))
    if both.any() and same < _SAME_TISSUE:
        told.append(
            f"{result.name}: model and label map name the same tissue in {same:.0%} of the volume alone; the names of "
            "one, or the model's frame, are wrong."
        )
    bone = np.isin(labels.labels, [n for n, name in labels.names.items() if name in bones])
    points = labels.grid.points(bone)
    if len(points):
        near = cKDTree(points).query(mesh.points_mm, distance_upper_bound=_NEAR_BONE_MM)[0] < _NEAR_BONE_MM
        if near.any():
            moved = float(np.median(np.linalg.norm(result.deformation.u_mm[near], axis=1)))
            if moved > _AT_REST_MM:
                told.append(
                    f"{result.name}: the model moves by {moved:.1f} mm at the bone, and the measurement is relative "
                    "to the bone; take the bone's motion out of it."
                )
    determinant = np.linalg.det(np.eye(3) + result.deformation.cell_gradients)
    change = float(volume @ np.abs(determinant - 1.0) / volume.sum())
    if change > _VOLUME_CHANGE:
        told.append(
            f"{result.name}: its cells change their volume by {change:.0%} in the mean, which soft tissue does not; "
            "are displacements in the frame and unit of the coordinates, and these the unloaded ones?"
        )
    return told
