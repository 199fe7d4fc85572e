"""Commands that are killed: what they leave is not taken for a result, and the same command gives the same results.

All of full size: in `make test`, a stage of a study and a simulation are killed (test_run, fe/test_restart), and what
has begun and not ended is taken for no result (records/test_begun).
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import SimpleITK as sitk

import mrstrain
from dvc.errors import InputError
from dvc.own_files import read_rows
from mrstrain.comparison.model_files import model_files
from mrstrain.options.modelling import ModelReading
from mrstrain.studies.run import forecast
from mrstrain.truth.accuracy import _finished
from tests.golden.scenes import GIVEN
from tests.processes import under_way, wait_for

DATA = (".nii.gz", ".vtu", ".csv", ".npz", ".inp", ".mac", ".feb", ".toml")
"""Endings of results that are compared; records, reports and logs have times of day, or their order, in them."""


_WITH_SECONDS = {"counts", "head"}
slow = partial(pytest.param, marks=pytest.mark.full_size)


@dataclass(frozen=True)
class Killed:
    """A command without its output folder, when it is killed, and what must hold of the folder then."""

    command: list[str]
    begun: Callable[[Path], bool]
    left: Callable[[Path], None]
    inputs: Path | None = None  # a folder that is copied to the output folder first


@pytest.fixture(scope="module")
def made(made_once: Callable[..., Path]) -> Path:
    """Two measured loads, each a stretch of the golden image, and a model driven by them."""
    subject = {"labels": GIVEN / "tissues.nii.gz", "names": GIVEN / "tissues.csv", "bone_label": "bone"}

    def fill(folder: Path) -> None:
        for load, stretch in (("Load1", 1.01), ("Load2", 1.02)):
            matrix = (stretch, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0 / stretch)
            sitk.WriteTransform(sitk.AffineTransform(matrix, (0.0, 0.0, 0.0)), str(folder / f"{load}.tfm"))
            transform, out = folder / f"{load}.tfm", folder / "measured"
            mrstrain.strain(GIVEN / "Load0.nii.gz", transform, out=out, **subject)
        mrstrain.drive(
            GIVEN / "pad.inp", folder / "measured", out=folder, sets=[str(GIVEN / "materials.toml")], threads=1
        )

    return made_once("killed", fill)


def refused(folder: Path) -> None:
    with pytest.raises(InputError, match=r"has not ended|has no file of a measured load"):
        model_files(["Load1"], [folder], ModelReading())


def driving(made: Path) -> Killed:
    command = ["drive", str(GIVEN / "pad.inp"), str(made / "measured"), "--set", str(GIVEN / "materials.toml")]
    own = "two-laws-driven"

    def left(out: Path) -> None:
        if json.loads((out / own / "simulation.json").read_text())["outcome"]:
            pytest.skip("the simulation had ended before it was killed")
        refused(out / own)

    return Killed(command, lambda out: (out / own / "Load1.vtu").is_file(), left)


def levelling(made: Path) -> Killed:
    place = made.with_name("killed-heel")
    mrstrain.phantom(place, seed=3, spacing_mm=2.3, loads=["Load1"])
    heel = [str(place / name) for name in ("Load0.nii.gz", "tissues.nii.gz", "tissues.csv")]
    named = ["--labels", heel[1], "--names", heel[2], "--bone-label", "bone"]
    command = ["level", heel[0], str(made / "two-laws-driven"), "--load", "Load1", *named]
    image = Path("two-laws-driven-levelled-work") / "images" / "Load1.nii.gz"
    return Killed(command, lambda out: (out / image).is_file(), lambda out: refused(out / "two-laws-driven-levelled"))


def measuring_accuracy(made: Path) -> Killed:
    command = ["accuracy", "--spacing", "3", "--seed", "1", "--workers", "1"]
    command += ["--motion", "still", "--motion", "Load1"]

    def left(out: Path) -> None:
        assert [run.case.motion for run in _finished(out / "runs").values()] == ["still"]
        assert not (out / "report.html").exists()

    return Killed(command, lambda out: any((out / "runs").glob("*_still_1.npz")), left)


def running_a_cohort(made: Path) -> Killed:
    def left(out: Path) -> None:
        assert forecast(out / "study")["compare"] == "will run"
        assert not (out / "cohort.csv").exists()

    def begun(out: Path) -> bool:
        return under_way(out / "study" / "results" / ".study", "simulate akrami")

    return Killed(["cohort", "study", "--workers", "1"], begun, left, GIVEN)


@pytest.mark.parametrize(
    "case",
    [
        slow(driving), slow(levelling), slow(measuring_accuracy), slow(running_a_cohort),
    ],
)  # fmt: skip
def test_a_command_that_is_killed_leaves_nothing_whole_and_gives_the_same_when_repeated(made, tmp_path, case):
    asked = case(made)
    whole, out = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, out):
        folder.mkdir()
        if asked.inputs is not None:
            shutil.copytree(asked.inputs, folder / "study")
    subprocess.run(run(asked.command, whole), cwd=whole, check=True, stdout=subprocess.DEVNULL)
    process = subprocess.Popen(run(asked.command, out), cwd=out, stdout=subprocess.DEVNULL, start_new_session=True)
    try:
        wait_for(lambda: asked.begun(out), process)
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    asked.left(out)
    subprocess.run(run(asked.command, out), cwd=out, check=True, stdout=subprocess.DEVNULL)
    ours, theirs = (files_in(folder) for folder in (out, whole))
    assert ours.keys() == theirs.keys()
    assert [name for name in ours if not same(ours[name], theirs[name])] == []


def run(command: list[str], out: Path) -> list[str]:
    return [sys.executable, "-m", "mrstrain", *command, "--out", str(out)]


def files_in(folder: Path) -> dict[str, Path]:
    """Files of results below a folder, by their place."""
    found = [file for file in folder.rglob("*") if file.is_file() and file.name.endswith(DATA)]
    return {str(file.relative_to(folder)): file for file in found if not any(p.startswith(".") for p in file.parts)}


def same(one: Path, other: Path) -> bool:
    """Whether two files are equal byte for byte; tables and arrays but for the seconds that something took."""
    if one.suffix == ".csv":
        a, b = ([{**row, "seconds": ""} for row in read_rows(file)] for file in (one, other))
        return a == b
    if one.suffix != ".npz":
        return one.read_bytes() == other.read_bytes()
    with np.load(one) as a, np.load(other) as b:
        return sorted(a) == sorted(b) and all(np.array_equal(a[name], b[name]) for name in {*a} - _WITH_SECONDS)
