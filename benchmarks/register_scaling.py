"""Time and memory of `mrstrain register` against the number of voxels.

    python -m benchmarks.register_scaling --sizes 128 192 256 --out benchmarks/results/register_scaling.json
    python -m benchmarks.register_scaling --labels --sizes 128 192 256 --out ...

Heel phantom 1 under load, its body's field of view divided into n^3 voxels with noise of their own, as a command of its
own on all cores: processor time of all of its processes, and the peak of their memory (Linux only). With ``--labels``
strain may jump at the borders of tissues. Runs are added to those that the file holds.
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

import numpy as np

from benchmarks.memory import peak_kib
from dvc import Grid, Image, fit_mask, write_image, write_labels, write_mask
from dvc.images.resample import carry
from mrstrain.records.provenance import versions
from phantoms import HeelPair, heel_pair


def divided(grid: Grid, count: int) -> Grid:
    """The same field of view in count^3 voxels."""
    low, high = grid.bounds_mm()
    step = (high - low) / count
    return Grid((count, count, count), step, low + step / 2)


def written(pair: HeelPair, count: int, folder: Path) -> None:
    """Images, bone and label map of a pair on count^3 voxels."""
    for seed, (stem, image) in enumerate((("Load0", pair.reference), ("Load1", pair.loaded))):
        grid = divided(image.grid, count)
        noise = np.random.default_rng(seed).normal(scale=1.0, size=grid.shape).astype(np.float32)
        write_image(folder / f"{stem}.nii.gz", Image(grid, np.nan_to_num(carry(image, grid, order=1)) + noise))
    write_mask(folder / "bone.nii.gz", pair.bone)
    write_labels(folder / "tissues.nii.gz", fit_mask(pair.labels, divided(pair.reference.grid, count), "label map"))


def registered(pair: HeelPair, count: int, labels: bool, preset: str | None, one_spline: bool) -> dict[str, object]:
    """One run of the command."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        written(pair, count, folder)
        command = [
            sys.executable,
            "-m",
            "mrstrain",
            "register",
            str(folder / "Load0.nii.gz"),
            str(folder / "Load1.nii.gz"),
        ]
        command += ["--bone", str(folder / "bone.nii.gz"), "--out", str(folder / "out")]
        command += (
            ["--labels", str(folder / "tissues.nii.gz"), "--names", str(folder / "tissues.csv")] if labels else []
        )
        command += [] if preset is None else ["--preset", preset]
        command += ["--no-borders"] if one_spline else []
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        peak = peak_kib(process)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return {
            "voxels": count**3,
            "labels": labels,
            "preset": preset,
            "one_spline": one_spline,
            "exit_status": process.returncode,
            "processor_s": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
            "wall_s": round(time.perf_counter() - began, 1),
            "peak_gib": round(peak / 2**20, 2),
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[128, 192, 256])
    parser.add_argument("--labels", action="store_true")
    parser.add_argument("--preset")
    parser.add_argument("--one-spline", action="store_true", help="without strain discontinuities")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    pair = heel_pair(seed=1, load=0.6)
    for count in given.sizes:
        runs = json.loads(given.out.read_text())["runs"] if given.out.is_file() else []
        runs.append(registered(pair, count, given.labels, given.preset, given.one_spline))
        print(runs[-1], flush=True)
        given.out.write_text(json.dumps({"versions": versions(), "runs": runs}, indent=1) + "\n")


if __name__ == "__main__":
    main()
