"""The honest test of a whole study: images whose deformation comes from a law that no published set holds.

    .venv/bin/python -m benchmarks.hidden_law --work /tmp/hidden --out benchmarks/results/hidden_law.json
    .venv/bin/python -m benchmarks.hidden_law --work /tmp/hidden --no-borders --out hidden_law_one_spline.json

A heel (a seed set aside) is meshed whole; its fat has three kinds of lobules, of initial shear moduli 6, 11 and 20
kPa, mixed by a random field of 6 mm; skin and muscle have laws of their own. The finite elements under the published
loads move the anatomy, from which the loaded images are formed. Then `mrstrain run` gets images, label map and
forces, and nothing else. Told: the error of the measured strain against that of the hidden model, as its cells have it
and averaged at their nodes; each published set's area between curves as measured, with its interval, beside its area to
the hidden model itself; and both rankings. What is there already in the work folder is not made again.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

from benchmarks.nodal import Averaged
from dvc import (
    Grid,
    LabelMap,
    SampledDisplacement,
    TetMesh,
    evaluate_on_grid,
    read_labels,
    read_mask,
    write_image,
    write_labels,
)
from dvc.io.result_folder import spline_in
from fe import LoadStep, read_tet_mesh, write_tet_mesh
from mrstrain import mesh as make_mesh, run, simulate
from mrstrain.models.simulate import LOADS
from mrstrain.records.provenance import versions
from phantoms import (
    Heel,
    covering,
    distances_mm,
    errors_by_tissue,
    heel_grid,
    labels_of,
    labels_to_mesh,
    material_points,
    random_foot_motion,
    scan,
)
from validate import ALL, ALL_LOADS, LoadCase, compare_load, extrapolated, rank_over_loads, read_result

HIDDEN = """
[hidden]
title = "Fat of three kinds of lobules"
source = "Made for this benchmark: in no published set."
[hidden.skin]
law = "Yeoh"
c10_mpa = 0.12
c20_mpa = 0.9
nu = 0.4999
[hidden.muscle]
law = "neo-Hooke"
mu_kpa = 14.0
nu = 0.4999
""" + "".join(
    f"""[hidden.{name}]
law = "Ogden"
convention = "abaqus"
mu_kpa = {modulus}
alpha = 7.5
nu = 0.4999
"""
    for name, modulus in (("fat-soft", 6.0), ("fat-middle", 11.0), ("fat-stiff", 20.0), ("tendon", 25.0))
)
SETS = ["trebbi", "akrami", "erdemir", "luboz", "zwam"]
BONES = ("bone", "ankle")
LOBULES_MM = 6.0
MARGIN_MM = 12.0
SNR = 25.0


class Moved:
    """Tissue moved as sampled on a grid, and back: what `scan` asks for."""

    def __init__(self, there: SampledDisplacement, back: SampledDisplacement) -> None:
        self._there, self._back = there, back

    def displacement(self, points_mm):
        return self._there.displacement(points_mm)

    def evaluate(self, points_mm):
        return self._there.evaluate(points_mm)

    def inverse(self) -> Moved:
        return Moved(self._back, self._there)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=9200)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--no-borders", action="store_true", help="register with one smooth spline")
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    heel, grid = Heel(given.seed), heel_grid(0.8)
    labels = labels_of(heel, grid)
    hidden = hidden_model(given.work, labels, given.seed)
    study = images(given.work, heel, labels, hidden, given.seed)
    (study / "study.toml").write_text(study_text(borders=not given.no_borders))
    ran = run(study)
    print("\n".join(ran.summary()))
    found = scores(study, hidden, labels)
    given.out.write_text(json.dumps({"versions": versions(), "seed": given.seed} | found, indent=1) + "\n")
    print(told(found))
    wrong = misjudged(found)
    assert not wrong, f"neither the true order nor called noise: {wrong}"


def hidden_model(work: Path, labels: LabelMap, seed: int, **how: Any) -> Path:
    """Mesh the heel, mix its fat, and simulate the loads, ``how`` being passed to `simulate`; the folder of results."""
    done = work / "simulated" / "hidden"
    if (done / "regions.csv").is_file():  # written when the simulation has ended
        return done
    # The whole foot that the images show: a motion carried on beyond a mesh would change tissue's volume there.
    write_labels(work / "whole.nii.gz", labels)
    make_mesh(work / "whole.nii.gz", out=work / "plain.vtu", edge_mm=3.6, names=work / "whole.csv", bones=BONES)
    plain = read_tet_mesh(work / "plain.vtu")
    fat = plain.regions["fat"]
    at = labels.grid.indices_of(plain.centroids_mm[fat])
    width = LOBULES_MM / 2.355 / 0.8
    noise = np.random.default_rng([seed, 77]).standard_normal(
        [n + int(np.ceil(6.0 * width)) for n in labels.grid.shape]
    )
    values = gaussian_filter(noise, width, mode="wrap")[tuple(np.rint(at).astype(int).T)]
    kinds = np.digitize(values, np.quantile(values, [1 / 3, 2 / 3]))
    regions = {name: cells for name, cells in plain.regions.items() if name != "fat"}
    regions |= {name: fat[kinds == k] for k, name in enumerate(("fat-soft", "fat-middle", "fat-stiff"))}
    mixed = TetMesh(plain.points_mm, plain.cells, regions=regions, facets=plain.facets)
    write_tet_mesh(work / "mixed.vtu", mixed, {})
    (work / "hidden.toml").write_text(HIDDEN)
    told = simulate(work / "mixed.vtu", out=work / "simulated", sets=[str(work / "hidden.toml")], **how)
    print("\n".join(told.summary()))
    return done


def images(
    work: Path, heel: Heel, labels: LabelMap, hidden: Path, seed: int, loads: Sequence[LoadStep] = LOADS
) -> Path:
    """Form the images of the hidden model's loads; the study's folder."""
    study, grid = work / "study", labels.grid
    study.mkdir(exist_ok=True)
    if not (study / f"{loads[-1].name}.nii.gz").is_file():
        write_image(study / "Load0.nii.gz", scan(heel, grid, snr=SNR, number=0))
        foot = random_foot_motion(seed, 100)
        bone = labels.region("bone")
        again = covering(grid, foot.apply(bone.points()))
        write_image(study / "Load0-again.nii.gz", scan(heel, again, None, foot, snr=SNR, number=100))
        write_labels(study / "tissues.nii.gz", labels)
        write_labels(study / "to_mesh.nii.gz", labels_to_mesh(heel, labels))
        for number, load in enumerate(loads, start=1):
            moved = as_motion(truth(hidden, load.name, labels), labels)
            foot = random_foot_motion(seed, number)
            where = covering(grid, foot.apply(bone.points()))
            write_image(study / f"{load.name}.nii.gz", scan(heel, where, moved, foot, snr=SNR, number=number))
            print(load.name, "imaged", flush=True)
    return study


def study_text(*, borders: bool) -> str:
    """The study file: images, label map and forces."""
    loads = "".join(
        f'[loads.{x.name}]\nimage = "{x.name}.nii.gz"\nnormal_n = {x.normal_n}\nshear_n = {x.shear_n or 0.0}\n'
        for x in LOADS
    )
    return (
        f'[study]\nname = "Hidden law"\n[images]\nload0 = "Load0.nii.gz"\nrepeat = "Load0-again.nii.gz"\n'
        f'labels = "tissues.nii.gz"\nnames = "tissues.csv"\n{loads}[registration]\nborders = {json.dumps(borders)}\n'
        f'[mesh]\nedge_mm = 4.0\nlabels = "to_mesh.nii.gz"\nnames = "to_mesh.csv"\n'
        f"[models]\nsets = {json.dumps(SETS)}\n"
    )


def truth(hidden: Path, load: str, labels: LabelMap) -> SampledDisplacement:
    """The hidden model's displacement, carried on over a grid with room around the heel."""
    grid = labels.grid
    room = np.ceil(MARGIN_MM / grid.spacing_mm).astype(int)
    shape = tuple(int(n + 2 * r) for n, r in zip(grid.shape, room, strict=True))
    wide = Grid(shape, grid.spacing_mm, grid.points_at(-room.astype(np.float64)), grid.direction)
    inner = tuple(slice(r, r + n) for r, n in zip(room, grid.shape, strict=True))
    bone = np.zeros(shape, dtype=bool)
    bone[inner] = labels.region("bone").inside | labels.region("ankle").inside
    return extrapolated(read_result("hidden", hidden / f"{load}.vtu").deformation, wide, bone)


def as_motion(there: SampledDisplacement, labels: LabelMap) -> Moved:
    """The motion with its inverse, found by Newton's method at every voxel and sampled there."""
    grid = there.grid
    x = grid.points().reshape(-1, 3)
    u = evaluate_on_grid(there, grid, np.ones(grid.shape, dtype=bool))[0]
    start = x - u
    back = material_points(there, x, start) - x
    lost = ~np.isfinite(back).all(axis=1)  # at the grid's rim, far from the heel
    back[lost] = -u[lost]
    return Moved(there, SampledDisplacement(grid, back.reshape(*grid.shape, 3)))


def scores(study: Path, hidden: Path, labels: LabelMap) -> dict[str, object]:
    """The measurement's error, and each set's area between curves, measured and true."""
    results = study / "results"
    names = read_labels(study / "tissues.nii.gz", study / "tissues.csv")
    errors: dict[str, dict[str, dict[str, dict[str, float]]]] = {"error": {}, "error_at_nodes": {}}
    true, comparisons = [], {}
    for load in (x.name for x in LOADS):
        model = read_result("hidden", hidden / f"{load}.vtu")
        folder = results / "registration" / load
        found = spline_in(folder)
        inside = read_mask(folder / "valid.nii.gz").inside & _in(model, labels)
        for kind, truth in (("error", model.deformation), ("error_at_nodes", Averaged(model.deformation))):
            of = [e for m in (names, near_bone(names)) for e in errors_by_tissue(m, truth, found, inside)]
            errors[kind][load] = {
                e.tissue: {"true_p50": e.true_p50, "true_p95": e.true_p95, "rmse": e.shear_rmse, "bias": e.shear_bias,
                           "u_p50_mm": e.u_p50_mm, "u_p95_mm": e.u_p95_mm}
                for e in of
                if e.tissue not in BONES  # the model has none: what of it the mesh covers is the border's staircase
            }  # fmt: skip
        models = [read_result(s, results / "models" / s / f"{load}.vtu") for s in SETS]
        one = compare_load(LoadCase.of(load, model.deformation, models), names)
        true.append(one)
        comparisons[load] = {a.model: a.ml for a in one.areas if a.tissue == ALL and a.model in SETS}
    comparisons[ALL_LOADS] = {a.model: a.ml for a in rank_over_loads(true).areas if a.model in SETS}
    measured: dict[str, dict[str, list[float]]] = {}
    with (results / "comparison" / "areas.csv").open() as file:
        for row in csv.DictReader(file):
            if row["tissue"] == ALL:
                measured.setdefault(row["load"], {})[row["model"]] = [
                    float(row[k]) for k in ("ml", "estimate_ml", "low_ml", "high_ml")
                ]
    # a set that fell short of a load was not compared under it
    areas = {load: {s: ml for s, ml in of.items() if s in measured[load]} for load, of in comparisons.items()}
    said = json.loads((results / "comparison" / "comparison.json").read_text())
    told_apart = {key: said[key] for key in ("told_apart", "not_told_apart")}
    return errors | {"true_area_ml": areas, "measured_area_ml": measured} | told_apart


def near_bone(labels: LabelMap) -> LabelMap:
    """The fat within 3 mm of bone, as a tissue of its own."""
    fat = labels.region("fat").inside & (distances_mm(labels)[0] <= 3.0)
    return LabelMap(labels.grid, fat.astype(np.int64), {1: "fat within 3 mm of bone"})


def misjudged(found) -> list[str]:
    """Pairs whose measured order is not the true one, and which the measurement did not call noise either."""
    wrong = []
    for load, true in found["true_area_ml"].items():
        measured = found["measured_area_ml"][load]
        ranked = sorted(true, key=lambda model: measured[model][1])
        noise = {tuple(pair) for pair in found["not_told_apart"][load]}
        wrong += [
            f"{load}: {a} before {b}" for a, b in combinations(ranked, 2) if true[a] > true[b] and (a, b) not in noise
        ]
    return wrong


def _in(model, labels: LabelMap) -> np.ndarray:
    points = labels.grid.points().reshape(-1, 3)
    inside = np.isfinite(model.deformation.displacement(points)).all(axis=1)
    return inside.reshape(labels.grid.shape)


def told(found) -> str:
    """The figures as tables."""
    lines = [
        "| load | tissue | true shear p50 / p95 | RMSE / bias | against strain at nodes | u p50 / p95, mm |",
        "|---|---|---|---|---|---|",
    ]
    for load, of in found["error"].items():
        for tissue, e in of.items():
            at_nodes = found["error_at_nodes"][load][tissue]
            lines.append(
                f"| {load} | {tissue} | {e['true_p50']:.3f} / {e['true_p95']:.3f} | {e['rmse']:.3f} / {e['bias']:+.3f} "
                f"| {at_nodes['rmse']:.3f} / {at_nodes['bias']:+.3f} | {e['u_p50_mm']:.2f} / {e['u_p95_mm']:.2f} |"
            )
    lines += [
        "",
        "| load | set | true area, mL | measured | estimate | interval | holds |",
        "|---|---|---|---|---|---|---|",
    ]
    for load, of in found["true_area_ml"].items():
        for model, area in sorted(of.items(), key=lambda pair: pair[1]):
            ml, best, low, high = found["measured_area_ml"][load][model]
            holds = "yes" if low <= area <= high else "no"
            lines.append(
                f"| {load} | {model} | {area:.2f} | {ml:.2f} | {best:.2f} | {low:.2f} to {high:.2f} | {holds} |"
            )
    return "\n".join([*lines, "", *found["told_apart"]])


if __name__ == "__main__":
    main()
