"""`simulate`: a mesh under a plate's loads, for one or more sets of material laws."""

from __future__ import annotations

import json
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from dvc.atomic_files import whole_file, write_json
from dvc.errors import InputError, MrstrainError
from dvc.io.result_folder import REGIONS
from dvc.mesh import TetMesh
from dvc.worker import Worker, each_in_workers, usable_cores
from fe import figures
from fe.decks import write_calculix, write_febio
from fe.elements import TOLD
from fe.elements import element as formulation
from fe.materials import MODES, Material
from fe.mesh_file import read_tet_mesh
from fe.model import CROWDED
from fe.plate import Plate
from fe.published import MaterialSet, material_set
from fe.restart import ENDING
from fe.result import (
    RegionFigures,
    region_figures,
    volume_share_off,
    write_curve_csv,
    write_regions_csv,
)
from fe.simulate import LoadStep, State, check
from fe.surface_sets import fixed_facets
from mrstrain.models.load_path import simulated_path
from mrstrain.models.loads import LOADS, Vector, paths_of
from mrstrain.records.inputs import make_output, refuse_touching_inputs
from mrstrain.records.provenance import provenance

Told = Callable[[str, str, float], None]

_TABLES = (REGIONS, "curve.csv", "slices.png", "force_travel.png")
_FAR = 0.05  # det F of a patch further from 1 than this is counted
_MUCH = 0.05  # share of the volume above which that is told
_CROWD = 0.01  # share of a region's volume, squeezed flat, above which that is told


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
        What was assumed, and what is not to be trusted.
    complete : bool
        Whether every load was carried, with laws that are stable at the strain reached.
    timed_out : bool
        Whether all that it lacks is what its limit of time did not let it reach.
    """

    name: str
    states: tuple[State, ...]
    figures: tuple[RegionFigures, ...]
    notes: tuple[str, ...]
    complete: bool
    timed_out: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Simulations:
    """What `simulate` gave."""

    out: Path
    sets: tuple[Simulated, ...]
    failures: Mapping[str, str]

    @property
    def complete(self) -> bool:
        """Whether every set carried every load, with laws that are stable at the strain reached."""
        return not self.failures and all(one.complete for one in self.sets)

    def summary(self) -> list[str]:
        """A few lines for a person."""
        lines = []
        for one in self.sets:
            for state in one.states:
                fat = [f for f in one.figures if f.load == state.load.name]
                shear = "; ".join(f"{f.region} {f.shear_p50:.3f} / {f.shear_p90:.3f}" for f in fat)
                force = f"{state.force_n[0]:.1f} N and {state.force_n[1]:.1f} N of shear"
                part = "" if state.reached == 1.0 else f" ONLY {state.reached:.0%} of the load was reached ({force});"
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
    towards: Mapping[str, tuple[Vector, Vector]] | None = None,
    taped: bool = True,
    gap_mm: float = 0.0,
    turns: bool = False,
    pivot_mm: Sequence[float] | None = None,
    fixed: Sequence[str] = (),
    element: str = "P1",
    mesh_unit: str = "mm",
    mesh_frame: str = "LPS",
    decks: bool = False,
    limit_s: float | None = None,
    workers: int | None = None,
    threads: int | None = None,
    progress: Told | None = None,
) -> Simulations:
    """Simulate a plate that presses and shears soft tissue on fixed bone.

    Parameters
    ----------
    mesh : path
        As `mesh` writes it, or made elsewhere; with facets "skin", "bone", and those that are fixed as well.
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
    towards : mapping, optional
        The same two for loads, by name, that go in directions of their own.
    taped : bool
        Whether skin that has touched the plate holds to it; if not, it slides without friction.
    gap_mm : float
        Distance of the plate from the skin at the start, which its travel begins with.
    turns : bool
        Whether the plate turns freely about its pivot once it presses.
    pivot_mm : (3,), optional
        As in `fe.plate.Plate`.
    fixed : sequence of str
        Facets that do not move, beside the bone's; case does not count.
    element : {"P1", "MINI", "P2"}
        As in `fe.elements`.
    decks : bool
        Also write each load as decks for CalculiX (C3D10) and FEBio 4 (tet10); see `fe.decks`.
    limit_s : float, optional
        Time after which a set's path of loads ends at its last equilibrium; with more time it goes on from there.
    workers, threads : int, optional
        Simulations at once, and threads of each; by default all cores are used.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError
        If the mesh, a set or a load cannot be used; before anything is computed.
    """
    place, target = Path(mesh), Path(out)
    if limit_s is not None and not limit_s > 0.0:
        raise InputError(f"The limit of time must be above 0; got {limit_s:g} s.")
    towards = dict(towards or {})
    formulation(element)
    read = read_tet_mesh(place, unit=mesh_unit, frame=mesh_frame)
    chosen = [material_set(name) for name in sets]
    names = [one.name for one in chosen]
    if not names or len(set(names)) < len(names):
        raise InputError(f"Material sets are needed, each once; got {', '.join(map(str, sets)) or 'none'}.")
    strangers = towards.keys() - {load.name for load in loads}
    if strangers:
        raise InputError(f"Directions are given for {', '.join(sorted(strangers))}, which is none of the loads.")
    plate_of = {
        load.name: Plate(*towards.get(load.name, (plate_normal, shear_direction)), gap_mm, taped, turns, pivot_mm)
        for load in loads
    }
    paths = paths_of(loads, {name: tuple(plate.axes.round(9).ravel()) for name, plate in plate_of.items()})
    plates = [plate_of[path[0].name] for path in paths]
    held = fixed_facets(read, fixed)
    laws = {one.name: one.for_regions(read.regions) for one in chosen}
    for region_laws, _ in laws.values():
        for path, plate in zip(paths, plates, strict=True):
            check(read, region_laws, plate, path, held)
    refuse_touching_inputs(target, names, [place])
    make_output(target)
    for name in names:
        make_output(target / name)
        clear(target / name)
        for left in (target / name).glob(f"*{ENDING}"):
            if left.name.removesuffix(ENDING) not in {load.name for load in loads}:
                left.unlink()
    files = {"mesh": [place, *_beside(place)], "sets": [Path(s) for s in sets if str(s).endswith(".toml")]}
    given = {"mesh_unit": mesh_unit, "mesh_frame": mesh_frame, "taped": taped, "gap_mm": gap_mm, "fixed": list(held)}
    given |= {
        "limit_s": limit_s,
        "turns": turns,
        "pivot_mm": None if pivot_mm is None else list(pivot_mm),
        "mesh_made": _mesh_made(place),
    }
    jobs = [(one, path, plate) for one in chosen for path, plate in zip(paths, plates, strict=True)]
    at_once = max(1, min(workers or usable_cores(), len(jobs)))
    each = threads or max(1, usable_cores() // at_once)
    found: dict[str, list[State]] = {name: [] for name in names}
    waiting = {name: len(paths) for name in names}
    done: dict[str, Simulated] = {}
    failures: dict[str, str] = {}
    tell, writing = progress or (lambda *_: None), threading.Lock()

    def one(job: tuple[MaterialSet, tuple[LoadStep, ...], Plate], worker: Worker) -> None:
        chosen_set, path, plate = job
        name = chosen_set.name
        case = f"{name}, {' '.join(step.name for step in path)}"
        with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder:
            share = Path(folder) / "share"

            def watch() -> None:
                if share.exists():
                    tell(case, "simulating", float(share.read_text() or 0.0))

            try:
                states = worker.run(
                    f"simulating {case}", simulated_path, read, laws[name][0], plate, path, held, element,
                    target / name, share, each, np.inf if limit_s is None else limit_s, watch=watch,
                )  # fmt: skip
            except MrstrainError as failure:
                states, failures[case] = [], str(failure)
        with writing:  # each set's tables as soon as its last path is there
            found[name] += states
            waiting[name] -= 1
            if waiting[name] == 0 and found[name]:
                ordered = [s for p in paths for load in p for s in found[name] if s.load.name == load.name]
                record = provenance("simulate", files, given | _told(chosen_set, laws[name][0], paths, turns, element))
                done[name] = _written(
                    target / name, name, read, ordered, *laws[name], loads, record, held if decks else None
                )
        tell(case, "simulating", 1.0)

    each_in_workers(jobs, one, at_once=at_once, threads=each)
    if not done:
        raise MrstrainError("No simulation ended. " + " ".join(f"{n}: {r}" for n, r in failures.items()))
    return Simulations(target, tuple(done[name] for name in names if name in done), failures)


def clear(folder: Path) -> None:
    """Remove what an earlier simulation wrote by its own list, so that nothing old stands beside what is new."""
    told = folder / "simulation.json"
    try:
        loads = list(json.loads(told.read_text(encoding="utf-8"))["outcome"])
    except (OSError, ValueError, KeyError, TypeError):
        return
    of_loads = [f"{load}{ending}" for load in loads for ending in (".vtu", ".inp", ".feb")]
    logs = [f"log-{load}.txt" for load in loads]
    for name in (*of_loads, *logs, *_TABLES, told.name):
        (folder / name).unlink(missing_ok=True)


def _beside(place: Path) -> list[Path]:
    names = place.with_suffix(".json")
    return [names] if names.is_file() else []


def _mesh_made(place: Path) -> dict[str, object] | None:
    """How `mesh` made a mesh, by the record that it leaves beside it; None for meshes made elsewhere."""
    try:
        told = json.loads(place.with_suffix(".json").read_text(encoding="utf-8"))
        if told["command"] == "mesh":
            return {"edge_mm": told["parameters"]["edge_mm"], "pytetwild": told["versions"]["pytetwild"]}
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return None


def _told(
    chosen: MaterialSet, laws: Mapping[str, Material], paths: Sequence[Sequence[LoadStep]], turns: bool, element: str
) -> dict[str, object]:
    return {
        "set": chosen.name,
        "title": chosen.title,
        "source": chosen.source,
        "laws": {
            region: {
                "law": law.told,
                "vector_mpa": law.vector.tolist(),
                "bulk_modulus_mpa": law.bulk_modulus_mpa,
                "stable_stretches": {mode: law.stable_range(mode) for mode in MODES},
            }
            for region, law in laws.items()
        },
        "region_numbers_in_vtu": {number: name for number, name in enumerate(laws, start=1)},
        "paths": [[asdict(load) for load in path] for path in paths],
        "plate": "rigid; moved to the tissue, then to the forces and travels asked for, no force along the third axis; "
        + ("let go to turn about its pivot once it presses" if turns else "rotation locked"),
        "element": f"{element}: {TOLD[element]}",
    }


def _written(
    folder: Path,
    name: str,
    mesh: TetMesh,
    states: Sequence[State],
    laws: Mapping[str, Material],
    notes: tuple[str, ...],
    loads: Sequence[LoadStep],
    record: dict[str, object],
    decks_fixed: Sequence[str] | None,
) -> Simulated:
    rows = [row for state in states for row in region_figures(mesh, state, laws)]
    unstable = tuple(
        f"{row.load}: the law of {row.region} is not stable (Drucker) in {1.0 - row.stable_share:.1%} of its volume."
        for row in rows
        if row.stable_share < 1.0
    )
    notes += unstable
    notes += tuple(
        f"{row.load}: {row.crowded_share:.1%} of {row.region} is squeezed below det F {CROWDED:g}, where the solver "
        "holds cells open; the law bears no pressure above its bulk modulus "
        f"({laws[row.region].bulk_modulus_mpa:.2g} MPa)."
        for row in rows
        if row.crowded_share > _CROWD
    )
    notes += tuple(
        f"{state.load.name}: its time was over at {state.reached:.0%} of the load; given more, it goes on from there."
        if len(state.curve) > 1
        else f"{state.load.name}: its time was over before the first equilibrium."
        for state in states
        if state.out_of_time
    )
    tried = {state.load.name for state in states}
    notes += tuple(
        f"{load.name} was not tried: the load before it was not reached." for load in loads if load.name not in tried
    )
    if decks_fixed is not None:
        try:
            for state in states:
                write_calculix(folder / f"{state.load.name}.inp", mesh, laws, state, fixed=decks_fixed, quadratic=True)
                write_febio(folder / f"{state.load.name}.feb", mesh, laws, state, fixed=decks_fixed, quadratic=True)
        except InputError as refused:
            notes += (f"No decks: {refused}",)
    write_regions_csv(folder / REGIONS, rows)
    write_curve_csv(folder / "curve.csv", states)
    outcome = {}
    for state in states:
        assert state.plate_axes is not None
        share = volume_share_off(mesh, state, laws, _FAR)
        if share > _MUCH:
            notes += (
                f"{state.load.name}: det F of nodal patches is over 5 % off what the law asks for in {share:.0%} of "
                "the volume; a finer mesh keeps volume better.",
            )
        outcome[state.load.name] = {
            "reached": state.reached,
            "out_of_time": state.out_of_time,
            "stable_share": min(row.stable_share for row in rows if row.load == state.load.name),
            "plate_axes_lps": state.plate_axes.tolist(),
            "plate_travel_mm": state.travel_mm.tolist(),
            "plate_force_n": state.force_n.tolist(),
            "plate_turn_deg": state.plate.turn_deg.tolist(),
            "plate_moment_nmm": state.plate.moment_nmm.tolist(),
            "contact_area_mm2": state.plate.area_mm2,
            "contact_pressure_mpa": state.plate.pressure_mpa if state.plate.area_mm2 > 0.0 else None,
            "nodes_on_plate": len(state.on_plate),
            "iterations": state.iterations,
            "seconds": round(state.seconds, 1),
            "volume_share_with_patch_det_f_off_by_5_percent": share,
        }
    write_json(folder / "simulation.json", {"outcome": outcome, "notes": list(notes)} | record)
    pictures = {
        "slices.png": figures.sagittal_slice(mesh, states),
        "force_travel.png": figures.force_travel(states),
    }
    for file, drawn in pictures.items():
        with whole_file(folder / file) as part:
            part.write_bytes(drawn)
    complete = len(tried) == len(loads) and not unstable and all(state.reached == 1.0 for state in states)
    timed_out = not complete and not unstable and all(state.reached == 1.0 or state.out_of_time for state in states)
    return Simulated(name, tuple(states), tuple(rows), notes, complete, timed_out)
