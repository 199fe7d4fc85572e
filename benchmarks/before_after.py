"""Time, memory and results of `mrstrain register` in two source trees, side by side.

    git worktree add ../before COMMIT
    python -m benchmarks.before_after --before ../before --sizes 64 128 256 --out benchmarks/results/before_after.json

Heel phantom 1 under load, in n^3 voxels with noise of their own, with one smooth spline, with a bone mask alone and
with the label map, as a command of its own on all cores: each round runs the command of the tree before and of this
one, in turn. Wall and processor time of all its processes, the peak of their memory (Linux only), the median over
rounds of the ratios of time, the root mean square difference of the maximum shear strain in all voxels where both
measure it, and its root mean square error against the phantom's truth by tissue.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from benchmarks.memory import peak_kib
from benchmarks.register_scaling import written
from dvc import read_image
from dvc.io.result_folder import spline_in
from mrstrain.records.provenance import versions
from phantoms import HeelPair, errors_by_tissue, heel_pair

HERE = Path(__file__).resolve().parents[1]
KINDS = {
    "one spline": ["--no-borders"], "bone alone": [], "labels": ["--labels", "tissues.nii.gz", "--names", "tissues.csv"]
}  # fmt: skip


def run(tree: Path, folder: Path, kind: str, out: Path, variables: Mapping[str, str] | None = None) -> dict[str, float]:
    """One run of the command with a tree's code, and variables of the environment beside those here."""
    command = [sys.executable, "-m", "mrstrain", "register", "Load0.nii.gz", "Load1.nii.gz"]
    command += ["--bone", "bone.nii.gz", "--out", str(out), *KINDS[kind]]
    environment = os.environ | {"PYTHONPATH": str(tree)} | dict(variables or {})
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # an installed copy holds the bytecode of its modules
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.DEVNULL)
    peak = peak_kib(process)
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_CHILDREN)
    if process.returncode:
        raise RuntimeError(f"{' '.join(command)} in {tree} ended with status {process.returncode}")
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {"wall_s": round(wall, 2), "processor_s": round(processor, 2), "peak_gib": round(peak / 2**20, 2)}


def errors_of(pair: HeelPair, load: Path) -> dict[str, float]:
    """Root mean square error of a load's maximum shear strain against the truth, by tissue."""
    everywhere = np.ones(pair.labels.grid.shape, dtype=bool)
    rows = errors_by_tissue(pair.labels, pair.deformation, spline_in(load), everywhere)
    return {row.tissue: round(float(row.shear_rmse), 4) for row in rows}


def compared(before: Path, count: int, kind: str, rounds: int, warms: int) -> dict[str, object]:
    """Both trees on one pair, in turn; rounds before the others only warm their compiled loops."""
    trees = {"before": before, "after": HERE}
    runs: dict[str, list[dict[str, float]]] = {name: [] for name in trees}
    pair = heel_pair(seed=1, load=0.6)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        written(pair, count, folder)
        for number in range(-warms, rounds):
            for name, tree in trees.items():
                one = run(tree, folder, kind, folder / name)
                if number >= 0:
                    runs[name].append(one)
        errors = {name: errors_of(pair, folder / name / "Load1") for name in trees}
        shear = [read_image(folder / name / "Load1" / "max_shear.nii.gz", allow_missing=True).values for name in trees]
    both = np.isfinite(shear[0]) & np.isfinite(shear[1])
    ratios = {
        key: round(float(np.median([b[key] / a[key] for b, a in zip(*runs.values(), strict=True)])), 2)
        for key in ("wall_s", "processor_s", "peak_gib")
    }
    return {
        "voxels": count**3, "kind": kind, **runs, "before_over_after": ratios,
        "rms_error_of_max_shear": errors,
        "rms_difference_of_max_shear": float(np.sqrt(np.mean((shear[0][both] - shear[1][both]) ** 2.0))),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, required=True)
    parser.add_argument("--sizes", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    done: list[dict[str, object]] = []
    for count in given.sizes:
        for kind in given.kinds:
            warms = int(count == given.sizes[0])
            done.append(compared(given.before.resolve(), count, kind, given.rounds, warms))
            print(json.dumps(done[-1]), flush=True)
            given.out.write_text(json.dumps({"versions": versions(), "cores": os.cpu_count(), "runs": done}, indent=1))


if __name__ == "__main__":
    main()
