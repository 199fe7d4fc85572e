"""`vary`: variants of a material set, each with one input changed, for the input uncertainty of the model.

All are solved on a coarser mesh if there is one, and compared with the solution on that mesh, which also gives the
discretisation error. Variants with another force, material or interface start from its converged states.
"""

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

import fe
from dvc import TetMesh
from dvc.atomic_files import write_whole
from dvc.errors import MrstrainError
from dvc.worker import Worker
from fe import variation
from fe.simulation_files import ENDING, fingerprint, read_checkpoint
from mrstrain.models.simulate import material_sets, simulate
from mrstrain.models.variant_files import MESH, VARIANT, VariantRecord
from mrstrain.options import modelling as options
from mrstrain.options.measurement import Cores
from mrstrain.options.model import Vector
from mrstrain.options.uncertainty import Uncertainty
from mrstrain.records.outcome import Outcome
from validate.sensitivity import LABELS, TAPE

_SHORT = 0.2  # of the time of a whole solution: one that starts from the state of another


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


@dataclass(frozen=True, slots=True)
class _Whole:
    """A variant that is simulated from the start, because no state of another solution is near."""

    towards: Mapping[str, tuple[Vector, Vector]]  # outward normal and direction of shear by load
    loads: Sequence[fe.LoadStep]
    taped: bool
    steps: float = 1.0


def vary(
    mesh: Path, *, out: Path, simulation: options.SimulationOptions, loads: Sequence[fe.LoadStep],
    plate_options: options.PlateOptions, towards: Mapping[str, tuple[Vector, Vector]],
    coordinates: options.MeshCoordinates, uncertainty: Uncertainty, base: Path, coarse: Path | None = None,
    voxel_mm: float = 0.0, boundaries_mm: Mapping[str, float] | None = None,
    tell: Callable[[str, float], None] = lambda _stage, _share: None,
) -> Outcome:  # fmt: skip
    """Solve a material set with each input changed by one standard uncertainty.

    Parameters
    ----------
    mesh, simulation, loads, plate_options, towards, coordinates
        As in `simulate`, with one set.
    out : path
        Gets a folder for each input, with a folder of the set that has a VTU file for each load and ``variant.toml``.
    uncertainty : Uncertainty
        Standard uncertainty of each input.
    base : path
        Folder of the set's simulation on ``mesh``.
    coarse : path, optional
        Coarser mesh, in the coordinates of the image, on which everything is computed instead.
    voxel_mm : float
        Edge of a voxel of the label map, or the cube root of its volume.
    boundaries_mm : mapping of tissue to float, optional
        Standard uncertainty of the position of each soft tissue's boundary with others, mm, at least that of
        ``uncertainty``; by default only the skin's boundary is uncertain.
    tell : callable
        Called with the current step and the fraction of the whole that is done.
    """
    (chosen,) = material_sets(simulation.sets)
    place, how = (mesh, coordinates) if coarse is None else (coarse, options.MeshCoordinates())
    read = fe.read_tet_mesh(place, unit=how.mesh_unit, frame=how.mesh_frame)
    contact = plate_options.model_dump(exclude={"plate_normal", "shear_direction"})
    usual = (plate_options.plate_normal, plate_options.shear_direction)
    plates = {load.name: fe.Plate(*towards.get(load.name, usual), **contact) for load in loads}
    setting = _Setting(
        chosen.name, read, plates, loads, fe.fixed_facets(read, simulation.fixed), simulation.element,
        chosen.for_regions(read.regions)[0],
    )  # fmt: skip
    changed, lines = _changes(setting, uncertainty, voxel_mm, boundaries_mm)
    whole = _wholes(setting, uncertainty, plate_options.taped, lines)
    if coarse is not None:
        whole = {MESH: _Whole(towards, loads, plate_options.taped)} | whole
    _remove_others(out, [*whole, *changed])
    solving = simulation.model_copy(update={"decks": False})
    complete, work = True, len(whole) + _SHORT * len(changed)
    for number, (name, one) in enumerate(whole.items()):
        began: dict[str, float] = {}

        def watch(case: str, stage: str, share: float, number: int = number, began: dict[str, float] = began) -> None:
            began[case] = share
            tell(stage, (number + min(sum(began.values()) / max(len(loads), 1), 1.0)) / work)

        try:
            made = simulate.with_options(
                place, out=out / name, simulation=solving, loads=one.loads, coordinates=how, towards=one.towards,
                plate_options=plate_options.model_copy(update={"taped": one.taped}),
                cores=Cores(workers=1, threads=1), progress=watch,
            )  # fmt: skip
            complete = complete and made.complete
        except MrstrainError as failure:
            complete = False
            lines.append(f"{name}: FAILED. {failure}")
    of_base = None
    if coarse is not None:
        of_base = base = out / MESH / chosen.name
        fine = fe.read_tet_mesh(mesh, unit=coordinates.mesh_unit, frame=coordinates.mesh_frame)
        lines.append(_record_mesh(base, chosen.name, fine, read))
    for name, one in whole.items():
        if name != MESH:
            _record(out / name / chosen.name, chosen.name, name, one.steps, of_base)
    states = _states(setting, base)
    failed = _solve_short(changed, states, out, of_base, chosen.name,
                          lambda done: tell("varying", (len(whole) + _SHORT * done) / work))  # fmt: skip
    lines = [
        f"{chosen.name} with one input changed: {', '.join([*whole, *changed]) or 'none'} ({len(states)} loads)",
        *lines, *failed,
    ]  # fmt: skip
    return Outcome(out, tuple(lines), complete and not failed and len(states) == len(loads))


def _remove_others(out: Path, names: Sequence[str]) -> None:
    """Remove variants of inputs that are now exact, which would otherwise be compared."""
    for place in out.iterdir() if out.is_dir() else ():
        if place.is_dir() and place.name not in names:
            shutil.rmtree(place)


def _solve_short(
    changed: Mapping[str, tuple[list[fe.Problem], float]], states: Mapping[str, fe.Checkpoint], out: Path,
    base: Path | None, chosen: str, ended: Callable[[int], None],
) -> list[str]:  # fmt: skip
    """Solve changed problems that start from known states, unless they are solved; a sentence for each that failed."""
    failed = []
    with Worker(threads=1) as worker:
        for number, (name, (problems, steps)) in enumerate(changed.items(), start=1):
            folder, made_from = out / name / chosen, [fingerprint(one, one.loads[-1]) for one in problems]
            if not _is_made(folder, made_from, states):
                (folder / VARIANT).unlink(missing_ok=True)
                try:
                    worker.run(f"varying {name}", solve_from_base, problems, states, folder)
                except MrstrainError as failure:
                    failed.append(f"{name}: FAILED. {failure}")
                    continue
                write_whole(folder / _MADE_FROM, "\n".join(made_from))
            _record(folder, chosen, name, steps, base)
            ended(number)
    return failed


_MADE_FROM = "made-from.txt"


def _changes(
    setting: _Setting, spread: Uncertainty, voxel_mm: float, boundaries_mm: Mapping[str, float] | None
) -> tuple[dict[str, tuple[list[fe.Problem], float]], list[str]]:
    """Changed problems by input, that start from the states of the unchanged ones, with the steps of each.

    Also a sentence for each that cannot be made.
    """
    lines = list[str]()
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
    least_mm = spread.labels_voxels * voxel_mm
    for name, move in _boundaries(setting.mesh, boundaries_mm, least_mm).items() if least_mm else ():
        try:
            moved, share = move(setting.mesh)
            made[LABELS + name] = replace(setting, mesh=moved), share
        except MrstrainError as failure:
            lines.append(f"{LABELS}{name}: not given. {failure}")
    return {name: (of.problems(), steps) for name, (of, steps) in made.items()}, lines


def _boundaries(
    mesh: TetMesh, boundaries_mm: Mapping[str, float] | None, least_mm: float
) -> Mapping[str, Callable[[TetMesh], tuple[TetMesh, float]]]:
    """What moves each uncertain boundary by its standard uncertainty: of the bone, and of all tissues but the largest.

    The largest tissue meets the others, so its boundary is theirs.
    """
    own_mm = {tissue.casefold(): mm for tissue, mm in (boundaries_mm or {fe.SKIN: least_mm}).items()}
    moving = {fe.BONE: partial(variation.with_bone, thickness_mm=least_mm)}
    largest = max(mesh.regions, key=lambda name: float(np.abs(mesh.volumes_mm3[mesh.regions[name]]).sum()))
    for name in mesh.regions:
        if name.casefold() in own_mm and (name != largest or boundaries_mm is None):
            by_mm = max(least_mm, own_mm[name.casefold()])
            moving[name.casefold()] = partial(variation.with_tissue, tissue=name, thickness_mm=by_mm)
    return moving


def _wholes(setting: _Setting, spread: Uncertainty, taped: bool, lines: list[str]) -> dict[str, _Whole]:
    """Variants with a tilted plate or without tape; adds a sentence to ``lines`` if there can be none."""
    made: dict[str, _Whole] = {}
    for name, along in (("direction-along", True), ("direction-across", False)) if spread.direction_deg else ():
        turned = {
            load: _towards(variation.tilted(plate, spread.direction_deg, along=along))
            for load, plate in setting.plates.items()
        }
        made[name] = _Whole(turned, setting.loads, taped)
    if spread.tape:
        pressed = [load for load in setting.loads if not load.sheared]
        if not taped or any(plate.turns for plate in setting.plates.values()) or not pressed:
            lines.append(
                "tape: not given. It needs a load without shear, and a plate with tape that does not rotate (taped = "
                "true, turns = false)."
            )
        else:
            towards = {load.name: _towards(setting.plates[load.name]) for load in pressed}
            made[TAPE] = _Whole(towards, pressed, False, 1.0 / spread.tape)
    return made


def _towards(plate: fe.Plate) -> tuple[Vector, Vector]:
    """Outward normal and direction of shear of a plate."""
    force, shear, _ = plate.axes.T.tolist()
    return (-force[0], -force[1], -force[2]), (shear[0], shear[1], shear[2])


def _record_mesh(folder: Path, name: str, fine: TetMesh, coarse: TetMesh) -> str:
    """Record the solution on the coarser mesh as a variant, unless the meshes are too similar; return a sentence."""
    ratio = fe.cell_size_mm(coarse) / fe.cell_size_mm(fine)
    told = f"mesh: cells of {fe.cell_size_mm(fine):.2f} and {fe.cell_size_mm(coarse):.2f} mm, a ratio of {ratio:.2f}"
    if ratio < fe.LEAST_RATIO:
        (folder / VARIANT).unlink(missing_ok=True)
        return f"{told}; below {fe.LEAST_RATIO:g} no error of the mesh can be estimated."
    steps = fe.mesh_steps(ratio)
    _record(folder, name, MESH, steps, None)
    return f"{told}; one standard uncertainty is {1.0 / steps:.1f} times the difference of the two solutions."


def _record(folder: Path, model: str, name: str, steps: float, base: Path | None) -> None:
    if folder.is_dir():
        write_whole(folder / VARIANT, VariantRecord.of_folders(model, name, steps, base, folder).text)


def _states(setting: _Setting, folder: Path) -> dict[str, fe.Checkpoint]:
    """States of the unchanged problem, of the loads that it reached."""
    states = {}
    for problem in setting.problems():
        for load in problem.loads:
            state = read_checkpoint(folder / f"{load.name}{ENDING}", fingerprint(problem, load))
            if state is not None and state.reached == 1.0:
                states[load.name] = state
    return states


def solve_from_base(problems: Sequence[fe.Problem], states: Mapping[str, fe.Checkpoint], folder: Path) -> None:
    """Solve changed problems in a worker, and write a VTU file for each load that is reached."""
    folder.mkdir(parents=True, exist_ok=True)
    for earlier in folder.glob("*.vtu"):
        earlier.unlink()
    for problem in problems:
        for state in variation.from_base(problem, states, fe.SolverOptions(1)):
            if state.reached == 1.0:
                fe.write_state(folder / f"{state.load.name}.vtu", problem.mesh, state, problem.materials)


def _is_made(folder: Path, made_from: Sequence[str], states: Mapping[str, fe.Checkpoint]) -> bool:
    """Whether an earlier run solved the same problems for all loads."""
    try:
        same = (folder / _MADE_FROM).read_text(encoding="utf-8") == "\n".join(made_from)
    except OSError:
        return False
    return same and all((folder / f"{load}.vtu").is_file() for load in states)
