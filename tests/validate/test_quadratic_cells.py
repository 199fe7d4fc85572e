"""Quadratic bricks, wedges and pyramids: their own interpolation, in the order of nodes of every format."""

from __future__ import annotations

import shutil
import subprocess
from itertools import product
from pathlib import Path

import meshio
import numpy as np
import pytest
import vtk
from scipy.spatial import cKDTree

from dvc.errors import GeometryError
from dvc.io.meshes.read import read_mesh
from dvc.mesh import outer_faces
from validate import FeResult, read_result
from validate.tetrahedra import linear_tetrahedra

SQUARE = [(0, 0), (1, 0), (1, 1), (0, 1)]
CUBE = np.array([(x, y, z) for z in (0, 1) for x, y in SQUARE], dtype=float)
WEDGE = np.array([(x, y, z) for z in (0, 1) for x, y in SQUARE[:2] + SQUARE[3:]], dtype=float)
PYRAMID = np.array([*((x, y, 0) for x, y in SQUARE), (0.5, 0.5, 0.5)], dtype=float)
VTK = {  # how VTK itself numbers the nodes; number of tetrahedra
    "hexahedron20": (vtk.vtkQuadraticHexahedron, CUBE, 48),
    "hexahedron27": (vtk.vtkTriQuadraticHexahedron, CUBE, 48),
    "wedge15": (vtk.vtkQuadraticWedge, WEDGE, 32),
    "wedge18": (vtk.vtkBiQuadraticQuadraticWedge, WEDGE, 32),
    "pyramid13": (vtk.vtkQuadraticPyramid, PYRAMID, 24),
}
SKEW = np.array([[9.0, 1.5, -1.0], [0.5, 8.0, 2.0], [-2.0, 1.0, 10.0]])  # a cell with plane faces, askew


def reference(kind: str) -> np.ndarray:
    """Reference coordinates of a cell's nodes, from VTK's edges and faces."""
    made, corners, _ = VTK[kind]
    cell = made()
    for n in range(cell.GetNumberOfPoints()):
        cell.GetPointIds().SetId(n, n)
    nodes = np.full((cell.GetNumberOfPoints(), 3), np.nan)
    nodes[: len(corners)] = corners
    for n in range(cell.GetNumberOfEdges()):
        a, b, middle = (cell.GetEdge(n).GetPointId(i) for i in range(3))
        nodes[middle] = nodes[[a, b]].mean(axis=0)
    for n in range(cell.GetNumberOfFaces()):
        ids = [cell.GetFace(n).GetPointId(i) for i in range(cell.GetFace(n).GetNumberOfPoints())]
        if len(ids) == 9:
            nodes[ids[8]] = nodes[ids[:4]].mean(axis=0)
    nodes[np.isnan(nodes)] = 0.5  # the middle of the brick of 27 nodes
    return nodes


def quadratic(points: np.ndarray) -> np.ndarray:
    """A displacement in equilibrium in any linear elastic body without forces: div u = 0 and every laplacian is 0."""
    x, y, z = (points / 10.0).T
    rows = [
        1.0 + 0.7 * y * z + 0.3 * (x * x - y * y) - 0.5 * z * x,
        x + 0.7 * z * x - 0.6 * x * y + 0.4 * (y * y - z * z),
        -y + 0.7 * x * y - 0.8 * y * z + 0.25 * (z * z - x * x),
    ]
    return np.stack(rows, axis=1)


def bulging(points: np.ndarray) -> np.ndarray:
    """A quadratic displacement that no element of linear shape functions comes near to."""
    x, y, z = (points / 10.0).T
    return np.stack([1.0 + x * y - z * z, x - 0.5 * y * y + y * z, 0.3 * x * x + 0.4 * z * x - y], axis=1)


def gradient(points: np.ndarray) -> np.ndarray:
    """Of `bulging`."""
    x, y, z = (points / 10.0).T
    rows = [[y, x, -2 * z], [1.0 + 0.0 * x, z - y, y], [0.6 * x + 0.4 * z, 0.0 * x - 1.0, 0.4 * x]]
    return np.moveaxis(np.array(rows), 2, 0) / 10.0


def read(path: Path, points: np.ndarray, kind: str, cells: np.ndarray, u: np.ndarray | None = None) -> FeResult:
    moved = quadratic(points) if u is None else u
    meshio.write(path, meshio.Mesh(points, [(kind, cells)], {"displacement": moved}))
    return read_result("one", path)


def exact_at_all_nodes(result: FeResult) -> bool:
    at = result.mesh.points_mm
    return bool(np.abs(result.deformation.u_mm - quadratic(at)).max() < 1e-5)


@pytest.mark.parametrize("kind", VTK)
def test_a_quadratic_field_is_exact_at_old_and_new_nodes(tmp_path: Path, kind: str) -> None:
    _, corners, count = VTK[kind]
    result = read(tmp_path / "Load1.vtu", reference(kind) @ SKEW.T, kind, np.arange(len(reference(kind)))[None])
    assert exact_at_all_nodes(result)
    assert len(result.mesh.cells) == count
    volume = {8: 1.0, 6: 0.5, 5: 1 / 6}[len(corners)] * np.linalg.det(SKEW)
    assert result.mesh.volumes_mm3.sum() == pytest.approx(volume, rel=1e-5)


def lattice(kind: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    """A cube of 12 mm of n x n x n bricks, each of one or more cells; bent, so that no face is plane."""
    nodes = reference(kind)
    turns = [np.eye(3)]
    if kind.startswith("wedge"):
        turns.append(np.diag([-1.0, -1.0, 1.0]))
    if kind.startswith("pyramid"):
        turns = [side * np.roll(np.eye(3), k, axis=0) for k in range(3) for side in (1.0, -1.0)]
    every = [(nodes - 0.5) @ t.T + 0.5 + c for c in product(range(n), repeat=3) for t in turns]
    points, which = np.unique(np.round(np.concatenate(every) * 4 * n) / (4 * n), axis=0, return_inverse=True)
    at = 12.0 * points / n
    bend = 0.6 * np.sin(at[:, [1, 2, 0]] / 5.0) * np.cos(at[:, [2, 0, 1]] / 7.0)
    number = np.random.default_rng(0).permutation(len(at))
    shuffled = np.empty_like(at)
    shuffled[number] = at + bend
    return shuffled, number[which.reshape(-1, len(nodes))]


@pytest.mark.parametrize("kind", VTK)
def test_the_error_falls_with_the_square_of_the_size_and_is_a_quarter_of_the_corners(tmp_path: Path, kind: str) -> None:
    _, corners, _ = VTK[kind]
    inside = np.random.default_rng(1).uniform(2.0, 10.0, (2000, 3))
    linear = kind.rstrip("0123456789")
    errors, turned, coarse = [], [], []
    for n in (1, 2, 4):
        points, cells = lattice(kind, n)
        fine = read(tmp_path / "Load1.vtu", points, kind, cells, bulging(points))
        assert len(outer_faces(fine.mesh.cells)) == 6 * n * n * 8  # neighbours fit: nothing is open inside
        u, H = fine.deformation.evaluate(inside)
        errors.append(np.sqrt(((u - bulging(inside)) ** 2).mean()))
        turned.append(np.sqrt(((H - gradient(inside)) ** 2).mean()))
        plain = read(tmp_path / "Load1.vtu", points, linear, cells[:, : len(corners)], bulging(points))
        coarse.append(np.sqrt(((plain.deformation.displacement(inside) - bulging(inside)) ** 2).mean()))
    assert np.log2(errors[1] / errors[2]) > 1.75  # 2 in the limit; measured 1.81 (pyramids) to 1.97
    assert np.log2(turned[1] / turned[2]) > 0.8  # 1 in the limit; measured 0.85 (pyramids) to 1.05
    assert errors[-1] < 0.32 * coarse[-1]  # measured 0.27 to 0.30


# Orders as the formats' manuals give them, by the corners that a node lies between.
GMSH = {  # number of the type; pairs of corners in the order of their middles; then faces
    "hexahedron20": (17, "01 03 04 12 15 23 26 37 45 47 56 67", ""),
    "hexahedron27": (12, "01 03 04 12 15 23 26 37 45 47 56 67", "0321 0154 0473 1265 2376 4567"),
    "wedge15": (18, "01 02 03 12 14 25 34 35 45", ""),
    "wedge18": (13, "01 02 03 12 14 25 34 35 45", "0143 0253 1254"),
    "pyramid13": (19, "01 03 04 12 14 23 24 34", ""),
    "pyramid14": (14, "01 03 04 12 14 23 24 34", "0123"),
}
CORNERS = {"hexahedron": CUBE, "wedge": WEDGE, "pyramid": PYRAMID}


def in_order(kind: str, edges: str, faces: str = "") -> np.ndarray:
    """Nodes of one cell askew, in the order that corners, edges and faces tell; the middle of 27 last."""
    corners = CORNERS[kind.rstrip("0123456789")]
    between = [[int(c) for c in word] for word in (edges + " " + faces).split()]
    nodes = [*corners, *(corners[b].mean(axis=0) for b in between)]
    nodes += [corners.mean(axis=0)] if kind == "hexahedron27" else []
    return 12.0 + np.array(nodes) @ SKEW.T


def folds_or_is_inexact(path: Path, table: Path | None = None) -> bool:
    try:
        return not exact_at_all_nodes(read_result("one", table or path, mesh=path if table else None))
    except GeometryError:
        return True


def table_of(path: Path, points: np.ndarray) -> Path:
    rows = [f"{n},{x!r},{y!r},{z!r}" for n, (x, y, z) in enumerate(quadratic(points).tolist(), start=1)]
    path.write_text("\n".join(["node,ux,uy,uz", *rows]) + "\n")
    return path


@pytest.mark.parametrize("kind", GMSH)
def test_gmsh_has_its_own_order(tmp_path: Path, kind: str) -> None:
    number, edges, faces = GMSH[kind]

    def write(points: np.ndarray) -> Path:
        path = tmp_path / "Load1.msh"
        ids = range(1, len(points) + 1)
        lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(len(points))]
        lines += [f"{n} {x!r} {y!r} {z!r}" for n, (x, y, z) in zip(ids, points.tolist(), strict=True)]
        lines += ["$EndNodes", "$Elements", "1", f"1 {number} 2 1 1 " + " ".join(map(str, ids)), "$EndElements"]
        lines += ["$NodeData", "1", '"displacement"', "1", "0.0", "3", "0", "3", str(len(points))]
        lines += [f"{n} {x!r} {y!r} {z!r}" for n, (x, y, z) in zip(ids, quadratic(points).tolist(), strict=True)]
        path.write_text("\n".join([*lines, "$EndNodeData", ""]))
        return path

    points = in_order(kind, edges, faces)
    assert exact_at_all_nodes(read_result("one", write(points)))
    first = len(CORNERS[kind.rstrip("0123456789")])
    points[[first, first + 1]] = points[[first + 1, first]]  # another order does not pass
    assert folds_or_is_inexact(write(points))


BOTTOM_TOP_UPRIGHT = {
    "hexahedron20": ("C3D20H", "01 12 23 30 45 56 67 74 04 15 26 37"),
    "wedge15": ("C3D15", "01 12 20 34 45 53 03 14 25"),
}


@pytest.mark.parametrize("kind", BOTTOM_TOP_UPRIGHT)
def test_abaqus_counts_bottom_top_and_upright_edges(tmp_path: Path, kind: str) -> None:
    name, edges = BOTTOM_TOP_UPRIGHT[kind]
    points = in_order(kind, edges)
    lines = ["*NODE", *(f"{n + 1}, {x!r}, {y!r}, {z!r}" for n, (x, y, z) in enumerate(points.tolist()))]
    numbers = [str(n + 1) for n in range(len(points))]
    lines += [f"*ELEMENT, TYPE={name}, ELSET=FAT", "1, " + ", ".join(numbers[:9]) + ",", ", ".join(numbers[9:])]
    path = tmp_path / "heel.inp"
    path.write_text("\n".join(lines) + "\n")
    assert exact_at_all_nodes(read_result("one", table_of(tmp_path / "Load1.csv", points), mesh=path))


@pytest.mark.parametrize("kind", ["hexahedron20", "wedge15", "pyramid13", "tetra10"])
def test_ansys_bricks_that_have_become_something_else(tmp_path: Path, kind: str) -> None:
    # SOLID186: I J K L M N O P, then middles IJ JK KL LI MN NO OP PM IM JN KO LP; nodes that coincide are one
    letters = {
        "hexahedron20": "IJKLMNOP", "wedge15": "IJKKMNOO", "pyramid13": "IJKLMMMM", "tetra10": "IJKKMMMM",
    }[kind]  # fmt: skip
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)])
    place = dict(zip("IJKLMNOP", corners.astype(float), strict=True))
    if kind in ("pyramid13", "tetra10"):
        place["M"] = np.array([0.4, 0.5, 1.0])
    known: dict[str, int] = {}
    points: list[np.ndarray] = []

    def node(a: str, b: str) -> int:
        """Number of a corner (a = b) or of the middle of an edge, which is the corner itself where it has shrunk."""
        key = "".join(sorted({a, b}))
        if key not in known:
            known[key] = len(points) + 1
            points.append(12.0 + SKEW @ (place[a] + place[b]) / 2.0)
        return known[key]

    pairs = ["IJ", "JK", "KL", "LI", "MN", "NO", "OP", "PM", "IM", "JN", "KO", "LP"]
    became = dict(zip("IJKLMNOP", letters, strict=True))
    nodes = [node(c, c) for c in letters] + [node(became[a], became[b]) for a, b in pairs]
    lines = ["/PREP7", "ET,1,186", f"NBLOCK,6,SOLID,{len(points):9d},{len(points):9d}", "(3i9,6e21.13e3)"]
    lines += [f"{n:9d}{0:9d}{0:9d}" + "".join(f"{v:21.13E}" for v in p) for n, p in enumerate(points, start=1)]
    lines += ["N,R5.3,LOC,       -1,", "EBLOCK,19,SOLID,1,1", "(19i9)"]
    row = [1, 1, 1, 1, 0, 0, 0, 0, 20, 0, 1, *nodes]
    lines += ["".join(f"{v:9d}" for v in row[:19]), "".join(f"{v:9d}" for v in row[19:]), f"{-1:9d}"]
    path = tmp_path / "heel.cdb"
    path.write_text("\n".join(lines) + "\n")
    assert [block.kind for block in read_mesh(path).blocks] == [kind]
    result = read_result("one", table_of(tmp_path / "Load1.csv", np.array(points)), mesh=path)
    assert exact_at_all_nodes(result)
    assert len(result.mesh.cells) == {"tetra10": 8}.get(kind, VTK.get(kind, (0, 0, 0))[2])


@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not installed")
@pytest.mark.parametrize("kind", BOTTOM_TOP_UPRIGHT)
def test_quadratic_results_of_calculix_itself(tmp_path: Path, kind: str) -> None:
    points, cells = lattice(kind, 2)
    name = BOTTOM_TOP_UPRIGHT[kind][0].rstrip("H")
    lines = ["*NODE, NSET=NALL", *(f"{n + 1}, {x!r}, {y!r}, {z!r}" for n, (x, y, z) in enumerate(points.tolist()))]
    lines += [f"*ELEMENT, TYPE={name}, ELSET=EALL"]
    for number, cell in enumerate((cells + 1).tolist(), start=1):
        lines += [f"{number}, " + ", ".join(map(str, cell[:9])) + ",", ", ".join(map(str, cell[9:]))]
    lines += ["*MATERIAL, NAME=M", "*ELASTIC", "1., 0.3", "*SOLID SECTION, ELSET=EALL, MATERIAL=M", "*STEP", "*STATIC"]
    faces = outer_faces(read(tmp_path / "bricks.vtu", points, kind, cells).mesh.cells)
    rim = np.unique(faces[faces < len(points)])
    assert len(rim) < len(points)
    small = 0.001 * quadratic(points)
    lines += ["*BOUNDARY", *(f"{n + 1}, {a + 1}, {a + 1}, {small[n, a]:.9g}" for n in rim for a in range(3))]
    (tmp_path / "Load1.inp").write_text("\n".join([*lines, "*NODE FILE", "U", "*END STEP"]) + "\n")
    subprocess.run(["ccx", "Load1"], cwd=tmp_path, check=True, capture_output=True)
    found = read_result("heel", tmp_path / "Load1.frd")
    same = read(tmp_path / "bricks.vtu", points, kind, cells)
    assert found.mesh.volumes_mm3.sum() == pytest.approx(same.mesh.volumes_mm3.sum(), rel=1e-4)
    by_place = cKDTree(found.mesh.points_mm).query(points)[1]
    # inner nodes went where equilibrium put them, which is where the field has them
    np.testing.assert_allclose(found.deformation.u_mm[by_place[rim]], small[rim], atol=1e-6)
    np.testing.assert_allclose(found.deformation.u_mm[by_place], small, atol=2e-5)
    inside = np.random.default_rng(2).uniform(3.0, 9.0, (200, 3))
    expected = 0.001 * same.deformation.displacement(inside)
    np.testing.assert_allclose(found.deformation.displacement(inside), expected, atol=2e-5)


def test_named_surfaces_follow_the_cut_faces(tmp_path: Path) -> None:
    for kind, flat, width, most in (("hexahedron20", "quad8", 8, 8), ("hexahedron", "quad", 4, 2)):
        points, cells = lattice("hexahedron20", 2)
        faces = cells[:, [0, 1, 2, 3, 8, 9, 10, 11]][:, :width]
        cells = cells[:, : 20 if kind.endswith("20") else 8]
        lowest = faces[points[faces].mean(axis=1)[:, 2] < 3.0]
        path = tmp_path / "heel.vtu"
        tissue = [np.full(len(lowest), 2), np.full(len(cells), 1)]
        meshio.write(path, meshio.Mesh(points, [(flat, lowest), (kind, cells)], cell_data={"tissue": tissue}))
        mesh, _ = linear_tetrahedra(read_mesh(path))
        sole = np.sort(mesh.facets["tissue 2"], axis=1)
        outer = {tuple(face) for face in outer_faces(mesh.cells).tolist()}
        assert len(sole) == 4 * most
        assert all(tuple(face) in outer for face in sole.tolist())
