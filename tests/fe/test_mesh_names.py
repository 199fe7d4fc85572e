"""Names of tissues and surfaces in meshes: in whatever case, of other programs, and of tissues that get lost.

Label maps are meshed here by a lattice in the mesher's place: what is tested comes after it, and takes no time so.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import InputError, MrstrainError
from dvc.images.image import Grid, LabelMap
from dvc.mesh import TetMesh
from fe import MeshQuality, mesh_labels, read_tet_mesh, write_tet_mesh
from mrstrain.models.mesh import Meshed
from mrstrain.options.modelling import Finer, Meshing
from tests.blocks import block
from tests.fe.test_simulate import dome

SIDE = 12
SHIFT_MM = 0.1  # by which a border may move to keep volumes


@pytest.fixture
def latticed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[TetMesh, MeshQuality]]:
    """`mesh_labels`, with a lattice of so many cubes along each side."""

    def made(labels: LabelMap, cubes: int = SIDE) -> tuple[TetMesh, MeshQuality]:
        lattice = block((cubes,) * 3, (float(SIDE),) * 3)
        monkeypatch.setattr("fe.meshing._limited", lambda *_: (lattice.points_mm, lattice.cells))
        return mesh_labels(labels, 1.0)

    return made


def post(outer: str = "skin") -> LabelMap:
    """A square post along z: bone in fat in an outer tissue; the map ends at its upper end, z = 12 mm."""
    grid = Grid((SIDE,) * 3, (1.0, 1.0, 1.0), [0.5, 0.5, 0.5], np.eye(3))
    labels = np.zeros(grid.shape, dtype=int)
    labels[1:11, 1:11, 1:], labels[2:10, 2:10, 2:], labels[5:7, 5:7, 4:] = 3, 2, 1
    return LabelMap(grid, labels, {1: "bone", 2: "fat", 3: outer})


def with_nerve(voxels: tuple[int | slice, ...]) -> LabelMap:
    labels = post()
    marked = labels.labels.copy()
    marked[voxels] = 4
    return LabelMap(labels.grid, marked, dict(labels.names) | {4: "nerve"})


@pytest.mark.parametrize("name", ["skin", "Skin", "SKIN"])
def test_the_cut_is_found_in_whatever_case_skin_is_written(name: str, latticed, tmp_path: Path) -> None:
    mesh, quality = latticed(post(name))
    assert set(mesh.facets) == {"bone", "skin", "cut"}
    assert mesh.points_mm[mesh.facets["cut"]][:, :, 2] == pytest.approx(SIDE, abs=SHIFT_MM)
    assert (mesh.points_mm[mesh.facets["skin"]][:, :, 2].max(axis=1) < SIDE + SHIFT_MM).all()
    assert not (mesh.points_mm[mesh.facets["skin"]][:, :, 2].min(axis=1) > SIDE - SHIFT_MM).any()
    assert dict(quality.thin)[name] > 0.5  # one cell thick
    assert not any("is called skin" in line for line in Meshed(tmp_path, mesh, quality, Meshing()).summary())


def test_without_a_skin_the_cut_is_told_to_count_as_outer_surface(latticed, tmp_path: Path) -> None:
    mesh, quality = latticed(post("dermis"))
    assert set(mesh.facets) == {"bone", "skin"}
    assert (mesh.points_mm[mesh.facets["skin"]][:, :, 2].min(axis=1) > SIDE - SHIFT_MM).any()
    told = Meshed(tmp_path, mesh, quality, Meshing()).summary()
    assert [line for line in told if "no tissue is named skin" in line and "no surface set 'cut'" in line]


def test_a_tissue_that_vanishes_is_refused(latticed) -> None:
    latticed(with_nerve(np.s_[3:6, 3:6, 6:9]))  # large enough for cubes of 1 mm
    with pytest.raises(MrstrainError, match="no cell of nerve, which is too small for it"):
        latticed(with_nerve(np.s_[3, 3, 6]), cubes=4)


def test_a_tissue_that_loses_a_fifth_is_refused(latticed) -> None:
    sheet = with_nerve(np.s_[4, 2:10, 2:])
    latticed(sheet)
    with pytest.raises(MrstrainError, match=r"nerve has 0\.06 mL in the mesh but 0\.08 mL in the label map"):
        latticed(sheet, cubes=10)


def test_what_is_lost_is_refused_before_the_rest_is_made_larger(latticed) -> None:
    """Bone too; by moving their borders, what is left of a tissue could be given the volume of all of it."""
    whole = post()
    values = whole.labels.copy()
    values[5:7, 5:7, 4:] = 2
    values[5, 5, 4::2] = 1  # single voxels: cubes of 1.2 mm miss most
    with pytest.raises(MrstrainError, match="no cell of bone"):
        latticed(LabelMap(whole.grid, values, whole.names), cubes=10)


def test_the_summary_warns_of_volumes_and_angles(tmp_path: Path) -> None:
    mesh = dome((2, 2, 2))

    def told(fat_ml: float, angle_deg: float) -> list[str]:
        volumes = (("fat", fat_ml, 10.0), ("skin", 5.05, 5.0))
        quality = MeshQuality(48, 27, angle_deg, 150.0, (1.0, 2.0, 3.0), volumes, ())
        return [line for line in Meshed(tmp_path, mesh, quality, Meshing()).summary() if line.startswith("WARNING")]

    assert told(9.7, 4.2) == [
        "WARNING: the volume of fat differs by -3.0 % from the label map.",
        "WARNING: the smallest dihedral angle is 4.2 degrees.",
    ]
    assert told(9.9, 12.0) == []


def with_middles(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Its nodes and those in the middle of its edges, and the ten of each cell, as Abaqus, ANSYS and VTK order them."""
    ends = np.sort(mesh.cells[:, [(0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3)]].reshape(-1, 2), axis=1)
    edges, of_cells = np.unique(ends, axis=0, return_inverse=True)
    points = np.concatenate([mesh.points_mm, mesh.points_mm[edges].mean(axis=1)])
    return points, np.hstack([mesh.cells, len(mesh.points_mm) + of_cells.reshape(-1, 6)])


def ansys(path: Path, mesh: TetMesh, *, quadratic: bool = False) -> None:
    """As CDWRITE writes it: a material for each tissue; components in capitals, of which no two share a name.

    SKIN therefore holds the tissue and the surface elements (SURF154) on it; BONE is a component of nodes. Cells are
    SOLID285, or SOLID187, whose ten nodes take two lines.
    """
    points, cells = with_middles(mesh) if quadratic else (mesh.points_mm, mesh.cells)
    lines = ["/PREP7", f"ET,1,{187 if quadratic else 285}", "ET,2,154"]
    lines += [f"NBLOCK,6,SOLID,{len(points):9d},{len(points):9d}", "(3i9,6e21.13e3)"]
    for number, at in enumerate(points, start=1):
        lines += [f"{number:9d}{0:9d}{0:9d}" + "".join(f"{x:21.13E}" for x in at)]
    lines += ["N,R5.3,LOC,       -1,", "EBLOCK,19,SOLID", "(19i9)"]
    material = np.full(len(mesh.cells), 1)
    material[mesh.regions["skin"]] = 2
    solids = [(1, of, [*cell]) for of, cell in zip(material, cells + 1, strict=True)]
    flat = [(2, 3, [*face, face[-1]]) for face in mesh.facets["skin"] + 1]
    for number, (kind, of, nodes) in enumerate(solids + flat, start=1):
        row = [f"{v:9d}" for v in [of, kind, 1, 1, 0, 0, 0, 0, len(nodes), 0, number, *nodes]]
        lines += ["".join(row[at : at + 19]) for at in range(0, len(row), 19)]
    lines += [f"{-1:9d}"]
    surface = len(mesh.cells) + 1 + np.arange(len(flat))
    for name, kind, members in (
        ("FAT", "ELEM", mesh.regions["fat"] + 1),
        ("SKIN", "ELEM", np.concatenate([mesh.regions["skin"] + 1, surface])),
        ("BONE", "NODE", np.unique(mesh.facets["bone"]) + 1),
    ):
        lines += [f"CMBLOCK,{name:<8},{kind},{len(members):8d}", "(8i10)"]
        lines += ["".join(f"{n:10d}" for n in members[at : at + 8]) for at in range(0, len(members), 8)]
    path.write_text("\n".join([*lines, "FINISH"]) + "\n")


def abaqus(path: Path, mesh: TetMesh, *, quadratic: bool = False) -> None:
    """Sets of nodes for surfaces."""
    points, cells = with_middles(mesh) if quadratic else (mesh.points_mm, mesh.cells)
    lines = ["*NODE"] + [f"{n}, {x!r}, {y!r}, {z!r}" for n, (x, y, z) in enumerate(points.tolist(), start=1)]
    lines += [f"*ELEMENT, TYPE={'C3D10' if quadratic else 'C3D4H'}"]
    lines += [f"{n}, " + ", ".join(map(str, cell)) for n, cell in enumerate((cells + 1).tolist(), start=1)]
    for name, cells in mesh.regions.items():
        lines += [f"*ELSET, ELSET={name.capitalize()}", *(str(c + 1) for c in cells)]
    for name, facets in (("Bone", "bone"), ("SKIN", "skin")):
        lines += [f"*NSET, NSET={name}", *(str(n + 1) for n in np.unique(mesh.facets[facets]))]
    path.write_text("\n".join(lines) + "\n")


def same(one: TetMesh, other: TetMesh) -> None:
    assert np.abs(one.points_mm - other.points_mm).max() < 1e-9
    assert one.cells.tolist() == other.cells.tolist()
    assert set(one.facets) >= {"bone", "skin"}
    for name in ("bone", "skin"):
        faces = [sorted(map(sorted, mesh.facets[name].tolist())) for mesh in (one, other)]
        assert faces[0] == faces[1], name
    regions = [{name.casefold(): sorted(cells) for name, cells in mesh.regions.items()} for mesh in (one, other)]
    assert regions[0] == regions[1]


def test_bone_and_skin_may_be_written_in_any_case(tmp_path: Path) -> None:
    mesh = dome((3, 4, 4))
    write_tet_mesh(tmp_path / "named.vtu", TetMesh(mesh.points_mm, mesh.cells, mesh.regions, {
        "BONE": mesh.facets["bone"], "Skin": mesh.facets["skin"], "Side": mesh.facets["skin"][:2],
    }), {})  # fmt: skip
    ansys(tmp_path / "dome.cdb", mesh)
    abaqus(tmp_path / "dome.inp", mesh)
    for name in ("named.vtu", "dome.cdb", "dome.inp"):
        same(read_tet_mesh(tmp_path / name), mesh)
    assert "Side" in read_tet_mesh(tmp_path / "named.vtu").facets  # others keep theirs


def test_two_surfaces_of_one_name_are_refused(tmp_path: Path) -> None:
    mesh = dome((2, 2, 2))
    facets = dict(mesh.facets) | {"Bone": mesh.facets["bone"]}
    write_tet_mesh(tmp_path / "dome.vtu", TetMesh(mesh.points_mm, mesh.cells, mesh.regions, facets), {})
    with pytest.raises(InputError, match=r"dome\.vtu: two surface sets are named 'bone' \(case is ignored\)"):
        read_tet_mesh(tmp_path / "dome.vtu")


def test_the_summary_tells_the_edge_length_that_was_asked_and_that_of_the_mesh(tmp_path: Path) -> None:
    quality = MeshQuality(48, 27, 20.0, 150.0, (1.25, 2.6, 4.0), (), ())
    finer = Meshing(edge_mm=4.0, finer=Finer("skin", 1.5))
    plain, fine = (Meshed(tmp_path, dome((2, 2, 2)), quality, of).summary()[0] for of in (Meshing(edge_mm=4.0), finer))
    of_mesh = "median of the mesh 2.60 mm (5th to 95th percentile 1.25 to 4.00)"
    assert f"requested edge length 4 mm, {of_mesh}" in plain
    assert f"requested edge length 4 mm (1.5 mm in skin), {of_mesh}" in fine
