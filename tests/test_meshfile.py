"""Mesh files: a file's own nodes, numbers, frame and unit are read, and come back with results on them."""

from __future__ import annotations

import csv
import itertools
import json
from pathlib import Path

import meshio
import numpy as np
import pytest

from dvc.deformation import Affine
from dvc.errors import GeometryError, ImageFileError, InputError, OutputError
from dvc.meshfile import MeshFile, read_mesh
from dvc.meshwrite import write_nodal_displacements, write_on_mesh

SIDE = 10.0


def block(n: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A cube of 10 mm, off the origin, cut into 6 n^3 tetrahedra of positive volume."""
    axis = np.linspace(0.0, SIDE, n + 1)
    points = np.array(list(itertools.product(axis, axis, axis))) + np.array([5.0, -20.0, 40.0])
    cells = []
    for corner in itertools.product(range(n), repeat=3):
        for order in itertools.permutations(range(3)):
            path = [np.array(corner)]
            for step in order:
                path.append(path[-1] + np.eye(3, dtype=int)[step])
            cell = [int(np.dot(node, [(n + 1) ** 2, n + 1, 1])) for node in path]
            odd = order in {(0, 2, 1), (1, 0, 2), (2, 1, 0)}
            cells.append([cell[0], cell[1], cell[3], cell[2]] if odd else cell)
    return points, np.array(cells)


def skin(cells: np.ndarray) -> np.ndarray:
    """Two triangles that are faces of the mesh."""
    return cells[:2, :3]


TAGS = np.random.default_rng(1).permutation(np.arange(100, 154, 2))  # numbers with gaps, in no order


def write_gmsh41(path: Path, points: np.ndarray, cells: np.ndarray, *, binary: bool) -> None:
    """Two physical groups of tetrahedra and one of triangles, nodes in two blocks, numbered by TAGS."""
    # dimension, tag, gmsh's number of the element type, nodes
    groups = [(2, 7, 2, skin(cells)), (3, 1, 4, cells[:20]), (3, 2, 4, cells[20:])]
    names = '$PhysicalNames\n3\n2 7 "sole"\n3 1 "fat"\n3 2 "skin"\n$EndPhysicalNames\n'
    out = bytearray(f"$MeshFormat\n4.1 {int(binary)} 8\n".encode())

    def ints(*values: int) -> bytes:
        return np.array(values, "<i4").tobytes() if binary else (" ".join(map(str, values)) + " ").encode()

    def sizes(*values: int) -> bytes:
        return np.array(values, "<u8").tobytes() if binary else (" ".join(map(str, values)) + " ").encode()

    def reals(values: np.ndarray) -> bytes:
        text = " ".join(map(repr, values.tolist())) + " "
        return values.astype("<f8").tobytes() if binary else text.encode()

    end = b"" if binary else b"\n"
    out += (ints(1) + b"\n" if binary else b"") + b"$EndMeshFormat\n" + names.encode() + b"$Entities\n"
    out += sizes(0, 0, 1, 2) + end
    for dim, tag, *_ in groups:
        out += ints(tag) + reals(np.zeros(6)) + sizes(1) + ints(tag) + sizes(0) + end
        assert dim in (2, 3)
    out += b"\n$EndEntities\n$Nodes\n" + sizes(2, 27, 100, 152) + end
    for part in (slice(0, 11), slice(11, 27)):
        out += ints(3, 1, 0) + sizes(len(TAGS[part])) + end
        out += b"".join(sizes(int(tag)) + end for tag in TAGS[part])
        out += b"".join(reals(point) + end for point in points[part])
    out += b"\n$EndNodes\n$Elements\n" + sizes(3, 50, 1, 50) + end
    number = itertools.count(1)
    for dim, tag, kind, nodes in groups:
        out += ints(dim, tag, kind) + sizes(len(nodes)) + end
        out += b"".join(sizes(next(number), *map(int, TAGS[row])) + end for row in nodes)
    path.write_bytes(bytes(out + b"\n$EndElements\n"))


def write_gmsh22(path: Path, points: np.ndarray, cells: np.ndarray) -> None:
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", "3"]
    lines += ['2 7 "sole"', '3 1 "fat"', '3 2 "skin"', "$EndPhysicalNames", "$Nodes", "27"]
    lines += [f"{tag} {x!r} {y!r} {z!r}" for tag, (x, y, z) in zip(TAGS, points.tolist(), strict=True)]
    lines += ["$EndNodes", "$Elements", "50"]
    elements = [(2, 7, row) for row in skin(cells)]
    elements += [(4, 1 if i < 20 else 2, row) for i, row in enumerate(cells)]
    for number, (kind, group, row) in enumerate(elements, start=1):
        lines.append(f"{number} {kind} 2 {group} {group} " + " ".join(str(TAGS[i]) for i in row))
    path.write_text("\n".join([*lines, "$EndElements", ""]))


def write_abaqus(path: Path, points: np.ndarray, cells: np.ndarray, kind: str = "C3D4H") -> None:
    """All that meshio 5.3.5 stumbles over: hybrid elements, a set at the nodes, several blocks of nodes."""
    rows = [f"{tag}, {x!r}, {y!r}, {z!r}" for tag, (x, y, z) in zip(TAGS, points.tolist(), strict=True)]
    lines = ["*HEADING", "a heel", "** comment", "*NODE, NSET=N1", *rows[:11], "*Node", *rows[11:]]
    lines += ["*ELEMENT, TYPE=S3, ELSET=sole"]
    lines += [f"{901 + i}, {a}, {b}, {c}" for i, (a, b, c) in enumerate(TAGS[skin(cells)])]
    lines += [f"*Element, type={kind},", " elset=Fat"]
    lines += [f"{i + 1}, {', '.join(str(TAGS[j]) for j in row)}" for i, row in enumerate(cells[:20])]
    lines += [f"*ELEMENT, TYPE={kind}"]
    for i, row in enumerate(cells[20:], start=21):
        a, b, c, d = TAGS[row]
        lines += [f"{i}, {a}, {b},", f"{c}, {d}"]
    lines += ["*ELSET, ELSET=part one, GENERATE", "21, 30, 1", "*ELSET, ELSET=skin", "PART ONE,"]
    lines += [", ".join(map(str, range(31, 49)))]
    path.write_text("\n".join(lines) + "\n")


def write_ansys(path: Path, points: np.ndarray, cells: np.ndarray, top: np.ndarray | None = None) -> None:
    """As CDWRITE writes it: shells and solids in one block, components as runs of numbers, a component of nodes."""
    lines = [
        "/COM,ANSYS RELEASE 2024 R1",
        "/PREP7",
        "ET,1,285",
        "ET,2,181",
        f"NBLOCK,6,SOLID,{TAGS.max():9d},{len(TAGS):9d}",
    ]
    lines += ["(3i9,6e21.13e3)"]
    lines += [f"{TAGS[n]:9d}{0:9d}{0:9d}" + "".join(f"{x:21.13E}" for x in points[n]) for n in range(len(TAGS))]
    lines += ["N,R5.3,LOC,       -1,", f"EBLOCK,19,SOLID,{950:9d},{50:9d}", "(19i9)"]

    def row(number: int, kind: int, material: int, nodes: list[int]) -> str:
        return "".join(f"{v:9d}" for v in [material, kind, 1, 1, 0, 0, 0, 0, len(nodes), 0, number, *nodes])

    lines += [row(901 + i, 2, 7, [*TAGS[face], TAGS[face[-1]]]) for i, face in enumerate(skin(cells))]
    lines += [row(1 + i, 1, 1 if i < 20 else 2, list(TAGS[cell])) for i, cell in enumerate(cells)]
    lines += [f"{-1:9d}"]

    def component(name: str, kind: str, numbers: list[int]) -> list[str]:
        rows = ["".join(f"{n:10d}" for n in numbers[i : i + 8]) for i in range(0, len(numbers), 8)]
        return [f"CMBLOCK,{name:<8},{kind},{len(numbers):8d}  ! users element component definition", "(8i10)", *rows]

    lines += component("SOLE", "ELEM", [901, 902])
    lines += component("FAT", "ELEM", [1, -20]) + component("SKIN", "ELEM", [21, -48])
    if top is not None:
        lines += component("TOP", "NODE", sorted(TAGS[top].tolist()))
    path.write_text("\n".join([*lines, "/GO", "FINISH"]) + "\n")


def write_vtk(path: Path, points: np.ndarray, cells: np.ndarray) -> None:
    tissue = [np.array([7, 7]), np.where(np.arange(48) < 20, 1, 2)]
    blocks = [("triangle", skin(cells)), ("tetra", cells)]
    meshio.write(path, meshio.Mesh(points, blocks, cell_data={"tissue": tissue}))


def written(folder: Path, kind: str, scale: float = 1.0, signs: tuple[int, int, int] = (1, 1, 1)) -> Path:
    points, cells = block()
    points = points * scale * signs
    path = folder / f"heel.{kind[:3]}"
    if kind == "inp":
        write_abaqus(path, points, cells)
    elif kind == "cdb":
        write_ansys(path, points, cells)
    elif kind == "msh-22":
        write_gmsh22(path, points, cells)
    elif kind.startswith("msh"):
        write_gmsh41(path, points, cells, binary=kind == "msh-41-binary")
    else:
        write_vtk(path, points, cells)
    return path


KINDS = ["vtu", "vtk", "msh-22", "msh-41", "msh-41-binary", "inp", "cdb"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("unit", "scale"), [("mm", 1.0), ("m", 1e-3)])
@pytest.mark.parametrize(("frame", "signs"), [("LPS", (1, 1, 1)), ("RAS", (-1, -1, 1))])
def test_every_format_unit_and_frame_gives_the_same_mesh(
    tmp_path: Path, kind: str, unit: str, scale: float, frame: str, signs: tuple[int, int, int]
) -> None:
    points, cells = block()
    mesh = read_mesh(written(tmp_path, kind, scale, signs), unit=unit, frame=frame)
    np.testing.assert_allclose(mesh.points_mm, points, atol=1e-9)
    assert mesh.tets is not None
    np.testing.assert_array_equal(mesh.tets.cells, cells)
    named = kind in {"inp", "cdb"} or kind.startswith("msh")
    fat, dermis, sole = ("fat", "skin", "sole") if named else ("tissue 1", "tissue 2", "tissue 7")
    regions = {name.casefold(): index for name, index in mesh.tets.regions.items()}
    np.testing.assert_array_equal(regions[fat], np.arange(20))
    np.testing.assert_array_equal(regions[dermis], np.arange(20, 48))
    facets = {name.casefold(): faces for name, faces in mesh.tets.facets.items()}
    np.testing.assert_array_equal(facets[sole], skin(cells))
    np.testing.assert_array_equal(mesh.node_ids, TAGS if named else np.arange(27))
    assert mesh.cell_count == 50
    np.testing.assert_allclose(mesh.centroids_mm[2:], mesh.tets.centroids_mm, atol=1e-9)


@pytest.mark.parametrize("kind", ["inp", "cdb"])
def test_a_set_of_nodes_names_the_outer_triangles_between_them(tmp_path: Path, kind: str) -> None:
    points, cells = block()
    top = np.flatnonzero(points[:, 2] == points[:, 2].max())
    path = tmp_path / f"heel.{kind}"
    if kind == "cdb":
        write_ansys(path, points, cells, top)
    else:
        write_abaqus(path, points, cells)
        middle = len(top) // 2
        sets = ["*NSET, NSET=half", ", ".join(str(TAGS[n]) for n in top[:middle]), "*NSET, NSET=Top", "HALF,"]
        strange = ["*NSET, NSET=elsewhere", "Part-1.5"]
        path.write_text(
            path.read_text() + "\n".join([*sets, ", ".join(str(TAGS[n]) for n in top[middle:]), *strange]) + "\n"
        )
    mesh = read_mesh(path).tets
    assert mesh is not None
    found = mesh.facets["TOP" if kind == "cdb" else "Top"]
    assert len(found) == 8  # two for each of the four squares
    assert np.unique(found).tolist() == top.tolist()
    assert "elsewhere" not in mesh.facets


@pytest.mark.parametrize(("nodes", "kind"), [(4, "tetra"), (10, "tetra10")])
def test_bricks_that_are_tetrahedra_are_read_as_such(tmp_path: Path, nodes: int, kind: str) -> None:
    path = tmp_path / "heel.cdb"
    points = np.array([[0, 0, 0], [6, 0, 0], [0, 6, 0], [0, 0, 6]], dtype=float)
    edges = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]
    points = np.concatenate([points, [points[list(e)].mean(axis=0) for e in edges]])[:nodes]
    i, j, k, m, *mid = range(1, nodes + 1)
    brick = [i, j, k, k, m, m, m, m]
    if mid:
        q, r, t, y, z, a = mid
        brick += [q, r, k, t, m, m, m, m, y, z, a, a]
    head = [1, 1, 1, 1, 0, 0, 0, 0, len(brick), 0, 1]
    lines = [f"ET,1,{186 if mid else 185}", f"NBLOCK,6,SOLID,{nodes},{nodes}", "(3i9,6e21.13e3)"]
    lines += [f"{n:9d}{0:9d}{0:9d}" + "".join(f"{x:21.13E}" for x in p) for n, p in enumerate(points, start=1)]
    lines += ["-1", "EBLOCK,19,SOLID,1,1", "(19i9)", "".join(f"{v:9d}" for v in head + brick[:8])]
    lines += ["".join(f"{v:9d}" for v in brick[8:])] if mid else []
    path.write_text("\n".join([*lines, "       -1"]) + "\n")
    mesh = read_mesh(path)
    assert [(b.kind, b.nodes.tolist()) for b in mesh.blocks] == [(kind, [list(range(nodes))])]
    path.write_text(path.read_text().replace("ET,1,185", "ET,1,170").replace("ET,1,186", "ET,1,170"))
    with pytest.raises(ImageFileError, match="no volume cells"):
        read_mesh(path)


def test_gmsh_22_binary_numbers_are_read(tmp_path: Path) -> None:
    points, cells = block()
    path = tmp_path / "heel.msh"
    meshio.write(path, meshio.Mesh(points, [("tetra", cells)]), file_format="gmsh22", binary=True)
    data = path.read_bytes()
    start = data.index(b"$Nodes\n27\n") + len(b"$Nodes\n27\n")
    nodes = np.frombuffer(data, [("tag", "<i4"), ("x", "<f8", 3)], 27, start).copy()
    assert nodes["tag"].tolist() == list(range(1, 28))
    np.testing.assert_array_equal(read_mesh(path).node_ids, np.arange(1, 28))


def test_a_quadratic_mesh_keeps_its_mid_side_nodes_and_is_checked_by_its_corners(tmp_path: Path) -> None:
    corners = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10]])
    middles = [corners[[i, j]].mean(axis=0) for i, j in ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))]
    path = tmp_path / "quadratic.vtu"
    meshio.write(path, meshio.Mesh(np.vstack([corners, middles]), [("tetra10", [list(range(10))])]))
    mesh = read_mesh(path)
    assert mesh.points_mm.shape == (10, 3)
    np.testing.assert_allclose(mesh.centroids_mm, [[2.5, 2.5, 2.5]])
    assert mesh.tets is not None
    assert mesh.tets.cells.tolist() == [[0, 1, 2, 3]]
    assert mesh.tets.points_mm.shape == (4, 3)


def hexahedron(folder: Path) -> MeshFile:
    points = np.array(list(itertools.product((0.0, 10.0), repeat=3)))
    path = folder / "brick.vtu"
    meshio.write(path, meshio.Mesh(points, [("hexahedron", [[0, 4, 6, 2, 1, 5, 7, 3]])]))
    return read_mesh(path)


def test_a_mesh_of_bricks_takes_results_though_it_has_no_tetrahedra(tmp_path: Path) -> None:
    mesh = hexahedron(tmp_path)
    assert mesh.tets is None
    np.testing.assert_allclose(mesh.centroids_mm, [[5, 5, 5]])
    write_on_mesh(tmp_path / "out.vtu", mesh, {}, {"max_shear": np.array([0.25])})
    back = meshio.read(tmp_path / "out.vtu")
    assert back.cells[0].type == "hexahedron"
    assert back.cell_data["max_shear"][0].tolist() == [0.25]


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, kind: str) -> None:
    path = written(tmp_path, kind)
    data = path.read_bytes()
    whole = read_mesh(path)
    for end in range(0, len(data) - 1, len(data) // 60):
        if kind == "inp" and data[:end].endswith(b"\n"):
            continue  # the format has no mark of its end: a cut between two lines cannot be seen
        path.write_bytes(data[:end])
        try:
            cut = read_mesh(path)
        except ImageFileError:
            continue
        # only the closing words were lost
        np.testing.assert_array_equal(cut.centroids_mm, whole.centroids_mm, err_msg=f"cut at {end}")


def test_what_cannot_be_a_mesh_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"\.inp, \.cdb, \.frd, \.msh, \.vtu, \.vtk; got '\.stl'"):
        read_mesh(tmp_path / "heel.stl")
    with pytest.raises(ImageFileError, match="no such file"):
        read_mesh(tmp_path / "heel.vtu")
    with pytest.raises(InputError, match="mm or m; got 'inch'"):
        read_mesh(written(tmp_path, "vtu"), unit="inch")
    with pytest.raises(InputError, match="LPS or RAS; got 'LAS'"):
        read_mesh(written(tmp_path, "vtu"), frame="LAS")
    points, cells = block()
    meshio.write(tmp_path / "surface.vtu", meshio.Mesh(points, [("triangle", skin(cells))]))
    with pytest.raises(ImageFileError, match=r"no volume cells \(found: triangle\)"):
        read_mesh(tmp_path / "surface.vtu")
    cells[3, 0] = cells[3, 1]
    meshio.write(tmp_path / "flat.vtu", meshio.Mesh(points, [("tetra", cells)]))
    with pytest.raises(GeometryError, match=r"flat\.vtu: 1 of 48 tetrahedra are degenerate"):
        read_mesh(tmp_path / "flat.vtu")
    with pytest.raises(GeometryError, match=r"heel\.vtu: .*--mesh-unit m"):
        read_mesh(written(tmp_path, "vtu", 1e-3))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("*HEADING", "*INCLUDE, INPUT=nodes.inp", r"\*INCLUDE in line 1 brings in"),
        ("*HEADING", "*PART, NAME=a\n*END PART\n*PART, NAME=b", r"\*PART in line 3 is a second part"),
        ("*HEADING", "*INSTANCE, NAME=a, PART=b\n0., 0., 12.", r"\*INSTANCE in line 1 moves the part"),
        ("*NODE, NSET=N1", "*NODE, SYSTEM=C", "cylindrical"),
        ("type=C3D4H", "type=C3D27", "solid elements of type C3D27 are not read"),
        ("type=C3D4H", "type=C3D10", "need 11 numbers each; the 100 numbers"),
        ("\n48, ", "\n47, ", "element 47 is defined twice"),
        ("*Node\n", f"*Node\n{TAGS[0]}, 0, 0, 0\n", f"node {TAGS[0]} is defined twice"),
        ("*Node\n", "*Node\nfour, 0, 0, 0\n", "could not be read .*'four'"),
        ("PART ONE", "PART TWO", "'PART TWO' is not defined"),
        ("PART ONE", "Skin", "'Skin' is not defined, or contains itself"),
        ("\n21, ", f"\n21, {TAGS[0] + 1}, {TAGS[1]}, 1, 1\n22, ", "which the file does not define"),
    ],
)
def test_what_is_not_read_in_an_abaqus_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = written(tmp_path, "inp")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ImageFileError, match=message):
        read_mesh(path)


def test_what_carries_no_tissue_in_an_abaqus_file_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = written(tmp_path, "inp")
    spring = f"*ELEMENT, TYPE=SPRINGA\n999, {TAGS[0]}, {TAGS[1]}\n"
    reference_point = f"*ASSEMBLY, NAME=a\n*NODE\n{TAGS[0]}, 900., 900., 900.\n*END ASSEMBLY\n"
    path.write_text(path.read_text() + spring + reference_point)
    mesh = read_mesh(path)
    assert mesh.cell_count == 50
    np.testing.assert_allclose(mesh.bounds_mm, [[5, -20, 40], [15, -10, 50]])
    assert "elements of type SPRINGA carry no tissue" in caplog.text


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
    missing = write_on_mesh(out, mesh, {"u_mm": u}, {"H": gradients, "max_shear": np.linspace(0, 1, 50)})
    assert missing == {f"u_{unit}": 0, "H": 0, "max_shear": 0}

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
    assert write_on_mesh(tmp_path / "out.vtu", mesh, {"u_mm": u}, {}) == {"u_mm": 2}
    assert np.isnan(meshio.read(tmp_path / "out.vtu").point_data["u_mm"]).sum() == 4


def test_what_cannot_be_written_is_refused_and_leaves_nothing_behind(tmp_path: Path) -> None:
    mesh = read_mesh(written(tmp_path, "vtu"))
    before = mesh.path.read_bytes()
    u = np.zeros_like(mesh.points_mm)
    with pytest.raises(InputError, match="is the mesh itself"):
        write_on_mesh(mesh.path, mesh, {}, {})
    with pytest.raises(InputError, match=r"must end in \.csv"):
        write_nodal_displacements(tmp_path / "bc.txt", mesh, u)
    with pytest.raises(InputError, match=r"each of the 50 cells.* got shape \(48,\)"):
        write_on_mesh(tmp_path / "out.vtu", mesh, {}, {"J": np.ones(48)})
    with pytest.raises(InputError, match=r"shape \(27, 3\).* got \(26, 3\)"):
        write_nodal_displacements(tmp_path / "bc.csv", mesh, u[1:])
    with pytest.raises(InputError, match="'node' is kept"):
        write_on_mesh(tmp_path / "out.vtu", mesh, {"node": u}, {})
    with pytest.raises(OutputError, match="folder exists"):
        write_on_mesh(tmp_path / "nowhere" / "out.vtu", mesh, {}, {})
    (tmp_path / "taken.csv").mkdir()
    with pytest.raises(OutputError, match=r"taken\.csv: cannot be written"):
        write_nodal_displacements(tmp_path / "taken.csv", mesh, u)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["heel.vtu", "taken.csv"]
    assert mesh.path.read_bytes() == before
