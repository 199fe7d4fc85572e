"""Error with one smooth spline and with strain that may be discontinuous at the bone alone, on heels set aside.

    python -m benchmarks.at_bone --out benchmarks/results/at_bone.json
    python -m benchmarks.at_bone --seeds 9000 --motions Load1 Load3 --off -1 1 --out ...

Phantom heels (0.8 mm, SNR 25) registered without a label map, with the bone mask as it is, or too small or too large by
a voxel all around (``--off``). Scored are all labelled voxels: root mean square error of the max. shear by tissue, and
in fat within 1.5 mm of the bone. One thread. Rows are added to those that the file holds.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from scipy.ndimage import binary_dilation, binary_erosion

from dvc import Engine, GaussNewton, GaussNewtonAtBone, Mask, Settings, register, tissue_mask
from dvc.worker import Worker
from mrstrain.records.provenance import versions
from phantoms import Heel, HeelPair, distances_mm, errors_by_tissue, heel_pair, motion_named

NEAR_MM = 1.5


def off_by(bone: Mask, voxels: int) -> Mask:
    """The mask with a voxel more or less all around."""
    change = {-1: binary_erosion, 0: lambda inside: inside, 1: binary_dilation}[voxels]
    return Mask(bone.grid, change(bone.inside))


def scored(pair: HeelPair, bone: Mask, engine: Engine, worker: Worker) -> dict[str, float]:
    began = time.perf_counter()
    body, settings = tissue_mask(pair.reference), Settings(engine, threads=1)
    found = register(pair.reference, pair.loaded, bone=bone, tissue=body, settings=settings, worker=worker)
    seconds = time.perf_counter() - began
    labelled = pair.labels.labels > 0
    near = pair.labels.region("fat").inside & (distances_mm(pair.labels)[0] <= NEAR_MM)
    rows = errors_by_tissue(pair.labels, pair.deformation, found.deformation, labelled)
    (beside,) = errors_by_tissue(pair.labels, pair.deformation, found.deformation, near)
    errors = {row.tissue: round(float(row.shear_rmse), 4) for row in rows}
    return errors | {"near bone": round(float(beside.shear_rmse), 4), "seconds": round(seconds, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[9000, 9001])
    parser.add_argument("--motions", nargs="+", default=["Load1", "Load3", "sliding", "smooth"])
    parser.add_argument("--off", type=int, nargs="+", default=[0], choices=[-1, 0, 1])
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    rows = json.loads(given.out.read_text())["rows"] if given.out.exists() else []
    with Worker(1) as worker:
        for seed in given.seeds:
            for motion in given.motions:
                pair = heel_pair(seed, motion=motion_named(Heel(seed), motion))
                for voxels in given.off:
                    for engine in (GaussNewton(), GaussNewtonAtBone()):
                        told = {"seed": seed, "motion": motion, "off": voxels, "engine": engine.name}
                        rows.append(told | scored(pair, off_by(pair.bone, voxels), engine, worker))
                        print(json.dumps(rows[-1]), flush=True)
                        given.out.write_text(json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
