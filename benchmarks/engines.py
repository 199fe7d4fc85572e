"""Error, time and memory of both engines on the same heels: heel-mr and another set (elastix) beside gauss-newton.

    python -m benchmarks.engines --seeds 1 2 --motions smooth Load1 --out benchmarks/results/engines.json

Both take the same images, masks and search for the bone, on one thread each; "labels" is gauss-newton with the
phantom's own label map. Besides the motions of the accuracy study there is "gentle-R": the smooth one, 1.15 times as
large, rising over R times the distance from the bone. Scored are all labelled voxels whose true place lies 4 mm or
more inside the loaded image. Seconds are the worker process' own processor time from the bone's
alignment to the end (Linux), so that other work on the machine counts little; wall time is told as well.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from dvc import (
    Deformation,
    GaussNewton,
    GaussNewtonWithInterfaces,
    Mask,
    Settings,
    StrainField,
    evaluate_on_grid,
    register,
)
from dvc.arrays import BoolArray
from dvc.deformation.protocol import Motion
from dvc.images.resample import shows
from dvc.registration.elastix import run as elastix
from dvc.worker import Worker
from mrstrain.records.provenance import versions
from phantoms import Heel, HeelPair, distances_mm, heel_pair, motion_named, pressed

ENGINES = {
    "elastix, heel-mr": Settings.of("heel-mr"),
    "elastix, 4 mm": Settings.of(str(Path(__file__).with_name("four_mm.txt"))),
    "gauss-newton": Settings(GaussNewton()),
    "gauss-newton, bending 1": Settings(GaussNewton(bending=1.0)),
    "gauss-newton, labels": Settings(GaussNewtonWithInterfaces()),
}
MARGIN_MM = 4.0
NEAR_MM = 3.0


def motion_of(heel: Heel, name: str) -> Motion | None:
    if not name.startswith("gentle-"):
        return motion_named(heel, name)
    smooth = pressed(heel, 1.15)
    return replace(smooth, rest=replace(smooth.rest, ramp=float(name.removeprefix("gentle-"))))


def processor_seconds(pid: int) -> float:
    """Processor time that a process has used so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def peak_gib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def errors(pair: HeelPair, still: bool, found: Deformation) -> dict[str, dict[str, float]]:
    """Of the max. shear: root mean square and mean error; of the displacement: median and 95th percentile, mm."""
    labels = pair.labels
    X, inside = labels.grid.points(labels.labels > 0), labels.labels > 0
    u, H = (np.zeros_like(X), np.zeros((len(X), 3, 3))) if still else pair.deformation.evaluate(X)
    seen = shows(pair.repeat if still else pair.loaded, pair.foot_motion.apply(X + u), MARGIN_MM)
    found_u, found_H = evaluate_on_grid(found, labels.grid, inside)
    measured = StrainField.from_gradient(found_H)
    truth = StrainField.from_gradient(H)
    error = measured.max_shear - truth.max_shear
    distance = np.linalg.norm(found_u - u, axis=1)
    tissue = labels.labels[inside]
    number = {name: key for key, name in labels.names.items()}
    to_bone, to_border = (d[inside] for d in distances_mm(labels))
    fat = tissue == number["fat"]
    places: dict[str, BoolArray] = {name: tissue == number[name] for name in ("fat", "muscle", "skin", "bone")}
    places["fat within 3 mm of bone"] = fat & (to_bone < NEAR_MM)
    places["fat 3 mm from any border"] = fat & (to_border > NEAR_MM)
    places["soft tissue"] = places["fat"] | places["muscle"] | places["skin"]
    rows = {}
    for name, where in places.items():
        kept = where & seen & measured.valid
        rows[name] = {
            "shear_rmse": float(np.sqrt(np.mean(error[kept] ** 2))),
            "shear_bias": float(error[kept].mean()),
            "shear_true_p50": float(np.median(truth.max_shear[kept])),
            "shear_true_p95": float(np.percentile(truth.max_shear[kept], 95)),
            "shear_found_p50": float(np.median(measured.max_shear[kept])),
            "u_p50_mm": float(np.median(distance[kept])),
            "u_p95_mm": float(np.percentile(distance[kept], 95)),
            "lowest_jacobian": float(measured.jacobian[kept].min()),
        }
    return rows


def measured_by(settings: Settings, pair: HeelPair, still: bool) -> dict[str, object]:
    with Worker(1) as worker:
        worker.run("warming up", elastix.self_test)
        pid = worker.run("asking", os.getpid)
        began: list[tuple[float, float]] = []

        def watch(stage: str, _: float) -> None:
            if stage.startswith("registering") and not began:
                began.append((processor_seconds(pid), time.perf_counter()))

        found = register(
            pair.reference,
            pair.repeat if still else pair.loaded,
            bone=pair.bone,
            tissue=Mask(pair.labels.grid, pair.labels.labels > 0),
            labels=pair.labels,
            settings=replace(settings, threads=1),
            worker=worker,
            progress=watch,
        )
        wall = time.perf_counter() - began[0][1]
        cpu = processor_seconds(pid) - began[0][0]
        peak = worker.run("asking", peak_gib)
    return {
        "processor_s": cpu,
        "wall_s": wall,
        "peak_gib_of_worker": peak,
        "choice": found.choice.as_dict(),
        "errors": errors(pair, still, found.displacement),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--motions", nargs="+", default=["still", "smooth", "sliding", "Load1", "Load3"])
    parser.add_argument("--engines", nargs="+", choices=ENGINES, default=list(ENGINES))
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    runs: list[dict[str, object]] = []
    for seed in given.seeds:
        for motion in given.motions:
            pair = heel_pair(seed=seed, motion=motion_of(Heel(seed), motion))
            for engine in given.engines:
                run = measured_by(ENGINES[engine], pair, motion == "still")
                runs.append({"seed": seed, "motion": motion, "engine": engine, **run})
                told = "  ".join(f"{n} {row['shear_rmse']:.4f}" for n, row in run["errors"].items())  # type: ignore[attr-defined]
                print(f"{motion} {seed}, {engine}: {run['processor_s']:.1f} s, {told}", flush=True)
                if given.out is not None:
                    given.out.parent.mkdir(parents=True, exist_ok=True)
                    given.out.write_text(json.dumps({"versions": versions(), "runs": runs}, indent=1) + "\n")


if __name__ == "__main__":
    main()
