"""CalculiX results (.frd, ASCII): nodes, elements and the last step's displacements, with the file's own numbers."""

from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from dvc.errors import ImageFileError
from dvc.io.meshes.raw import NumberedMesh, RawMesh, damage_named

# Shape in meshio's names by CalculiX' number of the element type.
_SHAPES = {
    1: "hexahedron", 2: "wedge", 3: "tetra", 4: "hexahedron20", 5: "wedge15", 6: "tetra10", 7: "triangle",
    8: "triangle6", 9: "quad", 10: "quad8", 11: "line", 12: "line3",
}  # fmt: skip
# CalculiX writes the middles of the upright edges before those of the top.
_ORDER = {
    "hexahedron20": [*range(12), *range(16, 20), *range(12, 16)],
    "wedge15": [*range(9), *range(12, 15), *range(9, 12)],
}
_NODE, _VALUE = 10, 12  # columns of a number of a node, and of a value
_TIME, _ANALYSIS, _IN_TIME = slice(12, 24), slice(56, 58), (0, 1)  # of the head of results; static and transient


def read_frd(path: Path) -> RawMesh:
    """Read a result file: its regions are the materials ("material 1"), its field the last step's displacement."""
    try:
        text = path.read_text(encoding="ascii")
    except (UnicodeDecodeError, OSError) as error:
        raise ImageFileError(
            f"{path}: not a text file. If it is a binary result of CalculiX, write it with *NODE FILE in place of "
            "*NODE OUTPUT."
        ) from error
    mesh = NumberedMesh(path)
    materials: dict[str, list[int]] = {}
    at_nodes: dict[str, dict[int, list[float]]] = {}
    lines = enumerate(text.splitlines(), start=1)
    for number, line in lines:
        with damage_named(f"{path}, after line {number}: a row"):
            if line.startswith("    2C"):
                for row in _rows(path, lines, "nodes"):
                    mesh.add_node(int(row[3:13]), _values(row))
            elif line.startswith("    3C"):
                _add_elements(_rows(path, lines, "elements"), mesh, materials)
            elif line.startswith(" -4  DISP"):
                rows = [row for row in _rows(path, lines, "displacements") if row.startswith(" -1")]
                at_nodes = {"displacement": {int(row[3:13]): _values(row) for row in rows}}
    return mesh.by_index(materials, at_nodes=at_nodes)


def time_reached(path: Path) -> float | None:
    """The latest time of a static or transient result in the file; None where it has none."""
    times = []
    with path.open("rb") as file, damage_named(f"{path}: a head of results"):
        for line in file:
            if line.startswith(b"  100C") and int(line[_ANALYSIS]) in _IN_TIME:
                times.append(float(line[_TIME]))
    return max(times, default=None)


def _rows(path: Path, lines: Iterator[tuple[int, str]], block: str) -> list[str]:
    """Lines of a block to its end."""
    rows: list[str] = []
    for _, line in lines:
        if line.startswith(" -3"):
            return rows
        rows.append(line)
    raise ImageFileError(f"{path}: the file is incomplete; it ends within the {block}.")


def _values(row: str) -> list[float]:
    starts = range(3 + _NODE, 3 + _NODE + 3 * _VALUE, _VALUE)
    if len(row) < starts.stop:
        raise ValueError("a row is incomplete")
    return [float(row[start : start + _VALUE]) for start in starts]


def _add_elements(rows: list[str], mesh: NumberedMesh, materials: dict[str, list[int]]) -> None:
    starts = [n for n, row in enumerate(rows) if row.startswith(" -1")]
    for start, end in pairwise([*starts, len(rows)]):
        head = rows[start]
        number, shape = int(head[3:13]), _SHAPES[int(head[13:18])]
        nodes = [int(row[i : i + _NODE]) for row in rows[start + 1 : end] for i in range(3, len(row.rstrip()), _NODE)]
        order = _ORDER.get(shape, range(len(nodes)))
        mesh.add_element(number, shape, [nodes[i] for i in order] if len(order) == len(nodes) else nodes)
        materials.setdefault(f"material {int(head[23:28])}", []).append(number)
