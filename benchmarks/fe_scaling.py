"""Time and memory against the number of cells: one lift of the sole, and the published Load1 whole, one thread.

    .venv/bin/python -m benchmarks.fe_scaling m20.vtu m80.vtu --halved m40.vtu --out benchmarks/results/fe_scaling.json

Meshes of one label map with edges of other lengths, as `mrstrain mesh` makes them; --halved adds one whose every edge
is halved (eight cells from each), for sizes that take long to mesh. Each is solved in a process of its own, all in turn
and again, and the least time counts. Exponents are those of a power law through all meshes.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fe_speed import ours
from dvc import TetMesh
from dvc.arrays import IntArray
from fe import LoadStep, Plate, Problem, material_set, read_tet_mesh, solve, write_tet_mesh
from mrstrain.records.provenance import versions

LOAD = LoadStep("Load1", 140.0)
FIGURES = ("lift_s", "load_s", "peak_gib")


# Corners of the eight cells within a cell: 0 to 3 its own, 4 to 9 the middles of its edges 01, 02, 03, 12, 13, 23.
_EDGES = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
_EIGHT = (
    (0, 4, 5, 6), (4, 1, 7, 8), (5, 7, 2, 9), (6, 8, 9, 3), (4, 5, 6, 8), (4, 7, 5, 8), (5, 9, 6, 8), (5, 7, 9, 8),
)  # fmt: skip
_FOUR = ((0, 3, 4), (3, 1, 5), (4, 5, 2), (3, 5, 4))  # of a face with the middles of its edges 01, 02, 12


def halved(mesh: TetMesh) -> TetMesh:
    """The mesh with every edge halved: eight cells from each, four faces from each."""
    ends = np.sort(mesh.cells[:, _EDGES].reshape(-1, 2), axis=1)
    edges, of_cells = np.unique(ends, axis=0, return_inverse=True)
    count = len(mesh.points_mm)
    points = np.concatenate([mesh.points_mm, mesh.points_mm[edges].mean(axis=1)])
    corners = np.hstack([mesh.cells, count + of_cells.reshape(-1, 6)])
    cells = corners[:, _EIGHT].reshape(-1, 4)
    keys = edges[:, 0] * count + edges[:, 1]

    def middles(faces: IntArray) -> IntArray:
        pairs = np.sort(faces[:, ((0, 1), (0, 2), (1, 2))], axis=2)
        return count + np.searchsorted(keys, pairs[..., 0] * count + pairs[..., 1])

    facets = {name: np.hstack([faces, middles(faces)])[:, _FOUR].reshape(-1, 3) for name, faces in mesh.facets.items()}
    regions = {name: (8 * of[:, None] + np.arange(8)).ravel() for name, of in mesh.regions.items()}
    return TetMesh(points, cells, regions=regions, facets=facets)


def one(place: Path) -> dict[str, Any]:
    """Processor seconds of the lift and of Load1 in this process, and its peak memory."""
    mesh = read_tet_mesh(place)
    laws, _ = material_set("trebbi").for_regions(mesh.regions)
    ours(place, "P1")  # compiles
    began = time.process_time()
    lift = ours(place, "P1")
    lifted = time.process_time()
    (state,) = solve(Problem(mesh, laws, Plate((0.0, 0.0, -1.0), (0.0, -1.0, 0.0)), [LOAD]))
    return {
        "cells": len(mesh.cells), "nodes": len(mesh.points_mm), "lift_s": lifted - began, "lift_n": lift["force_n"],
        "load_s": time.process_time() - lifted, "iterations": state.iterations, "reached": state.reached,
        "travel_mm": float(state.plate_displacement_mm[0]),
        "peak_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
    }  # fmt: skip


def measured(meshes: list[Path], rounds: int) -> list[dict[str, Any]]:
    """Each mesh in a process of its own, all in turn and again."""
    runs = []
    for _ in range(rounds):
        for mesh in meshes:
            argv = [sys.executable, "-m", "benchmarks.fe_scaling", str(mesh), "--one"]
            said = subprocess.run(argv, capture_output=True, text=True, check=True)
            runs.append(json.loads(said.stdout.splitlines()[-1]))
            print(runs[-1], flush=True)
    return runs


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", type=Path, nargs="+")
    parser.add_argument("--halved", type=Path, help="a mesh whose edges are halved first, beside the others")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--one", action="store_true", help="solve one mesh here and print its figures")
    given = parser.parse_args()
    if given.one:
        print(json.dumps(one(given.meshes[0])))
        return
    with tempfile.TemporaryDirectory() as folder:
        meshes = list(given.meshes)
        if given.halved:
            meshes.append(Path(folder) / "halved.vtu")
            write_tet_mesh(meshes[-1], halved(read_tet_mesh(given.halved)), {})
        runs = measured(meshes, given.rounds)
    cells = sorted({run["cells"] for run in runs})
    least = {key: [min(run[key] for run in runs if run["cells"] == n) for n in cells] for key in FIGURES}
    exponents = {key: float(np.polyfit(np.log(cells), np.log(of), 1)[0]) for key, of in least.items()}
    results = {"versions": versions(), "cells": cells, "least": least, "exponents": exponents, "runs": runs}
    print(exponents)
    if given.out:
        given.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
