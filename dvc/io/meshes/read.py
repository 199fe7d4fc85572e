"""A user's mesh file: every node and cell of it, with the numbers it uses, in LPS mm."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from meshio._common import num_nodes_per_cell

from dvc.arguments import checked
from dvc.arrays import FloatArray, IntArray, frozen
from dvc.errors import GeometryError, ImageFileError, InputError
from dvc.file_names import missing
from dvc.io import StrPath
from dvc.io.meshes.abaqus import read_abaqus
from dvc.io.meshes.ansys import read_ansys
from dvc.io.meshes.calculix import read_frd
from dvc.io.meshes.febio import read_xplt
from dvc.io.meshes.raw import RawMesh
from dvc.io.meshes.through_meshio import read_gmsh, read_vtk
from dvc.mesh import TetMesh, check_extent, checked_indices, checked_points, outer_faces

MM_PER_UNIT = {"mm": 1.0, "m": 1000.0}
TO_LPS = {"LPS": np.array([1.0, 1.0, 1.0]), "RAS": np.array([-1.0, -1.0, 1.0])}  # signs; their own inverse

_VOLUMES = {"tetra": 4, "pyramid": 5, "wedge": 6, "hexahedron": 8}
_CORNERS = {"vertex": 1, "line": 2, "triangle": 3, "quad": 4} | _VOLUMES
_READERS: dict[str, Callable[[Path], RawMesh]] = {
    ".inp": read_abaqus, ".cdb": read_ansys, ".frd": read_frd, ".xplt": read_xplt,
    ".msh": read_gmsh, ".vtu": read_vtk, ".vtk": read_vtk,
}  # fmt: skip


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
        The file's numbers of its nodes; the index from 0 in VTK files, which give none.
    blocks : tuple of CellBlock
        All cells, surfaces and lines too, each block of one ``kind`` (meshio's names: tetra, tetra10 ...) with the
        indices of its cells' ``nodes`` (m, k); cells are counted through all blocks.
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


@checked
def read_mesh(path: StrPath, *, unit: str = "mm", frame: str = "LPS") -> MeshFile:
    """Read a volume mesh: VTU, VTK, Gmsh (.msh 2.2, 4.1), Abaqus (.inp), ANSYS (.cdb), CalculiX (.frd), FEBio (.xplt).

    Parameters
    ----------
    path : path
        The file; its ending gives the format.
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
        If the unit, the frame or the format is not one of those above, or ``path`` is no path.
    ImageFileError
        If the file is missing, damaged, or has no volume cells.
    GeometryError
        If the mesh is not usable; see `dvc.TetMesh`.
    """
    path = Path(path)
    if unit not in [*MM_PER_UNIT]:
        raise InputError(f"The unit of a mesh must be mm or m; got {unit!r}.")
    if frame not in [*TO_LPS]:
        raise InputError(f"The frame of a mesh must be LPS or RAS; got {frame!r}.")
    if path.is_dir():
        raise InputError(f"{path} is a folder; a mesh is one file. Give the file ({', '.join(_READERS)}).")
    if path.suffix.lower() not in _READERS:
        raise InputError(f"{path}: the name of a mesh file must end in {', '.join(_READERS)}.")
    if not path.is_file():
        raise ImageFileError(missing(path, "file"))
    try:
        return _checked(_READERS[path.suffix.lower()](path), unit, frame)
    except (GeometryError, InputError) as error:
        if isinstance(error, ImageFileError):
            raise
        raise type(error)(f"{path}: {error}") from error


def _checked(raw: RawMesh, unit: str, frame: str) -> MeshFile:
    """Bring a mesh to LPS mm, with the checks that are the same whatever its format."""
    path = raw.path
    points = checked_points(raw.points) * MM_PER_UNIT[unit] * TO_LPS[frame]
    blocks = []
    for kind, nodes in raw.blocks:
        if kind.rstrip("0123456789") not in _CORNERS or kind not in num_nodes_per_cell:
            raise ImageFileError(f"{path}: cells of kind {kind!r} are not supported, only {', '.join(_CORNERS)}.")
        index = checked_indices(f"{kind} cells", nodes, len(points), num_nodes_per_cell[kind])
        blocks.append(CellBlock(kind, frozen(index, np.int64)))
    volumes = [block for block in blocks if block.shape in _VOLUMES and len(block.nodes)]
    if not volumes:
        kinds = ", ".join(sorted({block.kind for block in blocks})) or "no cells at all"
        raise ImageFileError(f"{path}: no volume cells (found: {kinds}). Pass the volume mesh, not its surface.")
    check_extent(points[np.unique(np.concatenate([block.nodes.ravel() for block in volumes]))])
    regions = {name: frozen(index, np.int64) for name, index in raw.regions.items() if len(index)}
    tets = _tetrahedra(raw, points, blocks, regions) if all(block.shape == "tetra" for block in volumes) else None
    at_nodes = MappingProxyType({name: frozen(values, np.float64) for name, values in raw.at_nodes.items()})
    points, node_ids = frozen(points, np.float64), frozen(raw.node_ids, np.int64)
    return MeshFile(path, unit, frame, points, node_ids, tuple(blocks), MappingProxyType(regions), tets, at_nodes)


def _tetrahedra(raw: RawMesh, points: FloatArray, blocks: list[CellBlock], regions: Mapping[str, IntArray]) -> TetMesh:
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
    outside = outer_faces(cells) if raw.node_sets else np.empty((0, 3), dtype=np.int64)
    for name, nodes in raw.node_sets.items():
        inside = np.zeros(len(points), dtype=bool)
        inside[nodes] = True
        faces = outside[inside[outside].all(axis=1)]
        if len(faces):
            surfaces.setdefault(name, faces)
    return TetMesh(points, cells, tissues, surfaces, raw.node_ids)
