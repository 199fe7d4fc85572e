"""A small study to compare models with, and its plain comparison, made once for all tests."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import meshio
import numpy as np
import pytest

from dvc.io.images.write import write_labels
from dvc.io.result_folder import write_displacement
from mrstrain.comparison.compare import Compared, compare
from tests.mrstrain.comparison.test_compare import LOADS, given
from tests.validate.test_comparison import cube, labels, sheared


@pytest.fixture(autouse=True)
def _here(in_this_process) -> None:
    """Tests of `validate` hold that loads compared in processes give the same to the bit."""


def _fill(folder: Path) -> None:
    tissues = labels()
    write_labels(folder / "tissues.nii.gz", tissues)
    (folder / "tissues.csv").write_text("label,name\n1,fat\n2,skin\n3,bone\n")
    mesh = cube(6)
    points = tissues.grid.points().reshape(*tissues.grid.shape, 3)
    for load, gamma in LOADS.items():
        measured = folder / "measured" / load
        measured.mkdir(parents=True)
        u = sheared(gamma).displacement(points.reshape(-1, 3)).reshape(points.shape)
        write_displacement(measured, tissues.grid, u.astype(np.float32))
        for model, factor in (("right", 1.0), ("half", 0.5)):
            place = folder / model / f"{load}.vtu"
            place.parent.mkdir(exist_ok=True)
            moved = sheared(factor * gamma).displacement(mesh.points_mm)
            meshio.write(place, meshio.Mesh(mesh.points_mm, [("tetra", mesh.cells)], {"displacement": moved}))


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """Measured shear of two loads, and the models "right" (the same) and "half"; a label map and its names."""
    _fill(tmp_path)
    return tmp_path


class Plain(NamedTuple):
    """The study, compared without error models; nobody may write into its folder."""

    folder: Path
    done: Compared


@pytest.fixture
def plain(made_once, computed_once, in_this_process) -> Plain:
    folder = made_once("compared-study", _fill)
    models = [folder / "right", folder / "half"]
    return Plain(folder, computed_once("compared", lambda: compare(folder / "measured", models, **given(folder))))
