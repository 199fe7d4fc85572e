"""`converge`: mesh convergence, the same loads on meshes of several sizes, and the extrapolated limits."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

import fe
from dvc.atomic_files import write_csv, write_json, write_whole
from dvc.errors import InputError, MrstrainError, few
from dvc.measurement.subject import bones_of
from dvc.own_files import read_json
from dvc.report.drawing import figure_files, save_figure
from dvc.threads import usable_cores
from fe import (
    Limit,
    LoadStep,
    MaterialSet,
    Simulation,
    cell_size_mm,
    extrapolate,
    figures,
    material_set,
    paths_of,
    read_tet_mesh,
)
from mrstrain.models.mesh import mesh as make_mesh
from mrstrain.models.simulate import LOADS, path_name, simulate
from mrstrain.models.variant_files import MESH, VARIANT, VariantRecord
from mrstrain.options import modelling as options
from mrstrain.options.door import door
from mrstrain.options.measurement import Cores
from mrstrain.records.durations import PathSize, cells_of, meshing, simulations
from mrstrain.records.inputs import alone, output_folder, read_given_labels, refuse_touching_inputs
from mrstrain.records.progress import OnProgress, expect
from mrstrain.records.provenance import file_hash, provenance
from mrstrain.records.time_left import Expected

_FEWEST = 3
_SHEAR = "maximum shear strain"


@dataclass(frozen=True, slots=True)
class Row:
    """A quantity of one load: its value on each mesh, and the extrapolated limit."""

    load: str
    quantity: str
    values: tuple[float, ...]
    limit: Limit


@dataclass(frozen=True, slots=True)
class Converged:
    """Result of `converge`."""

    out: Path
    sizes_mm: tuple[float, ...]
    rows: tuple[Row, ...]

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        lines = ["Cell sizes, mm: " + ", ".join(f"{s:.2f}" for s in self.sizes_mm)]
        for row in self.rows:
            values, of = ", ".join(f"{v:.4g}" for v in row.values), row.limit
            tends = f"limit {of.limit:.4g} (order {of.order:.1f}), error of the finest mesh {100 * of.error:+.1f} %"
            tends = (
                tends if np.isfinite(of.limit) else "no limit, because the values do not approach one; use finer meshes"
            )
            lines.append(f"{row.load}, {row.quantity}: {values}; {tends}")
        return [*lines, f"Results: {self.out}"]


@door
def converge(
    labels: Path | str, edges_mm: Sequence[float], *, out: Path | str, labelling: options.Labelling,
    followed: options.Followed, loads: Sequence[LoadStep] = LOADS, directions: options.Directions,
    workers: int | None = None, progress: OnProgress | None = None,
) -> Converged:  # fmt: skip
    """Mesh a label map with several edge lengths, simulate the same loads on each mesh, and extrapolate.

    Parameters
    ----------
    labels
        As in `mesh`.
    edges_mm : sequence of float
        At least three edge lengths, mm.
    out : path
        Gets ``mesh-E.vtu`` and ``simulated-E`` for each edge length E, ``convergence.csv`` and its figure, as PNG and
        PDF. An existing mesh that was made from the same label map is reused. The simulation on the second finest mesh
        (with cells at least 1.1 times as large) gets ``variant.toml``: `compare` takes from it the uncertainty of the
        finest mesh.
    loads, workers, progress
        As in `simulate`, with one material set.

    Raises
    ------
    InputError
        If there are fewer than three edge lengths, or the region or the material set does not match the label map;
        before anything is meshed.
    MrstrainError
        If a load is not reached on a mesh.
    """
    target, edges = Path(out), sorted(set(edges_mm), reverse=True)
    if len(edges) < _FEWEST:
        raise InputError(f"Mesh convergence needs at least {_FEWEST} different edge lengths; got {len(edges)}.")
    inputs = {"labels": [Path(labels)], **labelling.files}
    refuse_touching_inputs(target, [f"simulated-{edge:g}" for edge in edges], [Path(labels), *labelling.paths])
    tell, region, material = progress or (lambda *_: None), followed.region, followed.material
    tissues = read_given_labels(labels, labelling.names)
    known, bones = list(tissues.names.values()), bones_of(tissues, labelling.bones)
    labelling = labelling.model_copy(update={"bones": bones})
    if region not in known or region in bones:
        raise InputError(f"The label map has no soft tissue '{region}'; it has {few(known)}.")
    # an unsuitable material set is refused before hours of meshing
    chosen = material_set(material)
    chosen.for_regions([name for name in known if name not in bones])
    with output_folder(target), alone(target):
        places = {edge: target / f"mesh-{edge:g}.vtu" for edge in edges}
        to_mesh = [edge for edge, place in places.items() if not _is_of(place, inputs, bones)]
        cells = {edge: cells_of(tissues, bones, edge) for edge in edges}
        expect(progress, _expected(cells, to_mesh, chosen, loads), workers or usable_cores())
        for edge, place in places.items():
            if edge in to_mesh:
                make_mesh.with_options(
                    labels, out=place, labelling=labelling, meshing=options.Meshing(edge_mm=edge),
                    progress=lambda _, stage, share, edge=edge: tell(f"{edge:g} mm", stage, share),  # type: ignore[misc]
                )  # fmt: skip
        sizes = np.array([cell_size_mm(read_tet_mesh(place)) for place in places.values()])
        extrapolate(sizes, sizes)  # refuses sizes that give no limit, before anything is simulated
        values, simulated = [], list[Path]()
        for edge, place in places.items():
            made = simulate.with_options(
                place, out=target / f"simulated-{edge:g}", simulation=options.SimulationOptions(sets=(material,)),
                loads=loads, plate_options=options.PlateOptions(**directions.model_dump(exclude_unset=True)),
                coordinates=options.MeshCoordinates(), cores=Cores(workers=workers),
                progress=lambda case, stage, share, edge=edge: tell(f"{edge:g} mm, {case}", stage, share),  # type: ignore[misc]
            )  # fmt: skip
            if not made.complete:
                reasons = " ".join(made.summary()[:-1])
                raise MrstrainError(
                    f"Not every load was reached on the mesh with an edge length of {edge:g} mm. {reasons}"
                )
            values.append(_followed(made.sets[0], region))
            simulated.append(target / f"simulated-{edge:g}" / made.sets[0].name)
        on_meshes = {key: tuple(of[key] for of in values) for key in values[0]}
        rows = tuple(Row(*key, of, extrapolate(sizes, np.array(of))) for key, of in on_meshes.items())
        done = Converged(target, tuple(sizes.tolist()), rows)
        _record_variant(done, simulated)
        _write(done, edges, provenance("converge", inputs, {"edges_mm": edges, "material": material}))
    return done


def _followed(simulation: Simulation, region: str) -> dict[tuple[str, str], float]:
    """Quantities compared between meshes, by load and name: plate displacement, and percentiles of the max. shear."""
    moved = {state.load.name: float(np.hypot(*state.plate_displacement_mm[:2])) for state in simulation.states}
    return {(load, "plate displacement, mm"): value for load, value in moved.items()} | {
        (row.load, f"{_SHEAR} of {region}, p{percent}"): value
        for row in simulation.regions
        if row.region == region
        for percent, value in ((50, row.shear_p50), (90, row.shear_p90), (99, row.shear_p99))
    }


def _expected(
    cells: Mapping[float, float], to_mesh: Sequence[float], one: MaterialSet, loads: Sequence[LoadStep]
) -> dict[str, Expected]:
    """Meshes and simulations, one after another, by their names; ``cells`` of the mesh of each edge length."""
    expected: dict[str, Expected] = {}
    before: tuple[str, ...] = ()
    for edge in to_mesh:
        expected[f"{edge:g} mm"] = replace(meshing(cells[edge]), before=before)
        before = (f"{edge:g} mm",)
    paths = {path_name(one, path): PathSize(one, len(path), 0) for path in paths_of(loads)}
    for edge, count in cells.items():
        solved = simulations({f"{edge:g} mm, {name}": path for name, path in paths.items()}, count, "P1")
        expected |= {name: replace(path, before=before) for name, path in solved.items()}
        before = tuple(solved)
    return expected


def _is_of(place: Path, inputs: dict[str, list[Path]], bones: Sequence[str]) -> bool:
    """Whether a mesh exists and was made from the current content of these files, with the same bones cut out."""
    if not place.is_file():
        return False
    hashes = {role: [file_hash(path) for path in paths] for role, paths in inputs.items()}
    try:
        record = read_json(place.with_suffix(".json"))
        known = {role: [f["sha256"] for f in files] for role, files in record["inputs"].items()}
        return bool(known == hashes and record["parameters"]["bones"] == list(bones))
    except (OSError, ValueError, KeyError, TypeError, AttributeError):  # not what `mesh` writes
        return False


def _record_variant(done: Converged, simulated: Sequence[Path]) -> None:
    """Record the solution on the second finest mesh as a variant of that on the finest, by the order of the strain.

    Meshes with cells of nearly the size of the finest are passed over; an earlier run's variants are removed.
    """
    finest, *coarser = np.argsort(done.sizes_mm)
    ratios = {place: done.sizes_mm[place] / done.sizes_mm[finest] for place in coarser}
    second = next(place for place, ratio in ratios.items() if ratio >= fe.LEAST_RATIO)
    coarse, fine = simulated[second], simulated[finest]
    for folder in done.out.glob("simulated-*"):
        (folder / fine.name / VARIANT).unlink(missing_ok=True)
    orders = [row.limit.order for row in done.rows if row.quantity.startswith(_SHEAR) and np.isfinite(row.limit.order)]
    of_order = (float(np.median(orders)), fe.SAFETY) if orders else (fe.ASSUMED_ORDER, fe.SAFETY_WITHOUT_ORDER)
    steps = fe.mesh_steps(ratios[second], *of_order)
    write_whole(coarse / VARIANT, VariantRecord.of_folders(fine.name, MESH, steps, fine, coarse).text)


def _write(done: Converged, edges: Sequence[float], record: dict[str, object]) -> None:
    out, rows, table = done.out, [], []
    for row in done.rows:
        limit = {of: value if np.isfinite(value) else None for of, value in asdict(row.limit).items()}
        rows.append(asdict(row) | {"limit": limit})
        table.append([row.load, row.quantity, *row.values, *limit.values()])
    head = ["load", "quantity", *(f"edge_{e:g}_mm" for e in edges), "limit", "order", "scatter", "error_of_finest"]
    sizes = ["all", "size of the cells, mm", *done.sizes_mm, *([None] * len(fields(Limit)))]
    write_csv(out / "convergence.csv", head, [*table, sizes])
    curves = {(r.load, r.quantity): (r.values, r.limit) for r in done.rows if np.isfinite(r.limit.limit)}
    for earlier in figure_files(out / "convergence"):
        earlier.unlink(missing_ok=True)
    if curves:
        save_figure(out / "convergence", figures.convergence(done.sizes_mm, curves))
    write_json(out / "convergence.json", {"sizes_mm": list(done.sizes_mm), "rows": rows} | record)
