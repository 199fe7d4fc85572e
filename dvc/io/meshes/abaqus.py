"""Nodes, elements and element sets of an Abaqus input file (.inp), with the file's own numbers.

One part in global coordinates is read, in the dialect that CalculiX shares; what would move, join or create geometry
elsewhere in the file is refused: a misplaced mesh gives wrong strains without a warning.
"""

import logging
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from dvc.errors import ImageFileError
from dvc.io.meshes.raw import Members, NumberedMesh, RawMesh, damage_named, read_text

_log = logging.getLogger("dvc.io.meshes.abaqus")

# Shape and number of nodes by the stem of the element's name; the rest (H, R, I, M, T ...) is the formulation.
_SHAPES = {
    "C3D4": ("tetra", 4), "C3D10": ("tetra10", 10),
    "C3D8": ("hexahedron", 8), "C3D20": ("hexahedron20", 20),
    "C3D6": ("wedge", 6), "C3D15": ("wedge15", 15), "C3D5": ("pyramid", 5),
    "S3": ("triangle", 3), "STRI3": ("triangle", 3), "STRI65": ("triangle6", 6), "S6": ("triangle6", 6),
    "M3D3": ("triangle", 3), "M3D6": ("triangle6", 6), "SFM3D3": ("triangle", 3), "SFM3D6": ("triangle6", 6),
    "R3D3": ("triangle", 3),
    "S4": ("quad", 4), "M3D4": ("quad", 4), "SFM3D4": ("quad", 4), "R3D4": ("quad", 4),
    "S8": ("quad8", 8), "M3D8": ("quad8", 8), "SFM3D8": ("quad8", 8),
}  # fmt: skip
_VARIANTS = set("HRIMTSPEW5")
_READ = {"NODE", "ELEMENT", "ELSET", "NSET"}
_CLOSED = {"PART", "INSTANCE", "ASSEMBLY", "STEP"}  # each has its END
_ELSEWHERE = {"INCLUDE", "SYSTEM", "NGEN", "NCOPY", "NFILL", "ELGEN", "ELCOPY", "NMAP"}


@dataclass(slots=True)
class Keyword:
    """A keyword of an input file: its line, name and options in capitals, and the cells of its rows."""

    line: int
    name: str
    options: dict[str, str]
    rows: list[list[str]] = field(default_factory=list)


def read_abaqus(path: Path) -> RawMesh:
    """Read ``*NODE``, ``*ELEMENT`` (solids, shells, membranes, surface elements), ``*ELSET`` and ``*NSET``.

    Springs, trusses, connectors and the reference points of an assembly are not tissue: they are left out, and logged.
    """
    mesh = NumberedMesh(path)
    element_sets, node_sets = _Sets(path, "ELSET"), _Sets(path, "NSET")
    parts, in_assembly = 0, False
    opened: dict[str, str] = {}
    for keyword in keywords(path):
        where = f"{path}, *{keyword.name} in line {keyword.line}"
        parts += keyword.name == "PART"
        if keyword.name in _CLOSED:
            opened[keyword.name] = where
        elif keyword.name.startswith("END "):
            opened.pop(keyword.name.removeprefix("END "), None)
        _refuse_what_lies_elsewhere(where, keyword, parts)
        with damage_named(f"{where}: a row or an option"):
            if keyword.name in {"ASSEMBLY", "END INSTANCE"}:
                in_assembly = True
            elif keyword.name in {"INSTANCE", "END ASSEMBLY"}:
                in_assembly = False
            elif keyword.name == "NODE" and in_assembly:
                mesh.left_out = True
                _log.info("%s: %d reference points of the assembly are skipped.", where, len(keyword.rows))
            elif keyword.name == "NODE":
                for row in keyword.rows:
                    mesh.add_node(int(row[0]), ([float(x or 0.0) for x in row[1:4]] + [0.0] * 3)[:3])
            elif keyword.name == "ELEMENT":
                numbers = _add_elements(where, keyword, mesh)
                if "ELSET" in keyword.options:
                    element_sets.extend(keyword, map(str, numbers))
            elif keyword.name in {"ELSET", "NSET"}:
                chosen = element_sets if keyword.name == "ELSET" else node_sets
                rows = [[x for x in row if x] for row in keyword.rows]
                if "GENERATE" in keyword.options:  # first, last, and a step that may be left out
                    chosen.extend(keyword, (range(int(a), int(b) + 1, *map(int, step[:1])) for a, b, *step in rows))
                else:
                    chosen.extend(keyword, (x for row in rows for x in row))
    if opened:
        name, where = opened.popitem()
        raise ImageFileError(f"{where} has no *END {name}: the file is incomplete. Export it again.")
    return mesh.by_index(element_sets.resolved(), node_sets.resolved())


def keywords(path: Path) -> Iterator[Keyword]:
    """Yield the keywords with their options and data rows; comments left out, continued heads joined."""
    text = read_text(path)
    current: Keyword | None = None
    head, head_line = "", 0
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("**"):
            continue
        if line.startswith("*") or head:
            if not head:
                if current is not None:
                    yield current
                head_line = number
            head += line
            if not head.endswith(","):
                name, *options = (part.strip() for part in head[1:].split(","))
                pairs = [option.partition("=") for option in options if option]
                named = {key.strip().upper(): value.strip() for key, _, value in pairs}
                current, head = Keyword(head_line, name.upper(), named), ""
        elif current is not None:
            current.rows.append([x.strip() for x in line.rstrip(",").split(",")])
    if current is not None:
        if head or (current.name in _READ and not text.endswith(("\n", "\r"))):
            # The format has no mark of its end, and half a number would be another node.
            problem = f"it ends in the middle of a line, after *{current.name} in line {current.line}"
            raise ImageFileError(f"{path}: the file may be incomplete: {problem}. If not, add a line break at its end.")
        yield current


def _refuse_what_lies_elsewhere(where: str, keyword: Keyword, parts: int) -> None:
    reason = None
    if parts > 1:
        reason = "is a second part"
    elif keyword.name == "INSTANCE" and keyword.rows:
        reason = "moves the part"
    elif keyword.name in _ELSEWHERE or (keyword.name in _READ and "INPUT" in keyword.options):
        reason = "includes, generates or moves nodes or elements that are not in this file"
    elif keyword.name == "NODE" and keyword.options.get("SYSTEM", "R").upper() != "R":
        reason = "uses cylindrical or spherical coordinates"
    if reason is not None:
        advice = "Write the mesh as one part in global coordinates (an orphan mesh), or as VTU."
        raise ImageFileError(f"{where} {reason}, which is not supported. {advice}")


def _add_elements(where: str, keyword: Keyword, mesh: NumberedMesh) -> list[int]:
    """Add the elements of a keyword, if they are of a kind that is read, and give their numbers."""
    kind = keyword.options["TYPE"].upper()
    stems = [s for s in _SHAPES if kind.startswith(s) and set(kind[len(s) :]) <= _VARIANTS]
    if not stems:
        if kind.startswith("C3D"):
            raise ImageFileError(
                f"{where}: solid elements of type {kind} are not supported; supported are "
                f"{', '.join(s for s in _SHAPES if s.startswith('C3D'))} and their variants (H, R, I, M ...)."
            )
        _log.warning("%s: elements of type %s carry no tissue and are skipped.", where, kind)
        mesh.left_out = True
        return []
    shape, width = _SHAPES[max(stems, key=len)]
    # An element of many nodes goes over several lines, so rows are joined before they are cut.
    numbers = [int(x) for row in keyword.rows for x in row if x]
    if len(numbers) % (width + 1):
        raise ImageFileError(
            f"{where}: {kind} elements need {width + 1} numbers each, but {len(numbers)} is not a multiple of that. "
            "The file may be incomplete. Export it again."
        )
    rows = [numbers[i : i + width + 1] for i in range(0, len(numbers), width + 1)]
    for number, *nodes in rows:
        mesh.add_element(number, shape, nodes)
    return [row[0] for row in rows]


class _Sets:
    """Named sets of elements (ELSET) or nodes (NSET) as the file lists them: by number, or by another set's name."""

    def __init__(self, path: Path, kind: str) -> None:
        self._path, self._kind = path, kind
        self._sets: dict[
            str, tuple[str, list[str | range]]
        ] = {}  # names are the same in any case; the first spelling is kept

    def extend(self, keyword: Keyword, more: Iterable[str | range]) -> None:
        if self._kind not in keyword.options:
            raise ImageFileError(f"{self._path}, line {keyword.line}: *{self._kind} without a name ({self._kind}=...).")
        name = keyword.options[self._kind].strip('"')
        self._sets.setdefault(name.casefold(), (name, []))[1].extend(more)

    def resolved(self) -> dict[str, Members]:
        """Numbers of the members of each set, and ranges of numbers as the file generates them."""
        members: dict[str, Members] = {}
        for name, _ in self._sets.values():
            try:
                members[name] = self._members(name)
            except ImageFileError as error:
                if self._kind == "ELSET":
                    raise
                _log.warning("%s The set is skipped.", error)  # nodes of an assembly: no tissue is lost with them
        return members

    def _members(self, name: str, seen: tuple[str, ...] = ()) -> list[int | range]:
        key = name.strip('"').casefold()
        if key in seen or key not in self._sets:
            kind = {"ELSET": "element set", "NSET": "node set"}[self._kind]
            raise ImageFileError(f"{self._path}: the {kind} {name!r} is not defined, or contains itself.")
        members: list[int | range] = []
        for entry in self._sets[key][1]:
            if isinstance(entry, range):
                members.append(entry)
            else:
                members += [int(entry)] if entry.isdecimal() else self._members(entry, (*seen, key))
        return members
