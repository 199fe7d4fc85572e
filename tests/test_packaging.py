"""The wheel holds what it should, and the command line starts at once."""

from __future__ import annotations

import subprocess
import sys
import tomllib
import zipfile
from importlib import import_module
from pathlib import Path

import pytest

import mrstrain

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {"dvc", "fe", "phantoms", "validate", "mrstrain"}


@pytest.fixture(scope="module")
def project() -> dict[str, object]:
    table: dict[str, object] = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    return table


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """Names of the files in a wheel built from this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("mrstrain-*.whl")
    return set(zipfile.ZipFile(path).namelist())


def test_the_wheel_holds_the_five_packages_and_nothing_else(wheel: set[str]) -> None:
    assert {name.split("/")[0] for name in wheel if ".dist-info/" not in name} == PACKAGES


def test_the_wheel_holds_every_file_of_the_packages_data_files_too(wheel: set[str]) -> None:
    files = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert files - wheel == set()
    assert {name for name in wheel if ".dist-info/" not in name} - files == set()
    assert any(not name.endswith(".py") for name in files), "no preset or template was found to look for"


def test_the_doctests_of_every_package_are_run(wheel: set[str]) -> None:
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
    assert {name.split("/")[0] for name in wheel if ".dist-info/" not in name} <= set(options["testpaths"])
    assert "--doctest-modules" in options["addopts"].split()


def test_importing_the_command_does_not_run_it() -> None:
    assert callable(import_module("mrstrain.__main__").main)


def test_the_wheel_carries_the_licence_and_the_command(wheel: set[str], project: dict[str, object]) -> None:
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in wheel)
    assert project["scripts"] == {"mrstrain": "mrstrain.__main__:main"}


def test_the_version_is_the_same_everywhere(project: dict[str, object]) -> None:
    assert mrstrain.__version__ == project["version"]
    citation = (ROOT / "CITATION.cff").read_text().splitlines()
    assert f"version: {project['version']}" in citation


def test_the_lock_names_every_dependency_with_hashes_and_no_address(project: dict[str, object]) -> None:
    lock = (ROOT / "requirements.lock").read_text()
    assert "://" not in lock
    assert "index" not in lock.replace("lazy-loader", "")
    pinned = [line for line in lock.splitlines() if line and line[0] not in " #"]
    assert all("==" in line and line.endswith("\\") for line in pinned)
    names = {line.split("==")[0] for line in pinned}
    dependencies = project["dependencies"]
    assert isinstance(dependencies, list)
    for dependency in dependencies:
        name = dependency.split(">")[0].split("[")[0].strip().lower()
        assert name in names, f"{name} is not in requirements.lock; run: make lock"


def test_the_command_line_starts_without_the_heavy_libraries() -> None:
    code = (
        "import sys, mrstrain.cli.app\n"
        "heavy = 'itk', 'SimpleITK', 'matplotlib', 'numba', 'scipy', 'skimage'\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_registration_loads_nothing_of_the_labelling() -> None:
    """It brings scipy.stats and skimage.restoration, which take as long as a fifth of all its imports."""
    code = "import sys, mrstrain.measurement.register; print('scipy.stats' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_help_comes_in_under_a_second() -> None:
    """Of processor time, since other programs take theirs from the clock."""
    code = (
        "import atexit, sys, time\n"
        "atexit.register(lambda: print(time.process_time(), file=sys.stderr))\n"
        "sys.argv = ['mrstrain', '--help']\n"
        "from mrstrain.__main__ import main\n"
        "main()"
    )
    command = [sys.executable, "-c", code]
    times = []
    for _ in range(3):  # the first may compile
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        times.append(float(done.stderr.splitlines()[-1]))
        assert "register" in done.stdout
    assert min(times) < 1.0
