"""A refusal leaves no folder behind, however late it comes."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import meshio
import nibabel
import numpy as np
import pytest

import mrstrain
from dvc.errors import MrstrainError
from fe import LoadStep
from tests.golden.scenes import GIVEN
from tests.mrstrain.comparison.conftest import _fill as fill_comparison
from tests.mrstrain.comparison.test_compare import given as of_comparison
from tests.validate.test_comparison import cube

pytestmark = pytest.mark.usefixtures("in_this_process")

LOAD0, LOAD1 = GIVEN / "Load0.nii.gz", GIVEN / "Load1.nii.gz"
TISSUES = {"labels": GIVEN / "tissues.nii.gz", "names": GIVEN / "tissues.csv"}
WARPED = {"frame": "LPS", **TISSUES, "bone_label": "bone"}
PAD = {"mesh": GIVEN / "pad.inp"}
EDGES_MM = [4.0, 5.0, 6.0]


def bone(files: Path, *, voxels: int = 0, whole: bool = False) -> Path:
    """A mask on the grid of the unloaded image: all of it, so many voxels of bone, or a block in the air."""
    tissues = nibabel.load(TISSUES["labels"])
    labels = np.asarray(tissues.dataobj)
    inside = np.full(labels.shape, whole, dtype=np.uint8)
    if voxels:
        inside[tuple(np.argwhere(labels == 1)[:voxels].T)] = 1
    elif not whole:
        image = np.asarray(nibabel.load(LOAD0).dataobj)
        inside[tuple(np.argwhere((labels == 0) & (image < np.percentile(image, 20)))[:400].T)] = 1
    nibabel.save(nibabel.Nifti1Image(inside, tissues.affine, tissues.header), files / "bone.nii.gz")
    return files / "bone.nii.gz"


def displacement(files: Path, mm: float) -> Path:
    """A displacement image on the grid of the unloaded image: so much along the first axis, more and less in turn."""
    image = nibabel.load(LOAD0)
    u = np.zeros((*image.shape, 1, 3), dtype=np.float32)
    u[::2, ..., 0] = mm
    u[1::2, ..., 0] = 0.9 * mm
    made = nibabel.Nifti1Image(u, image.affine)
    made.header.set_intent("vector")
    made.header.set_xyzt_units("mm")
    nibabel.save(made, files / "u.nii.gz")
    return files / "u.nii.gz"


def without_bone(files: Path) -> dict[str, Path]:
    """The label map, whose bone has another name."""
    (files / "names.csv").write_text(TISSUES["names"].read_text().replace("1,bone", "1,fascia"))
    return {"labels": TISSUES["labels"], "names": files / "names.csv"}


def cohort(out: Path, files: Path, first: str = "", second: str = "") -> object:
    for name, more in (("one", first), ("two", second)):
        shutil.copytree(GIVEN, files / name)
        study = files / name / "study.toml"
        study.write_text(f"{study.read_text().replace('Golden', name)}{more}\n")
    return mrstrain.cohort([files / "one", files / "two"], out=out)


def compared(out: Path, files: Path, aside_mm: float = 0.0, **more: object) -> object:
    """A comparison of measured shear with a model that lies aside."""
    fill_comparison(files)
    mesh = cube(6)
    aside = meshio.Mesh(mesh.points_mm + np.array([aside_mm, 0.0, 0.0]), [("tetra", mesh.cells)])
    aside.point_data["displacement"] = 0.1 * np.asarray(mesh.points_mm)
    (files / "aside").mkdir()
    meshio.write(files / "aside" / "Load1.vtu", aside)
    return mrstrain.compare(files / "measured", [files / "aside"], **of_comparison(files) | {"out": out} | more)


Give = Callable[[Path, Path], object]  # given the output folder, and one for files that are made up
REFUSED: dict[str, tuple[str, Give]] = {
    "register, bone of one voxel": (
        "Only 1 voxels of the mask",
        lambda out, files: mrstrain.register(LOAD0, [LOAD1], out=out, bone=bone(files, voxels=1), workers=1)),
    "register, bone in the air": (
        "The bone mask lies outside the body",
        lambda out, files: mrstrain.register(LOAD0, [LOAD1], out=out, bone=bone(files), workers=1)),
    "register, the whole image as bone": (
        "The bone mask covers 100 % of the body, so there is no soft tissue",
        lambda out, files: mrstrain.register(LOAD0, [LOAD1], out=out, bone=bone(files, whole=True), workers=1),
    ),
    "register, no such label": (
        "no region 'talus'",
        lambda out, files: mrstrain.register(LOAD0, [LOAD1], out=out, **TISSUES, bone_label="talus")),
    "strain, no such label": (
        "no region 'talus'",
        lambda out, files: mrstrain.strain(
            LOAD0, displacement(files, 1.0), out=out, **WARPED | {"bone_label": "talus"})),
    "strain, bone of one voxel": (
        "bone's motion cannot be removed",
        lambda out, files: mrstrain.strain(
            LOAD0, displacement(files, 1.0), out=out, frame="LPS", bone=bone(files, voxels=1))),
    "strain, a mesh elsewhere": (
        "no node is inside the unloaded image",
        lambda out, files: mrstrain.strain(
            LOAD0, displacement(files, 1.0), out=out, **WARPED, **PAD, mesh_frame="RAS"
        ),
    ),
    "twin, folds": ("fold", lambda out, files: mrstrain.twin(LOAD0, displacement(files, 40.0), out=out, **WARPED)),
    "label, bone of one voxel": (
        "has only 1 of the image's voxels",
        lambda out, files: mrstrain.label(LOAD0, out=out / "t.nii.gz", bone=bone(files, voxels=1))),
    "label, bone in the air": (
        "of the mask of the bone is inside the body",
        lambda out, files: mrstrain.label(LOAD0, out=out / "t.nii.gz", bone=bone(files))),
    "mesh, no bone": (
        "no region 'bone'", lambda out, files: mrstrain.mesh(**without_bone(files), out=out / "m.vtu", edge_mm=4.0)),
    "mesh, no such bone": (
        "no region 'talus'", lambda out, _: mrstrain.mesh(**TISSUES, bones=["talus"], out=out / "m.vtu", edge_mm=4.0)),
    "converge, no such tissue": (
        "no soft tissue 'talus'",
        lambda out, _: mrstrain.converge(**TISSUES, out=out, edges_mm=EDGES_MM, region="talus")),
    "simulate, a load no tissue bears": (
        "no tissue withstands it", lambda out, _: mrstrain.simulate(**PAD, out=out, loads=[LoadStep("pressed", 1e9)])),
    "drive, no results": ("no results", lambda out, files: mrstrain.drive(**PAD, dvc=files, out=out)),
    "level, no folder of a model": (
        "not a folder", lambda out, files: mrstrain.level(dvc=files, model=GIVEN / "pad.inp", out=out)),
    "compare, aside": ("frame", lambda out, files: compared(out, files, -6.0)),
    "compare, no such bone": (
        "no label 'calcaneus'", lambda out, files: compared(out, files, bones=["calcaneus"])),
    "cohort, other strains": (
        "different ranges of strain",
        lambda out, files: cohort(out, files, second="[compare]\nstrains = [0.1, 0.3]")),
    "phantom, no such load": ("Unknown load 'Load9'", lambda out, _: mrstrain.phantom(out, seed=1, loads=["Load9"])),
    "accuracy, no case": ("at least one case", lambda out, _: mrstrain.accuracy(out, cases=[])),
    "fit, no curve": ("stretch", lambda out, _: mrstrain.fit(TISSUES["names"], "Ogden", out=out)),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_refusal_leaves_no_folder(name: str, tmp_path: Path) -> None:
    said, give = REFUSED[name]
    (tmp_path / "files").mkdir()
    with pytest.raises(MrstrainError, match=said):
        give(tmp_path / "new" / "out", tmp_path / "files")
    assert not (tmp_path / "new").exists()
