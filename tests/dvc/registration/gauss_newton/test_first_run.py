"""What is compiled beforehand on a machine where nothing is yet: everything that a fit needs, and only once."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from dvc.registration.gauss_newton import first_run
from dvc.registration.gauss_newton.engine import GaussNewton, GaussNewtonAtBone, GaussNewtonWithInterfaces

PREPARE = "import dvc; dvc.{}().prepare()"
FIT = """
import numpy as np
from numba.core import event
from dvc.deformation.protocol import RigidMotion, Within
from dvc.deformation.strain_maps import strain_maps
from dvc.images.image import Mask
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.fit import Parameters
from dvc.registration.gauss_newton.with_interfaces import fit_with_interfaces
from phantoms import heel_pair

heel = heel_pair(3, load=0.6, shape=(40, 44, 42), spacing_mm=2.5)  # phantoms have loops of their own
body = Mask(heel.reference.grid, heel.labels.labels > 0)
labels = {}
pair = AlignedPair.of(heel.reference, heel.loaded, heel.foot_motion, body, heel.bone, labels).cut()
with event.install_recorder("numba:compile") as compiled:
    found, _ = fit_with_interfaces(pair, Parameters())
    strain_maps(Within(found, pair.body), pair.body)
print(sorted({e.data["dispatcher"].py_func.__name__ for _, e in compiled.buffer}))
"""


@pytest.mark.full_size
@pytest.mark.parametrize(
    ("engine", "labels"), [("GaussNewtonWithInterfaces", "heel.labels"), ("GaussNewtonAtBone", "None")]
)
def test_a_fit_compiles_nothing_more(engine: str, labels: str, tmp_path) -> None:
    there = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    for script in (PREPARE.format(engine), FIT.replace("{}", labels, 1)):
        run = subprocess.run([sys.executable, "-c", script], env=there, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]", run.stdout


COMPILED = """
from numba.core import event
import dvc
with event.install_recorder("numba:compile") as compiled:
    dvc.{}().{}()
functions = [e.data["dispatcher"].py_func for _, e in compiled.buffer]
print(*(f.__module__ + "." + f.__name__ for f in functions if f.__module__.startswith("dvc.")))
"""


@pytest.mark.full_size
@pytest.mark.parametrize("engine", ["GaussNewtonWithInterfaces", "GaussNewtonAtBone", "GaussNewton"])
def test_two_processes_compile_different_loops(engine: str, tmp_path) -> None:
    there = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    beside, rest = (
        set(subprocess.run([sys.executable, "-c", script], env=there, capture_output=True, text=True, check=True)
            .stdout.split())
        for script in (COMPILED.format(engine, part) for part in ("prepare_beside", "prepare"))
    )  # fmt: skip
    fit, spline = "dvc.registration.gauss_newton", "dvc.deformation"
    assert {f"{fit}.image_term._carry", f"{fit}.image_term._normal", f"{spline}.strain._strain"} <= beside
    assert (f"{spline}.interface_spline._depths_at_voxels" in beside) == (engine != "GaussNewton")
    assert f"{fit}.sweeps.sweep" in rest - beside
    assert beside & rest <= {f"{spline}.bspline.summed_spline"}  # which takes arguments of another kind there


@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("engine", [GaussNewton(), GaussNewtonAtBone(), GaussNewtonWithInterfaces()])
def test_nothing_is_done_where_an_earlier_run_has_stored_its_loops(engine, beside, monkeypatch) -> None:
    fitted = []
    monkeypatch.setattr(first_run, "_tiny_pair", lambda: fitted.append("pair"))
    monkeypatch.setattr(first_run, "stored", lambda: True)
    prepare = engine.prepare_beside if beside else engine.prepare
    prepare()
    assert not fitted
    monkeypatch.setattr(first_run, "stored", lambda: False)
    with pytest.raises((AttributeError, TypeError)):  # there is no pair to fit
        prepare()
    assert fitted


def test_what_is_stored_is_seen(tmp_path) -> None:
    told = "from dvc.registration.gauss_newton.sweeps import stored; print(stored())"
    there = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    seen = [sys.executable, "-c", told]
    assert subprocess.run(seen, env=there, capture_output=True, text=True, check=True).stdout == "False\n"
