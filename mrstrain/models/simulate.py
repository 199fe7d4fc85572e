"""`simulate`: a mesh under the loads of a plate, for one or more material sets."""

import logging
import re
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

import fe
from dvc.atomic_files import write_whole
from dvc.errors import InputError, MrstrainError, OutputError, WorkerError, few
from dvc.file_names import clash
from dvc.own_files import read_json
from dvc.threads import usable_cores
from dvc.worker import Worker, each_in_workers
from fe.simulation_files import ENDING, fingerprint, read_checkpoint, write_checkpoint
from mrstrain.options.door import door
from mrstrain.options.measurement import Cores, in_parallel
from mrstrain.options.model import Vector
from mrstrain.options.modelling import MeshCoordinates, PlateOptions, SimulationOptions
from mrstrain.records.durations import PASSED, SIMULATING, PathSize, figures_of, simulations
from mrstrain.records.inputs import alone, make_output, refuse_touching_inputs
from mrstrain.records.outcome import with_reasons
from mrstrain.records.progress import NOTE, OnProgress, expect
from mrstrain.records.provenance import provenance
from mrstrain.records.time_left import STARTING, WRITING

LOADS = (
    fe.LoadStep("Load1", 140.0), fe.LoadStep("Load2", 15.0),
    fe.LoadStep("Load3", 15.0, 45.0), fe.LoadStep("Load4", 15.0, 12.0),
)  # fmt: skip
"""Loads of the published experiment."""
_log = logging.getLogger(__name__)
_EVERY_S = 30.0  # smallest time between two checkpoints within a load


@dataclass(frozen=True, slots=True, eq=False)
class Simulations:
    """Result of `simulate`: a simulation for each material set, and why others failed."""

    out: Path
    sets: tuple[fe.Simulation, ...]
    failures: Mapping[str, str]

    @property
    def complete(self) -> bool:
        """Whether every load was reached with every set, and every material is stable at the strain reached."""
        return not self.failures and all(one.complete for one in self.sets)

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        lines = [line for one in self.sets for line in str(one).splitlines()]
        lines += [f"{name}: FAILED. {reason}" for name, reason in self.failures.items()]
        return [*lines, f"Results: {self.out}"]


@door
def simulate(
    mesh: Path | str, *, out: Path | str, simulation: SimulationOptions, loads: Sequence[fe.LoadStep] = LOADS,
    plate_options: PlateOptions, towards: Mapping[str, tuple[Vector, Vector]] | None = None,
    coordinates: MeshCoordinates, cores: Cores, progress: OnProgress | None = None,
) -> Simulations:  # fmt: skip
    """Simulate a plate that presses and shears soft tissue on fixed bone.

    Parameters
    ----------
    mesh : path
        Written by `mesh` or another program, with the surface sets "skin", "bone", and further fixed ones.
    out : path
        Gets a folder for each set: a VTU file for each load, ``curve.csv`` (force and plate displacement),
        ``regions.csv``, ``simulation.json`` and figures.
    loads : sequence of LoadStep
        Loads with the same normal force are simulated as one load path, in the order of their shear; by default those
        of the published experiment. The first load of a path passes smaller loads without shear.
    towards : mapping, optional
        ``plate_normal`` and ``shear_direction``, by name, of loads that have their own directions.
    simulation, plate_options, coordinates, cores
        Their fields are given as keywords, such as ``sets=...``. See `fe.elements`, `fe.Plate` and `fe.decks`.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError
        If the mesh, a material set or a load cannot be used; before anything is computed.
    MrstrainError
        If every simulation failed; `WorkerError` if their processes died.
    """
    place, target, tell = Path(mesh), Path(out), progress or (lambda *_: None)
    sets, limit_s, decks = simulation.sets, simulation.limit_s, simulation.decks
    read = fe.read_tet_mesh(place, unit=coordinates.mesh_unit, frame=coordinates.mesh_frame)
    chosen = material_sets(sets)
    towards = dict(towards or {})
    if strangers := towards.keys() - {load.name for load in loads}:
        known = few(load.name for load in loads)
        raise InputError(f"Directions are given for {few(sorted(strangers))}, which is no load; the loads are {known}.")
    usual = (plate_options.plate_normal, plate_options.shear_direction)
    contact = plate_options.model_dump(exclude={"plate_normal", "shear_direction"})
    plates = {load.name: fe.Plate(*towards.get(load.name, usual), **contact) for load in loads}
    held = fe.fixed_facets(read, simulation.fixed)
    jobs = [
        (one, problem)
        for one in chosen
        for problem in fe.problems_of(read, one.for_regions(read.regions)[0], plates, loads, held, simulation.element)
    ]
    notes = [note for one in chosen for note in one.for_regions(read.regions)[1]]
    if assumed := plate_options.assumed("give plate_normal (--plate-normal)") * (len(towards) < len(loads)):
        tell(NOTE, assumed, 0.0)
    for note in dict.fromkeys([*notes, *(note for _, problem in jobs for note in problem.notes)]):
        tell(NOTE, note, 0.0)
    refuse_touching_inputs(target, [one.name for one in chosen], [place])
    make_output(target)
    beside = [names] if (names := place.with_suffix(".json")).is_file() else []
    files = {"mesh": [place, *beside], "sets": [Path(s) for s in sets if s.endswith(".toml")]}
    given = coordinates.plain() | contact | {"fixed": list(held), "limit_s": limit_s, "mesh_made": _mesh_made(place)}
    at_once = max(1, min(in_parallel(cores.workers), len(jobs)))
    each = cores.threads or max(1, usable_cores() // at_once)
    options = fe.SolverOptions(each, np.inf if limit_s is None else limit_s)
    sizes = {path_name(one, path.loads): PathSize(one, len(path.loads), len(path.passed)) for one, path in jobs}
    expect(progress, simulations(sizes, len(read.cells), simulation.element, limit_s), at_once)
    run = _Run(target, loads, jobs, lambda one: provenance("simulate", files, given | one.parameters()), decks, tell)
    with ExitStack() as held_folders:
        for folder in (target / one.name for one in chosen):
            make_output(folder)
            held_folders.enter_context(alone(folder))
            _remove_earlier(folder, plates)
        # What others pass comes first; on one core, one set after the other.
        in_order = sorted(jobs, key=lambda job: (at_once == 1 and chosen.index(job[0]), len(job[1].passed)))
        each_in_workers(in_order, lambda job, worker: run.path(*job, options, worker), at_once=at_once, threads=each)
    if not run.done:
        kind = WorkerError if run.died == run.failures.keys() else MrstrainError
        raise kind(with_reasons("Every simulation failed.", [f"{n}: {r}" for n, r in run.failures.items()]))
    return Simulations(target, tuple(run.done[one.name] for one in chosen if one.name in run.done), run.failures)


def path_name(one: fe.MaterialSet, loads: Sequence[fe.LoadStep]) -> str:
    """The name of a load path with a material set."""
    return f"{one.name}, {' '.join(step.name for step in loads)}"


def _share(problem: fe.Problem, loads_done: float) -> float:
    """How much of the time of a path has passed where a fraction of all its loads is done, passed ones included."""
    own, passed = len(problem.loads), len(problem.passed)
    done = loads_done * (own + passed)
    return (PASSED * min(done, passed) + max(done - passed, 0.0)) / (own + PASSED * passed)


def _remove_earlier(folder: Path, loads: Collection[str]) -> None:
    """Remove the results of an earlier simulation; checkpoints of the current loads are kept."""
    fe.begin_simulation(folder)
    for left in folder.glob(f"*{ENDING}"):
        if left.name.removesuffix(ENDING) not in loads:
            left.unlink()


def load_named(text: str) -> fe.LoadStep:
    """A load from NAME=NORMAL or NAME=NORMAL,SHEAR: forces in N or, followed by mm, plate displacements."""
    name, _, asked = text.partition("=")
    found = [re.fullmatch(r"\s*([^\s]+?)\s*(mm|N)?\s*", part) for part in asked.split(",")]
    try:
        values = {
            f"{axis}_{'mm' if match[2] == 'mm' else 'n'}": float(match[1])
            for axis, match in zip(("normal", "shear"), found, strict=False)
            if match
        }
        if len(values) < len(found) or not np.isfinite(list(values.values())).all():
            raise ValueError("not finite numbers")
    except ValueError as failure:
        raise InputError(
            "A load is written NAME=NORMAL or NAME=NORMAL,SHEAR, with forces in N, such as Load3=15,45, or plate "
            f"displacements in mm, such as Load3=15,8mm; got '{text}'."
        ) from failure
    if not name.strip() or not re.fullmatch(r"[\w. -]+", name.strip()):
        raise InputError(f"The name of a load may have letters, digits, dots, spaces and dashes; got '{name}'.")
    return fe.LoadStep(name.strip(), **values)


def loads_named(texts: Sequence[str] | None) -> Sequence[fe.LoadStep]:
    """Loads from their texts, each as in `load_named`; those of the published experiment if there is none."""
    return [load_named(text) for text in texts] if texts else LOADS


def material_sets(names: Sequence[str]) -> list[fe.MaterialSet]:
    """Material sets by published name or file; at least one is needed, each only once."""
    chosen = [fe.material_set(name) for name in names]
    if not chosen:
        raise InputError("At least one material set is needed, such as trebbi.")
    if twice := clash(one.name for one in chosen):
        raise InputError(f"Two material sets are named {twice}; give each only once, or rename one.")
    return chosen


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """Solves load paths in workers, and writes the tables of a set as soon as its last path is solved."""

    target: Path
    loads: Sequence[fe.LoadStep]
    jobs: Sequence[tuple[fe.MaterialSet, fe.Problem]]
    record: Callable[[fe.Simulation], dict[str, object]]
    decks: bool
    progress: OnProgress
    done: dict[str, fe.Simulation] = field(default_factory=dict)
    failures: dict[str, str] = field(default_factory=dict)
    died: set[str] = field(default_factory=set)  # those of them whose process died
    crashed: set[int] = field(default_factory=set)  # problems whose solution failed, by their id
    ended: dict[int, list[fe.LoadState]] = field(default_factory=dict)
    writing: threading.Lock = field(default_factory=threading.Lock)

    def path(self, chosen: fe.MaterialSet, problem: fe.Problem, options: fe.SolverOptions, worker: Worker) -> None:
        """Solve one path."""
        case = path_name(chosen, problem.loads)
        with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
            share, place, what = Path(folder) / "share", self.target / chosen.name, f"simulating {case}"

            def watch() -> None:
                if share.exists():
                    self.progress(case, SIMULATING, _share(problem, float(share.read_text() or 0.0)))

            states: list[fe.LoadState] = []
            try:
                if not self._passed_in_vain(chosen, problem):
                    self.progress(case, STARTING, 0.0)
                    states = worker.run(what, solve_in_folder, problem, options, place, share, watch=watch)
            except MrstrainError as failure:
                self.failures[case] = str(failure)
                _log.info("%s failed", case, exc_info=failure)
                self.crashed.add(id(problem))
                self.died.update({case} if isinstance(failure, WorkerError) else ())
        with self.writing:
            self.ended[id(problem)] = states
            problems = [one for other, one in self.jobs if other is chosen]
            self.progress(case, SIMULATING, 1.0)
            if all(id(one) in self.ended for one in problems):
                self.progress(figures_of(chosen.name), WRITING, 0.0)
                self._write(chosen, problems)
                self.progress(figures_of(chosen.name), WRITING, 1.0)

    def _passed_in_vain(self, chosen: fe.MaterialSet, problem: fe.Problem) -> bool:
        """Whether another path has ended without equilibrium under a load that this one passes."""
        whole = self.ended.keys() - self.crashed
        others = [(one, self.ended[id(one)]) for of, one in self.jobs if of is chosen and id(one) in whole]
        lost = {load for one, _ in others for load in one.loads} - {
            state.load for _, states in others for state in states if state.reached == 1.0
        }
        return bool(lost & set(problem.passed))

    def _write(self, chosen: fe.MaterialSet, problems: Sequence[fe.Problem]) -> None:
        states = [state for one in problems for state in self.ended[id(one)]]
        if not states:
            return
        made, folder = fe.Simulation.of(chosen, problems, states, self.loads), self.target / chosen.name
        try:
            if self.decks:
                made.write_decks(folder)
        except InputError as refused:
            made = replace(made, remarks=(*made.remarks, f"No decks were written. {refused}"))
        made.write(folder, record=self.record(made), fields=False)
        self.done[chosen.name] = made


def _mesh_made(place: Path) -> dict[str, object] | None:
    """How `mesh` made a mesh, from the record next to it; None for meshes of other programs."""
    try:
        record = read_json(place.with_suffix(".json"))
        made = {"edge_mm": record["parameters"]["edge_mm"], "pytetwild": record["versions"]["pytetwild"]}
        return made if record["command"] == "mesh" else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def solve_in_folder(problem: fe.Problem, options: fe.SolverOptions, folder: Path, share: Path) -> list[fe.LoadState]:
    """Solve one load path in a worker; an earlier run in the folder is resumed if it has the same inputs.

    The files of a load are written as soon as it is reached. The fraction done is written to the file ``share``.
    """
    files = _Files(problem, folder, share)
    return fe.solve(problem, options, files, files.earlier())


class _Files(fe.Observer):
    """Writes the files of a load path: results and checkpoint of each load when it is reached, and a log."""

    def __init__(self, problem: fe.Problem, folder: Path, share: Path) -> None:
        self._problem, self._folder, self._share = problem, folder, share
        self._log = folder / f"log-{problem.loads[0].name}.txt"
        self._made_from = {load.name: fingerprint(problem, load) for load in (*problem.passed, *problem.loads)}
        self._last = time.monotonic()
        write_whole(self._log, "")

    def earlier(self) -> dict[str, fe.Checkpoint]:
        """Checkpoints of the first loads, the last of which may be incomplete, and of complete ones that are passed."""
        kept: dict[str, fe.Checkpoint] = {}
        for load in self._problem.loads:
            checkpoint = self._read(load)
            if checkpoint is None:
                break
            kept[load.name] = checkpoint
            if checkpoint.reached < 1.0:
                break
        if not kept:  # another path may be solving an incomplete one now
            read = {load.name: self._read(load) for load in self._problem.passed}
            kept = {name: at for name, at in read.items() if at is not None and at.reached == 1.0}
        for name, checkpoint in kept.items():
            self.log(f"{name}: resumed from the checkpoint at {100 * checkpoint.reached:.0f} % of the load")
        return kept

    def _read(self, load: fe.LoadStep) -> fe.Checkpoint | None:
        return read_checkpoint(self._checkpoint_of(load), self._made_from[load.name])

    def log(self, line: str) -> None:
        try:
            # closed each time, so that it can be read meanwhile and after a kill
            with self._log.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"{self._log} cannot be written ({reason}). Check the free disk space.") from error

    def progress(self, done: float) -> None:
        write_whole(self._share, f"{done:.4f}")

    def converged(self, load: fe.LoadStep, checkpoint: fe.Checkpoint) -> None:
        if time.monotonic() - self._last > _EVERY_S:
            write_checkpoint(self._checkpoint_of(load), checkpoint, self._made_from[load.name])
            self._last = time.monotonic()

    def ended(self, state: fe.LoadState) -> None:
        if state.checkpoint is not None and len(state.curve) > 1:
            write_checkpoint(self._checkpoint_of(state.load), state.checkpoint, self._made_from[state.load.name])
            fe.write_state(self._folder / f"{state.load.name}.vtu", self._problem.mesh, state, self._problem.materials)

    def _checkpoint_of(self, load: fe.LoadStep) -> Path:
        return self._folder / f"{load.name}{ENDING}"
