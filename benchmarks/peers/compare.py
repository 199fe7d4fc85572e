"""mrstrain beside its peers: the same pairs, one after the other, each in a process of its own.

    make peers
    .venv/bin/python -m benchmarks.peers.compare --out benchmarks/results/peers.json

Seconds are wall time from the start of the process to its end: start of the interpreter, reading and writing included;
for the peers (not for mrstrain) shading and the foot's motion have been taken out beforehand. CPU seconds are those
that the process and its children computed, which say more where the machine did other work beside. Memory is that of
all processes of a peer together. A peer that fails, or takes over ``--limit-s``, is recorded so, and the others go on.
Results are kept in the file after each run, and what it holds already is not run again: take a run out of it to repeat
it.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.memory import peak_kib
from benchmarks.peers.pairs import PAIRS, pair_named, write_pair
from benchmarks.registration_accuracy import scored
from dvc import Deformation, read_displacement, read_transform
from dvc.errors import MrstrainError
from mrstrain.records.provenance import versions
from phantoms import HeelPair

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).parent
PEERS_PYTHON = ROOT / ".venv-peers" / "bin" / "python"
OURS = [sys.executable, "-m"]
PEERS: dict[str, tuple[list[str], list[str]]] = {  # command, and what follows FOLDER THREADS
    **{
        name: ([*OURS, "benchmarks.peers.with_mrstrain"], [name])
        for name in ("gauss-newton", "gauss-newton-bone", "gauss-newton-borders", "heel-mr")
    },
    "elastix default, as acquired": ([*OURS, "benchmarks.peers.with_elastix"], ["as-acquired"]),
    "elastix default": ([*OURS, "benchmarks.peers.with_elastix"], []),
    **{
        name: ([str(PEERS_PYTHON), str(HERE / f"with_{name.lower()}.py")], [])
        for name in ("ANTs", "greedy", "SimpleITK", "SPAM", "pyALDVC", "pyxel")
    },
}
PINNED = ("antspyx", "picsl-greedy", "SimpleITK", "spam", "al-dvc", "pyxel-dic")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", nargs="+", choices=list(PAIRS), default=list(PAIRS))
    parser.add_argument("--peers", nargs="+", choices=list(PEERS), default=list(PEERS))
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--limit-s", type=float, default=900.0, help="wall time after which a peer is stopped")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    theirs = any(PEERS[peer][0][0] != sys.executable for peer in given.peers)
    if theirs and not PEERS_PYTHON.exists():
        parser.error("the peers' environment is not there: run 'make peers' first")
    earlier = json.loads(given.out.read_text()) if given.out.exists() else {"runs": [], "versions": {}}
    kept, about = earlier["runs"], earlier["versions"] | versions() | (_peer_versions() if theirs else {})
    for name in given.pairs:
        missing = [p for p in given.peers if not any(r["pair"] == name and r["peer"] == p for r in kept)]
        if not missing:
            continue
        pair = pair_named(name)
        with tempfile.TemporaryDirectory(prefix="peers-") as prepared:
            write_pair(pair, Path(prepared))
            for peer in missing:
                outcome = _run(peer, pair, Path(prepared), given.threads, given.limit_s)
                kept.append({"pair": name, "peer": peer, "threads": given.threads, "limit_s": given.limit_s} | outcome)
                given.out.parent.mkdir(parents=True, exist_ok=True)
                given.out.write_text(json.dumps({"versions": about, "runs": kept}, indent=1) + "\n")
                print(name, peer, kept[-1]["status"], f"{kept[-1]['seconds']:.0f} s", flush=True)
    print(table(kept))


def _run(peer: str, pair: HeelPair, prepared: Path, threads: int, limit_s: float) -> dict[str, Any]:
    """Outcome, wall and CPU seconds, peak memory and, where there is a result, the error by tissue."""
    count = str(threads)
    names = ("ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS", "NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    command, more = PEERS[peer]
    with tempfile.TemporaryDirectory(prefix="peer-") as name:
        folder = Path(name)
        for file in prepared.iterdir():
            (folder / file.name).symlink_to(file)
        log = folder / "log.txt"
        began, computed, memory = time.perf_counter(), _children_cpu_s(), 0
        with log.open("wb") as told:
            process = subprocess.Popen(
                [*command, str(folder), count, *more],
                cwd=ROOT,
                env=os.environ | dict.fromkeys(names, count),
                stdout=told,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # so that its children end with it
            )
            try:
                memory = peak_kib(process, limit_s)
                status = "done" if process.returncode == 0 else f"failed: {_last_line(log)}"
            except TimeoutError as late:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                status = f"stopped: {late}"
        outcome = {"status": status, "seconds": time.perf_counter() - began, "peak_gib": memory / 2**20}
        outcome["cpu_seconds"] = _children_cpu_s() - computed
        if status != "done":
            return outcome
        try:
            return outcome | {"tissues": scored(pair, _found(folder))}
        except MrstrainError as unreadable:
            return outcome | {"status": f"failed: {unreadable}".replace(f"{folder}/", "")}


def _children_cpu_s() -> float:
    """Processor time of all child processes that have ended so far, and of theirs that they waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _found(folder: Path) -> Deformation:
    """The displacement or transform that an adapter has left (see `exchange`)."""
    image = folder / "found.mha"
    if image.exists():
        return read_displacement(image)
    ours = (folder / f"found.{ending}" for ending in ("txt", "npz"))
    return read_transform(next((file for file in ours if file.exists()), folder / "found.tfm"))


def _last_line(log: Path) -> str:
    lines = log.read_text(errors="replace").strip().splitlines()
    return lines[-1].strip() if lines else "nothing said"


def _peer_versions() -> dict[str, str]:
    ask = "import importlib.metadata as m, sys; print(*(m.version(p) for p in sys.argv[1:]))"
    told = subprocess.run([str(PEERS_PYTHON), "-c", ask, *PINNED], capture_output=True, text=True, check=True).stdout
    return {f"peers' {name}": version for name, version in zip(PINNED, told.split(), strict=True)}


def table(runs: list[dict[str, Any]]) -> str:
    """Means over pairs: RMSE of max. shear; fat's displacement, median / 95th percentile, mm; time and memory.

    Time is the processor's, which other work on the machine changes far less; of runs made before it was recorded, wall
    time. On one thread of an idle machine the two are nearly the same.
    "Fat scored" is the part of fat where the peer has a displacement, of what the peer with the most has.
    """
    most: dict[str, int] = {}
    for run in runs:
        if "tissues" in run:
            most[run["pair"]] = max(most.get(run["pair"], 0), run["tissues"]["fat"]["voxels"])
    lines = [
        "| | pairs | fat | muscle | skin | bone | u, fat | fat scored | s | GiB |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for peer in dict.fromkeys(r["peer"] for r in runs):
        tried = [r for r in runs if r["peer"] == peer]
        done = [r for r in tried if "tissues" in r]
        if not done:
            lines.append(f"| {peer} | 0 of {len(tried)} | {tried[-1]['status']} |")
            continue

        def mean(tissue: str, figure: str, done: list[dict[str, Any]] = done) -> float:
            return float(np.mean([r["tissues"][tissue][figure] for r in done]))

        shear = " | ".join(f"{mean(t, 'shear_rmse'):.4f}" for t in ("fat", "muscle", "skin", "bone"))
        share = np.mean([r["tissues"]["fat"]["voxels"] / most[r["pair"]] for r in done])
        seconds = np.mean([r.get("cpu_seconds", r["seconds"]) for r in done])
        memory = np.mean([r["peak_gib"] for r in done])
        lines.append(
            f"| {peer} | {len(done)} of {len(tried)} | {shear} | {mean('fat', 'u_p50_mm'):.3f} / "
            f"{mean('fat', 'u_p95_mm'):.3f} | {share:.3f} | {seconds:.0f} | {memory:.2f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
