"""Results are sent to other processes and copied: what a front door gives survives pickle and deepcopy."""

import copy
import pickle
from collections.abc import Callable
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

import dvc
import fe
import validate
from tests.fe.test_simulate import dome
from tests.textures import everything, pair_of
from tests.validate.test_comparison import case, cube, error_table, labels, sheared

COPIES = [lambda one: pickle.loads(pickle.dumps(one)), copy.deepcopy]


@pytest.fixture(scope="module")
def simulation() -> fe.Simulation:
    plate = fe.Plate((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    law = fe.NeoHooke.of(0.02, nu=0.49)
    mesh = dome((2, 3, 3))
    return fe.simulate(mesh, dict.fromkeys(mesh.regions, law), plate, [fe.LoadStep("Load1", 0.5)])


@pytest.mark.parametrize("copied", COPIES, ids=["pickle", "deepcopy"])
def test_a_simulation_and_what_it_is_made_of(copied: Callable[[Any], Any], simulation: fe.Simulation) -> None:
    again = copied(simulation)
    assert str(again) == str(simulation)
    assert list(again.mesh.regions) == list(simulation.mesh.regions)
    published = copied(fe.material_set("trebbi"))
    assert published.materials.keys() == fe.material_set("trebbi").materials.keys()


@pytest.mark.parametrize("copied", COPIES, ids=["pickle", "deepcopy"])
def test_a_comparison_and_its_loads(copied: Callable[[Any], Any]) -> None:
    mesh = cube(4)
    model = validate.FeResult.of("a", dvc_on(mesh, 0.6))
    made = validate.compare([case("Load1", sheared(0.8), [model], error_table(0.05, 0.01))], labels(), bones=["bone"])
    again = copied(made)
    assert again.summary() == made.summary()
    assert again.loads[0].case.read()[1][0].name == "a"


@pytest.mark.usefixtures("in_this_process")
def test_a_measurement_with_its_images() -> None:
    settings = dvc.Settings(dvc.GaussNewton(5.0, bending=3.0, volume=300.0), align_on="none")
    images = pair_of(dvc.Affine(np.eye(3), np.array([1.3, -0.6, 0.7])), 0.05)
    made = dvc.measure(*images, tissue=everything(), settings=settings)
    assert made.source is not None
    for again in (copied(made) for copied in COPIES):
        np.testing.assert_array_equal(again.max_shear, made.max_shear)
        np.testing.assert_equal(asdict(again.source.images.similarity), asdict(made.source.images.similarity))


def dvc_on(mesh: dvc.TetMesh, gamma: float) -> Any:
    from dvc.deformation.nodal import OnMesh

    return OnMesh(mesh, sheared(gamma).displacement(mesh.points_mm))


def test_what_a_measurement_knows_goes_into_the_comparison() -> None:
    grid = labels().grid
    tissue = labels().labels > 0
    subject = dvc.Subject(dvc.Image(grid, tissue.astype(np.float32)), tissue=dvc.Mask(grid, tissue), labels=labels())
    measured = dvc.Measurement.from_deformation(sheared(0.8), subject)
    model = validate.FeResult.of("a", dvc_on(cube(4), 0.8))
    one = validate.LoadCase.of("Load1", measured, [model])
    assert one.verdict == measured.verdict
    assert one.aligned_on == "none"
    pressed = replace(subject, axes=dvc.plate_axes(subject.plate_normal, (0.0, -1.0, 0.0)))  # the plate is below
    known = validate.LoadCase.of("Load1", dvc.Measurement.from_deformation(sheared(0.8), pressed), [model])
    np.testing.assert_array_equal(known.axes, one.axes)  # by default, the force presses upward
    area = next(a for a in validate.compare([one], labels(), bones=["bone"]).areas if a.model == "a")
    assert area.ml == pytest.approx(0.0, abs=1e-6)
