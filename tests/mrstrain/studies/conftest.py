"""A small study of three registrations, a mesh, a simulation and a comparison; finished once for all tests."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from dvc.images.image import Grid, LabelMap
from dvc.io.images.write import write_image, write_labels
from mrstrain.cli.app import app
from tests.mrstrain.studies import checked_study
from tests.pictures import real_pictures
from tests.planted import plant_in_nifti
from tests.processes import stages_run_here

STUDY = """
[study]
name = "Heel <b>3</b>"
[images]
load0 = "Load0.nii.gz"
labels = "tissues.nii.gz"
names = "tissues.csv"
repeat = "Load0-again.nii.gz"
[loads.Load1]
image = "Load1.nii.gz"
normal_n = 8.0
[loads.Load2]
image = "Load2.nii.gz"
normal_n = 2.0
[registration]
bending = 3.0
volume = 300.0
borders = false
[mesh]
edge_mm = 9.0
labels = "to_mesh.nii.gz"
names = "to_mesh.csv"
[models]
sets = ["akrami"]
"""


def coarse(labels: LabelMap) -> LabelMap:
    """Bone and soft tissue at twice the voxel: a mesh of few cells."""
    grid = labels.grid
    bones = [n for n, name in labels.names.items() if name in ("bone", "ankle")]
    values = labels.labels[::2, ::2, ::2]
    both = np.where(np.isin(values, bones), 1, np.where(values > 0, 2, 0))
    return LabelMap(
        Grid(both.shape, 2.0 * grid.spacing_mm, grid.origin_mm, grid.direction), both, {1: "bone", 2: "fat"}
    )


@pytest.fixture(scope="module")
def images(made_once, tiny_pair, small_pair) -> Path:
    """A heel at 2.3 mm; the repeat scan serves for Load2 too, with one voxel changed: no image is given twice."""

    def fill(folder: Path) -> None:
        write_image(folder / "Load0.nii.gz", tiny_pair.reference)
        write_image(folder / "Load1.nii.gz", tiny_pair.loaded)
        values = tiny_pair.repeat.values.copy()
        values[0, 0, 0] += 1.0
        write_image(folder / "Load2.nii.gz", type(tiny_pair.repeat)(tiny_pair.repeat.grid, values))
        write_image(folder / "Load0-again.nii.gz", tiny_pair.repeat)
        write_labels(folder / "tissues.nii.gz", tiny_pair.labels)
        write_labels(folder / "to_mesh.nii.gz", coarse(small_pair.labels))
        for image in folder.glob("*.nii.gz"):
            plant_in_nifti(image)  # a patient, whom no result may name
        (folder / "study.toml").write_text(STUDY)

    return made_once("study-images", fill)


@pytest.fixture(scope="module")
def done(images, made_once, tmp_path_factory):
    """The study, run once for all by its command, and what that printed; each test worker has a copy."""

    def fill(folder: Path) -> None:
        shutil.copytree(images, folder / "study")
        with stages_run_here(), real_pictures():
            told = CliRunner().invoke(app, ["run", str(folder / "study")])
        assert told.exit_code == 0, told.output
        (folder / "told.json").write_text(json.dumps([told.stdout, told.stderr]))

    folder = made_once("study-done", fill)
    own = tmp_path_factory.mktemp("done") / "study"
    shutil.copytree(folder / "study", own)
    return own, *json.loads((folder / "told.json").read_text())


@pytest.fixture
def stages_in_this_process() -> Iterator[None]:
    """For tests of what a study makes; others start the processes that users have."""
    with stages_run_here():
        yield


@pytest.fixture
def folder(tmp_path):
    """A study of text files, for stages that only write a file."""
    (tmp_path / "results").mkdir()
    for name in ("a", "b", "labels"):
        (tmp_path / f"{name}.txt").write_text(name)
    return tmp_path


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """A study that `check` looks at, as `checked_study.written` writes it."""
    return checked_study.written(tmp_path)
