"""Time of the published material sets under the four loads on one mesh, as `mrstrain simulate` runs them.

    .venv/bin/python -m benchmarks.published_sets heel.vtu --work /tmp/sets --out benchmarks/results/published_sets.json

The mesh is that of `mrstrain mesh` on the label map of heel phantom 1. Two simulations run side by side. Seconds of a
set are those of its loads, one after the other; wall and processor time and memory are those of the whole command.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.study_speed import HERE, timed
from fe import read_tet_mesh
from mrstrain.records.provenance import versions

SETS = ("friedman", "spears", "luboz", "trebbi", "zwam", "erdemir", "akrami")
TOLD = ("reached", "seconds", "iterations", "plate_displacement_mm", "plate_force_n", "nodes_on_plate",
        "volume_share_with_patch_det_f_off_by_5_percent")  # fmt: skip


def of_set(folder: Path) -> dict[str, Any]:
    """What each load of one set's folder tells, without what has no room in a table."""
    loads = json.loads((folder / "simulation.json").read_text())["outcome"]
    return {load: {key: np.round(told[key], 4).tolist() for key in TOLD} for load, told in loads.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", type=Path)
    parser.add_argument("--sets", nargs="+", default=SETS)
    parser.add_argument("--limit-minutes", type=float, default=10.0, help="limit of each path of loads")
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    work = given.work.resolve()
    choice = [word for name in given.sets for word in ("--set", name)]
    command = ["simulate", str(given.mesh.resolve()), "--out", str(work), *choice]
    command += ["--limit-minutes", str(given.limit_minutes)]
    spent = timed(HERE, *command)
    results = {
        "command": shlex.join(["mrstrain", "simulate", given.mesh.name, "--out", work.name, *command[4:]]),
        "versions": versions(),
        "cores": len(os.sched_getaffinity(0)),
        "cells": len(read_tet_mesh(given.mesh).cells),
        **{key: round(value, 2) for key, value in spent.items()},
        "sets": {name: of_set(work / name) for name in given.sets},
    }
    given.out.write_text(json.dumps(results, indent=1) + "\n")
    for name, loads in results["sets"].items():
        print(name, {load: (told["reached"], told["seconds"]) for load, told in loads.items()})
    print({key: round(value, 2) for key, value in spent.items()})


if __name__ == "__main__":
    main()
