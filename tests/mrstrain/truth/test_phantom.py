"""`phantom` writes images with the truth beside them, in the layout of `register`."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from dvc.deformation.protocol import RigidMotion
from dvc.errors import InputError, OutputError
from dvc.io.images.labels import read_labels, read_mask
from dvc.io.images.read import read_image
from mrstrain import phantom as make
from mrstrain.cli.app import app
from mrstrain.truth.phantom import PhantomFiles
from phantoms import Heel, random_foot_motion, under_load


@pytest.fixture(scope="module")
def made(made_once) -> Path:
    def fill(out: Path) -> None:
        told: list[float] = []
        given = {"loads": ("Load1", "Load4"), "spacing_mm": (1.6, 1.6, 3.2)}  # what is scanned lies 1.6 mm apart
        make(out, seed=2, progress=lambda _c, _s, f: told.append(f), **given)
        assert told == sorted(told)
        assert told[-1] == 1.0

    return made_once("phantom", fill)


def test_truth_lies_beside_the_images_as_register_writes_it(made: Path) -> None:
    names = {"displacement.nii.gz", "displacement.nrrd", "displacement.json", "green_lagrange.nii.gz"}
    names |= {"max_shear.nii.gz", "jacobian.nii.gz", "valid.nii.gz", "regions.csv", "provenance.json"}
    for load in ("Load1", "Load4"):
        assert names <= {p.name for p in (made / "truth" / load).iterdir()}
    assert not (made / "truth" / "Load2").exists()
    images = {"Load0", "Load0-again", "Load1", "Load4", "calcaneus", "tissues", "tissues_to_mesh"}
    assert images <= {p.name.removesuffix(".nii.gz") for p in made.glob("*.nii.gz")}


def test_the_command_that_registers_takes_a_folder_with_a_space() -> None:
    out = Path("new heel")
    images = {name: out / f"{name}.nii.gz" for name in ("Load0", "Load0-again", "Load1")}
    command = PhantomFiles(out, images).summary()[2]
    typed = "register {0}/Load0.nii.gz {0}/Load1.nii.gz --bone {0}/calcaneus.nii.gz --labels {0}/tissues.nii.gz"
    typed += " --names {0}/tissues.csv --repeat {0}/Load0-again.nii.gz --out {0}/results"
    assert shlex.split(command) == ["mrstrain", *(word.format(out) for word in typed.split())]


def test_truth_is_that_of_the_motion(made: Path) -> None:
    shear = read_image(made / "truth" / "Load4" / "max_shear.nii.gz", allow_missing=True)
    labels = read_labels(made / "tissues.nii.gz", made / "tissues.csv")
    np.testing.assert_array_equal(np.isfinite(shear.values), labels.labels > 0)
    fat = labels.region("fat").points()[::40]
    _, H = under_load(Heel(2), "Load4").evaluate(fat)
    F = H + np.eye(3)
    principal = np.linalg.eigvalsh(0.5 * (F.transpose(0, 2, 1) @ F - np.eye(3)))
    at = tuple(np.rint(shear.grid.indices_of(fat)).astype(int).T)
    np.testing.assert_allclose(shear.values[at], 0.5 * (principal[:, 2] - principal[:, 0]), atol=1e-6)
    assert shear.values[at].max() > 0.1


def test_foot_motions_are_recorded_and_true(made: Path) -> None:
    """The bone's place in a loaded scan, by its recorded motion, is where its dark rim is."""
    record = json.loads((made / "phantom.json").read_text())
    assert record["parameters"]["seed"] == 2
    bone = read_mask(made / "calcaneus.nii.gz").points()
    heel = Heel(2)
    rim = bone[np.abs(heel.bone.distance(bone)) < 0.7]
    loaded = read_image(made / "Load1.nii.gz")
    motion = record["foot_motion"]["Load1"]
    foot = RigidMotion(np.array(motion["rotation"]), np.array(motion["translation_lps_mm"]))

    def brightness(points: np.ndarray) -> float:
        at = np.rint(loaded.grid.indices_of(points)).astype(int)
        return float(loaded.values[tuple(at.T)].mean())

    assert foot.angle_deg > 0.5
    np.testing.assert_array_equal(foot.rotation, random_foot_motion(2, 1).rotation)  # this seed's, not every phantom's
    assert brightness(foot.apply(rim)) < 0.95 * brightness(rim)


def test_bad_numbers_are_refused_before_anything_is_made(tmp_path: Path) -> None:
    for arguments, says in (
        ({"spacing_mm": 0.1}, "0.3 and 4"),
        ({"spacing_mm": (1.0, 2.0)}, "three"),
        ({"snr": 0.2}, "SNR"),
        ({"loads": ("Load9",)}, "Load9"),
        ({"loads": ()}, "at least one"),
        ({"pad_mm": 90.0}, "pad_mm"),
    ):
        with pytest.raises(InputError, match=says):
            make(tmp_path / "out", **arguments)
    assert not (tmp_path / "out").exists()


def test_full_disk_is_told_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 10**6))
    with pytest.raises(OutputError, match="1 MB left"):
        make(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_command_tells_how_to_register(tmp_path: Path) -> None:
    given = ["phantom", "--out", str(tmp_path / "p"), "--load", "Load2", "--spacing", "3.2", "--no-noise"]
    result = CliRunner().invoke(app, given)
    assert result.exit_code == 0, result.output
    assert "mrstrain register" in result.output
    assert (tmp_path / "p" / "truth" / "Load2" / "max_shear.nii.gz").exists()
