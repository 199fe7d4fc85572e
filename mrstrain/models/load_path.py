"""One path of loads, simulated in a worker: each load's files are there as soon as it is reached."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from dvc.atomic_files import write_whole
from dvc.errors import OutputError
from dvc.mesh import TetMesh
from fe.load_stages import Kept
from fe.materials import Material
from fe.plate import Plate
from fe.restart import ENDING, fingerprint, read_kept, write_kept
from fe.result import write_state
from fe.simulate import LoadStep, State
from fe.simulate import simulate as solve

_EVERY_S = 30.0  # at most so often is a state on the way to a load written, to go on from


def simulated_path(
    mesh: TetMesh,
    laws: Mapping[str, Material],
    plate: Plate,
    path: Sequence[LoadStep],
    fixed: Sequence[str],
    element: str,
    folder: Path,
    share: Path,
    threads: int,
    limit_s: float,
) -> list[State]:
    """Run one path in a worker: each load's files are written as soon as it is there, and each step's line in the log.

    It goes on from where an earlier run came to, if that was made from the same.
    """
    log = folder / f"log-{path[0].name}.txt"
    write_whole(log, "")

    def tell(line: str) -> None:
        try:
            # closed each time: there to be read meanwhile, and after a kill
            with log.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        except OSError as error:
            raise OutputError(f"{log}: cannot be written ({error.strerror or error}). Has the disk room?") from error

    made_from = {
        load.name: fingerprint(mesh, laws, plate, path[: n + 1], fixed, element) for n, load in enumerate(path)
    }
    earlier: list[Kept] = []
    for load in path:
        found = read_kept(folder / f"{load.name}{ENDING}", made_from[load.name])
        if found is None:
            break
        tell(f"{load.name}: {found.reached:.0%} of it was there from an earlier run")
        earlier.append(found)
        if found.reached < 1.0:
            break
    last = time.monotonic()

    def settled(load: LoadStep, kept: Kept) -> None:
        nonlocal last
        if time.monotonic() - last > _EVERY_S:
            write_kept(folder / f"{load.name}{ENDING}", kept, made_from[load.name])
            last = time.monotonic()

    def keep(state: State) -> None:
        if state.kept is not None and len(state.kept.curve) > 1:
            write_kept(folder / f"{state.load.name}{ENDING}", state.kept, made_from[state.load.name])
            write_state(folder / f"{state.load.name}.vtu", mesh, state, laws)

    return solve(
        mesh, laws, plate, path, fixed=fixed, formulation=element, threads=threads, tell=tell, keep=keep,
        settled=settled, earlier=earlier, limit_s=limit_s, progress=lambda done: _replaced(share, f"{done:.4f}"),
    )  # fmt: skip


def _replaced(path: Path, text: str) -> None:
    part = path.with_suffix(".part")
    part.write_text(text)
    part.replace(path)
