"""FEBio's plot files (.xplt): nodes, elements, parts and the last state's displacements.

A file is a tree of chunks: a tag and a length in bytes (two little-endian integers of 32 bits), then data or further
chunks (FEBio's binary database, versions 2.0 to 3.5, FEBio 3 and 4); states may be compressed, each by itself.
"""

import logging
import struct
import zlib
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray, IntArray
from dvc.errors import ImageFileError
from dvc.io.meshes.raw import RawMesh, damage_named, finite

_log = logging.getLogger("dvc.io.meshes.febio")

_MAGIC = 0x00464542
_ROOT, _MESH, _STATE = 0x01000000, 0x01040000, 0x02000000
_NODAL_NAMES = (0x01020000, 0x01023000)  # dictionary, of nodes
_ITEM, _ITEM_NAME = 0x01020001, 0x01020004
_NODE_COUNT, _COORDINATES = (0x01041000, 0x01041100, 0x01041101), (0x01041000, 0x01041200)
_DOMAINS, _PARTS = 0x01042000, 0x01045000
_KIND, _PART = (0x01042101, 0x01042102), (0x01042101, 0x01042103)
_ELEMENTS, _ELEMENT = 0x01042200, 0x01042201
_PART_ID, _PART_NAME = 0x01045101, 0x01045102
_NODE_DATA, _TIME, _STATUS = (0x02020000, 0x02020300), (0x02010000, 0x02010002), (0x02010000, 0x02010003)
_NO_STEPS_END = 2  # status of a state that is written at another event: an iteration, or the end of the run
_VARIABLE_ID, _VARIABLE_DATA = 0x02020002, 0x02020003
_DISPLACEMENT = "displacement"
_CUT = "the last section is incomplete: FEBio was stopped while it wrote the file, or the copy ended early"
_PIECE = 1 << 16

# Of FEBio's number of the element type: nodes in the file, and the kind in meshio's names with those that are taken.
# Tetrahedra of 15 nodes begin with the nodes of those of 10.
_KINDS = {
    0: (8, "hexahedron", 8), 1: (6, "wedge", 6), 2: (4, "tetra", 4), 3: (4, "quad", 4), 4: (3, "triangle", 3),
    6: (20, "hexahedron20", 20), 7: (10, "tetra10", 10), 8: (15, "tetra10", 10), 9: (27, "hexahedron27", 27),
    10: (6, "triangle6", 6), 11: (8, "quad8", 8), 12: (9, "quad9", 9), 13: (15, "wedge15", 15),
    16: (5, "pyramid", 5), 17: (5, "tetra", 4), 18: (13, "pyramid13", 13),
}  # fmt: skip
# FEBio has the middles of the upright faces one after the other, VTK those of opposite faces.
_ORDER = {"hexahedron27": [*range(20), 23, 21, 20, 22, 24, 25, 26]}


def read_xplt(path: Path) -> RawMesh:
    """Read a plot file: regions are FEBio's parts; nodes have its numbers, or count from 0 where it gives none."""
    with damage_named(f"{path}: its sections"):
        data = path.read_bytes()
        if len(data) < 4 or struct.unpack_from("<I", data)[0] != _MAGIC:
            raise ImageFileError(f"{path}: not a FEBio plot file. Give the .xplt file that FEBio wrote.")
        last: dict[int, bytes] = {}
        before = b""  # the state before the last one
        for tag, body in _sections(data):
            if tag == _MESH and tag in last:
                raise ImageFileError(f"{path}: the mesh changes between states (remeshing), which is not supported.")
            before = last.get(tag, b"") if tag == _STATE else before
            last[tag] = body
        if _ROOT not in last or _MESH not in last:
            raise ImageFileError(f"{path}: the file is incomplete; it has no mesh. Copy it again, or run FEBio again.")
        points, ids = _nodes(last[_MESH])
        fields = _displacement(last[_ROOT], last[_STATE], len(points)) if _STATE in last else {}
        _tell_iterations(path, before, last.get(_STATE, b""))
        return RawMesh(path, points, ids, *_cells(path, last[_MESH]), at_nodes=fields)


def _sections(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Top chunks; a compressed one is recognised by its first bytes, which are no tag."""
    at = 4
    while at < len(data):
        tag, size = struct.unpack_from("<II", data, at) if len(data) >= at + 8 else (0, 0)
        if tag in (_ROOT, _MESH, _STATE):
            if at + 8 + size > len(data):
                raise ValueError(_CUT)
            yield tag, data[at + 8 : at + 8 + size]
            at += 8 + size
        else:
            stream, plain = zlib.decompressobj(), bytearray()
            while not stream.eof and at < len(data):  # a piece at a time: what is left over is copied
                plain += stream.decompress(data[at : at + _PIECE])
                at = min(at + _PIECE, len(data))
            if not stream.eof:
                raise ValueError(_CUT)
            yield from _chunks(bytes(plain))
            at -= len(stream.unused_data)


def _chunks(body: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(body):
        tag, size = struct.unpack_from("<II", body, at)
        if at + 8 + size > len(body):
            raise ValueError(f"chunk {tag:#x} is longer than the section that contains it")
        yield tag, body[at + 8 : at + 8 + size]
        at += 8 + size


def _at(body: bytes, *tags: int) -> bytes:
    """The first chunk down a path of tags."""
    for tag in tags:
        body = next((chunk for name, chunk in _chunks(body) if name == tag), b"")
    return body


def _number(body: bytes) -> int:
    return int(struct.unpack_from("<i", body)[0])


def _text(body: bytes) -> str:
    return body.split(b"\0", 1)[0].decode("utf-8", errors="replace").strip()


def _nodes(mesh: bytes) -> tuple[FloatArray, IntArray]:
    count = _number(_at(mesh, *_NODE_COUNT))
    record = np.dtype([("id", "<i4"), ("x", "<f4", 3)])
    body = _at(mesh, *_COORDINATES)
    if len(body) != count * record.itemsize:
        raise ValueError(f"{len(body)} bytes of coordinates for {count} nodes")
    nodes = np.frombuffer(body, record)
    ids = nodes["id"].astype(np.int64)
    return nodes["x"].astype(np.float64), ids if len(np.unique(ids)) == count else np.arange(count)


def _cells(path: Path, mesh: bytes) -> tuple[list[tuple[str, IntArray]], dict[str, IntArray]]:
    names = {_number(_at(part, _PART_ID)): _text(_at(part, _PART_NAME)) for _, part in _chunks(_at(mesh, _PARTS))}
    blocks: list[tuple[str, IntArray]] = []
    parts: dict[str, list[IntArray]] = {}
    known = 0
    for _, domain in _chunks(_at(mesh, _DOMAINS)):
        number, part = _number(_at(domain, *_KIND)), _number(_at(domain, *_PART))
        if number in (5, 19):  # they carry no tissue
            _log.info("%s: springs and beams are skipped.", path)
            continue
        if number not in _KINDS:
            raise ImageFileError(f"{path}: elements of FEBio type {number} are not supported.")
        width, kind, taken = _KINDS[number]
        if taken < width:
            _log.warning(
                "%s: elements with %d nodes are read as %s, by their first %d nodes; between these, displacements may "
                "differ from FEBio's.", path, width, kind, taken,
            )  # fmt: skip
        rows = np.frombuffer(_at(domain, _ELEMENTS), "<u4").reshape(-1, width + 3)
        if not ((rows[:, 0] == _ELEMENT).all() and (rows[:, 1] == 4 * (width + 1)).all()):
            raise ValueError(f"an element in a domain of {kind} has a wrong number of nodes")
        nodes = rows[:, 3 : 3 + taken].astype(np.int64)
        blocks.append((kind, nodes[:, _ORDER[kind]] if kind in _ORDER else nodes))
        name = names.get(part) or f"part {part}"
        parts.setdefault(name, []).append(np.arange(known, known + len(rows)))
        known += len(rows)
    return blocks, {name: np.concatenate(cells) for name, cells in parts.items()}


def time_reached(path: Path) -> float | None:
    """The time of the last state in a plot file; None where it has none."""
    with damage_named(f"{path}: its sections"):
        last = deque((body for tag, body in _sections(path.read_bytes()) if tag == _STATE), maxlen=1)
        time = _at(last[0], *_TIME) if last else b""
        return finite(float(np.float32(struct.unpack("<f", time)[0]))) if time else None


def _tell_iterations(path: Path, before: bytes, state: bytes) -> None:
    """Warn of a last state that may not be converged, by the state before it."""
    time, status = _at(state, *_TIME), _at(state, *_STATUS)
    if time and time == _at(before, *_TIME) and status and _number(status) == _NO_STEPS_END:
        _log.warning(
            "%s: its states are written in every iteration (PLOT_MINOR_ITRS), so the last one may not be converged; "
            "check the run, or set plot_level to PLOT_MAJOR_ITRS.",
            path,
        )


def _displacement(root: bytes, state: bytes, count: int) -> dict[str, FloatArray]:
    """Displacement in a state, (n, 3), by its name; empty where it has none."""
    names = [_text(_at(item, _ITEM_NAME)) for tag, item in _chunks(_at(root, *_NODAL_NAMES)) if tag == _ITEM]
    wanted = names.index(_DISPLACEMENT) + 1 if _DISPLACEMENT in names else None
    for _, variable in _chunks(_at(state, *_NODE_DATA)):
        if _number(_at(variable, _VARIABLE_ID)) == wanted:
            _, values = next(_chunks(_at(variable, _VARIABLE_DATA)))
            if len(values) != 12 * count:
                raise ValueError(f"{len(values)} bytes of displacement for {count} nodes")
            return {_DISPLACEMENT: np.frombuffer(values, "<f4").reshape(-1, 3).astype(np.float64)}
    return {}
