"""Time and memory of `mrstrain compare` on a study's results: one load with one model, and all loads with all models.

    .venv/bin/mrstrain demo --full --out heel
    .venv/bin/python -m benchmarks.compare_speed heel --out benchmarks/results/compare_speed.json

Each run is a process of its own, report included; memory is the peak of all its processes, sampled five times a second
from /proc (Linux only). The phantom has 2.3 million voxels; the mesh's cells are counted in its file.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.memory import peak_kib
from fe import read_tet_mesh
from mrstrain.records.provenance import versions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path, help="Folder of a study that was run.")
    parser.add_argument("--load", default="Load1")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    results = given.study / "results"
    models = sorted(p for p in (results / "models").iterdir() if p.is_dir())
    measured = results / "registration"
    one = [_compared(given.study, measured / given.load, models[:1]) for _ in range(given.rounds)]
    told = {
        "versions": versions(),
        "cells": len(read_tet_mesh(results / "mesh" / "mesh.vtu").cells),
        "models": [model.name for model in models],
        "one_load_one_model": one,
        "all_loads_all_models": _compared(given.study, measured, models),
    }
    given.out.write_text(json.dumps(told, indent=1) + "\n")
    print(json.dumps(told, indent=1))


def _compared(study: Path, measured: Path, models: list[Path]) -> dict[str, float]:
    """Seconds, peak memory and the report's size of one comparison."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "mrstrain", "compare", str(measured), *map(str, models), "--out", folder]
        command += ["--labels", str(study / "tissues.nii.gz"), "--names", str(study / "tissues.csv")]
        command += ["--bone", "bone", "--bone", "ankle"]
        began = time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        peak = peak_kib(process)
        if process.returncode != 0:
            raise SystemExit(f"compare ended with {process.returncode}")
        report = (Path(folder) / "report.html").stat().st_size
        return {"seconds": time.perf_counter() - began, "peak_gib": peak / 2**20, "report_mb": report / 1e6}


if __name__ == "__main__":
    main()
