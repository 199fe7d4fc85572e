"""Strain measured with label maps whose borders are wrong, and with the same corrected by the image.

    python -m benchmarks.label_correction --seeds 51 52 --out benchmarks/results/label_correction.json
    python -m benchmarks.label_correction --boundaries --seeds 3 4 --out benchmarks/results/label_boundaries.json

Heels at 0.8 mm and SNR 25. The borders of bones and skin are exact, a voxel too large or too small all around, wrong by
a voxel in patches of 5 mm at random, or wrong by a smooth error of up to 1.5 voxels; each is given to the registration
as it is, and after `correct_labels`. Root mean square errors of the max. shear by the tissues of the label map that the
registration was given, and share of its labels that are wrong. With ``--boundaries`` nothing is registered: told is how
far corrected boundaries of bones and skin are off, mm, at several noise levels.
"""

from __future__ import annotations

import argparse
import json
from contextlib import nullcontext
from dataclasses import asdict
from itertools import product
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

from dvc import Image, LabelMap, Mask, correct_labels
from dvc.arrays import FloatArray
from dvc.images.depth import depth_mm
from dvc.threads import usable_cores
from dvc.worker import Worker
from mrstrain.records.provenance import versions
from phantoms import AccuracyCase, Heel, error_rows, heel_grid, labels_of, measure_run, misdrawn, scan

ENGINE, SPACING, SNR = "gauss-newton-borders", (0.8, 0.8, 0.8), 25.0
MOTIONS = ("smooth", "sliding", "Load1", "Load3")
STIFF = ("bone", "ankle", "skin")
PATCH_MM, SMOOTH_MM, LARGEST = 5.0, 15.0, 1.5


def in_patches(truth: LabelMap, seed: int) -> LabelMap:
    """Borders right, a voxel outward or a voxel inward, by cubes of 5 mm at random."""
    shape, spacing = truth.labels.shape, truth.grid.spacing_mm
    cubes = [(np.arange(n) * s / PATCH_MM).astype(int) for n, s in zip(shape, spacing, strict=True)]
    drawn = np.random.default_rng(seed).integers(-1, 2, [int(of[-1]) + 1 for of in cubes])[np.ix_(*cubes)]
    labels = truth.labels.copy()
    for by in (1, -1):
        labels[drawn == by] = misdrawn(truth, by).labels[drawn == by]
    return LabelMap(truth.grid, labels, truth.names)


def smoothly(truth: LabelMap, seed: int) -> LabelMap:
    """Borders off by a smooth field, up to 1.5 voxels."""
    given, spacing = truth.labels, truth.grid.spacing_mm
    off = gaussian_filter(np.random.default_rng(seed).standard_normal(given.shape), SMOOTH_MM / spacing)
    stiff = np.isin(given, [number for number, name in truth.names.items() if name in STIFF])
    soft = (given > 0) & ~stiff
    to_soft, to_stiff = (distance_transform_edt(~of, sampling=spacing) - 0.5 * spacing.mean() for of in (soft, stiff))
    border = np.where(stiff, to_soft, -to_stiff)
    off *= LARGEST * float(spacing.mean()) / np.abs(off[(given > 0) & (np.abs(border) < 1.0)]).max()
    grown = border + off > 0
    labels = given.copy()
    for changed, of in ((soft & grown, stiff), (stiff & ~grown, soft)):
        nearest = distance_transform_edt(~of, return_distances=False, return_indices=True)
        labels[changed] = given[tuple(nearest)][changed]
    return LabelMap(truth.grid, labels, truth.names)


def drawn(truth: LabelMap, how: str, seed: int) -> LabelMap:
    makers = {"patches": in_patches, "smooth": smoothly}
    return makers[how](truth, seed) if how in makers else misdrawn(truth, {"exact": 0, "large": 1, "small": -1}[how])


def measured(seed: int, motion: str, how: str, corrected: bool, worker: Worker) -> dict[str, object]:
    truth = labels_of(Heel(seed), heel_grid(SPACING))
    given, body, wrong = drawn(truth, how, seed), truth.labels > 0, list[FloatArray]()

    def made(image: Image, _: Mask) -> LabelMap:
        labels = correct_labels(image, given).labels if corrected else given
        wrong.append(np.mean(labels.labels[body] != truth.labels[body]))
        return labels

    case = AccuracyCase(ENGINE, SPACING, SNR, motion, seed)
    run = measure_run(case, worker, nullcontext(), lambda _: None, made)
    rows = [asdict(row) for row in error_rows([run]) if row.by in ("all", "distance to bone, mm")]
    near = next(r for r in rows if r["tissue"] == "fat" and r["by"] != "all" and r["low"] == 0.0)["shear_rmse"]
    of = {r["tissue"]: r["shear_rmse"] for r in rows if r["by"] == "all"} | {"fat within 1.5 mm of bone": near}
    about = {"seed": seed, "motion": motion, "labels": how, "corrected": corrected}
    return {**about, "wrong": float(wrong[0]), "errors": of}


def off_by(seed: int, snr: float | None, how: str) -> dict[str, object]:
    """Mean and root mean square of how far corrected boundaries are off, mm; above zero where a tissue is too thick."""
    heel, grid = Heel(seed), heel_grid(SPACING)
    truth = labels_of(heel, grid)
    found = correct_labels(scan(heel, grid, snr=snr, number=0), drawn(truth, how, seed)).labels.labels
    number = {name: value for value, name in truth.names.items()}
    row: dict[str, object] = {"seed": seed, "snr": snr, "labels": how}
    row["wrong"] = float(np.mean(found[truth.labels > 0] != truth.labels[truth.labels > 0]))
    for tissue, names in (("bones", ("bone", "ankle")), ("skin", ("skin",))):
        those = [number[name] for name in names]
        is_right, is_found = (np.isin(of, those) | ((of == 0) & (tissue == "skin")) for of in (truth.labels, found))
        right = depth_mm(is_right, grid.spacing_mm)
        off = (depth_mm(is_found, grid.spacing_mm) - right)[np.abs(right) < 0.5 * SPACING[0]]
        row[tissue] = [round(float(off.mean()), 3), round(float(np.sqrt((off**2).mean())), 3)]
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--labels", nargs="+", default=["exact", "large", "small", "patches", "smooth"])
    parser.add_argument("--motions", nargs="+", default=MOTIONS)
    parser.add_argument("--boundaries", action="store_true", help="how far they are off, without a registration")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    rows = []
    if given.boundaries:
        for seed, snr, how in product(given.seeds, (SNR, 60.0, None), ("exact", "large", "small")):
            rows.append(off_by(seed, snr, how))
            print(rows[-1], flush=True)
        given.out.write_text(json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")
        return
    for seed in given.seeds:
        for motion in given.motions:
            for how in given.labels:
                for corrected in (False, True):
                    with Worker(usable_cores()) as worker:
                        rows.append(measured(seed, motion, how, corrected, worker))
                    errors = {name: round(value, 4) for name, value in rows[-1]["errors"].items()}  # type: ignore[attr-defined]
                    print(seed, motion, how, "corrected" if corrected else "as drawn", errors, flush=True)
                    given.out.write_text(json.dumps({"versions": versions(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
