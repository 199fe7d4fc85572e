"""The unloaded image and what is known about it."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dvc.arrays import BoolArray, FloatArray, frozen
from dvc.deformation.strain import plate_axes
from dvc.errors import InputError
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.tissue import tissue_mask
from dvc.io.meshes.read import MeshFile

_BONES = {
    "bone", "bones", "ankle", "calcaneus", "talus", "tibia", "fibula", "navicular", "cuboid", "cuneiform", "metatarsal",
    "femur", "trochanter", "patella", "pelvis", "sacrum", "coccyx", "ilium", "ischium", "pubis", "vertebra",
}  # fmt: skip
_SOFT = {"fat", "pad", "muscle", "skin", "tendon", "ligament", "fascia", "aponeurosis", "tissue", "cartilage"}
_INFERIOR = (0.0, 0.0, -1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """The unloaded image and what is known about it.

    Attributes
    ----------
    bone, tissue, labels : Mask, Mask, LabelMap or None
        On the reference grid.
    plate_normal : (3,)
        The plate's outward unit normal, away from the body, LPS.
    axes : (3, 3) or None
        Columns: plate normal, shear direction, and their cross product; None without a shear direction.
    files : dict
        Role to the file it came from, for provenance; empty where arrays were given.
    """

    reference: Image
    bone: Mask | None = None
    tissue: Mask | None = None
    labels: LabelMap | None = None
    mesh: MeshFile | None = None
    plate_normal: FloatArray = field(default_factory=lambda: np.array(_INFERIOR))
    axes: FloatArray | None = None
    files: dict[str, Path] = field(default_factory=dict)

    @property
    def lowest_bone_point_mm(self) -> FloatArray | None:
        """The voxel of the bone that is furthest along the plate's outward normal, LPS mm."""
        if self.bone is None:
            return None
        points = self.bone.points()
        return np.asarray(points[int(np.argmax(points @ self.plate_normal))])

    def body(self) -> Mask:
        """Soft tissue and bone: as given, or by a threshold."""
        return self.tissue or tissue_mask(self.reference)

    def soft(self, body: Mask) -> BoolArray:
        """The voxels of a body that are not the bone's."""
        return body.inside if self.bone is None else body.inside & ~self.bone.inside

    def regions(self, body: Mask) -> LabelMap:
        """The labels; without, the body as "tissue", and the bone."""
        if self.labels is not None:
            return self.labels
        if self.bone is None:
            return LabelMap(body.grid, body.inside.astype(np.int64), {1: "tissue"})
        return LabelMap(body.grid, np.where(self.bone.inside, 2, body.inside), {1: "tissue", 2: "bone"})


def plate_directions(
    plate_normal: Sequence[float] | None, shear_direction: Sequence[float] | None
) -> tuple[FloatArray, FloatArray | None]:
    """The plate's outward unit normal (inferior where none is given), and its axes where a shear direction is given."""
    normal = _unit("plate_normal", _INFERIOR if plate_normal is None else plate_normal)
    return normal, None if shear_direction is None else plate_axes(normal, _unit("shear_direction", shear_direction))


def _unit(name: str, vector: Sequence[float]) -> FloatArray:
    direction = frozen(vector, np.float64)
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not np.isfinite(length) or length < 1e-6:
        told = f"{name} (--{name.replace('_', '-')} on the command line)"
        raise InputError(f"{told} must be three finite numbers (LPS), not all zero; got {list(vector)}.")
    return direction / length


def is_bones_name(name: str) -> bool:
    """Whether a label is named like a bone.

    >>> [is_bones_name(name) for name in ("Talus", "tibia_left", "Sacrum", "fat pad", "calcaneus tendon")]
    [True, True, True, False, False]
    """
    words = set(re.split(r"[^a-z]+", name.lower()))
    return bool(words & _BONES) and not words & _SOFT
