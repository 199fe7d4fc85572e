"""Error of displacement and maximum shear strain on the heel phantom: our own beside elastix' default B-spline.

    python benchmarks/registration_accuracy.py --seeds 1 2 --out benchmarks/results/registration_accuracy.json

Both register the same pair after the same rigid motion (the true one for elastix' default, which gets no mask;
mrstrain finds its own). Scored: every labelled voxel whose true place lies inside the loaded image, by at
least the spacing of control points (the border that mrstrain itself marks as not valid).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import asdict
from pathlib import Path

import numpy as np

from dvc import BSpline, Deformation, Image, Mask, Preset, RigidMotion, Settings, register
from dvc.images.resample import shows
from dvc.io.transforms.elastix_text import parse_parameters
from dvc.io.transforms.read import bspline_from_elastix
from dvc.registration.elastix import run as elastix
from dvc.threads import usable_cores
from dvc.worker import Worker
from mrstrain.records.provenance import versions
from phantoms import HeelPair, errors_by_tissue, heel_pair

MARGIN_MM = 4.0

# elastix' own default for (Transform "BSplineTransform"), as GetDefaultParameterMap("bspline") gives it.
DEFAULT = """
(AutomaticParameterEstimation "true")
(CheckNumberOfSamples "true")
(FinalGridSpacingInPhysicalUnits 10.0)
(FixedImagePyramid "FixedSmoothingImagePyramid")
(GridSpacingSchedule 2.803221 1.988100 1.410000 1.0)
(ImageSampler "RandomCoordinate")
(Interpolator "LinearInterpolator")
(MaximumNumberOfIterations 256)
(MaximumNumberOfSamplingAttempts 8)
(Metric "AdvancedMattesMutualInformation" "TransformBendingEnergyPenalty")
(Metric0Weight 1.0)
(Metric1Weight 1.0)
(MovingImagePyramid "MovingSmoothingImagePyramid")
(NewSamplesEveryIteration "true")
(NumberOfResolutions 4)
(NumberOfSamplesForExactGradient 4096)
(NumberOfSpatialSamples 2048)
(Optimizer "AdaptiveStochasticGradientDescent")
(Registration "MultiMetricMultiResolutionRegistration")
(Transform "BSplineTransform")
"""


def scored(pair: HeelPair, deformation: Deformation) -> dict[str, dict[str, float]]:
    X = pair.reference.grid.points()
    inside = pair.labels.labels > 0
    where = np.zeros(inside.shape, dtype=bool)
    true_place = pair.foot_motion.apply(X[inside] + pair.deformation.displacement(X[inside]))
    where[inside] = shows(pair.loaded, true_place, MARGIN_MM)
    rows = (asdict(error) for error in errors_by_tissue(pair.labels, pair.deformation, deformation, where))
    return {row.pop("tissue"): row for row in rows}


def elastix_default(reference: Image, moving: Image, mask: Mask | None, worker: Worker, seed: int) -> BSpline:
    """elastix' default B-spline from ``reference`` to ``moving``, whose header has the rigid motion taken out."""
    preset = Preset("elastix default", DEFAULT, parse_parameters(DEFAULT))
    parameters = preset.complete(seed=seed) | {"UseMultiThreadingForMetrics": ("false",)}
    with tempfile.TemporaryDirectory() as folder:
        found = worker.run("elastix default", elastix.register, reference, moving, parameters, mask, None, None, folder)
    return bspline_from_elastix(found)


def without_motion(image: Image, motion: RigidMotion) -> Image:
    """The image moved back by the motion in its header alone."""
    back = motion.inverse()
    return Image(image.grid.moved_by(back.rotation, back.translation_mm), image.values)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    parser.add_argument("--load", type=float, default=1.0)
    parser.add_argument("--by", default="gauss-newton", help="the engine gauss-newton, or a preset of elastix")
    parser.add_argument("--skip-default", action="store_true")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    threads = usable_cores()
    results = []
    with Worker(threads) as worker:
        for seed in given.seeds:
            pair = heel_pair(seed=seed, load=given.load)
            body = Mask(pair.reference.grid, pair.labels.labels > 0)
            runs = {}
            worker.run("warming up", elastix.self_test)
            began = time.perf_counter()
            result = register(
                pair.reference,
                pair.loaded,
                bone=pair.bone,
                tissue=body,
                settings=Settings.of(given.by, threads=threads),
                worker=worker,
            )
            runs[given.by] = (scored(pair, result.displacement), time.perf_counter() - began)
            if not given.skip_default:
                began = time.perf_counter()
                moving = without_motion(pair.loaded, pair.foot_motion)
                found = elastix_default(pair.reference, moving, None, worker, seed=1)
                runs["elastix default"] = (scored(pair, found), time.perf_counter() - began)
            for method, (rows, seconds) in runs.items():
                print(f"seed {seed}, load {given.load}, {method}: {seconds:.0f} s")
                for tissue, row in rows.items():
                    print(
                        f"  {tissue:8s} true {row['true_p50']:.3f}/{row['true_p95']:.3f}  shear RMSE "
                        f"{row['shear_rmse']:.4f} bias {row['shear_bias']:+.4f} p95 {row['shear_error_p95']:.4f}  "
                        f"u {row['u_p50_mm']:.3f}/{row['u_p95_mm']:.3f} mm  folded {row['folded']}",
                        flush=True,
                    )
                results.append(
                    {"seed": seed, "load": given.load, "method": method, "seconds": seconds, "tissues": rows}
                )
    if given.out is not None:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps({"versions": versions(), "threads": threads, "runs": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
