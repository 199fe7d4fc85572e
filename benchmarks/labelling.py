"""Labels made from the image: overlap with the truth by tissue, where skin ends, and the strain measured with them.

    python -m benchmarks.labelling --seeds 41 42 43 --out labelling.json
    python -m benchmarks.labelling --seeds 41 42 --motions smooth sliding Load1 Load3 --out labelling.json
    python -m benchmarks.labelling --seeds 43 --off -1 0 1 --motions Load1 Load3 --out labelling.json
    python -m benchmarks.labelling --seeds 41 42 --carried-from 1 --out labelling.json

Heels at 0.8 mm and SNR 25, labelled from the mask of the bone, and from ten strokes of 12 mm at random places (bone,
4 in fat, 3 in muscle, 2 in skin). Dice coefficients by tissue (tendon counts as muscle, and other bones as one), the
distance (mm) from the border of skin to the true one, and seconds on one thread. With motions, pairs are registered
with the exact labels, with those from the bone's mask, and without; root mean square errors of the max. shear by
tissue, and in fat within 1.5 mm of bone. With ``--off``, the mask of the bone is also too small or too large by a voxel
all around, and such pairs are registered twice: with the surface of the bone moved to its dark rim, and with it kept.
With another heel's seed, its labels are carried over to heels of the same size, and to ones that are a twelfth larger
with a thinner pad and skin: by registration alone, corrected by the image, and in all (`dvc.labels_from`); overlap by
tissue, share of wrong labels, and distance of surfaces (mm). Results are added to those that the file holds.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.at_bone import NEAR_MM, off_by
from benchmarks.engines import ENGINES, errors, motion_of
from dvc import Image, LabelMap, Mask, TissueLabels, correct_labels, label_tissues, register, tissue_mask
from dvc.arrays import BoolArray, FloatArray
from dvc.images.depth import depth_mm
from dvc.labelling.carried import carry_labels, combined
from mrstrain.records.provenance import versions
from phantoms import (
    TISSUES,
    Heel,
    HeelPair,
    distances_mm,
    errors_by_tissue,
    heel_grid,
    heel_pair,
    labels_of,
    random_foot_motion,
    scan,
)

STROKES = {"bone": 1, "fat": 4, "muscle": 3, "skin": 2}
STROKE_MM = 12.0
OTHER_SHAPE = {"size": 1.08, "pad_mm": 14.0, "skin_mm": 1.5}


def strokes(labels: LabelMap, seed: int) -> LabelMap:
    """Strokes along the axes of the image in the middle of the tissues, at random places."""
    random, drawn = np.random.default_rng(seed), np.zeros_like(labels.labels)
    numbers = {name: number for number, name in labels.names.items()}
    spacing = labels.grid.spacing_mm
    for name, count in STROKES.items():
        depth = depth_mm(labels.labels == numbers[name], spacing)
        inner = np.argwhere(depth > min(2.0, 0.6 * float(depth.max())))
        for centre in inner[random.integers(len(inner), size=count)]:
            along = np.eye(3)[random.integers(3)] / spacing
            path = np.rint(centre + np.linspace(-0.5, 0.5, 31)[:, None] * STROKE_MM * along).astype(int)
            path = path[np.all((path >= 0) & (path < drawn.shape), axis=1)]
            path = path[labels.labels[tuple(path.T)] == numbers[name]]
            drawn[tuple(path.T)] = numbers[name]
    return LabelMap(labels.grid, drawn, {numbers[name]: name for name in STROKES})


def dice(a: BoolArray, b: BoolArray) -> float:
    return float(2.0 * np.count_nonzero(a & b) / max(1, np.count_nonzero(a) + np.count_nonzero(b)))


def figures(made: TissueLabels, truth: LabelMap) -> dict[str, float]:
    """Overlap by tissue, and how far the border of skin is off."""
    true = {name: truth.labels == number for number, name in truth.names.items()}
    true |= {"muscle": true["muscle"] | true["tendon"], "other bone": true["ankle"]}
    found = {name: made.labels.labels == number for number, name in made.labels.names.items()}
    told = {name: dice(found[name], true[name]) for name in found}
    flesh = [depth_mm((of > 0) & ~skin, truth.grid.spacing_mm) for of, skin in (
        (truth.labels, true["skin"]), (made.labels.labels, found.get("skin", np.zeros_like(true["skin"])))
    )]  # fmt: skip
    at_border = (np.abs(flesh[0]) < 0.5 * float(truth.grid.spacing_mm.mean())) & (truth.labels > 0)
    off = (flesh[1] - flesh[0])[at_border]
    return told | {"skin_border_bias_mm": float(off.mean()), "skin_border_rms_mm": float(np.sqrt((off**2).mean()))}


def labelled(seed: int, offs: list[int]) -> dict[str, object]:
    heel, grid = Heel(seed), heel_grid(0.8)
    image, truth = scan(heel, grid, snr=25.0, number=0), labels_of(heel, grid)
    rows: dict[str, object] = {"seed": seed}
    bone = truth.region("bone")
    masks = {f"bone {n:+d} voxel" if n else "bone": {"bone": off_by(bone, n)} for n in offs}
    for name, given in (masks | {"strokes": {"marks": strokes(truth, seed)}}).items():
        began = time.process_time()
        made = label_tissues(image, **given)  # type: ignore[arg-type]
        rows[name] = figures(made, truth) | {"uncertain": made.uncertain, "processor_s": time.process_time() - began}
        off_mm = surface_off(made.labels.region("bone").inside, bone.inside, grid.spacing_mm)
        rows[name] |= {"bone_surface_rms_mm": off_mm}  # type: ignore[operator]
        print(seed, name, {key: round(float(value), 3) for key, value in rows[name].items()}, flush=True)  # type: ignore[attr-defined]
    return rows


def surface_off(found: BoolArray, true: BoolArray, spacing_mm: FloatArray) -> float:
    """Root mean square distance from the true surface of a tissue to that of one found, mm."""
    at_border = np.abs(depth := depth_mm(true, spacing_mm)) < 0.5 * float(spacing_mm.mean())
    return float(np.sqrt(np.mean((depth_mm(found, spacing_mm) - depth)[at_border] ** 2)))


def carried(seed: int, other: int, shape: dict[str, float]) -> dict[str, object]:
    """Labels of one heel carried over to another, whose foot lies otherwise."""
    heel, theirs = Heel(seed, **shape), Heel(other)
    grid, foot = heel_grid(0.8, heel.size), random_foot_motion(other, 5)
    image, truth = scan(heel, grid, snr=25.0, number=0), labels_of(heel, grid)
    first = scan(theirs, heel_grid(0.8), snr=25.0, number=0)
    moved = first.grid.moved_by(foot.rotation, foot.translation_mm)
    drawn = LabelMap(moved, labels_of(theirs, first.grid).labels, TISSUES)
    began, scanned, body = time.process_time(), Image(moved, first.values), tissue_mask(image)
    over = carry_labels(image, scanned, drawn, body)
    made = combined(image, scanned, drawn, over, None, body)  # as `dvc.labels_from` does
    spent = time.process_time() - began  # the non-rigid fit runs in a process of its own
    rows: dict[str, object] = {"seed": seed, "from": other, "shape": shape, "processor_s_without_fit": spent}
    rows |= {"uncertain": made.uncertain, "notes": made.notes}
    corrected, alone = correct_labels(image, over.labels).labels, label_tissues(image, truth.region("bone")).labels
    ways = {"registration": over.labels, "corrected": corrected, "all": made.labels, "bone": alone}
    labelled = truth.labels > 0
    for way, labels in ways.items():
        found = {name.replace("other bone", "ankle"): labels.labels == n for n, name in labels.names.items()}
        same = np.zeros_like(labelled)
        for name, where in found.items():
            same |= where & (truth.labels == next(n for n, one in TISSUES.items() if one == name))
        told: dict[str, float] = {"wrong": float(np.mean(~same[labelled]))}
        for name, where in found.items():
            true = truth.region(name).inside
            told |= {name: dice(where, true), f"{name}_surface_mm": surface_off(where, true, grid.spacing_mm)}
        rows[way] = told
        print(seed, shape, way, {key: round(value, 3) for key, value in told.items()}, flush=True)
    return rows


def measured(pair: HeelPair, seed: int, motion: str, offs: list[int]) -> list[dict[str, object]]:
    """Errors of the max. shear with exact labels, with labels from the bone's mask, and without labels."""
    body, exact = tissue_mask(pair.reference), Mask(pair.labels.grid, pair.labels.labels > 0)
    near = pair.labels.region("fat").inside & (distances_mm(pair.labels)[0] <= NEAR_MM)
    ways = [("exact", 0, pair.labels, pair.bone, exact, "gauss-newton, labels")]
    for off in offs:
        for kept in (False, True) if off else (False,):
            made = label_tissues(pair.reference, off_by(pair.bone, off), bone_is_exact=kept).labels
            name = "from the image, surface of the bone kept" if kept else "from the image"
            ways.append((name, off, made, made.region("bone"), body, "gauss-newton, labels"))
    rows = []
    for name, off, labels, bone, tissue, engine in (*ways, ("none", 0, None, pair.bone, body, "gauss-newton")):
        found = register(
            pair.reference, pair.loaded, bone=bone, tissue=tissue, labels=labels,
            settings=replace(ENGINES[engine], threads=2),
        )  # fmt: skip
        of = errors(pair, still=False, found=found.displacement)
        (beside,) = errors_by_tissue(pair.labels, pair.deformation, found.deformation, near)
        near_bone = float(beside.shear_rmse)
        told = {"labels": name, "off": off, "errors": of, "near_bone": near_bone}
        rows.append({"seed": seed, "motion": motion} | told)
        shown = {key: round(value["shear_rmse"], 4) for key, value in of.items()}
        print(seed, motion, name, off, shown, round(near_bone, 4), flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", required=True)
    parser.add_argument("--motions", nargs="*", default=[])
    parser.add_argument("--off", type=int, nargs="+", default=[0], choices=[-1, 0, 1])
    parser.add_argument("--carried-from", type=int)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    told = json.loads(given.out.read_text()) if given.out.is_file() else {}
    told |= {"versions": versions()}
    for seed in given.seeds:
        for motion in given.motions:
            pair = heel_pair(seed=seed, motion=motion_of(Heel(seed), motion))
            told.setdefault("strain", []).extend(measured(pair, seed, motion, given.off))
            given.out.write_text(json.dumps(told, indent=1) + "\n")
        if given.carried_from is not None:
            for shape in ({}, OTHER_SHAPE):
                told.setdefault("carried", []).append(carried(seed, given.carried_from, shape))
                given.out.write_text(json.dumps(told, indent=1) + "\n")
        elif not given.motions:
            told.setdefault("labels", []).append(labelled(seed, given.off))
            given.out.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
