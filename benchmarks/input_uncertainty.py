"""How often intervals hold and orders are right if force, direction, labels, materials and mesh are wrong.

    python -m benchmarks.input_uncertainty --cases 40 --out benchmarks/results/input_uncertainty.json

A small pad of fat and skin under a rounded bone has a hidden law: fat of three stiffnesses, mixed at random. In each
case, the force, the direction of the plate, the thickness of bone and skin, and Poisson's ratio of each model get
errors drawn with their stated standard deviations, and the models have a coarser mesh than the truth. Three models,
whose fat is stiffer or softer at random, are compared with a measurement whose error is drawn from the error model of
the Gauss-Newton engine. The intervals should hold the area of each model with right inputs, on the mesh of the truth.

The result is the coverage of the intervals; the pairs in the wrong order among those called significantly different;
and the number of pairs called so (power). All is repeated with the inputs taken as exact. The interval E +- 2 u_val of
a statistic should hold the error of the model with right inputs, on the mesh of the truth, without an error of the
measurement. Skin is hardly strained here, so it does not count. The measurement follows its error model, so only the
models are tested. Cases that are already in the file are not run again.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from itertools import combinations
from operator import attrgetter
from pathlib import Path

import numpy as np

from dvc import Grid, LabelMap, TetMesh, plate_axes
from dvc.trust.error_model import error_model_of
from dvc.trust.truth_draws import TruthDraws
from fe import LoadStep, NeoHooke, Plate, SolverOptions, Yeoh, cell_size_mm, mesh_steps, problems_of, solve, variation
from mrstrain.records.provenance import versions
from validate import ALL, ALL_LOADS, FeResult, LoadCase, Variant, compare_load, rank_over_loads
from validate.comparison_error import AREA, _statistics
from validate.ranking import summed

SPREAD = {"force": 0.03, "direction_deg": 2.0, "poisson": 0.5, "labels_mm": 0.4}
LOADS = (LoadStep("Load1", 16.0), LoadStep("Load3", 6.0, 4.0))
HALF_MM, PAD_MM, SKIN_MM, BONE_RADIUS_MM, SOLE_RADIUS_MM = 16.0, 12.0, 2.0, 22.0, 60.0
TRUTH, MODEL, COARSE = (12, 2, 5), (9, 1, 4), (7, 1, 3)  # cells across, through skin, and through fat
FAT_MPA, NU = 0.008, 0.4995
MODELS = ("a", "b", "c")
PLATE = Plate((0.0, 0.0, -1.0), (0.0, -1.0, 0.0))


def pad(count: tuple[int, int, int], bone_mm: float = 0.0, skin_mm: float = 0.0) -> TetMesh:
    """The pad, its bone and skin thicker by so much; LPS mm, the plate comes from below."""
    across, of_skin, of_fat = count
    line = np.linspace(-HALF_MM, HALF_MM, across + 1)
    x, y = np.meshgrid(line, line, indexing="ij")
    sole, bone = (x**2 + y**2) / (2.0 * SOLE_RADIUS_MM), PAD_MM + (x**2 + y**2) / (2.0 * BONE_RADIUS_MM) - bone_mm
    inside = sole + SKIN_MM + skin_mm
    layers = [sole + share * (inside - sole) for share in np.linspace(0.0, 1.0, of_skin + 1)]
    layers += [inside + share * (bone - inside) for share in np.linspace(0.0, 1.0, of_fat + 1)[1:]]
    points = np.stack([np.broadcast_to(x, (len(layers), *x.shape)), np.broadcast_to(y, (len(layers), *y.shape)),
                       np.array(layers)], axis=-1)  # fmt: skip
    number = np.arange(points[..., 0].size).reshape(points.shape[:3])
    cells, layer = [], []
    for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        corner, path = np.zeros(3, dtype=int), [np.zeros(3, dtype=int)]
        for axis in order:
            corner = corner + np.eye(3, dtype=int)[axis]
            path.append(corner)
        ends = [number[tuple(slice(c, n - 1 + c) for c, n in zip(at, number.shape, strict=True))] for at in path]
        cells.append(np.stack(ends, axis=-1).reshape(-1, 4))
        layer.append(np.repeat(np.arange(number.shape[0] - 1), across**2))
    tets, at = np.concatenate(cells), points.reshape(-1, 3)
    corners = at[tets]
    inverted = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0.0
    tets[inverted] = tets[inverted][:, [0, 1, 3, 2]]
    skin = np.concatenate(layer) < of_skin
    faces = np.sort(np.concatenate([np.delete(tets, k, axis=1) for k in range(4)]), axis=1)
    faces = np.unique(faces, axis=0)
    facets = {name: faces[np.isin(faces, number[end]).all(axis=1)] for name, end in (("skin", 0), ("bone", -1))}
    return TetMesh(at, tets, {"skin": np.flatnonzero(skin), "fat": np.flatnonzero(~skin)}, facets)


def labels() -> LabelMap:
    """Labels of the pad as it is taken to be, voxels of 1 mm."""
    half = int(HALF_MM) + 3
    grid = Grid((2 * half, 2 * half, 32), np.ones(3), np.array([0.5 - half, 0.5 - half, -3.5]))
    x, y, z = np.moveaxis(grid.points(), -1, 0)
    around = x**2 + y**2
    sole, bone = around / (2.0 * SOLE_RADIUS_MM), PAD_MM + around / (2.0 * BONE_RADIUS_MM)
    inside = (np.abs(x) <= HALF_MM) & (np.abs(y) <= HALF_MM) & (z >= sole)
    kind = np.where(z > bone, 3, np.where(z < sole + SKIN_MM, 1, 2))
    return LabelMap(grid, np.where(inside, kind, 0), {1: "skin", 2: "fat", 3: "bone"})


class Measured:
    """A deformation whose gradient has the maximum shear strain that is given at some points, and nothing else."""

    def __init__(self, points_mm: np.ndarray, u_mm: np.ndarray, max_shear: np.ndarray) -> None:
        self._at = {tuple(point): k for k, point in enumerate(points_mm.tolist())}
        gamma = np.sqrt(2.0 * (np.sqrt(1.0 + 4.0 * max_shear**2) - 1.0))  # equation 5 of docs/theory.md, solved
        self._u, self._H = u_mm, np.zeros((len(u_mm), 3, 3))
        self._H[:, 1, 2] = gamma

    def displacement(self, points_mm):
        return self.evaluate(points_mm)[0]

    def evaluate(self, points_mm):
        index = np.array([self._at.get(tuple(point), -1) for point in np.asarray(points_mm).tolist()])
        u, H = self._u[index].copy(), self._H[index].copy()
        u[index < 0], H[index < 0] = np.nan, np.nan
        return u, H


def with_error(shear: np.ndarray, points_mm: np.ndarray, tissue: np.ndarray, to_bone_mm: np.ndarray, seed: int):
    """A measurement of the true maximum shear strain e: m with m - b(m) - s(m) g = e, for one registration."""
    table = error_model_of("gauss-newton-borders").table_for(np.full(3, 0.8), 25.0)
    random = np.random.default_rng(seed)
    run = int(random.integers(len(table.runs)))
    unit = replace(table, runs=tuple({k: np.stack([0.0 * v[0], 1.0 + 0.0 * v[1]]) for k, v in r.items()}
                                     for r in table.runs))  # fmt: skip
    field = 5.0 - TruthDraws(points_mm, np.full(len(shear), 5.0), tissue.tolist(), to_bone_mm, unit, seed).drawn()
    found = shear.copy()
    for _ in range(30):
        bias, sd = np.empty((2, len(shear)))
        for name in np.unique(tissue):
            here = tissue == name
            bias[here], sd[here] = table.expected(str(name), found[here], to_bone_mm[here], run)
        found = 0.5 * found + 0.5 * np.maximum(shear + bias + sd * field, 0.0)
    return found, table


def materials(fat_mpa: float, nu: float = NU):
    return {"skin": Yeoh.of(0.05, 0.2, nu=nu), "fat": NeoHooke.of(fat_mpa, nu)}


def solved(mesh, laws, plate=PLATE, loads=LOADS):
    """The states of both loads; None if one is not reached."""
    states = [s for one in problems_of(mesh, laws, plate, loads) for s in solve(one, SolverOptions(1))]
    reached = len(states) == len(loads) and all(s.reached == 1.0 for s in states)
    return {s.load.name: s for s in states} if reached else None


def hidden(mesh: TetMesh, random: np.random.Generator):
    """The truth's mesh and laws: fat of three stiffnesses in lobules of some 6 mm."""
    fat = mesh.regions["fat"]
    seeds = random.uniform([-HALF_MM, -HALF_MM, 0.0], [HALF_MM, HALF_MM, 20.0], (60, 3))
    kinds = random.integers(3, size=60)
    nearest = np.argmin(np.linalg.norm(mesh.centroids_mm[fat][:, None] - seeds[None], axis=2), axis=1)
    regions = {"skin": mesh.regions["skin"]} | {f"fat-{k}": fat[kinds[nearest] == k] for k in range(3)}
    laws = {"skin": Yeoh.of(0.05, 0.2, nu=NU)}
    laws |= {f"fat-{k}": NeoHooke.of(FAT_MPA * s, NU) for k, s in enumerate((0.6, 1.0, 1.7))}
    return TetMesh(mesh.points_mm, mesh.cells, regions, mesh.facets), laws


def variants_of(laws, mesh: TetMesh, coarse: TetMesh) -> dict[str, list[Variant]] | None:
    """Variants of one model by load, as a study makes them."""
    base = solved(coarse, laws)
    if base is None:
        return None
    states = {name: state.checkpoint for name, state in base.items()}
    bone, of_bone = variation.with_bone(coarse, SPREAD["labels_mm"])
    skin, of_skin = variation.with_tissue(coarse, "skin", SPREAD["labels_mm"])
    force = [variation.with_force(load, SPREAD["force"]) for load in LOADS]
    changed = {
        "force": (problems_of(coarse, laws, PLATE, force), 1.0),
        "poisson": (problems_of(coarse, variation.with_compressibility(laws, SPREAD["poisson"]), PLATE, LOADS), 1.0),
        "labels-bone": (problems_of(bone, laws, PLATE, LOADS), of_bone),
        "labels-skin": (problems_of(skin, laws, PLATE, LOADS), of_skin),
    }
    found = {}
    for (name, (problems, by)), on in zip(changed.items(), (coarse, coarse, bone, skin), strict=True):
        short = (s for p in problems for s in variation.from_base(p, states, SolverOptions(1)))
        found[name] = {s.load.name: s for s in short}, by, on
    for name, along in (("direction-along", True), ("direction-across", False)):
        tilted = solved(coarse, laws, variation.tilted(PLATE, SPREAD["direction_deg"], along=along))
        if tilted is not None:
            found[name] = tilted, 1.0, coarse
    steps = mesh_steps(cell_size_mm(coarse) / cell_size_mm(mesh))
    made: dict[str, list[Variant]] = {}
    for load in (x.name for x in LOADS):
        start = _on(coarse, base[load].u_mm)
        made[load] = [Variant("mesh", steps, start)]
        made[load] += [Variant(name, by, _on(on, of[load].u_mm), start) for name, (of, by, on) in found.items()
                       if load in of and of[load].reached == 1.0]  # fmt: skip
    return made


def _on(mesh: TetMesh, u_mm: np.ndarray):
    from dvc.deformation.nodal import OnMesh

    made = OnMesh(mesh, u_mm)
    return lambda: made


def case(seed: int) -> dict[str, object] | None:
    """One case; None if a load was not reached."""
    random = np.random.default_rng([32, seed])
    force, along, across, bone, skin = random.standard_normal(5)
    plate = variation.tilted(variation.tilted(PLATE, SPREAD["direction_deg"] * along, along=True),
                             SPREAD["direction_deg"] * across, along=False)  # fmt: skip
    loads = [replace(x, normal_n=x.normal_n * (1.0 + SPREAD["force"] * force),
                     shear_n=x.shear_n and x.shear_n * (1.0 + SPREAD["force"] * force)) for x in LOADS]  # fmt: skip
    right = pad(TRUTH, SPREAD["labels_mm"] * bone, SPREAD["labels_mm"] * skin)
    mesh, coarse = pad(MODEL), pad(COARSE)
    true = solved(*hidden(right, random), plate, loads)
    stiffness = dict(zip(MODELS, np.exp(random.uniform(-0.5, 0.5, len(MODELS))), strict=True))
    off = {name: max(1.0 + SPREAD["poisson"] * random.standard_normal(), 0.1) for name in MODELS}
    made, best, variants = {}, {}, {}
    for name in MODELS:
        laws = materials(FAT_MPA * stiffness[name])
        wrong = variation.with_compressibility(laws, off[name] - 1.0)
        made[name], best[name] = solved(mesh, laws), solved(right, wrong, plate, loads)
        variants[name] = variants_of(laws, mesh, coarse)
    if true is None or any(of[name] is None for of in (made, best, variants) for name in MODELS):
        return None
    tissues, results, references = labels(), [], []
    axes = plate_axes((0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    for load in (x.name for x in LOADS):
        truth = _on(right, true[load].u_mm)()
        of_best = [FeResult.of(name, _on(right, best[name][load].u_mm)()) for name in MODELS]
        exact = compare_load(replace(LoadCase.of(load, truth, of_best), axes=axes), tissues, mesh=mesh)
        fields = exact.fields
        shear = fields.measured.max_shear
        known = np.isfinite(shear)
        found, table = with_error(shear[known], fields.points_mm[known], fields.tissue[known], fields.to_bone_mm[known],
                                  1000 * seed + len(results))  # fmt: skip
        measured = Measured(fields.points_mm[known], fields.measured.u_mm[known], found)
        models = [FeResult.of(n, _on(mesh, made[n][load].u_mm)(), variants[n][load]) for n in MODELS]
        one = compare_load(replace(LoadCase.of(load, measured, models, table), axes=axes), tissues)
        references.append(exact)
        results.append(one)
    return told(results, references)


def true_error(exact, stated) -> float:
    """The error of a statistic without errors of measurement, inputs and mesh."""
    where, of_strain = exact.fields.parts[stated.tissue], {"median": 0, "p95": 1}
    levels = [] if stated.statistic in of_strain else [float(stated.statistic.split()[-1])]
    fields = exact.fields.models[stated.model], exact.fields.measured
    of = [_statistics(one.max_shear[where], exact.fields.volumes_ml[where], levels) for one in fields]
    return float((of[0] - of[1])[of_strain.get(stated.statistic, -1)])


def told(results, references) -> dict[str, object]:
    """Intervals with the areas that they should hold, and pairs in their order, with inputs drawn and as exact."""
    areas, pairs = [], []
    true = {(a.load, a.model, a.tissue): a.ml for one in references for a in one.areas}
    total = {a.model: a.ml for a in rank_over_loads(references).areas}
    bands = {(one.load, tissue): band for one in results for tissue, band in one.bands.items()}
    bands[ALL_LOADS, ALL] = summed([one.bands[ALL] for one in results], MODELS)
    true |= {(ALL_LOADS, name, ALL): ml for name, ml in total.items()}
    for (load, tissue), band in bands.items():
        exact = replace(band, varied_ml={})
        for name in MODELS:
            area = true[load, name, tissue]
            areas.append([load, tissue, name, area, *band.interval(name)[:3], *exact.interval(name)[1:3]])
        for a, b in combinations(MODELS, 2) if tissue == ALL else ():
            gap = true[load, a, ALL] - true[load, b, ALL]
            said = [int(of.surely_below(b, a)) - int(of.surely_below(a, b)) for of in (band, exact)]
            pairs.append([load, a, b, gap, *said])
    numbers = attrgetter("error", "u_num", "u_input", "u_d", "low", "high")
    errors = [
        [e.load, e.model, e.tissue, e.statistic, true_error(exact, e), *numbers(e)]
        for one, exact in zip(results, references, strict=True)
        for e in one.errors
        if e.statistic != AREA
    ]
    shears = {one.load: one.fields.measured.max_shear[one.fields.common] for one in results}
    strains = [[load, *np.quantile(shear, [0.5, 0.95]).tolist()] for load, shear in shears.items()]
    return {"areas": areas, "pairs": pairs, "errors": errors, "measured_p50_p95": strains}


def summary(cases: list[dict]) -> dict[str, object]:
    """Coverage, wrong orders and power over all cases."""
    areas, pairs = ([row for case in cases for row in case[key]] for key in ("areas", "pairs"))
    areas = [row for row in areas if row[1] != "skin"]
    if not areas:
        return {}
    held = {name: float(np.mean([row[k] <= row[3] <= row[k + 1] for row in areas])) for name, k in
            (("inputs drawn", 5), ("inputs exact", 7))}  # fmt: skip
    by = {f"{load}, {tissue}": float(np.mean([r[5] <= r[3] <= r[6] for r in areas if r[:2] == [load, tissue]]))
          for load, tissue in dict.fromkeys((r[0], r[1]) for r in areas)}  # fmt: skip
    width = {name: float(np.mean([row[k + 1] - row[k] for row in areas])) for name, k in
             (("inputs drawn", 5), ("inputs exact", 7))}  # fmt: skip
    orders = {}
    for name, k in (("inputs drawn", 4), ("inputs exact", 5)):
        called = [row for row in pairs if row[k] != 0]
        wrong = sum(row[k] * row[3] < 0.0 for row in called)
        orders[name] = {"pairs": len(pairs), "called different": len(called), "in the wrong order": wrong}
    return {
        "cases": len(cases), "coverage": held, "coverage_by": by, "mean_width_ml": width, "orders": orders,
        "coverage_of_errors": held_errors([row for case in cases for row in case["errors"]]),
    }  # fmt: skip


def held_errors(rows: list[list]) -> dict[str, dict[str, float]]:
    """Share of the intervals E +- 2 u_val that hold the true error, and their number, by tissue and kind of statistic.

    Statistics that are certain (0 mL above a level, in the model and in the measurement) do not count.
    """
    found: dict[str, list[bool]] = {}
    for _, _, tissue, name, true, error, _, _, _, low, high in rows:
        if tissue != "skin" and np.isfinite(error) and high > low:
            kind = f"{tissue}, {'volume above a strain' if name.startswith('volume') else name}"
            found.setdefault(kind, []).append(bool(low <= true <= high))
            found.setdefault("all", []).append(found[kind][-1])
    return {kind: {"held": float(np.mean(of)), "of": len(of)} for kind, of in found.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    content = json.loads(given.out.read_text()) if given.out.is_file() else {"cases": {}}
    for seed in range(given.first, given.first + given.cases):
        if str(seed) in content["cases"]:
            continue
        began = time.process_time()
        made = case(seed)
        content["cases"][str(seed)] = made
        finished = [one for one in content["cases"].values() if one]
        content |= {"versions": versions(), "spread": SPREAD, "summary": summary(finished)}
        given.out.write_text(json.dumps(content, indent=None) + "\n")
        took = f"{time.process_time() - began:.0f} s"
        print(seed, took, "not reached" if made is None else content["summary"], flush=True)


if __name__ == "__main__":
    main()
