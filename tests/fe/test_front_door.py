"""`import fe`: every name that a person needs, and nothing heavy before it is asked for."""

import subprocess
import sys
from pathlib import Path

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
