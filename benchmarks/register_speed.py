"""Time of a registration beside plain elastix.

    python -m benchmarks.register_speed --out benchmarks/results/register_speed.json

The same pair, masks and threads in one warm process, in turn: `dvc.register` (shading, search, rigid, non-rigid)
with our own engine and with elastix, and plain elastix (rigid on the bone, then the same B-spline parameters on the
tissue, result image). A phantom set of Load0 to Load4 is timed once.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import numpy as np

from dvc import Mask, Settings, load_preset, read_parameter_file, register, tissue_mask
from dvc.images.tissue import widened
from dvc.io.transforms.elastix_text import format_parameters
from dvc.registration.elastix import run as elastix
from dvc.threads import usable_cores
from dvc.worker import Worker
from mrstrain import phantom
from mrstrain.records.provenance import versions
from phantoms import HeelPair, heel_pair

RIGID = Path(__file__).with_name("bone_rigid.txt")
RESULT = {"WriteResultImage": ("true",)}


def plain(pair: HeelPair, body: Mask, worker: Worker) -> None:
    with tempfile.TemporaryDirectory() as folder:
        rigid = worker.run(
            "plain elastix", elastix.register, pair.reference, pair.loaded,
            read_parameter_file(RIGID).complete(seed=1), pair.bone, None, None, folder,
        )  # fmt: skip
        start = Path(folder) / "rigid.txt"
        start.write_text(format_parameters(rigid))
        worker.run(
            "plain elastix", elastix.register, pair.reference, pair.loaded,
            load_preset("heel-mr").complete(seed=1) | RESULT, widened(body, 3.0), None, str(start), folder,
        )  # fmt: skip


def speed(rounds: int) -> dict[str, object]:
    threads = usable_cores()
    pair = heel_pair(seed=1, load=0.6)
    body = tissue_mask(pair.reference)
    taken: dict[str, list[float]] = {"gauss-newton": [], "heel-mr": [], "plain elastix": []}
    with Worker(threads) as worker:
        worker.run("warming up", elastix.self_test)
        for _ in range(rounds):
            for name, seconds in taken.items():
                began = time.perf_counter()
                if name == "plain elastix":
                    plain(pair, body, worker)
                else:
                    settings = Settings.of(name, threads=threads)
                    register(pair.reference, pair.loaded, bone=pair.bone, tissue=body, settings=settings, worker=worker)
                seconds.append(time.perf_counter() - began)
    beside = {
        name: float(np.median(np.array(seconds) / np.array(taken["plain elastix"]))) for name, seconds in taken.items()
    }
    return {"threads": threads, "seconds": taken, "median_of_ratios_to_plain_elastix": beside}


def phantom_seconds() -> float:
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        phantom(Path(folder) / "heel", seed=1)
        return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    results = {"versions": versions(), "cores": os.cpu_count(), "speed": speed(given.rounds)}
    results["phantom_set_s"] = phantom_seconds()
    print(json.dumps(results, indent=1))
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
