"""Nodes, elements and components of an ANSYS archive (.cdb, as CDWRITE writes it), with the file's own numbers.

Blocks of fixed columns: NBLOCK (nodes), EBLOCK with the key SOLID (elements), CMBLOCK (components). A brick whose nodes
coincide is the tetrahedron, pyramid or wedge that ANSYS takes it for.
"""

import logging
import re
from collections import Counter
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from dvc.errors import ImageFileError
from dvc.io.meshes.raw import Members, NumberedMesh, RawMesh, damage_named, read_text

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
_FORMAT = re.compile(r"\((\d+)i(\d+)(?:,(\d+)e(\d+))?", re.IGNORECASE)


def _next(lines: Iterator[str], within: str) -> str:
    for line in lines:
        return line
    raise ValueError(f"the file ends within {within}")


def read_ansys(path: Path) -> RawMesh:
    """Read a blocked archive in the global Cartesian frame; its regions: element components and "material 1" ..."""
    mesh = NumberedMesh(path)
    types: dict[str, str] = {}
    materials: dict[int, list[int]] = {}
    components: dict[str, dict[str, Members]] = {"ELEM": {}, "NODE": {}}
    words: set[str] = set()
    lines = iter(read_text(path).splitlines())
    for line in lines:
        fields = [f.strip() for f in line.split("!")[0].split(",")]
        word = fields[0].upper()
        words.add(word)
        with damage_named(f"{path}: a row of {word}"):
            if word == "ET" and len(fields) > 2:
                types[fields[1]] = re.sub(r"\D", "", fields[2])
            elif word == "ETBLOCK":
                _, width, *_ = _format(_next(lines, word))
                while (row := _next(lines, word)).strip() != "-1":
                    number, kind = _columns(row, width, 2)
                    types[str(number)] = str(kind)
            elif word == "NBLOCK":
                _tell_count(path, fields, _add_nodes(lines, mesh))
            elif word == "EBLOCK" and len(fields) > 2 and fields[2].upper() == "SOLID":
                _tell_count(path, fields, _add_elements(lines, types, mesh, materials))
            elif word == "EBLOCK":
                _log.warning("%s: a block of contact elements is skipped.", path)
                mesh.left_out = True
            elif word == "CMBLOCK":
                of_kind = components.setdefault(fields[2][:4].upper(), {})
                of_kind[fields[1].upper()] = _members(lines, int(fields[3]))
    if not {"NBLOCK", "EBLOCK"} <= words:
        raise ImageFileError(f"{path}: no blocks of nodes or of elements. Write the file with CDWRITE, DB, name, cdb.")
    if "FINISH" not in words:
        _log.warning("%s does not end in FINISH, as CDWRITE writes it; its last components may be missing.", path)
    regions: dict[str, Members] = {f"material {number}": materials[number] for number in sorted(materials)}
    return mesh.by_index(regions | components["ELEM"], components["NODE"])


def _format(line: str) -> list[int]:
    """Repeats and widths of a block's columns: two numbers of its integers, and two of its reals if it has any."""
    columns = _FORMAT.search(line)
    numbers = [int(n) for n in columns.groups() if n] if columns else []
    if not numbers or 0 in numbers:
        raise ValueError(f"'{line.strip()}' is not a format")
    return numbers


def _columns(line: str, width: int, count: int | None = None) -> list[int]:
    columns = len(line.rstrip()) // width if count is None else count
    return [int(line[i * width : (i + 1) * width]) for i in range(columns)]


def _tell_count(path: Path, fields: list[str], found: int) -> None:
    """Warn of a block that has not as many rows as its head says, in its last field, where it does say."""
    if len(fields) > 4 and fields[4] not in ("", "0", str(found)):
        _log.warning("%s: %s should have %s rows and has %d; some may be lost.", path, fields[0], fields[4], found)


def _add_nodes(lines: Iterator[str], mesh: NumberedMesh) -> int:
    """Add the nodes of a block to the mesh, and give their number."""
    count, width, _, wide = _format(_next(lines, "NBLOCK"))
    start, found = count * width, 0
    # The end is written in one way in old archives and in another in new ones.
    while not (line := _next(lines, "NBLOCK")).lstrip().startswith(("N,", "-1")):
        # Trailing zeros are left out, so a row may hold fewer than three coordinates.
        at = [line[start + i * wide : start + (i + 1) * wide].strip() for i in range(3)]
        cut = [text for text in at if text and len(text) < wide // 2]
        if cut:
            raise ValueError(f"'{cut[0]}' is not a coordinate")
        mesh.add_node(int(line[:width]), [float(text or 0.0) for text in at])
        found += 1
    return found


def _add_elements(lines: Iterator[str], types: dict[str, str], mesh: NumberedMesh, of: dict[int, list[int]]) -> int:
    """Add the elements of a block to the mesh, and their numbers to those ``of`` their materials; give their number."""
    _, width, *_ = _format(_next(lines, "EBLOCK"))
    left_out: Counter[str] = Counter()
    found = 0
    while (line := _next(lines, "EBLOCK")).strip() != "-1":
        found += 1
        numbers = _columns(line, width)
        material, kind, number, count = numbers[0], str(numbers[1]), numbers[10], numbers[8]
        nodes = numbers[_HEAD:]
        while len(nodes) < count:
            nodes += _columns(_next(lines, "EBLOCK"), width)
        if kind not in types:
            raise ValueError(f"element {number} has type {kind}, which is not defined by any ET")
        cell = _shape(types[kind], nodes[:count])
        if cell is None:
            left_out[types[kind]] += 1
            mesh.left_out = True
        else:
            mesh.add_element(number, *cell)
            of.setdefault(material, []).append(number)
    for kind, count in left_out.items():
        _log.warning("%s: %d elements of type %s are skipped: not a supported solid or shell.", mesh.path, count, kind)
    return found


def _members(lines: Iterator[str], count: int) -> Members:
    """Numbers of the items of a component, which has ``count`` numbers in the file."""
    _, width, *_ = _format(_next(lines, "CMBLOCK"))
    numbers: list[int] = []
    while len(numbers) < count:
        numbers += _columns(_next(lines, "CMBLOCK"), width)
    members: list[int | range] = []
    for before, number in pairwise([0, *numbers]):
        if number > 0:
            members.append(number)
        elif before > 0 > number:  # a negative one ends a run
            members.append(range(before + 1, -number + 1))
        else:
            raise ValueError(f"{number} after {before} is neither an item nor the end of a run")
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
