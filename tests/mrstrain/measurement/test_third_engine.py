"""A third engine is one class: nothing that registers, judges or writes has to know it."""

from __future__ import annotations

import ast
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import dvc
import mrstrain
from dvc.arrays import FloatArray
from dvc.errors import InputError
from dvc.images.image import Grid, Image, Mask
from dvc.io.images.write import write_image, write_mask
from dvc.io.result_folder import result_folders, spline_in
from dvc.io.transforms.read import read_transform
from dvc.registration.engine import AlignedPair, Engine, Found
from dvc.registration.engines import ENGINES, methods_of
from dvc.registration.register import Settings, register

pytestmark = pytest.mark.usefixtures("in_this_process")

GRID = Grid((24, 22, 20), (1.5, 1.5, 1.5), (-18.0, -16.0, -15.0))
SHIFT = np.array([1.5, -3.0, 0.0])


@dataclass(frozen=True, eq=False)
class Shift:
    """A displacement that is the same everywhere."""

    shift_mm: FloatArray
    spacing_mm = np.full(3, 2.0)

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        return np.broadcast_to(self.shift_mm, np.shape(points_mm)).astype(float)

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.displacement(points_mm), np.zeros((len(points_mm), 3, 3))

    def turned(self, rotation: FloatArray) -> Shift:
        return Shift(rotation @ self.shift_mm)


@dataclass(frozen=True)
class Centroids(Engine):
    """The shift between the centroids of what is bright in both images."""

    above: float = 50.0
    family = name = "centroids"

    @property
    def text(self) -> str:
        return f"brighter than {self.above}"

    def record(self) -> dict[str, object]:
        return {"above": self.above}

    def find(self, pair: AlignedPair, *, start, seeds, worker, progress) -> Found:
        progress("registering", 1.0)
        assert len(seeds) == 0
        fixed, moving = (Mask(i.grid, i.values > self.above).points().mean(axis=0) for i in (pair.fixed, pair.moving))
        return Found(Shift(moving - fixed), unlike_study="No phantom was ever only shifted.")


def block(at: np.ndarray) -> Image:
    low, high = np.array([7, 6, 5]) + at, np.array([15, 14, 13]) + at
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = True
    noise = np.random.default_rng(int(abs(at).sum())).normal(0.0, 2.0, GRID.shape)
    return Image(GRID, (np.where(inside, 100.0, 10.0) + noise).astype(np.float32))


BODY = Mask(GRID, block(np.zeros(3, dtype=int)).values > 50.0)
LOADED = np.rint(SHIFT / 1.5).astype(int)


def test_it_registers_a_pair() -> None:
    found = register(
        block(np.zeros(3, dtype=int)), block(LOADED), tissue=BODY, settings=Settings(Centroids(), align_on="none")
    )
    np.testing.assert_allclose(found.displacement.displacement(GRID.points(BODY.inside)), np.tile(SHIFT, (512, 1)))
    assert (found.choice.as_dict(), found.settings.of_repeat()) == ({}, found.settings)


def test_its_results_are_written_read_and_told(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(ENGINES, "centroids", Centroids)
    write_image(tmp_path / "Load0.nii.gz", block(np.zeros(3, dtype=int)))
    write_image(tmp_path / "Load1.nii.gz", block(LOADED))
    write_mask(tmp_path / "body.nii.gz", BODY)
    given = {"tissue": tmp_path / "body.nii.gz", "align": "none", "engine": "centroids", "workers": 1, "threads": 1}
    done = mrstrain.register(tmp_path / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "out", **given)
    assert not done.failures
    folder = tmp_path / "out" / "Load1"
    record, quality = (json.loads((folder / name).read_text()) for name in ("provenance.json", "quality.json"))
    assert (record["parameters"]["engine"], record["parameters"]["above"]) == ("centroids", 50.0)
    assert quality["alignment"]["engine"] == "centroids"
    assert "mrstrain accuracy --preset centroids" in quality["error_of_max_shear"]["reason"]
    assert not (folder / "TransformParameters.0.txt").exists()
    X = GRID.points(BODY.inside)
    for read in (read_transform(folder / "transform.h5"), spline_in(folder), result_folders(folder)[0].deformation()):
        np.testing.assert_allclose(read.displacement(X), np.tile(SHIFT, (len(X), 1)), atol=1e-5)
    assert methods_of(record["parameters"], record["versions"]).startswith("with the engine centroids of mrstrain")
    with pytest.raises(InputError, match="the engine is centroids"):
        mrstrain.register(
            tmp_path / "Load0.nii.gz", [tmp_path / "Load1.nii.gz"], out=tmp_path / "no", bending=1.0, **given
        )


ENGINES_KNOWN_IN = {
    "dvc/labelling/carried.py",  # between two subjects it has weights of its own
    "dvc/registration/engines.py",  # every engine by its name, and the default
    "mrstrain/measurement/engines.py",  # options of the command line to an engine
}
CLASSES = {"GaussNewton", "GaussNewtonAtBone", "GaussNewtonWithInterfaces", "Elastix"}


def test_no_other_file_knows_an_engine() -> None:
    """Whoever asks which engine it has, has to import its class."""
    root = Path(dvc.__file__).parents[1]
    knowing = set()
    for package in ("dvc", "fe", "phantoms", "validate", "mrstrain"):
        for file in (root / package).rglob("*.py"):
            names = {
                alias.name
                for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
                if isinstance(node, ast.ImportFrom)
                for alias in node.names
            }
            if names & CLASSES:
                knowing.add(file.relative_to(root).as_posix())
    assert knowing == ENGINES_KNOWN_IN
