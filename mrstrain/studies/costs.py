"""Estimated time, memory and disk space of the remaining stages of a study, reported before it is run."""

import shutil
from collections.abc import Sequence

import numpy as np

from dvc import LabelMap, TetMesh, read_image, read_labels, tissue_mask
from dvc.errors import InputError
from dvc.measurement.subject import bones_of
from dvc.registration.engine import Cost
from dvc.threads import usable_cores
from fe import LoadStep, material_set, paths_of, read_tet_mesh
from mrstrain.measurement.engines import engine_of
from mrstrain.records.doctor import usable_memory_bytes
from mrstrain.records.durations import USUAL_VOXELS, cells_of, comparison_s, label_s, load_s, mesh_s, registration_s
from mrstrain.records.progress import duration
from mrstrain.records.time_left import Expected, TimeLeft
from mrstrain.studies.file import Study
from mrstrain.studies.plan import COARSE, Stage, drawn_to_mesh, mesh_place

# Seconds on one core, as those of `mrstrain.records.durations`.
_SIMULATE_S = 8.0  # of a simulation beside its loads: start, mesh, figures
_COARSER, _SHORT = 0.35, 0.2  # of the time of a solution: on the coarser mesh, and from the state of another solution
_COARSER_MESH = 0.5  # of the time of the mesh
# Of P1's memory, on 56,000 cells, where P2 took 2.2 GiB and MINI .84.
_ELEMENT_GIB = {"P1": 1.0, "MINI": 1.0, "P2": 2.8}
# GiB of all processes of a stage: registrations of 2.1, 7.1, 16.8 and 56.6 million voxels took .95, 2.1, 3.5 and 9.9,
# with strain discontinuities 1.2 and 2.3 of the first two, by elastix 1.7 of the first; a factorisation at 79,000 cells
# .84.
_REGISTER_GIB = 0.65
_SIMULATE_GIB, _SIMULATE_GIB_PER_CELL = 0.2, 1.0 / 79e3
_COMPARE_GIB, _OTHER_GIB = 1.0, 1.5  # a comparison: of it, and of each of its processes
_BYTES_VOXEL, _MB_MODEL = 40.0, 40.0
_USUAL_CELLS = 60e3
_MANY_CELLS = 2e5  # that are warned of
_GIB = 1024.0**3


def sizes_of(study: Study) -> tuple[float, float]:
    """Number of voxels of the unloaded image, and approximate number of cells for the simulations (0 if there is none).

    If a file cannot be read, typical numbers are used; the stages that read the file report the error.
    """
    try:
        reference, how = read_image(study.path(study.images.load0), allow_missing=True), study.mesh
        voxels = float(np.prod(reference.grid.shape))
        drawn = drawn_to_mesh(study)
        if not study.models.sets:
            return voxels, 0.0
        if how.file is not None:
            return voxels, float(len(mesh_given(study).cells))
        if drawn is None:  # a label map will be made: as of a body of one tissue
            body = tissue_mask(reference).inside.astype(np.int64)
            labels = LabelMap(reference.grid, body, {1: "tissue"})
        else:
            labels = read_labels(*drawn)
    except (InputError, OSError):
        return USUAL_VOXELS, _USUAL_CELLS
    return voxels, cells_of(labels, bones_of(labels, how.bones), how.edge_mm)


def seconds_of(stage: Stage, study: Study, voxels: float, cells: float) -> float:
    """Approximate time of a stage on one core, s; ``voxels`` of the unloaded image, ``cells`` of the mesh."""
    loads = len(study.loads)
    if stage.kind in ("register", "level"):
        parts = registration_s(_cost(study), voxels, twin=bool(stage.arguments.get("twin")))
        return sum(parts.values()) * (1.5 if stage.kind == "level" else 1.0)
    if stage.kind == "mesh":
        return mesh_s(cells) * (_COARSER_MESH if stage.name == COARSE else 1.0)
    if stage.kind == "label":
        return label_s(voxels)
    if stage.kind == "compare":
        models = len(set(stage.some.get("models", {}).values()))
        return sum(comparison_s([models + len(study.models.results)] * loads).values())
    if stage.kind not in ("simulate", "vary"):
        return loads * load_s(cells)
    (one,) = stage.arguments["sets"]
    seconds = loads * load_s(cells, study.models.element, material_set(one))
    if stage.kind == "vary":
        whole, short = study.uncertainty.solutions
        seconds *= (whole + _SHORT * short) * (_COARSER if stage.arguments["coarse"] else 1.0)
    paths = paths_of([LoadStep(**load) for load in stage.arguments["loads"]], stage.arguments["towards"])
    limit = stage.arguments["limit_s"]
    return _SIMULATE_S + (seconds if limit is None else min(seconds, len(paths) * limit))


def gib_of(stage: Stage, study: Study, voxels: float, cells: float) -> float:
    """Approximate memory of a stage, GiB, all its processes together; parameters as in `seconds_of`."""
    if stage.kind in ("register", "level"):
        cost = _cost(study)
        return _REGISTER_GIB + cost.gib + cost.gib_per_mvoxel * voxels / 1e6
    if stage.kind in ("simulate", "vary", "drive"):
        times = _ELEMENT_GIB["P1" if stage.kind == "drive" else study.models.element]
        return _SIMULATE_GIB + times * _SIMULATE_GIB_PER_CELL * cells
    if stage.kind == "compare":
        return _COMPARE_GIB * (1 + min(len(study.loads), usable_cores()))
    return _OTHER_GIB


def disk_bytes(stage: Stage, study: Study, voxels: float) -> float:
    """Approximate disk space for the results of a stage; parameters as in `seconds_of`."""
    images = _BYTES_VOXEL * voxels if stage.kind in ("label", "register", "level") else 0.0
    loads = len(study.loads)
    further = 2 * loads * sum(study.uncertainty.solutions) // 5  # on a coarser mesh
    models = {"label": 0, "register": 0, "level": 1, "mesh": 1, "vary": further}.get(stage.kind, loads)
    return images + 1e6 * _MB_MODEL * models


def expected(left: Sequence[Stage], study: Study, voxels: float, cells: float) -> dict[str, Expected]:
    """Expected time of each stage, by name; other parameters as in `seconds_of`."""
    told: dict[str, Expected] = {}
    for stage in left:
        cores = usable_cores() if stage.kind == "compare" else 1
        told[stage.name] = Expected(seconds_of(stage, study, voxels, cells) / cores, cores, stage.before, stage.kind)
    return told


def mesh_given(study: Study) -> TetMesh:
    """The mesh file that a study names."""
    return read_tet_mesh(mesh_place(study), unit=study.mesh.mesh_unit, frame=study.mesh.mesh_frame)


def _cost(study: Study) -> Cost:
    return engine_of(study.registration.located(study.place), labelled=True).cost


def costs(
    study: Study, stages: Sequence[Stage], left: Sequence[Stage], voxels: float, cells: float, workers: int
) -> tuple[list[str], list[str]]:
    """Approximate time, memory and disk space of the stages that are ``left``, and warnings if there is too little.

    ``workers`` is the number of stages at the same time; the other parameters are as in `seconds_of`.
    """
    time = duration(TimeLeft(expected(left, study, voxels, cells), workers).seconds())
    gib = sorted((gib_of(stage, study, voxels, cells) for stage in left), reverse=True)
    needed = sum(gib[:workers])  # the largest stages may run at the same time
    disk = sum(disk_bytes(stage, study, voxels) for stage in left) / _GIB
    free = shutil.disk_usage(study.place).free / _GIB
    lines = [
        f"To do: {len(left)} of {len(stages)} stages, about {time} on {workers} cores if they are idle, "
        f"{needed:.1f} GiB of memory, {disk:.1f} GiB of disk space ({free:.0f} GiB free)."
    ]
    if further := [stage for stage in left if stage.kind == "vary" or stage.name == COARSE]:
        added = duration(sum(seconds_of(stage, study, voxels, cells) for stage in further) / workers)
        lines.append(
            f"Of these, {len(further)} stages give the input uncertainty of the models and take about {added}; "
            "`mrstrain run --quick` skips them."
        )
    warnings = ["there is too little free disk space."] if disk > free else []
    if cells > _MANY_CELLS and any(stage.name == "mesh" for stage in left):
        warnings.append(
            f"the mesh will have about {round(cells, -4):,.0f} cells (edge length {study.mesh.edge_mm:g} mm), which "
            "takes long to make and to simulate; 80,000 are enough for a first look at a heel. For fewer, give a "
            "larger edge_mm under [mesh], such as 4, or a label map with larger voxels."
        )
    there = usable_memory_bytes()
    if there is not None and needed > there / _GIB:
        fitting = sum(np.cumsum(gib[:workers]) <= there / _GIB)
        smaller = "a single stage needs more. Crop the images, use a coarser mesh, or a machine with more memory."
        advice = f"run with workers={fitting} (--workers {fitting})." if fitting else smaller
        warnings.append(f"this machine has {there / _GIB:.1f} GiB of memory; {advice}")
    return lines, warnings
