"""Can the content and the edge of a bone mask tell whether it lies on the bone?

    python -m benchmarks.bone_masks --out benchmarks/results/bone_masks.json

Unloaded phantom heels (voxels of 0.8, 1.2 and 0.8 x 0.8 x 2.4 mm, SNR 12, 25 and 50) with right masks of the bone,
masks that are a voxel too large or too small, and wrong ones. Three measures:

- edge: the median gradient of the image at the surface of the mask, over that 2.5 to 6 mm from it, more than 3 mm
  inside the body
- rim: the median brightness of the outer millimetre of the mask, over that of the rest (cortical bone is dark)

- shift: the sharpest mask that is 2.5 to 12 mm away, over the mask as given

A measure can tell if the values of wrong masks lie outside the range of the right ones.
"""

from __future__ import annotations

import argparse
import json
from itertools import product
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt, shift

from dvc import Image, Mask, tissue_mask
from dvc.registration.bone_mask import _FITS, _SHIFTS_MM, _gradient, edge_sharpness, nearest_edges
from mrstrain.records.provenance import versions
from phantoms import Heel, heel_grid, labels_of, scan

SPACINGS: tuple[float | tuple[float, float, float], ...] = (0.8, 1.2, (0.8, 0.8, 2.4))
SNRS, SEEDS = (12.0, 25.0, 50.0), (1, 2, 3, 4)
RIM_MM = 1.0


def masks(bone: Mask, body: Mask, seed: int) -> dict[str, Mask]:
    """Right masks and wrong ones, by what is wrong."""
    grid, edges, inside = bone.grid, bone.grid.spacing_mm, bone.inside
    depth = distance_transform_edt(inside, edges) - distance_transform_edt(~inside, edges)
    way = np.random.default_rng(seed).normal(size=3)
    way /= np.linalg.norm(way)
    moved = {
        f"{mm} mm beside": shift(inside.astype(np.float32), mm * way / edges, order=1) > 0.5 for mm in (3, 5, 10, 15)
    }
    upper = body.inside & (grid.points() @ [0.0, 0.0, 1.0] > np.median(body.points()[:, 2]))
    ball = np.linalg.norm(grid.points() - body.points().mean(axis=0), axis=-1) < 15.0
    found = {
        "right": inside, "a voxel too large": binary_dilation(inside), "a voxel too small": binary_erosion(inside),
        "3 mm too large": depth > -3.0, "3 mm too small": depth > 3.0, **moved, "upper half of the body": upper,
        "ball": ball, "whole body": body.inside,
    }  # fmt: skip
    return {name: Mask(grid, np.ascontiguousarray(each)) for name, each in found.items() if each.any()}


def rim(image: Image, mask: Mask) -> float:
    """Brightness of the outer part of a mask over that of the rest."""
    depth = distance_transform_edt(mask.inside, image.grid.spacing_mm)
    outer = mask.inside & (depth <= max(RIM_MM, float(image.grid.spacing_mm.max())))
    inner = mask.inside & ~outer
    return float(np.median(image.values[outer]) / np.median(image.values[inner])) if inner.any() else float("nan")


def shifted(image: Image, mask: Mask, body: Mask) -> float:
    """Sharpness of a mask where it is sharpest, over that as given; 1 if it fits nowhere, or best near its place."""
    given, best, shift_mm = nearest_edges(_gradient(image), mask, body)
    return best / given if given > 0.0 and best >= _FITS and np.linalg.norm(shift_mm) >= _SHIFTS_MM[0] else 1.0


def _range(values: list[float]) -> list[float]:
    """The smallest, median and largest of the values that are known; empty without any."""
    known = [value for value in values if not np.isnan(value)]
    return np.quantile(known, [0.0, 0.5, 1.0]).round(2).tolist() if known else []


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.bone_masks")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/bone_masks.json"))
    asked = parser.parse_args()
    found: dict[str, dict[str, list[float]]] = {}
    for seed, spacing, snr in product(SEEDS, SPACINGS, SNRS):
        heel, grid = Heel(seed), heel_grid(spacing)
        image = scan(heel, grid, snr=snr, number=0)
        body = tissue_mask(image)
        for name, mask in masks(labels_of(heel, grid).region("bone"), body, seed).items():
            values = found.setdefault(name, {"edge": [], "rim": [], "shift": []})
            values["edge"].append(edge_sharpness(image, mask, body))
            values["rim"].append(rim(image, mask))
            values["shift"].append(shifted(image, mask, body))
    ranges = {name: {measure: _range(values) for measure, values in of.items()} for name, of in found.items()}
    for name, of in ranges.items():
        print(f"{name:24}", *(f"{measure} {' '.join(map(str, known)) or '-'}" for measure, known in of.items()))
    command = "python -m benchmarks.bone_masks"
    record = {"command": command, "versions": versions(), "images": len(SEEDS) * len(SPACINGS) * len(SNRS)}
    asked.out.write_text(json.dumps(record | {"least_median_most": ranges}, indent=2) + "\n")


if __name__ == "__main__":
    main()
