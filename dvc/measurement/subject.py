"""The unloaded image and what is known about it."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dvc.arrays import BoolArray, FloatArray, different, frozen
from dvc.deformation.strain import plate_axes
from dvc.errors import InputError
from dvc.images.bone_names import is_bones_name
from dvc.images.image import Image, LabelMap, Mask
from dvc.images.tissue import tissue_mask
from dvc.io.meshes.read import MeshFile
from dvc.trust.error_model import POOLED

_HEEL = ("bone", "calcaneus")
_INFERIOR = (0.0, 0.0, -1.0)
_MOST_UNCERTAIN = 0.2  # of the voxels; .11 to .16 on the phantoms for which error bars were found to hold


@dataclass(frozen=True, slots=True)
class LabelsFromImage:
    """How a label map came out that was made from the image (`label_tissues`).

    Attributes
    ----------
    uncertain : float
        Share of the labelled voxels whose tissue has a probability below 0.9.
    notes : tuple of str
        What was not found, and why.
    """

    uncertain: float
    notes: tuple[str, ...] = ()

    @property
    def told(self) -> str:
        """A sentence on it."""
        share = f"{100 * self.uncertain:.0f} %"
        return f"The label map was made from the image; {share} of its voxels have an uncertain label."

    @property
    def doubts(self) -> tuple[str, ...]:
        """Why a result that relies on these labels needs care; empty where it does not."""
        notes = tuple(f"The label map was made from the image. {note}" for note in self.notes)
        if self.uncertain <= _MOST_UNCERTAIN:
            return notes
        limits = f"limit: 'Use with care' above {100 * _MOST_UNCERTAIN:.0f} %"
        correct = "Look at its picture, and correct it with strokes or by hand."
        return (*notes, f"{self.told.removesuffix('.')} ({limits}). {correct}")


@dataclass(frozen=True, slots=True, eq=False)
class Subject:
    """The unloaded image and what is known about it.

    Attributes
    ----------
    bone, tissue, labels : Mask, Mask, LabelMap or None
        On the reference grid.
    plate_normal : (3,)
        Unit direction from the body to the plate, LPS.
    axes : (3, 3) or None
        Columns: plate normal, shear direction, and their cross product; None without a shear direction.
    files : dict
        Role to the file it came from, for provenance; empty where arrays were given.
    from_image : LabelsFromImage or None
        How the labels came out if they were made from the image; None for others.
    pressed : bool
        Whether a plate is known to press against ``plate_normal``; otherwise only slices and figures follow it.
    """

    reference: Image
    bone: Mask | None = None
    tissue: Mask | None = None
    labels: LabelMap | None = None
    mesh: MeshFile | None = None
    plate_normal: FloatArray = field(default_factory=lambda: np.array(_INFERIOR))
    axes: FloatArray | None = None
    files: dict[str, Path] = field(default_factory=dict)
    from_image: LabelsFromImage | None = None
    pressed: bool = False

    @property
    def pressed_along(self) -> FloatArray | None:
        """The plate's outward normal if a plate is known to press; None otherwise."""
        return self.plate_normal if self.pressed else None

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
        """The labels; without, the body as "soft tissue", and the bone."""
        if self.labels is not None:
            return self.labels
        if self.bone is None:
            return LabelMap(body.grid, body.inside.astype(np.int64), {1: POOLED})
        return LabelMap(body.grid, np.where(self.bone.inside, 2, body.inside), {1: POOLED, 2: "bone"})


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


def bones_of(labels: LabelMap, given: Sequence[str] = ()) -> tuple[str, ...]:
    """The labels that are bones: those given, or those with voxels that are named like one.

    Of those named like one, "bone" or "calcaneus" is the first. Without any: "bone" if a label has no name, since it
    may be one; none otherwise.

    >>> from dvc import Grid
    >>> grid = Grid((3, 1, 1), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    >>> bones_of(LabelMap(grid, np.array([[[1]], [[2]], [[3]]]), {1: "fat", 2: "talus", 3: "bone", 4: "tibia"}))
    ('bone', 'talus')
    """
    if given:
        return tuple(given)
    there = set(different(labels.labels).tolist())
    names = [name for number, name in labels.names.items() if number in there and is_bones_name(name)]
    if not names and any(name.startswith("label-") for name in labels.names.values()):
        return ("bone",)
    return tuple(sorted(names, key=lambda name: name.casefold() not in _HEEL))
