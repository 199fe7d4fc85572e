"""Mesh files: a file's own nodes, numbers, frame and unit are read; damaged files are refused."""

from __future__ import annotations

import itertools
from pathlib import Path

import meshio
import numpy as np
import pytest

from dvc.errors import GeometryError, ImageFileError, InputError
from dvc.io.meshes.read import MeshFile, read_mesh
from dvc.io.meshes.write import write_on_mesh
from tests.meshfiles import TAGS, block, skin, write_abaqus, write_ansys, written

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


@pytest.mark.parametrize("kind", ["msh-22", "msh-41", "msh-41-binary"])
def test_a_volume_and_its_surface_may_share_a_name(tmp_path: Path, kind: str) -> None:
    _, cells = block()
    path = written(tmp_path, kind)
    path.write_bytes(path.read_bytes().replace(b'"sole"', b'"skin"'))
    mesh = read_mesh(path)
    assert mesh.tets is not None
    assert set(mesh.tets.regions) == {"fat", "skin"}
    np.testing.assert_array_equal(mesh.tets.regions["skin"], np.arange(20, 48))
    assert set(mesh.tets.facets) == {"skin"}
    np.testing.assert_array_equal(mesh.tets.facets["skin"], skin(cells))
    np.testing.assert_array_equal(mesh.node_ids, TAGS)


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
    with pytest.raises(InputError, match=r"\.inp, \.cdb, \.frd, \.xplt, \.msh, \.vtu, \.vtk\."):
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
        ("*HEADING", "*INCLUDE, INPUT=nodes.inp", r"\*INCLUDE in line 1 includes"),
        ("*HEADING", "*PART, NAME=a\n*END PART\n*PART, NAME=b", r"\*PART in line 3 is a second part"),
        ("*HEADING", "*INSTANCE, NAME=a, PART=b\n0., 0., 12.", r"\*INSTANCE in line 1 moves the part"),
        ("*NODE, NSET=N1", "*NODE, SYSTEM=C", "cylindrical"),
        ("type=C3D4H", "type=C3D27", "solid elements of type C3D27 are not supported"),
        ("type=C3D4H", "type=C3D10", "need 11 numbers each, but 100 is not"),
        ("\n48, ", "\n47, ", "element 47 is defined twice"),
        ("*Node\n", f"*Node\n{TAGS[0]}, 0, 0, 0\n", f"node {TAGS[0]} is defined twice"),
        ("*Node\n", "*Node\nfour, 0, 0, 0\n", "cannot be read .*'four'"),
        ("PART ONE", "PART TWO", "'PART TWO' is not defined"),
        ("PART ONE", "Skin", "'Skin' is not defined, or contains itself"),
        ("\n21, ", f"\n21, {TAGS[0] + 1}, {TAGS[1]}, 1, 1\n99, ", "which is not defined in the file"),
        ("*HEADING", "*PART, NAME=a", r"\*PART in line 1 has no \*END PART: the file is incomplete"),
        ("PART ONE", "\N{SUPERSCRIPT TWO}", "'\N{SUPERSCRIPT TWO}' is not defined"),
        ("*Node\n", f"*Node\n{2**64}, 0, 0, 0\n", f"{2**64} cannot be the number of a node"),
        ("21, 30, 1", "21, 30, 0", "a row or an option cannot be read"),
    ],
)
def test_what_is_not_read_in_an_abaqus_file_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = written(tmp_path, "inp")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ImageFileError, match=message):
        read_mesh(path)


@pytest.mark.parametrize("last", [2**32, 2**63])
def test_numbers_that_a_set_generates_are_bounded_by_those_of_the_file(tmp_path: Path, last: int) -> None:
    path = written(tmp_path, "inp")
    path.write_text(path.read_text().replace("21, 30, 1", f"21, {last}, 2"))
    tets = read_mesh(path).tets
    assert tets is not None
    np.testing.assert_array_equal(tets.regions["part one"], np.arange(20, 48, 2))

    path = written(tmp_path, "cdb")
    path.write_text(path.read_text().replace(f"{21:10d}{-48:10d}", f"{21:10d}{-999999999:10d}"))
    tets = read_mesh(path).tets
    assert tets is not None
    np.testing.assert_array_equal(tets.regions["SKIN"], np.arange(20, 48))


def test_what_a_set_names_and_the_file_does_not_define_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = written(tmp_path, "inp")
    path.write_text(path.read_text().replace("31, 32,", "31, 99,"))
    assert read_mesh(path).cell_count == 50
    assert "the element set 'skin' names 1 that the file does not define, such as 99" in caplog.text
    caplog.clear()
    path.write_text(path.read_text() + f"*ELEMENT, TYPE=SPRINGA\n99, {TAGS[0]}, {TAGS[1]}\n")
    read_mesh(path)
    assert "does not define" not in caplog.text


def test_an_ansys_archive_that_may_be_cut_after_a_block_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = written(tmp_path, "cdb")
    read_mesh(path)
    assert not caplog.text
    path.write_text(path.read_text().partition("/GO")[0])
    read_mesh(path)
    assert "heel.cdb does not end in FINISH" in caplog.text
    lines = written(tmp_path, "cdb").read_text().splitlines(keepends=True)
    del lines[next(n for n, line in enumerate(lines) if line.startswith(row(2, 1, 1, 1))) + 1]
    path.write_text("".join(lines))
    assert read_mesh(path).cell_count == 49
    assert "heel.cdb: EBLOCK should have 50 rows and has 49" in caplog.text


@pytest.mark.parametrize(
    ("kind", "old", "new", "message"),
    [
        (
            "msh-22",
            "$EndElements",
            '$EndElements\n$NodeData\n99999999999\n"u"',
            "states 99999999999 items",
        ),
        ("msh-22", "$Nodes\n27\n", "$Nodes\n26\n", "27 of 26 Nodes"),
        ("msh-22", "$Elements\n50\n", "$Elements\n5\n", "50 of 5 Elements"),
        ("msh-22", f"\n{TAGS[0]} ", f"\n{TAGS[0]}000000000 ", f"to {TAGS[0]}000000000, and only 1 to 100000000 are"),
        ("msh-22", "$EndNodes", "$EndNode", "cannot be read as a mesh"),
        ("msh-22", "\n15 4 2 1 ", "\n15 14 4 2 1 ", "cells of the kind pyramid14 have too few nodes"),
        ("msh-41", "$Nodes\n2 27 ", "$Nodes\n2 28 ", "blocks of Nodes do not add up"),
        ("msh-41", "$Elements\n3 50 ", "$Elements\n3 49 ", "blocks of Elements do not add up"),
        ("msh-41", "$Elements\n3 50 ", "$Elements\n999999999 50 ", "could not be read to its end"),
        ("msh-41", "\n2 7 2 2 \n", "\n2 7 2 2000000000 \n", "states 8000000000 items"),
    ],
)
def test_counts_that_a_mesh_file_cannot_hold_are_refused_at_once(
    tmp_path: Path, kind: str, old: str, new: str, message: str
) -> None:
    path = written(tmp_path, kind)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ImageFileError, match=rf"heel\.{kind[:3]}: .*({message})"):
        read_mesh(path)


def test_a_grid_of_more_points_than_its_file_can_hold_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "heel.vtk"
    head = "# vtk DataFile Version 3.0\na heel\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS {}\nORIGIN 0 0 0\n"
    text = head + "SPACING 5 5 5\nPOINT_DATA 8\nSCALARS u double 1\nLOOKUP_TABLE default\n1 2 3 4 5 6 7 8\n"
    path.write_text(text.format("2 2 2"))
    assert [(block.kind, len(block.nodes)) for block in read_mesh(path).blocks] == [("hexahedron", 1)]
    path.write_text(text.format("2 2 2999999999"))
    with pytest.raises(
        ImageFileError, match=r"heel\.vtk: the file is too short for a grid of 2 x 2 x 2999999999 points"
    ):
        read_mesh(path)


def test_the_name_of_a_gmsh_group_may_lack_its_quotes(tmp_path: Path) -> None:
    path = written(tmp_path, "msh-41")
    path.write_text(path.read_text().replace('"sole"', "sole"))
    tets = read_mesh(path).tets
    assert tets is not None
    assert set(tets.facets) == {"sole"}


def row(*numbers: int) -> str:
    return "".join(f"{n:9d}" for n in numbers)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("(3i9,6e21.13e3)", "(3i9,6f21.13e3)", r"a row of NBLOCK cannot be read"),
        ("(3i9,6e21.13e3)", "(3i0,6e21.13e3)", r"a row of NBLOCK cannot be read .*'\(3i0,6e21.13e3\)' is not a format"),
        ("(19i9)", "(19i0)", r"a row of EBLOCK cannot be read .*'\(19i0\)' is not a format"),
        ("(8i10)", "(8i0)", r"a row of CMBLOCK cannot be read"),
        (row(4, 0, 1), row(3, 0, 1), r"element 1 has 3 nodes, but a tetra needs 4"),
        (row(4, 0, 2), row(4, 0, 1), r"element 1 is defined twice"),
        (f"{1:10d}{-20:10d}", f"{-1:10d}{-20:10d}", r"a row of CMBLOCK cannot be read \(-1 after 0 is neither"),
        (f"{TAGS[1]:9d}{0:9d}{0:9d}", f"{TAGS[0]:9d}{0:9d}{0:9d}", f"node {TAGS[0]} is defined twice"),
    ],
)
def test_a_damaged_ansys_archive_is_refused(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = written(tmp_path, "cdb")
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(ImageFileError, match=rf"heel\.cdb: {message}"):
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


def test_a_cell_without_volume_is_named_by_the_files_numbers_of_its_nodes(tmp_path: Path) -> None:
    path = tmp_path / "heel.inp"
    points, cells = block()
    cells[3, 0] = cells[3, 1]
    write_abaqus(path, points, cells)
    with pytest.raises(GeometryError, match=rf"cell 3, nodes \[{', '.join(str(TAGS[n]) for n in cells[3])}\]"):
        read_mesh(path)
