"""A mesh as its file gives it, before unit, frame and geometry are checked: what every reader returns."""

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

_DAMAGE = (
    ValueError, IndexError, KeyError, TypeError, AttributeError, ArithmeticError, OSError, StopIteration,
    struct.error, zlib.error,
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class RawMesh:
    """Nodes, cells, sets and nodal fields in the file's own unit, frame and order."""

    path: Path
    points: Any  # (n, 3)
    node_ids: IntArray  # (n,) the file's number of each node; the index from 0 in a format without numbers
    blocks: list[tuple[str, Any]]  # kind in meshio's names, node indices (m, k); cells count through all blocks
    regions: Mapping[str, IntArray]  # cells of each named set
    node_sets: Mapping[str, IntArray] = field(default_factory=dict)  # node indices of each named set
    at_nodes: Mapping[str, Any] = field(default_factory=dict)  # fields (n, ...); NaN where the file gives no value


@dataclass(slots=True)
class NumberedMesh:
    """Nodes and elements as a text file lists them: by number, and elements by the numbers of their nodes."""

    path: Path
    nodes: dict[int, list[float]] = field(default_factory=dict)
    elements: dict[int, tuple[str, list[int]]] = field(default_factory=dict)

    def add_node(self, number: int, coordinates: list[float]) -> None:
        """Add a node; refuse a number that is taken."""
        if number in self.nodes:
            raise ImageFileError(f"{self.path}: node {number} is defined twice.")
        self.nodes[number] = coordinates

    def add_element(self, number: int, kind: str, nodes: list[int]) -> None:
        """Add an element, its kind in meshio's names; refuse a number that is taken and a wrong count of nodes."""
        if number in self.elements:
            raise ImageFileError(f"{self.path}: element {number} is defined twice.")
        if len(nodes) != num_nodes_per_cell[kind]:
            counts = f"{len(nodes)} nodes, but a {kind} needs {num_nodes_per_cell[kind]}"
            raise ImageFileError(f"{self.path}: element {number} has {counts}. The file is damaged.")
        self.elements[number] = kind, nodes

    def by_index(
        self, regions: Mapping[str, Iterable[int]], node_sets: Mapping[str, Iterable[int]] | None = None,
        at_nodes: Mapping[str, Mapping[int, list[float]]] | None = None,
    ) -> RawMesh:  # fmt: skip
        """The mesh by indices, cells grouped by kind; sets may name what was left out, elements and fields may not."""
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
            {name: _known(members, cell_of) for name, members in regions.items()},
            {name: _known(members, index_of) for name, members in (node_sets or {}).items()},
            fields,
        )


def _known(members: Iterable[int], position: Mapping[int, int]) -> IntArray:
    return np.unique(np.array([position[number] for number in members if number in position], dtype=np.int64))


@contextmanager
def damage_named(place: str) -> Iterator[None]:
    """Turn whatever reading a damaged file raises into an `ImageFileError` that begins with ``place``."""
    try:
        yield
    except ImageFileError:
        raise
    except _DAMAGE as error:
        raise ImageFileError(f"{place} cannot be read ({error}); the file is damaged.") from error
