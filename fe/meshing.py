"""Conforming mesh of linear tetrahedra from a label map, with named tissues and surface sets."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from dvc import Grid, LabelMap, TetMesh
from dvc.arguments import checked
from dvc.arrays import BoolArray, FloatArray, IntArray
from dvc.errors import InputError, MrstrainError, WorkerError
from dvc.mesh import faces_of, signed_volumes
from dvc.worker import Worker, ended_with_parent
from fe.mesh_file import BONE, CUT, SKIN
from fe.slivers import dihedral_angles_deg, without_slivers
from fe.tissue_surfaces import borders_of, labels_at, thinned, with_volumes

_ENVELOPE = 0.2  # of the smallest voxel edge: largest distance of the mesh from the tissue surfaces
_THINNED = 0.05  # of the smallest voxel edge: sum of the errors when nodes are removed from the surfaces
_FARTHEST = 0.1  # of the smallest voxel edge: largest move of a node in one step towards the tissues' volumes
_LONGER = 1.05  # fTetWild makes shorter edges on decimated surfaces: a tenth more cells
_SURE = 0.8
_SECONDS_PER_TRIANGLE, _SECONDS_PER_CELL = 5e-4, 3e-4  # as measured on one core
_MOST_LOST = 0.2  # of a tissue's volume
_ALIGNED = 0.8  # cosine between a face of the skin and the plane of a truncation surface that it continues
_RIM_VOXELS = 6.0  # largest width of the truncated skin
_LEAST_FINER = 0.25  # of a voxel: shorter edges follow nothing in the label map, and fill the memory
_REFINED_MM = 2.0  # spacing of the lattice on which a finer edge length is given

_Lattice = tuple[FloatArray, IntArray, FloatArray]  # points, tetrahedra and the edge length at each point, mm


@dataclass(frozen=True, slots=True)
class MeshQuality:
    """Quality of a mesh.

    Attributes
    ----------
    least_angle_deg, greatest_angle_deg : float
        Of the dihedral angles.
    edge_mm : (5th percentile, median, 95th percentile)
    volumes_ml : tuple of (region, mesh, label map)
    thin : tuple of (region, fraction)
        For regions between two surfaces: fraction of their cells that extend from one to the other.
    """

    cells: int
    nodes: int
    least_angle_deg: float
    greatest_angle_deg: float
    edge_mm: tuple[float, float, float]
    volumes_ml: tuple[tuple[str, float, float], ...]
    thin: tuple[tuple[str, float], ...]


def check_meshing(
    labels: LabelMap, edge_mm: float, bones: Sequence[str], finer: tuple[str, float] | None
) -> dict[str, int]:
    """Check the arguments of `mesh_labels` before it starts; return the numbers of the label map's regions.

    Raises
    ------
    InputError
        If an edge length is out of range, a region is not in the label map, or no soft tissue is left.
    """
    spacing = float(labels.grid.spacing_mm.min())
    if not 0.5 * spacing <= edge_mm <= 20.0:
        raise InputError(
            f"The edge length must be between half a voxel ({0.5 * spacing:g} mm) and 20 mm; got {edge_mm} mm."
        )
    if finer is not None and not _LEAST_FINER * spacing <= finer[1] < edge_mm:
        raise InputError(
            f"The finer edge length must be between a quarter of a voxel ({_LEAST_FINER * spacing:g} mm) and {edge_mm} "
            f"mm; got {finer[1]} mm."
        )
    there = set(np.unique(labels.labels).tolist())
    numbers = {name: number for number, name in labels.names.items() if number in there}
    if not bones:
        raise labels.no_region("bone")
    for name in (*bones, *((finer[0],) if finer else ())):
        if name not in numbers:
            raise labels.no_region(name)
    if not numbers.keys() - set(bones):
        raise InputError(f"The label map has no soft tissue to mesh, only bone ({', '.join(bones)}).")
    return numbers


@checked
def mesh_labels(
    labels: LabelMap, edge_mm: float, *, bones: Sequence[str] = ("bone",), finer: tuple[str, float] | None = None,
    limit_s: float = 3600.0, watch: Callable[[float], None] = lambda _: None,
) -> tuple[TetMesh, MeshQuality]:  # fmt: skip
    """Mesh the soft tissues of a label map.

    Parameters
    ----------
    edge_mm : float
        Target edge length, mm. Thin tissues get shorter edges.
    bones : sequence of str
        Regions that are cut out; their surface is named "bone".
    finer : (region, edge in mm), optional
        Another edge length in and near one region: 1 mm in a skin of 2 mm makes it two cells thick.
    limit_s : float
        Time after which meshing is stopped, s.
    watch : callable
        Called about twice a second with the fraction done. It is estimated from the sizes, because the mesher reports
        no progress.

    Returns
    -------
    mesh : TetMesh
        LPS mm, with a region for each soft tissue, and the surface sets "bone", "skin" (the outer surface) and "cut"
        (the truncation surface, where the label map ends: outer faces of tissues other than skin, and the cross section
        of the skin there). Without a region named skin (in any case), there is no "cut", and all outer faces are
        "skin".
    quality : MeshQuality

    Raises
    ------
    InputError
        As from `check_meshing`.
    MrstrainError
        If a tissue is missing in the mesh or lost a fifth of its volume, or if meshing took too long.

    Notes
    -----
    Tissue surfaces are decimated where they are flat (`fe.tissue_surfaces.thinned`). The tetrahedra are made by
    fTetWild (Hu and others 2020, doi:10.1145/3386569.3392385), within a fifth of a voxel of these surfaces. The
    surfaces are then moved by at most three tenths of a voxel until each region has the volume of its voxels
    (`fe.tissue_surfaces`). Nodes of cells with dihedral angles under 12 degrees are moved until there are none or no
    move helps. Meshes differ slightly from run to run: keep the mesh, and its hash, with the results computed on it.
    """
    numbers = check_meshing(labels, edge_mm, bones, finer)
    soft = {name: number for name, number in numbers.items() if name not in bones}
    spacing = float(labels.grid.spacing_mm.min())
    borders = borders_of(labels)
    lattice = None if finer is None else _lattice(labels, numbers[finer[0]], edge_mm, finer[1])
    surface = thinned(borders, _THINNED * spacing)
    points, cells = _limited(surface, edge_mm, _ENVELOPE * spacing, lattice, limit_s, watch)
    cell_labels = labels_at(labels, borders, points[cells].mean(axis=1))
    body = np.isin(cell_labels, list(soft.values()))
    voxel_mm3 = labels.grid.voxel_volume_mm3
    volumes_mm3 = {number: voxel_mm3 * float((labels.labels == number).sum()) for number in numbers.values()}
    _refuse_lost(numbers, volumes_mm3, np.abs(signed_volumes(points[cells])), cell_labels)
    points = with_volumes(points, cells, cell_labels, volumes_mm3, _FARTHEST * spacing)
    points = without_slivers(points, cells[body], cell_labels[body])
    mesh = _named(points, cells, cell_labels, soft, [numbers[b] for b in bones], labels)
    return mesh, _quality(mesh, labels, soft)


def self_test() -> str:
    """Mesh a small ball around a bone; return a sentence with the result, for `mrstrain doctor`."""
    grid = Grid((12, 12, 12), np.ones(3), np.full(3, -5.5))
    radius = np.linalg.norm(grid.points(), axis=-1)
    labels = LabelMap(grid, (radius < 5.0) + (radius < 2.5).astype(np.int64), {1: "fat", 2: "bone"})
    _, quality = mesh_labels(labels, 2.0, limit_s=600.0)  # takes seconds; beside other programs, more than a minute
    return f"meshed a ball with {quality.cells} cells"


def _refuse_lost(
    numbers: dict[str, int], volumes_mm3: dict[int, float], of_cells: FloatArray, cell_labels: IntArray
) -> None:
    """MrstrainError if a region, bones included, is missing in the mesh or lost a fifth of its volume."""
    instead = "Use a shorter edge length, or merge its label with a neighbouring tissue."
    lost = [name for name, number in numbers.items() if not (cell_labels == number).any()]
    if lost:
        raise MrstrainError(f"The mesh has no cell of {', '.join(lost)}, which is too small for it. {instead}")
    for name, number in numbers.items():
        made, given = float(of_cells[cell_labels == number].sum()) / 1000.0, volumes_mm3[number] / 1000.0
        if abs(made - given) > _MOST_LOST * given:
            raise MrstrainError(
                f"{name} has {made:.2f} mL in the mesh but {given:.2f} mL in the label map: it is too thin for the "
                f"mesh or for the voxels. {instead}"
            )


def _guessed(share: float) -> float:
    """Fraction done after a fraction of the expected time; beyond it, it approaches 1 slowly."""
    return share if share < _SURE else 1.0 - (1.0 - _SURE) * _SURE / share


def _limited(
    surface: tuple[FloatArray, IntArray], edge_mm: float, envelope_mm: float, lattice: _Lattice | None, limit_s: float,
    watch: Callable[[float], None],
) -> tuple[FloatArray, IntArray]:  # fmt: skip
    """Tetrahedra of the whole box, made in a separate process that is ended at the time limit."""
    began = time.monotonic()
    points_mm, triangles = surface
    box_mm3 = float(np.prod(np.ptp(points_mm, axis=0)))
    expected = _SECONDS_PER_TRIANGLE * len(triangles) + _SECONDS_PER_CELL * box_mm3 / (0.12 * edge_mm**3)
    with Worker(threads=1) as worker:
        over = threading.Timer(limit_s, worker.kill)
        over.start()
        try:
            return worker.run(
                "meshing", _tetrahedra, points_mm, triangles, edge_mm, envelope_mm, lattice,
                watch=lambda: watch(_guessed((time.monotonic() - began) / expected)),
            )  # fmt: skip
        except WorkerError as ended:
            if time.monotonic() - began >= limit_s:
                raise MrstrainError(
                    f"Meshing was stopped at its time limit of {limit_s:.0f} s. Use a longer edge length, remove "
                    "specks and holes of a few voxels from the label map (they take most time), or raise the limit."
                ) from ended
            raise
        finally:
            over.cancel()


def _tetrahedra(
    points_mm: FloatArray, triangles: IntArray, edge_mm: float, envelope_mm: float, lattice: _Lattice | None
) -> tuple[FloatArray, IntArray]:
    import pytetwild

    size = float(np.linalg.norm(np.ptp(points_mm, axis=0)))
    names = ("bg_vertices", "bg_tets", "bg_values")
    finer = {} if lattice is None else dict(zip(names, lattice, strict=True))
    with ended_with_parent():
        points, cells = pytetwild.tetrahedralize(
            points_mm, triangles.astype(np.int32), edge_length_abs=_LONGER * edge_mm, epsilon=envelope_mm / size,
            disable_filtering=True, num_threads=1, vtk_ordering=True, quiet=True, **finer,
        )  # fmt: skip
    return np.asarray(points), np.asarray(cells, dtype=np.int64)


def _lattice(labels: LabelMap, label: int, edge_mm: float, finer_mm: float) -> _Lattice:
    """Edge lengths on a lattice of tetrahedra: ``finer_mm`` in a region, increasing to ``edge_mm`` away from it."""
    from scipy.ndimage import distance_transform_edt

    grid = labels.grid
    inside, steps = np.argwhere(labels.labels), _REFINED_MM / grid.spacing_mm
    away = distance_transform_edt(labels.labels != label, sampling=grid.spacing_mm)
    ends = inside.min(axis=0) - 2, inside.max(axis=0) + 3 + steps
    axes = [np.arange(low, high, step) for low, high, step in zip(*ends, steps, strict=True)]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    nearest = np.clip(np.round(at), 0, np.array(grid.shape) - 1).astype(int)
    distance = away[tuple(np.moveaxis(nearest, -1, 0))]
    values = np.clip(finer_mm + 0.3 * np.maximum(distance - _REFINED_MM, 0.0), finer_mm, edge_mm)
    points = (at.reshape(-1, 3) * grid.spacing_mm) @ grid.direction.T + grid.origin_mm
    number = np.arange(len(axes[0]) * len(axes[1]) * len(axes[2])).reshape([len(a) for a in axes])
    corner = [number[i : number.shape[0] - 1 + i, j : number.shape[1] - 1 + j, k : number.shape[2] - 1 + k].ravel()
              for i in (0, 1) for j in (0, 1) for k in (0, 1)]  # fmt: skip
    # Kuhn's six tetrahedra around the cube's diagonal
    paths = [(0, a, b, 7) for a, b in ((1, 3), (1, 5), (2, 3), (2, 6), (4, 5), (4, 6))]
    cells = np.concatenate([np.column_stack([corner[c] for c in path]) for path in paths])
    return points, cells.astype(np.int32), values.ravel()


def _named(
    points: FloatArray, cells: IntArray, cell_labels: IntArray, soft: dict[str, int], bones: list[int], labels: LabelMap
) -> TetMesh:
    kept = np.isin(cell_labels, list(soft.values()))
    body, tissue = cells[kept], cell_labels[kept]
    faces = faces_of(body)
    _, first, count = np.unique(faces, axis=0, return_index=True, return_counts=True)
    outer = first[count == 1]
    triangles, owner = faces[outer], np.tile(tissue, 4)[outer]
    bone_faces = faces_of(cells[np.isin(cell_labels, bones)])
    which = np.unique(np.concatenate([bone_faces, triangles]), axis=0, return_inverse=True)[1].ravel()
    at_bone = np.isin(which[len(bone_faces) :], which[: len(bone_faces)])
    free: BoolArray = np.logical_not(at_bone)
    cut = np.zeros(len(triangles), dtype=bool)
    if skins := [number for name, number in soft.items() if name.casefold() == SKIN]:
        cut = free & np.isin(owner, skins, invert=True)
        cut |= _rim(points, triangles, free & np.logical_not(cut), cut, labels)
    facets = {BONE: triangles[at_bone], SKIN: triangles[free & ~cut], CUT: triangles[cut]}
    regions = {name: np.flatnonzero(tissue == number) for name, number in soft.items()}
    return TetMesh(points, body, regions, {name: rows for name, rows in facets.items() if len(rows)})


def _rim(points: FloatArray, triangles: IntArray, asked: BoolArray, cut: BoolArray, labels: LabelMap) -> BoolArray:
    """Faces of the skin that continue the plane of a truncation surface: the cross section of the skin."""
    if not cut.any() or not asked.any():
        return np.zeros(len(triangles), dtype=bool)
    corners = points[triangles]
    centre = corners.mean(axis=1)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    voxel = float(labels.grid.spacing_mm.max())
    rim = np.zeros(len(triangles), dtype=bool)
    tree, planes = cKDTree(centre[cut]), normal[cut]
    _, nearest = tree.query(centre[asked], k=min(8, len(planes)))
    # Plane of the section: the mean of the nearest faces of the truncation surface, whatever their orientation.
    nearest = nearest.reshape(int(asked.sum()), -1)
    around = planes[nearest]
    around *= np.sign(np.einsum("fki,fi->fk", around, around[:, 0]))[..., None]
    plane = around.mean(axis=1)
    plane /= np.linalg.norm(plane, axis=1, keepdims=True)
    offset = np.einsum("fi,fi->f", plane, centre[asked] - centre[cut][nearest].mean(axis=1))
    aligned = np.abs(np.einsum("fi,fi->f", plane, normal[asked])) > _ALIGNED
    close = np.linalg.norm(centre[asked] - centre[cut][nearest[:, 0]], axis=1) < _RIM_VOXELS * voxel
    rim[asked] = aligned & close & (np.abs(offset) < voxel)
    return rim


def _quality(mesh: TetMesh, labels: LabelMap, soft: dict[str, int]) -> MeshQuality:
    angles = dihedral_angles_deg(mesh.points_mm[mesh.cells])
    ends = [mesh.points_mm[mesh.cells[:, i]] - mesh.points_mm[mesh.cells[:, j]] for i in range(4) for j in range(i)]
    low, middle, high = np.percentile(np.linalg.norm(np.concatenate(ends), axis=1), [5, 50, 95])
    voxel_ml = labels.grid.voxel_volume_mm3 / 1000.0
    volumes = tuple(
        (name, float(mesh.volumes_mm3[mesh.regions[name]].sum()) / 1000.0, voxel_ml * float((labels.labels == n).sum()))
        for name, n in soft.items()
    )
    thin = []
    for skin in mesh.regions:
        if skin.casefold() == SKIN and SKIN in mesh.facets:
            cells, beneath = mesh.cells[mesh.regions[skin]], np.delete(mesh.cells, mesh.regions[skin], axis=0)
            across = [np.isin(cells, nodes).any(axis=1) for nodes in (mesh.facets[SKIN], beneath)]
            thin.append((skin, float((across[0] & across[1]).mean())))
    return MeshQuality(
        len(mesh.cells), len(mesh.points_mm), float(angles.min()), float(angles.max()),
        (float(low), float(middle), float(high)), volumes, tuple(thin),
    )  # fmt: skip
