"""CalculiX results (.frd, ASCII): nodes, elements and the last step's displacements, with the file's own numbers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dvc.arrays import FloatArray, IntArray
from dvc.errors import ImageFileError

# Shape in meshio's names and number of nodes, by CalculiX' number of the element type.
_SHAPES = {
    1: ("hexahedron", 8), 2: ("wedge", 6), 3: ("tetra", 4), 4: ("hexahedron20", 20), 5: ("wedge15", 15),
    6: ("tetra10", 10), 7: ("triangle", 3), 8: ("triangle6", 6), 9: ("quad", 4), 10: ("quad8", 8),
}  # fmt: skip
# CalculiX writes the middles of the upright edges before those of the top.
_ORDER = {
    "hexahedron20": [*range(12), *range(16, 20), *range(12, 16)],
    "wedge15": [*range(9), *range(12, 15), *range(9, 12)],
}
_NODE, _VALUE = 10, 12  # columns of a number of a node, and of a value


@dataclass(frozen=True, slots=True, eq=False)
class FrdResult:
    """What a file says, in its own unit.

    Attributes
    ----------
    points : (n, 3)
    node_ids : (n,)
    blocks : list of (shape in meshio's names, node indices (m, k))
    materials : mapping of str to (k,) int
        Cells of each material ("material 1"), counted through all blocks.
    displacement : (n, 3) or None
        Of the last step that has one; NaN at nodes without a value.
    """

    points: FloatArray
    node_ids: IntArray
    blocks: list[tuple[str, IntArray]]
    materials: dict[str, IntArray]
    displacement: FloatArray | None


def read_frd(path: Path) -> FrdResult:
    """Read a result file.

    Raises
    ------
    ImageFileError
        If it is binary, cut short, or has no nodes and elements.
    """
    try:
        lines = path.read_text(encoding="ascii").splitlines()
    except (UnicodeDecodeError, OSError) as error:
        raise ImageFileError(f"{path} is no ASCII result file of CalculiX ({error}).") from error
    points: dict[int, list[float]] = {}
    cells: dict[tuple[str, int], list[list[int]]] = {}
    moved: dict[int, list[float]] | None = None
    at = 0

    def rows(what: str) -> list[str]:
        """Lines of a block to its end."""
        nonlocal at
        start = at
        while at < len(lines) and not lines[at].startswith(" -3"):
            at += 1
        if at == len(lines):
            raise ImageFileError(f"{path} ends within its {what}: it is cut short.")
        at += 1
        return lines[start : at - 1]

    try:
        while at < len(lines):
            line = lines[at]
            at += 1
            if line.startswith("    2C"):
                points = {int(row[3:13]): _values(row, 3) for row in rows("nodes")}
            elif line.startswith("    3C"):
                cells = _elements(rows("elements"))
            elif line.startswith(" -4  DISP"):
                moved = {int(row[3:13]): _values(row, 3) for row in rows("displacements") if row.startswith(" -1")}
    except (ValueError, IndexError, KeyError) as error:
        if isinstance(error, ImageFileError):
            raise
        raise ImageFileError(f"{path}, near line {at}: a row could not be read ({error}).") from error
    if not points or not cells:
        raise ImageFileError(f"{path} holds {len(points)} nodes and {len(cells)} kinds of elements: no mesh.")
    index_of = {number: index for index, number in enumerate(points)}
    ordered = sorted(cells, key=lambda kind: list(cells).index(kind))
    blocks: list[tuple[str, IntArray]] = []
    materials: dict[str, IntArray] = {}
    known = 0
    for shape, material in ordered:
        missing = [n for row in cells[shape, material] for n in row if n not in index_of]
        if missing:
            raise ImageFileError(f"{path}: an element uses node {missing[0]}, which the file does not define.")
        members = np.array([[index_of[n] for n in row] for row in cells[shape, material]], dtype=np.int64)
        if shape in _ORDER:
            members = members[:, _ORDER[shape]]
        blocks.append((shape, members))
        name = f"material {material}"
        here = np.arange(known, known + len(members))
        materials[name] = np.concatenate([materials[name], here]) if name in materials else here
        known += len(members)
    u = None
    if moved is not None:
        u = np.full((len(points), 3), np.nan)
        for number, value in moved.items():
            u[index_of[number]] = value
    return FrdResult(np.array(list(points.values())), np.array(list(points)), blocks, materials, u)


def _values(row: str, count: int) -> list[float]:
    start = 3 + _NODE
    if len(row) < start + count * _VALUE:
        raise ValueError("a row is cut short")
    return [float(row[start + i * _VALUE : start + (i + 1) * _VALUE]) for i in range(count)]


def _elements(rows: list[str]) -> dict[tuple[str, int], list[list[int]]]:
    found: dict[tuple[str, int], list[list[int]]] = {}
    shape, count, material, nodes = "", 0, 0, list[int]()
    for row in [*rows, " -1"]:
        if row.startswith(" -1"):
            if shape:
                if len(nodes) != count:
                    raise ValueError(f"an element of {len(nodes)} nodes instead of {count}")
                found.setdefault((shape, material), []).append(nodes)
            if len(row) > 13:
                shape, count = _SHAPES[int(row[13:18])]
                material, nodes = int(row[23:28]), []
        else:
            nodes = nodes + [int(row[i : i + _NODE]) for i in range(3, len(row.rstrip()), _NODE)]
    return found
