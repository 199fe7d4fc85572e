"""A command keeps a log beside its results: all in full, with tracebacks, and no name of a patient."""

from __future__ import annotations

import logging
import re
import warnings
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import mrstrain
from dvc.errors import InputError, RegistrationError, few
from dvc.worker import Worker
from mrstrain.cli.app import app, main
from mrstrain.cli.lines import say
from mrstrain.cli.options import EXAMPLES
from mrstrain.records.inputs import make_output, output_folder
from mrstrain.records.log import logged
from mrstrain.records.progress import NOTE, live
from tests.mrstrain.records.test_nothing_left import LOAD0, LOAD1, bone
from tests.planted import NAME, NUMBER, PLACE, PLANTED

COMMANDS = typer.main.get_command(app).commands
LOGGED = sorted(name for name, one in COMMANDS.items() if any(p.name == "out" for p in one.params) and name != "demo")
STRETCH = "stretch,nominal_stress_kpa\n1.0,0.0\n1.1,1.0\n1.2,2.1\n1.3,3.4\n1.4,5.1\n"


def test_these_commands_have_a_log() -> None:
    assert set(COMMANDS) - {*LOGGED} == {"init", "check", "run", "demo", "doctor"}  # studies have their own


@pytest.mark.parametrize("name", LOGGED)
def test_every_command_that_writes_results_has_a_log_beside_them(name, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    command = COMMANDS[name]
    typed = EXAMPLES[name].splitlines()[-1].split()[2:]
    context = command.make_context(name, list(typed))
    out, one_file = Path(context.params["out"]), name in ("label", "mesh")

    def carried_out(**_: object) -> None:
        make_output(out.parent if one_file else out)
        say("what was found")

    monkeypatch.setattr(command, "callback", carried_out)
    command.invoke(context)
    place = {"label": "tissues.log", "mesh": "heel.log"}.get(name, f"{out}/log.txt")
    told = (tmp_path / place).read_text().splitlines()
    assert all(re.match(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ ", line) for line in told)
    said = [line.partition(" ")[2] for line in told]
    assert (
        said[0] == f"mrstrain {mrstrain.__version__}: mrstrain {name} {' '.join(word.split('/')[-1] for word in typed)}"
    )
    assert said[1] == "what was found"
    assert re.fullmatch(r"Finished after \d+\.\d s", said[2])


def test_a_log_holds_notes_stages_warnings_and_whole_lists_once(tmp_path, capsys) -> None:
    with logged(tmp_path / "out", ["mrstrain", "compare"]) as log, live() as progress:
        progress(NOTE, "a note", 0.0)
        assert not log.place.parent.exists()  # nothing has begun
        make_output(tmp_path / "out")
        for fraction in (0.0, 0.4, 1.0, 1.0):
            progress("Load1", "aligning", fraction)
        logging.getLogger("dvc.images").warning("a warning")
        logging.getLogger("another").info("of no interest")
        with warnings.catch_warnings():
            warnings.simplefilter("always")
            warnings.warn("of Python", stacklevel=1)
        assert few("abcdefgh", most=2) == "a, b and 6 more"
        few("ab")
    said = [line.partition(" ")[2] for line in log.place.read_text().splitlines()]
    assert said[1:5] == ["a note", "Load1: aligning", "Load1: aligning (ended after 0.0 s)", "a warning"]
    assert any("UserWarning: of Python" in line for line in said)
    assert "In full: a, b, c, d, e, f, g, h" in said
    assert not [line for line in said if "of no interest" in line or line == "In full: a, b"]
    logging.getLogger("dvc").info("later")
    assert "later" not in log.place.read_text()


def test_a_log_names_no_patient_and_no_folder(tmp_path, monkeypatch) -> None:
    folder = tmp_path / PLACE / NAME
    folder.mkdir(parents=True)
    (folder / "curve.csv").write_text(STRETCH)
    monkeypatch.chdir(folder.parent)
    given = ["fit", f"{NAME}/curve.csv", "--law", "neo-Hooke", "--test", "uniaxial"]
    for out in (folder / "absolute", Path(NAME) / "relative"):
        done = CliRunner().invoke(app, [*given, "--out", str(out)], catch_exceptions=False)
        assert done.exit_code == 0, done.output
        told = (out / "log.txt").read_text()
        assert f"mrstrain fit curve.csv --law neo-Hooke --test uniaxial --out {out.name}" in told
        assert f"Results: {out.name}" in told
        assert not [word for word in PLANTED if word in told]


@pytest.mark.parametrize("ending", ["", ".dcm", ".IMA"])
def test_the_folder_of_a_dicom_series_is_not_named(ending, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / NAME).mkdir()
    (tmp_path / NAME / f"IM001{ending}").write_text("")
    with logged(tmp_path / "out", ["mrstrain", "register", NAME, "b.nii", "--out", "out"]):
        make_output(tmp_path / "out")
        logging.getLogger("dvc").info("%s/IM001: of another series; //server/%s/a.nii", NAME, NAME)
        logging.getLogger("dvc").info("file:///mnt/%s/a.nii", NAME)
    told = (tmp_path / "out" / "log.txt").read_text()
    assert NAME not in told
    assert "mrstrain register 'a folder' b.nii --out out" in told
    assert " IM001: of another series; a.nii" in told


def test_a_record_that_cannot_be_written_stops_nothing(tmp_path, capsys) -> None:
    """As a library may log one with too few arguments."""
    with logged(tmp_path / "out", ["mrstrain", "register"]) as log:
        make_output(tmp_path / "out")
        log.handle(logging.makeLogRecord({"msg": "%d of", "args": ("a",)}))
        logging.getLogger("dvc").warning("the next")
    assert "the next" in (tmp_path / "out" / "log.txt").read_text()
    assert "Logging error" in capsys.readouterr().err


def test_an_error_in_a_log_names_no_folder(tmp_path) -> None:
    folder, home = tmp_path / PLACE / NAME, Path.home()

    def command() -> None:
        with logged(tmp_path / "out", ["mrstrain", "register", f"{folder}/a.nii"]):
            make_output(tmp_path / "out")
            others = f"/mnt/{NUMBER}/b.nii, {home}/c.nii and {home}/{NUMBER}/d.nii"
            raise RegistrationError(f"{folder}: no. {folder}/a.nii and {others} differ by 3 mm/s: https://a.b/c.html")

    with pytest.raises(RegistrationError):
        command()
    told = (tmp_path / "out" / "log.txt").read_text()
    assert "a folder: no. a.nii and b.nii, ~/c.nii and d.nii differ by 3 mm/s: https://a.b/c.html" in told
    assert not [word for word in PLANTED if word in told]
    assert str(Path(mrstrain.__file__).parents[1]) not in told
    assert 'File "' in told


def fails(out: Path) -> None:
    with logged(out, ["mrstrain", "mesh"]):
        make_output(out)
        with Worker(1) as worker:
            worker.run("reading a number", int, "no number")


def test_an_error_of_a_worker_stands_in_the_log_with_its_traceback(tmp_path) -> None:
    with pytest.raises(ValueError, match="no number") as failed:
        fails(tmp_path / "out")
    told = (tmp_path / "out" / "log.txt").read_text()
    assert told.count("ValueError: invalid literal for int()") == 2  # there and here
    assert "_RemoteTraceback" in told
    assert "process_executor.py" in told
    assert "in fails" in told
    assert failed.value.__notes__ == [f"Log: {tmp_path / 'out' / 'log.txt'}"]


def test_a_failed_command_says_last_where_its_log_is(tmp_path, monkeypatch, capsys) -> None:
    def command() -> None:
        with logged(tmp_path / "out", ["mrstrain", "register"]):
            make_output(tmp_path / "out")
            raise RegistrationError("It diverged. Check the images.")

    monkeypatch.setattr("mrstrain.cli.app.app", command)
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "mrstrain: It diverged. Check the images."
    assert "".join(lines[1:]).replace(" ", "") == f"Log:{tmp_path / 'out' / 'log.txt'}"


def test_results_that_are_not_complete_are_followed_by_where_the_log_is(tmp_path, monkeypatch) -> None:
    class Done:
        complete = False

        def summary(self) -> list[str]:
            make_output(tmp_path / "out")
            return ["Load1: ONLY 40 % of the load was reached"]

    monkeypatch.setattr(mrstrain, "simulate", type("", (), {"with_options": lambda *_, **__: Done()}))
    (tmp_path / "heel.vtu").touch()
    ran = CliRunner().invoke(
        app, ["simulate", str(tmp_path / "heel.vtu"), "--set", "trebbi", "--out", str(tmp_path / "out")]
    )
    assert ran.exit_code == 1
    assert ran.output.split("Log:")[1].strip() == str(tmp_path / "out" / "log.txt")
    assert "ONLY 40 % of the load" in (tmp_path / "out" / "log.txt").read_text()


@pytest.mark.usefixtures("in_this_process")
def test_each_load_that_fails_stands_in_the_log_with_its_traceback(tmp_path, monkeypatch) -> None:
    def diverges(*_: object, **__: object) -> None:
        raise RegistrationError("it diverged")

    monkeypatch.setattr("mrstrain.measurement.plan.dvc.register", diverges)
    mask = bone(tmp_path, voxels=30)
    ran = CliRunner().invoke(app, ["register", str(LOAD0), str(LOAD1), "--bone", str(mask), "--out", f"{tmp_path}/out"])
    assert isinstance(ran.exception, RegistrationError)
    told = (tmp_path / "out" / "log.txt").read_text()
    assert re.search(r"Load1 failed\n\S+ Traceback", told)
    assert "in diverges" in told


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("before", [True, False])
def test_a_refusal_leaves_neither_folder_nor_log(before, tmp_path) -> None:
    """Before anything is computed, or in the first seconds of it."""
    out, mask = tmp_path / "new" / "out", bone(tmp_path, voxels=1)
    more = ["--labels", "no.nii.gz"] if before else []
    ran = CliRunner().invoke(app, ["register", str(LOAD0), str(LOAD1), "--bone", str(mask), "--out", str(out), *more])
    assert ran.exit_code != 0
    assert not (tmp_path / "new").exists()
    assert not hasattr(ran.exception, "__notes__")


@pytest.mark.parametrize("error", [InputError("no"), KeyboardInterrupt(), SystemExit(143)])
def test_what_is_refused_or_interrupted_keeps_a_log_only_beside_results(error, tmp_path) -> None:
    def command(out: Path, results: str = "") -> None:
        with logged(out, ["mrstrain", "phantom"]), output_folder(out):
            if results:
                (out / results).write_text("1")
            raise error

    with pytest.raises(type(error)):
        command(tmp_path / "of" / "mine")
    assert not [*tmp_path.iterdir()]
    with pytest.raises(type(error)):
        command(tmp_path, "curve.csv")
    assert {path.name for path in tmp_path.iterdir()} == {"curve.csv", "log.txt"}
    ended = "Failed" if isinstance(error, Exception) else "Interrupted"
    assert f"Z {ended} after 0.0 s" in (tmp_path / "log.txt").read_text()


def test_a_later_command_in_the_same_folder_appends_to_the_log(tmp_path) -> None:
    for name in ("simulate", "drive"):
        with logged(tmp_path, ["mrstrain", name]):
            make_output(tmp_path)
    with pytest.raises(InputError), logged(tmp_path, ["mrstrain", "level"]):
        raise InputError("no")  # before anything
    commands = re.findall(r"mrstrain [\d.]+: mrstrain (\w+)", (tmp_path / "log.txt").read_text())
    assert commands == ["simulate", "drive"]


def test_a_file_has_a_log_of_its_name_and_a_refused_one_none(tmp_path) -> None:
    for name, stem in (("tissues.nii.gz", "tissues"), ("heel.1.vtu", "heel.1")):
        out = tmp_path / name
        with pytest.raises(InputError), logged(out, ["mrstrain", "label"], one_file=True), output_folder(tmp_path):
            raise InputError("no")
        assert not [*tmp_path.iterdir()]
        with logged(out, ["mrstrain", "label"], one_file=True), output_folder(tmp_path):
            out.write_text("1")
        assert {path.name for path in tmp_path.iterdir()} == {name, f"{stem}.log"}
        for path in tmp_path.iterdir():
            path.unlink()
