"""Results of any finite-element code as a `Deformation`, in any unit and frame.

A result is one file with mesh and displacement (VTU, VTK, Gmsh, CalculiX .frd, FEBio .xplt), or a mesh (also Abaqus
.inp, ANSYS .cdb) and a table of nodal displacements (.csv: node number, and three components).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from dvc import Affine, Grid, MeshFile, TetMesh, read_mesh
from dvc.arguments import checked
from dvc.arrays import FloatArray
from dvc.deformation.nodal import OnMesh
from dvc.errors import GeometryError, InputError, few
from dvc.io.meshes.read import MM_PER_UNIT, TO_LPS
from dvc.mesh import box_told
from dvc.own_files import read_json
from dvc.tables import read_table
from validate.rigid_parts import without_named_parts, without_rigid_parts
from validate.sensitivity import Variant
from validate.tetrahedra import linear_tetrahedra

_NAMES = ("displacement_mm", "displacement", "displacements", "disp", "u")
_NODE_COLUMNS = ("node", "node label", "node number", "node_id", "nodeid", "id")
_COMPONENTS = (
    ("ux_mm", "uy_mm", "uz_mm"),
    ("ux", "uy", "uz"), ("u1", "u2", "u3"), ("u-u1", "u-u2", "u-u3"),
    ("u_x", "u_y", "u_z"), ("u.x", "u.y", "u.z"), ("u.u1", "u.u2", "u.u3"), ("disp_x", "disp_y", "disp_z"),
    ("dx", "dy", "dz"),
)  # fmt: skip
_SCALES = {1.0: "this unit", 1e3: "the unit m"}
_TURNS = {(1.0, 1.0, 1.0): "this frame", (-1.0, -1.0, 1.0): "the other frame (LPS or RAS)"}
_INSIDE = 0.5  # fraction of a mesh's nodes that must lie in the image
_MOST_MM = 200.0


@dataclass(frozen=True, slots=True, eq=False)
class FeResult:
    """Result of a model for one load, on linear tetrahedra in the reference (unloaded) configuration, LPS mm.

    Attributes
    ----------
    name, path : str, path
        Name of the model in tables; and its file, for messages.
    deformation : OnMesh
        Displacement (n, 3) of the mesh's nodes relative to the bone, LPS mm, in the frame of the unloaded image.
    rigid_parts : tuple of str
        Regions of the file that only moved and turned, such as a rigid plate. They are not part of the mesh.
    variants : tuple of Variant
        Solutions with one input changed, from which the input uncertainty of the model is computed.
    """

    name: str
    path: Path
    deformation: OnMesh
    rigid_parts: tuple[str, ...] = ()
    variants: tuple[Variant, ...] = ()

    @classmethod
    @checked
    def of(cls, name: str, deformation: OnMesh, variants: Sequence[Variant] = ()) -> "FeResult":
        """The result of a model in memory, such as ``simulation.deformation("Load1")``, with its name in tables.

        InputError if ``deformation`` is not of the class that `fe.Simulation.deformation` returns.
        """
        return cls(name, Path(name), deformation, variants=tuple(variants))

    @property
    def mesh(self) -> TetMesh:
        """The linear tetrahedra on which it is defined."""
        return self.deformation.mesh


def read_result(
    name: str, path: Path | str, *, mesh: Path | str | None = None, unit: str = "mm", frame: str = "LPS",
    to_image: FloatArray | None = None, leave_out: Sequence[str] = (),
) -> FeResult:  # fmt: skip
    """Read the result of any code for one load; displacement is relative to the bone, which does not move.

    Parameters
    ----------
    name : str
        Name of the model in tables.
    path, mesh : path
        One file with mesh and displacement: VTU, VTK, Gmsh .msh, CalculiX .frd, FEBio .xplt, with an array of three
        components at the nodes named displacement (or displacement_mm, displacements, disp, u). Or a table (.csv) of
        nodal displacements and, as ``mesh``, the mesh of its nodes: these formats, Abaqus .inp, ANSYS .cdb. The table
        has a header, commas, and columns in any order and case: the node number in the mesh file (node, node label,
        node number, node_id, nodeid, id), and three components along x, y, z of the frame (ux, uy, uz; likewise ux_mm,
        u1, u-u1, u_x, u.x, u.u1, disp_x, dx). Other columns are ignored.
    unit, frame : {"mm", "m"}, {"LPS", "RAS"}
        Of coordinates and displacements, whatever the names of the columns. Coordinates are those of the unloaded mesh.
    to_image : (4, 4), optional
        Rigid map of the model's frame to the image's, LPS mm, applied after unit and frame; it also rotates the
        displacement.
    leave_out : sequence of str
        Regions of the file that are no tissue, such as a plate. Rigid ones are left out without being named.

    Raises
    ------
    InputError
        If there is no displacement, it is missing at a node, or it is implausibly large for tissue; if a region to
        leave out is not there, or nothing else is.
    ImageFileError, GeometryError
        As `dvc.io.meshes.read.read_mesh`.
    """
    place = Path(path)
    is_table = place.suffix.lower() == ".csv"
    if is_table and mesh is None:
        raise InputError(f"{place}: a table of displacements also needs the mesh of its nodes: mesh (--model-mesh).")
    source = read_mesh((is_table and mesh) or place, unit=unit, frame=frame)
    u = (_from_table if is_table else _beside_mesh)(place, source) * MM_PER_UNIT[unit] * TO_LPS[frame]
    try:
        tets, carry = linear_tetrahedra(source)
    except GeometryError as error:
        raise GeometryError(f"{source.path}: {error}") from error
    used = np.unique(carry.indices)
    missing = used[~np.isfinite(u[used]).all(axis=1)]
    if len(missing):
        raise InputError(
            f"{place}: {len(missing)} of {len(used)} nodes have no displacement (the first is node "
            f"{source.node_ids[missing[0]]}). Export all nodes of the tissue."
        )
    rigid = _rigid(np.eye(4) if to_image is None else to_image)
    moved = np.asarray(carry @ np.nan_to_num(u)) @ rigid.matrix.T
    largest = float(np.linalg.norm(moved, axis=1).max())
    if largest == 0.0:
        raise InputError(f"{place}: the displacement is 0 everywhere, as in the unloaded state. Export the loaded one.")
    if not largest < _MOST_MM:
        raise InputError(
            f"{place}: the largest displacement is {largest:.3g} mm, which is implausible for tissue under a plate. "
            "Check the unit, and that the last load step was exported."
        )
    names = _names_of_regions(place)
    regions = {names.get(region, region): cells for region, cells in tets.regions.items()}
    tets = TetMesh(rigid.apply(tets.points_mm), tets.cells, regions, tets.facets, tets.node_ids)
    if leave_out:
        try:
            tets, moved = without_named_parts(tets, moved, leave_out)
        except InputError as error:
            raise InputError(f"{place}: {error}") from error
    tets, moved, rigid_parts = without_rigid_parts(tets, moved)
    return FeResult(name, place, OnMesh(tets, moved), rigid_parts)


def _names_of_regions(place: Path) -> dict[str, str]:
    """Names of the numbers in the array ``region``, from the record next to a file that mrstrain wrote."""
    tables = ((place.with_name("simulation.json"), "region_numbers_in_vtu"), (place.with_suffix(".json"), "regions"))
    for file, key in tables:
        try:
            record = read_json(file)
            if table := record.get(key) or record.get("parameters", {}).get(key):
                return {f"region {number}": str(name) for number, name in table.items()}
        except (OSError, ValueError, AttributeError):
            continue
    return {}


def _rigid(matrix: FloatArray) -> Affine:
    affine = np.asarray(matrix, dtype=np.float64)
    turn = affine[:3, :3] if affine.shape == (4, 4) else np.zeros((3, 3))
    proper = np.abs(turn.T @ turn - np.eye(3)).max() < 1e-4 and np.linalg.det(turn) > 0.0
    if not (proper and np.allclose(affine[3], [0.0, 0.0, 0.0, 1.0])):
        raise InputError("The map to the image (to_image) must be a 4 x 4 matrix of a rotation and a translation, mm.")
    return Affine(turn, affine[:3, 3])


def _beside_mesh(place: Path, source: MeshFile) -> FloatArray:
    """Displacement (n, 3) in the unit and frame of the file."""
    if place.suffix.lower() in (".inp", ".cdb"):
        raise InputError(f"{place} contains a mesh but no result; give the table of its nodal displacements (.csv).")
    if place.suffix.lower() == ".frd" and not source.at_nodes:
        raise InputError(f"{place} has no displacements; write them with *NODE FILE, U in CalculiX.")
    if place.suffix.lower() == ".msh" and (np.diff(source.node_ids) <= 0).any():
        raise InputError(
            f"{place}: the nodes are not in the order of their numbers, so displacements may be assigned to wrong "
            "nodes. Write the result as VTU."
        )
    known = {name.casefold(): name for name in source.at_nodes}
    name = next((known[wanted] for wanted in _NAMES if wanted in known), None)
    if name is None:
        has = f"{place} has no displacement at its nodes; its arrays are {few(source.at_nodes, most=4) or 'none'}."
        if place.suffix.lower() == ".xplt":
            raise InputError(
                f'{has} Add <var type="displacement"/> to the <plotfile> of the FEBio model, and run it again.'
            )
        raise InputError(f"{has} Name the array {_NAMES[1]!r}; its unit must be that of the coordinates.")
    values = source.at_nodes[name]
    if place.suffix.lower() == ".xplt" and not values.any():
        raise InputError(
            f"{place}: the displacement in its last state is 0 everywhere, as at time 0: FEBio wrote no loaded state. "
            "See FEBio's log, and set <plot_level>PLOT_MAJOR_ITRS</plot_level> in its <Control>."
        )
    if values.shape != source.points_mm.shape:
        raise InputError(f"{place}: the array '{name}' has shape {values.shape}; three components per node are needed.")
    return values


def _from_table(place: Path, source: MeshFile) -> FloatArray:
    head, rows = read_table(place)
    named = [cell.strip(" '\"") for cell in head]
    node = next((n for n in _NODE_COLUMNS if n in named), None)
    parts = next((c for c in _COMPONENTS if set(c) <= set(named)), None)
    if node is None or parts is None:
        raise InputError(
            f"{place}: a table of displacements needs a column 'node' and three columns such as ux, uy, uz, separated "
            f"by commas; its columns are {few(head)}."
        )
    columns = [named.index(c) for c in (node, *parts)]
    try:
        numbers = np.array([[float(row[c]) for c in columns] for _, row in rows]).reshape(-1, 4)
    except ValueError as error:
        raise InputError(
            f"{place}: a row does not have a node and three numbers ({error}). Export it again."
        ) from error
    index = {int(n): i for i, n in enumerate(source.node_ids)}
    ids = numbers[:, 0].tolist()
    unknown = [n for n in ids if n not in index]
    if unknown or len(set(ids)) < len(ids):
        what = f"node {unknown[0]:.15g}, which {source.path.name} does not have" if unknown else "a node twice"
        raise InputError(f"{place} has {what}; table and mesh do not match. Export both from one model.")
    u = np.full((len(source.node_ids), 3), np.nan)
    u[[index[n] for n in ids]] = numbers[:, 1:]
    return u


def check_overlap(path: Path, mesh: TetMesh, grid: Grid) -> None:
    """Check that a mesh lies in the image.

    Raises
    ------
    GeometryError
        If it does not; with both bounding boxes, and with the unit or frame that would fit, if there is one.
    """

    def lies_in(scale: float, signs: tuple[float, ...]) -> bool:
        return bool(np.mean(grid.contains(mesh.points_mm * scale * np.array(signs))) >= _INSIDE)

    if lies_in(1.0, (1.0, 1.0, 1.0)):
        return
    fitting = [(size, frame) for (a, size), (b, frame) in product(_SCALES.items(), _TURNS.items()) if lies_in(a, b)]
    hint = (
        f"It would fit with {' and '.join(fitting[0])}; check the unit and frame of the model"
        if fitting
        else "Give the rigid map to the frame of the image: to_image (--to-image)"
    )
    raise GeometryError(
        f"{path} does not lie in the image. Model: {box_told(*mesh.bounds_mm)}; image: {box_told(*grid.bounds_mm())} "
        f"(LPS mm). {hint}."
    )
