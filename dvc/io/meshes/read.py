"""A user's mesh file: every node and cell of it, with the numbers it uses, in LPS mm."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import meshio
import numpy as np
from meshio._mesh import topological_dimension

from dvc.arrays import FloatArray, IntArray, frozen
from dvc.errors import GeometryError, ImageFileError, InputError
from dvc.io.meshes.abaqus import read_abaqus
from dvc.io.meshes.ansys import read_ansys
from dvc.io.meshes.calculix import read_frd
from dvc.io.meshes.febio import read_xplt
from dvc.io.meshes.gmsh import gmsh_group_names, gmsh_node_numbers, in_vtk_order, with_names_apart
from dvc.mesh import TetMesh, check_extent, checked_indices, checked_points, outer_faces

_log = logging.getLogger("dvc.io.meshes.read")

MM_PER_UNIT = {"mm": 1.0, "m": 1000.0}
TO_LPS = {"LPS": np.array([1.0, 1.0, 1.0]), "RAS": np.array([-1.0, -1.0, 1.0])}  # signs; their own inverse

_VOLUMES = {"tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
_CORNERS = {"vertex": 1, "line": 2, "triangle": 3, "quad": 4} | _VOLUMES
_DIMENSION = {"vertex": 0, "line": 1, "triangle": 2, "quad": 2} | dict.fromkeys(_VOLUMES, 3)
# Cell arrays of VTK files that hold a region's number, in the order in which they are looked for.
_REGION_ARRAYS = ("region", "regions", "label", "labels", "tissue", "material", "materialids", "part", "part_id")
_MOST_REGIONS = 256
# meshio 5.3.5 reads and writes these cells, but has left them out of its own table of dimensions, and fails on them.
topological_dimension.update({"wedge15": 3, "pyramid13": 3})


@dataclass(frozen=True, slots=True, eq=False)
class CellBlock:
    """Cells of one ``kind``, in meshio's names (tetra10 ...), by the indices of their ``nodes`` (m, k)."""

    kind: str
    nodes: IntArray

    @property
    def shape(self) -> str:
        """The kind without its order: tetra for tetra10."""
        return self.kind.rstrip("0123456789")

    @property
    def corners(self) -> IntArray:
        """The corner nodes, (m, 4) for tetrahedra of any order."""
        return self.nodes[:, : _CORNERS[self.shape]]


@dataclass(frozen=True, slots=True, eq=False)
class MeshFile:
    """A mesh as its file has it, whatever its elements: every node, every cell.

    Attributes
    ----------
    path : Path
        The file.
    unit, frame : str
        The file's own: "mm" or "m", "LPS" or "RAS".
    points_mm : (n, 3)
        All nodes, mid-side nodes too, LPS mm.
    node_ids : (n,) int
        The file's numbers of its nodes (Gmsh, Abaqus); the index from 0 in VTK files, which give none.
    blocks : tuple of CellBlock
        All cells, surfaces and lines too; cells are counted through all blocks.
    regions : mapping of str to (k,) int
        Indices of the cells in each named set.
    tets : TetMesh or None
        The tetrahedra by their corner nodes, checked, with the regions that hold tetrahedra and, as facets,
        those that hold triangles. None where the file has volume cells of other shapes.
    at_nodes : mapping of str to (n, ...)
        Arrays at the nodes, such as a displacement, in the file's own unit and frame.
    """

    path: Path
    unit: str
    frame: str
    points_mm: FloatArray
    node_ids: IntArray
    blocks: tuple[CellBlock, ...]
    regions: Mapping[str, IntArray]
    tets: TetMesh | None
    at_nodes: Mapping[str, FloatArray]

    @property
    def cell_count(self) -> int:
        """Number of cells in all blocks."""
        return sum(len(block.nodes) for block in self.blocks)

    @property
    def centroids_mm(self) -> FloatArray:
        """Mean of each cell's corner nodes, (cells, 3) LPS mm, through all blocks."""
        return np.concatenate([self.points_mm[block.corners].mean(axis=1) for block in self.blocks])

    @property
    def bounds_mm(self) -> FloatArray:
        """Least and greatest coordinates of the nodes, (2, 3) LPS mm."""
        return np.stack([self.points_mm.min(axis=0), self.points_mm.max(axis=0)])


def read_mesh(path: str | os.PathLike[str], *, unit: str = "mm", frame: str = "LPS") -> MeshFile:
    """Read a volume mesh: VTU, VTK, Gmsh (.msh 2.2, 4.1), Abaqus (.inp), ANSYS (.cdb), CalculiX (.frd), FEBio (.xplt).

    Parameters
    ----------
    path : path
        The file; its ending tells the format.
    unit : {"mm", "m"}
        Unit of length of the file's coordinates.
    frame : {"LPS", "RAS"}
        Frame of the file's coordinates: DICOM, ITK and Slicer's own files are LPS, NIfTI-based tools RAS.

    Returns
    -------
    MeshFile
        With regions from Abaqus element sets, ANSYS components and materials, FEBio's parts, Gmsh physical groups, or,
        in VTK files, a cell array of whole numbers called region, label, tissue, material or part. Sets of nodes
        (Abaqus, ANSYS) become facets: the triangles on the outside of the tetrahedra whose corners are all in the set.

    Raises
    ------
    InputError
        If the unit, the frame or the format is not one of those above.
    ImageFileError
        If the file is missing, damaged, or has no volume cells.
    GeometryError
        If the mesh is not usable; see `dvc.mesh.TetMesh`.
    """
    path = Path(path)
    if unit not in MM_PER_UNIT:
        raise InputError(f"The unit of a mesh is mm or m; got {unit!r}.")
    if frame not in TO_LPS:
        raise InputError(f"The frame of a mesh is LPS or RAS; got {frame!r}.")
    readers: dict[str, Callable[[Path], _Raw]] = {
        ".inp": _from_abaqus, ".cdb": _from_ansys, ".frd": _from_frd, ".xplt": _from_xplt,
        ".msh": _from_gmsh, ".vtu": _from_vtk, ".vtk": _from_vtk,
    }  # fmt: skip
    if path.suffix.lower() not in readers:
        raise InputError(f"{path}: a mesh is a file ending in {', '.join(readers)}; got {path.suffix!r}.")
    if not path.is_file():
        raise ImageFileError(f"{path}: there is no such file.")
    try:
        return _checked(path, unit, frame, readers[path.suffix.lower()](path))
    except (GeometryError, InputError) as error:
        if isinstance(error, ImageFileError):
            raise
        raise type(error)(f"{path}: {error}") from error


@dataclass(slots=True)
class _Raw:
    points: Any
    node_ids: IntArray
    blocks: list[tuple[str, Any]]
    regions: dict[str, IntArray]
    node_sets: dict[str, IntArray] = field(default_factory=dict)
    at_nodes: Mapping[str, Any] = field(default_factory=dict)


def _from_abaqus(path: Path) -> _Raw:
    mesh = read_abaqus(path)
    return _Raw(mesh.points, mesh.node_ids, list(mesh.blocks), mesh.sets, mesh.node_sets)


def _from_ansys(path: Path) -> _Raw:
    mesh = read_ansys(path)
    return _Raw(mesh.points, mesh.node_ids, list(mesh.blocks), mesh.sets, mesh.node_sets)


def _from_frd(path: Path) -> _Raw:
    found = read_frd(path)
    moved = {} if found.displacement is None else {"displacement": found.displacement}
    return _Raw(found.points, found.node_ids, list(found.blocks), found.materials, at_nodes=moved)


def _from_xplt(path: Path) -> _Raw:
    found = read_xplt(path)
    moved = {} if found.displacement is None else {"displacement": found.displacement}
    return _Raw(found.points, found.node_ids, list(found.blocks), found.parts, at_nodes=moved)


def _from_gmsh(path: Path) -> _Raw:
    names = gmsh_group_names(path)
    with with_names_apart(path, names) as (place, real):
        mesh = _by_meshio(path, lambda _: meshio.gmsh.read(str(place)))
    blocks = [(block.type, in_vtk_order(block.type, block.data)) for block in mesh.cells]
    sizes = [len(data) for _, data in blocks]
    groups: list[tuple[str, IntArray]] = []
    if "gmsh:physical" in mesh.cell_data:
        tag = np.concatenate(mesh.cell_data["gmsh:physical"])
        dimension = np.repeat([_DIMENSION.get(kind.rstrip("0123456789"), -1) for kind, _ in blocks], sizes)
        for d, t in np.unique(np.column_stack([dimension, tag])[tag != 0], axis=0).tolist():
            groups.append((names.get((d, t), f"physical {t}"), np.flatnonzero((dimension == d) & (tag == t))))
    starts = np.cumsum([0, *sizes])[:-1]
    for name, parts in mesh.cell_sets.items():  # version 4.1, where a cell may be in several groups
        if not name.startswith("gmsh:"):
            if len(parts) != len(starts):
                raise ImageFileError(f"{path}: its $Elements section is cut short.")
            found = [np.asarray(part, dtype=np.int64) for part in parts]
            cells = np.concatenate([part + start for part, start in zip(found, starts, strict=True)])
            groups.append((real[name], cells))
    regions: dict[str, IntArray] = {}
    for name, cells in groups:  # a volume and its surface may share a name: their cells are told apart by their shape
        regions[name] = np.union1d(regions.get(name, np.empty(0, dtype=np.int64)), cells)
    return _Raw(mesh.points, gmsh_node_numbers(path, len(mesh.points)), blocks, regions, at_nodes=mesh.point_data)


def _from_vtk(path: Path) -> _Raw:
    mesh = _by_meshio(path, meshio.vtu.read if path.suffix.lower() == ".vtu" else meshio.vtk.read)
    regions: dict[str, IntArray] = {}
    arrays = {name.casefold(): name for name in mesh.cell_data}
    for wanted in _REGION_ARRAYS:
        if wanted in arrays:
            values = np.concatenate(mesh.cell_data[arrays[wanted]])
            values = values[:, 0] if values.shape[1:] == (1,) else values  # as legacy VTK has scalars
            numbers = np.unique(values)
            if values.ndim == 1 and len(numbers) <= _MOST_REGIONS and np.all(numbers == np.round(numbers)):
                regions = {f"{arrays[wanted]} {int(n)}": np.flatnonzero(values == n) for n in numbers}
                break
    blocks = [(block.type, block.data) for block in mesh.cells]
    return _Raw(mesh.points, np.arange(len(mesh.points)), blocks, regions, at_nodes=mesh.point_data)


def _by_meshio(path: Path, read: Callable[[str], Any]) -> Any:
    with silenced() as said, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            return read(str(path))
        except Exception as error:
            # meshio meets damaged files with whatever Python raises: KeyError, ValueError, IndexError ...
            reason = " ".join(f"{type(error).__name__}: {error} {said.getvalue()}".split())
            raise ImageFileError(
                f"{path} cannot be read as a mesh ({reason}). It is damaged, or of a variant that is not "
                "read; write it again as VTU."
            ) from error


@contextlib.contextmanager
def silenced() -> Iterator[io.StringIO]:
    """Keep what meshio prints off the terminal, and log it."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        yield said
    if said.getvalue().strip():
        _log.info("meshio: %s", " ".join(said.getvalue().split()))


def _checked(path: Path, unit: str, frame: str, raw: _Raw) -> MeshFile:
    points = checked_points(raw.points) * MM_PER_UNIT[unit] * TO_LPS[frame]
    blocks = []
    for kind, nodes in raw.blocks:
        corners = _CORNERS.get(kind.rstrip("0123456789"))
        if corners is None:
            raise ImageFileError(f"{path}: cells of kind {kind!r} are not read, only {', '.join(_CORNERS)}.")
        if np.ndim(nodes) != 2 or np.shape(nodes)[1] < corners:
            raise ImageFileError(f"{path}: {kind} cells have {np.shape(nodes)} nodes; the file is cut short.")
        index = checked_indices(f"{kind} cells", nodes, len(points), np.shape(nodes)[1])
        blocks.append(CellBlock(kind, frozen(index, np.int64)))
    volumes = [block for block in blocks if block.shape in _VOLUMES]
    if not volumes:
        found = ", ".join(sorted({block.kind for block in blocks})) or "no cells at all"
        raise ImageFileError(
            f"{path} holds no volume cells (found: {found}). Results are given in the tissue: hand over the "
            "volume mesh, not its surface."
        )
    check_extent(points[np.unique(np.concatenate([block.nodes.ravel() for block in volumes]))])
    regions = {name: frozen(index, np.int64) for name, index in raw.regions.items() if len(index)}
    tets = None
    if all(block.shape == "tetra" for block in volumes):
        tets = _tetrahedra(points, raw.node_ids, blocks, regions, raw.node_sets)
    return MeshFile(
        path=path,
        unit=unit,
        frame=frame,
        points_mm=frozen(points, np.float64),
        node_ids=frozen(raw.node_ids, np.int64),
        blocks=tuple(blocks),
        regions=MappingProxyType(regions),
        tets=tets,
        at_nodes=MappingProxyType({name: frozen(values, np.float64) for name, values in raw.at_nodes.items()}),
    )


def _tetrahedra(
    points: FloatArray,
    node_ids: IntArray,
    blocks: list[CellBlock],
    regions: Mapping[str, IntArray],
    node_sets: Mapping[str, IntArray],
) -> TetMesh:
    shape = np.repeat([block.shape for block in blocks], [len(block.nodes) for block in blocks])

    def gathered(wanted: str) -> tuple[IntArray, IntArray]:
        of_shape = [block.corners for block in blocks if block.shape == wanted]
        corners = np.concatenate(of_shape) if of_shape else np.empty((0, 3), dtype=np.int64)
        return corners, np.cumsum(shape == wanted) - 1  # row of ``corners`` of each cell of the shape

    cells, tet_row = gathered("tetra")
    triangles, triangle_row = gathered("triangle")
    tissues, surfaces = {}, {}
    for name, index in regions.items():
        solid, flat = index[shape[index] == "tetra"], index[shape[index] == "triangle"]
        if len(solid):
            tissues[name] = tet_row[solid]
        if len(flat):
            surfaces[name] = triangles[triangle_row[flat]]
    outside = outer_faces(cells) if node_sets else np.empty((0, 3), dtype=np.int64)
    for name, nodes in node_sets.items():
        inside = np.zeros(len(points), dtype=bool)
        inside[nodes] = True
        faces = outside[inside[outside].all(axis=1)]
        if len(faces):
            surfaces.setdefault(name, faces)
    return TetMesh(points, cells, tissues, surfaces, node_ids)
