"""`drive`: constitutive models under measured (Dirichlet) boundary conditions, without plate, contact and friction."""

import logging
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import fe
from dvc import Deformation, TetMesh
from dvc.atomic_files import whole_folder, write_json, write_whole
from dvc.errors import InputError, MrstrainError
from dvc.io.result_folder import REGIONS, result_folders
from dvc.threads import usable_cores
from mrstrain.comparison.model_files import IN_IMAGE, SETTINGS
from mrstrain.models.simulate import material_sets
from mrstrain.options.door import door
from mrstrain.options.modelling import MaterialSets, MeshCoordinates
from mrstrain.records.durations import SIMULATING, driven, driven_part
from mrstrain.records.inputs import alone, make_output, refuse_touching_inputs
from mrstrain.records.outcome import Outcome
from mrstrain.records.progress import OnProgress, expect
from mrstrain.records.provenance import provenance
from mrstrain.records.time_left import Expected
from validate import boundary_displacement, simulate_driven, write_boundary_conditions

_log = logging.getLogger(__name__)
ENDING = "-driven"  # of a set's folder
_CASE = "drive"
_BOUNDARY = "boundary"  # folder in it, of the boundary conditions for other codes


@door
def drive(
    mesh: Path | str, dvc: Path | str, *, out: Path | str, material: MaterialSets, loads: Sequence[str] = (),
    threads: int | None = None, coordinates: MeshCoordinates, progress: OnProgress | None = None,
) -> Outcome:  # fmt: skip
    """Simulate a mesh with the measured displacement prescribed on its surface.

    Parameters
    ----------
    mesh : path
        As in `simulate`; the surface set "bone" does not move.
    dvc : path
        Results of `register` or `strain`: the folder with one folder per load, or the folder of one load.
    out : path
        Gets a folder for each material set (SET-driven) with ``LOAD.vtu``, for `compare`. Its folder ``boundary`` has
        the displacements as boundary conditions for ANSYS, Abaqus and FEBio, with the node numbers, unit and frame of
        the mesh.
    material, coordinates, progress
        As in `simulate`.
    loads : sequence of str
        Names of measured loads; all by default.
    threads : int, optional
        Of the solver; all cores by default.

    Raises
    ------
    InputError
        If the mesh, a material set or the measurement cannot be used; before anything is computed.
    """
    target, place, tell = Path(out), Path(mesh), progress or (lambda *_: None)
    unit, frame, sets = coordinates.mesh_unit, coordinates.mesh_frame, material.sets
    read = fe.read_tet_mesh(place, unit=unit, frame=frame)
    chosen = material_sets(sets)
    laws = {one.name: one.for_regions(read.regions) for one in chosen}
    titles = {one.name: one.title for one in chosen}
    for materials, _ in laws.values():
        fe.check_materials(read, materials)
    measurements = result_folders(Path(dvc), loads)
    if loose := [m.load for m in measurements if m.aligned_on == "none"]:
        raise InputError(
            f"{', '.join(loose)}: the rigid motion of the bone was not removed from this measurement, but the bone of "
            "the model does not move. Register again with a bone."
        )
    measured = {m.load: m.deformation() for m in measurements}
    prescribed = {load: boundary_displacement(read, field) for load, field in measured.items()}
    folders = {name: target / (name + ENDING) for name in laws}
    refuse_touching_inputs(target, [f.name for f in folders.values()], [place, Path(dvc)])
    make_output(target)
    inputs = {"mesh": [place], "measured": [f for m in measurements for f in m.files]}
    inputs["sets"] = [Path(s) for s in sets if str(s).endswith(".toml")]
    record = provenance("drive", inputs, coordinates.plain())
    doubtful = [(m.load, m.verdict) for m in measurements if m.verdict and m.verdict.reasons]
    lines = [f"{load}: verdict on the registration: {verdict.words}" for load, verdict in doubtful]
    complete, regions = True, {str(n): region for n, region in enumerate(read.regions, start=1)}
    with ExitStack() as held_folders:
        for folder in folders.values():  # a study drives its sets side by side
            make_output(folder)
            held_folders.enter_context(alone(folder))
            fe.begin_simulation(folder)
        how_long = driven(chosen, measured, len(read.cells))
        expect(progress, {_CASE: Expected(how_long.seconds)})
        tell(_CASE, SIMULATING, 0.0)

        def told(name: str, load: str, done: float) -> None:
            tell(_CASE, SIMULATING, how_long.share(driven_part(name, load), min(done, 0.99)))  # then it is written

        for name, (materials, notes) in laws.items():
            with whole_folder(folders[name] / _BOUNDARY) as conditions:
                for load, (nodes, u) in prescribed.items():
                    write_boundary_conditions(conditions / load, read, nodes, u, unit=unit, frame=frame)
            watch = partial(told, name)
            outcome, messages = _drive_set(folders[name], read, materials, measured, threads or usable_cores(), watch)
            complete = complete and [of["reached"] for of in outcome.values()] == [1.0] * len(measured)
            lines += messages
            about = {"outcome": outcome, "notes": list(notes), "region_numbers_in_vtu": regions, "set": name}
            about |= {"laws": {region: law.description for region, law in materials.items()}, "title": titles[name]}
            write_json(folders[name] / "simulation.json", about | record)
    tell(_CASE, SIMULATING, 1.0)
    return Outcome(target, (*lines, f"Results: {target}"), complete)


def _drive_set(
    folder: Path,
    mesh: TetMesh,
    laws: Mapping[str, fe.Material],
    measured: Mapping[str, Deformation],
    threads: int,
    watch: Callable[[str, float], None],
) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Simulate all loads with one material set and write the results; the outcome of each load, and summary lines."""
    rows, outcome, log, lines = list[fe.RegionFigures](), dict[str, dict[str, float]](), list[str](), list[str]()
    name = folder.name.removesuffix(ENDING)
    for load, field in measured.items():
        try:
            share = partial(watch, load)
            state = simulate_driven(mesh, laws, field, load, threads=threads, tell=log.append, watch=share)
        except InputError:
            raise
        except MrstrainError as failure:
            lines.append(f"{name}: {failure}")
            _log.info("%s, %s failed", name, load, exc_info=failure)
            continue
        fe.write_state(folder / f"{load}.vtu", mesh, state, laws)
        outcome[load] = {"reached": state.reached, "iterations": state.iterations, "seconds": round(state.seconds, 1)}
        own = fe.region_figures(mesh, state, laws)
        rows += own
        figures = "; ".join(f"{r.region} {r.shear_p50:.3f} / {r.shear_p95:.3f}" for r in own)
        part = "" if state.reached == 1.0 else f" ONLY {100 * state.reached:.0f} % of the displacement was reached;"
        lines.append(f"{name}, {load}:{part} max. shear, median / 95th percentile: {figures}")
    fe.write_regions_csv(folder / REGIONS, rows)
    write_whole(folder / SETTINGS, IN_IMAGE)
    write_whole(folder / "log.txt", "\n".join(log) + "\n")
    return outcome, lines
