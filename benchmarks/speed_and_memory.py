"""Time beside plain elastix, and peak memory of a 256^3 pair.

    python benchmarks/speed_and_memory.py --out benchmarks/results/speed_and_memory.json

Speed: the same pair, masks and threads in one warm process, in turn: `dvc.register` (shading, search, rigid, non-rigid)
with our own engine and with elastix, and plain elastix (rigid on the bone, then the same B-spline parameters on the
tissue, result image). A phantom set of Load0 to Load4 is timed once. Memory: `mrstrain register` on a pair of 256^3
voxels, sum over all of its processes, sampled five times a second from /proc (Linux only); shared pages are counted by
their share.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.memory import peak_kib
from dvc import elastix
from dvc.elastixtext import format_parameters
from dvc.image import Grid, Image, Mask
from dvc.imagewrite import write_image, write_mask
from dvc.presets import load_preset
from dvc.registration import Settings, register
from dvc.resample import carry
from dvc.tissue import tissue_mask, widened
from dvc.worker import Worker, usable_cores
from mrstrain.making import phantom
from mrstrain.provenance import versions
from phantoms.heel import HeelPair, heel_pair

RESULT = {"WriteResultImage": ("true",)}


def plain(pair: HeelPair, body: Mask, worker: Worker) -> None:
    with tempfile.TemporaryDirectory() as folder:
        rigid = worker.run(
            "plain elastix", elastix.register, pair.reference, pair.loaded,
            load_preset("bone-rigid").complete(seed=1), pair.bone, None, None, folder,
        )  # fmt: skip
        start = Path(folder) / "rigid.txt"
        start.write_text(format_parameters(rigid.transform))
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


def memory(name: str) -> dict[str, float]:
    pair = heel_pair(seed=1, load=0.6)
    low, high = pair.reference.grid.bounds_mm()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for stem, image in (("Load0", pair.reference), ("Load1", pair.loaded)):
            low, high = image.grid.bounds_mm()
            step = (high - low) / 256
            grid = Grid((256, 256, 256), step, low + step / 2)
            values = np.nan_to_num(carry(image, grid, order=1))
            noise = np.random.default_rng(len(stem)).normal(scale=1.0, size=grid.shape)
            write_image(folder / f"{stem}.nii.gz", Image(grid, values + noise.astype(np.float32)))
        write_mask(folder / "bone.nii.gz", pair.bone)
        began = time.perf_counter()
        command = [
            sys.executable,
            "-m",
            "mrstrain",
            "register",
            str(folder / "Load0.nii.gz"),
            str(folder / "Load1.nii.gz"),
        ]
        command += ["--bone", str(folder / "bone.nii.gz"), "--out", str(folder / "out")]
        command += [] if name == "gauss-newton" else ["--preset", name]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        peak = peak_kib(process)
        return {
            "exit_status": process.returncode,
            "peak_gib": peak / 2**20,
            "seconds": time.perf_counter() - began,
            "voxels": 256**3,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    results = {"versions": versions(), "cores": os.cpu_count(), "speed": speed(given.rounds)}
    results |= {"phantom_set_s": phantom_seconds(), "memory": {n: memory(n) for n in ("gauss-newton", "heel-mr")}}
    print(json.dumps(results, indent=1))
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
