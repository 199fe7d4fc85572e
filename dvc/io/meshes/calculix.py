"""CalculiX results (.frd, ASCII): nodes, elements and the last step's displacements, with the file's own numbers."""

import logging
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

from dvc.errors import ImageFileError
from dvc.io.meshes.abaqus import keywords
from dvc.io.meshes.raw import NumberedMesh, RawMesh, damage_named, finite

_log = logging.getLogger("dvc.io.meshes.calculix")

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
# Where a solid's lower and its upper nodes begin, of those between which a shell that was expanded has none.
_LAYERS = {"hexahedron": (0, 4), "wedge": (0, 3), "hexahedron20": (8, 12), "wedge15": (6, 9)}
_NODE, _VALUE = 10, 12  # columns of a number of a node, and of a value
_COUNT = slice(6, 36)  # of the head of nodes or elements
_TIME, _ANALYSIS, _IN_TIME = slice(12, 24), slice(56, 58), (0, 1)  # of the head of results; static and transient


def read_frd(path: Path) -> RawMesh:
    """Read a result file: its regions are the materials ("material 1"), its field the last step's displacement.

    CalculiX expands shells, membranes and beams to solids. They are left out if the deck lies beside the result, with
    its name, and lists them; of elements that it does not list, those with node numbers of a shell or of a linear beam
    are told. Both are logged.
    """
    try:
        text = path.read_text(encoding="ascii")
    except (UnicodeDecodeError, OSError) as error:
        raise _not_text(path) from error
    mesh = NumberedMesh(path)
    materials: dict[str, list[int]] = {}
    at_nodes: dict[str, dict[int, list[float]]] = {}
    lines = enumerate(text.splitlines(), start=1)
    for number, line in lines:
        with damage_named(f"{path}, after line {number}: a row"):
            if line.startswith("    2C"):
                for row in _counted(line, _rows(path, lines, "nodes")):
                    mesh.add_node(int(row[3:13]), _values(row))
            elif line.startswith("    3C"):
                rows = _counted(line, _rows(path, lines, "elements"))
                _add_elements(rows, mesh, materials, *_solids_and_others(path.with_suffix(".inp")))
            elif line.startswith(" -4  DISP"):
                rows = [row for row in _rows(path, lines, "displacements") if row.startswith(" -1")]
                at_nodes = {"displacement": {int(row[3:13]): _values(row) for row in rows}}
    return mesh.by_index(materials, at_nodes=at_nodes)


def time_reached(path: Path) -> float | None:
    """The latest time of a static or transient result in the file; None where it has none.

    ImageFileError for a binary file, whose heads alone are text.
    """
    times = []
    with path.open("rb") as file, damage_named(f"{path}: a head of results"):
        for line in file:
            if not line.isascii():
                raise _not_text(path)
            if line.startswith(b"  100C") and int(line[_ANALYSIS]) in _IN_TIME:
                times.append(finite(float(line[_TIME])))
    return max(times, default=None)


def _not_text(path: Path) -> ImageFileError:
    return ImageFileError(
        f"{path}: not a text file. If it is a binary result of CalculiX, write it with *NODE FILE in place of "
        "*NODE OUTPUT."
    )


def is_closed(path: Path) -> bool:
    """Whether the file has its last line, 9999: CalculiX writes it when a run ends, and not when it fails."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 200))
        return file.read().rstrip().rpartition(b"\n")[2].strip() == b"9999"


def _rows(path: Path, lines: Iterator[tuple[int, str]], block: str) -> list[str]:
    """Lines of a block to its end."""
    rows: list[str] = []
    for _, line in lines:
        if line.startswith(" -3"):
            return rows
        rows.append(line)
    raise ImageFileError(
        f"{path}: the file is incomplete; it ends within the {block}. Copy it again, or run CalculiX again."
    )


def _counted(head: str, rows: list[str]) -> list[str]:
    """The rows unchanged; ValueError if they are not of as many items as the head of their block says."""
    found = sum(row.startswith(" -1") for row in rows)
    if found != int(head[_COUNT]):
        raise ValueError(f"{found} of {int(head[_COUNT])} items")
    return rows


def _values(row: str) -> list[float]:
    starts = range(3 + _NODE, 3 + _NODE + 3 * _VALUE, _VALUE)
    if len(row) < starts.stop:
        raise ValueError("a row is incomplete")
    return [float(row[start : start + _VALUE]) for start in starts]


def _add_elements(
    rows: list[str], mesh: NumberedMesh, materials: dict[str, list[int]], solids: set[int], others: set[int]
) -> None:
    left_out = alike = 0
    starts = [n for n, row in enumerate(rows) if row.startswith(" -1")]
    for start, end in pairwise([*starts, len(rows)]):
        head = rows[start]
        number, shape = int(head[3:13]), _SHAPES[int(head[13:18])]
        nodes = [int(row[i : i + _NODE]) for row in rows[start + 1 : end] for i in range(3, len(row.rstrip()), _NODE)]
        order = _ORDER.get(shape, range(len(nodes)))
        nodes = [nodes[i] for i in order] if len(order) == len(nodes) else nodes
        if shape in _LAYERS and number in others:
            left_out += 1
            continue
        alike += number not in solids and (_like_a_shell(shape, nodes, mesh) or _like_a_beam(shape, nodes, mesh))
        mesh.add_element(number, shape, nodes)
        materials.setdefault(f"material {int(head[23:28])}", []).append(number)
    if left_out:
        _log.info("%s: %d shells, membranes or beams, expanded to solids, are left out.", mesh.path, left_out)
    if alike:
        _log.warning(
            "%s: %d elements may be shells or beams that CalculiX expanded to solids, and count as tissue. To have "
            "them recognised, put the input deck (%s) next to the result, or write the result with OUTPUT=2D.",
            mesh.path, alike, mesh.path.with_suffix(".inp").name,
        )  # fmt: skip


def _like_a_shell(shape: str, nodes: list[int], mesh: NumberedMesh) -> bool:
    """Whether nodes have the numbers of a shell's: lower, middle and upper in a row, and no middle one in the file."""
    low, high = _LAYERS.get(shape, (0, 0))
    pairs = [*zip(nodes[low:high], nodes[high : 2 * high - low], strict=False)]
    return bool(pairs) and all(above == below + 2 and below + 1 not in mesh.nodes for below, above in pairs)


def _like_a_beam(shape: str, nodes: list[int], mesh: NumberedMesh) -> bool:
    """Whether nodes have the numbers of a linear beam's: at each end four of eight, the other four not in the file."""
    if shape != "hexahedron":
        return False
    first = sorted(nodes)
    ends = (first[:4], first[4:])
    return all(end[3] == end[0] + 3 and not any(end[3] + n in mesh.nodes for n in range(1, 5)) for end in ends)


def _solids_and_others(deck: Path) -> tuple[set[int], set[int]]:
    """Numbers of the solids that a deck lists, and of its other elements; none without a deck.

    A deck may have its elements, or some, in files that it includes.
    """
    solids, others = set[int](), set[int]()
    for keyword in keywords(deck) if deck.is_file() else ():
        if keyword.name == "ELEMENT":
            of = solids if keyword.options.get("TYPE", "").upper().startswith("C3D") else others
            of.update(int(row[0]) for row in keyword.rows if row[0].isdecimal())
    return solids, others - solids
