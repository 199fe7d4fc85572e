"""Files from which a simulation that was cut goes on: where each load came to, and what it was computed from."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from dvc.atomic_files import whole_file
from dvc.mesh import TetMesh
from dvc.software import software_key
from fe.load_stages import Kept
from fe.materials import Material
from fe.plate import Hold, Plate
from fe.plate_path import PlateState
from fe.simulate import LoadStep

ENDING = ".restart.npz"

_HOLD = [field.name for field in fields(Hold)]
_PLATE = [field.name for field in fields(PlateState)]


def fingerprint(
    mesh: TetMesh,
    laws: Mapping[str, Material],
    plate: Plate,
    loads: Sequence[LoadStep],
    fixed: Sequence[str],
    element: str,
) -> str:
    """A hash of all that the last of these loads depends on, the solver and its libraries included (`dvc.software`)."""
    digest = hashlib.sha256()

    def add(*things: object) -> None:
        for thing in things:
            digest.update(thing.tobytes() if isinstance(thing, np.ndarray) else f"{thing!r};".encode())

    add(mesh.points_mm, mesh.cells)
    for named in (mesh.regions, mesh.facets):
        for name, rows in named.items():
            add(name, rows)
    for region, law in laws.items():
        add(region, law.vector, law.nu)
    add(plate.axes, plate.gap_mm, plate.taped, plate.turns, np.asarray(plate.pivot_mm, dtype=np.float64))
    add(*(astuple(load)[1:] for load in loads), tuple(fixed), element, software_key("fe"))
    return digest.hexdigest()


def write_kept(path: Path, kept: Kept, made_from: str) -> None:
    """Write where a load came to, with the `fingerprint` of what it was made from."""
    arrays: dict[str, Any] = {
        "made_from": made_from,
        "told": np.array([kept.reached, kept.stages, kept.iterations, kept.seconds]),
        "unknowns": kept.unknowns,
    }
    arrays |= {name: getattr(kept.hold, name) for name in _HOLD}
    arrays |= {name: np.array([getattr(at, name) for at in kept.curve]) for name in _PLATE}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    with whole_file(path) as part:
        part.write_bytes(content.getvalue())


def read_kept(path: Path, made_from: str) -> Kept | None:
    """Read where a load came to; None if there is no such file, it is damaged, or was made from something else."""
    try:
        with np.load(io.BytesIO(path.read_bytes())) as file:
            if str(file["made_from"]) != made_from:
                return None
            reached, stages, iterations, seconds = file["told"].tolist()
            nodes, places, rotation, loose = (file[name] for name in _HOLD)
            curve = [PlateState(*at) for at in zip(*(file[name] for name in _PLATE), strict=True)]
            return Kept(
                reached, int(stages), tuple(curve), int(iterations), seconds, file["unknowns"],
                Hold(nodes, places, rotation, bool(loose)),
            )  # fmt: skip
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return None
