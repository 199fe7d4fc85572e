"""`drive`: a model whose outside goes where the measurement puts it, so that laws are judged apart from the plate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from dvc.atomic_files import write_json, write_whole
from dvc.errors import InputError, MrstrainError
from dvc.io.result_folder import REGIONS, result_folders
from dvc.worker import usable_cores
from fe.mesh_file import read_tet_mesh
from fe.published import material_set
from fe.result import region_figures, write_regions_csv, write_state
from fe.simulate import check_laws
from mrstrain.comparison.model_files import IN_IMAGE, SETTINGS
from mrstrain.models.simulate import clear
from mrstrain.records.inputs import make_output, refuse_touching_inputs
from mrstrain.records.provenance import provenance
from validate.measured_boundary import driven, outside, write_boundary

BOUNDARY, ENDING = "boundary", "-driven"
"""Folder of the boundary conditions for other codes; ending of a set's folder."""


@dataclass(frozen=True, slots=True)
class Driven:
    """What `drive` gave."""

    out: Path
    complete: bool
    lines: tuple[str, ...]

    def summary(self) -> list[str]:
        """A few lines for a person."""
        return [*self.lines, f"Results: {self.out}"]


def drive(
    mesh: Path | str,
    dvc: Path | str,
    *,
    out: Path | str,
    sets: Sequence[str] = ("trebbi",),
    loads: Sequence[str] = (),
    threads: int | None = None,
    mesh_unit: str = "mm",
    mesh_frame: str = "LPS",
    progress: Callable[[str, str, float], None] | None = None,
) -> Driven:
    """Drive a mesh by measured displacements of its outside.

    Parameters
    ----------
    mesh : path
        As in `simulate`; facets "bone" do not move.
    dvc : path
        Results of `register` or `strain`: a folder for each load, or one of these.
    out : path
        Gets a folder for each set (SET-driven) with ``LOAD.vtu``, as `simulate` writes them and `compare` takes them,
        and a folder ``boundary`` with the displacements of the outside for ANSYS, Abaqus and FEBio, by the mesh's
        node numbers, in its unit and frame.
    sets : sequence of str
        Names of published sets, or files of your own (.toml).
    loads : sequence of str
        Names of measured loads; all by default.
    threads : int, optional
        Of the solver; all cores by default.
    mesh_unit, mesh_frame : str
        Of the mesh file: "mm" or "m", "LPS" or "RAS".
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError
        If mesh, sets or measurement cannot be used; before anything is computed.
    """
    target, place, tell = Path(out), Path(mesh), progress or (lambda *_: None)
    read = read_tet_mesh(place, unit=mesh_unit, frame=mesh_frame)
    chosen = [material_set(name) for name in sets]
    if not chosen or len({one.name for one in chosen}) < len(chosen):
        raise InputError(f"Material sets are needed, each once; got {', '.join(map(str, sets)) or 'none'}.")
    laws = {one.name: one.for_regions(read.regions) for one in chosen}
    for region_laws, _ in laws.values():
        check_laws(read, region_laws)
    found = result_folders(Path(dvc), loads)
    loose = [m.load for m in found if m.aligned_on == "none"]
    if loose:
        raise InputError(
            f"{', '.join(loose)}: the bone's motion was not taken out of this measurement, and the model's bone stays "
            "where it is. Register with a bone."
        )
    measured = {m.load: m.deformation() for m in found}
    edges = {load: outside(read, field) for load, field in measured.items()}
    folders = {name: target / (name + ENDING) for name in laws}
    refuse_touching_inputs(target, [BOUNDARY, *(f.name for f in folders.values())], [place, Path(dvc)])
    make_output(target)
    for folder in (target / BOUNDARY, *folders.values()):
        make_output(folder)
        clear(folder)
    own = [Path(s) for s in sets if str(s).endswith(".toml")]
    record = provenance(
        "drive",
        {"mesh": place, "measured": [f for m in found for f in m.files], "sets": own},
        {"mesh_unit": mesh_unit, "mesh_frame": mesh_frame},
    )
    lines = [
        f"{m.load}: the measurement is judged: {m.verdict.words}" for m in found if m.verdict and m.verdict.reasons
    ]
    complete = True
    for load, (nodes, u) in edges.items():
        write_boundary(target / BOUNDARY / load, read, nodes, u, unit=mesh_unit, frame=mesh_frame)
    total = len(chosen) * len(measured)
    for number, one in enumerate(chosen):
        region_laws, notes = laws[one.name]
        rows, outcome, log = [], {}, list[str]()
        for at, (load, field) in enumerate(measured.items()):
            tell("drive", "simulating", (number * len(measured) + at) / total)
            try:
                state = driven(read, region_laws, field, load, threads=threads or usable_cores(), tell=log.append)
            except InputError:
                raise
            except MrstrainError as failure:
                complete = False
                lines.append(f"{one.name}: {failure}")
                continue
            write_state(folders[one.name] / f"{load}.vtu", read, state, region_laws)
            outcome[load] = {
                "reached": state.reached,
                "iterations": state.iterations,
                "seconds": round(state.seconds, 1),
            }
            complete = complete and state.reached == 1.0
            rows += region_figures(read, state, region_laws)
            told = "; ".join(f"{r.region} {r.shear_p50:.3f} / {r.shear_p90:.3f}" for r in rows if r.load == load)
            part = "" if state.reached == 1.0 else f" ONLY {state.reached:.0%} of the displacement was reached;"
            lines.append(f"{one.name}, {load}:{part} maximal shear, median / 90th percentile: {told}")
        write_regions_csv(folders[one.name] / REGIONS, rows)
        write_whole(folders[one.name] / SETTINGS, IN_IMAGE)
        write_whole(folders[one.name] / "log.txt", "\n".join(log) + "\n")
        regions = {str(n): name for n, name in enumerate(read.regions, start=1)}
        write_json(
            folders[one.name] / "simulation.json",
            {"outcome": outcome, "notes": list(notes), "region_numbers_in_vtu": regions, "set": one.name,
             "laws": {region: law.told for region, law in region_laws.items()}} | record,
        )  # fmt: skip
    tell("drive", "simulating", 1.0)
    return Driven(target, complete, tuple(lines))
