"""Label map to mesh: borders keep volumes, tissues and surfaces keep their names, what cannot be meshed is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import InputError, MrstrainError, OutputError
from dvc.images.image import Grid, LabelMap
from dvc.io.images.write import write_labels
from dvc.mesh import TetMesh
from fe import mesh_labels, read_tet_mesh, write_tet_mesh
from fe.meshing import _guessed, check_meshing
from fe.slivers import dihedral_angles_deg, without_slivers
from fe.tissue_surfaces import borders_of, labels_at, thinned
from mrstrain.models.mesh import Meshed
from mrstrain.options.modelling import Meshing
from tests.blocks import block

NAMES = {1: "bone", 2: "fat", 3: "skin"}


def half_onion(spacing: float = 1.0) -> LabelMap:
    """Half a ball, cut at z = 0: bone of 6 mm inside fat to 14 mm inside a skin to 17 mm; an oblique grid."""
    turn = np.array([[0.8, 0.6, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    grid = Grid((44, 44, 28), (spacing, spacing, spacing), turn @ np.array([-21.5, -21.5, -23.0]), turn)
    points = grid.points()
    radius = np.linalg.norm(points, axis=-1)
    labels = np.select([radius < 6, radius < 14, radius < 17], [1, 2, 3], 0) * (points[..., 2] < 0)
    return LabelMap(grid, labels, NAMES)


@pytest.fixture(scope="module")
def meshed() -> tuple[TetMesh, object]:
    return mesh_labels(half_onion(), 4.0)


def test_borders_keep_the_volumes_that_smoothing_would_take() -> None:
    labels = half_onion()
    borders = borders_of(labels)
    for number in NAMES:
        voxels = float((labels.labels == number).sum()) / 1000.0
        sign = (borders.sides[:, 0] == number).astype(float) - (borders.sides[:, 1] == number)
        enclosed = abs(float(sign @ np.linalg.det(borders.points_mm[borders.triangles]))) / 6000.0
        assert enclosed == pytest.approx(voxels, rel=0.01)  # plain relaxation loses 4 %
    points = labels.grid.points(labels.labels >= 0)
    # a voxel's centre may fall on the other side only where a border is: none by more than half a voxel
    radius = np.linalg.norm(points, axis=-1)
    sure = (np.abs(radius[:, None] - [6, 14, 17]).min(axis=1) > 1.0) & (np.abs(points[:, 2]) > 1.0)
    assert np.array_equal(labels_at(labels, borders, points[sure]), labels.labels.reshape(-1)[sure])


def test_thinned_borders_are_closed_and_lie_where_they_were() -> None:
    labels = half_onion()
    borders = borders_of(labels)
    points, triangles = thinned(borders, 0.05)
    assert len(triangles) < 0.5 * len(borders.triangles)
    edges = np.sort(np.concatenate([triangles[:, pair] for pair in ([0, 1], [1, 2], [0, 2])]), axis=1)
    times = np.unique(edges, axis=0, return_counts=True)[1]
    assert set(times) == {2, 3}  # three where skin, fat and air meet at the cut
    middles = points[triangles].mean(axis=1)  # a node stays where it was: what moves is between nodes
    radius, at_cut = np.linalg.norm(middles, axis=1), middles[:, 2] > -1.5
    off = np.abs(radius[:, None] - [6.0, 14.0, 17.0]).min(axis=1)[~at_cut]
    whole = borders.points_mm[borders.points_mm[:, 2] < -1.5]
    before = np.abs(np.linalg.norm(whole, axis=1)[:, None] - [6.0, 14.0, 17.0]).min(axis=1)
    assert off.max() < before.max() + 0.3
    assert off.mean() < before.mean() + 0.05
    for off_mm in (0.02, 0.2):  # the further it may lie, the fewer triangles
        assert (len(thinned(borders, off_mm)[1]) - len(triangles)) * (off_mm - 0.05) < 0


@pytest.mark.full_size
def test_a_tendon_of_few_voxels_keeps_its_volume() -> None:
    """A mesh within its tolerance of smoothed borders takes a tenth from this cord of 3 voxels."""
    labels = half_onion()
    points = labels.grid.points()
    cord = (np.hypot(points[..., 1] - 9.5, points[..., 2] + 5.0) < 1.6) & (np.abs(points[..., 0]) < 6.0)
    assert (labels.labels[cord] == 2).all()
    labels = LabelMap(labels.grid, np.where(cord, 4, labels.labels), {**NAMES, 4: "tendon"})
    _, quality = mesh_labels(labels, 3.0)
    for name, made, given in quality.volumes_ml:
        assert made == pytest.approx(given, rel=0.002), name
    assert quality.least_angle_deg > 10.0


def test_tissues_have_their_volumes_and_good_cells(meshed) -> None:
    mesh, quality = meshed
    assert set(mesh.regions) == {"fat", "skin"}
    for name, made, given in quality.volumes_ml:
        assert made == pytest.approx(given, rel=0.002), name
        assert made == pytest.approx(float(mesh.volumes_mm3[mesh.regions[name]].sum()) / 1000.0)
    assert quality.least_angle_deg > 10.0
    assert 2.0 < quality.edge_mm[1] < 5.0
    counted = np.concatenate(list(mesh.regions.values()))
    assert len(np.unique(counted)) == len(counted) == len(mesh.cells)


def test_surfaces_lie_where_they_should(meshed) -> None:
    mesh, _ = meshed
    radius = {name: np.linalg.norm(mesh.points_mm[np.unique(rows)], axis=1) for name, rows in mesh.facets.items()}
    assert set(radius) == {"bone", "skin", "cut"}
    skin = mesh.points_mm[np.unique(mesh.facets["skin"])]
    at_rim = radius["skin"] < 16.0  # its own section at the cut, a sixth of all, counts as cut but for its very rim
    assert np.mean(at_rim) < 0.08
    assert (skin[at_rim, 2] > -1.0).all()
    for off_mm in (np.abs(radius["bone"] - 6.0), np.abs(mesh.points_mm[np.unique(mesh.facets["cut"]), 2] + 0.5)):
        assert off_mm.max() < 1.0  # the rim where they meet is rounded, by less than a voxel
        assert np.quantile(off_mm, 0.95) < 0.5
        assert off_mm.mean() < 0.2
    shared = np.intersect1d(*(np.unique(mesh.cells[cells]) for cells in mesh.regions.values()))
    assert len(shared) > 100
    border = np.linalg.norm(mesh.points_mm[shared], axis=1)  # fat's with skin
    rim = mesh.points_mm[shared, 2] > -1.5  # where three surfaces meet, the mesher takes a corner off now and then
    assert border[~rim] == pytest.approx(14.0, abs=0.8)
    assert border[rim] == pytest.approx(14.0, abs=1.5)
    assert np.mean(np.abs(border[rim] - 14.0) < 0.8) > 0.9
    whole = np.concatenate(list(mesh.facets.values()))
    assert len(np.unique(np.sort(whole, axis=1), axis=0)) == len(whole)
    edges = np.sort(np.concatenate([whole[:, pair] for pair in ([0, 1], [1, 2], [0, 2])]), axis=1)
    _, times = np.unique(edges, axis=0, return_counts=True)
    assert (times % 2 == 0).all()  # closed


@pytest.mark.full_size
def test_a_finer_skin_is_two_cells_thick(meshed) -> None:
    """No cell of a skin of 3 mm reaches through it, but for one in a hundred at the rim of the cut."""
    _, coarse = meshed
    _, fine = mesh_labels(half_onion(), 4.0, finer=("skin", 1.4))
    assert dict(fine.thin)["skin"] < 0.01
    assert dict(coarse.thin)["skin"] > 0.3


def test_a_bone_that_is_meshed_as_tissue_is_told(meshed) -> None:
    mesh, quality = meshed
    for name, told in (("Talus", True), ("fat", False)):
        regions = {name: mesh.regions["fat"], "skin": mesh.regions["skin"]}
        lines = Meshed(
            Path("a.vtu"), TetMesh(mesh.points_mm, mesh.cells, regions, mesh.facets), quality, Meshing()
        ).summary()
        assert any(line.startswith(f"WARNING: {name} is meshed") for line in lines) == told


def test_dihedral_angles_of_known_shapes() -> None:
    corner = np.array([[[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]])
    assert sorted(dihedral_angles_deg(corner)[0]) == pytest.approx([np.degrees(np.arccos(3**-0.5))] * 3 + [90.0] * 3)
    regular = np.array([[[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]])
    assert dihedral_angles_deg(regular)[0] == pytest.approx(np.degrees(np.arccos(1 / 3)))


def _spoiled(free: bool, by: float = 0.93) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two tissues one upon the other, and one node shoved until cells beside it are nearly flat."""
    box = block((4, 4, 4), (4.0, 4.0, 4.0), layers=2)
    points, tissue = box.points_mm.copy(), np.zeros(len(box.cells), dtype=int)
    tissue[box.regions["layer 1"]] = 1
    at = points.min(axis=0) + ([1.0, 2.0, 1.0] if free else [2.0, 2.0, 2.0])
    node = int(np.argmin(np.linalg.norm(points - at, axis=1)))
    points[node] += [0.0, by, 0.0]
    return points, box.cells, tissue


def test_a_flat_cell_is_mended_and_borders_stay_where_they_are() -> None:
    def least(points: np.ndarray, cells: np.ndarray) -> float:
        return float(dihedral_angles_deg(points[cells]).min())

    for free in (True, False):
        points, cells, tissue = _spoiled(free)
        assert least(points, cells) < 8.0
        mended = without_slivers(points, cells, tissue)
        assert least(mended, cells) > 12.0
        assert least(without_slivers(*_spoiled(free, 1.0)), cells) > 12.0  # quite flat
        assert np.count_nonzero((mended != points).any(axis=1)) < 8
        faces, halves = block((4, 4, 4), (4.0, 4.0, 4.0)).facets, points[:, 0] == 2.0
        assert np.array_equal(mended[halves, 0], points[halves, 0])  # the border between the tissues
        for name, rows in faces.items():
            axis = "xyz".index(name[0])
            assert np.array_equal(mended[np.unique(rows), axis], points[np.unique(rows), axis]), name
    # a node where all that is near belongs to borders that meet stays: the mesh keeps its flat cell and its shape
    points, cells, _ = _spoiled(False)
    assert np.array_equal(without_slivers(points, cells, np.arange(len(cells))), points)


def test_what_cannot_be_meshed_is_refused() -> None:
    labels = half_onion()
    for edge in (0.1, 50.0, float("nan")):
        with pytest.raises(InputError, match="edge length must be between"):
            mesh_labels(labels, edge)
    with pytest.raises(InputError, match="no region 'calcaneus'; it has bone, fat, skin"):
        mesh_labels(labels, 4.0, bones=("calcaneus",))
    with pytest.raises(InputError, match="no soft tissue"):
        mesh_labels(labels, 4.0, bones=("bone", "fat", "skin"))
    for edge in (6.0, 0.001, -1.0):  # .001 mm filled the memory before it reached the time limit
        with pytest.raises(InputError, match="finer edge length must be between a quarter of a voxel"):
            check_meshing(labels, 4.0, ("bone",), ("skin", edge))


def test_meshing_that_does_not_end_is_ended() -> None:
    with pytest.raises(MrstrainError, match=r"stopped at its time limit of 1 s\. Use a longer edge length"):
        mesh_labels(half_onion(), 0.6, limit_s=1.0)


def test_a_mesh_comes_back_with_every_name(tmp_path: Path) -> None:
    box = block((2, 2, 2), (4.0, 4.0, 4.0), layers=2)
    mesh = TetMesh(
        box.points_mm, box.cells, {"fat": box.regions["layer 0"], "skin": box.regions["layer 1"]},
        {"bone": box.facets["x0"], "skin": box.facets["x1"]},
    )  # fmt: skip
    write_tet_mesh(tmp_path / "box.vtu", mesh, {"made": "here"})
    again = read_tet_mesh(tmp_path / "box.vtu")
    assert np.array_equal(again.cells, mesh.cells)
    assert {k: v.tolist() for k, v in again.regions.items()} == {k: v.tolist() for k, v in mesh.regions.items()}
    assert {k: v.tolist() for k, v in again.facets.items()} == {k: v.tolist() for k, v in mesh.facets.items()}
    (tmp_path / "box.json").unlink()
    assert set(read_tet_mesh(tmp_path / "box.vtu").regions) == {"region 1", "region 2"}
    (tmp_path / "box.json").write_text("{}")
    with pytest.raises(InputError, match=r"box\.json: the table of region names is missing"):
        read_tet_mesh(tmp_path / "box.vtu")


@pytest.mark.usefixtures("real_pictures")
def test_the_command_writes_mesh_names_and_picture(tmp_path: Path) -> None:
    from typer.testing import CliRunner

    from mrstrain.cli.app import app

    write_labels(tmp_path / "map.nii.gz", half_onion())
    given = ["--edge-mm", "5", "--names", str(tmp_path / "map.csv"), "--out", str(tmp_path / "out" / "onion.vtu")]
    done = CliRunner().invoke(app, ["mesh", str(tmp_path / "map.nii.gz"), *given])
    assert done.exit_code == 0, done.output
    assert "tetrahedra" in done.output
    assert set(read_tet_mesh(tmp_path / "out" / "onion.vtu").regions) == {"fat", "skin"}
    told = json.loads((tmp_path / "out" / "onion.json").read_text())
    assert told["parameters"]["edge_mm"] == 5.0
    assert told["quality"]["cells"] > 100
    assert (tmp_path / "out" / "onion.png").stat().st_size > 10_000
    assert 10_000 < (tmp_path / "out" / "onion.pdf").stat().st_size < 500_000


def test_the_command_replaces_no_input(tmp_path: Path) -> None:
    from mrstrain.models.mesh import mesh

    with pytest.raises(InputError, match=r"must end in \.vtu"):
        mesh("a.nii.gz", out=tmp_path / "mesh.msh")
    with pytest.raises(OutputError, match="would be overwritten"):
        mesh("a.nii.gz", names=tmp_path / "heel.json", out=tmp_path / "heel.vtu")


def test_a_mesh_that_takes_longer_than_expected_always_has_some_time_left():
    shares = [0.5, 1.0, 2.0, 5.0, 20.0]  # of the expected time
    left = [share * (1.0 / _guessed(share) - 1.0) for share in shares]
    assert left[0] == pytest.approx(0.5)
    assert all(0.1 < some < 0.25 for some in left[1:]), left
