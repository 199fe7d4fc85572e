"""The program as a person first meets it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

import mrstrain
from dvc import preset_names
from dvc.errors import InputError
from mrstrain.cli.app import app
from mrstrain.cli.options import EXAMPLES
from mrstrain.models.simulate import LOADS
from mrstrain.options.modelling import ComparisonOptions, Directions
from validate import read_thresholds

COMMANDS = typer.main.get_command(app).commands
HELP = {name: CliRunner().invoke(app, [name, "--help"], terminal_width=100).output for name in COMMANDS}


def test_without_arguments_it_greets_with_three_commands_and_not_with_the_whole_help() -> None:
    ran = CliRunner().invoke(app, [])
    assert ran.exit_code == 0
    assert re.findall(r"^  mrstrain (\w+)", ran.output, re.MULTILINE) == ["demo", "init", "register"]
    assert "mrstrain --help" in ran.output
    assert len(ran.output.splitlines()) < 10
    assert "converge" in CliRunner().invoke(app, ["--help"]).output


def test_a_command_does_not_greet_and_one_that_there_is_not_is_refused() -> None:
    assert CliRunner().invoke(app, ["--version"]).output.startswith("mrstrain 0")
    assert "mrstrain demo" not in CliRunner().invoke(app, ["fit", "--help"]).output
    assert CliRunner().invoke(app, ["registr"]).exit_code == 2


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["Load0.nii.gz"], "Missing argument 'loads'. Loaded images."),
        (
            ["Load0.nii.gz", "Load1.nii.gz"],
            "Missing option '--out'. Folder for the results and log.txt; created if",
        ),
    ],
)
def test_what_is_missing_is_told_with_what_it_is(given: list[str], told: str) -> None:
    ran = CliRunner().invoke(app, ["register", *given])
    assert ran.exit_code == 2
    assert told in ran.output


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["a", "b", "--out", ""], "The value of --out is empty."),
        (["a", "b", "--out="], "The value of --out is empty."),
        (["a", "", "--out", "c"], "An argument is empty."),
    ],
)
def test_an_empty_value_is_refused(given: list[str], told: str) -> None:
    """It was taken for the current folder, in which results replaced folders of their names."""
    ran = CliRunner().invoke(app, ["register", *given])
    assert ran.exit_code == 2
    assert f"{told} If you gave a shell variable, it may not be set." in ran.output


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("--bending 3,5", "'3,5' is not a number. Use a decimal point, not a comma: 3.5."),
        ("--bending 3mm", "'3mm' is not a number."),
        ("--threads two", "'two' is not a whole number."),
        ("--plate-normal 0,0,-1", "Type three numbers with spaces: --plate-normal 0 0 -1."),
        ("--plate-normal=0,0,-1", "Type three numbers with spaces: --plate-normal 0 0 -1."),
        ("--plate-normal 0,0,-1 --align none", "Type three numbers with spaces: --plate-normal 0 0 -1."),
        ("--plate-normal 0 0 -1,5", "'-1,5' is not a number. Use a decimal point, not a comma: -1.5."),
        ("--plate-normal 0 1", "Option '--plate-normal' requires 3 arguments."),
        ("--align bones", "'bones'"),
    ],
)
def test_a_number_that_is_none_is_quoted_with_the_form_that_is_expected(given: str, told: str) -> None:
    ran = CliRunner().invoke(app, ["register", "Load0.nii.gz", "Load1.nii.gz", "--out", "out", *given.split()])
    assert ran.exit_code == 2
    assert told in " ".join(ran.output.split())


@pytest.mark.parametrize(
    ("given", "missing"),
    [
        ("label nowhere.nii.gz --bone here --out t.nii.gz", "nowhere.nii.gz"),
        ("register here here nowhere.nii.gz --align none --out r", "nowhere.nii.gz"),
        ("register here here --bone nowhere.nii.gz --out r", "nowhere.nii.gz"),
        ("register here here --labels auto --bone here/nowhere.nii.gz --out r", "here/nowhere.nii.gz"),
        ("strain here nowhere.txt --out s", "nowhere.txt"),
        ("twin nowhere.nii.gz here --out t", "nowhere.nii.gz"),
        ("mesh nowhere.nii.gz --edge-mm 2 --out m.vtu", "nowhere.nii.gz"),
        ("simulate nowhere.vtu --out s", "nowhere.vtu"),
        ("compare here nowhere --out c", "nowhere"),
    ],
)
def test_a_file_that_is_not_there_is_refused_before_anything_takes_time(given: str, missing: str, tmp_path) -> None:
    (tmp_path / "here").touch()
    why = ", since there is no folder 'here'" * ("/" in missing)
    main = "import sys; from mrstrain.cli.app import app\ntry: app()\nfinally: print(*sys.modules)"
    ran = subprocess.run(
        [sys.executable, "-c", main, *given.split()], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert f"InputError: {missing}: no such file or folder{why}. Check the path." in ran.stderr
    assert not {"nibabel", "dvc.worker", "psutil"} & {*ran.stdout.split()}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["here"]


@pytest.mark.parametrize("typed", ["autp", "Auto", "aut0"])
def test_a_word_close_to_auto_is_taken_for_it_where_there_is_no_such_file(typed: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    images = [tmp_path / "Load0.nii.gz", tmp_path / "Load1.nii.gz"]
    for path in images:
        path.touch()
    given = [*map(str, images), "--bone", str(images[0]), "--labels", typed, "--out", "out"]
    told = str(CliRunner().invoke(app, ["register", *given]).exception)
    assert told == f"{typed}: no such file or folder. Did you mean auto? Check the spelling."
    with pytest.raises(InputError, match="Did you mean auto"):
        mrstrain.register(*images[:1], images[1:], labels=typed, bone=images[0], out="out")
    strained = str(CliRunner().invoke(app, ["strain", *given[:4], "--labels", typed, "--out", "out"]).exception)
    assert strained == f"{typed}: no such file or folder. Check the path."
    (tmp_path / typed).touch()
    assert "Did you mean" not in str(CliRunner().invoke(app, ["register", *given]).exception)


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - {"doctor"}))  # which takes nothing
def test_each_help_ends_with_an_example_that_can_be_pasted(name: str) -> None:
    program, command, *given = HELP[name].splitlines()[-1].split()
    assert (program, command) == ("mrstrain", name)
    COMMANDS[name].make_context(name, given)  # refuses what it does not know


def test_an_example_with_an_option_that_is_not_there_is_found() -> None:
    with pytest.raises(Exception, match="--bones"):
        COMMANDS["register"].make_context("register", ["Load0.nii.gz", "Load1.nii.gz", "--bones", "calcaneus.nii.gz"])
    assert set(EXAMPLES) == set(COMMANDS) - {"doctor"}


def test_the_list_of_commands_ends_no_sentence_early() -> None:
    listed = CliRunner().invoke(app, ["--help"]).output.partition("Commands:")[2]
    assert "..." not in listed
    assert listed.count(".\n") >= len(COMMANDS)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_a_help_says_each_default_once_and_kinds_in_plain_words(name: str) -> None:
    told = " ".join(HELP[name].split())
    for option in re.split(r" (?=--[a-z])", told):
        assert option.count("Default: ") + option.count("[default: ") <= 1, option
    assert not re.search(r"<list|range>|<str|<int|<float|>\.\.\.", told)


def test_the_page_on_register_lists_every_option_and_no_other() -> None:
    page = (Path(__file__).parents[3] / "docs" / "reference" / "register.md").read_text(encoding="utf-8")
    listed = [name for cell in re.findall(r"^\| (`--.*?) \| ", page, re.MULTILINE) for name in cell.split(", ")]
    offered = [name for one in COMMANDS["register"].params for name in (*one.opts, *one.secondary_opts)]
    names = [name.strip("`").split(" ")[0] for name in listed]
    assert sorted(names) == sorted(name for name in offered if name.startswith("--"))


def test_defaults_in_the_words_of_a_help_are_those_that_are_used() -> None:
    told = {name: " ".join(text.split()) for name, text in HELP.items()}
    loads = [f"{load.name}={load.normal_n:g}" + (f",{load.shear_n:g}" if load.shear_n else "") for load in LOADS]
    assert f"Default: the published loads {', '.join(loads[:-1])} and {loads[-1]}." in told["simulate"]
    levels = [f"{one.max_shear:g}" for one in read_thresholds()]
    assert f"Default: {', '.join(levels[:-1])} and {levels[-1]}." in told["compare"]
    assert "Default: {:g} {:g}.".format(*ComparisonOptions().strains) in told["compare"]
    for vector in (Directions().plate_normal, Directions().shear_direction):
        assert "Default: {:g} {:g} {:g} (".format(*vector) in told["simulate"]
    assert f"Built-in elastix parameters: {', '.join(preset_names())}." in told["register"]


def test_only_register_offers_to_make_the_label_map() -> None:
    assert [name for name, text in HELP.items() if "or auto to make it" in " ".join(text.split())] == ["register"]
    assert "--labels <path> Label map of the tissues on the unloaded image. --names" in " ".join(HELP["strain"].split())


@pytest.mark.parametrize("name", [name for name, text in HELP.items() if "--plate-normal" in text])
def test_directions_are_explained_where_they_are_asked_for(name: str) -> None:
    told = " ".join(HELP[name].split())
    assert "Direction from the body to the plate, in LPS (x left, y posterior, z superior)." in told
    assert told.count("x left") == 1


def test_a_simulation_says_nothing_of_elastix() -> None:
    assert "elastix" not in HELP["simulate"]
    assert "elastix reproduces" in " ".join(HELP["register"].split())


def test_settings_for_other_programs_do_not_stop_a_command(tmp_path: Path) -> None:
    """With each of these, numba or matplotlib could not be imported, which ended in a traceback."""
    (tmp_path / "curve.csv").write_text("stretch,nominal_stress_kpa\n1,0\n1.1,1\n1.2,2.2\n1.3,3.6\n1.4,5.4\n")
    given = ["curve.csv", "--law", "neo-Hooke", "--test", "uniaxial", "--out", "a"]
    ran = subprocess.run(
        [sys.executable, "-m", "mrstrain", "fit", *given],
        env=os.environ | {"NUMBA_NUM_THREADS": "0", "MPLBACKEND": "nonsense"},
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=100,
    )  # fmt: skip
    assert (ran.returncode, ran.stderr) == (0, "")
    assert (tmp_path / "a" / "fit.png").exists()


def test_only_what_was_typed_counts_as_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen = list[set[str]]()
    monkeypatch.chdir(tmp_path)
    for name in ("dvc", "model"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(
        "mrstrain.cli.models.carry_out", lambda *_, reading, **__: seen.append(reading.model_fields_set)
    )
    for typed in ([], ["--model-unit", "mm"]):
        assert CliRunner().invoke(app, ["compare", "dvc", "model", "--out", "out", *typed]).exit_code == 0
    assert seen == [set(), {"model_unit"}]
