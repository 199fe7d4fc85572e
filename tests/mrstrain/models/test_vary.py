"""Further solutions of a material set: one for each uncertain input, on a coarser mesh, resumed, and found again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fe
from dvc.images.image import Grid, LabelMap
from dvc.mesh import TetMesh
from mrstrain.models.mesh import _coarser
from mrstrain.models.simulate import simulate
from mrstrain.models.variant_files import variant_folders
from mrstrain.models.vary import _boundaries, vary
from mrstrain.options import modelling as options
from mrstrain.options.uncertainty import Uncertainty
from tests.blocks import block
from tests.processes import tasks_run_here
from validate import read_result

LOADS = (fe.LoadStep("Load2", 4.0), fe.LoadStep("Load3", 4.0, 1.0))
NORMAL, SHEAR = (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0)


def pad(place: Path, layers: int) -> Path:
    """A block of fat on skin, with bone behind; x is the thickness, in so many layers of cells."""
    made = block((layers, 2 * layers, 2 * layers), (16.0, 32.0, 32.0), layers=4)
    fat = np.concatenate([made.regions[f"layer {k}"] for k in (1, 2, 3)])
    facets = {"skin": made.facets["x0"], "bone": made.facets["x1"]}
    mesh = TetMesh(made.points_mm, made.cells, {"fat": fat, "skin": made.regions["layer 0"]}, facets)
    fe.write_tet_mesh(place, mesh, {})
    return place


@pytest.fixture(autouse=True)
def _here(in_this_process) -> None:
    """Workers have tests of their own."""


@pytest.fixture(scope="module")
def given(tmp_path_factory) -> dict[str, object]:
    folder = tmp_path_factory.mktemp("vary")
    fine, coarse = pad(folder / "fine.vtu", 6), pad(folder / "coarse.vtu", 4)
    how = {"plate_normal": NORMAL, "shear_direction": SHEAR, "workers": 1, "threads": 1}
    with tasks_run_here():
        simulate(fine, out=folder / "models", sets=["trebbi"], loads=LOADS, **how)
    return {
        "mesh": fine, "coarse": coarse, "out": folder / "variants", "base": folder / "models" / "trebbi",
        "simulation": options.SimulationOptions(sets=("trebbi",)), "loads": LOADS, "towards": {},
        "plate_options": options.PlateOptions(plate_normal=NORMAL, shear_direction=SHEAR),
        "coordinates": options.MeshCoordinates(), "voxel_mm": 0.8,
    }  # fmt: skip


def test_larger_voxels_have_the_labels_of_the_same_place() -> None:
    grid = Grid((24, 20, 22), np.array([0.8, 0.8, 1.0]), np.array([3.0, -2.0, 7.0]))
    points = grid.points()
    middle = points.reshape(-1, 3).mean(axis=0)
    ball = LabelMap(grid, (np.linalg.norm(points - middle, axis=-1) < 6.0).astype(np.int64), {1: "fat"})
    made = _coarser(ball, 1.5)
    assert made.grid.spacing_mm == pytest.approx(1.5 * grid.spacing_mm)
    assert (made.grid.shape, made.names) == ((16, 13, 14), ball.names)
    before, after = (of.grid.points(of.labels == 1) for of in (ball, made))
    assert after.mean(axis=0) == pytest.approx(before.mean(axis=0), abs=0.2)
    assert len(after) * made.grid.voxel_volume_mm3 == pytest.approx(len(before) * grid.voxel_volume_mm3, rel=0.06)
    assert np.ptp(after, axis=0) == pytest.approx(np.ptp(before, axis=0), abs=1.5)


def spread(**inputs: object) -> Uncertainty:
    return Uncertainty.of(inputs)


def test_each_uncertain_input_has_a_solution_that_is_kept(given) -> None:
    uncertain = spread(
        mesh=1.4, force=0.05, direction_deg=1.0, tape=0.25, poisson=0.5, labels_voxels=0.5, stiffness={"fat": 0.2}
    )
    done = vary(**given, uncertainty=uncertain)
    assert done.complete, done.lines
    found = {one.record.input: one for one in variant_folders([given["out"]])}
    assert set(found) == {
        "mesh", "force", "direction-along", "direction-across", "tape", "poisson", "labels-bone", "labels-skin",
        "stiffness-fat",
    }  # fmt: skip
    # skin that slides everywhere is four standard uncertainties away; without tape there is no load with shear
    assert found["tape"].record.steps == 4.0
    assert sorted(file.name for file in found["tape"].place.glob("*.vtu")) == ["Load2.vtu"]
    # cells 1.5 times as long, an assumed order of 1, and a safety factor of 1.25 on the interval of k = 2
    assert found["mesh"].record.steps == pytest.approx(2.0 * (1.5 - 1.0) / 1.25)
    assert found["mesh"].base is None
    assert {one.base.resolve() for name, one in found.items() if name != "mesh"} == {found["mesh"].place.resolve()}
    # each changed solution carries its own load, and strains the pad otherwise
    for load, missing in (("Load2", set()), ("Load3", {"tape"})):
        shear = {
            n: read_result(n, one.place / f"{load}.vtu").deformation for n, one in found.items() if n not in missing
        }
        base = shear.pop("mesh")
        moved = {name: float(np.abs(of.u_mm - base.u_mm).max()) for name, of in shear.items()}
        assert 0.0 < min(moved.values()) < max(moved.values()) < 2.0, moved
    written = {name: (one.place / "Load2.vtu").stat().st_mtime_ns for name, one in found.items()}
    # only what changed is solved again, and what is exact by now is gone
    vary(**given, uncertainty=uncertain.model_copy(update={"poisson": 0.4, "direction_deg": 0.0}))
    left = {one.record.input for one in variant_folders([given["out"]])}
    assert left == {name for name in found if not name.startswith("direction")}
    again = {name: (found[name].place / "Load2.vtu").stat().st_mtime_ns for name in left}
    short = {"force", "poisson", "labels-bone", "labels-skin", "stiffness-fat"}
    assert {name for name in short if written[name] != again[name]} == {"poisson"}


def test_without_a_coarser_mesh_the_states_of_the_model_itself_are_used(given, tmp_path) -> None:
    alone = {**given, "coarse": None, "out": tmp_path / "variants"}
    done = vary(**alone, uncertainty=spread(mesh=1.4, force=0.05))
    (found,) = variant_folders([alone["out"]])
    assert done.complete, done.lines
    assert (found.record.input, found.record.steps, found.base) == ("force", 1.0, None)


def test_boundaries_move_as_far_as_their_probabilities_tell_but_the_largest_tissues(given, tmp_path) -> None:
    base = read_result("base", given["base"] / "Load2.vtu").deformation.mesh
    depth = {}
    for name, boundaries_mm in (("told", {"skin": 0.9, "fat": 2.0}), ("least", {"skin": 0.1})):
        alone = {**given, "coarse": None, "out": tmp_path / name, "boundaries_mm": boundaries_mm}
        assert vary(**alone, uncertainty=spread(labels_voxels=0.5)).complete
        found = {one.record.input: one for one in variant_folders([alone["out"]])}
        assert set(found) == {"labels-bone", "labels-skin"}  # fat is the largest, and meets skin alone
        meshes = {n: read_result(n, one.place / "Load2.vtu").deformation.mesh for n, one in found.items()}
        depth[name] = [float(np.abs(mesh.points_mm - base.points_mm).max()) for mesh in meshes.values()]
    # the bone by half a voxel of 0.8 mm, the skin by no less
    assert depth == {"told": pytest.approx([0.4, 0.9]), "least": pytest.approx([0.4, 0.4])}


def test_a_tissue_is_found_however_its_name_is_spelt(given) -> None:
    mesh = fe.read_tet_mesh(given["mesh"])
    spelt = TetMesh(mesh.points_mm, mesh.cells, {"Fat": mesh.regions["fat"], "Skin": mesh.regions["skin"]}, mesh.facets)
    moving = _boundaries(spelt, None, 0.4)
    assert [*moving] == ["bone", "skin"]
    moved, share = moving["skin"](spelt)
    assert share == 1.0
    assert np.abs(moved.points_mm - mesh.points_mm).max() == pytest.approx(0.4)


@pytest.mark.parametrize(
    ("loads", "plate"),
    [(LOADS[1:], {}), (LOADS, {"taped": False}), (LOADS[:1], {"turns": True})],
)
def test_tape_is_not_given_where_it_cannot_be(given, tmp_path, loads, plate) -> None:
    changed = given["plate_options"].model_copy(update=plate)
    none = {**given, "coarse": None, "out": tmp_path, "plate_options": changed, "base": tmp_path}
    sliding = [replace(load, shear_n=None) for load in loads] if plate == {"taped": False} else loads
    done = vary(**{**none, "loads": sliding}, uncertainty=spread(tape=0.25))
    assert any(line.startswith("tape: not given. It needs a load without shear") for line in done.lines), done.lines
    assert not list(tmp_path.glob("tape"))
