"""Time and memory against the number of cells: one lift of the sole, and the published Load1 whole, one thread.

    .venv/bin/python -m benchmarks.fe_scaling m20.vtu m80.vtu m320.vtu --out benchmarks/results/fe_scaling.json

Meshes of one label map with edges of other lengths, as `mrstrain mesh` makes them. Each is solved in a process of its
own, all in turn and again, and the least time counts. Exponents are those of a power law through all meshes.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fe_speed import ours
from fe.meshstore import read_tet_mesh
from fe.plate import Plate
from fe.published import material_set
from fe.simulate import LoadStep, simulate
from mrstrain.provenance import versions

LOAD = LoadStep("Load1", 140.0)
FIGURES = ("lift_s", "load_s", "peak_gib")


def one(place: Path) -> dict[str, Any]:
    """Processor seconds of the lift and of Load1 in this process, and its peak memory."""
    mesh = read_tet_mesh(place)
    laws, _ = material_set("trebbi").for_regions(mesh.regions)
    ours(place, "P1")  # compiles
    began = time.process_time()
    lift = ours(place, "P1")
    lifted = time.process_time()
    (state,) = simulate(mesh, laws, Plate((0.0, 0.0, -1.0), (0.0, -1.0, 0.0)), [LOAD])
    return {
        "cells": len(mesh.cells), "nodes": len(mesh.points_mm), "lift_s": lifted - began, "lift_n": lift["force_n"],
        "load_s": time.process_time() - lifted, "iterations": state.iterations, "reached": state.reached,
        "travel_mm": float(state.travel_mm[0]),
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path, nargs="+")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--one", action="store_true", help="solve one mesh here and print its figures")
    given = parser.parse_args()
    if given.one:
        print(json.dumps(one(given.meshes[0])))
        return
    runs = []
    for _ in range(given.rounds):
        for mesh in given.meshes:
            argv = [sys.executable, "-m", "benchmarks.fe_scaling", str(mesh), "--one"]
            said = subprocess.run(argv, capture_output=True, text=True, check=True)
            runs.append(json.loads(said.stdout.splitlines()[-1]))
            print(runs[-1], flush=True)
    cells = sorted({run["cells"] for run in runs})
    least = {key: [min(run[key] for run in runs if run["cells"] == n) for n in cells] for key in FIGURES}
    exponents = {key: float(np.polyfit(np.log(cells), np.log(of), 1)[0]) for key, of in least.items()}
    results = {"versions": versions(), "cells": cells, "least": least, "exponents": exponents, "runs": runs}
    print(exponents)
    if given.out:
        given.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
