"""Time, memory and result of the published loads in two source trees, side by side, one thread.

    git worktree add ../before COMMIT
    python -m benchmarks.fe_loads m36.vtu m81.vtu --before ../before --out benchmarks/results/fe_loads.json

Load1 to Load4 with one material set on meshes as `mrstrain mesh` makes them, --rounds times on each, in a process
of its own with the code of the tree before and of this one, in turn (every other round in the other order). Processor
time of the solution alone, after a first small load that compiles, and the peak memory of the whole process; ratios are
medians over rounds. With --steps, this tree also solves with increments of 0.1 mm while the plate comes near, and the
root mean square difference of the maximum shear strain from that solution is told for every load.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import fe
import fe.load_path
from mrstrain.records.provenance import versions

HERE = Path(__file__).resolve().parents[1]
LOADS = (("Load1", 140.0, None), ("Load2", 15.0, None), ("Load4", 15.0, 12.0), ("Load3", 15.0, 45.0))
PLATE = ((0.0, 0.0, -1.0), (0.0, -1.0, 0.0))
SMALL_MM = 0.1
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
# malloc as in the workers of a command; by itself, glibc keeps memory that depends on the order of what came before.
MEMORY = {
    "MALLOC_ARENA_MAX": "2", "MALLOC_MMAP_THRESHOLD_": str(32 << 20), "MALLOC_TRIM_THRESHOLD_": str(64 << 20)
}  # fmt: skip


def one(place: Path, material_set: str, step_mm: float | None, strains: Path | None) -> dict[str, Any]:
    """Solve the loads in this process, with the code that it imports; also write max. shear strain and volumes."""
    assert Path(fe.__file__).parents[1] == Path(os.environ["PYTHONPATH"]), "the code of another tree is imported"
    if step_mm:
        fe.load_path._FIRST_MM = fe.load_path._MOST_MM = (step_mm, step_mm)
    mesh, plate = fe.read_tet_mesh(place), fe.Plate(*PLATE)
    fe.simulate(mesh, material_set, plate, [fe.LoadStep("compiles", 0.05)])
    began = time.process_time()
    states = fe.simulate(mesh, material_set, plate, [fe.LoadStep(*load) for load in LOADS]).states
    seconds = time.process_time() - began
    corners = mesh.points_mm[mesh.cells]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6.0
    if strains:
        np.savez(strains, volumes=volumes, **{state.load.name: state.strain.max_shear for state in states})
    return {
        "cells": len(mesh.cells), "processor_s": round(seconds, 2),
        "peak_gib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, 2),
        "reached": all(state.reached == 1.0 for state in states),
        "plate_mm": {s.load.name: [round(float(v), 3) for v in s.plate_displacement_mm[:2]] for s in states},
        "nodes_on_plate": {s.load.name: len(s.on_plate) for s in states},
    }  # fmt: skip


def run(tree: Path, mesh: Path, material_set: str, strains: Path, step_mm: float | None = None) -> dict[str, Any]:
    """`one` in a process of its own with a tree's code."""
    command = [sys.executable, str(Path(__file__).resolve()), str(mesh), "--set", material_set]
    command += ["--one", str(strains), *(["--step-mm", str(step_mm)] if step_mm else [])]
    environment = os.environ | THREADS | MEMORY | {"PYTHONPATH": str(tree)}
    said = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=True)
    return dict(json.loads(said.stdout.splitlines()[-1]))


def differences(strains: Path, reference: Path) -> dict[str, float]:
    """Root mean square difference of max. shear strain over the volume, by load."""
    with np.load(strains) as these, np.load(reference) as those:
        share = these["volumes"] / these["volumes"].sum()
        return {name: round(float(np.sqrt(share @ (these[name] - those[name]) ** 2)), 5) for name, _, _ in LOADS}


def compared(mesh: Path, before: Path, material_set: str, rounds: int, *, small_steps: bool) -> dict[str, Any]:
    """Both trees on one mesh, in turn."""
    trees = {"before": before, "after": HERE}
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in trees}
    with tempfile.TemporaryDirectory() as place:
        strains = {name: Path(place) / f"{name}.npz" for name in (*trees, "small_steps")}
        for number in range(rounds):
            for name in list(trees)[:: -1 if number % 2 else 1]:
                runs[name].append(run(trees[name], mesh, material_set, strains[name]))
        pairs = zip(*runs.values(), strict=True)
        ratio = float(np.median([b["processor_s"] / a["processor_s"] for b, a in pairs]))
        result = {"cells": runs["after"][0]["cells"], "set": material_set, **runs, "before_over_after": round(ratio, 2)}
        if small_steps:
            result["small_steps"] = run(HERE, mesh, material_set, strains["small_steps"], SMALL_MM)
            result["rms_from_small_steps"] = {
                name: differences(strains[name], strains["small_steps"]) for name in trees
            }
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path, nargs="+")
    parser.add_argument("--before", type=Path)
    parser.add_argument("--set", default="trebbi", help="the material set")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--steps", action="store_true", help="compare with small steps as well")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--one", type=Path, help="solve one mesh here, write its strain to this file, print the rest")
    parser.add_argument("--step-mm", type=float)
    given = parser.parse_args()
    if given.one:
        print(json.dumps(one(given.meshes[0].resolve(), given.set, given.step_mm, given.one)))
        return
    if not given.before or not given.out:
        parser.error("give --before and --out")
    before, done = given.before.resolve(), []
    describe = ("git", "describe", "--always", "--dirty")
    commits = [subprocess.check_output(describe, cwd=tree, text=True) for tree in (before, HERE)]
    of = {"versions": versions(), "machine": platform.machine(), "commits": [commit.strip() for commit in commits]}
    for mesh in given.meshes:
        done.append(compared(mesh.resolve(), before, given.set, given.rounds, small_steps=given.steps))
        print(json.dumps(done[-1]), flush=True)
        given.out.write_text(json.dumps(of | {"runs": done}, indent=1) + "\n")


if __name__ == "__main__":
    main()
