"""A mesh as its file gives it, before unit, frame and geometry are checked: what every reader returns."""

import logging
import math
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from meshio._common import num_nodes_per_cell

from dvc.arrays import IntArray
from dvc.errors import ImageFileError

_log = logging.getLogger("dvc.io.meshes.raw")

_DAMAGE = (
    ValueError, IndexError, KeyError, TypeError, AttributeError, ArithmeticError, OSError, StopIteration,
    struct.error, zlib.error,
)  # fmt: skip

_HIGHEST = np.iinfo(np.int64).max

Members = Iterable[int | range]
"""Numbers of the members of a set, and runs of them."""


@dataclass(frozen=True, slots=True, eq=False)
class RawMesh:
    """Nodes, cells, sets of either and nodal fields in the file's own unit, frame and order."""

    path: Path
    points: Any  # (n, 3)
    node_ids: IntArray  # (n,) the file's number of each node; the index from 0 in a format without numbers
    blocks: list[tuple[str, Any]]  # kind in meshio's names, node indices (m, k); cells count through all blocks
    regions: Mapping[str, IntArray]  # cells of each named set
    node_sets: Mapping[str, IntArray] = field(default_factory=dict)  # node indices of each named set
    at_nodes: Mapping[str, Any] = field(default_factory=dict)  # fields (n, ...); NaN where the file gives no value


@dataclass(slots=True)
class NumberedMesh:
    """Nodes and elements as a text file lists them: by number, and elements by the numbers of their nodes.

    ``left_out`` says that some of them were passed over, so that a set may name what is not here.
    """

    path: Path
    nodes: dict[int, list[float]] = field(default_factory=dict)
    elements: dict[int, tuple[str, list[int]]] = field(default_factory=dict)
    left_out: bool = False

    def add_node(self, number: int, coordinates: list[float]) -> None:
        """Add a node; refuse a number that is taken, or that no program gives."""
        if not 0 < number <= _HIGHEST:
            raise ImageFileError(f"{self.path}: {number} cannot be the number of a node. Export the mesh again.")
        if number in self.nodes:
            raise ImageFileError(f"{self.path}: node {number} is defined twice. Export the mesh again.")
        self.nodes[number] = coordinates

    def add_element(self, number: int, kind: str, nodes: list[int]) -> None:
        """Add an element, its kind in meshio's names; refuse a number that is taken and a wrong count of nodes."""
        if number in self.elements:
            raise ImageFileError(f"{self.path}: element {number} is defined twice. Export the mesh again.")
        if len(nodes) != num_nodes_per_cell[kind]:
            counts = f"{len(nodes)} nodes, but a {kind} needs {num_nodes_per_cell[kind]}"
            raise ImageFileError(f"{self.path}: element {number} has {counts}. Export the mesh again.")
        self.elements[number] = kind, nodes

    def by_index(
        self, regions: Mapping[str, Members], node_sets: Mapping[str, Members] | None = None,
        at_nodes: Mapping[str, Mapping[int, list[float]]] | None = None,
    ) -> RawMesh:  # fmt: skip
        """The mesh by indices, cells grouped by kind.

        Elements and fields must not name what the file does not define. A set may; where nothing was left out, each
        number in it that stands for nothing is logged as a warning. A range stands for what there is of it.
        """
        if not self.nodes:
            raise ImageFileError(f"{self.path}: no mesh in this file (no nodes).")

        def undefined(whose: str, node: int) -> ImageFileError:
            return ImageFileError(f"{self.path}: {whose} node {node}, which is not defined in the file.")

        index_of = {number: index for index, number in enumerate(self.nodes)}
        blocks: dict[str, dict[int, list[int]]] = {}
        for number, (kind, nodes) in self.elements.items():
            missing = [node for node in nodes if node not in index_of]
            if missing:
                raise undefined(f"element {number} uses", missing[0])
            blocks.setdefault(kind, {})[number] = [index_of[node] for node in nodes]
        cell_of = {number: cell for cell, number in enumerate(n for block in blocks.values() for n in block)}
        fields = {}
        for name, values in (at_nodes or {}).items():
            fields[name] = np.full((len(index_of), 3), np.nan)
            for number, value in values.items():
                if number not in index_of:
                    raise undefined(f"a {name} belongs to", number)
                fields[name][index_of[number]] = value
        return RawMesh(
            self.path,
            np.array(list(self.nodes.values()), dtype=np.float64),
            np.array(list(self.nodes), dtype=np.int64),
            [(kind, np.array(list(block.values()), dtype=np.int64)) for kind, block in blocks.items()],
            {name: self._known(f"the element set {name!r}", of, cell_of) for name, of in regions.items()},
            {name: self._known(f"the node set {name!r}", of, index_of) for name, of in (node_sets or {}).items()},
            fields,
        )

    def _known(self, name: str, members: Members, position: Mapping[int, int]) -> IntArray:
        """Positions of the members of a set that are in the mesh."""
        known, unknown = list[int](), list[int]()
        for each in members:
            if isinstance(each, int):
                (known if each in position else unknown).append(each)
            elif (each.stop - each.start) // each.step > len(position):  # of any length where the file is damaged
                known += [number for number in position if number in each]
            else:
                known += [number for number in each if number in position]
        if unknown and not self.left_out:
            what = f"{name} names {len(unknown)} that the file does not define, such as {unknown[0]}"
            _log.warning("%s: %s. The file may be incomplete or damaged.", self.path, what)
        return np.unique(np.array([position[number] for number in known], dtype=np.int64))


def read_text(path: Path) -> str:
    """The text of a mesh file; what is not UTF-8 stands as a mark that no number has."""
    try:
        return path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise ImageFileError(f"{path}: cannot be read ({error.strerror}).") from error


def finite(number: float) -> float:
    """The number unchanged; ValueError if it is NaN or infinite."""
    if not math.isfinite(number):
        raise ValueError(f"{number} is not a valid result value")
    return number


@contextmanager
def damage_named(place: str) -> Iterator[None]:
    """Turn whatever reading a damaged file raises into an `ImageFileError` that begins with ``place``."""
    try:
        yield
    except ImageFileError:
        raise
    except _DAMAGE as error:
        raise ImageFileError(f"{place} cannot be read ({error}); the file is damaged. Export it again.") from error
