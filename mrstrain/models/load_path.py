"""One path of loads, solved in a worker: each load's files are there as soon as it is reached."""

from __future__ import annotations

import time
from pathlib import Path

from dvc.atomic_files import write_whole
from dvc.errors import OutputError
from fe import Checkpoint, LoadState, LoadStep, Observer, Problem, SolverOptions, solve, write_state
from fe.restart import ENDING, fingerprint, read_checkpoint, write_checkpoint

_EVERY_S = 30.0  # at most so often is an increment on the way to a load written, to resume from


def solve_in_folder(problem: Problem, options: SolverOptions, folder: Path, share: Path) -> list[LoadState]:
    """Solve one path, resuming what an earlier run in the folder came to if that was made from the same.

    ``share`` is a file that holds the share that is done.
    """
    files = _Files(problem, folder, share)
    return solve(problem, options, files, files.earlier())


class _Files(Observer):
    """Files of a path in its folder: a load's results and checkpoint when it is reached, a log of each step."""

    def __init__(self, problem: Problem, folder: Path, share: Path) -> None:
        self._problem, self._folder, self._share = problem, folder, share
        self._log = folder / f"log-{problem.loads[0].name}.txt"
        self._made_from = {load.name: fingerprint(problem, n) for n, load in enumerate(problem.loads, start=1)}
        self._last = time.monotonic()
        write_whole(self._log, "")

    def earlier(self) -> list[Checkpoint]:
        """Where the first loads came to in an earlier run; the last may have been on its way."""
        kept: list[Checkpoint] = []
        for load in self._problem.loads:
            checkpoint = read_checkpoint(self._checkpoint_of(load), self._made_from[load.name])
            if checkpoint is None:
                break
            self.log(f"{load.name}: {checkpoint.reached:.0%} of it was there from an earlier run")
            kept.append(checkpoint)
            if checkpoint.reached < 1.0:
                break
        return kept

    def log(self, line: str) -> None:
        try:
            # closed each time: there to be read meanwhile, and after a kill
            with self._log.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        except OSError as error:
            raise OutputError(
                f"{self._log}: cannot be written ({error.strerror or error}). Has the disk room?"
            ) from error

    def progress(self, done: float) -> None:
        part = self._share.with_suffix(".part")
        part.write_text(f"{done:.4f}")
        part.replace(self._share)

    def converged(self, load: LoadStep, checkpoint: Checkpoint) -> None:
        if time.monotonic() - self._last > _EVERY_S:
            write_checkpoint(self._checkpoint_of(load), checkpoint, self._made_from[load.name])
            self._last = time.monotonic()

    def ended(self, state: LoadState) -> None:
        if state.checkpoint is not None and len(state.curve) > 1:
            write_checkpoint(self._checkpoint_of(state.load), state.checkpoint, self._made_from[state.load.name])
            write_state(self._folder / f"{state.load.name}.vtu", self._problem.mesh, state, self._problem.materials)

    def _checkpoint_of(self, load: LoadStep) -> Path:
        return self._folder / f"{load.name}{ENDING}"
