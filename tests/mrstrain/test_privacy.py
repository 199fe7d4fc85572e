"""What names a patient in the header of an input reaches no byte of any output, and nothing that is printed."""

from __future__ import annotations

import base64
import gzip
import re
import shutil
import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dvc import read_image, write_image, write_labels, write_mask
from mrstrain import accuracy, register, strain, twin
from tests.phantoms.test_error_tables import CASE, samples
from tests.planted import (
    BORN,
    NAME,
    NUMBER,
    PLACE,
    PLANTED,
    plant_beside,
    plant_in_nifti,
    plant_in_nrrd,
    planted_in,
    write_dicom,
    write_enhanced_dicom,
)
from tests.quick import QUICK

pytestmark = pytest.mark.usefixtures("in_this_process")


@pytest.fixture(scope="module")
def inputs(made_once, tiny_pair) -> Path:
    """Images, labels and masks of a heel, each with a patient in its header."""

    def fill(folder: Path) -> None:
        write_dicom(folder / "Load0", tiny_pair.reference)
        write_enhanced_dicom(folder / "enhanced.dcm", tiny_pair.reference)
        write_image(folder / "Load1.nrrd", tiny_pair.loaded)
        write_image(folder / "again.nii.gz", tiny_pair.repeat)
        write_mask(folder / "bone.nii.gz", tiny_pair.bone)
        write_labels(folder / "tissues.nrrd", tiny_pair.labels)
        for name in ("Load1.nrrd", "tissues.nrrd"):
            plant_in_nrrd(folder / name)
        for name in ("again.nii.gz", "bone.nii.gz"):
            plant_in_nifti(folder / name)
        plant_beside(folder / "again.nii.gz")
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
    page = (registered / "out" / "report.html").read_text()
    section = page.split("<h2>Acquisition and measurement</h2>")[1].split("</details>")[0]
    rows = dict(re.findall(r"<th scope=row[^>]*>([^<]*)</th>\s*<td[^>]*>([^<]*)</td>", section))
    assert rows["Scanner, manufacturer"] == "Siemens (unloaded image); not given (Load1, repeat)"
    assert rows["Scanner, model"] == rows["Sequence, name"] == "not given"
    assert rows["Field strength, T"] == "not given (unloaded image, Load1); 3 (repeat)"
    assert rows["Flip angle, degrees"] == "12 (unloaded image); not given (Load1, repeat)"


def test_an_enhanced_file_holds_all_names_and_is_read_as_the_series_is(inputs: Path) -> None:
    assert {one for one in PLANTED if f"{inputs / 'enhanced.dcm'}: {one}" in planted_in(inputs)} == set(PLANTED)
    one, other = read_image(inputs / "enhanced.dcm"), read_image(inputs / "Load0")
    assert one.grid.same_as(other.grid)
    assert np.array_equal(one.values, other.values)


@pytest.fixture
def measured(inputs: Path, registered: Path, tmp_path: Path) -> Path:
    """A displacement image of a registration, with the patient in its header."""
    whole = tmp_path / "given" / "measured.nii.gz"
    whole.parent.mkdir()
    shutil.copy(registered / "out" / "Load1" / "displacement.nii.gz", whole)
    plant_in_nifti(whole)
    assert planted_in(whole.parent)
    return whole


@pytest.mark.parametrize("load0", ["Load0", "enhanced.dcm"])
@pytest.mark.parametrize("command", [strain, twin])
def test_strain_and_twin_name_no_patient(
    inputs: Path, measured: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], command: Any, load0: str
) -> None:
    done = command(
        inputs / load0, measured, out=tmp_path / "out", frame="LPS", bone=inputs / "bone.nii.gz",
        labels=inputs / "tissues.nrrd", names=inputs / "tissues.csv",
    )  # fmt: skip
    assert len([file for file in (tmp_path / "out").rglob("*") if file.is_file()]) > 5
    assert planted_in(tmp_path / "out") == []
    printed = "\n".join([*done.summary(), *capfd.readouterr()])
    assert not [word for word in PLANTED if word in printed]


def test_an_accuracy_study_tells_no_folder_of_its_parameter_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its input that may name a patient; the samples keep the path, since from them the study goes on."""
    given = tmp_path / NAME / NUMBER / "mine.txt"
    given.parent.mkdir(parents=True)
    given.write_text(QUICK)
    monkeypatch.setattr("mrstrain.truth.accuracy.measure_run", lambda case, *_: samples(case))
    study = accuracy(tmp_path / "out", cases=[replace(CASE, preset=str(given))], workers=1)
    assert "mine.txt, " in (tmp_path / "out" / "report.html").read_text()
    assert all(row.preset == "mine.txt" for row in study.errors)
    assert {one.split("/out/")[1].split("/")[0] for one in planted_in(tmp_path / "out")} == {"runs"}
