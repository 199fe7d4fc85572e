"""Whole studies whose force, plate direction and label map are off by their stated uncertainty: do intervals hold?

    .venv/bin/python -m benchmarks.wrong_inputs --work /tmp/wrong --out benchmarks/results/wrong_inputs.json

As `benchmarks.hidden_law`: heels that were set aside are moved by a hidden law, and `mrstrain run` gets images, label
map and nominal loads. Here the plate pressed with another force and in another direction than the study file says, and
the boundaries of bone and skin in the label map that is meshed are off by half a voxel. Standard deviations are those
that `init` writes. The mesh of the models is coarser than that of the truth.

An interval should hold the area between the hidden model and the same material set with the right force, direction and
labels, on the finer mesh. A pair of sets that is called significantly different should be in the order of these areas.
Heels that are already in the file are not run again.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.special import ndtr

from benchmarks.hidden_law import BONES, hidden_model, images
from dvc import LabelMap, read_labels, write_labels
from fe import LoadStep, Plate, read_tet_mesh, variation
from mrstrain import mesh as make_mesh, run, simulate
from mrstrain.options.modelling import INFERIOR
from mrstrain.records.provenance import versions
from phantoms import Heel, heel_grid, labels_of, labels_to_mesh
from validate import ALL, ALL_LOADS, LoadCase, compare_load, rank_over_loads, read_result

SETS = ("trebbi", "akrami", "erdemir", "zwam")
LOADS = (LoadStep("Load1", 140.0), LoadStep("Load3", 15.0, 45.0))
FORCE, DIRECTION_DEG, LABELS_VOXELS, COARSER = 0.03, 2.0, 0.5, 1.4
TRUE_EDGE_MM, EDGE_MM = 3.6, 4.5
TISSUES = (ALL, "fat")
ANTERIOR = (0.0, -1.0, 0.0)


def heel(seed: int, work: Path) -> dict[str, object]:
    """Areas and orders of one heel's study, beside the true ones."""
    random = np.random.default_rng([32, seed])
    force, along, across = random.standard_normal(3)
    bone, skin = random.choice([-LABELS_VOXELS, LABELS_VOXELS], 2)
    plate = variation.tilted(Plate(INFERIOR, ANTERIOR), DIRECTION_DEG * along, along=True)
    plate = variation.tilted(plate, DIRECTION_DEG * across, along=False)
    stronger = 1.0 + FORCE * force
    loads = [
        replace(x, normal_n=x.normal_n * stronger, shear_n=x.shear_n and x.shear_n * stronger)
        for x in LOADS
    ]  # fmt: skip
    how = {"loads": loads, "plate_normal": tuple(-plate.axes[:, 0]), "shear_direction": tuple(plate.axes[:, 1])}
    anatomy, grid = Heel(seed), heel_grid(0.8)
    labels = labels_of(anatomy, grid)
    hidden = hidden_model(work, labels, seed, **how)
    study = images(work, anatomy, labels, hidden, seed, LOADS)
    right = labels_to_mesh(anatomy, labels)
    write_labels(work / "right.nii.gz", right)
    write_labels(study / "to_mesh.nii.gz", labels_to_mesh(anatomy, off(labels, bone, skin)))
    (study / "study.toml").write_text(study_text())
    print("\n".join(run(study).summary()), flush=True)
    if not (work / "right.vtu").is_file():
        there = np.unique(right.labels)
        bones = [name for number, name in right.names.items() if name in BONES and number in there]
        make_mesh(work / "right.nii.gz", out=work / "right.vtu", edge_mm=TRUE_EDGE_MM, names=work / "right.csv",
                  bones=bones)  # fmt: skip
    if not (work / "best" / SETS[-1] / "regions.csv").is_file():
        simulate(work / "right.vtu", out=work / "best", sets=SETS, **how)
    drawn = {"force": force, "along": along, "across": across, "bone_voxels": bone, "skin_voxels": skin}
    return {"drawn": {k: float(v) for k, v in drawn.items()}} | told(study, hidden, work / "best")


def off(labels: LabelMap, bone: float, skin: float) -> LabelMap:
    """Labels whose bones are thicker by so many voxels, and whose skin is so on its inside; negative is thinner.

    Blurred by a voxel, what lies on one side of a plane boundary is the normal distribution function of the distance
    to it, in voxels.
    """
    found, number = np.array(labels.labels), {name: n for n, name in labels.names.items()}
    bones = [number[name] for name in BONES]
    for side, thick, own in ((np.isin(found, bones), bone, number["bone"]),
                             (np.isin(found, [0, number["skin"]]), skin, number["skin"])):  # fmt: skip
        soft = (found > 0) & ~np.isin(found, bones)
        moved = gaussian_filter(side.astype(np.float64), 1.0) > ndtr(-thick)
        beyond = soft & ~side
        nearest = distance_transform_edt(~beyond, return_distances=False, return_indices=True)
        lost, tissue = ~moved & side & (found > 0), found[tuple(nearest)]
        found[moved & beyond] = own
        found[lost] = tissue[lost]
    return LabelMap(labels.grid, found, labels.names)


def study_text() -> str:
    """The study file: images, label map, nominal loads, and what is uncertain."""
    loads = "".join(
        f'[loads.{x.name}]\nimage = "{x.name}.nii.gz"\nnormal_n = {x.normal_n}\nshear_n = {x.shear_n or 0.0}\n'
        for x in LOADS
    )
    return (
        f'[study]\nname = "Wrong inputs"\n[images]\nload0 = "Load0.nii.gz"\nrepeat = "Load0-again.nii.gz"\n'
        f'labels = "tissues.nii.gz"\nnames = "tissues.csv"\n{loads}'
        f'[mesh]\nedge_mm = {EDGE_MM}\nlabels = "to_mesh.nii.gz"\nnames = "to_mesh.csv"\n'
        f"[models]\nsets = {json.dumps(SETS)}\n"
        f"[uncertainty]\nmesh = {COARSER}\nforce = {FORCE}\ndirection_deg = {DIRECTION_DEG}\n"
        f"labels_voxels = {LABELS_VOXELS}\n"
    )


def told(study: Path, hidden: Path, best: Path) -> dict[str, object]:
    """Areas with their intervals beside the true ones, and pairs that are called different beside the true order."""
    results = study / "results"
    names, mesh = read_labels(study / "tissues.nii.gz", study / "tissues.csv"), read_tet_mesh(results / "mesh/mesh.vtu")
    exact = []
    for load in (x.name for x in LOADS):
        truth = read_result("hidden", hidden / f"{load}.vtu").deformation
        models = [read_result(s, best / s / f"{load}.vtu") for s in SETS]
        exact.append(compare_load(LoadCase.of(load, truth, models), names, BONES, mesh=mesh))
    true = {(a.load, a.model, a.tissue): a.ml for one in exact for a in one.areas}
    true |= {(ALL_LOADS, a.model, ALL): a.ml for a in rank_over_loads(exact).areas}
    with (results / "comparison" / "areas.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["model"] in SETS and row["tissue"] in TISSUES]
    areas = [
        [row["load"], row["tissue"], row["model"], true[row["load"], row["model"], row["tissue"]],
         *(float(row[key] or "nan") for key in ("estimate_ml", "low_ml", "high_ml"))]
        for row in rows
    ]  # fmt: skip
    said = json.loads((results / "comparison" / "comparison.json").read_text())["not_told_apart"]
    estimate = {(load, model): ml for load, tissue, model, _, ml, *_ in areas if tissue == ALL}
    pairs = []
    for load, alike in said.items():
        for a, b in combinations([name for name in SETS if (load, name) in estimate], 2):  # a set may miss a load
            called = (estimate[load, a] - estimate[load, b]) if not any({a, b} == set(pair) for pair in alike) else 0.0
            pairs.append([load, a, b, true[load, a, ALL] - true[load, b, ALL], called])
    return {"areas": areas, "pairs": pairs}


def summary(heels: list[dict]) -> dict[str, object]:
    """Coverage, and pairs in the wrong order, over all heels."""
    areas, pairs = ([row for one in heels for row in one[key]] for key in ("areas", "pairs"))
    held: dict[str, list[bool]] = {}
    for load, tissue, _, area, _, low, high in areas:
        for key in ("all", f"{load}, {tissue}"):
            held.setdefault(key, []).append(low <= area <= high)
    called = [row for row in pairs if row[4] != 0.0]
    return {
        "heels": len(heels), "coverage": {key: [int(sum(of)), len(of)] for key, of in held.items()},
        "begin above 0": [sum(a[5] <= a[3] <= a[6] for a in areas if a[5] > 0.0), sum(a[5] > 0.0 for a in areas)],
        "pairs": len(pairs), "called different": len(called),
        "in the wrong order": sum(row[3] * row[4] < 0.0 for row in called),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[9201, 9202, 9203, 9204, 9205, 9206])
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    content = json.loads(given.out.read_text()) if given.out.is_file() else {"heels": {}}
    for seed in given.seeds:
        if str(seed) in content["heels"]:
            continue
        began, work = time.monotonic(), given.work / str(seed)
        work.mkdir(parents=True, exist_ok=True)
        content["heels"][str(seed)] = heel(seed, work)
        content |= {"versions": versions(), "summary": summary([*content["heels"].values()])}
        given.out.write_text(json.dumps(content) + "\n")
        print(seed, f"{time.monotonic() - began:.0f} s", json.dumps(content["summary"]), flush=True)
        shutil.rmtree(work)


if __name__ == "__main__":
    main()
