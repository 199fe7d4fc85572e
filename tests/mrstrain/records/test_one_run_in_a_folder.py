"""Two runs at once do not write to one place: the second is refused, and what is there stays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from filelock import FileLock

import mrstrain
from dvc.errors import OutputError, RegistrationError
from fe import LoadStep
from mrstrain.measurement.register import register
from mrstrain.records.inputs import alone
from tests.golden.scenes import GIVEN
from tests.phantoms.test_error_tables import CASE, samples
from tests.processes import ended_process

LOAD0, LOAD1, PAD, LABELS = (GIVEN / name for name in ("Load0.nii.gz", "Load1.nii.gz", "pad.inp", "tissues.nii.gz"))
NAMED = {"labels": LABELS, "names": GIVEN / "tissues.csv"}
SUBJECT = {**NAMED, "bone_label": "bone"}
OWN, SET, MODEL = str(GIVEN / "materials.toml"), "two-laws", "two-laws-driven"
TOUCHING = LoadStep("Load1", 2.0)


LOCK = ".mrstrain-lock"
COMMANDS: dict[str, tuple[str, Callable[[Path, Path], Any]]] = {
    # command: (what it holds below its output folder, the command with what was made and that folder)
    "register": (LOCK, lambda _, out: mrstrain.register(LOAD0, [LOAD1], out=out, **SUBJECT)),
    "strain": (LOCK, lambda made, out: mrstrain.strain(LOAD0, made / "Load1.tfm", out=out, **SUBJECT)),
    "twin": (LOCK, lambda made, out: mrstrain.twin(LOAD0, made / "Load1.tfm", out=out, **SUBJECT)),
    "phantom": (LOCK, lambda _, out: mrstrain.phantom(out, seed=3, spacing_mm=4.0, loads=["Load1"])),
    "accuracy": (LOCK, lambda _, out: mrstrain.accuracy(cases=[CASE], workers=1, out=out)),
    "label": (
        ".l.nii.gz.lock",
        lambda made, out: mrstrain.label(LOAD0, out=out / "l.nii.gz", bone=made / "bone.nii.gz"),
    ),
    "mesh": (".m.vtu.lock", lambda _, out: mrstrain.mesh(out=out / "m.vtu", edge_mm=9.0, **NAMED)),
    "simulate": (f"{SET}/{LOCK}", lambda _, out: mrstrain.simulate(PAD, out=out, sets=[OWN], loads=[TOUCHING])),
    "converge": (LOCK, lambda _, out: mrstrain.converge(edges_mm=[9.0, 8.0, 7.0], out=out, region="fat", **NAMED)),
    "fit": (LOCK, lambda made, out: mrstrain.fit(made / "curve.csv", "neo-Hooke", out=out)),
    "compare": (LOCK, lambda made, out: mrstrain.compare(made / "strain", [made / MODEL], out=out, **NAMED)),
    "drive": (f"{MODEL}/{LOCK}", lambda made, out: mrstrain.drive(PAD, made / "strain", out=out, sets=[OWN])),
    "level": (
        f"{MODEL}-levelled-work/.Load1.lock",
        lambda made, out: mrstrain.level(LOAD0, made / MODEL, out=out, **SUBJECT),
    ),
    "run": ("results/.study/lock", lambda _, out: mrstrain.run(study_in(out))),
    "cohort": (LOCK, lambda _, out: mrstrain.cohort([study_in(out)], out=out)),
}


def study_in(folder: Path) -> Path:
    """A study file in a folder, with the golden images."""
    text = (GIVEN / "study.toml").read_text()
    for name in ("Load0.nii.gz", "Load0-again.nii.gz", "Load1.nii.gz", "tissues.nii.gz", "tissues.csv", "pad.inp"):
        text = text.replace(f'"{name}"', f'"{(GIVEN / name).as_posix()}"')
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("command", COMMANDS)
def test_a_second_run_is_refused_and_writes_nothing(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.setattr("mrstrain.truth.accuracy.measure_run", lambda case, *_: samples(case))
    held, second = COMMANDS[command]
    (tmp_path / held).parent.mkdir(parents=True, exist_ok=True)
    with FileLock(tmp_path / held), pytest.raises(OutputError, match=r"another run writes to it\. Wait until"):
        second(made, tmp_path)
    written = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    assert written <= {held, "study.toml"}


@pytest.mark.parametrize("lock", [LOCK, ".study/lock"])
def test_what_a_killed_run_had_begun_to_write_goes_with_the_next(tmp_path: Path, lock: str) -> None:
    places = [tmp_path, (tmp_path / lock).parent]
    (tmp_path / lock).parent.mkdir(exist_ok=True)
    for place in places:
        (place / f".{ended_process()}.partial.report.html").write_text("half")
    with alone(tmp_path, tmp_path / lock):
        assert not [*tmp_path.rglob("*.partial.*")]


def test_the_sets_of_a_study_are_driven_side_by_side(made: Path, tmp_path: Path) -> None:
    (tmp_path / "akrami-driven").mkdir()
    with FileLock(tmp_path / "akrami-driven" / ".mrstrain-lock"):
        assert COMMANDS["drive"][1](made, tmp_path).complete
    assert not [*tmp_path.rglob("two-laws-driven/.*")]
    written = {path.relative_to(tmp_path).parts[0] for path in tmp_path.rglob("*") if path.is_file()}
    assert written <= {MODEL, "akrami-driven"}, "a file in a folder that another run does not know to be held"
    conditions = {path.name for path in (tmp_path / MODEL / "boundary").iterdir()}
    assert conditions == {"Load1.inp", "Load1.mac", "Load1.feb"}


def test_the_loads_of_a_model_are_levelled_side_by_side(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def came_so_far(*_: object, **__: object) -> None:
        raise RegistrationError("nothing is registered here")

    monkeypatch.setattr(register, "with_options", came_so_far)
    (tmp_path / f"{MODEL}-levelled-work").mkdir()
    with (
        FileLock(tmp_path / f"{MODEL}-levelled-work" / ".Load2.lock"),
        pytest.raises(RegistrationError, match="nothing is"),
    ):
        COMMANDS["level"][1](made, tmp_path)
