"""How long a simulation takes that cannot reach equilibrium: a heel under Load1 with a material that is mistaken.

    .venv/bin/python -m benchmarks.no_equilibrium heel.vtu --out benchmarks/results/no_equilibrium.json

Materials are those of the set trebbi but for one: fat of 10 Pa, a skin whose stress falls, or one whose stress falls
steeply. Told are seconds, seconds of processor time, linear solutions, and the fraction of the load that is reached.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import fe
from fe.linear import Solver
from mrstrain.records.provenance import versions

MISTAKEN = {
    "fat of 10 Pa": ("fat", fe.NeoHooke.of(1e-5)),
    "skin whose stress falls": ("skin", fe.Yeoh.of(0.03, c20_mpa=-0.02)),
    "skin whose stress falls steeply": ("skin", fe.Yeoh.of(0.01, c20_mpa=-0.1)),
}
LOAD = fe.LoadStep("Load1", 140.0)
DOWN, FORWARD = (0.0, 0.0, -1.0), (0.0, -1.0, 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    mesh = fe.read_tet_mesh(given.mesh)
    sound = fe.material_set("trebbi").for_regions(mesh.regions)[0]
    solutions, solve = [0], Solver.solve

    def counted(solver: Solver, *of: object) -> object:
        solutions[0] += 1
        return solve(solver, *of)  # type: ignore[arg-type]

    Solver.solve = counted  # type: ignore[method-assign, assignment]
    rows = []
    for name, (tissue, law) in MISTAKEN.items():
        solutions[0], began, computed = 0, time.perf_counter(), time.process_time()
        done = fe.simulate(mesh, {**sound, tissue: law}, fe.Plate(DOWN, FORWARD), [LOAD])
        seconds, processor_s = round(time.perf_counter() - began, 1), round(time.process_time() - computed, 1)
        reached = round(done.states[0].reached, 3)
        cost = {"seconds": seconds, "processor_s": processor_s, "solutions": solutions[0]}
        rows.append({"material": name, **cost, "reached": reached})
        print(rows[-1], flush=True)
    given.out.write_text(json.dumps({"versions": versions(), "cells": len(mesh.cells), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
