"""Mesh files with the names of regions and surface sets, readable by ParaView; names of the standard surface sets."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import meshio
import numpy as np

from dvc import TetMesh, read_mesh
from dvc.arguments import checked
from dvc.arrays import FloatArray, IntArray
from dvc.atomic_files import whole_file, write_json
from dvc.errors import InputError
from dvc.mesh import repeated_rows
from dvc.own_files import read_json

BONE, SKIN, CUT = "bone", "skin", "cut"
"""Surface sets: the interface with bone, which is fixed; the outer surface, which the plate may touch; and the
truncation surface, where the label map ends."""

_SAME_PLACE_MM = 1e-6
_FIRST_FACET = 101  # first number of the surface sets in the array "region"; those of tissues begin at 1
_MATERIAL = re.compile(r"material \d+")  # ANSYS also groups cells by material, in addition to components


@checked
def write_tet_mesh(
    path: Path | str, mesh: TetMesh, about: Mapping[str, object] = MappingProxyType({}),
    at_nodes: Mapping[str, FloatArray] | None = None,
) -> None:  # fmt: skip
    """Write a mesh as VTU, LPS mm, and the names of its regions and surface sets in a JSON file next to it.

    Parameters
    ----------
    path : path
        Ending in .vtu: tetrahedra, and the triangles of the surface sets, numbered in the array ``region``. The JSON
        file has the same name; `read_tet_mesh` reads both.
    about : mapping
        Further content of the JSON file, such as how the mesh was made.
    at_nodes : mapping of name to (n,) or (n, k) float, optional
        Point data, for ParaView.

    Raises
    ------
    InputError, OutputError
        If the name does not end in .vtu; if a file cannot be written.
    """
    place = Path(path)
    if place.suffix.lower() != ".vtu":
        raise InputError(f"{place}: meshes are written as VTU; the file name must end in .vtu.")
    blocks, numbers = [("tetra", mesh.cells)], [np.zeros(len(mesh.cells), dtype=np.int64)]
    for number, cells in enumerate(mesh.regions.values(), start=1):
        numbers[0][cells] = number
    for number, rows in enumerate(mesh.facets.values(), start=_FIRST_FACET):
        blocks.append(("triangle", rows))
        numbers.append(np.full(len(rows), number))
    with whole_file(place) as part:
        meshio.vtu.write(part, meshio.Mesh(mesh.points_mm, blocks, at_nodes, {"region": numbers}), binary=True)
    names = [*enumerate(mesh.regions, start=1), *enumerate(mesh.facets, start=_FIRST_FACET)]
    write_json(place.with_suffix(".json"), {"regions": {str(number): name for number, name in names}, **about})


def read_tet_mesh(path: Path | str, *, unit: str = "mm", frame: str = "LPS") -> TetMesh:
    """Read a tetrahedral mesh with its named regions and surface sets, made by mrstrain or another program.

    A JSON file of the same name may name the numbers in the array ``region``. A set of all cells is ignored if others
    contain every cell, and so are the materials of ANSYS if its components do. The surface sets "bone", "skin" and
    "cut" are recognised in upper or lower case (ANSYS writes capitals only).

    Raises
    ------
    InputError
        As `dvc.io.meshes.read.read_mesh`; also for elements other than tetrahedra, or if the names of two surface sets
        differ only in case.
    """
    place = Path(path)
    read = read_mesh(place, unit=unit, frame=frame)
    if read.tets is None:
        raise InputError(f"{place}: simulations need tetrahedra, and this mesh has other cells. Mesh it again.")
    names: dict[str, str] = {}
    names_file = place.with_suffix(".json")
    if names_file.is_file():
        try:
            table = read_json(names_file)["regions"]
            names = {f"region {number}": str(name) for number, name in table.items()}
        except (ValueError, KeyError, AttributeError, TypeError) as damaged:
            what = f"the table of region names is missing or damaged ({damaged})"
            raise InputError(f"{names_file}: {what}. Copy it again, or mesh again.") from damaged
    mesh = read.tets
    regions, count = {names.get(name, name): cells for name, cells in mesh.regions.items()}, len(mesh.cells)
    regions = _without(regions, {name for name, cells in regions.items() if len(cells) == count}, count)
    regions = _without(regions, {name for name in regions if _MATERIAL.fullmatch(name)}, count)
    facets: dict[str, IntArray] = {}
    for name, rows in mesh.facets.items():
        known = names.get(name, name)
        known = known.casefold() if known.casefold() in (BONE, SKIN, CUT) else known
        if known in facets:
            raise InputError(f"{place}: two surface sets are named '{known}' (case is ignored); rename one.")
        facets[known] = rows
    return TetMesh(mesh.points_mm, mesh.cells, regions, facets, mesh.node_ids)


def _without(regions: dict[str, IntArray], names: set[str], cell_count: int) -> dict[str, IntArray]:
    """The regions without ``names``, if the others contain every cell; otherwise all regions."""
    others = {name: cells for name, cells in regions.items() if name not in names}
    held = np.unique(np.concatenate([*others.values(), np.empty(0, dtype=np.int64)]))
    return others if len(held) == cell_count else regions


def fixed_facets(mesh: TetMesh, beside: Sequence[str]) -> tuple[str, ...]:
    """Names of the fixed surface sets, as spelt in the mesh: "bone", and those in ``beside``."""
    spelt = {name.casefold(): name for name in mesh.facets} | {name: name for name in mesh.facets}
    return tuple(dict.fromkeys([BONE, *(spelt.get(name, spelt.get(name.casefold(), name)) for name in beside)]))


def where_open(mesh: TetMesh) -> str:
    """A sentence if nodes of cells coincide, so that the tissue is open there; empty if none do."""
    nodes = np.unique(mesh.cells)
    twice = len(repeated_rows(np.round(mesh.points_mm[nodes] / _SAME_PLACE_MM)))
    told = (
        f"{twice} nodes of the mesh lie where another node lies: there, cells overlap or are not connected. Merge "
        "coincident nodes in the program that made the mesh."
    )
    return told if twice else ""
