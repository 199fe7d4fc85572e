"""Files from which an interrupted simulation resumes: where each load came to, and what it was computed from."""

import hashlib
import io
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from dvc.atomic_files import whole_file
from dvc.software import software_key
from fe.load_path import Checkpoint, PlateState
from fe.plate import ContactStatus
from fe.problem import Problem

ENDING = ".restart.npz"

_CONTACT = [field.name for field in fields(ContactStatus)]
_PLATE = [field.name for field in fields(PlateState)]


def fingerprint(problem: Problem, load_count: int) -> str:
    """A hash of all that the first loads of a problem depend on, solver and libraries (`dvc.software`) included."""
    mesh, plate = problem.mesh, problem.plate
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
    add(*(astuple(load)[1:] for load in problem.loads[:load_count]))
    add(tuple(problem.fixed), problem.element, software_key("fe"))
    return digest.hexdigest()


def write_checkpoint(path: Path, checkpoint: Checkpoint, made_from: str) -> None:
    """Write where a load came to, with the `fingerprint` of what it was made from."""
    at = checkpoint
    counts = np.array([at.reached, at.stages, at.iterations, at.seconds])
    arrays: dict[str, Any] = {"made_from": made_from, "counts": counts, "unknowns": at.unknowns}
    arrays |= {name: getattr(at.contact, name) for name in _CONTACT}
    arrays |= {name: np.array([getattr(plate, name) for plate in at.curve]) for name in _PLATE}
    with whole_file(path) as part:
        np.savez_compressed(part, **arrays)


def read_checkpoint(path: Path, made_from: str) -> Checkpoint | None:
    """Where a load came to; None if there is no such file, it is damaged, or was made from something else."""
    try:
        with np.load(io.BytesIO(path.read_bytes())) as file:
            if str(file["made_from"]) != made_from:
                return None
            reached, stages, iterations, seconds = file["counts"].tolist()
            nodes, places, rotation, turns = (file[name] for name in _CONTACT)
            curve = [PlateState(*at) for at in zip(*(file[name] for name in _PLATE), strict=True)]
            contact = ContactStatus(nodes, places, rotation, bool(turns))
            return Checkpoint(reached, int(stages), tuple(curve), int(iterations), seconds, file["unknowns"], contact)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None
