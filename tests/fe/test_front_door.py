"""`import fe`: every name that a person needs, and nothing heavy before it is asked for."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import fe

ROOT = Path(fe.__file__).parent.parent
HEAVY = ("vtkmodules", "pytetwild", "pypardiso", "numba", "matplotlib", "meshio")


def test_importing_it_loads_nothing_heavy() -> None:
    code = f"import sys, fe; print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_what_comes_with_a_name_is_not_the_mesher_and_not_a_solver_library() -> None:
    code = "import sys, fe; [getattr(fe, name) for name in fe.__all__]; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert {"numba", "meshio"} <= (loaded := set(done.stdout.split()))
    assert not loaded & {"vtkmodules", "vtk", "pytetwild", "pypardiso", "ngsolve"}


def test_every_name_is_listed_for_readers_and_for_the_importer_alike() -> None:
    assert sorted(name for names in fe._HOMES.values() for name in names.split()) == sorted(fe.__all__)
    with pytest.raises(AttributeError, match="no attribute 'simulat'"):
        fe.simulat  # noqa: B018


def imports(place: Path) -> list[tuple[str, str]]:
    """Names that a file takes from inside `fe`, with where from."""
    tree = ast.parse(place.read_text(encoding="utf-8"))
    return [
        (node.module, alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("fe.")
        for alias in node.names
    ]


@pytest.mark.parametrize("package", ["phantoms", "validate", "mrstrain", "benchmarks", "tests"])
def test_outside_nothing_goes_round_the_front_door(package: str) -> None:
    files = sorted((ROOT / package).rglob("*.py"))
    assert files
    around = [f"{f}: {home}.{name}" for f in files for home, name in imports(f) if name in fe.__all__]
    assert around == []
