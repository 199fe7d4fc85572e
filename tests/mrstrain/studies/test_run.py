"""A study from its file to its report: run, run again, changed, broken, killed, shared out over a cluster."""

from __future__ import annotations

import contextlib
import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from dvc.errors import OutputError
from dvc.io.images.read import read_image
from dvc.io.images.write import write_image
from mrstrain.studies.check import check
from mrstrain.studies.file import read_study
from mrstrain.studies.init import init
from mrstrain.studies.plan import plan
from mrstrain.studies.run import forecast, report, run, run_studies
from tests.planted import PLANTED, planted_in
from tests.processes import cluster_of, stages_run_here, under_way, wait_for
from tests.quick import QUICK

STAGES = ["register repeat", "register Load1", "register Load2", "mesh", "simulate akrami", "compare"]


def shear_of(folder: Path, load: str) -> np.ndarray:
    return read_image(folder / "results" / "registration" / load / "max_shear.nii.gz", allow_missing=True).values


def change(study: Path, *changes: tuple[str, str]) -> None:
    """Change texts of a study's file."""
    text = (study / "study.toml").read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (study / "study.toml").write_text(text)


def areas(study: Path) -> list[float]:
    with (study / "results" / "comparison" / "areas.csv").open() as file:
        return [float(row["ml"]) for row in csv.DictReader(file)]


def test_no_result_names_the_patient_of_an_images_header(done, images):
    folder, *printed = done
    assert planted_in(folder / "results") == []
    assert not any(word in text for word in PLANTED for text in printed)
    assert {one.rpartition(": ")[2] for one in planted_in(images)} == set(PLANTED)


def test_every_result_is_there_and_the_report_tells_it(done):
    folder, stdout, stderr = done
    out = folder / "results"
    for name in (
        "registration/Load1/displacement.nii.gz",
        "registration/repeat/quality.json",
        "mesh/mesh.vtu",
        "models/akrami/Load1.vtu",
        "models/akrami/Load2.vtu",
        "comparison/areas.csv",
        "provenance.json",
    ):
        assert (out / name).is_file(), name
    page = (out / "report.html").read_text()
    assert "Heel &lt;b&gt;3&lt;/b&gt;" in page
    assert "<b>3</b>" not in page
    assert "Registration of Load1" in page
    assert "Area between measured and simulated strain-volume curves" in page
    assert "Stages" in page
    assert re.search(r"^Report: .*study/results/report\.html$", stdout, re.M)
    assert "akrami" in stdout
    for stage, found in (
        (
            "register Load1",
            r"max\. shear in \w+ 0\.\d{3} median, 0\.\d{3} at the 95th percentile; (Trust|Use|Do)",
        ),
        ("mesh", r"\d+ tetrahedra"),
        ("simulate akrami", r"plate displacement, mm: Load1 \d+\.\d, Load2 \d"),
        ("compare", r".*akrami"),
    ):
        assert re.search(rf"^{stage}: {found}.* \(\d of 6 stages after .*\)$", stderr, re.M), stage
    assert re.search(r"^mesh: .*, about \d+ (s|min) left\)$", stderr, re.M)
    assert re.search(r"^finished after \d+ (s|min): 6 of 6 stages$", stderr, re.M)
    log = (out / "study.log").read_text()
    assert all(f"{stage}: done after" in log for stage in STAGES)
    assert re.search(
        r"To do: 6 of 6 stages, about \d+ (s|min) on \d+ cores if they are idle, [\d.]+ GiB of memory", log
    )
    record = json.loads((out / "provenance.json").read_text())
    assert {f["name"] for f in record["inputs"]["inputs"]} >= {"Load0.nii.gz", "tissues.nii.gz"}


def test_parameter_files_are_inputs_of_every_registration(images, tmp_path):
    study = tmp_path / "study"
    shutil.copytree(images, study)
    (study / "quick.txt").write_text(QUICK)
    own = 'parameters = ["quick.txt"]\n'
    change(study, ("bending = 3.0\nvolume = 300.0\nborders = false\n", own))
    registrations = [stage for stage in plan(read_study(study)) if stage.kind == "register"]
    assert len(registrations) == 3
    assert all(study / "quick.txt" in stage.files for stage in registrations)


def test_run_again_does_nothing_in_under_ten_seconds(done):
    folder, *_ = done
    before = (folder / "results" / "mesh" / "mesh.vtu").stat().st_mtime_ns
    assert set(forecast(folder).values()) == {"up to date"}
    began = time.process_time()  # a busy machine makes it no longer, as the clock would
    outcomes = run(folder).outcomes
    assert time.process_time() - began < 10.0
    assert all(o.reused for o in outcomes.values())
    assert (folder / "results" / "mesh" / "mesh.vtu").stat().st_mtime_ns == before


def test_a_disk_with_too_little_room_is_refused_before_anything_is_made(done, images, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 5 * 10**7))
    shutil.copytree(images, tmp_path / "study")
    said = r"the results of 6 stages need about (\d+) MB, but the disk has only 50 MB left"
    with pytest.raises(OutputError, match=said) as refused:
        run(tmp_path / "study")
    assert not (tmp_path / "study" / "results" / "registration").exists()
    one = 10**6 * int(re.search(said, str(refused.value))[1])
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 3 * one // 2))
    shutil.copytree(images, tmp_path / "other")
    change(tmp_path / "other", ('name = "Heel', 'name = "Other heel'))
    with pytest.raises(OutputError, match="the results of 12 stages need"):  # room for one of two
        run_studies([read_study(tmp_path / name) for name in ("study", "other")])
    assert run(done[0]).complete  # where all is there already, none is needed


def test_the_report_alone(done):
    folder, *_ = done
    first = (folder / "results" / "report.html").read_text()
    (folder / "results" / "report.html").unlink()
    report(folder)
    again = (folder / "results" / "report.html").read_text()
    assert "Registration of Load2" in again
    assert abs(len(again) - len(first)) < 2000  # but for times and "up to date"


def test_only_what_changed_is_done_anew(done, tmp_path):
    folder, *_ = done
    study = tmp_path / "study"
    shutil.copytree(folder, study)
    change(study, ("normal_n = 8.0", "normal_n = 6.0"))
    told = forecast(study)
    assert [name for name, what in told.items() if what == "will run"] == ["simulate akrami", "compare"]
    image = read_image(study / "Load2.nii.gz")
    values = image.values.copy()
    values[0, 0, 0] += 1.0
    write_image(study / "Load2.nii.gz", type(image)(image.grid, values))  # the same shape, and nearly the same size
    assert [name for name, what in forecast(study).items() if what == "will run"] == [
        "register Load2", "simulate akrami", "compare",
    ]  # fmt: skip


@pytest.mark.usefixtures("stages_in_this_process")
def test_a_broken_image_leaves_the_others_to_finish_and_is_named(done, tmp_path):
    folder, *_ = done
    study = tmp_path / "Doe_Jane" / "heel"
    shutil.copytree(folder, study)
    whole = (study / "Load2.nii.gz").read_bytes()
    (study / "Load2.nii.gz").write_bytes(whole[: len(whole) // 2])
    ran = run(study, workers=1)
    assert not ran.complete
    assert any(line.startswith("register Load2: FAILED") for line in ran.summary())
    out = study / "results"
    assert not (out / "registration" / "Load2").exists()  # that of the whole image is no result of this one
    with (out / "comparison" / "areas.csv").open() as file:
        assert "Load2" not in {row["load"] for row in csv.DictReader(file)}
    page = (out / "report.html").read_text()
    assert "register Load2: failed" in page
    for file in (out / "report.html", out / "study.log", out / "provenance.json", *(out / ".study").glob("*.*")):
        assert "Doe_Jane" not in file.read_text(), file


def without_loads(done: Path, study: Path, loads: tuple[str, ...] = ("Load1", "Load2")) -> Path:
    """A copy of the finished study, in which loads have still to be registered."""
    shutil.copytree(done, study)
    for load in loads:
        (study / "results" / ".study" / f"register {load}.json").unlink()
        shutil.rmtree(study / "results" / "registration" / load)
    return study


@pytest.mark.parametrize(
    "stage",
    [
        "register Load1",
        *(pytest.param(name, marks=pytest.mark.full_size) for name in ("mesh", "simulate akrami", "compare")),
    ],
)
def test_killed_in_any_stage_and_run_again_gives_the_same(done, tmp_path, stage):
    """Made anew and killed half-way, a stage has no result; the next run makes it, and what builds on it alone."""
    folder, *_ = done
    study = tmp_path / "study"
    shutil.copytree(folder, study)
    records = study / "results" / ".study"
    left = [stage, "compare"] if stage == "register Load1" else STAGES[STAGES.index(stage) :]
    kept = {name: (records / f"{name}.json").read_bytes() for name in STAGES if name not in left}
    command = [sys.executable, "-m", "mrstrain", "run", str(study), "--force", stage, "--workers", "1"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for(lambda: under_way(records, stage), process)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (records / f"{stage}.json").exists()
    assert stage != "register Load1" or not (study / "results" / "registration" / "Load1").exists()
    told = forecast(study)
    assert [name for name in STAGES if told[name] == "will run"] == left
    of_all: list[float] = []
    ended: list[str] = []

    def progress(case: str, told: str, fraction: float) -> None:
        of_all.extend([fraction] if case == "all" else [])
        ended.extend([case] if case != "all" and fraction == 1.0 else [])

    with stages_run_here():
        again = run(study, progress=progress, workers=1)
    assert again.complete
    assert [name for name in STAGES if not again.outcomes[name].reused] == left
    assert {name: (records / f"{name}.json").read_bytes() for name in kept} == kept
    assert ended == left
    assert all(0.0 <= share < 1.0 for share in of_all[:-1])
    assert of_all[-1] == 1.0
    assert np.array_equal(shear_of(study, "Load1"), shear_of(folder, "Load1"), equal_nan=True)
    # A mesh made anew is another; states found on the same are the same to the solver's tolerance.
    assert areas(study) == pytest.approx(areas(folder), rel=0.2 if stage == "mesh" else 1e-4)


@pytest.mark.full_size
def test_a_registration_whose_process_is_killed_is_tried_once_more(done, tmp_path):
    """As the system does where memory runs out; Load1 is killed again, fails alone and is named, Load2 is not."""
    folder, *_ = done
    study = without_loads(folder, tmp_path / "study")
    command = [sys.executable, "-m", "mrstrain", "run", str(study), "--only", "register", "--workers", "1"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    records = study / "results" / ".study"
    killed: set[int] = set()

    def registering() -> list[psutil.Process]:
        with contextlib.suppress(psutil.NoSuchProcess):
            below = psutil.Process(process.pid).children(recursive=True)
            return [one for one in below if one.pid not in killed and any("popen_loky" in w for w in one.cmdline())]
        return []

    def kill(load: str) -> None:
        found = list[psutil.Process]()

        def at_work() -> bool:
            found[:] = registering()
            return found != [] and under_way(records, f"register {load}")

        wait_for(at_work, process)
        (one,) = found
        killed.add(one.pid)
        one.kill()

    for load in ("Load1", "Load2", "Load1"):
        kill(load)
    told, _ = process.communicate(timeout=400)
    assert process.returncode == 1
    assert "A second attempt, with no other stage running, failed too" in " ".join(told.split())
    assert "register Load1: FAILED" in told
    assert "register Load2: FAILED" not in told
    assert "died (exit code SIGKILL(-9))" in told
    log = (study / "results" / "study.log").read_text()
    assert "second attempt. The process" in log
    assert "died (exit code SIGKILL(-9))" in log
    assert not (study / "results" / "registration" / "Load1").exists()
    assert np.array_equal(shear_of(study, "Load2"), shear_of(folder, "Load2"), equal_nan=True)
    assert "register Load1: failed" in (study / "results" / "report.html").read_text()
    next_time = forecast(study, only=["register"])
    assert (next_time["register Load1"], next_time["register Load2"]) == ("will run", "up to date")


@pytest.mark.full_size
def test_a_cluster_whose_worker_is_killed_loses_nothing(done, tmp_path):
    folder, *_ = done
    study = without_loads(folder, tmp_path / "study")
    with cluster_of(2, tmp_path) as (address, workers):
        process = subprocess.Popen(
            [sys.executable, "-m", "mrstrain", "run", str(study), "--only", "register", "--scheduler", address],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        records = study / "results" / ".study"
        wait_for(lambda: all(under_way(records, f"register {load}") for load in ("Load1", "Load2")), process)
        workers[0].kill()  # each of the two has one
        workers[0].wait()
        assert not all((records / f"register {load}.json").exists() for load in ("Load1", "Load2"))
        assert process.wait(timeout=400) == 0  # what was not asked for is no failure
        for load in ("Load1", "Load2"):
            assert np.array_equal(shear_of(study, load), shear_of(folder, load), equal_nan=True)
        rest = run(study, scheduler=address)  # what builds on them, by the worker that is left
        assert rest.complete
        assert [name for name in STAGES if not rest.outcomes[name].reused] == ["compare"]
        assert areas(study) == pytest.approx(areas(folder), rel=1e-9)
        outcomes = (study / "results" / "study.log").read_text()
        assert "FAILED" not in outcomes


def test_check_tells_all_that_is_wrong_at_once(done, images, tmp_path):
    fine = check(images)
    assert fine.wrong == ()
    assert any(f"To do: {len(STAGES)} of {len(STAGES)} stages" in note for note in fine.notes)
    assert "All stages are up to date" in check(done[0]).notes[-1]
    assert check(done[0]).summary()[-1] == "No problems found."
    study = tmp_path / "study"
    shutil.copytree(images, study)
    shutil.copy(study / "Load0.nii.gz", study / "Load1.nii.gz")
    (study / "Load2.nii.gz").unlink()
    named = 'names = "tissues.csv"'
    change(study, (named, named + '\nbone = "heelbone"'), ('"akrami"', '"akramy"'))
    wrong = "\n".join(check(study).wrong)
    for words in ("Load1 is identical to the unloaded image", "Load2.nii.gz", "heelbone", "akramy"):
        assert words in wrong, words


def test_init_writes_a_study_that_can_be_checked(images, tmp_path):
    study = tmp_path / "study"
    shutil.copytree(images, study)
    with pytest.raises(OutputError, match="already"):
        init(study)
    (study / "study.toml").unlink()
    (study / "ansys").mkdir()
    (study / "ansys" / "Load1.vtu").write_text("")
    init(study)
    told = read_study(study)
    assert told.images.load0 == Path("Load0.nii.gz")
    assert told.images.repeat == Path("Load0-again.nii.gz")
    assert (told.images.labels, told.images.names) == (Path("tissues.nii.gz"), Path("tissues.csv"))
    assert list(told.loads) == ["Load1", "Load2"]
    assert told.loads["Load1"].normal_n is None  # forces are never guessed
    assert (told.models.results, told.models.sets) == (("ansys",), ())  # which need no forces
    assert not any("'normal_n'" in one for one in check(study).wrong)
    text = (study / "study.toml").read_text()
    (study / "study.toml").write_text(text.replace("# sets = ", "sets = "))
    told = read_study(study)
    assert any("'normal_n'" in one for one in check(study).wrong)
    assert len(told.models.sets) == 6
    assert "friedman" not in told.models.sets
