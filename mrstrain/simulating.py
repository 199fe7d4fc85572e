"""`simulate`: a mesh under a plate's loads, for one or more sets of material laws."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from dvc.errors import InputError, MrstrainError
from dvc.mesh import TetMesh
from dvc.whole import whole_file, write_whole
from dvc.worker import Worker, each_in_workers, usable_cores
from fe import figures
from fe.decks import write_calculix, write_febio
from fe.materials import Material
from fe.meshstore import read_tet_mesh
from fe.plate import Plate
from fe.published import MaterialSet, material_set
from fe.result import (
    RegionFigures,
    patch_volumes,
    region_figures,
    write_curve_csv,
    write_regions_csv,
    write_state,
)
from fe.simulate import LoadStep, State
from fe.simulate import simulate as solve
from mrstrain.inputs import make_output, refuse_touching_inputs
from mrstrain.meshing import lowest_point
from mrstrain.provenance import provenance, write_json

Told = Callable[[str, str, float], None]

LOADS = (
    LoadStep("Load1", 140.0),
    LoadStep("Load2", 15.0),
    LoadStep("Load3", 15.0, 45.0),
    LoadStep("Load4", 15.0, 12.0),
)
"""The published experiment's."""

_FAR = 0.05  # det F of a patch further from 1 than this is counted


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """One material set under all loads.

    Attributes
    ----------
    name : str
    states : tuple of State
        In the order of the loads; the last of a path that could not go on has ``reached`` below 1.
    figures : tuple of RegionFigures
    notes : tuple of str
        What was assumed.
    """

    name: str
    states: tuple[State, ...]
    figures: tuple[RegionFigures, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Simulations:
    """What `simulate` gave."""

    out: Path
    sets: tuple[Simulated, ...]
    failures: Mapping[str, str]

    @property
    def complete(self) -> bool:
        """Whether every set carried every load."""
        return not self.failures and all(s.reached == 1.0 for one in self.sets for s in one.states)

    def summary(self) -> list[str]:
        """A few lines for a person."""
        lines = []
        for one in self.sets:
            for state in one.states:
                fat = [f for f in one.figures if f.load == state.load.name]
                shear = "; ".join(f"{f.region} {f.shear_p50:.3f} / {f.shear_p90:.3f}" for f in fat)
                part = "" if state.reached == 1.0 else f" ONLY {state.reached:.0%} of the load was reached;"
                lines.append(
                    f"{one.name}, {state.load.name}:{part} plate {state.travel_mm[0]:.2f} mm in, "
                    f"{state.travel_mm[1]:.2f} mm along; maximal shear, median / 90th percentile: {shear}"
                )
            lines += [f"{one.name}: {note}" for note in one.notes]
        lines += [f"{name}: FAILED. {reason}" for name, reason in self.failures.items()]
        return [*lines, f"Results: {self.out}"]


def simulate(
    mesh: Path | str,
    *,
    out: Path | str,
    sets: Sequence[str] = ("trebbi",),
    loads: Sequence[LoadStep] = LOADS,
    plate_normal: Sequence[float] = (0.0, 0.0, -1.0),
    shear_direction: Sequence[float] = (0.0, -1.0, 0.0),
    taped: bool = True,
    mesh_unit: str = "mm",
    mesh_frame: str = "LPS",
    decks: bool = False,
    workers: int | None = None,
    progress: Told | None = None,
) -> Simulations:
    """Simulate a plate that presses and shears soft tissue on fixed bone.

    Parameters
    ----------
    mesh : path
        As `mesh` writes it, or made elsewhere; with facets "bone" and "skin".
    out : path
        Gets a folder for each set: a VTU file for each load, ``curve.csv`` (force and travel of the plate),
        ``regions.csv``, ``simulation.json`` and pictures.
    sets : sequence of str
        Names of published sets, or files of your own (.toml).
    loads : sequence of LoadStep
        Loads with the same normal force lie on one path, in the order of their shear; by default those of the
        published experiment.
    plate_normal, shear_direction : (3,)
        The plate's outward normal, and the direction of the shear force on the tissue, LPS.
    taped : bool
        Whether skin that has touched the plate holds to it; if not, it slides without friction.
    decks : bool
        Also write each load as decks for CalculiX (C3D10) and FEBio 4 (tet10); see `fe.decks`.
    workers : int
        Simulations at once; by default one for each core.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError
        If the mesh, a set or a load cannot be used; before anything is computed.
    """
    place, target = Path(mesh), Path(out)
    plate = Plate(plate_normal, shear_direction, taped=taped)
    read = read_tet_mesh(place, unit=mesh_unit, frame=mesh_frame)
    chosen = [material_set(name) for name in sets]
    names = [one.name for one in chosen]
    if not names or len(set(names)) < len(names):
        raise InputError(f"Material sets are needed, each once; got {', '.join(map(str, sets)) or 'none'}.")
    paths = paths_of(loads)
    laws = {one.name: one.for_regions(read.regions) for one in chosen}
    refuse_touching_inputs(target, names, [place])
    make_output(target)
    for name in names:
        make_output(target / name)
    jobs = [(one, path) for one in chosen for path in paths]
    at_once = max(1, min(workers or usable_cores(), len(jobs)))
    threads = max(1, usable_cores() // at_once)
    found: dict[str, list[State]] = {name: [] for name in names}
    failures: dict[str, str] = {}
    tell = progress or (lambda *_: None)

    def one(job: tuple[MaterialSet, tuple[LoadStep, ...]], worker: Worker) -> None:
        chosen_set, path = job
        case = f"{chosen_set.name}, {' '.join(step.name for step in path)}"
        with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
            share = Path(folder) / "share"

            def watch() -> None:
                if share.exists():
                    tell(case, "simulating", float(share.read_text() or 0.0))

            try:
                states = worker.run(
                    f"simulating {case}", _simulated, read, laws[chosen_set.name][0], plate, path,
                    target / chosen_set.name, share, threads, watch=watch,
                )  # fmt: skip
                found[chosen_set.name] += states
            except MrstrainError as failure:
                failures[case] = str(failure)
        tell(case, "simulating", 1.0)

    each_in_workers(jobs, one, at_once=at_once, threads=threads)
    order = [load.name for load in loads]
    done = []
    for chosen_set in chosen:
        name = chosen_set.name
        states = sorted(found[name], key=lambda s: order.index(s.load.name))
        if states:
            record = provenance("simulate", {"mesh": place}, _told(chosen_set, loads, plate))
            done.append(_written(target / name, name, read, states, *laws[name], plate, record, decks))
    if not done:
        raise MrstrainError("No simulation ended. " + " ".join(f"{n}: {r}" for n, r in failures.items()))
    return Simulations(target, tuple(done), failures)


def paths_of(loads: Sequence[LoadStep]) -> list[tuple[LoadStep, ...]]:
    """Loads by path: those of one normal force in the order of their shear.

    Examples
    --------
    >>> [" ".join(load.name for load in path) for path in paths_of(LOADS)]
    ['Load1', 'Load2 Load4 Load3']
    """
    names = [load.name for load in loads]
    if not names or len(set(names)) < len(names):
        raise InputError(f"Loads are needed, each with a name of its own; got {', '.join(names) or 'none'}.")
    forces = dict.fromkeys(load.normal_n for load in loads)
    return [tuple(sorted((x for x in loads if x.normal_n == n), key=lambda x: x.shear_n)) for n in forces]


def load_named(text: str) -> LoadStep:
    """A load from NAME=NORMAL or NAME=NORMAL,SHEAR, in N.

    Examples
    --------
    >>> load_named("Load3=15,45")
    LoadStep(name='Load3', normal_n=15.0, shear_n=45.0)
    """
    name, _, forces = text.partition("=")
    try:
        normal, shear = (float(v) for v in (forces if "," in forces else forces + ",0").split(","))
    except ValueError as failure:
        raise InputError(
            f"A load is NAME=NORMAL or NAME=NORMAL,SHEAR in N, such as Load3=15,45; got '{text}'."
        ) from failure
    if not name.strip() or not re.fullmatch(r"[\w. -]+", name.strip()):
        raise InputError(f"A load needs a name of letters, digits, dots, blanks or dashes; got '{name}'.")
    return LoadStep(name.strip(), normal, shear)


def _simulated(
    mesh: TetMesh,
    laws: Mapping[str, Material],
    plate: Plate,
    path: Sequence[LoadStep],
    folder: Path,
    share: Path,
    threads: int,
) -> list[State]:
    """Run one path in a worker: each load's file is written as soon as it is there."""
    log: list[str] = []
    try:
        return solve(
            mesh, laws, plate, path, threads=threads, tell=log.append,
            keep=lambda state: write_state(folder / f"{state.load.name}.vtu", mesh, state, laws),
            progress=lambda done: _replaced(share, f"{done:.4f}"),
        )  # fmt: skip
    finally:
        write_whole(folder / f"log-{path[0].name}.txt", "\n".join(log) + "\n")


def _replaced(path: Path, text: str) -> None:
    part = path.with_suffix(".part")
    part.write_text(text)
    part.replace(path)


def _told(chosen: MaterialSet, loads: Sequence[LoadStep], plate: Plate) -> dict[str, object]:
    return {
        "set": chosen.name,
        "title": chosen.title,
        "source": chosen.source,
        "laws": {tissue: law.told for tissue, law in chosen.laws.items()},
        "loads": [asdict(load) for load in loads],
        "plate_axes_lps": plate.axes.tolist(),
        "taped": plate.taped,
        "element": "P1",
    }


def _written(
    folder: Path,
    name: str,
    mesh: TetMesh,
    states: Sequence[State],
    laws: Mapping[str, Material],
    notes: tuple[str, ...],
    plate: Plate,
    record: dict[str, object],
    decks: bool,
) -> Simulated:
    rows = [row for state in states for row in region_figures(mesh, state, laws)]
    notes += tuple(
        f"{row.load}: the law of {row.region} is not stable (Drucker) in {1.0 - row.stable_share:.1%} of its volume."
        for row in rows
        if row.stable_share < 1.0
    )
    if decks:
        try:
            for state in states:
                write_calculix(folder / f"{state.load.name}.inp", mesh, laws, state, quadratic=True)
                write_febio(folder / f"{state.load.name}.feb", mesh, laws, state, quadratic=True)
        except InputError as refused:
            notes += (f"No deck: {refused}",)
    write_regions_csv(folder / "regions.csv", rows)
    write_curve_csv(folder / "curve.csv", states)
    outcome = {}
    for state in states:
        J = np.linalg.det(np.eye(3) + state.gradients)
        patches = np.abs(patch_volumes(mesh, J) - 1.0)[mesh.cells].mean(axis=1) > _FAR
        outcome[state.load.name] = {
            "reached": state.reached,
            "plate_travel_mm": state.travel_mm.tolist(),
            "plate_force_n": state.force_n.tolist(),
            "nodes_on_plate": len(state.on_plate),
            "iterations": state.iterations,
            "seconds": round(state.seconds, 1),
            "volume_share_with_patch_det_f_off_by_5_percent": float(
                mesh.volumes_mm3[patches].sum() / mesh.volumes_mm3.sum()
            ),
        }
    write_json(folder / "simulation.json", {"outcome": outcome, "notes": list(notes)} | record)
    pictures = {
        "slices.png": figures.sagittal_slice(mesh, states, plate, lowest_point(mesh, plate)),
        "force_travel.png": figures.force_travel(states),
    }
    for file, drawn in pictures.items():
        with whole_file(folder / file) as part:
            part.write_bytes(drawn)
    return Simulated(name, tuple(states), tuple(rows), notes)
