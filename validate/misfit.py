"""Checks that a model lies in the imaged tissue; detects wrong units, frames and reference configurations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import permutations, product
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from dvc import LabelMap, TetMesh, Verdict
from dvc.arguments import checked
from dvc.arrays import FloatArray
from dvc.errors import GeometryError, InputError
from dvc.file_names import clash
from dvc.mesh import box_told, repeated_rows
from dvc.trust.verdict import Level
from dvc.worker import Each
from validate.fe_result import FeResult, check_overlap
from validate.load_comparison import LoadCase
from validate.mapping import MappedFields, check_bones, tissues_of

_OF_RAS = np.array([-1.0, -1.0, 1.0])  # LPS of coordinates in RAS
_LEAST_OVERLAP, _GOOD_OVERLAP, _SAME_TISSUE, _VOLUME_CHANGE = 0.85, 0.95, 0.8, 0.15
_NEAR_BONE_MM, _RIGID_MM = 1.5, 1.0
_FAR_MM = 50.0  # no plate that presses soft tissue moves the bone so far: a seat sinks into a buttock by 2 to 4 cm
_ALONG, _TURNED, _TIED, _UNIT = 0.7, 0.5, 0.02, 1000.0
_SAME_PLACE_MM = 1e-6
_FEWEST_POINTS, _IN_LINE = 4, 0.01  # the latter of their spread along the longest axis
_RIGID_SHARE = 0.1  # of a displacement, what it has beside a rigid motion if that is all that there is to it


@dataclass(frozen=True, slots=True)
class Misfit:
    """A possible input error of a model.

    Attributes
    ----------
    load, model : str
        The load and the name of the model; no load from `misfits`.
    told : str
        A sentence on it.
    level : {"caution", "distrust"}
        Of the verdict on the inputs of a comparison that includes this model.
    """

    load: str
    model: str
    told: str
    level: Level = "caution"

    @property
    def verdict(self) -> Verdict:
        """The verdict on the inputs, with the sentence as its reason."""
        return Verdict(self.level, (self.told,))


@checked
def check_models(
    cases: Sequence[LoadCase], labels: LabelMap, bones: Sequence[str] = ("bone",), *, each: Each = map
) -> list[Misfit]:
    """Check that every model lies in the imaged tissue; returns each possible input error.

    With ``each`` from `dvc.worker.side_by_side`, several loads are checked at the same time.

    Raises
    ------
    InputError
        If there is no case, two loads or two models of a load have the same name, a case has no model, or the label map
        has no such bone.
    GeometryError
        If a model does not lie in the image, or if less than 85 % of it lies in the labelled soft tissue.
    """
    check_bones(labels, bones)
    if not cases:
        raise InputError("There is no load to compare; at least one case is needed.")
    if twice := clash(case.load for case in cases):
        raise InputError(f"Two loads are named {twice}; rename one of them.")
    return [odd for of in each(partial(_odd_models, labels=labels, bones=bones), cases) for odd in of]


def _odd_models(case: LoadCase, labels: LabelMap, bones: Sequence[str]) -> list[Misfit]:
    """Possible input errors of the models of one load."""
    found, bone = list[Misfit](), _points_of_bone(labels, bones)
    for result in case.fields()[1]:
        check_overlap(result.path, result.mesh, labels.grid)
        if result.rigid_parts:
            parts = ", ".join(result.rigid_parts)
            told = f"{case.load}: {result.name} has rigid parts, which are not compared: {parts}."
            found.append(Misfit(case.load, result.name, told))
        odd = misfits(result, labels, bones, bone)
        found += [replace(one, load=case.load, told=f"{case.load}: {one.told}") for one in odd]
    return found


def _points_of_bone(labels: LabelMap, bones: Sequence[str]) -> cKDTree:
    bone = np.isin(labels.labels, [number for number, name in labels.names.items() if name in bones])
    return cKDTree(labels.grid.points(bone))


def check_in_tissue(path: Path, mesh: TetMesh, labels: LabelMap, bones: Sequence[str]) -> float:
    """Overlap of a mesh and the labelled soft tissue, as a fraction of the smaller volume.

    Both are in the reference configuration, LPS mm; all labels except ``bones`` are soft tissue. Below 85 %, a
    GeometryError names ``path`` and gives both bounding boxes.
    """
    soft = [number for number, name in labels.names.items() if name not in bones]
    tissue = tissues_of(mesh, labels, by_mesh=False)
    inside = np.isin(tissue, [labels.names[number] for number in soft])
    labelled = np.isin(labels.labels, soft)
    smaller = min(mesh.volumes_mm3.sum(), np.count_nonzero(labelled) * labels.grid.voxel_volume_mm3)
    overlap = float(mesh.volumes_mm3[inside].sum() / smaller)
    if overlap < _LEAST_OVERLAP:
        there = labels.grid.points(labelled)
        turned = TetMesh(mesh.points_mm * _OF_RAS, mesh.cells, mesh.regions, mesh.facets)
        otherwise = np.isin(tissues_of(turned, labels, by_mesh=False), [labels.names[number] for number in soft])
        share = float(mesh.volumes_mm3[otherwise].sum() / smaller)
        hint = (
            f" Read as RAS, {100 * share:.0f} % would: give its frame (--model-frame RAS)."
            if share >= _LEAST_OVERLAP
            else " Check subject, unit (--model-unit) and frame (--model-frame), or map it to the image (--to-image)."
        )
        own, of_tissue = box_told(*mesh.bounds_mm), box_told(there.min(axis=0), there.max(axis=0))
        raise GeometryError(
            f"{path}: only {100 * overlap:.0f} % of the model lies in the labelled soft tissue "
            f"({100 * _LEAST_OVERLAP:.0f} % is needed).{hint} Model: {own}; tissue: {of_tissue} (LPS mm)."
        )
    return overlap


def misfits(result: FeResult, labels: LabelMap, bones: Sequence[str], bone: cKDTree | None = None) -> list[Misfit]:
    """Check a model against the label map; returns each possible input error.

    Reported are models with cells that are there twice, of which less than 95 % lies in the labelled soft tissue, whose
    tissue names agree with the label map in under 80 % of the volume, that move by over 1 mm at the bone, or whose mean
    change of cell volume is over 15 %. Over 50 mm at the bone, or in the median of a model that no bone touches, is "Do
    not trust". Errors as `check_in_tissue`. ``bone`` has the points of the bones' voxels, LPS mm, if they are known
    already.
    """
    mesh, warnings, wrong = result.mesh, list[str](), list[str]()
    if len(again := repeated_rows(np.round(mesh.centroids_mm / _SAME_PLACE_MM))):
        warnings.append(
            f"{len(again)} of its {len(mesh.cells)} tetrahedra are repeated (the first is number {again[0]}, from 0), "
            "so their volume counts twice; remove them from the model."
        )
    overlap = check_in_tissue(result.path, mesh, labels, bones)
    if overlap < _GOOD_OVERLAP:
        warnings.append(
            f"only {100 * overlap:.0f} % of the model lies in the labelled soft tissue; check its frame "
            "(--model-frame LPS or RAS)."
        )
    names = [name for name in labels.names.values() if name not in bones]
    tissue, of_mesh = (tissues_of(mesh, labels, by_mesh=by_mesh) for by_mesh in (False, True))
    both, volume = np.isin(tissue, names) & np.isin(of_mesh, names), mesh.volumes_mm3
    same = float(volume[both & (of_mesh == tissue)].sum() / max(volume[both].sum(), 1e-12))
    if both.any() and same < _SAME_TISSUE:
        warnings.append(
            f"model and label map have the same tissue name in only {100 * same:.0f} % of the volume; check the names, "
            "and the frame of the model."
        )
    of_bone = bone or _points_of_bone(labels, bones)
    distance = of_bone.query(mesh.points_mm, distance_upper_bound=_NEAR_BONE_MM)[0]
    touching = distance < _NEAR_BONE_MM
    where, nodes = ("at the bone", touching) if touching.any() else ("in the median of its nodes", ~touching)
    moved = np.linalg.norm(result.deformation.u_mm[nodes], axis=1)
    if len(moved) and np.median(moved) > _FAR_MM:
        wrong.append(
            f"the model moves by {np.median(moved):.0f} mm {where}, more than any load would cause ('Do not trust' "
            f"above {_FAR_MM:g} mm). Check the unit and frame of the displacements, and that they are in the order of "
            "the nodes."
        )
    elif touching.any() and np.median(moved) > _RIGID_MM:
        warnings.append(
            f"the model moves by {np.median(moved):.1f} mm at the bone, but the measurement is relative to the bone; "
            "remove the rigid motion of the bone from the model."
        )
    determinant = np.linalg.det(np.eye(3) + result.deformation.cell_gradients)
    change = float(volume @ np.abs(determinant - 1.0) / volume.sum())
    if change > _VOLUME_CHANGE:
        warnings.append(
            f"the mean change of cell volume is {100 * change:.0f} %, which is implausible for soft tissue; check that "
            "displacements have the frame and unit of the coordinates, which must be unloaded."
        )
    levels: dict[Level, list[str]] = {"distrust": wrong, "caution": warnings}
    return [Misfit("", result.name, f"{result.name}: {told}", level) for level, of in levels.items() for told in of]


def _strains_alike(
    points: FloatArray, weight: FloatArray, u: FloatArray, v: FloatArray, turned: FloatArray
) -> bool | None:
    """Whether ``u`` agrees with ``turned`` better than with ``v`` where the rigid motion of each is removed.

    None where too little is left to tell, or a few points or points in a line leave a rotation free.
    """
    away = (points - weight @ points) * np.sqrt(weight)[:, None]
    spread = np.linalg.svd(away, compute_uv=False)
    if len(points) < _FEWEST_POINTS or spread[1] <= _IN_LINE * spread[0]:
        return None

    def left(w: FloatArray) -> FloatArray:
        before, after = points - weight @ points, points + w - weight @ (points + w)
        rotation, _ = Rotation.align_vectors(after, before, weight)
        return np.asarray(np.sqrt(weight)[:, None] * (after - rotation.apply(before)))

    of_measured, as_stored, as_turned = map(left, (u, v, turned))
    for whole, part in ((u, of_measured), (v, as_stored)):
        if np.linalg.norm(part) <= _RIGID_SHARE * np.sqrt(weight @ (whole**2).sum(axis=1)):
            return None
    stored, other = ((of_measured * of).sum() / np.linalg.norm(of) for of in (as_stored, as_turned))
    return bool(other > stored)


def displacement_slip(fields: MappedFields, name: str) -> str:
    """A sentence if a model's displacement fits the measured one only with other axes, another frame or another unit.

    It names the probable error, and is empty if none is detected.

    Notes
    -----
    Direction and magnitude are tested separately, since a model may be too stiff or too soft. The direction is compared
    by the cosine <u, v> / (|u| |v|) of the measured displacement u and the model's v over all cells, weighted by
    volume. An error is reported if one of the 48 orders and signs of the components reaches 0.7 and the components as
    stored have less than half of that. A changed sign or order that hardly affects the displacement is not reported. A
    wrong unit is reported if |v| / |u| is closer to 1000 or 1/1000 than to 1.

    A rigid motion in the model, such as that of the plate or of the bone, lies along axes of its own, and another order
    or sign may turn it towards the measured displacement. Other axes are therefore only named if, without the nearest
    rigid motion of each, u and v also agree better with them than as stored; otherwise the rigid motion is named. Both
    are named if a tenth of u or v or less is left.
    """
    where = fields.common
    weight = fields.volumes_ml[where] / fields.volumes_ml[where].sum()
    u, v = fields.measured.u_mm[where], fields.models[name].u_mm[where]
    size, of_model = (float(np.sqrt(weight @ (w**2).sum(axis=1))) for w in (u, v))
    if min(size, of_model) == 0.0:
        return ""
    shared = np.einsum("n,ni,nj->ij", weight, u, v) / (size * of_model)
    as_given, warnings = float(np.trace(shared)), []
    cosines = {
        (order, signs): float(np.array(signs) @ shared[range(3), order])
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    }
    most = max(cosines.values())
    tied = (axes for axes, cosine in cosines.items() if cosine > most - _TIED)
    order, signs = min(tied, key=lambda axes: sum(o != n for n, o in enumerate(axes[0])) + axes[1].count(-1.0))
    turned = most >= _ALONG and as_given < _TURNED * most
    axes = " ".join(("-" if sign < 0.0 else "") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
    axes += " (LPS and RAS exchanged)" if axes == "-x -y z" else ""
    alike = _strains_alike(fields.points_mm[where], weight, u, v, v[:, order] * signs) if turned else None
    if turned and alike is None:
        warnings.append(
            f"has another direction than the measured one (cosine {as_given:z.2f}): it contains a rigid motion, or its "
            f"axes are wrong (as {axes}, the cosine would be {most:.2f}); check first whether the bone moves"
        )
    elif turned and not alike:
        warnings.append(
            f"has another direction than the measured one (cosine {as_given:z.2f}), most likely because it contains a "
            "rigid motion; if the bone moves in the model, subtract that motion"
        )
    elif turned:
        warnings.append(
            f"fits the measured one far better with its components as {axes} (cosine {most:.2f}, as given "
            f"{as_given:z.2f}); check its frame and the order of its components"
        )
    if abs(np.log(of_model / size)) > 0.5 * np.log(_UNIT):
        unit = "it may be in metres" if of_model < size else "it may be 1000 times too large"
        warnings.append(f"is {of_model / size:.2g} times as large as the measured one ({unit})")
    return f"{name}: the displacement {', and '.join(warnings)}." if warnings else ""
