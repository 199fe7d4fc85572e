"""Problems with one input changed: what changes and what stays, and solutions that start from another state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fe
from dvc.errors import InputError, MrstrainError
from dvc.mesh import TetMesh
from fe import variation
from tests.blocks import block

LOADS = (fe.LoadStep("Load2", 4.0), fe.LoadStep("Load3", 4.0, 2.0))
PLATE = fe.Plate((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))


def pad(count: int = 4) -> TetMesh:
    """Skin at x = 0 to 4 mm, fat up to 16 mm, and bone behind."""
    made = block((count, count, count), (16.0, 24.0, 24.0), layers=4)
    fat = np.concatenate([made.regions[f"layer {k}"] for k in (1, 2, 3)])
    facets = {"skin": made.facets["x0"], "bone": made.facets["x1"]}
    return TetMesh(made.points_mm, made.cells, {"skin": made.regions["layer 0"], "fat": fat}, facets)


def volume(mesh: TetMesh, region: str) -> float:
    return float(mesh.volumes_mm3[mesh.regions[region]].sum())


def test_a_force_is_larger_by_both_spreads_in_square_and_a_displacement_stays() -> None:
    load = variation.with_force(fe.LoadStep("a", 30.0, -40.0), 0.1, 3.0)
    assert load.normal_n == pytest.approx(30.0 + np.hypot(3.0, 3.0))
    assert load.shear_n == pytest.approx(-40.0 - 5.0)  # the other way round, it is larger too
    moved = fe.LoadStep("b", normal_mm=5.0, shear_n=0.0)
    assert variation.with_force(moved, 0.1, 3.0) == moved


def test_a_plate_tilts_along_its_shear_or_across_it() -> None:
    small = np.deg2rad(2.0)
    for along, axis in ((True, 1), (False, 2)):
        axes = variation.tilted(PLATE, 2.0, along=along).axes
        assert axes[:, 0] @ PLATE.axes[:, 0] == pytest.approx(np.cos(small))
        assert abs(axes[:, 0] @ PLATE.axes[:, axis]) == pytest.approx(np.sin(small))
        assert axes[:, 0] @ PLATE.axes[:, 3 - axis] == pytest.approx(0.0, abs=1e-12)
    assert variation.tilted(PLATE, 2.0, along=False).axes[:, 1] == pytest.approx(PLATE.axes[:, 1])


def test_one_parameter_changes_and_the_others_stay() -> None:
    laws, _ = fe.material_set("trebbi").for_regions(["skin", "fat", "muscle"])
    softer = variation.with_compressibility(laws, 0.5)
    stiffer = variation.with_stiffness(laws, "fat", 0.2)
    for region, law in laws.items():
        assert 0.5 - softer[region].nu == pytest.approx(1.5 * (0.5 - law.nu))
        assert softer[region].vector.tolist() == law.vector.tolist()
        factor = 1.2 if region == "fat" else 1.0
        stretch = np.array([0.7, 1.3])
        assert stiffer[region].nominal_stress(stretch) == pytest.approx(factor * law.nominal_stress(stretch))
    with pytest.raises(InputError, match="no region 'brawn', whose stiffness is uncertain"):
        variation.with_stiffness(laws, "brawn", 0.2)


def test_bone_or_skin_is_thicker_by_as_much_and_no_other_surface_moves() -> None:
    mesh, face = pad(), 24.0 * 24.0
    for (moved, share), thinner in (
        (variation.with_bone(mesh, 0.5), "bone"), (variation.with_tissue(mesh, "skin", 0.5), "skin")
    ):  # fmt: skip
        assert share == 1.0
        assert moved.cells.tolist() == mesh.cells.tolist()
        assert volume(moved, "fat") - volume(mesh, "fat") == pytest.approx(-0.5 * face, rel=1e-6)
        gained = 0.5 * face if thinner == "skin" else 0.0
        assert volume(moved, "skin") - volume(mesh, "skin") == pytest.approx(gained, abs=1e-6)
        sole = np.unique(mesh.facets["skin"])
        assert moved.points_mm[sole].tolist() == mesh.points_mm[sole].tolist()
    # cells of 4 mm cannot take it all, and not even a tenth of much more
    assert 0.1 < variation.with_bone(mesh, 12.0)[1] < 1.0
    with pytest.raises(MrstrainError, match="too flat to shift the interface by 200 mm"):
        variation.with_bone(mesh, 200.0)


def test_a_solution_from_the_state_of_another_is_that_from_the_start() -> None:
    mesh, options = pad(), fe.SolverOptions(1)
    laws, _ = fe.material_set("trebbi").for_regions(mesh.regions)
    (problem,) = fe.problems_of(mesh, laws, PLATE, LOADS)
    base = fe.solve(problem, options)
    states = {state.load.name: state.checkpoint for state in base if state.checkpoint is not None}
    changed = {
        "force": replace(problem, loads=[variation.with_force(load, 0.05) for load in LOADS]),
        "stiffness": replace(problem, materials=variation.with_stiffness(laws, "fat", 0.2)),
        "bone": replace(problem, mesh=variation.with_bone(mesh, 0.4)[0]),
    }
    for name, one in changed.items():
        whole = fe.solve(one, options)
        for quick, slow, before in zip(variation.from_base(one, states, options), whole, base, strict=True):
            assert quick.load == slow.load
            assert quick.reached == 1.0
            assert quick.strain.max_shear == pytest.approx(slow.strain.max_shear, abs=1e-5), name
            assert np.abs(quick.strain.max_shear - before.strain.max_shear).max() > 1e-3, name
            assert quick.force_n[:2] == pytest.approx([quick.load.normal_n, quick.load.shear_n or 0.0], abs=1e-3)
    assert [s.load.name for s in variation.from_base(problem, {"Load3": states["Load3"]}, options)] == ["Load3"]
