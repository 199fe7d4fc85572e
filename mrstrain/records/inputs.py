"""What a command was given, read and checked before anything is computed."""

from __future__ import annotations

import re
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray
from dvc.deformation.strain import plate_axes
from dvc.errors import InputError, OutputError
from dvc.images.image import Image, LabelMap, Mask
from dvc.io.images.labels import fit_mask, read_labels, read_mask
from dvc.io.images.read import read_image
from dvc.io.images.write import refuse_overwriting_inputs
from dvc.io.meshes.read import MeshFile, read_mesh
from mrstrain.options.measurement import MeshAndAxes, SubjectFiles

IMAGE_ENDINGS = (".nii.gz", ".seg.nrrd", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
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
    reference : Image
    bone, tissue : Mask or None
        On the reference grid.
    labels : LabelMap or None
        On the reference grid.
    mesh : MeshFile or None
    plate_normal : (3,)
        The plate's outward unit normal, away from the foot, LPS.
    axes : (3, 3) or None
        Columns: plate normal, shear direction, and the third; where a shear direction was given.
    files : dict
        Role to the file it came from, for provenance.
    """

    reference: Image
    bone: Mask | None
    tissue: Mask | None
    labels: LabelMap | None
    mesh: MeshFile | None
    plate_normal: FloatArray
    axes: FloatArray | None
    files: dict[str, Path] = field(default_factory=dict)

    @property
    def lowest_bone_point_mm(self) -> FloatArray | None:
        """The bone's voxel that lies furthest along the plate's outward normal, LPS mm."""
        if self.bone is None:
            return None
        points = self.bone.points()
        return np.asarray(points[int(np.argmax(points @ self.plate_normal))])


def read_subject(
    load0: Path | str, files: SubjectFiles, onto: MeshAndAxes | None = None, *, allow_missing: bool = False
) -> Subject:
    """Read the unloaded image, its masks, labels and mesh; refuse what does not fit together."""
    onto = onto or MeshAndAxes()
    reference = read_image(load0, allow_missing=allow_missing)
    label_map = None
    if files.labels is not None:
        label_map = fit_mask(read_labels(files.labels, files.names), reference.grid, str(files.labels))
    elif files.names is not None or files.bone_label is not None:
        raise InputError("--names and --bone-label speak of a label map: give it with --labels.")
    if files.bone is not None and files.bone_label is not None:
        raise InputError("Give the bone once: as a mask (--bone) or as a label of the map (--bone-label).")
    bone = None if files.bone is None else read_mask(files.bone, reference.grid)
    if files.bone_label is not None and label_map is not None:
        bone = label_map.region(files.bone_label)
    tissue = None if files.tissue is None else read_mask(files.tissue, reference.grid)
    mesh = None
    if onto.mesh is not None:
        mesh = read_mesh(onto.mesh, unit=onto.mesh_unit, frame=onto.mesh_frame)
        if not reference.grid.contains(mesh.points_mm).any():
            low, high = mesh.bounds_mm
            raise InputError(
                f"{onto.mesh}: no node lies in the unloaded image. The mesh spans {np.round(low, 1).tolist()} to "
                f"{np.round(high, 1).tolist()} mm (LPS); the image: {reference.grid}. Check --mesh-unit and "
                "--mesh-frame."
            )
    normal = _unit("--plate-normal", onto.plate_normal or _INFERIOR)
    shear = onto.shear_direction
    axes = None if shear is None else plate_axes(normal, _unit("--shear-direction", shear))
    given = {role: paths[0] for role, paths in {"load0": [Path(load0)], **files.files, **onto.files}.items()}
    return Subject(reference, bone, tissue, label_map, mesh, normal, axes, given)


def _unit(name: str, vector: Sequence[float]) -> FloatArray:
    direction = np.asarray(vector, dtype=np.float64)
    length = float(np.linalg.norm(direction))
    if direction.shape != (3,) or not np.isfinite(length) or length < 1e-6:
        raise InputError(f"{name} must be three finite numbers (LPS) that are not all zero; got {list(vector)}.")
    return direction / length


def read_matrix(path: Path) -> FloatArray:
    """Read a 4 x 4 matrix from a text file of four rows.

    Raises
    ------
    InputError
        If it is none.
    """
    try:
        matrix = np.loadtxt(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: no matrix of four rows of four numbers ({error}).") from error
    if matrix.shape != (4, 4):
        raise InputError(f"{path}: a matrix of shape {matrix.shape}; 4 x 4 is needed.")
    return np.asarray(matrix, dtype=np.float64)


def case_names(loads: Sequence[Path]) -> list[str]:
    """Names of the result folders, from the files' names.

    Raises
    ------
    InputError
        If two files would share a folder.
    """
    names = []
    for path in loads:
        name = path.name
        for suffix in IMAGE_ENDINGS:
            if name.lower().endswith(suffix):
                name = name[: -len(suffix)]
                break
        names.append(name)
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise InputError(
            f"Results are kept in a folder named after each loaded image, and {twice} would be used twice: "
            "rename the files, or register them into different --out folders."
        )
    return names


def refuse_touching_inputs(out: Path, case_folders: Sequence[str], inputs: Sequence[Path]) -> None:
    """Refuse an output folder in which a result would replace an input, or the folder that an input lies in."""
    refuse_overwriting_inputs([out / c for c in case_folders] + [out / "report.html"], inputs)
    for path in inputs:
        for case in case_folders:
            if (out / case).resolve() in path.resolve().parents:
                raise OutputError(
                    f"{out / case} would be replaced, and the input {path} lies in it. Choose another --out."
                )


def refuse_small_disk(out: Path, needed: float, what: str, instead: str = "", option: str = "--out") -> None:
    """Refuse an output folder, made or not yet made, on a disk with too little room for ``needed`` bytes.

    Parameters
    ----------
    what : str
        "the set needs", say.
    instead : str
        More that can be done about it, as it follows "choose another --out".
    option : str
        What names the folder.
    """
    there = next(place for place in (out.resolve(), *out.resolve().parents) if place.exists())
    free = shutil.disk_usage(there).free
    if free < needed:
        raise OutputError(
            f"{out}: {what} about {needed / 1e6:.0f} MB and the disk has {free / 1e6:.0f} MB left. Free some, choose "
            f"another {option}{instead}."
        )


def is_bones_name(name: str) -> bool:
    """Whether a label is called as a bone is.

    Examples
    --------
    >>> [is_bones_name(name) for name in ("Talus", "tibia_left", "Sacrum", "fat pad", "calcaneus tendon")]
    [True, True, True, False, False]
    """
    words = set(re.split(r"[^a-z]+", name.lower()))
    return bool(words & _BONES) and not words & _SOFT


def make_output(out: Path) -> None:
    """Make the output folder, and refuse one that cannot be written to."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".mrstrain-probe"
        probe.write_bytes(b"0")
        probe.unlink(missing_ok=True)  # another run may have probed at the same time
    except OSError as error:
        raise OutputError(
            f"{out}: results cannot be written here ({error.strerror or error}). Choose another --out, or change "
            "the folder's rights."
        ) from error
