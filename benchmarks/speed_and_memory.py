"""Time beside plain elastix, and peak memory of a 256^3 pair.

    python benchmarks/speed_and_memory.py --out benchmarks/results/speed_and_memory.json

Speed: the same pair, parameters, masks and threads in one warm process, in turn: `dvc.register` (shading, search,
rigid, non-rigid), and plain elastix (rigid on the bone, then the same B-spline parameters on the tissue, result image).
Memory: `mrstrain register` on a pair of 256^3 voxels, sum over all of its processes, sampled five times a second from
/proc (Linux only); shared pages are counted by their share.
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
    ours, theirs = [], []
    with Worker(threads) as worker:
        worker.run("warming up", elastix.self_test)
        for _ in range(rounds):
            began = time.perf_counter()
            settings = Settings.of("heel-mr", threads=threads)
            register(pair.reference, pair.loaded, bone=pair.bone, tissue=body, settings=settings, worker=worker)
            ours.append(time.perf_counter() - began)
            began = time.perf_counter()
            plain(pair, body, worker)
            theirs.append(time.perf_counter() - began)
    ratio = float(np.median(np.array(ours) / np.array(theirs)))
    return {"threads": threads, "register_s": ours, "plain_elastix_s": theirs, "ratio_of_medians_by_round": ratio}


def memory() -> dict[str, float]:
    pair = heel_pair(seed=1, load=0.6)
    low, high = pair.reference.grid.bounds_mm()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
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
    results = {"versions": versions(), "cores": os.cpu_count(), "speed": speed(given.rounds), "memory": memory()}
    print(json.dumps(results, indent=1))
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
