"""Does a pair's twin tell its error? Heels with known strain, registered with `--twin`; true error beside the twin's.

    .venv/bin/python -m benchmarks.twin_check --work /tmp/twins --out benchmarks/results/twin_check.json

For each heel, load and tissue: root mean square error of the max. shear, true and in the twin; the share of voxels
whose truth lies within 1.96 standard deviations of the error model about its bias, as it is and as wide as the twin
made it; the factor. Seconds of the whole command, and the peak memory of this process and of the largest it started.
What is there already in the work folder is not made again.
"""

from __future__ import annotations

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np

from dvc import read_error_model, read_image, read_labels
from dvc.atomic_files import write_json
from dvc.images.depth import to_surface_mm
from mrstrain import phantom, register
from mrstrain.records.provenance import versions
from phantoms import RIGID

HEELS = ((1, 6.0, "Load1"), (2, 12.0, "Load1"), (3, 6.0, "Load3"))
"""Seed, width of the fat's lobules (mm) and load."""


def made(work: Path, seed: int, lobule_mm: float, load: str) -> tuple[Path, float]:
    """The heel's images with their truth, registered with its twin; the folder, and the command's seconds."""
    place = work / f"{seed}-{lobule_mm:g}-{load}"
    if not (place / "Load0.nii.gz").is_file():
        phantom(place, seed=seed, loads=(load,), lobule_mm=lobule_mm)
    began = time.monotonic()
    if not (place / "results" / load / "quality.json").is_file():
        register(
            place / "Load0.nii.gz", [place / f"{load}.nii.gz"], out=place / "results",
            bone=place / "calcaneus.nii.gz", labels=place / "tissues.nii.gz", names=place / "tissues.csv",
            twin=True, threads=1,
        )  # fmt: skip
    return place, time.monotonic() - began


def rows(place: Path, load: str) -> list[dict[str, object]]:
    """By tissue, what the truth says of the error and what the twin says of it."""
    found = place / "results" / load
    shear, true = (
        read_image(folder / "max_shear.nii.gz", allow_missing=True).values for folder in (found, place / "truth" / load)
    )
    labels = read_labels(place / "tissues.nii.gz", place / "tissues.csv")
    table = read_error_model(found / "error_model.json").tables[0]
    bones = [number for number, name in labels.names.items() if name in RIGID]
    to_bone = to_surface_mm(np.isin(labels.labels, bones), labels.grid.spacing_mm)
    told = json.loads((found / "quality.json").read_text())["error_of_max_shear"]
    lines: list[dict[str, object]] = []
    for twin in told["twin"]:
        kept = labels.region(twin["region"]).inside & np.isfinite(shear) & np.isfinite(true)
        error = (shear - true)[kept]
        bias, sd = table.expected(twin["region"], shear[kept].astype(np.float64), to_bone[kept])
        held = [float(np.mean(np.abs(error - bias) < 1.96 * factor * sd)) for factor in (1.0, twin["factor"])]
        lines.append(
            {"tissue": twin["region"], "true_rms": float(np.sqrt(np.mean(error**2))), "twin_rms": twin["rms_error"],
             "factor": twin["factor"], "held_by_model": held[0], "held_with_twin": held[1]}
        )  # fmt: skip
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    heels = []
    for seed, lobule_mm, load in HEELS:
        place, seconds = made(given.work, seed, lobule_mm, load)
        heels.append(
            {"seed": seed, "lobule_mm": lobule_mm, "load": load, "seconds": seconds, "tissues": rows(place, load)}
        )
        print(json.dumps(heels[-1]), flush=True)
    own, started = (
        resource.getrusage(who).ru_maxrss / 2**20 for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    write_json(given.out, {"versions": versions(), "heels": heels, "peak_gib": {"own": own, "started": started}})


if __name__ == "__main__":
    main()
