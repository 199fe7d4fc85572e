"""Nodes, elements and components of an ANSYS archive (.cdb, as CDWRITE writes it), with the file's own numbers.

Blocks of fixed columns: NBLOCK (nodes), EBLOCK with the key SOLID (elements), CMBLOCK (components). A brick whose nodes
coincide is the tetrahedron, pyramid or wedge that ANSYS takes it for.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray, IntArray
from dvc.errors import ImageFileError

_log = logging.getLogger("dvc.io.meshes.ansys")

_BRICKS = {"45", "185", "95", "186"}
_TETS = {"285": (4, "tetra"), "187": (10, "tetra10"), "92": (10, "tetra10")}
_SHELLS = {"181", "63", "281", "154"}  # SURF154 too: a face that carries a load
_HEAD = 11  # numbers before the nodes of an element
# Places in a brick's list of the nodes of what it has become; corners, then the middles of edges.
_DEGENERATE = {
    "tetra": ([0, 1, 2, 4], [8, 9, 11, 16, 17, 18]),
    "pyramid": ([0, 1, 2, 3, 4], [8, 9, 10, 11, 16, 17, 18, 19]),
    "wedge": ([0, 1, 2, 4, 5, 6], [8, 9, 11, 12, 13, 15, 16, 17, 18]),
    "hexahedron": (list(range(8)), list(range(8, 20))),
}
_WORD = re.compile(r"\((\d+)i(\d+)(?:,(\d+)e(\d+))?", re.IGNORECASE)


@dataclass(frozen=True, slots=True, eq=False)
class AnsysMesh:
    """What an archive says: ``points`` (n, 3) in its unit, ``node_ids`` (n,), blocks, and sets by name.

    ``blocks`` are pairs of an element shape, in meshio's names, and node *indices* (m, k); ``sets`` hold the indices of
    elements, counted through all blocks, of each element component and of each material ("material 1"); ``node_sets``
    the indices of the nodes of each node component.
    """

    points: FloatArray
    node_ids: IntArray
    blocks: list[tuple[str, IntArray]]
    sets: dict[str, IntArray]
    node_sets: dict[str, IntArray]


class _Lines:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._lines = iter(path.read_text(encoding="utf-8", errors="replace").splitlines())

    def __iter__(self) -> Iterator[str]:
        return self._lines

    def next(self, within: str) -> str:
        for line in self._lines:
            return line
        raise ImageFileError(f"{self._path} ends within {within}: it is cut short.")


def read_ansys(path: Path) -> AnsysMesh:
    """Read the mesh of a blocked archive, in the global Cartesian frame.

    Raises
    ------
    ImageFileError
        If the file is cut short, has no block of nodes or of elements, or an element uses a node that is not there.
    """
    types: dict[str, str] = {}
    nodes: dict[int, list[float]] = {}
    elements: dict[int, tuple[str, int, list[int]]] = {}
    components: dict[tuple[str, str], list[int]] = {}
    lines = _Lines(path)
    for line in lines:
        fields = [f.strip() for f in line.split("!")[0].split(",")]
        word = fields[0].upper()
        try:
            if word == "ET" and len(fields) > 2:
                types[fields[1]] = re.sub(r"\D", "", fields[2])
            elif word == "ETBLOCK":
                _types(lines, types)
            elif word == "NBLOCK":
                _nodes(lines, nodes)
            elif word == "EBLOCK":
                if len(fields) > 2 and fields[2].upper() == "SOLID":
                    _elements(lines, types, elements)
                else:
                    _log.warning("%s: a block of contact elements is left out.", path)
            elif word == "CMBLOCK":
                components[fields[1].upper(), fields[2][:4].upper()] = _members(lines, int(fields[3]))
        except (ValueError, IndexError, AttributeError, KeyError) as error:
            if isinstance(error, ImageFileError):
                raise
            raise ImageFileError(
                f"{path}: a row of {word} could not be read ({error}); the file is damaged."
            ) from error
    if not nodes or not elements:
        raise ImageFileError(
            f"{path} holds {len(nodes)} nodes and {len(elements)} elements in blocks. Write it in ANSYS with "
            "CDWRITE, DB, name, cdb."
        )
    return _assembled(path, nodes, elements, components)


def _columns(line: str, width: int, count: int | None = None) -> list[int]:
    whole = len(line.rstrip()) // width if count is None else count
    return [int(line[i * width : (i + 1) * width]) for i in range(whole)]


def _types(lines: _Lines, types: dict[str, str]) -> None:
    form = lines.next("ETBLOCK")
    width = int(_WORD.search(form).group(2))  # type: ignore[union-attr]
    while True:
        line = lines.next("ETBLOCK")
        if line.strip() == "-1":
            return
        number, kind = _columns(line, width, 2)
        types[str(number)] = str(kind)


def _nodes(lines: _Lines, nodes: dict[int, list[float]]) -> None:
    form = lines.next("NBLOCK")
    count, width, _, wide = (int(n) for n in _WORD.search(form).groups())  # type: ignore[union-attr]
    start = count * width
    while True:
        line = lines.next("NBLOCK")
        if line.lstrip().startswith(("N,", "-1")):  # the end, in old and in new archives
            return
        # Trailing zeros are left out, so a row may hold fewer than three coordinates.
        at = [line[start + i * wide : start + (i + 1) * wide].strip() for i in range(3)]
        cut = [text for text in at if text and len(text) < wide // 2]
        if cut:
            raise ValueError(f"'{cut[0]}' is no coordinate")
        nodes[int(line[:width])] = [float(text or 0.0) for text in at]


def _elements(lines: _Lines, types: dict[str, str], elements: dict[int, tuple[str, int, list[int]]]) -> None:
    form = lines.next("EBLOCK")
    width = int(_WORD.search(form).group(2))  # type: ignore[union-attr]
    while True:
        line = lines.next("EBLOCK")
        if line.strip() == "-1":
            return
        numbers = _columns(line, width)
        count = numbers[8]
        found = numbers[_HEAD:]
        while len(found) < count:
            found += _columns(lines.next("EBLOCK"), width)
        if str(numbers[1]) not in types:
            raise ValueError(f"element {numbers[10]} has type {numbers[1]}, which no ET defines")
        elements[numbers[10]] = types[str(numbers[1])], numbers[0], found[:count]


def _members(lines: _Lines, count: int) -> list[int]:
    form = lines.next("CMBLOCK")
    width = int(_WORD.search(form).group(2))  # type: ignore[union-attr]
    numbers: list[int] = []
    while len(numbers) < count:
        numbers += _columns(lines.next("CMBLOCK"), width)
    members: list[int] = []
    for number in numbers:  # a negative one ends a run
        members += range(members[-1] + 1, -number + 1) if number < 0 else [number]
    return members


def _shape(kind: str, nodes: list[int]) -> tuple[str, list[int]] | None:
    """Shape of an element in meshio's names, and its nodes; None for what is no tissue."""
    if kind in _TETS:
        count, name = _TETS[kind]
        return (name, nodes) if len(nodes) == count and 0 not in nodes else ("tetra", nodes[:4])
    if kind in _SHELLS:
        corners = list(dict.fromkeys(nodes[:4]))
        return ({3: "triangle", 4: "quad"}[len(corners)], corners) if len(corners) >= 3 else None
    if kind not in _BRICKS:
        return None
    if len(set(nodes[4:8])) == 1:
        name = "tetra" if nodes[2] == nodes[3] else "pyramid"
    else:
        name = "wedge" if nodes[2] == nodes[3] else "hexahedron"
    corners, middles = _DEGENERATE[name]
    chosen = corners + (middles if len(nodes) == 20 and 0 not in nodes else [])
    order = "" if len(chosen) == len(corners) else str(len(chosen))
    return name + order, [nodes[i] for i in chosen]


def _assembled(
    path: Path,
    nodes: dict[int, list[float]],
    elements: dict[int, tuple[str, int, list[int]]],
    components: dict[tuple[str, str], list[int]],
) -> AnsysMesh:
    index_of = {number: index for index, number in enumerate(nodes)}
    rows: dict[str, list[list[int]]] = {}
    named: dict[str, list[int]] = {}  # numbers of the elements in each block
    material: dict[int, int] = {}
    left_out: dict[str, int] = {}
    for number, (kind, of, members) in elements.items():
        found = _shape(kind, members)
        if found is None:
            left_out[kind] = left_out.get(kind, 0) + 1
            continue
        missing = [node for node in found[1] if node not in index_of]
        if missing:
            raise ImageFileError(f"{path}: element {number} uses node {missing[0]}, which the file does not define.")
        rows.setdefault(found[0], []).append([index_of[node] for node in found[1]])
        named.setdefault(found[0], []).append(number)
        material[number] = of
    for kind, count in left_out.items():
        _log.warning("%s: %d elements of type %s are left out: no solid or shell that is read.", path, count, kind)
    position = {number: n for n, number in enumerate(number for numbers in named.values() for number in numbers)}
    sets = {
        f"material {of}": np.array([position[number] for number, its in material.items() if its == of])
        for of in sorted(set(material.values()))
    }
    for (name, what), members in components.items():
        if what == "ELEM":
            sets[name] = np.array([position[number] for number in members if number in position], dtype=np.int64)
    return AnsysMesh(
        np.array(list(nodes.values()), dtype=np.float64),
        np.array(list(nodes), dtype=np.int64),
        [(shape, np.array(block, dtype=np.int64)) for shape, block in rows.items()],
        {name: np.sort(index) for name, index in sets.items()},
        {
            name: np.array([index_of[number] for number in members if number in index_of], dtype=np.int64)
            for (name, what), members in components.items()
            if what == "NODE"
        },
    )
