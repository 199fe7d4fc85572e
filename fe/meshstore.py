"""Meshes made here, kept as files that ParaView opens and that are read back with every name."""

from __future__ import annotations

import json
from pathlib import Path

import meshio
import numpy as np

from dvc.errors import InputError
from dvc.mesh import TetMesh
from dvc.meshfile import read_mesh
from dvc.whole import whole_file, write_whole

_FIRST_FACET = 101  # numbers of facets in the array "region"; those of tissues begin at 1


def write_tet_mesh(path: Path, mesh: TetMesh, about: dict[str, object]) -> None:
    """Write a mesh as VTU, LPS mm: tetrahedra and named triangles, numbered in ``region``.

    The names, and what is told ``about`` it, stand in a JSON file of the same name.
    """
    tissues = {name: number for number, name in enumerate(mesh.regions, start=1)}
    facets = {name: number for number, name in enumerate(mesh.facets, start=_FIRST_FACET)}
    number = np.zeros(len(mesh.cells), dtype=np.int64)
    for name, cells in mesh.regions.items():
        number[cells] = tissues[name]
    triangles = np.concatenate([*mesh.facets.values(), np.empty((0, 3), dtype=np.int64)])
    flat = np.repeat(list(facets.values()), [len(rows) for rows in mesh.facets.values()]).astype(np.int64)
    blocks = [("tetra", mesh.cells)] + ([("triangle", triangles)] if len(triangles) else [])
    numbers = [number] + ([flat] if len(triangles) else [])
    with whole_file(path) as part:
        meshio.vtu.write(part, meshio.Mesh(mesh.points_mm, blocks, cell_data={"region": numbers}), binary=True)
    names = {str(number): name for named in (tissues, facets) for name, number in named.items()}
    write_whole(_names_of(path), json.dumps({"regions": names} | about, indent=2) + "\n")


def read_tet_mesh(path: Path | str, *, unit: str = "mm", frame: str = "LPS") -> TetMesh:
    """Read a mesh of tetrahedra with its named regions and facets, made here or elsewhere.

    Where a JSON file of the same name tells the names of the numbers in the array ``region``, they are used. A set of
    all cells is left out where others divide them.

    Raises
    ------
    InputError
        If it cannot be used: as `dvc.meshfile.read_mesh`, or for elements other than tetrahedra.
    """
    place = Path(path)
    read = read_mesh(place, unit=unit, frame=frame)
    if read.tets is None:
        raise InputError(f"{place}: the simulation takes tetrahedra; this mesh has cells of other shapes.")
    names: dict[str, str] = {}
    if _names_of(place).is_file():
        try:
            told = json.loads(_names_of(place).read_text(encoding="utf-8"))["regions"]
            names = {f"region {number}": str(name) for number, name in told.items()}
        except (ValueError, KeyError, AttributeError, TypeError) as damaged:
            raise InputError(f"{_names_of(place)}: no table of regions in it ({damaged}).") from damaged
    mesh = read.tets
    regions = {names.get(name, name): cells for name, cells in mesh.regions.items()}
    parts = {name: cells for name, cells in regions.items() if len(cells) < len(mesh.cells)}
    if parts and len(np.unique(np.concatenate(list(parts.values())))) == len(mesh.cells):
        regions = parts  # a set of all elements beside those of the tissues
    return TetMesh(
        mesh.points_mm,
        mesh.cells,
        regions,
        {names.get(name, name): rows for name, rows in mesh.facets.items()},
        mesh.node_ids,
    )


def _names_of(path: Path) -> Path:
    return path.with_suffix(".json")
