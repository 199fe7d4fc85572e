"""A model driven by the measured displacement of its outside: exact where the answer is known, written for others."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from typer.testing import CliRunner

from dvc.deformation.nodal import OnMesh
from dvc.deformation.protocol import Affine
from dvc.errors import InputError
from dvc.io.result_folder import write_displacement
from dvc.mesh import TetMesh, outer_faces
from fe import NeoHooke, Ogden, write_tet_mesh
from mrstrain.cli.app import app
from tests.blocks import block
from tests.validate.test_comparison import labels
from validate import boundary_displacement, read_result, simulate_driven, write_boundary_conditions

SIDE = 20.0
# Isochoric, and at rest where x = 0: simple shear of y and z along x
SHEAR = Affine(np.array([[1.0, 0.0, 0.0], [0.3, 1.0, 0.0], [-0.1, 0.0, 1.0]]), np.zeros(3))


def slab(n: int = 6) -> TetMesh:
    """Fat (x < 10) and skin; bone at x = 0."""
    made = block((n, n, n), (SIDE, SIDE, SIDE), layers=2, wobble=0.15)
    tissues = {"fat": made.regions["layer 0"], "skin": made.regions["layer 1"]}
    return TetMesh(made.points_mm, made.cells, tissues, {"bone": made.facets["x0"], "skin": made.facets["x1"]})


def test_one_law_follows_a_homogeneous_deformation_exactly() -> None:
    mesh = slab()
    fat = Ogden.from_ansys(0.0034, 6.2)
    state = simulate_driven(mesh, {"fat": fat, "skin": fat}, SHEAR, "Load1")
    assert state.reached == 1.0
    assert np.abs(state.u_mm - SHEAR.displacement(mesh.points_mm)).max() < 1e-3
    assert np.abs(state.gradients - (SHEAR.matrix - np.eye(3))).max() < 2e-3


def test_a_stiff_layer_strains_less_than_a_soft_one() -> None:
    mesh = slab()
    laws = {"fat": NeoHooke.of(0.005), "skin": NeoHooke.of(0.25)}
    state = simulate_driven(mesh, laws, SHEAR, "Load1")
    inner = ((mesh.centroids_mm > 5.0) & (mesh.centroids_mm < 15.0))[:, 1:].all(axis=1)
    shear = np.abs(state.gradients[:, 1, 0])
    near = np.abs(mesh.centroids_mm[:, 0] - 10.0) < 5.0
    in_fat, in_skin = (np.isin(np.arange(len(mesh.cells)), mesh.regions[name]) for name in ("fat", "skin"))
    assert shear[inner & near & in_fat].mean() > 1.2 * shear[inner & near & in_skin].mean()
    nodes, u = boundary_displacement(mesh, SHEAR)
    assert np.abs(state.u_mm[nodes] - u).max() < 1e-12


def test_the_outside_is_where_it_was_measured_and_bone_stays() -> None:
    mesh = slab(10)
    moved = Affine(SHEAR.matrix, np.array([0.5, 0.0, 0.0]))
    inner = TetMesh(mesh.points_mm, mesh.cells[(np.abs(mesh.centroids_mm - 10.0) < 9.0).all(axis=1)])
    measured = OnMesh(inner, moved.displacement(inner.points_mm))  # its rim is not measured
    nodes, u = boundary_displacement(mesh, measured)
    assert np.array_equal(nodes, np.unique(outer_faces(mesh.cells)))
    bone = np.isin(nodes, mesh.facets["bone"])
    assert (u[bone] == 0.0).all()
    assert np.abs(u[~bone] - moved.displacement(mesh.points_mm[nodes])[~bone]).max() < 1.5  # of the nearest that is
    corner = TetMesh(mesh.points_mm, mesh.cells[:60])
    with pytest.raises(InputError, match="does not cover the model"):
        boundary_displacement(mesh, OnMesh(corner, np.zeros_like(corner.points_mm)))


def test_boundary_conditions_say_the_same_in_every_code(tmp_path: Path) -> None:
    mesh = slab()
    numbered = TetMesh(mesh.points_mm, mesh.cells, node_ids=np.arange(len(mesh.points_mm)) + 1001)
    nodes, u = boundary_displacement(numbered, SHEAR)
    abaqus, ansys, febio = write_boundary_conditions(tmp_path / "Load1", numbered, nodes, u)
    rows = [line.split(",") for line in abaqus.read_text().splitlines() if line[0].isdigit()]
    of_abaqus = {(int(n), int(a)): float(v) for n, a, _, v in rows}
    axis = {"UX": 1, "UY": 2, "UZ": 3}
    lines = [line.split(",") for line in ansys.read_text().splitlines() if line.startswith("D,")]
    of_ansys = {(int(n), axis[a]): float(v) for _, n, a, v in lines}
    root = ElementTree.parse(febio).getroot()
    members = [int(n) for n in (root.findtext("Mesh/NodeSet[@name='outside']") or "").split(",")]
    of_febio = {
        (members[int(row.get("lid") or 0) - 1], 1 + "xyz".index((data.get("name") or "")[1])): float(row.text or "nan")
        for data in root.iterfind("MeshData/NodeData")
        for row in data.iterfind("node")
    }
    expected = {(int(n) + 1001, a + 1): u[i, a] for i, n in enumerate(nodes) for a in range(3)}
    for found in (of_abaqus, of_ansys, of_febio):
        assert found.keys() == expected.keys()
        assert all(found[key] == pytest.approx(expected[key], abs=1e-8) for key in expected)


def test_boundary_conditions_are_in_the_meshs_own_numbers_unit_and_frame(tmp_path: Path) -> None:
    mesh = slab()  # of a file without numbers: counted from 1
    nodes, u = boundary_displacement(mesh, SHEAR)
    abaqus, _, _ = write_boundary_conditions(tmp_path / "Load1", mesh, nodes, u, unit="m", frame="RAS")
    text = abaqus.read_text()
    assert "unit m, frame RAS" in text
    rows = [line.split(",") for line in text.splitlines() if line[0].isdigit()]
    found = {(int(n), int(a)): float(v) for n, a, _, v in rows}
    at = int(np.argmax(np.abs(u[:, 1])))
    assert found[int(nodes[at]) + 1, 2] == pytest.approx(-1e-3 * u[at, 1])
    assert found[int(nodes[at]) + 1, 3] == pytest.approx(1e-3 * u[at, 2])


@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not installed")
def test_calculix_runs_with_them(tmp_path: Path) -> None:
    """By *INCLUDE in a step of its own deck: its outside goes where it was measured, and its inside as ours."""
    mesh = slab()
    fat = NeoHooke.of(0.005, 0.4)
    write_boundary_conditions(tmp_path / "Load1", mesh, *boundary_displacement(mesh, SHEAR))
    (tmp_path / "Load1.inp").rename(tmp_path / "measured.inp")
    lines = ["*NODE, NSET=NALL"] + [f"{n + 1}, {x}, {y}, {z}" for n, (x, y, z) in enumerate(mesh.points_mm.tolist())]
    lines += ["*ELEMENT, TYPE=C3D4, ELSET=EALL"]
    lines += [f"{i + 1}, " + ", ".join(str(n + 1) for n in cell) for i, cell in enumerate(mesh.cells)]
    lines += [
        "*MATERIAL, NAME=M",
        "*HYPERELASTIC, NEO HOOKE",
        "0.0025, 85.714",
        "*SOLID SECTION, ELSET=EALL, MATERIAL=M",
    ]
    lines += [
        "*STEP, NLGEOM, INC=100",
        "*STATIC",
        "0.2, 1.",
        "*INCLUDE, INPUT=measured.inp",
        "*NODE FILE",
        "U",
        "*END STEP",
    ]
    (tmp_path / "deck.inp").write_text("\n".join(lines) + "\n")
    subprocess.run(["ccx", "deck"], cwd=tmp_path, check=True, capture_output=True)
    theirs = read_result("ccx", tmp_path / "deck.frd").deformation.u_mm
    expected = SHEAR.displacement(mesh.points_mm)
    assert np.abs(theirs - expected).max() < 1e-4
    ours = simulate_driven(mesh, {"fat": fat, "skin": fat}, SHEAR, "Load1").u_mm
    assert np.abs(theirs - ours).max() < 1e-3


def test_the_command_writes_what_compare_takes(tmp_path: Path) -> None:
    mesh = slab()
    write_tet_mesh(tmp_path / "heel.vtu", mesh, {})
    grid = labels().grid
    folder = tmp_path / "measured" / "Load1"
    folder.mkdir(parents=True)
    u = SHEAR.displacement(grid.points().reshape(-1, 3)).reshape(*grid.shape, 3)
    write_displacement(folder, grid, u.astype(np.float32))
    argv = ["drive", tmp_path / "heel.vtu", tmp_path / "measured", "--set", "luboz", "--out", tmp_path / "out"]
    ran = CliRunner().invoke(app, [str(a) for a in argv])
    assert ran.exit_code == 0, ran.output
    assert "luboz, Load1: max. shear" in ran.output
    result = read_result("luboz", tmp_path / "out" / "luboz-driven" / "Load1.vtu")
    assert set(result.mesh.regions) == {"fat", "skin"}
    outer = np.unique(outer_faces(mesh.cells))
    assert np.abs(result.deformation.u_mm - SHEAR.displacement(mesh.points_mm))[outer].max() < 2e-3
    assert {p.name for p in (tmp_path / "out" / "luboz-driven" / "boundary").iterdir()} == {
        "Load1.inp", "Load1.mac", "Load1.feb",
    }  # fmt: skip
