"""Results on a mesh file: they are written in its frame, unit and node numbers, or refused."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import meshio
import numpy as np
import pytest

from dvc.deformation.protocol import Affine
from dvc.errors import InputError, OutputError
from dvc.io.meshes.read import read_mesh
from dvc.io.meshes.write import write_nodal_displacements, write_on_mesh
from tests.meshfiles import TAGS, block, written

H = np.array([[0.02, 0.30, -0.01], [0.05, -0.10, 0.04], [-0.03, 0.20, 0.07]])
MOVED = Affine(np.eye(3) + H, np.array([1.0, -2.0, 3.0]))
CASES = [("mm", 1.0, "LPS", (1, 1, 1)), ("mm", 1.0, "RAS", (-1, -1, 1)), ("m", 1e-3, "RAS", (-1, -1, 1))]


@pytest.mark.parametrize(("unit", "scale", "frame", "signs"), CASES)
def test_results_come_back_in_the_frame_and_unit_of_the_users_mesh(
    tmp_path: Path, unit: str, scale: float, frame: str, signs: tuple[int, int, int]
) -> None:
    mesh = read_mesh(written(tmp_path, "inp", scale, signs), unit=unit, frame=frame)
    u, _ = MOVED.evaluate(mesh.points_mm)
    _, gradients = MOVED.evaluate(mesh.centroids_mm)
    out = tmp_path / "out.vtu"
    write_on_mesh(out, mesh, {"u_mm": u}, {"H": gradients, "max_shear": np.linspace(0, 1, 50)})

    back = meshio.read(out)
    own_points, _ = block()
    np.testing.assert_allclose(back.points, own_points * scale * signs, rtol=1e-12)
    turned = np.diag(signs) @ H @ np.diag(signs)
    expected = back.points @ turned.T + np.array([1.0, -2.0, 3.0]) * signs * scale
    np.testing.assert_allclose(back.point_data[f"u_{unit}"], expected, rtol=1e-9)
    np.testing.assert_allclose(back.cell_data["H"][1], np.tile(turned.ravel(), (48, 1)), rtol=1e-12)
    np.testing.assert_allclose(back.cell_data["max_shear"][1], np.linspace(0, 1, 50)[2:], rtol=1e-12)
    np.testing.assert_array_equal(back.point_data["node"], TAGS)
    assert [cells.type for cells in back.cells] == ["triangle", "tetra"]

    assert write_nodal_displacements(tmp_path / "bc.csv", mesh, u) == 0
    with (tmp_path / "bc.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == ["node", *(f"{name}_{unit}" for name in ("x", "y", "z", "ux", "uy", "uz"))]
    assert [int(row["node"]) for row in rows] == TAGS.tolist()
    table = np.array([[float(x) for x in list(row.values())[1:]] for row in rows])
    np.testing.assert_allclose(table, np.hstack([back.points, expected]), rtol=1e-8, atol=1e-9)
    declared = json.loads((tmp_path / "bc.json").read_text())
    assert (declared["frame"], declared["unit"], declared["nodes"]) == (frame, unit, 27)
    assert declared["node"] == "number in the mesh file"


def test_nodes_of_an_ansys_archive_are_declared_by_their_numbers(tmp_path: Path) -> None:
    mesh = read_mesh(written(tmp_path, "cdb"))
    write_nodal_displacements(tmp_path / "bc.csv", mesh, np.zeros_like(mesh.points_mm))
    assert json.loads((tmp_path / "bc.json").read_text())["node"] == "number in the mesh file"


def test_a_node_without_a_displacement_is_empty_and_counted_never_zero(tmp_path: Path) -> None:
    mesh = read_mesh(written(tmp_path, "vtu"))
    u = MOVED.displacement(mesh.points_mm).copy()
    u[4], u[9, 1] = np.nan, np.nan
    assert write_nodal_displacements(tmp_path / "bc.csv", mesh, u) == 2
    lines = (tmp_path / "bc.csv").read_text().splitlines()
    assert [line.endswith(",,,") for line in lines[1:]] == [node in {4, 9} for node in range(27)]
    assert "nan" not in "".join(lines)
    declared = json.loads((tmp_path / "bc.json").read_text())
    assert declared["nodes_without_displacement"] == 2
    assert declared["node"] == "index in the mesh file, counted from 0"
    write_on_mesh(tmp_path / "out.vtu", mesh, {"u_mm": u}, {})
    assert np.isnan(meshio.read(tmp_path / "out.vtu").point_data["u_mm"]).sum() == 4


def test_what_cannot_be_written_is_refused_and_leaves_nothing_behind(tmp_path: Path) -> None:
    mesh = read_mesh(written(tmp_path, "vtu"))
    before = mesh.path.read_bytes()
    u = np.zeros_like(mesh.points_mm)
    with pytest.raises(InputError, match="is the mesh itself"):
        write_on_mesh(mesh.path, mesh, {}, {})
    with pytest.raises(InputError, match=r"must end in \.csv"):
        write_nodal_displacements(tmp_path / "bc.txt", mesh, u)
    with pytest.raises(InputError, match=r"50 rows, one per cell, .* got shape \(48,\)"):
        write_on_mesh(tmp_path / "out.vtu", mesh, {}, {"J": np.ones(48)})
    with pytest.raises(InputError, match=r"shape \(27, 3\).* got \(26, 3\)"):
        write_nodal_displacements(tmp_path / "bc.csv", mesh, u[1:])
    with pytest.raises(InputError, match="'node' is reserved"):
        write_on_mesh(tmp_path / "out.vtu", mesh, {"node": u}, {})
    with pytest.raises(OutputError, match="folder exists"):
        write_on_mesh(tmp_path / "nowhere" / "out.vtu", mesh, {}, {})
    (tmp_path / "taken.csv").mkdir()
    with pytest.raises(OutputError, match=r"taken\.csv: cannot be written"):
        write_nodal_displacements(tmp_path / "taken.csv", mesh, u)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["heel.vtu", "taken.csv"]
    assert mesh.path.read_bytes() == before
