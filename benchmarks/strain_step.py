"""From a B-spline to strain: exact and separable, against transformix, finite differences and LAPACK.

Both ways give displacement, Green-Lagrange strain and its principal values at the voxels of a mask of half a
million voxels, 0.8 mm apart, from a control grid every 4 mm. Run from the repository root:

    python benchmarks/strain_step.py --threads 2
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")

REPEATS = 5
SHAPE, SPACING_MM, CONTROL_MM = (126, 140, 132), 0.8, 4.0
VOXELS = 500_000


def main() -> None:
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    arguments.add_argument("--output", type=Path, default=Path(__file__).parent / "results" / "strain_step.json")
    chosen = arguments.parse_args()
    for name in (
        "NUMBA_NUM_THREADS",
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS",
    ):
        os.environ[name] = str(chosen.threads)  # before numpy, numba and itk are imported
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    result = measure(chosen.threads)
    for name, seconds in result["seconds"].items():
        print(f"{name:<44} {seconds:9.4f} s")
    print(f"{'ratio of the medians':<44} {result['ratio']:9.1f}")
    print(f"{'largest difference in u':<44} {result['difference']['displacement_mm']:9.2g} mm")
    print(
        f"{'median, largest difference in E, principal':<44} "
        f"{result['difference']['strain_median']:9.2g} {result['difference']['strain_largest']:.2g}"
    )
    chosen.output.parent.mkdir(parents=True, exist_ok=True)
    chosen.output.write_text(json.dumps(result, indent=2) + "\n")


def measure(threads: int) -> dict[str, object]:
    import itk
    import numpy as np

    from dvc import BSpline, Grid, StrainField
    from dvc.io.transforms.write import write_elastix_transform

    grid = Grid(SHAPE, (SPACING_MM,) * 3, (0.0, 0.0, 0.0))
    counts = tuple(int(np.ceil((n - 1) * SPACING_MM / CONTROL_MM)) + 4 for n in SHAPE)
    control = Grid(counts, (CONTROL_MM,) * 3, (-1.5 * CONTROL_MM,) * 3)
    bspline = BSpline(control, np.random.default_rng(0).normal(scale=0.4, size=(3, *counts)))
    # An ellipsoid about the centre, which is what a heel roughly is.
    offsets = (grid.points() - grid.centre_mm) / (np.array(SHAPE) * SPACING_MM)
    radius = (offsets**2).sum(axis=-1)
    where = radius <= np.partition(radius.ravel(), VOXELS)[VOXELS]

    def exact() -> tuple[np.ndarray, np.ndarray]:
        u, H = bspline.evaluate_on_grid(grid, where)
        return u, StrainField.from_gradient(H).principal

    def exact_by_points() -> tuple[np.ndarray, np.ndarray]:
        u, H = bspline.evaluate(grid.points(where))
        return u, StrainField.from_gradient(H).principal

    with tempfile.TemporaryDirectory() as folder:
        (file,) = write_elastix_transform(folder, bspline, None, grid)
        fast = Path(folder) / "fast.txt"  # elastix' own faster form of the same transform
        fast.write_text(file.read_text().replace('"BSplineTransform"', '"RecursiveBSplineTransform"', 1))
        image = itk.image_from_array(np.zeros((4, 4, 4), np.float32))

        def field() -> np.ndarray:
            method = itk.TransformixFilter[itk.Image[itk.F, 3]].New()
            method.SetMovingImage(image)
            method.SetTransformParameterFileName(str(fast))
            method.SetComputeDeformationField(True)
            method.SetLogToConsole(False)
            method.SetOutputDirectory(folder)
            method.UpdateLargestPossibleRegion()
            return itk.array_from_image(method.GetOutputDeformationField()).transpose(2, 1, 0, 3)

        def strain(u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            slopes = [np.gradient(u[..., c], SPACING_MM) for c in range(3)]
            H = np.stack([np.stack([s[where] for s in row], axis=-1) for row in slopes], axis=-2)
            F = H + np.eye(3)
            E = (F.transpose(0, 2, 1) @ F - np.eye(3)) / 2
            return u[where], np.linalg.eigvalsh(E)[:, ::-1]

        began = time.perf_counter()
        exact()
        exact_first = time.perf_counter() - began
        began = time.perf_counter()
        u_field = field()
        field_first = time.perf_counter() - began
        exact_s, (u, principal) = timed(exact)
        points_s, _ = timed(exact_by_points)
        field_s, u_field = timed(field)
        strain_s, (their_u, their_principal) = timed(lambda: strain(u_field))
    off = np.abs(principal - their_principal)
    return {
        "voxels": int(where.sum()),
        "grid": {"shape": SHAPE, "spacing_mm": SPACING_MM, "control_mm": CONTROL_MM},
        "seconds": {
            "exact, on the grid: u, H, E, principal": exact_s,
            "exact, point by point": points_s,
            "exact, first call (loads or compiles)": exact_first,
            "transformix displacement field": field_s,
            "np.gradient, E, eigvalsh": strain_s,
            "transformix, first call": field_first,
        },
        "ratio": (field_s + strain_s) / exact_s,
        "difference": {
            "displacement_mm": float(np.abs(u - their_u).max()),
            "strain_median": float(np.median(off)),
            "strain_largest": float(off.max()),
        },
        "machine": {
            "threads": threads,
            "cores": os.cpu_count(),
            "system": platform.system(),
            "processor": platform.machine(),
            "python": platform.python_version(),
            **{name: version(name) for name in ("numpy", "numba", "itk-elastix")},
        },
    }


def timed(work: Callable[[], T]) -> tuple[float, T]:
    """Median wall time of a few runs, and what the last one gave."""
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - began)
    return sorted(seconds)[len(seconds) // 2], result


if __name__ == "__main__":
    main()
