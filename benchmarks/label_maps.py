"""Error with label maps, or bone masks, that are right, too large and too small, each of them under every motion.

    python -m benchmarks.label_maps --work DIR --out benchmarks/results/accuracy/label-maps
    python -m benchmarks.label_maps --work DIR2 --engine gauss-newton-bone --off 0 --out .../accuracy/bone-masks

The accuracy study combines each motion with one of the three, in turn. Here all are combined, on the heels that nothing
is tuned on (0.8 mm, SNR 25): 42 registrations, 20 minutes on two cores.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import mrstrain
from phantoms import AccuracyCase

MOTIONS = ("still", "smooth", "sliding", "Load1", "Load2", "Load3", "Load4")
SEEDS = 9000, 9001
LABELS_OFF = 0, 1, -1
ENGINES = "gauss-newton-borders", "gauss-newton-bone"
KEPT = "errors.csv", "runs.csv", "zero_strain.csv"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--engine", choices=ENGINES, default=ENGINES[0])
    parser.add_argument("--off", type=int, nargs="+", choices=LABELS_OFF, default=LABELS_OFF, help="voxels too large")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    cases = [
        AccuracyCase(given.engine, (0.8, 0.8, 0.8), 25.0, motion, seed, off)
        for off in given.off
        for motion in MOTIONS
        for seed in SEEDS
    ]
    if (runs := given.work / "runs").exists() and {one.stem for one in runs.glob("*.npz")} - {
        one.name for one in cases
    }:
        parser.error(f"{given.work} has runs of other cases, which would be in the tables")
    done = mrstrain.accuracy(given.work, cases=cases)
    if done.failures:
        raise SystemExit(f"Incomplete: {done.failures}")
    given.out.mkdir(parents=True, exist_ok=True)
    for name in KEPT:
        shutil.copy(given.work / name, given.out / name)


if __name__ == "__main__":
    main()
