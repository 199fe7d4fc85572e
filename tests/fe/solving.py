"""One path of loads solved, with everything that may be said of it as a keyword."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from fe import (
    Checkpoint,
    LoadState,
    LoadStep,
    Material,
    Observer,
    Plate,
    Problem,
    SolverOptions,
    TetMesh,
    Tolerance,
    solve,
)


class Notebook(Observer):
    """Keeps what it hears."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.shares: list[float] = []
        self.increments: list[tuple[str, Checkpoint]] = []

    def log(self, line: str) -> None:
        self.lines.append(line)

    def progress(self, done: float) -> None:
        self.shares.append(done)

    def converged(self, load: LoadStep, checkpoint: Checkpoint) -> None:
        self.increments.append((load.name, checkpoint))


def solved(
    mesh: TetMesh, materials: Mapping[str, Material], plate: Plate, loads: Sequence[LoadStep], *,
    fixed: Sequence[str] = ("bone",), element: str = "P1", threads: int = 1, tolerance: Tolerance | None = None,
    limit_s: float = np.inf, earlier: Mapping[str, Checkpoint] = MappingProxyType({}), observer: Observer | None = None,
) -> list[LoadState]:  # fmt: skip
    """The states in which these loads end, each reached from the one before it."""
    problem = Problem(mesh, materials, plate, loads, fixed, element)
    return solve(problem, SolverOptions(threads, limit_s, tolerance or Tolerance()), observer, earlier)
