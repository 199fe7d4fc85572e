"""Every refusal of the table of reliability that takes milliseconds names the file, the cause and the next step.

Rows are those of `tests/test_reliability_table.py`.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nibabel
import numpy as np
import pytest
import SimpleITK as sitk
from filelock import FileLock

from dvc import TetMesh, read_image, read_mask
from dvc.errors import MrstrainError
from dvc.io.images.labels import fit_mask
from dvc.registration.elastix.presets import read_parameter_file
from fe import LoadStep, NeoHooke, Plate, Problem, mesh_labels
from mrstrain.records.inputs import alone, make_output, refuse_small_disk, refuse_touching_inputs
from mrstrain.studies.file import read_study
from tests.blocks import block
from tests.dvc.io.images.test_dicom import _series, _write
from tests.dvc.registration.elastix.test_presets import GOOD
from tests.fe.test_meshing import half_onion
from tests.fe.test_simulate import ALONG, DOWN, FAT, dome
from tests.mrstrain.studies.test_file import WHOLE
from tests.test_reliability_table import ROWS
from tests.validate.test_fe_result import written as written_result
from validate import check_overlap, read_result

LONGEST = 300  # characters of a message beside the folder of this test: three lines of 100
VALUES = np.random.default_rng(1).normal(100.0, 20.0, (9, 8, 7)).astype(np.float32)
AFFINE = np.diag([2.0, 2.0, 2.0, 1.0])
MASK = np.pad(np.ones((5, 4, 3), dtype=np.float32), 2)
Give = Callable[[Path], object]


def nifti(path: Path, values: Any = VALUES, affine: Any = AFFINE) -> Path:
    image = nibabel.Nifti1Image(values, affine)
    image.header.set_xyzt_units("mm")
    nibabel.save(image, path)
    return path


def cut(path: Path) -> Path:
    """The file without its last bytes."""
    path.write_bytes(path.read_bytes()[:-200])
    return path


def truncated(folder: Path, suffix: str) -> object:
    path = folder / f"a.{suffix}"
    if suffix == "dcm":
        cut(sorted(_series(folder / "a.dcm").iterdir())[3])
    elif suffix.startswith("nii"):
        cut(nifti(path))
    else:
        sitk.WriteImage(sitk.GetImageFromArray(VALUES.T), str(path), True)
        cut(path)
    return read_image(path)


def with_nan(folder: Path) -> object:
    values = VALUES.copy()
    values[1, 2, 3] = np.nan
    return read_image(nifti(folder / "a.nii", values))


def mask_elsewhere(folder: Path) -> object:
    far = AFFINE + np.outer([500.0, 500.0, 500.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    path = nifti(folder / "bone.nii", MASK, far)
    return fit_mask(read_mask(path), read_image(nifti(folder / "a.nii")).grid, str(path))


def orientations_that_disagree(folder: Path) -> object:
    image = nibabel.Nifti1Image(VALUES, AFFINE)
    image.set_qform(AFFINE, 1)
    image.set_sform(AFFINE + np.outer([30.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]), 1)
    nibabel.save(image, folder / "a.nii")
    return read_image(folder / "a.nii")


def sheared(folder: Path) -> object:
    affine = AFFINE.copy()
    affine[0, 1] = 0.5
    image = nibabel.Nifti1Image(VALUES, None)
    image.set_sform(affine, 1)
    image.set_qform(None, 0)
    nibabel.save(image, folder / "a.nii")
    return read_image(folder / "a.nii")


def misspelt(folder: Path) -> object:
    (folder / "mine.txt").write_text(f"{GOOD}(NumberOfResolutionz 3)\n")
    return read_parameter_file(folder / "mine.txt")


def gap(folder: Path) -> object:
    sorted(_series(folder / "scan").iterdir())[4].unlink()
    return read_image(folder / "scan")


def duplicate(folder: Path) -> object:
    shutil.copy(sorted(_series(folder / "scan").iterdir())[3], folder / "scan" / "again.dcm")
    return read_image(folder / "scan")


def two_series(folder: Path) -> object:
    for k in range(8):
        _write(_series(folder / "scan"), k, name=f"other{k}.dcm", SeriesInstanceUID="1.2.3.4")
    return read_image(folder / "scan")


def terabytes(folder: Path) -> object:
    path = nifti(folder / "a.nii")
    header = nibabel.Nifti1Header(path.read_bytes()[:348], check=False)
    header["dim"][1:4] = 30000
    path.write_bytes(header.binaryblock + path.read_bytes()[348:])
    return read_image(path)


def degenerate(folder: Path) -> object:
    box = block((2, 2, 2), (20.0, 20.0, 20.0))
    points = box.points_mm.copy()
    points[13] = points[0]
    return TetMesh(points, box.cells)


def result_elsewhere(folder: Path) -> object:
    image = read_image(nifti(folder / "a.nii"))
    path = written_result(folder, "vtu")["path"]
    return check_overlap(path, read_result("heel", path).mesh, image.grid)


def second_run(folder: Path) -> object:
    with FileLock(folder / ".mrstrain-lock"), alone(folder):
        return None


def study(old: str, new: str) -> Give:
    def give(folder: Path) -> object:
        assert old in WHOLE
        (folder / "study.toml").write_text(WHOLE.replace(old, new))
        return read_study(folder)

    return give


def folder_in_a_file(folder: Path) -> object:
    (folder / "file").write_text("x")
    return make_output(folder / "file" / "out")


PRESS = [LoadStep("Load1", 2.0)]
MEANT = "normal_n = 140"
REFUSED: list[tuple[int, Give, str, str, str]] = [  # row, what is given, and the words for file, cause and next step
    *((1, lambda folder, kind=kind: truncated(folder, kind), f"a.{kind}", "incomplete", "Copy or export it again")
      for kind in ("nii", "nii.gz", "mha", "nrrd")),
    (1, lambda folder: truncated(folder, "dcm"), "slice05.dcm", "damaged", "Export it again"),
    (2, with_nan, "a.nii", "1 of 504 voxels are NaN or infinite, the first at index (1, 2, 3)", "allow_missing"),
    (3, lambda folder: read_mask(nifti(folder / "a.nii", 0 * VALUES)), "a.nii", "the mask is empty", "Choose another"),
    (3, lambda folder: read_mask(nifti(folder / "a.nii", np.round(VALUES / 60.0))), "a.nii",
     "a mask must have zeros and one other value", "save one region as a mask"),
    (6, mask_elsewhere, "bone.nii", "0 % of its volume is inside the image", "drawn on another image"),
    (7, orientations_that_disagree, "a.nii", "qform and sform differ", "Set the code of the wrong one to 0"),
    (7, sheared, "a.nii", "the affine is sheared", "Resample the image"),
    (8, lambda folder: read_image(nifti(folder / "a.nii", 0 * VALUES + 3)), "a.nii", "constant (all voxels are 3)",
     "Export it again"),
    (8, lambda folder: read_image(nifti(folder / "a.nii", VALUES[:, :, 0])), "a.nii", "2D", "in one file"),
    (8, lambda folder: read_image(nifti(folder / "a.nii", VALUES[:, :, :1])), "a.nii", "9 x 8 x 1 voxels",
     "in one file"),
    (10, misspelt, "mine.txt", "no parameter 'NumberOfResolutionz'", "closest known name is 'NumberOfResolutions'"),
    (12, gap, "scan", "slices are missing", "Export the whole series"),
    (12, duplicate, "scan", "have the position of another slice", "keep only one"),
    (12, two_series, "scan", "contains 2 DICOM series", "dvc.write_image"),
    (13, terabytes, "a.nii", "100,582.8 GiB", "Crop or resample the image first"),
    (17, folder_in_a_file, "file/out", "results cannot be written here", "Choose another folder"),
    (17, lambda folder: refuse_touching_inputs(folder, ["Load1"], [folder / "Load1" / "a.nii"]), "Load1/a.nii",
     "would be replaced", "Choose another folder"),
    (17, lambda folder: refuse_small_disk(folder, 1e18, "the results need"), "",
     "the disk has only", "Free disk space, or choose"),
    (18, lambda _: mesh_labels(half_onion(), 4.0, bones=("calcaneus",)), "", "no region 'calcaneus'",
     "it has bone, fat"),
    (18, lambda _: Problem(dome((2, 2, 2)), {"fat": FAT}, Plate(DOWN, ALONG), PRESS), "", "8 cells have none",
     "Give each region one: skin has none"),
    (19, degenerate, "", "6 of 48 tetrahedra are degenerate", "Remove these cells or remesh"),
    (19, lambda _: TetMesh(block((2, 2, 2), (0.02, 0.02, 0.02)).points_mm, block((2, 2, 2), (1.0, 1.0, 1.0)).cells), "",
     "probably in metres", "set unit='m'"),
    (20, lambda _: NeoHooke.of(0.01, nu=0.5), "", "Poisson's ratio must be between", "For incompressible tissue use"),
    (20, lambda _: NeoHooke.of(-0.01), "", "the initial shear modulus must be positive", "it is -10 kPa"),
    (22, result_elsewhere, "Load1.vtu", "does not lie in the image. Model: 5 to 15", "Give the rigid map"),
    (23, study(MEANT, "normal_m = 140"), "study.toml", "'normal_m' is an unknown key", "did you mean 'normal_mm'"),
    (23, study(MEANT, "normal_n = true"), "study.toml", "'normal_n'", "should be a valid number"),
    (23, study('name = "Heel"', 'name = "Heel"\nout = "../elsewhere"'), "study.toml",
     "is not below the folder of the study", "Choose a folder below it"),
    (25, second_run, "", "another run writes to it", "Wait until it ends"),
]  # fmt: skip


@pytest.mark.parametrize(("number", "give", "file", "cause", "step"), REFUSED)
def test_a_refusal_names_the_file_the_cause_and_the_next_step(
    tmp_path: Path, number: int, give: Give, file: str, cause: str, step: str
) -> None:
    assert number in ROWS
    with pytest.raises(MrstrainError) as refusal:
        give(tmp_path)
    message = str(refusal.value)
    for words in (file, cause, step):
        assert words in message
    assert message.index(cause) < message.rindex(step)
    assert len(message.partition(":\n")[0]) < LONGEST + 2 * len(str(tmp_path))  # a list may follow
    assert not [path for path in tmp_path.rglob("*") if "partial" in path.name]
