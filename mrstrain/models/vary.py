"""`vary`: further solutions of a material set with one input changed, for the input uncertainty of the model.

All are computed on a coarser mesh if there is one, and each is compared with the solution on that mesh, which also
gives the error of the discretisation. Solutions with another force, material or interface start from its states.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import fe
from dvc import Grid, LabelMap, TetMesh, read_labels, write_labels
from dvc.atomic_files import write_whole
from dvc.errors import MrstrainError
from dvc.worker import Worker
from fe import variation
from fe.simulation_files import ENDING, fingerprint, read_checkpoint
from mrstrain.models.mesh import Meshed, mesh as make_mesh
from mrstrain.models.simulate import material_sets, simulate
from mrstrain.models.variant_files import VARIANT, VariantRecord
from mrstrain.options import modelling as options
from mrstrain.options.measurement import Cores
from mrstrain.options.model import Vector
from mrstrain.records.outcome import Outcome

MESH = "mesh"
ORDER, SAFETY, COVERAGE = 1.0, 1.25, 2.0
"""Of the mesh: assumed order of the strain in linear cells, safety factor, and coverage factor of the expanded
uncertainty SAFETY |f_fine - f_coarse| / (r^ORDER - 1), with the ratio r of the cell sizes."""
_LEAST_RATIO = 1.1  # of cell sizes
_SKIN = "skin"


@dataclass(frozen=True, slots=True, eq=False)
class _Setting:
    """What all solutions of a set have in common."""

    name: str
    mesh: TetMesh
    plates: Mapping[str, fe.Plate]
    loads: Sequence[fe.LoadStep]
    fixed: Sequence[str]
    element: str
    materials: Mapping[str, fe.Material]

    def problems(self) -> list[fe.Problem]:
        return fe.problems_of(self.mesh, self.materials, self.plates, self.loads, self.fixed, self.element)


def mesh_coarser(labels: Path, *, out: Path, ratio: float, labelling: options.Labelling, meshing: options.Meshing,
                 watch: Callable[[float], None]) -> Meshed:  # fmt: skip
    """Mesh a label map with edges that are longer by a ratio, and with voxels as much larger, if no tissue is lost.

    In thin tissues the voxels and not the edge length limit the size of the cells.
    """
    longer = meshing.model_copy(update={"edge_mm": ratio * meshing.edge_mm})
    if longer.finer is not None:
        longer = longer.model_copy(update={"finer": longer.finer._replace(edge_mm=ratio * longer.finer.edge_mm)})
    given = read_labels(labels, labelling.names)
    out.parent.mkdir(parents=True, exist_ok=True)
    place = out.with_name("labels.nii.gz")
    write_labels(place, _coarser(given, ratio))
    renamed = labelling.model_copy(update={"names": place.with_name("labels.csv")})
    try:
        return make_mesh.with_options(place, out=out, labelling=renamed, meshing=longer, watch=watch)
    except MrstrainError:  # a tissue is too thin for these voxels
        return make_mesh.with_options(labels, out=out, labelling=labelling, meshing=longer, watch=watch)


def _coarser(labels: LabelMap, ratio: float) -> LabelMap:
    """A label map with larger voxels, each with the label at its centre."""
    grid = labels.grid
    shape = tuple(int(n) for n in np.maximum(np.floor(np.array(grid.shape) / ratio), 1))
    wide = Grid(shape, ratio * grid.spacing_mm, grid.points_at(np.full(3, 0.5 * (ratio - 1.0))), grid.direction)
    at = np.rint(grid.indices_of(wide.points().reshape(-1, 3))).astype(np.int64)
    at = np.clip(at, 0, np.array(grid.shape) - 1)
    return LabelMap(wide, labels.labels[tuple(at.T)].reshape(shape), labels.names)


def vary(
    mesh: Path, *, out: Path, simulation: options.SimulationOptions, loads: Sequence[fe.LoadStep],
    plate_options: options.PlateOptions, towards: Mapping[str, tuple[Vector, Vector]],
    coordinates: options.MeshCoordinates, uncertainty: options.Uncertainty, base: Path, coarse: Path | None = None,
    voxel_mm: float = 0.0, tell: Callable[[str, float], None] = lambda _stage, _share: None,
) -> Outcome:  # fmt: skip
    """Solve a material set with each input changed by one standard uncertainty.

    Parameters
    ----------
    mesh, simulation, loads, plate_options, towards, coordinates
        As in `simulate`, with one set.
    out : path
        Gets a folder for each input with a VTU file for each load and ``variant.toml``.
    uncertainty : Uncertainty
        Standard uncertainty of each input.
    base : path
        Folder of the set's simulation on ``mesh``.
    coarse : path, optional
        Coarser mesh, in the coordinates of the image, on which everything is computed instead.
    voxel_mm : float
        Edge of a voxel of the label map.
    tell : callable
        Called with what is done and the fraction of all that is done.
    """
    (chosen,) = material_sets(simulation.sets)
    place, how = (mesh, coordinates) if coarse is None else (coarse, options.MeshCoordinates())
    read = fe.read_tet_mesh(place, unit=how.mesh_unit, frame=how.mesh_frame)
    contact = plate_options.model_dump(exclude={"plate_normal", "shear_direction"})
    usual = (plate_options.plate_normal, plate_options.shear_direction)
    plates = {load.name: fe.Plate(*towards.get(load.name, usual), **contact) for load in loads}
    setting = _Setting(chosen.name, read, plates, loads, fe.fixed_facets(read, simulation.fixed), simulation.element,
                       chosen.for_regions(read.regions)[0])  # fmt: skip
    lines, complete = list[str](), True
    changed, tilts = _changes(setting, uncertainty, voxel_mm, lines), _tilts(setting, uncertainty)
    whole, cheap = [*([MESH] if coarse is not None else []), *tilts], 0.2  # of the time of a whole solution
    work, done = len(whole) + cheap * len(changed), 0.0
    simulated = simulation.model_copy(update={"decks": False})
    for name in whole:
        directions = {load: (p.normal, p.shear) for load, p in plates.items()} if name == MESH else tilts[name]
        try:
            made = simulate.with_options(
                place, out=out / name, simulation=simulated, loads=loads, plate_options=plate_options, coordinates=how,
                towards={load: (tuple(n), tuple(s)) for load, (n, s) in directions.items()},
                cores=Cores(workers=1, threads=1),
                progress=lambda case, stage, share, done=done: tell(stage, (done + share / 2.0) / work),  # type: ignore[misc]
            )  # fmt: skip
            complete = complete and made.complete
        except MrstrainError as failure:
            complete = False
            lines.append(f"{name}: FAILED. {failure}")
        done += 1.0
    if coarse is not None:
        base = out / MESH / chosen.name
        lines += _mesh_record(base, chosen.name, fe.read_tet_mesh(mesh, unit=coordinates.mesh_unit), read)
    of_base = None if coarse is None else base
    for name in tilts:
        _record(
            out / name / chosen.name,
            VariantRecord.of_folders(chosen.name, name, 1.0, of_base, out / name / chosen.name),
        )
    states = _states(setting, base)
    with Worker(threads=1) as worker:
        for name, (problems, steps) in changed.items():
            folder = out / name / chosen.name
            record = VariantRecord.of_folders(chosen.name, name, steps, of_base, folder)
            made_from = [fingerprint(one, len(one.loads)) for one in problems]
            if not _is_made(folder, made_from, states):
                (folder / VARIANT).unlink(missing_ok=True)
                try:
                    worker.run(f"varying {name}", solve_from_base, problems, states, folder)
                    write_whole(folder / _MADE_FROM, "\n".join(made_from))
                except MrstrainError as failure:
                    complete = False
                    lines.append(f"{name}: FAILED. {failure}")
                    continue
            _record(folder, record)
            done += cheap
            tell("varying", done / work)
    names = [*whole, *changed]
    lines.insert(0, f"{chosen.name} with one input changed: {', '.join(names) or 'none'} ({len(states)} loads)")
    return Outcome(out, tuple(lines), complete and len(states) == len(loads))


_MADE_FROM = "made-from.txt"


def _changes(
    setting: _Setting, spread: options.Uncertainty, voxel_mm: float, lines: list[str]
) -> dict[str, tuple[list[fe.Problem], float]]:
    """Changed problems by input, that can start from the states of the unchanged ones, and the steps of each."""
    made: dict[str, tuple[_Setting, float]] = {}
    stronger = [variation.with_force(load, spread.force, spread.force_n) for load in setting.loads]
    if stronger != list(setting.loads):
        made["force"] = replace(setting, loads=stronger), 1.0
    if spread.poisson:
        laws = variation.with_compressibility(setting.materials, spread.poisson)
        made["poisson"] = replace(setting, materials=laws), 1.0
    for region, relative in spread.stiffness.items():
        if relative:
            laws = variation.with_stiffness(setting.materials, region, relative)
            made[f"stiffness-{region}"] = replace(setting, materials=laws), 1.0
    if (thicker_mm := spread.labels_voxels * voxel_mm) > 0.0:
        moving = {"labels-bone": variation.with_bone}
        if any(region.casefold() == _SKIN for region in setting.mesh.regions):
            moving["labels-skin"] = variation.with_skin
        for name, move in moving.items():
            try:
                moved, share = move(setting.mesh, thicker_mm)
                made[name] = replace(setting, mesh=moved), share
            except MrstrainError as failure:
                lines.append(f"{name}: not given. {failure}")
    return {name: (of.problems(), steps) for name, (of, steps) in made.items()}


def _tilts(setting: _Setting, spread: options.Uncertainty) -> dict[str, dict[str, tuple[Vector, Vector]]]:
    """Outward normal and direction of shear of each load with a tilted plate, by input."""
    if not spread.direction_deg:
        return {}
    tilts: dict[str, dict[str, tuple[Vector, Vector]]] = {}
    for name, along in (("direction-along", True), ("direction-across", False)):
        axes = {load: variation.tilted(plate, spread.direction_deg, along=along).axes
                for load, plate in setting.plates.items()}  # fmt: skip
        tilts[name] = {load: (tuple((-of[:, 0]).tolist()), tuple(of[:, 1].tolist())) for load, of in axes.items()}
    return tilts


def _mesh_record(folder: Path, name: str, fine: TetMesh, coarse: TetMesh) -> list[str]:
    """Record the solution on the coarser mesh as a variant, unless the meshes are too much alike."""
    ratio = fe.cell_size_mm(coarse) / fe.cell_size_mm(fine)
    told = f"mesh: cells of {fe.cell_size_mm(fine):.2f} and {fe.cell_size_mm(coarse):.2f} mm, a ratio of {ratio:.2f}"
    if ratio < _LEAST_RATIO:
        (folder / VARIANT).unlink(missing_ok=True)
        return [f"{told}; below {_LEAST_RATIO:g} no error of the mesh can be estimated."]
    steps = COVERAGE * (ratio**ORDER - 1.0) / SAFETY
    _record(folder, VariantRecord.of_folders(name, MESH, steps, None, folder))
    return [f"{told}; one standard uncertainty is {1.0 / steps:.1f} times the difference of the two solutions."]


def _record(folder: Path, record: VariantRecord) -> None:
    if folder.is_dir():
        write_whole(folder / VARIANT, record.text)


def _states(setting: _Setting, folder: Path) -> dict[str, fe.Checkpoint]:
    """States of the unchanged problem, of the loads that it reached."""
    states = {}
    for problem in setting.problems():
        for number, load in enumerate(problem.loads, start=1):
            state = read_checkpoint(folder / f"{load.name}{ENDING}", fingerprint(problem, number))
            if state is not None and state.reached == 1.0:
                states[load.name] = state
    return states


def solve_from_base(problems: Sequence[fe.Problem], states: Mapping[str, fe.Checkpoint], folder: Path) -> None:
    """Solve changed problems in a worker, and write a VTU file for each load that is reached."""
    folder.mkdir(parents=True, exist_ok=True)
    for problem in problems:
        for state in variation.from_base(problem, states, fe.SolverOptions(1)):
            place = folder / f"{state.load.name}.vtu"
            place.unlink(missing_ok=True)
            if state.reached == 1.0:
                fe.write_state(place, problem.mesh, state, problem.materials)


def _is_made(folder: Path, made_from: Sequence[str], states: Mapping[str, fe.Checkpoint]) -> bool:
    """Whether an earlier run solved the same problems for all loads."""
    try:
        same = (folder / _MADE_FROM).read_text(encoding="utf-8") == "\n".join(made_from)
    except OSError:
        return False
    return same and all((folder / f"{load}.vtu").is_file() for load in states)
