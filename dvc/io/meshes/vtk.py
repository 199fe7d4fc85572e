"""VTU and legacy VTK files: cells, a cell array that numbers the regions, arrays at the nodes."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np

from dvc.arrays import IntArray
from dvc.io.meshes.raw import RawMesh, read_through_meshio

# Cell arrays that hold a region's number, in the order in which they are looked for.
_REGION_ARRAYS = ("region", "regions", "label", "labels", "tissue", "material", "materialids", "part", "part_id")
_MOST_REGIONS = 256


def read_vtk(path: Path) -> RawMesh:
    """Read a .vtu or .vtk file; its nodes have no numbers and are counted from 0."""
    mesh = read_through_meshio(path, meshio.vtu.read if path.suffix.lower() == ".vtu" else meshio.vtk.read)
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
    return RawMesh(path, mesh.points, np.arange(len(mesh.points)), blocks, regions, at_nodes=mesh.point_data)
