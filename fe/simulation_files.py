"""Files of a simulation: reading results, resuming after an interruption, and removing old files."""

import hashlib
from contextlib import suppress
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dvc import TetMesh
from dvc.atomic_files import remove_partial, whole_file, write_json
from dvc.errors import InputError
from dvc.mesh import outer_faces
from dvc.own_files import read_arrays, read_json
from dvc.software import software_key
from fe.load_path import PlateState
from fe.loading import Checkpoint
from fe.materials import from_vector
from fe.mesh_file import BONE, SKIN
from fe.plate import ContactStatus
from fe.problem import LoadStep, Problem
from fe.published import MaterialSet
from fe.result import BEFORE, PLATE_VECTORS, read_curve_csv, read_state
from fe.solution import LoadState

RECORD = "simulation.json"
ENDING = ".restart.npz"
_FIGURES = "slices", "force_displacement", "force_travel"  # the last: its name before
_TABLES = ("regions.csv", "curve.csv", *(f"{name}.{kind}" for name in _FIGURES for kind in ("png", "pdf", "csv")))
_CONTACT = [field.name for field in fields(ContactStatus)]
_PLATE = [field.name for field in fields(PlateState)]


def read_parts(place: Path, mesh: TetMesh | None) -> dict[str, Any]:
    """The arguments of a `fe.Simulation`, read from its folder."""
    try:
        return _parts(place, mesh)
    except (OSError, ValueError, LookupError, TypeError, AttributeError, StopIteration) as failure:
        raise InputError(
            f"{place}: not the folder of a simulation, or a file in it is damaged ({type(failure).__name__}: "
            f"{failure}). Give a folder with {RECORD}, curve.csv and a VTU file for each load, of `mrstrain simulate`."
        ) from failure


def _parts(place: Path, mesh: TetMesh | None) -> dict[str, Any]:
    content = read_json(place / RECORD)
    if content["outcome"] == {}:
        raise ValueError("the simulation has not ended, or reached no load")
    given, outcome = content["parameters"], content["outcome"]
    paths = tuple(tuple(LoadStep(**load) for load in path) for path in given["paths"])
    loads = {load.name: load for path in paths for load in path}
    curves = read_curve_csv(place / "curve.csv")
    files = {name: read_state(path) for name in outcome if (path := place / f"{name}.vtu").is_file()}
    first, u_mm, _, _ = next(iter(files.values()))
    cells = first.cells_dict["tetra"].astype(np.int64)
    if mesh is None:
        number = first.cell_data["region"][0]
        regions = {name: np.flatnonzero(number == int(n)) for n, name in given["region_numbers_in_vtu"].items()}
        faces, bone = outer_faces(cells), given["fixed"][0] if len(given["fixed"]) == 1 else BONE
        still = (u_mm[faces] == 0.0).all(axis=(1, 2))
        mesh = TetMesh(first.points, cells, regions, {bone: faces[still], SKIN: faces[~still]})
    elif not (np.array_equal(mesh.points_mm, first.points) and np.array_equal(mesh.cells, cells)):
        raise InputError(f"{place}: this simulation was made on another mesh than the one given. Give that mesh.")
    undeformed = first, np.zeros_like(first.points), np.zeros((len(cells), 3, 3)), np.zeros(len(cells))
    skin, states = np.unique(mesh.facets[SKIN]), []
    for name, at in outcome.items():  # no file: the time limit was reached before the first equilibrium
        _, u_mm, gradients, pressure_mpa = files.get(name, undeformed)
        at |= {name.replace(*BEFORE): value for name, value in at.items()}
        vectors = {vector: np.array(at[f"plate_{vector}"]) for vector in PLATE_VECTORS}
        plate, axes = PlateState(**vectors, area_mm2=at["contact_area_mm2"]), np.array(at["plate_axes_lps"])
        # The nodes on the plate are those of the skin that lie furthest along its normal.
        towards = axes @ Rotation.from_rotvec(plate.turn_deg, degrees=True).as_matrix()[:, 0]
        height = (mesh.points_mm + u_mm)[skin] @ towards
        on_plate = np.sort(skin[np.argsort(height, kind="stable")[: at["nodes_on_plate"]]])
        state = LoadState(
            loads[name], at["reached"], u_mm, pressure_mpa, gradients, on_plate, (*curves[name][:-1], plate),
            at["iterations"], at["seconds"], out_of_time=at["out_of_time"], plate_axes=axes,
        )  # fmt: skip
        states.append(state)
    materials = {
        region: from_vector(law["law"], np.array(law["vector_mpa"]), law["bulk_modulus_mpa"])
        for region, law in given["laws"].items()
    }
    if unlike := sorted(set(materials) ^ set(mesh.regions)):
        raise ValueError(f"only the mesh or only the materials have the region {', '.join(unlike)}")
    of_loads = tuple(f"{name}{word}" for name in loads for word in (":", " was not tried"))  # derived anew, not remarks
    material_set = MaterialSet(given["set"], given["title"], given["source"], materials)
    return {
        "materials": material_set, "mesh": mesh, "paths": paths, "states": tuple(states),
        "fixed": tuple(given["fixed"]), "element": given["element"].split(":")[0], "turns": given["turns"],
        "remarks": tuple(note for note in content["notes"] if not note.startswith(of_loads)),
    }  # fmt: skip


def begin_simulation(folder: Path) -> None:
    """Remove the files of an earlier simulation, listed in its own record, so that old and new are never mixed.

    Until the simulation ends, its record names no load, since the last file may hold only a part of a load.
    """
    loads = list[str]()
    with suppress(OSError, ValueError, KeyError, TypeError):  # there is none, or it is damaged
        loads = list(read_json(folder / RECORD)["outcome"])
    of_loads = [name for load in loads for name in (f"{load}.vtu", f"{load}.inp", f"{load}.feb", f"log-{load}.txt")]
    for name in (*of_loads, *_TABLES):
        (folder / name).unlink(missing_ok=True)
    remove_partial(folder)
    write_json(folder / RECORD, {"outcome": {}})


def fingerprint(problem: Problem, last: LoadStep) -> str:
    """A hash of everything that a load of a problem depends on, with solver and libraries (`dvc.software`)."""
    mesh, plate, loads = problem.mesh, problem.plate, (*problem.passed, *problem.loads)
    digest = hashlib.sha256()

    def add(*things: object) -> None:
        for thing in things:
            digest.update(thing.tobytes() if isinstance(thing, np.ndarray) else f"{thing!r};".encode())

    add(mesh.points_mm, mesh.cells)
    for named in (mesh.regions, mesh.facets):
        for name, rows in named.items():
            add(name, rows)
    for region, material in problem.materials.items():
        add(region, material.vector, material.nu)
    add(plate.axes, plate.gap_mm, plate.taped, plate.turns, np.asarray(plate.pivot_mm, dtype=np.float64))
    add(*(astuple(load)[1:] for load in loads[: loads.index(last) + 1]))
    add(tuple(problem.fixed), problem.element, software_key("fe"))
    return digest.hexdigest()


def write_checkpoint(path: Path, checkpoint: Checkpoint, made_from: str) -> None:
    """Write the checkpoint of a load, with the `fingerprint` of its inputs."""
    at = checkpoint
    counts = np.array([at.reached, at.stages, at.iterations, at.seconds])
    arrays: dict[str, Any] = {"made_from": made_from, "counts": counts, "unknowns": at.unknowns}
    arrays |= {name: getattr(at.contact, name) for name in _CONTACT}
    arrays |= {name: np.array([getattr(plate, name) for plate in at.curve]) for name in _PLATE}
    with whole_file(path) as part:
        np.savez_compressed(part, **arrays)


def read_checkpoint(path: Path, made_from: str) -> Checkpoint | None:
    """Read the checkpoint of a load; None if there is no file, it is damaged, or it was made from other inputs."""
    try:
        file = read_arrays(path)
        if str(file["made_from"]) != made_from:
            return None
        reached, stages, iterations, seconds = file["counts"].tolist()
        nodes, places, rotation, turns = (file[name] for name in _CONTACT)
        curve = [PlateState(*at) for at in zip(*(file[name] for name in _PLATE), strict=True)]
        contact = ContactStatus(nodes, places, rotation, bool(turns))
        return Checkpoint(reached, int(stages), tuple(curve), int(iterations), seconds, file["unknowns"], contact)
    except (OSError, ValueError, KeyError):
        return None
