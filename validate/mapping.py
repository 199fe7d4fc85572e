"""A measured deformation and several simulated ones, evaluated in the same cells."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from dvc import Deformation, LabelMap, StrainField, TetMesh
from dvc.arguments import checked
from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.errors import InputError, few
from dvc.trust.regions import volume_above

ALL = "all soft tissue"
"""Name of all compared tissues together."""

UNNAMED = "unnamed"
"""Tissue of cells that are named neither by the mesh nor by the label map."""


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """A deformation in the compared cells; NaN where undefined.

    Attributes
    ----------
    u_mm : (n, 3)
        Displacement, LPS mm.
    max_shear, jacobian : (n,)
        (E1 - E3) / 2 of the Green-Lagrange strain, and det F.
    """

    u_mm: FloatArray
    max_shear: FloatArray
    jacobian: FloatArray

    @property
    def defined(self) -> BoolArray:
        """Cells with a value (n,)."""
        return np.isfinite(self.max_shear)


@dataclass(frozen=True, slots=True, eq=False)
class MappedFields:
    """One load, measured and simulated, at the centroids of a mesh's cells; reference configuration, LPS mm.

    Attributes
    ----------
    points_mm, volumes_ml, tissue : (n, 3), (n,), (n,) str
        Centroids, volumes and tissues of the cells.
    to_bone_mm : (n,)
        Distance to the surface of bone; NaN without bone.
    """

    mesh: TetMesh
    points_mm: FloatArray
    volumes_ml: FloatArray
    tissue: np.ndarray
    to_bone_mm: FloatArray
    measured: Field
    models: Mapping[str, Field]

    @property
    def common(self) -> BoolArray:
        """Cells (n,) in which the measurement and every model are defined; only these are compared."""
        return np.asarray(np.all([field.defined for field in self.by_name.values()], axis=0))

    @property
    def by_name(self) -> dict[str, Field]:
        """Every field by name; the first is the measurement, named "measured"."""
        return {"measured": self.measured, **self.models}

    @property
    def parts(self) -> dict[str, BoolArray]:
        """Compared cells (n,) of `ALL`, and of each tissue that has any."""
        parts = {name: self.common & (self.tissue == name) for name in self.tissues}
        return {ALL: self.common} | {name: cells for name, cells in parts.items() if cells.any()}

    @property
    def tissues(self) -> list[str]:
        """Names of the tissues, the largest first."""
        names = np.unique(self.tissue)
        return sorted((str(n) for n in names), key=lambda n: -self.volumes_ml[self.tissue == n].sum())

    def curves(self, tissue: str, strains: FloatArray) -> dict[str, FloatArray]:
        """Volume (mL) of a tissue (or `ALL`) above each strain (k,), of "measured" and each model, in common cells."""
        where = self.common & ((self.tissue == tissue) | (tissue == ALL))
        return {n: volume_above(f.max_shear[where], self.volumes_ml[where], strains) for n, f in self.by_name.items()}

    def coverage(self) -> dict[str, float]:
        """Volume (mL) of the mesh, of the part where each field is defined, and of the common part."""
        volumes = {name: float(self.volumes_ml[field.defined].sum()) for name, field in self.by_name.items()}
        common = float(self.volumes_ml[self.common].sum())
        return {"mesh": float(self.volumes_ml.sum())} | volumes | {"common": common}


def filled_from_nearest(values: FloatArray, points_mm: FloatArray) -> FloatArray:
    """Values (n, k) at points (n, 3), mm, with rows that contain NaN replaced by the nearest complete row.

    At least one row must be complete.
    """
    known = np.isfinite(values).all(axis=1)
    filled = values.copy()
    if not known.all():
        _, nearest = cKDTree(points_mm[known]).query(points_mm[~known])
        filled[~known] = values[known][nearest]
    return filled


@checked
def check_bones(labels: LabelMap, bones: Sequence[str]) -> None:
    """InputError, with the labels of the map, for bones that are not in it."""
    known = labels.names.values()
    if missing := [name for name in bones if name not in known]:
        raise InputError(
            f"The label map has no label '{missing[0]}'; its labels are {few(known)}. Name its "
            "bones (bones, --bone), and check the table of label names."
        )


def _sampled(deformation: Deformation, points_mm: FloatArray) -> Field:
    u, H = deformation.evaluate(points_mm)
    strain = StrainField.from_gradient(H)
    return Field(u, strain.max_shear, strain.jacobian)


@checked
def map_fields(
    mesh: TetMesh, labels: LabelMap, bones: Sequence[str], measured: Deformation, models: Mapping[str, Deformation]
) -> MappedFields:
    """Evaluate a measured deformation and simulated ones at the centroids of the cells of a mesh.

    Parameters
    ----------
    mesh : TetMesh
        Reference configuration, LPS mm. Its regions give the tissues if they have the names of labels, in any case.
    labels : LabelMap
        Of the unloaded image.
    bones : sequence of str
        Labels of bone; cells with their centroid in bone are not compared. Empty where no label is bone.

    Raises
    ------
    InputError
        If a bone is not in the label map, or measurement and models have no tissue in common.
    """
    check_bones(labels, bones)
    tissue = tissues_of(mesh, labels)
    soft = ~np.isin(tissue, list(bones))
    mesh, tissue = mesh if soft.all() else _part(mesh, np.flatnonzero(soft)), tissue[soft]
    points = mesh.centroids_mm
    bone = np.isin(labels.labels, [number for number, name in labels.names.items() if name in bones])
    distance = np.full(len(points), np.nan)
    if bone.any():
        distance, _ = cKDTree(labels.grid.points(bone)).query(points)
    distance = np.maximum(distance - 0.5 * labels.grid.spacing_mm.min(), 0.0)  # to the surface, not to voxel centres
    by_model, volumes = {name: _sampled(model, points) for name, model in models.items()}, mesh.volumes_mm3 / 1000.0
    fields = MappedFields(mesh, points, volumes, tissue, distance, _sampled(measured, points), by_model)
    if not fields.common.any():
        covered = "; ".join(f"{name} {volume:.1f} mL" for name, volume in fields.coverage().items())
        raise InputError(
            f"There is no cell in which the measurement and all models are defined ({covered}). Check that they are in "
            "the same frame."
        )
    return fields


def tissues_of(mesh: TetMesh, labels: LabelMap, *, by_mesh: bool = True) -> np.ndarray:
    """Tissue of each cell (m,) str: its region, if that names a label; otherwise the label at its centroid.

    Case does not matter where it does not distinguish labels: Abaqus writes names in capitals.
    """
    names = set(labels.names.values())
    folded = [name.casefold() for name in labels.names.values()]
    in_any_case = {name.casefold(): name for name in labels.names.values() if folded.count(name.casefold()) == 1}
    tissue = np.full(len(mesh.cells), UNNAMED, dtype=f"<U{max(len(n) for n in (*names, UNNAMED))}")
    nearest = np.rint(labels.grid.indices_of(mesh.centroids_mm)).astype(np.int64)
    inside = ((nearest >= 0) & (nearest < np.array(labels.grid.shape))).all(axis=1)
    number = np.zeros(len(mesh.cells), dtype=np.int64)
    number[inside] = labels.labels[tuple(nearest[inside].T)]
    for value, name in labels.names.items():
        tissue[number == value] = name
    for region, cells in mesh.regions.items():
        label = region if region in names else in_any_case.get(region.casefold())
        if by_mesh and label is not None:
            tissue[cells] = label
    return tissue


def _part(mesh: TetMesh, kept: IntArray) -> TetMesh:
    place = np.full(len(mesh.cells), -1)
    place[kept] = np.arange(len(kept))
    regions = {name: place[cells][place[cells] >= 0] for name, cells in mesh.regions.items()}
    return TetMesh(mesh.points_mm, mesh.cells[kept], {n: c for n, c in regions.items() if len(c)})
