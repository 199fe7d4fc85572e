"""A name that becomes a file stays in the folder of results, on every system, wherever it comes from."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

import dvc
import fe
from dvc.errors import InputError
from dvc.file_names import as_file_name, as_typed, clash, missing, refuse_missing
from mrstrain import register
from mrstrain.comparison.model_files import model_files
from mrstrain.models.simulate import material_sets
from mrstrain.options.modelling import ModelReading
from mrstrain.records.inputs import case_names
from mrstrain.studies.file import read_study
from mrstrain.studies.plan import plan
from validate.tables import RECORD, remove_earlier

OUTSIDE = ("../x", "..", ".", "a/b", "/x", "C:x", "a\\b", "\\\\host\\x", "~/x/", "x\0y", "x\ny", "x\x1b[2J", "x\u202ey")
ODD = ("", " x", "x ", "x.", ".x", "CON", "nul.txt", "Com1", "lpt³", "a" * 201, "<script>", "ü" * 101)


@pytest.mark.parametrize("name", [*OUTSIDE, *ODD])
def test_it_is_refused_wherever_it_is_given(tmp_path: Path, name: str) -> None:
    with pytest.raises(ValueError, match=r"used as a folder name|too long for a folder name|reserved on Windows"):
        as_file_name(name)
    with pytest.raises(InputError, match="The name of the load"):
        fe.LoadStep(name, normal_n=1.0)
    (tmp_path / "mine.toml").write_text(fe.as_toml(name, "", {"fat": fe.NeoHooke.of(mu_mpa=0.01, nu=0.49)}))
    with pytest.raises(InputError, match=r"mine\.toml: The name of the material set"):
        fe.read_material_sets(tmp_path / "mine.toml")


@pytest.mark.parametrize("path", ["new heel/Load0.nii.gz", "it's/$HOME", "a;b", "plain/Load0.nii.gz", ""])
def test_a_shell_reads_a_path_as_one_word(monkeypatch, path: str) -> None:
    typed = dict[str, str]()
    for system in ("posix", "nt"):
        with monkeypatch.context() as there:
            there.setattr(os, "name", system)
            typed[system] = as_typed(path)
    assert shlex.split(typed["posix"]) == [path]
    assert typed["nt"] == (f'"{path}"' if " " in path or not path else path)


@pytest.mark.parametrize("name", ["Load1", "Load 1, repeat", "Füße", "kräftig=140", "console", "com", "a.b", "a" * 200])
def test_all_others_are_names(name: str) -> None:
    assert as_file_name(name) == name
    assert fe.LoadStep(name, normal_n=1.0).name == name


@pytest.mark.parametrize(("file", "what"), [("..nii.gz", "folder"), ("con.nii.gz", "Windows"), ("a\nb.nii", "folder")])
def test_an_image_whose_name_is_none_is_named(file: str, what: str) -> None:
    with pytest.raises(InputError, match=what) as told:
        case_names([Path("in") / file])
    assert str(told.value).startswith(str(Path("in") / file))


@pytest.mark.parametrize("name", ["../x", "/tmp/x", "CON", r"x\u0000y"])
def test_a_load_of_a_study_file_is_named_with_its_line(tmp_path: Path, name: str) -> None:
    text = f'[study]\nname = "a"\n[images]\nload0 = "a.nii"\nlabels = "b.nii"\n[loads."{name}"]\nimage = "c.nii"\n'
    (tmp_path / "study.toml").write_text(text)
    with pytest.raises(InputError, match=r"used as a folder name|too long for a folder name|reserved on Windows"):
        read_study(tmp_path)


@pytest.mark.timeout(60)
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
@pytest.mark.parametrize(
    "read", [dvc.read_image, dvc.read_mesh, dvc.read_displacement, read_study, fe.read_material_sets, fe.read_curves]
)
def test_a_pipe_or_device_is_refused_before_it_is_read(tmp_path: Path, read: Callable[[Path], object]) -> None:
    """A command waited for a pipe that nobody writes to, without a word and without end."""
    os.mkfifo(tmp_path / "a.nii.gz")
    (tmp_path / "link.nii.gz").symlink_to("a.nii.gz")
    for path in (tmp_path / "a.nii.gz", tmp_path / "link.nii.gz", Path("/dev/zero")):
        with pytest.raises(InputError, match=rf"^{path}: a pipe or device"):
            read(path)


def test_a_comparison_removes_no_folder_that_its_record_names_elsewhere(tmp_path: Path) -> None:
    for place in ("others/work", "out/Load1"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "fields.vtu").touch()
    record = tmp_path / "out" / RECORD
    for load in ("../others/work", str(tmp_path / "others" / "work")):
        record.write_text(f'{{"coverage_ml": {{"{load}": 1.0}}}}')
        remove_earlier(tmp_path / "out", [])
        assert (tmp_path / "others" / "work" / "fields.vtu").exists()
    record.write_text('{"coverage_ml": {"Load1": 1.0}}')
    remove_earlier(tmp_path / "out", [])
    assert not (tmp_path / "out" / "Load1").exists()


@pytest.mark.parametrize(("one", "other"), [("Load1", "load1"), ("Straße", "STRASSE"), ("Füße", "Fu\u0308ße")])
def test_names_that_a_file_system_takes_for_one_are_refused_wherever_they_are_given(
    tmp_path: Path, one: str, other: str
) -> None:
    """Some file systems ignore case, or how an accent is stored: there, the second overwrites the first."""
    assert clash([one, other, "x"]) == f"'{one}' and '{other}' (case is ignored)"
    assert clash([one, "x"]) == ""
    assert clash([one, "x", one]) == f"'{one}'"
    both = re.escape(f"'{one}' and '{other}'")
    with pytest.raises(InputError, match=both):
        fe.paths_of([fe.LoadStep(one, normal_n=1.0), fe.LoadStep(other, normal_n=2.0)])
    with pytest.raises(InputError, match=both):
        case_names([Path("in") / f"{one}.nii.gz", Path("again") / f"{other}.nrrd"])
    with pytest.raises(InputError, match=rf"study\.toml: two loads .* {both}"):
        read_study(_study(tmp_path, loads=(one, other)))
    files = [tmp_path / f"{number}.toml" for number in range(2)]
    for file, name in zip(files, (one, other), strict=True):
        file.write_text(fe.as_toml(name, "", {"fat": fe.NeoHooke.of(mu_mpa=0.01, nu=0.49)}), encoding="utf-8")
    with pytest.raises(InputError, match=both):
        material_sets([str(file) for file in files])
    names = [file.name for file in files]
    with pytest.raises(InputError, match=rf"two material sets .* {both}"):
        plan(read_study(_study(tmp_path, sets=names)))
    for place in (one, f"again/{other}"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "Load1.vtu").touch()
    with pytest.raises(InputError, match=rf"[Tt]wo models .* {both}"):
        model_files(["Load1"], [tmp_path / one, tmp_path / "again" / other], ModelReading())
    with pytest.raises(InputError, match=rf"another model are named {both}"):
        plan(read_study(_study(tmp_path, results=[one, f"again/{other}"])))
    with pytest.raises(InputError, match=rf"another model are named {both}"):
        plan(read_study(_study(tmp_path, sets=names[:1], results=[f"again/{other}"])))


def test_a_load_is_not_called_as_the_repeat_scan_is(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="'repeat' is reserved for the repeat scan"):
        read_study(_study(tmp_path, loads=("Repeat",)))
    with pytest.raises(InputError, match="'repeat', which is reserved for the repeat scan"):
        register("a.nii", ["REPEAT.nii"], out=tmp_path / "out", repeat="b.nii", align="image")
    assert not (tmp_path / "out").exists()


def _study(
    folder: Path, loads: Sequence[str] = ("Load1",), sets: Sequence[str] = (), results: Sequence[str] = ()
) -> Path:
    text = '[study]\nname = "a"\n[images]\nload0 = "a.nii"\nlabels = "b.nii"\n'
    text += "".join(f'[loads."{name}"]\nimage = "{at}.nii"\nnormal_n = 1.0\n' for at, name in enumerate(loads))
    (folder / "study.toml").write_text(f"{text}[models]\nsets = {[*sets]}\nresults = {[*results]}\n", encoding="utf-8")
    return folder


def test_a_missing_file_is_told_with_the_one_that_was_meant(tmp_path: Path) -> None:
    for name in ("Load2.nii.gz", "tissues.nii.gz", "Load0.nii.gz"):
        (tmp_path / name).touch()
    typed = "tisues.nii.gz", "load0.nii.gz", "Load0.nii", "Load1.nii.gz", "bone.nii.gz", "a/b/Load0.nii.gz"
    told = {name: missing(tmp_path / name, "file").partition(": ")[2] for name in typed}
    assert told == {
        "tisues.nii.gz": "no such file. Did you mean 'tissues.nii.gz', which is there?",
        "load0.nii.gz": "no such file. Did you mean 'Load0.nii.gz', which is there?",
        "Load0.nii": "no such file. Did you mean 'Load0.nii.gz', which is there?",
        "Load1.nii.gz": "no such file. Check the path.",  # Load2 is another load
        "bone.nii.gz": "no such file. Check the path.",
        "a/b/Load0.nii.gz": f"no such file, since there is no folder '{tmp_path / 'a'}'. Check the path.",
    }
    with pytest.raises(InputError, match=r"Did you mean 'tissues\.nii\.gz'"):
        refuse_missing(tmp_path / "tisues.nii.gz")
