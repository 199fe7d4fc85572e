"""Gmsh (.msh) and VTK files (.vtu, .vtk), by meshio, with its many kinds of failure and its printing in one place.

Gmsh's node numbers, groups of one name and order of some nodes, which meshio passes over, are read here: see the Gmsh
reference manual, sections "MSH file format" (versions 2 and 4.1) and "Node ordering".
"""

import io
import logging
import math
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import numpy.typing as npt
from meshio._common import num_nodes_per_cell
from meshio._mesh import topological_dimension
from meshio.gmsh import _gmsh22, main as gmsh
from meshio.gmsh.common import _gmsh_to_meshio_type

from dvc.arrays import IntArray
from dvc.errors import ImageFileError
from dvc.io.meshes.raw import RawMesh, damage_named

_log = logging.getLogger("dvc.io.meshes.read")

# meshio 5.3.5 reads and writes these cells, but has left them out of its own table of dimensions, and fails on them.
topological_dimension.update({"wedge15": 3, "pyramid13": 3})

# Cell arrays that hold a region's number, in the order in which they are looked for.
_REGION_ARRAYS = ("region", "regions", "label", "labels", "tissue", "material", "materialids", "part", "part_id")
_MOST_REGIONS = 256
_MOST_STEPS = 1_000_000  # a number alone on a line may be that of a time step, in a small file too
_HIGHEST_NUMBER = 100_000_000  # meshio keeps an array of so many
_GROUP = re.compile(rb'^[ \t]*(\d+)[ \t]+(\d+)[ \t]+"?(.*?)"?[ \t]*\r?$', re.MULTILINE)
_GRID = re.compile(rb"^DIMENSIONS[ \t]+(\d{1,18})[ \t]+(\d{1,18})[ \t]+(\d{1,18})", re.MULTILINE | re.IGNORECASE)
# Quadratic cells of Gmsh in VTK's order, of those that meshio leaves as they are.
_TO_VTK = {
    "wedge18": [0, 1, 2, 3, 4, 5, 6, 9, 7, 12, 14, 13, 8, 10, 11, 15, 17, 16],
    "pyramid14": [0, 1, 2, 3, 4, 5, 8, 10, 6, 7, 9, 11, 12, 13],
}


def read_gmsh(path: Path) -> RawMesh:
    """Read a .msh file (version 2.2 or 4.1, text or binary): its regions are the physical groups."""
    names: dict[tuple[int, int], str] = {}  # by dimension and tag; a volume and its surface may share one
    with suppress(ValueError):  # no section of names
        named = _GROUP.findall(_section(path.read_bytes(), b"PhysicalNames"))
        names = {(int(d), int(tag)): name.decode(errors="replace") for d, tag, name in named}
    tags = _node_numbers(path)
    with _names_apart(path, names) as (place, real), _BoundedFile(place) as file:
        mesh = _read(path, lambda _: gmsh.read_buffer(file))
    if len(tags) != len(mesh.points):
        raise ImageFileError(f"{path}: {len(tags)} node numbers for {len(mesh.points)} nodes. Export the mesh again.")
    if narrow := [c.type for c in mesh.cells if c.data.shape[1] < len(_TO_VTK.get(c.type, ()))]:
        raise ImageFileError(f"{path}: cells of the kind {narrow[0]} have too few nodes. Export the mesh again.")
    blocks = [(c.type, c.data[:, _TO_VTK[c.type]] if c.type in _TO_VTK else c.data) for c in mesh.cells]
    sizes = [len(data) for _, data in blocks]
    groups: list[tuple[str, IntArray]] = []
    if "gmsh:physical" in mesh.cell_data:
        tag = np.concatenate(mesh.cell_data["gmsh:physical"])
        dimension = np.repeat([topological_dimension.get(kind, -1) for kind, _ in blocks], sizes)
        for d, t in np.unique(np.column_stack([dimension, tag])[tag != 0], axis=0).tolist():
            groups.append((names.get((d, t), f"physical {t}"), np.flatnonzero((dimension == d) & (tag == t))))
    starts = np.cumsum([0, *sizes])[:-1]
    for name, parts in mesh.cell_sets.items():  # version 4.1, where a cell may be in several groups
        if not name.startswith("gmsh:"):
            if len(parts) != len(starts):
                raise ImageFileError(f"{path}: the $Elements section is incomplete. Export the mesh again.")
            own = [np.asarray(part, dtype=np.int64) + start for part, start in zip(parts, starts, strict=True)]
            groups.append((real.get(name, name), np.concatenate(own)))
    regions: dict[str, IntArray] = {}
    for name, cells in groups:  # a volume and its surface may share a name: the shape distinguishes their cells
        regions[name] = np.union1d(regions.get(name, np.empty(0, dtype=np.int64)), cells)
    return RawMesh(path, mesh.points, tags, blocks, regions, at_nodes=mesh.point_data)


class _BoundedFile(io.BufferedReader):
    """A Gmsh file for meshio, which counts down any number that stands alone on a line, over nothing in the end."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._most = max(path.stat().st_size, _MOST_STEPS)
        self._ended = False

    def readline(self, size: int | None = -1, /) -> bytes:
        """The next line; ValueError for a count of more than the file holds, and the second time at its end."""
        line = super().readline(size)
        if line.strip().isdigit() and int(line) > self._most:
            raise ValueError(f"the file states {int(line)} items, more than its size allows")
        if self._ended and not line:
            raise ValueError("the file ends within a section")
        self._ended = not line
        return line


def _node_numbers(path: Path) -> IntArray:
    """Node tags (n,) of a .msh file, in its order: any numbers, with gaps, to which boundary conditions refer.

    Counts are checked here, before meshio reserves memory for as many as they say.
    """
    data = path.read_bytes()
    with damage_named(f"{path}: its $MeshFormat section"):
        version, mode, size = _section(data, b"MeshFormat").split()[:3]
    if version not in (b"2.2", b"4.1"):
        raise ImageFileError(
            f"{path}: Gmsh file version {version.decode(errors='replace')} is not supported, only 2.2 and 4.1. "
            "Save it again with Gmsh (Mesh.MshFileVersion = 4.1)."
        )
    read_tags = _tags_of_22 if version == b"2.2" else _tags_of_41
    tags: IntArray = _read(path, lambda _: read_tags(path, data, mode == b"0", int(size)))
    if len(np.unique(tags)) != len(tags):
        different = len(np.unique(tags))
        raise ImageFileError(
            f"{path}: {different} different node numbers for {len(tags)} nodes. Export the mesh again."
        )
    if len(tags) and not 0 < tags.min() <= tags.max() <= _HIGHEST_NUMBER:
        raise ImageFileError(
            f"{path}: nodes have numbers from {tags.min()} to {tags.max()}, and only 1 to {_HIGHEST_NUMBER} are "
            "supported. Renumber the mesh in Gmsh, and save it again."
        )
    return tags


def _tags_of_22(path: Path, data: bytes, is_text: bool, _: int) -> IntArray:
    if is_text:
        for name in (b"Nodes", b"Elements"):
            count, *rows = filter(None, map(bytes.strip, _section(data, name).splitlines()))
            if int(count) != len(rows):
                raise ValueError(f"{len(rows)} of {int(count)} {name.decode()}")
    with _BoundedFile(path) as file:  # meshio reads these numbers, and keeps them to itself
        file.seek(_start(data, b"Nodes"))
        return np.array(_gmsh22._read_nodes(file, is_text)[1], dtype=np.int64)


def _tags_of_41(path: Path, data: bytes, is_text: bool, size: int) -> IntArray:
    with path.open("rb") as file:

        def read(kind: npt.DTypeLike, count: int) -> npt.NDArray[Any]:
            if count > len(data):
                raise ValueError(f"the file states {count} items, more than its size allows")
            values = np.fromfile(file, kind, count, " " if is_text else "")
            if len(values) < count:
                raise ValueError(f"the file ends before {count} numbers")
            return values

        def blocks(name: bytes) -> Iterator[tuple[int, int]]:
            """Kind and count of each block, whose items are read before the next one."""
            file.seek(_start(data, name))
            number, total, *_ = read(f"u{size}", 4).tolist()
            for _ in range(number):
                kind = int(read(np.intc, 3)[2])
                count = int(read(f"u{size}", 1)[0])
                yield kind, count
                total -= count
            if total:
                raise ValueError(f"blocks of {name.decode()} do not add up")

        tags = [np.empty(0, dtype=np.int64)]
        for _, count in blocks(b"Nodes"):
            tags.append(read(f"u{size}", count).astype(np.int64))
            read(float, 3 * count)
        for kind, count in blocks(b"Elements"):
            read(f"u{size}", count * (1 + num_nodes_per_cell[_gmsh_to_meshio_type[kind]]))
    return np.concatenate(tags)


@contextmanager
def _names_apart(path: Path, names: dict[tuple[int, int], str]) -> Iterator[tuple[Path, dict[str, str]]]:
    """A file in which every group has a name of its own, as meshio needs it, and the real name of each of these."""
    if len(set(names.values())) == len(names):
        yield path, {name: name for name in names.values()}
        return
    data = path.read_bytes()
    old = _section(data, b"PhysicalNames")
    with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
        copy = Path(folder) / path.name
        copy.write_bytes(data.replace(old, _GROUP.sub(rb'\1 \2 "\1 \2"', old), 1))
        yield copy, {f"{dimension} {tag}": name for (dimension, tag), name in names.items()}


def _section(data: bytes, name: bytes) -> bytes:
    start = _start(data, name)
    return data[start : data.index(b"$End" + name, start)]


def _start(data: bytes, name: bytes) -> int:
    return data.index(b"\n", data.index(b"$" + name)) + 1


def read_vtk(path: Path) -> RawMesh:
    """Read a .vtu or .vtk file; its nodes have no numbers and are counted from 0."""
    if path.suffix.lower() == ".vtu":
        mesh = _read(path, meshio.vtu.read)
    else:
        _refuse_a_grid_too_large(path)
        mesh = _read(path, meshio.vtk.read)
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


def _refuse_a_grid_too_large(path: Path) -> None:
    """Refuse a regular grid of more points than the file can have values of: meshio makes them all."""
    grid = _GRID.search(path.read_bytes())
    if grid and math.prod(map(int, grid.groups())) > path.stat().st_size:
        size = " x ".join(number.decode() for number in grid.groups())
        raise ImageFileError(f"{path}: the file is too short for a grid of {size} points. Export it again.")


def _read(path: Path, read: Callable[[str], Any]) -> Any:
    """Read a file by one of meshio's readers; refused if that fails, for whatever reason."""
    with silenced() as said, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", "string or file could not be read to its end")
        try:
            return read(str(path))
        except Exception as error:
            # meshio meets damaged files with whatever Python raises: KeyError, ValueError, IndexError ...
            reason = " ".join(f"{type(error).__name__}: {error} {said.getvalue()}".split())
            raise ImageFileError(
                f"{path}: cannot be read as a mesh ({reason}). The file is damaged, or its variant is not "
                "supported; write it again as VTU."
            ) from error


@contextmanager
def silenced() -> Iterator[io.StringIO]:
    """Keep what meshio prints off the terminal, and log it."""
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        yield said
    if said.getvalue().strip():
        _log.info("meshio: %s", " ".join(said.getvalue().split()))
