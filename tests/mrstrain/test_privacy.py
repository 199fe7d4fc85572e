"""What names a patient in the header of an input reaches no byte of any output, and nothing that is printed."""

from __future__ import annotations

import base64
import gzip
import zlib
from pathlib import Path

import numpy as np
import pytest

from dvc import write_image, write_labels, write_mask
from mrstrain import register
from tests.planted import BORN, NAME, NUMBER, PLACE, PLANTED, plant_in_nifti, plant_in_nrrd, planted_in, write_dicom

pytestmark = pytest.mark.usefixtures("in_this_process")


@pytest.fixture(scope="module")
def inputs(made_once, tiny_pair) -> Path:
    """Images, labels and masks of a heel, each with a patient in its header."""

    def fill(folder: Path) -> None:
        write_dicom(folder / "Load0", tiny_pair.reference)
        write_image(folder / "Load1.nrrd", tiny_pair.loaded)
        write_image(folder / "again.nii.gz", tiny_pair.repeat)
        write_mask(folder / "bone.nii.gz", tiny_pair.bone)
        write_labels(folder / "tissues.nrrd", tiny_pair.labels)
        for name in ("Load1.nrrd", "tissues.nrrd"):
            plant_in_nrrd(folder / name)
        for name in ("again.nii.gz", "bone.nii.gz"):
            plant_in_nifti(folder / name)
        (folder / "heel.inp").write_text(_abaqus(tiny_pair))

    return made_once("planted", fill)


def _abaqus(pair) -> str:
    """A mesh of another program with the patient in its heading, comments and names of sets."""
    centre = pair.bone.points().mean(axis=0)
    nodes = centre + np.array([[0, 0, -18], [5, 0, -18], [0, 5, -18], [0, 0, -14.0]])
    lines = ["*Heading", f"{NAME} {NUMBER}", f"** {PLACE}", "*Node"]
    lines += [f"{n}, {x}, {y}, {z}" for n, (x, y, z) in enumerate(nodes, start=1)]
    return "\n".join([*lines, "*Element, type=C3D4, elset=fat", "1, 1, 3, 2, 4"]) + "\n"


def test_the_search_finds_what_is_hidden(tmp_path: Path) -> None:
    (tmp_path / "a.gz").write_bytes(b"head" + gzip.compress(b"x" * 99 + NAME.encode()))
    np.savez_compressed(tmp_path / "b.npz", who=np.array([NUMBER]))
    (tmp_path / "c.html").write_bytes(
        b"<p>" + base64.b64encode(zlib.compress(bytes(range(99)) + BORN.encode())) + b"</p>"
    )
    (tmp_path / PLACE).mkdir()
    found = planted_in(tmp_path)
    assert [one.rpartition("/")[2] for one in found] == [
        f"{PLACE}: {PLACE}",
        f"a.gz: {NAME}",
        "a.gz: Quixote",
        f"b.npz: {NUMBER}",
        f"c.html: {BORN}",
    ]


@pytest.fixture(scope="module")
def registered(made_once, inputs: Path) -> Path:
    def fill(folder: Path) -> None:
        done = register(
            inputs / "Load0", [inputs / "Load1.nrrd"], out=folder / "out", bone=inputs / "bone.nii.gz",
            labels=inputs / "tissues.nrrd", names=inputs / "tissues.csv", repeat=inputs / "again.nii.gz",
            mesh=inputs / "heel.inp", bending=3.0, volume=300.0, borders=False, threads=1, workers=1,
        )  # fmt: skip
        assert not done.failures

    return made_once("planted-registered", fill)


def test_a_registration_names_no_patient(inputs: Path, registered: Path) -> None:
    assert {one.rpartition(": ")[2] for one in planted_in(inputs)} == set(PLANTED)
    assert planted_in(registered) == []
