"""`check`: every input of a study looked at, all that is wrong told at once, and what the run will take."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dvc.errors import InputError, MrstrainError
from dvc.image import Image, LabelMap
from dvc.imagefile import read_image
from dvc.kinematics import plate_axes
from dvc.labels import fit_mask, read_labels, read_mask
from dvc.uncertainty import error_model_of, read_error_model
from dvc.worker import usable_cores
from fe.meshstore import read_tet_mesh
from fe.published import material_set
from mrstrain.engines import settings_of
from mrstrain.ledger import Ledger
from mrstrain.modelfiles import Reading, model_files
from mrstrain.pipeline import Pipeline
from mrstrain.plan import Stage, plan
from mrstrain.registering import REPEAT
from mrstrain.studyfile import Study, read_study
from validate.location import read_thresholds

# Seconds on one core, as measured on the phantom heel (2.3 million voxels; 66,000 cells under four loads).
_REGISTER_S, _MAPS_S_PER_MVOXEL = 50.0, 7.0
_BORDERS = 2.5  # times as long with `borders = true` (docs/decisions/0009)
_CELLS, _LOAD_S, _GROWTH = 66e3, 70.0, 1.5
_MESH_S = 100.0
_COMPARE_S, _MODEL_S = 8.0, 4.0
_GB_STAGE, _BYTES_VOXEL, _MB_MODEL = 1.5, 40.0, 40.0
_SHAPE = 0.1  # volume of a cell over its edge cubed, as meshes come out


@dataclass(frozen=True, slots=True)
class Checked:
    """What `check` found.

    Attributes
    ----------
    wrong : tuple of str
        All that keeps the study from being run; empty where nothing does.
    notes : tuple of str
        What a person should know.
    """

    wrong: tuple[str, ...]
    notes: tuple[str, ...]

    def summary(self) -> list[str]:
        """A few lines for a person."""
        return [*self.notes, *(f"WRONG: {one}" for one in self.wrong)] or ["Nothing is wrong."]


def check(study: Path | str, *, workers: int | None = None) -> Checked:
    """Read every input of a study, and tell all that is wrong and what a run will take.

    Parameters
    ----------
    study : path
        The study file, or its folder.
    workers : int, optional
        Stages at once, for the time; one for each core by default.

    Raises
    ------
    InputError
        If the study file itself cannot be read.
    """
    told = read_study(study)
    wrong: list[str] = []
    notes: list[str] = []

    def tried(read: Callable[[], Any]) -> Any:
        try:
            return read()
        except (MrstrainError, OSError) as error:
            if str(error) not in wrong:
                wrong.append(str(error))
            return None

    images = told.images
    reference = tried(lambda: _image(told, images.load0))
    labels = tried(lambda: read_labels(told.path(images.labels), _optional(told, images.names)))
    if isinstance(labels, LabelMap):
        notes.append(f"Labels: {', '.join(labels.names.values())}")
        if isinstance(reference, Image):
            labels = tried(lambda: fit_mask(labels, reference.grid, images.labels)) or labels
        if images.bone_mask is None:
            tried(lambda: labels.region(images.bone))
    if isinstance(reference, Image):
        notes.insert(0, f"Load0: {reference.grid}")
        for given in (images.bone_mask, images.tissue):
            if given is not None:
                tried(lambda given=given: read_mask(told.path(given), reference.grid))  # type: ignore[misc]
    others = {load: one.image for load, one in told.loads.items()}
    if images.repeat is not None:
        others[REPEAT] = images.repeat
    for name, given in others.items():
        image = tried(lambda given=given: _image(told, given))  # type: ignore[misc]
        if isinstance(image, Image):
            notes.append(f"{name}: {image.grid}")
            if isinstance(reference, Image) and _same(reference, image):
                wrong.append(f"{name} is the unloaded image: every voxel is equal.")
    how = told.registration
    settings = tried(
        lambda: settings_of(how.engine, how.preset, [told.path(p) for p in how.parameters], borders=how.borders)
    )
    if settings:
        own = how.error_model
        model = tried(lambda: error_model_of(settings.name) if own is None else read_error_model(told.path(own)))
        if how.borders:
            notes.append("With borders = true results will have no intervals: that error has not been measured yet.")
        elif model is None:
            notes.append(f"{settings.name} has no error model: results will have no intervals (`mrstrain accuracy`).")
    if told.compare.thresholds is not None:
        tried(lambda: read_thresholds(told.path(str(told.compare.thresholds))))
    for name in told.models.sets:
        tried(lambda name=name: material_set(told.set_given(name)))  # type: ignore[misc]
    if told.mesh.file is not None:
        tried(lambda: read_tet_mesh(told.path(str(told.mesh.file))))
    mapped = told.mesh.labels
    if mapped is not None:
        own_labels = tried(lambda: read_labels(told.path(mapped), _optional(told, told.mesh.names)))
        labels = own_labels if isinstance(own_labels, LabelMap) else labels
    if told.models.results and labels is not None:
        tried(lambda: _foreign(told, labels))
    tried(lambda: plate_axes(-np.asarray(told.plate.normal), told.plate.shear_direction))
    low, high = told.compare.strains
    if not 0.0 <= low < high:
        wrong.append(f"[compare] strains: the range rises from 0 or more; got {low:g} to {high:g}.")
    if isinstance(labels, LabelMap) and told.mesh.file is None:
        finer = [] if told.mesh.finer is None else [told.mesh.finer.region]
        for region in (*told.mesh.bones, *finer):
            tried(lambda region=region: labels.region(region))  # type: ignore[misc]
        unknown = set(told.models.fixed) - {"bone", "skin", "cut"}
        if unknown:
            wrong.append(
                f"[models] fixed: a mesh has the surfaces bone, skin and cut; got {', '.join(sorted(unknown))}."
            )
    planned = tried(lambda: plan(told))
    if planned and not wrong:
        notes += _cost(told, planned, reference, labels, workers or usable_cores())
    return Checked(tuple(wrong), tuple(notes))


def _image(study: Study, given: str) -> Image:
    place = study.path(given)
    if not place.exists():
        raise InputError(f"{place}: there is no such file.")
    return read_image(place)


def _optional(study: Study, given: str | None) -> Path | None:
    return None if given is None else study.path(given)


def _same(one: Image, other: Image) -> bool:
    return one.grid.same_as(other.grid) and np.array_equal(one.values, other.values, equal_nan=True)


def _foreign(study: Study, labels: LabelMap) -> None:
    """Read every result of another code."""
    files, _ = model_files(list(study.loads), [study.path(p) for p in study.models.results], Reading())
    for of in files.values():
        for file in of:
            file.read(labels.grid)


def _cost(study: Study, stages: tuple[Stage, ...], reference: Image, labels: LabelMap, workers: int) -> list[str]:
    """About how long the stages that are not finished take, and how much memory and disk."""
    told = Pipeline(stages, Ledger(study.out, study.place)).forecast()
    left = [stage for stage in stages if told[stage.name] == "run"]
    if not left:
        return ["Everything is done already; a run only writes the report anew."]
    voxels = float(np.prod(reference.grid.shape))
    seconds = {stage.name: _seconds(stage, study, voxels, labels) for stage in left}
    total = sum(seconds.values())
    longest = max(seconds.values())
    minutes = max(total / workers, longest) / 60.0
    loads = len(study.loads)
    models = sum(stage.kind in ("simulate", "drive") for stage in stages)
    disk = (_BYTES_VOXEL * voxels * (loads + 1) + 1e6 * _MB_MODEL * loads * (models + 1)) / 1e9
    free = shutil.disk_usage(study.place).free / 1e9
    lines = [
        f"To do: {len(left)} of {len(stages)} stages, about {minutes:.0f} minutes on {workers} cores, "
        f"{_GB_STAGE * min(workers, len(left)):.1f} GB of memory, {disk:.1f} GB on the disk ({free:.0f} GB free)."
    ]
    if disk > free:
        lines.append("CARE: the disk has too little room.")
    return lines


def _seconds(stage: Stage, study: Study, voxels: float, labels: LabelMap) -> float:
    loads = len(study.loads)
    registering = _REGISTER_S * (_BORDERS if study.registration.borders else 1.0) + _MAPS_S_PER_MVOXEL * voxels / 1e6
    if stage.kind == "register":
        return registering
    if stage.kind == "level":
        return 1.5 * registering
    if stage.kind == "mesh":
        return _MESH_S
    if stage.kind == "compare":
        models = len({value for of in (stage.some.get("models", {}),) for value in of.values()})
        return loads * (_COMPARE_S + _MODEL_S * (models + len(study.models.results)))
    soft = np.isin(labels.labels, [n for n, name in labels.names.items() if name not in study.mesh.bones and n != 0])
    volume = float(np.count_nonzero(soft)) * labels.grid.voxel_volume_mm3
    cells = volume / (_SHAPE * study.mesh.edge_mm**3)
    return float(loads * _LOAD_S * (max(cells, 0.9 * _CELLS) / _CELLS) ** _GROWTH)
