"""Results on the user's own mesh, in its frame and unit: VTU to look at, CSV of nodal displacements for a solver."""

from collections.abc import Mapping
from pathlib import Path

import meshio
import numpy as np

from dvc.arrays import FloatArray
from dvc.atomic_files import whole_file, write_csv, write_json
from dvc.errors import InputError
from dvc.io import StrPath
from dvc.io.meshes.read import MM_PER_UNIT, TO_LPS, MeshFile
from dvc.io.meshes.through_meshio import silenced
from dvc.trust.verdict import LEVELS, Verdict

VERDICT_FIELD = "verdict_0_trust_1_use_with_care_2_do_not_trust"
"""Name of the field data that tell a measurement's verdict in a VTU file."""


def write_on_mesh(
    path: StrPath, mesh: MeshFile, point_data: Mapping[str, FloatArray], cell_data: Mapping[str, FloatArray],
    verdict: Verdict | None = None,
) -> None:  # fmt: skip
    """Write results on the user's own mesh as a VTU file (binary), in the mesh file's own frame and unit.

    The data, in LPS, have one row for each node of `mesh`, or for each cell through all its blocks. (n,) is a scalar,
    (n, 3) a vector and (n, 3, 3) a tensor, both turned into the mesh's frame (principal values are three scalars, not a
    vector). A name that ends in ``_mm`` is a length: it and the ending of its name are converted to the mesh's unit.
    NaN stays NaN. The nodes' own numbers are added as ``node``, the verdict as field data (`VERDICT_FIELD`).
    """
    path = Path(path)
    _check_name(path, ".vtu", mesh)
    at_nodes = dict(_in_own_frame(mesh, *item, len(mesh.points_mm), "node") for item in point_data.items())
    in_cells = dict(_in_own_frame(mesh, *item, mesh.cell_count, "cell") for item in cell_data.items())
    ends = np.cumsum([len(block.nodes) for block in mesh.blocks])[:-1]
    results = meshio.Mesh(
        _own_points(mesh),
        [(block.kind, block.nodes) for block in mesh.blocks],
        point_data={"node": mesh.node_ids, **at_nodes},
        cell_data={name: np.split(array, ends) for name, array in in_cells.items()},
    )
    with whole_file(path) as part, silenced():
        meshio.vtu.write(part, results, binary=True)
        if verdict is not None:
            # meshio writes no field data, and reads none that are text
            head = f'<DataArray type="Int8" Name="{VERDICT_FIELD}" NumberOfTuples="1" format="ascii">'
            told, grid = f"{head}{LEVELS.index(verdict.level)}</DataArray>", b"<UnstructuredGrid>"
            part.write_bytes(part.read_bytes().replace(grid, grid + f"<FieldData>{told}</FieldData>".encode(), 1))


def write_nodal_displacements(path: StrPath, mesh: MeshFile, u_mm: FloatArray, verdict: Verdict | None = None) -> int:
    """Write the displacement `u_mm` (n, 3; LPS mm) of every node of the user's mesh as CSV, for boundary conditions.

    The columns are ``node,x_mm,y_mm,z_mm,ux_mm,uy_mm,uz_mm``, or ``x_m`` and so on for a mesh in metres: the mesh
    file's own node numbers, frame and unit. A JSON file beside it (same name, ending .json) declares them. Where `u_mm`
    is NaN, the last three columns are empty, not zero; the number of such nodes is returned.
    """
    path = Path(path)
    _check_name(path, ".csv", mesh)
    if np.shape(u_mm) != mesh.points_mm.shape:
        raise InputError(f"u_mm must have shape {mesh.points_mm.shape}, one row per node; got {np.shape(u_mm)}.")
    _, own_u = _in_own_frame(mesh, "u_mm", u_mm, len(u_mm), "node")
    undefined = np.asarray(np.isnan(own_u).any(axis=1))
    columns = ["node", *(f"{axis}_{mesh.unit}" for axis in ("x", "y", "z", "ux", "uy", "uz"))]
    has_numbers = mesh.path.suffix.lower() not in {".vtu", ".vtk"}
    node = "number in the mesh file" if has_numbers else "index in the mesh file, counted from 0"
    missing = int(np.count_nonzero(undefined))
    declared: dict[str, object] = {"mesh": mesh.path.name, "frame": mesh.frame, "unit": mesh.unit, "columns": columns}
    declared |= {"node": node, "nodes": len(own_u), "nodes_without_displacement": missing}
    declared |= {} if verdict is None else {"verdict": verdict.as_dict()}
    at_nodes = zip(mesh.node_ids.tolist(), _own_points(mesh), own_u, undefined, strict=True)
    rows = ([n, *(f"{x:.10g}" for x in X), *("" if bare else f"{x:.10g}" for x in u)] for n, X, u, bare in at_nodes)
    write_csv(path, columns, rows)
    write_json(path.with_suffix(".json"), declared)
    return missing


def _own_points(mesh: MeshFile) -> FloatArray:
    return np.asarray(mesh.points_mm * TO_LPS[mesh.frame] / MM_PER_UNIT[mesh.unit])


def _in_own_frame(mesh: MeshFile, name: str, values: FloatArray, rows: int, what: str) -> tuple[str, FloatArray]:
    """Turn an LPS mm array into the mesh file's frame and unit; its name tells whether it is a length."""
    values = np.asarray(values, dtype=np.float64)
    if values.ndim == 0 or len(values) != rows or values.shape[1:] not in {(), (3,), (3, 3)}:
        raise InputError(
            f"{name!r} must have {rows} rows, one per {what}, each a scalar, a vector (3,) or a tensor (3, 3); "
            f"got shape {values.shape}."
        )
    if name == "node":
        raise InputError("The array name 'node' is reserved for the node numbers; use another name.")
    sign = TO_LPS[mesh.frame]
    if values.ndim == 2:
        values = values * sign
    elif values.ndim == 3:
        values = (values * np.outer(sign, sign)).reshape(rows, 9)
    if name.endswith("_mm"):
        name, values = name.removesuffix("mm") + mesh.unit, values / MM_PER_UNIT[mesh.unit]
    return name, np.ascontiguousarray(values)


def _check_name(path: Path, ending: str, mesh: MeshFile) -> None:
    if path.suffix.lower() != ending:
        raise InputError(f"{path}: the file name must end in {ending}.")
    if path.resolve() == mesh.path.resolve():
        raise InputError(f"{path}: this is the mesh itself; write the results to another file.")
