"""Error bars on motions that were not foreseen: pairs moved by finite-element models of other tissues and plates.

    python -m benchmarks.unforeseen --work FOLDER --out benchmarks/results/unforeseen.json   # hours on one core
    python -m benchmarks.unforeseen --work FOLDER --widen STUDY                              # the models that ship
    python -m benchmarks.unforeseen --work FOLDER --untouched --out benchmarks/results/untouched.json

A whole phantom heel is meshed, and pressed and sheared by the plate of the published experiment, with another set of
tissues for each kind of motion. Images of both states are made and registered by each engine. The tables of the shipped
error models were not made from such motions. They are judged by the fraction of voxels whose true maximum shear strain
(that of the mesh) lies within 1.96 standard deviations, by tissue and near bone; by the same for the components; and by
the fraction of true figures in their intervals, which are widened by the other kinds of motion. Two motions of the
accuracy study, on a heel that it did not use, are given for comparison. Results in the work folder are not computed
again, so two processes may share the work (--heels).

With --widen, the error models of an accuracy study (`mrstrain accuracy --out STUDY`) are widened by all kinds of motion
and written to where mrstrain finds them. Two kinds of motion, on a heel of their own, are never used for that: they are
registered (--untouched) when everything else is settled, and judged by the error models as they ship.
"""

from __future__ import annotations

import argparse
import json
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt, gaussian_filter

from benchmarks.hidden_law import BONES, as_motion, truth
from dvc import (
    ErrorModel,
    LabelMap,
    Mask,
    Settings,
    TetMesh,
    read_error_model,
    register,
    write_labels,
)
from dvc.arrays import FloatArray, IntArray
from dvc.trust.error_model import error_model_of
from dvc.worker import Worker
from fe import read_tet_mesh, write_tet_mesh
from mrstrain import mesh as make_mesh, simulate
from mrstrain.models.simulate import LOADS
from mrstrain.records.provenance import versions
from phantoms import (
    TISSUES,
    AccuracyCase,
    CoverageRow,
    ErrorSamples,
    Heel,
    coverage_rows,
    covering,
    heel_grid,
    labels_of,
    measure_run,
    random_foot_motion,
    sampled_errors,
    scan,
    widened_for,
)
from validate import read_result

ENGINES = ("gauss-newton-borders", "gauss-newton-bone", "gauss-newton")
VOXEL_MM, SNR = (0.8, 0.8, 0.8), 25.0
COARSE_MM = (1.2, 1.2, 1.2)
NEAR_MM = 3.0
SOFT = ("fat", "muscle", "skin")


def laws(fat: float | tuple[float, ...], skin: float | tuple[float, float], muscle: float) -> str:
    """A material set: initial shear moduli, kPa; fat in several kinds, and skin by Yeoh's c10 and c20, MPa."""
    ogden = 'law = "Ogden"\nconvention = "abaqus"\nalpha = 7.5\nmu_kpa = {}'
    hooke, yeoh = 'law = "neo-Hooke"\nmu_kpa = {}', 'law = "Yeoh"\nc10_mpa = {}\nc20_mpa = {}'
    fats = {"fat": fat} if isinstance(fat, float) else {f"fat-{n}": mu for n, mu in enumerate(fat)}
    of = {"muscle": hooke.format(muscle), "tendon": ogden.format(25.0)}
    of["skin"] = hooke.format(skin) if isinstance(skin, float) else yeoh.format(*skin)
    of |= {name: ogden.format(mu) for name, mu in fats.items()}
    head = '[hidden]\ntitle = "Made for this benchmark"\nsource = "In no published set."\n'
    return head + "".join(f"[hidden.{name}]\n{law}\nnu = 0.4999\n" for name, law in of.items())


# Heel and material set of each kind of motion; the plate of "slipping" is not taped.
KINDS = {
    "stiff-skin": (7, laws(8.0, (0.5, 3.0), 14.0)),
    "soft-skin": (7, laws(8.0, 30.0, 14.0)),
    "stiff-fat": (7, laws(25.0, (0.1, 0.5), 6.0)),
    "trebbi": (7, "trebbi"),
    "akrami": (8, "akrami"),
    "lobules": (9300, laws((6.0, 11.0, 20.0), (0.12, 0.9), 14.0)),
    "slipping": (9300, laws(10.0, (0.12, 0.9), 14.0)),
    "stiff-muscle": (9300, laws(6.0, (0.2, 1.0), 40.0)),
}
# Never used to widen an error model. Fat of "layers" is stiff near the skin and soft near the bone, as in a real heel;
# the plate of "oblique" is tilted by 20 degrees, and shears sideways.
UNTOUCHED = {"layers": (9302, laws((20.0, 6.0), (0.2, 1.0), 14.0)), "oblique": (9302, "erdemir")}
OBLIQUE = {"plate_normal": (0.0, -np.sin(np.pi / 9), -np.cos(np.pi / 9)), "shear_direction": (1.0, 0.0, 0.0)}
STIFF_LAYER_MM = 5.0
PRESSED, SHEARED = "Load1", "Load3"


def cases(engine: str) -> Iterator[AccuracyCase]:
    """Every case of an engine."""
    for kind, (heel, _) in KINDS.items():
        # Skin of 30 kPa would slide by 21 mm under the shear force, and a plate without tape does not hold it.
        for load in (PRESSED,) if kind in ("slipping", "soft-skin") else (PRESSED, SHEARED):
            yield AccuracyCase(engine, VOXEL_MM, SNR, f"{kind}-{load}", heel)
    yield AccuracyCase(engine, COARSE_MM, SNR, f"lobules-{PRESSED}", 9300)
    for motion in ("sliding", SHEARED):
        yield AccuracyCase(engine, VOXEL_MM, SNR, motion, 9300)


def untouched(engine: str) -> Iterator[AccuracyCase]:
    """Every case of an engine on motions that no error model may see."""
    for kind, (heel, _) in UNTOUCHED.items():
        for load in (PRESSED, SHEARED):
            yield AccuracyCase(engine, VOXEL_MM, SNR, f"{kind}-{load}", heel)


def simulated(work: Path, kind: str) -> tuple[Path, LabelMap]:
    """Simulate a kind of motion, if that is not done; the folder of its results, and the label map that was meshed."""
    heel, material = (KINDS | UNTOUCHED)[kind]
    labels = labels_of(Heel(heel), heel_grid(VOXEL_MM))
    place, own = work / f"{heel}-{kind}", "\n" in material
    folder = place / ("hidden" if own else material)
    if (folder / "regions.csv").is_file():
        return folder, labels
    mesh = work / f"mesh{heel}.vtu"
    if not mesh.is_file():
        write_labels(work / f"whole{heel}.nii.gz", labels)
        names = work / f"whole{heel}.csv"
        make_mesh(work / f"whole{heel}.nii.gz", out=mesh, edge_mm=3.6, names=names, bones=BONES)
    place.mkdir(exist_ok=True)
    if "fat-1" in material:
        divide = layered if kind == "layers" else mixed
        mesh = divided(mesh, place / "mixed.vtu", lambda at: divide(at, labels, heel))
    if own:
        (place / "hidden.toml").write_text(material)
    loads = [load for load in LOADS if load.name == PRESSED or (load.name == SHEARED and kind != "slipping")]
    sets = [str(place / "hidden.toml") if own else material]
    plate = {"taped": kind != "slipping"} | (OBLIQUE if kind == "oblique" else {})
    print(*simulate(mesh, out=place, sets=sets, loads=loads, **plate).summary(), sep="\n", flush=True)
    return folder, labels


def divided(mesh: Path, out: Path, kind_of: Callable[[FloatArray], IntArray]) -> Path:
    """The mesh with several kinds of fat, by the kind (0, 1 ...) of the positions (n, 3), LPS mm, of its cells."""
    plain = read_tet_mesh(mesh)
    fat = plain.regions["fat"]
    kinds = kind_of(plain.centroids_mm[fat])
    regions = {name: cells for name, cells in plain.regions.items() if name != "fat"}
    regions |= {f"fat-{k}": fat[kinds == k] for k in np.unique(kinds)}
    write_tet_mesh(out, TetMesh(plain.points_mm, plain.cells, regions=regions, facets=plain.facets), {})
    return out


def mixed(points_mm: FloatArray, labels: LabelMap, seed: int) -> IntArray:
    """Three kinds of fat, in lobules of 6 mm."""
    width = 6.0 / 2.355 / VOXEL_MM[0]
    shape = [n + int(np.ceil(6.0 * width)) for n in labels.grid.shape]
    values = gaussian_filter(np.random.default_rng([seed, 77]).standard_normal(shape), width, mode="wrap")
    at = np.rint(labels.grid.indices_of(points_mm)).astype(int)
    return np.asarray(np.digitize(values[tuple(at.T)], np.quantile(values[tuple(at.T)], [1 / 3, 2 / 3])))


def layered(points_mm: FloatArray, labels: LabelMap, _seed: int) -> IntArray:
    """Two kinds of fat: that within some millimetres of the skin, and that below."""
    from_skin = distance_transform_edt(~labels.region("skin").inside, sampling=labels.grid.spacing_mm)
    at = np.rint(labels.grid.indices_of(points_mm)).astype(int)
    return np.asarray(from_skin[tuple(at.T)] > STIFF_LAYER_MM, dtype=int)


def modelled(work: Path, case: AccuracyCase, worker: Worker) -> ErrorSamples:
    """A pair whose motion a finite-element model makes, registered and compared with the strain of the mesh's cells."""
    heel, grid = Heel(case.seed), heel_grid(case.spacing_mm)
    labels, load = labels_of(heel, grid), case.motion.rpartition("-")[2]
    folder, meshed = simulated(work, case.kind)
    motion = as_motion(truth(folder, load, meshed), meshed)
    number = zlib.crc32(case.motion.encode())
    foot, bone = random_foot_motion(case.seed, number), labels.region("bone")
    reference = scan(heel, grid, snr=case.snr, number=number)
    there = covering(grid, foot.apply(bone.points()))
    loaded = scan(heel, there, motion, foot, snr=case.snr, number=number + 1)
    settings = Settings.of(case.preset, threads=worker.threads)
    settings = replace(settings, engine=settings.engine.keeping_volume())
    body = labels.labels > 0
    found = register(
        reference, loaded, bone=bone, tissue=Mask(grid, body), labels=labels, settings=settings, worker=worker
    )
    return sampled_errors(case, labels, body, read_result(case.kind, folder / f"{load}.vtu").deformation, found)


def run(work: Path, of: list[AccuracyCase]) -> None:
    """Measure cases, one after the other; what was measured before is not measured again."""
    with Worker(threads=1) as worker:
        for case in of:
            path = work / "runs" / f"{case.name}.npz"
            if ErrorSamples.read(path, key) is None:
                if case.kind in KINDS | UNTOUCHED:
                    one = modelled(work, case, worker)
                else:
                    one = measure_run(case, worker, nullcontext(), lambda _: None)
                one.write(path, key(case))
                print(case.name, told(one), flush=True)


def key(case: AccuracyCase) -> str:
    """What tells that a file is of this benchmark."""
    return f"unforeseen {case.name}"


def told(one: ErrorSamples) -> dict[str, float]:
    """Root mean square error of the maximum shear strain by tissue."""
    error = one.shear - one.true_shear
    numbers = {name: number for number, name in TISSUES.items()}
    return {t: round(float(np.sqrt(np.mean(error[one.tissue == numbers[t]] ** 2))), 4) for t in SOFT}


def held(runs: list[ErrorSamples], model: ErrorModel, figures: list[CoverageRow]) -> dict[str, dict[str, float]]:
    """Share of voxels and of ``figures`` in their intervals, and half the width of voxels', by kind of motion."""
    numbers = {name: number for number, name in TISSUES.items()}
    found: dict[str, dict[str, list[np.ndarray]]] = {}
    for one in runs:
        table = model.table_for(np.array(one.case.spacing_mm), one.estimated_snr)
        coarse = " at 1.2 mm" if one.case.spacing_mm == COARSE_MM else ""
        rows = found.setdefault(f"{one.case.kind}{coarse}", {})
        for tissue in SOFT:
            of = one.tissue == numbers[tissue]
            bias, sd = table.expected(tissue, one.shear[of].astype(np.float64), one.to_bone_mm[of])
            within = np.abs(one.shear[of] - one.true_shear[of] - bias) < 1.96 * sd
            rows.setdefault(tissue, []).append(within)
            rows.setdefault(f"{tissue}, half width", []).append(1.96 * sd)
            rows.setdefault("near bone", []).append(within[one.to_bone_mm[of] < NEAR_MM])
    shares = {kind: {t: round(float(np.concatenate(w).mean()), 3) for t, w in of.items()} for kind, of in found.items()}
    each: dict[tuple[str, str], list[float]] = {}
    for row in figures:
        case = AccuracyCase("", VOXEL_MM, SNR, row.motion, 0)
        kind = f"{case.kind}{' at 1.2 mm' if row.voxel_mm == '1.2' else ''}"
        of_row = {"figures": row.statistics_within, "normal strain": row.normal_strain_within}
        of_row |= {"shear strain": row.shear_strain_within, "displacement": row.displacement_within}
        for what, share in of_row.items():
            each.setdefault((kind, f"{row.tissue}, {what}"), []).append(share)
    for (kind, name), some in each.items():
        shares[kind][name] = round(float(np.mean(some)), 3)
    means = {t: round(float(np.mean([of[t] for of in shares.values()])), 3) for t in next(iter(shares.values()))}
    return {"every kind": means} | shares


def figures_of(runs: list[ErrorSamples], model: ErrorModel) -> list[CoverageRow]:
    """Coverage of figures: each kind with intervals widened by the other kinds, the rest with those of the model."""
    by_kind = [row for kind in KINDS for row in left_out(runs, kind, model)]
    return by_kind + coverage_rows([one for one in runs if one.case.kind not in KINDS], model)


def left_out(runs: list[ErrorSamples], kind: str, model: ErrorModel) -> list[CoverageRow]:
    """Coverage of a kind of motion, with intervals widened by the other kinds."""
    others = [one for one in runs if one.case.kind in KINDS and one.case.kind != kind]
    return coverage_rows([one for one in runs if one.case.kind == kind], widened_for(model, others))


def ship(work: Path, study: Path, engines: Iterable[str]) -> None:
    """Widen the error models of a study, and write them to where mrstrain finds them."""
    for engine in engines:
        some = [one for one in measured(work, cases(engine)) if one.case.kind in KINDS]
        model = widened_for(read_error_model(study / f"error_model_{engine}.json"), some)
        source = f"{model.source}; intervals of tissues widened by {len(some)} pairs that finite-element models move"
        replace(model, source=source).write(Path(f"dvc/trust/error_models/{engine}.json"))


def measured(work: Path, of: Iterable[AccuracyCase]) -> list[ErrorSamples]:
    """Samples of those cases that were measured."""
    read = (ErrorSamples.read(work / "runs" / f"{case.name}.npz", key) for case in of)
    return [one for one in read if one is not None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--heels", type=int, nargs="+", help="only make the pairs of these heels")
    with_bars = [engine for engine in ENGINES if error_model_of(engine) is not None]
    parser.add_argument("--engines", nargs="+", choices=(*ENGINES, "heel-mr"), default=with_bars)
    parser.add_argument("--untouched", action="store_true", help="the motions that no error model may see")
    parser.add_argument("--out", type=Path, help="results of other engines in this file are kept")
    parser.add_argument("--widen", type=Path, help="folder of an accuracy study")
    given = parser.parse_args()
    (given.work / "runs").mkdir(parents=True, exist_ok=True)
    of = untouched if given.untouched else cases
    every = [case for engine in given.engines for case in of(engine)]
    run(given.work, [case for case in every if given.heels is None or case.seed in given.heels])
    if given.widen is not None:
        ship(given.work, given.widen, given.engines)
    if given.out is None:
        return
    result = json.loads(given.out.read_text()) if given.out.is_file() else {}
    for engine in given.engines:
        runs, model = measured(given.work, of(engine)), error_model_of(engine)
        if model is None:
            parser.error(f"{engine} has no error model; make it first, with --widen")
        figures = coverage_rows(runs, model) if given.untouched else figures_of(runs, model)
        result[engine] = {"versions": versions()} | held(runs, model, figures)
        print(engine, json.dumps(result[engine], indent=1))
        given.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
