"""Results of any finite-element code: the same deformation from every format, unit and frame; misfits are refused."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import meshio
import numpy as np
import pytest

from dvc.errors import GeometryError, ImageFileError, InputError
from dvc.images.image import Grid
from dvc.io.meshes.read import read_mesh
from dvc.mesh import outer_faces
from tests.meshfiles import TAGS, block, write_abaqus, write_ansys, write_gmsh22
from validate import CellGraph, check_overlap, fe_result, read_result
from validate.tetrahedra import linear_tetrahedra

GRADIENT = np.array([[0.1, 0.05, 0.0], [0.0, -0.08, 0.2], [0.03, 0.0, 0.02]])
INSIDE = np.array([[7.3, -16.1, 44.4], [12.0, -12.5, 48.0]])


def moved(points: np.ndarray) -> np.ndarray:
    return points @ GRADIENT.T + np.array([1.0, -2.0, 0.5])


def table(path: Path, ids: np.ndarray, u: np.ndarray, head: str = "node,ux,uy,uz") -> Path:
    rows = [f"{n},{x!r},{y!r},{z!r}" for n, (x, y, z) in zip(ids.tolist(), u.tolist(), strict=True)]
    path.write_text("\n".join([head, *rows]) + "\n")
    return path


def write_frd(path: Path, points: np.ndarray, cells: np.ndarray, u: np.ndarray) -> None:
    """As CalculiX writes it (compared with a file of version 2.20)."""

    def rows(values: np.ndarray) -> list[str]:
        return [f" -1{n:10d}" + "".join(f"{v:12.5E}" for v in row) for n, row in zip(TAGS, values, strict=True)]

    lines = ["    1C", "    1UPGM               CalculiX", f"    2C{len(points):30d}{1:38d}", *rows(points), " -3"]
    lines += [f"    3C{len(cells):30d}{1:38d}"]
    for number, cell in enumerate(cells, start=1):
        lines += [
            f" -1{number:10d}    3    0{1 if number <= 20 else 2:5d}",
            " -2" + "".join(f"{TAGS[n]:10d}" for n in cell),
        ]
    lines += [" -3"]
    for factor in (0.5, 1.0):  # two increments: the last one counts
        lines += [
            "  100CL  101 1.000000000           5                     0    1           1",
            " -4  DISP        4    1",
        ]
        lines += [f" -5  D{i}          1    2    {i}    0" for i in (1, 2, 3)] + [
            " -5  ALL         1    2    0    0    1ALL"
        ]
        lines += [*rows(factor * u), " -3"]
    path.write_text("\n".join([*lines, " 9999"]) + "\n")


def written(folder: Path, kind: str, scale: float = 1.0, signs: tuple[int, int, int] = (1, 1, 1)) -> dict[str, Path]:
    points, cells = block()
    u = moved(points) * scale * signs
    points = points * scale * signs
    path = folder / f"Load1.{kind}"
    if kind == "frd":
        write_frd(path, points, cells, u)
    elif kind in ("inp", "cdb"):
        (write_abaqus if kind == "inp" else write_ansys)(path, points, cells)
        return {"path": table(folder / "Load1.csv", TAGS[::-1], u[::-1]), "mesh": path}
    elif kind == "msh":
        write_gmsh22(path, points, cells)
        mesh = meshio.read(path)
        mesh.point_data["U"] = u
        meshio.gmsh.write(path, mesh, fmt_version="2.2")
    else:
        meshio.write(path, meshio.Mesh(points, [("tetra", cells)], {"displacement": u}))
    return {"path": path}


@pytest.mark.parametrize("kind", ["vtu", "vtk", "msh", "frd", "inp", "cdb"])
@pytest.mark.parametrize(("unit", "scale"), [("mm", 1.0), ("m", 1e-3)])
@pytest.mark.parametrize(("frame", "signs"), [("LPS", (1, 1, 1)), ("RAS", (-1, -1, 1))])
def test_every_code_gives_the_same_deformation(
    tmp_path: Path, kind: str, unit: str, scale: float, frame: str, signs: tuple[int, int, int],
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    files = written(tmp_path, kind, scale, signs)
    capsys.readouterr()
    result = read_result("heel", files["path"], mesh=files.get("mesh"), unit=unit, frame=frame)
    u, H = result.deformation.evaluate(INSIDE)
    close = 2e-3 if kind == "frd" else 1e-6  # an .frd file has six digits
    np.testing.assert_allclose(u, moved(INSIDE), atol=close)
    np.testing.assert_allclose(H, np.tile(GRADIENT, (2, 1, 1)), atol=close)
    assert result.mesh.volumes_mm3.sum() == pytest.approx(1000.0, rel=1e-4)


def test_a_map_to_the_image_turns_points_and_displacements(tmp_path: Path) -> None:
    files = written(tmp_path, "vtu")
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, [3.0, 4.0, 5.0]
    u, H = read_result("heel", files["path"], to_image=matrix).deformation.evaluate(INSIDE @ turn.T + matrix[:3, 3])
    np.testing.assert_allclose(u, moved(INSIDE) @ turn.T, atol=1e-6)
    np.testing.assert_allclose(H[0], turn @ GRADIENT @ turn.T, atol=1e-6)
    with pytest.raises(InputError, match="rotation"):
        read_result("heel", files["path"], to_image=2.0 * matrix)


@pytest.mark.parametrize(("kind", "children"), [("tetra10", 8), ("hexahedron", 12), ("wedge", 8), ("pyramid", 6)])
def test_cells_of_any_kind_carry_a_linear_field_exactly(tmp_path: Path, kind: str, children: int) -> None:
    corners = {
        "tetra10": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        "wedge": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]],
        "pyramid": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1]],
    }.get(kind, [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    points = 10.0 * np.array(corners, dtype=float)
    edges = {
        "tetra10": [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)],
    }.get(kind, [])
    points = np.concatenate([points, *([[points[list(e)].mean(axis=0) for e in edges]] if edges else [])])
    volume = {"tetra10": 1 / 6, "wedge": 0.5, "pyramid": 1 / 3}.get(kind, 1.0) * 1000.0
    path = tmp_path / "Load1.vtu"
    meshio.write(path, meshio.Mesh(points, [(kind, [list(range(len(points)))])], {"displacement": moved(points)}))
    result = read_result("one", path)
    assert len(result.mesh.cells) == children
    assert result.mesh.volumes_mm3.sum() == pytest.approx(volume, rel=1e-5)
    centre = result.mesh.centroids_mm
    u, H = result.deformation.evaluate(centre)
    np.testing.assert_allclose(u, moved(centre), atol=1e-5)
    np.testing.assert_allclose(H, np.tile(GRADIENT, (children, 1, 1)), atol=1e-5)
    if kind == "hexahedron":
        folded = points.copy()
        folded[6] = [2.0, 2.0, -9.0]
        meshio.write(path, meshio.Mesh(folded, [(kind, [list(range(8))])], {"displacement": moved(points)}))
        with pytest.raises(GeometryError, match="folded"):
            read_result("one", path)


def test_neighbours_of_any_numbering_fit(tmp_path: Path) -> None:
    axis = np.linspace(0.0, 12.0, 4)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    corner = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]])
    turns = [[0, 1, 2, 3, 4, 5, 6, 7], [1, 2, 3, 0, 5, 6, 7, 4], [0, 4, 5, 1, 3, 7, 6, 2], [6, 5, 4, 7, 2, 1, 0, 3]]
    cells = np.array([(np.array(c) + corner) @ [16, 4, 1] for c in np.ndindex(3, 3, 3)])
    random = np.random.default_rng(0)
    cells = np.array([cell[turns[random.integers(4)]] for cell in cells])
    number = random.permutation(len(points))
    shuffled = np.empty_like(points)
    shuffled[number] = points
    path = tmp_path / "Load1.vtu"
    meshio.write(path, meshio.Mesh(shuffled, [("hexahedron", number[cells])], {"displacement": moved(shuffled)}))
    mesh = read_result("bricks", path).mesh
    whole = CellGraph.of(mesh).clusters(np.ones(len(mesh.cells), dtype=bool), np.ones(len(mesh.cells)))
    assert [c.volume_ml for c in whole] == [pytest.approx(1.728)]
    on_a_side = ((mesh.points_mm == 0.0) | (mesh.points_mm == 12.0)).any(axis=1)
    assert on_a_side[outer_faces(mesh.cells)].all()


def test_surfaces_and_regions_come_along(tmp_path: Path) -> None:
    points, cells = block()
    top = np.flatnonzero(points[:, 2] == points[:, 2].max())
    write_ansys(tmp_path / "heel.cdb", points, cells, top)
    mesh, carry = linear_tetrahedra(read_mesh(tmp_path / "heel.cdb"))
    assert len(mesh.regions["FAT"]) == 20
    assert len(mesh.facets["TOP"]) == 8
    assert np.array_equal(np.unique(carry[np.unique(mesh.facets["TOP"])].indices), top)


def test_what_does_not_lie_in_the_image_is_refused_with_what_would(tmp_path: Path) -> None:
    grid = Grid((40, 40, 40), np.ones(3), np.array([-10.0, -35.0, 25.0]), np.eye(3))
    place = written(tmp_path, "vtu")["path"]
    check_overlap(place, read_result("heel", place).mesh, grid)
    lost = read_result("heel", written(tmp_path, "vtu", 1.0, (-1, -1, 1))["path"])
    with pytest.raises(GeometryError, match=r"Model: -15 to -5 .*image: -10 to 30 .*the other frame \(LPS or RAS\)"):
        check_overlap(place, lost.mesh, grid)
    big = read_result("heel", written(tmp_path, "vtu", 0.1)["path"])  # centimetres
    with pytest.raises(GeometryError, match="Give the rigid map"):
        check_overlap(place, big.mesh, Grid((9, 9, 9), np.ones(3), np.array([100.0, 0.0, 0.0]), np.eye(3)))


def test_what_is_no_result_is_refused(tmp_path: Path) -> None:
    points, cells = block()
    plain = tmp_path / "mesh.vtu"
    meshio.write(plain, meshio.Mesh(points, [("tetra", cells)]))
    with pytest.raises(InputError, match="no displacement at its nodes"):
        read_result("heel", plain)
    files = written(tmp_path, "inp")
    with pytest.raises(InputError, match="give the table of its nodal displacements"):
        read_result("heel", files["mesh"])
    with pytest.raises(InputError, match="also needs the mesh"):
        read_result("heel", files["path"])
    for rows, head, message in (
        (TAGS, "node,a,b,c", "column 'node' and three"),
        (TAGS, "node,x,y,z", "column 'node' and three"),
        (TAGS + 1, "node,ux,uy,uz", "does not have"),
        (np.full(27, TAGS[0]), "node,ux,uy,uz", "a node twice"),
        (TAGS[:20], "Node Label,U1,U2,U3", "7 of 27 nodes have no displacement"),
    ):
        table(files["path"], rows, moved(points)[: len(rows)], head)
        with pytest.raises(InputError, match=message):
            read_result("heel", files["path"], mesh=files["mesh"])
    text = table(files["path"], TAGS, moved(points)).read_text()
    for damaged, message in (
        (text.removesuffix("\n"), "ends in the middle of a line"),
        (text.replace(f"\n{TAGS[3]},", f"\n{TAGS[3]}.5,"), rf"has node {TAGS[3]}\.5, which"),
        (text.replace(f"\n{TAGS[3]},", "\nnan,"), "has node nan, which"),
        (text.partition("\n")[0] + "\n", "27 of 27 nodes have no displacement"),
    ):
        files["path"].write_text(damaged)
        with pytest.raises(InputError, match=message):
            read_result("heel", files["path"], mesh=files["mesh"])
    table(files["path"], TAGS, 1000.0 * moved(points))
    with pytest.raises(InputError, match="largest displacement"):
        read_result("heel", files["path"], mesh=files["mesh"])
    table(files["path"], TAGS, 0.0 * moved(points))
    with pytest.raises(InputError, match="0 everywhere, as in the unloaded state"):
        read_result("heel", files["path"], mesh=files["mesh"])
    whole = written(tmp_path, "frd")["path"]
    text = whole.read_text()
    for end in range(200, len(text) - 40, len(text) // 25):
        whole.write_text(text[:end])
        with pytest.raises((ImageFileError, InputError)):
            read_result("heel", whole)


def test_an_frd_file_with_a_spring_is_read_and_one_that_contradicts_itself_refused(tmp_path: Path) -> None:
    path = written(tmp_path, "frd")["path"]
    text = path.read_text()
    spring = f" -1{99:10d}   11    0    2\n -2{TAGS[0]:10d}{TAGS[1]:10d}\n"
    end_of_elements = " -3\n  100CL"
    more = text.replace(end_of_elements, spring + end_of_elements, 1)
    path.write_text(more.replace(f"    3C{48:30d}", f"    3C{49:30d}"))
    u, _ = read_result("heel", path).deformation.evaluate(INSIDE)
    path.write_text(text)
    np.testing.assert_array_equal(u, read_result("heel", path).deformation.evaluate(INSIDE)[0])
    last = text.rindex(f" -1{TAGS[3]:10d}")
    path.write_text(text[:last] + f" -1{7:10d}" + text[last + 13 :])
    with pytest.raises(ImageFileError, match=r"Load1\.frd: a displacement belongs to node 7, which is not defined"):
        read_result("heel", path)


def test_a_gmsh_file_whose_nodes_stand_in_another_order_is_refused(tmp_path: Path) -> None:
    mesh = tmp_path / "Load2.msh"
    mesh.write_text(
        "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n4\n2 6 0 0\n1 0 0 0\n3 0 6 0\n4 0 0 6\n$EndNodes\n"
        "$Elements\n1\n1 4 2 1 1 1 2 3 4\n$EndElements\n"
        '$NodeData\n1\n"u"\n1\n0.0\n3\n0\n3\n4\n1 0 0 0\n2 0 0 0\n3 0 0 0\n4 1 0 0\n$EndNodeData\n'
    )
    with pytest.raises(InputError, match="order of their numbers"):
        read_result("heel", mesh)


def with_middles(points: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic tetrahedra of linear ones: nodes in the middles of the edges, in CalculiX's order."""
    pairs = np.sort(cells[:, [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]], axis=2)
    edges, number = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    middles = points[edges].mean(axis=1)
    return np.concatenate([points, middles]), np.hstack([cells, len(points) + number.reshape(-1, 6)])


@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not installed")
@pytest.mark.parametrize("kind", ["C3D4", "C3D10", "C3D8"])
def test_a_file_of_calculix_itself_is_read(tmp_path: Path, kind: str) -> None:
    points, cells = block()
    if kind == "C3D10":
        points, cells = with_middles(points, cells)
    if kind == "C3D8":
        low = points.min(axis=0)
        index = {tuple(np.rint((p - low) / 5.0).astype(int)): n for n, p in enumerate(points)}
        around = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
        cells = np.array([[index[tuple(np.add(c, a))] for a in around] for c in np.ndindex(2, 2, 2)])
    lines = ["*NODE, NSET=NALL"] + [f"{n + 1}, {x}, {y}, {z}" for n, (x, y, z) in enumerate(points.tolist())]
    lines += [f"*ELEMENT, TYPE={kind}, ELSET=EALL"]
    lines += [f"{i + 1}, " + ", ".join(str(n + 1) for n in cell) for i, cell in enumerate(cells)]
    lines += ["*MATERIAL, NAME=M", "*ELASTIC", "1., 0.3", "*SOLID SECTION, ELSET=EALL, MATERIAL=M", "*STEP", "*STATIC"]
    rim = ((points == points.min(axis=0)) | (points == points.max(axis=0))).any(axis=1)
    lines += ["*BOUNDARY"]
    small = 0.01 * moved(points)
    lines += [f"{n + 1}, {a + 1}, {a + 1}, {small[n, a]:.9g}" for n in np.flatnonzero(rim) for a in range(3)]
    lines += ["*NODE FILE", "U", "*END STEP"]
    (tmp_path / "Load1.inp").write_text("\n".join(lines) + "\n")
    subprocess.run(["ccx", "Load1"], cwd=tmp_path, check=True, capture_output=True)
    u, H = read_result("heel", tmp_path / "Load1.frd").deformation.evaluate(INSIDE)
    np.testing.assert_allclose(u, 0.01 * moved(INSIDE), atol=1e-5)
    np.testing.assert_allclose(H[0], 0.01 * GRADIENT, atol=1e-5)


def test_vtk_as_febio_writes_it(tmp_path: Path) -> None:
    """The layout of FEBio's own VTK plot file: unloaded points, three to a line, and scalars without a count."""
    points, cells = block()
    u = points @ np.array([[0.0, 0.1, 0.0], [0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
    part = np.arange(len(cells)) >= len(cells) // 2
    rows = ["# vtk DataFile Version 3.0", "time 1", "ASCII", "DATASET UNSTRUCTURED_GRID"]
    rows.append(f"POINTS {len(points)} float")
    for start in range(0, len(points), 3):
        rows.append("".join(f"{x:g} {y:g} {z:g} " for x, y, z in points[start : start + 3]))
    rows += ["", f"CELLS {len(cells)} {5 * len(cells)}"]
    rows += [f"4 {' '.join(str(n) for n in cell)} " for cell in cells]
    rows += ["", f"CELL_TYPES {len(cells)}", *["10"] * len(cells), "", f"POINT_DATA {len(u)}"]
    rows += ["VECTORS displacement float", *(f"{x:g} {y:g} {z:g}" for x, y, z in u), "", f"CELL_DATA {len(part)}"]
    rows += ["SCALARS part_id int", "LOOKUP_TABLE default", *(str(int(p)) for p in part)]
    (tmp_path / "heel.1.vtk").write_text("\n".join(rows) + "\n")
    found = read_result("febio", tmp_path / "heel.1.vtk")
    np.testing.assert_allclose(found.deformation.displacement(points[13:14]), u[13:14], atol=1e-5)
    assert {name: len(inside) for name, inside in read_mesh(tmp_path / "heel.1.vtk").regions.items()} == {
        "part_id 0": np.count_nonzero(~part), "part_id 1": np.count_nonzero(part),
    }  # fmt: skip


def test_the_docstring_says_every_name_that_is_read() -> None:
    told = " ".join((read_result.__doc__ or "").split())
    for name in (*fe_result._NAMES, *fe_result._NODE_COLUMNS, *(first for first, _, _ in fe_result._COMPONENTS)):
        assert re.search(rf"(?<![\w.-]){re.escape(name)}(?![\w.-]*\w)", told), name
    for ending in (".csv", ".inp", ".cdb", ".frd", ".xplt", "LPS", "unloaded"):
        assert ending in told
