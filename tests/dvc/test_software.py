"""What is kept is made anew when the software that it depends on is another; tried on a copy of our packages."""

from __future__ import annotations

import ast
import shutil
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType

import pytest

import dvc.arrays
import dvc.deformation.bspline
import dvc.deformation.strain
import dvc.images.bias_field
import dvc.images.noise
import dvc.images.tissue
import dvc.mesh
import dvc.registration.engines
import dvc.registration.register
import dvc.software
import fe.assembly
import phantoms.mri
from dvc.software import distribution_versions, software_key
from fe import Problem
from fe.simulation_files import fingerprint
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.plan import Stage
from mrstrain.truth.accuracy import _finished, _key
from tests.fe.test_restart import LOADS, PLATE
from tests.fe.test_simulate import LAWS, dome
from tests.mrstrain.truth.test_accuracy import CASE, samples

OURS = ("dvc", "fe", "phantoms", "validate", "mrstrain")


def place(package: str) -> Path:
    return Path(find_spec(package).submodule_search_locations[0])


def read_anew() -> None:
    dvc.software._package.cache_clear()
    software_key.cache_clear()


@pytest.fixture
def copy(tmp_path, monkeypatch):
    """A copy of our packages, of which keys are made in place of the installed ones."""
    for package in OURS:
        shutil.copytree(place(package), tmp_path / "copy" / package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(dvc.software, "_folder", lambda package: tmp_path / "copy" / package)
    read_anew()
    yield tmp_path / "copy"
    read_anew()


def change(copy: Path, module: ModuleType) -> None:
    file = copy / Path(module.__file__).relative_to(place(module.__name__.split(".")[0]).parent)
    file.write_bytes(file.read_bytes() + b"\n# changed\n")
    read_anew()


def restart_key() -> str:
    return fingerprint(Problem(dome((3, 4, 4)), LAWS, PLATE, LOADS), LOADS[-1])


MEASURING = [
    dvc.deformation.bspline,
    dvc.images.tissue,
    dvc.deformation.strain,
    dvc.images.noise,
    dvc.registration.register,
    dvc.images.bias_field,
    dvc.registration.engines,
]


@pytest.mark.parametrize("preset", ["gauss-newton", "heel-mr"])
@pytest.mark.parametrize("module", [*MEASURING, phantoms.mri], ids=lambda module: module.__name__)
def test_a_run_of_an_accuracy_study_is_stale_after_a_change_of_what_made_it(copy, tmp_path, preset, module):
    case = replace(CASE, preset=preset)
    samples(case).write(tmp_path / "run.npz", _key(case))
    assert list(_finished(tmp_path)) == [case.name]
    change(copy, fe.assembly)  # phantoms are made and registered without it
    assert list(_finished(tmp_path)) == [case.name]
    change(copy, module)
    assert list(_finished(tmp_path)) == []


@pytest.mark.parametrize("module", [fe.assembly, dvc.mesh, dvc.arrays], ids=lambda module: module.__name__)
def test_a_simulation_does_not_go_on_from_a_state_that_other_code_made(copy, module):
    known = restart_key()
    change(copy, phantoms.mri)
    assert restart_key() == known
    change(copy, module)
    assert restart_key() != known


@pytest.mark.parametrize("package", OURS)
def test_a_stage_of_a_study_depends_on_all_packages(copy, tmp_path, package):
    stage = Stage("mesh", {}, files=(), gives=())
    key = lambda: Ledger(tmp_path, tmp_path).key(stage, {}, {})  # noqa: E731
    known = key()
    (copy / package / "new.py").touch()
    read_anew()
    assert key() != known


def test_files_count_by_place_and_content_in_any_folder_data_too(copy):
    keys = [software_key("dvc")]

    def differs() -> bool:
        read_anew()
        keys.append(software_key("dvc"))
        return len(set(keys)) == len(keys)

    renamed = (copy / "dvc" / "deformation" / "bspline.py").rename(copy / "dvc" / "spline.py")
    assert differs()
    (copy / "dvc" / "a" / "b").mkdir(parents=True)
    moved = renamed.rename(copy / "dvc" / "a" / "b" / "spline.py")
    assert differs()
    moved.write_bytes(moved.read_bytes().replace(b"=", b" = ", 1))
    assert differs()
    data = next((copy / "dvc").rglob("*.txt"))
    data.write_bytes(data.read_bytes()[:-1])
    assert differs()
    one, other = copy / "dvc" / "x1.py", copy / "dvc" / "x2.py"
    for contents in ((b"a", b"b"), (b"b", b"a"), (b"ax2.py", b"")):
        one.write_bytes(contents[0])
        other.write_bytes(contents[1])
        assert differs()
    moved.unlink()
    assert differs()


def test_what_python_and_editors_leave_does_not_count(copy):
    known = software_key("dvc")
    for name in ("__pycache__/mesh.cpython-311.pyc", "templates/.report.html.j2.swp", ".cache/kernel.nbi"):
        (copy / "dvc" / name).parent.mkdir(exist_ok=True)
        (copy / "dvc" / name).write_bytes(b"x")
    read_anew()
    assert software_key("dvc") == known


@pytest.mark.parametrize("library", ["numpy", "scipy", "numba", "itk-elastix", "pytetwild"])
def test_a_librarys_version_counts_everywhere(monkeypatch, library):
    known = {package: software_key(package) for package in OURS}
    told = distribution_versions() | {library: "0.0"}
    monkeypatch.setattr(dvc.software, "distribution_versions", lambda: told)
    read_anew()
    for package, key in known.items():
        assert set(software_key(package).split(", ")) - set(key.split(", ")) == {f"{library} 0.0"}
    read_anew()


@pytest.mark.parametrize("package", OURS)
def test_a_key_covers_every_package_that_is_imported(package):
    """Also within functions; `ast` sees them all."""
    imported = set()
    for file in place(package).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.Import):
                imported |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and not node.level:
                imported.add(node.module.split(".")[0])
    assert imported & set(OURS) - {package} == dvc.software._package(package)[1] - {package}


def test_a_package_that_is_missing_is_named():
    with pytest.raises(ModuleNotFoundError, match="its package 'nothing' is missing"):
        software_key("nothing")
