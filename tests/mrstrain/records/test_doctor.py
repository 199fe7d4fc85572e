"""The doctor: what it finds, and that foreign packages of our names are refused at once."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import namedtuple
from functools import partial
from importlib import import_module
from importlib.metadata import requires
from pathlib import Path
from types import SimpleNamespace

import pytest

from dvc.errors import MrstrainError
from dvc.registration import self_test
from fe import meshing
from mrstrain.records import doctor
from mrstrain.records.doctor import Finding, examine

ROOT = Path(doctor.__file__).resolve().parents[2]


def by_name(findings: list[Finding]) -> dict[str, Finding]:
    return {finding.what: finding for finding in findings}


def refusal(path: list[Path]) -> str:
    """Tell what a fresh interpreter with these folders first on its path says; empty where all is well."""
    code = (
        f"import sys; sys.path[:0] = {[str(p) for p in path]!r}\n"
        "from mrstrain.records.doctor import refuse_foreign_packages\n"
        "try:\n    refuse_foreign_packages()\nexcept ImportError as error:\n    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=path[-1])
    return done.stdout.strip()


def install(folder: Path, name: str, package: str, version: str = "3.1", *, recorded: bool = True) -> Path:
    """A distribution that brings one package, as pip leaves it."""
    (folder / package).mkdir(parents=True)
    (folder / package / "__init__.py").write_text("")
    info = folder / f"{name}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    if recorded:
        (info / "RECORD").write_text(f"{package}/__init__.py,,\n{info.name}/METADATA,,\n")
    return folder


def test_nothing_is_refused_where_only_mrstrain_is_installed() -> None:
    assert refusal([ROOT]) == ""


@pytest.mark.parametrize(
    ("name", "package", "title"),
    [
        ("dvc", "dvc", "Data Version Control"),
        ("configobj", "validate", "ConfigObj"),
        ("validate", "validate", "3.1"),
    ],
)
@pytest.mark.parametrize("first", ["ours", "theirs"])
@pytest.mark.parametrize("recorded", [True, False])
def test_a_rival_of_our_names_is_refused_wherever_it_lies(
    tmp_path: Path, name: str, package: str, title: str, first: str, recorded: bool
) -> None:
    theirs = install(tmp_path, name, package, recorded=recorded)
    said = refusal([ROOT, theirs] if first == "ours" else [theirs, ROOT])
    assert f"The distribution {name}" in said
    assert title in said
    assert f"package {package!r} has the same name as one of mrstrain" in said
    assert "environment of its own" in said
    assert "found in" not in said  # once is enough


def told_by(path: list[Path], code: str) -> str:
    """The last line of a fresh interpreter's error with these folders first on its path; empty where there is none."""
    code = f"import sys; sys.path[:0] = {[str(p) for p in path]!r}\n{code}"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=path[-1])
    assert bool(done.returncode) == bool(done.stderr)
    return done.stderr.strip().rpartition("\n")[2]


USES = ["import dvc", "from dvc import read_image", "from dvc.errors import InputError", "import fe; fe.LoadStep"]
COMMANDS = ["import mrstrain; mrstrain.register", "from mrstrain import compare"]


@pytest.mark.parametrize("code", [*USES, *COMMANDS])
def test_data_version_control_is_refused_when_a_package_is_imported(tmp_path: Path, code: str) -> None:
    path = [ROOT, install(tmp_path, "dvc", "dvc", "3.55.2")]
    said = told_by(path, code)
    assert "ImportError" in said or "ForeignPackageError" in said
    assert "Data Version Control" in said
    assert "3.55.2 is installed in" in said
    assert said.endswith("environment of its own: python -m venv mrstrain-env, and install it there.")


def test_nothing_is_refused_when_only_ours_is_imported() -> None:
    assert told_by([ROOT], "\n".join([*USES, *COMMANDS])) == ""


@pytest.mark.parametrize("code", COMMANDS)
def test_data_version_control_is_refused_where_theirs_is_imported(tmp_path: Path, code: str) -> None:
    said = told_by([install(tmp_path, "dvc", "dvc"), ROOT], code)
    assert "Data Version Control" in said


@pytest.mark.parametrize("given", [(), ("doctor",), ("register", "a.nii"), ("--help",)])
@pytest.mark.parametrize("first", ["ours", "theirs"])
def test_the_command_refuses_data_version_control_in_a_sentence(
    tmp_path: Path, given: tuple[str, ...], first: str
) -> None:
    path = [ROOT, install(tmp_path, "dvc", "dvc")]
    path = path if first == "ours" else path[::-1]
    code = f"import sys; sys.path[:0] = {[str(p) for p in path]!r}; from mrstrain.__main__ import main; main()"
    command = [sys.executable, "-P", "-c", code, *given]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("mrstrain: The distribution dvc (Data Version Control) 3.1 is installed")
    assert "environment of its own" in " ".join(done.stderr.split())
    assert len(done.stderr.splitlines()) <= 3


def test_any_other_package_that_shadows_ours_is_refused(tmp_path: Path) -> None:
    (tmp_path / "phantoms.py").write_text("")
    said = refusal([tmp_path, ROOT])
    assert "The package 'phantoms' should be in" in said
    assert "phantoms.py" in said


def test_a_distribution_of_a_rivals_name_without_our_package_is_let_be(tmp_path: Path) -> None:
    assert refusal([ROOT, install(tmp_path, "configobj", "configobj")]) == ""


def test_the_check_takes_a_moment_and_loads_none_of_our_packages() -> None:
    code = (
        f"import sys, time; sys.path.insert(0, {str(ROOT)!r})\n"
        "from mrstrain.records.doctor import refuse_foreign_packages\n"
        "start = time.process_time(); refuse_foreign_packages(); print(time.process_time() - start)\n"
        "print([n for n in ('dvc', 'fe', 'validate', 'phantoms', 'numpy', 'itk') if n in sys.modules])\n"
    )
    command = [sys.executable, "-c", code]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(3)]
    assert min(float(run.split("\n")[0]) for run in runs) < 0.05
    assert runs[0].split("\n")[1] == "[]"


def test_the_doctor_looks_at_everything_and_finds_this_environment_fit(tmp_path: Path) -> None:
    found = examine(tmp_path / "not" / "yet", trials={"itk-elastix": lambda: "a pair of 16^3 voxels in 0.4 s"})
    findings = by_name(found)
    assert {"Python", "package names", "itk-elastix", "numpy", "memory", "disk"} <= set(findings)
    assert findings["trial of itk-elastix"].detail == "a pair of 16^3 voxels in 0.4 s"
    for name in ("Python", "package names", "itk-elastix", "temporary folder", "trial of itk-elastix"):
        assert findings[name].ok, findings[name]
    assert not any(name.startswith("trial") for name in by_name(examine(tmp_path)))
    needed = {re.split("[<>=;]", one)[0] for one in requires("mrstrain") if ";" not in one}  # without markers
    assert {name.casefold() for name in findings} >= {name.casefold() for name in needed}


slow = partial(pytest.param, marks=pytest.mark.full_size)
# Loading elastix takes 8 s. The set-up before the tests has done the other, and one below lets it fail.
_SLOW = slow("dvc.registration.elastix.run"), slow("dvc.registration.self_test")


@pytest.mark.parametrize("module", [*_SLOW, "fe.meshing", "fe.linear"])
def test_what_it_tries_works_here(module: str) -> None:
    assert import_module(module).self_test()


@pytest.mark.usefixtures("in_this_process")
def test_a_registration_that_finds_another_shift_fails_its_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = self_test.register
    monkeypatch.setattr(self_test, "register", lambda fixed, moving, **given: whole(moving, fixed, **given))
    (told,) = (one for one in examine(trials={"registration": self_test.self_test}) if one.what.startswith("trial"))
    assert not told.ok
    assert "a shift of 0.5 mm was measured as -0.5" in told.detail


def test_a_busy_machine_is_slow_and_not_at_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside other programs, a mesh of seconds took more than a minute."""
    now = [1000.0]

    def meshed(_labels: object, _edge_mm: float, *, limit_s: float) -> tuple[None, SimpleNamespace]:
        now[0] += 100.0
        if limit_s < 100.0:
            raise MrstrainError("Meshing was stopped at its time limit.")
        return None, SimpleNamespace(cells=812)

    monkeypatch.setattr(doctor, "monotonic", lambda: now[0])
    monkeypatch.setattr(meshing, "mesh_labels", meshed)
    quick = "pardiso solved 60 equations"
    findings = by_name(examine(trials={"pytetwild": meshing.self_test, "sparse solver": lambda: quick}))
    slow = "meshed a ball with 812 cells; it took 100 s, which is slow: other programs may keep the machine busy"
    assert findings["trial of pytetwild"] == Finding("trial of pytetwild", True, slow)
    assert findings["trial of sparse solver"].detail == quick


def test_a_failed_registration_is_a_finding_and_not_an_exception(tmp_path: Path) -> None:
    def crash() -> str:
        raise RuntimeError("the worker was killed by signal 11")

    finding = by_name(examine(tmp_path, trials={"itk-elastix": crash}))["trial of itk-elastix"]
    assert not finding.ok
    assert "RuntimeError: the worker was killed by signal 11" in finding.detail
    assert finding.advice


def test_what_is_missing_or_short_is_found_with_advice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    versions = {"itk-elastix": "0.23.0"}
    real = doctor.importlib.metadata.version

    def version(name: str) -> str:
        if name == "numba":
            raise doctor.importlib.metadata.PackageNotFoundError(name)
        return versions.get(name) or real(name)

    def read_only() -> None:
        raise OSError("read-only")

    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(doctor.importlib.metadata, "version", version)
    monkeypatch.setattr(doctor.shutil, "disk_usage", lambda _: usage(10, 9, 1))
    monkeypatch.setattr(doctor, "usable_memory_bytes", lambda: 4 * 1024**3)
    monkeypatch.setattr(doctor.sys, "version_info", (3, 10, 2, "final", 0))
    monkeypatch.setattr(doctor.tempfile, "TemporaryFile", read_only)
    findings = by_name(examine(tmp_path))
    for name, detail, advice in [
        ("numba", "not installed", "pip install numba"),
        ("itk-elastix", "0.23.0", "0.25."),
        ("disk", "0.0 GiB free", "Free disk space"),
        ("memory", "4.0 GiB", "Crop the images"),
        ("Python", "Python 3", "3.11 or newer"),
        ("temporary folder", "read-only", "TMPDIR"),
    ]:
        assert not findings[name].ok
        assert detail in findings[name].detail
        assert advice in findings[name].advice
