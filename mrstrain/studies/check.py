"""`check`: every input of a study looked at, all that is wrong told at once, and what the run will take."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np

from dvc import Image, LabelMap, fit_mask, plate_axes, read_error_model, read_image, read_labels, read_mask
from dvc.errors import InputError, MrstrainError
from dvc.io.result_folder import REPEAT
from dvc.measurement.subject import is_bones_name
from dvc.trust.error_model import error_model_of
from dvc.worker import usable_cores
from fe import LoadStep, MaterialSet, Plate, Problem, check_loads, check_meshing, fixed_facets, material_set
from mrstrain.comparison.model_files import Reading, model_files
from mrstrain.measurement.engines import engine_of
from mrstrain.options.model import Vector
from mrstrain.studies.costs import costs, mesh_given, sizes_of
from mrstrain.studies.file import Study, read_study
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.pipeline import Pipeline
from mrstrain.studies.plan import Stage, labels_to_mesh, load_steps, plan, towards
from validate import check_bones, check_overlap, read_thresholds

_T = TypeVar("_T")
_THERE = 0.5  # of what a label map labels: less in the image, and it lies elsewhere
_P = ParamSpec("_P")


@dataclass(frozen=True, slots=True)
class Checked:
    """Result of `check`: everything that prevents the study from being run, and notes."""

    wrong: tuple[str, ...]
    notes: tuple[str, ...]

    def summary(self) -> list[str]:
        """A few lines for a person."""
        return [*self.notes, *(f"WRONG: {one}" for one in self.wrong)] or ["Nothing is wrong."]


@dataclass(slots=True)
class _Findings:
    """Results so far, as in `Checked`."""

    wrong: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def tried(self, read: Callable[_P, _T], *given: _P.args, **options: _P.kwargs) -> _T | None:
        """Result of a function; None if it raises an error, which is noted once."""
        try:
            return read(*given, **options)
        except (MrstrainError, OSError) as error:
            if str(error) not in self.wrong:
                self.wrong.append(str(error))
            return None


def check(study: Path | str, *, workers: int | None = None) -> Checked:
    """Read every input of a study, and tell all that is wrong and what a run will take.

    Parameters
    ----------
    study : path
        The study file, or its folder.
    workers : int, optional
        Stages at once, for time and memory; one for each core by default.

    Raises
    ------
    InputError
        If the study file itself cannot be read.
    """
    told, found = read_study(study), _Findings()
    reference, labels = _shared(told, found, None)
    _loaded(told, found, reference)
    if labels is not None and told.models.results:
        found.tried(_foreign, told, found, labels)
    planned = found.tried(plan, told)
    if planned is not None and not found.wrong:
        left = Pipeline(planned, Ledger(told.out, told.place)).to_do()
        found.notes += (
            costs(told, planned, left, *sizes_of(told), workers or usable_cores())
            if left
            else ["Everything is done already; a run only writes the report anew."]
        )
    return Checked(tuple(found.wrong), tuple(found.notes))


def wrong_with(study: Study, stages: Sequence[Stage]) -> tuple[str, ...]:
    """What some of these stages would fail by, but for their loaded images: each keeps only its own load."""
    found = _Findings()
    _shared(study, found, stages)
    return tuple(found.wrong)


def _shared(study: Study, found: _Findings, stages: Sequence[Stage] | None) -> tuple[Image | None, LabelMap | None]:
    """Look at what some stages need, or all (None), but loaded images; give the unloaded one, and the labels on it."""
    known = None if stages is None else {word for stage in stages for word in (stage.name, stage.kind)}

    def asked(*names_or_kinds: str) -> bool:
        return known is None or not known.isdisjoint(names_or_kinds)

    reference = found.tried(_image, study, study.images.load0) if asked("register", "level") else None
    if reference is not None:
        found.notes.append(f"Load0: {reference.grid}")
    labels = _labels(study, found, reference) if asked("register", "level", "compare") else None
    every, own = asked("simulate", "drive", "compare"), towards(study)
    shared = (study.plate.plate_normal, study.plate.shear_direction)
    loads = [load for load in study.loads if every or asked(f"register {load}")]
    for normal, shear in dict.fromkeys(own.get(load, shared) for load in loads):
        found.tried(plate_axes, -np.asarray(normal), shear)
    if asked("register", "level"):
        _registration(study, found, reference, labels)
    if study.models.sets and asked("mesh") and study.mesh.file is None:
        _meshing(study, found)
    if study.models.sets and asked("simulate", "drive"):
        sets = [found.tried(material_set, study.set_given(name)) for name in study.models.sets]
        chosen = [one for one in sets if one is not None and asked(f"simulate {one.name}", f"drive {one.name}")]
        _simulations(study, found, reference, chosen)
    if study.models.level and asked("level") and reference is not None and reference.missing.any():
        found.wrong.append("[models] level = true needs an unloaded image without voxels that are NaN or infinite.")
    if asked("compare"):
        if labels is not None and (study.models.sets or study.models.results):
            found.tried(check_bones, labels, study.mesh.bones)
        if study.compare.thresholds is not None:
            found.tried(read_thresholds, study.path(study.compare.thresholds))
    return reference, labels


def _labels(study: Study, found: _Findings, reference: Image | None) -> LabelMap | None:
    """Check the labels; returns them on the unloaded image's grid."""
    labels = found.tried(read_labels, study.path(study.images.labels), study.optional_path(study.images.names))
    if labels is not None:
        found.notes.append(f"Labels: {', '.join(labels.names.values())}")
        if reference is not None:
            labels = found.tried(fit_mask, labels, reference.grid, str(study.images.labels)) or labels
    return labels


def _loaded(study: Study, found: _Findings, reference: Image | None) -> None:
    """Look at the loaded images and the repeat scan."""
    others: dict[str, str | Path] = {load: one.image for load, one in study.loads.items()}
    if study.images.repeat is not None:
        others[REPEAT] = study.images.repeat
    hashes: dict[str, str] = {}
    for name, other in others.items():
        image = found.tried(_image, study, other)
        if image is None:
            continue
        found.notes.append(f"{name}: {image.grid}")
        same_grid = reference is not None and reference.grid.same_as(image.grid)
        if reference is not None and same_grid and np.array_equal(reference.values, image.values, equal_nan=True):
            found.wrong.append(f"{name} is the unloaded image: every voxel is equal.")
        twin = hashes.setdefault(hashlib.sha256(image.values.tobytes()).hexdigest(), name)
        if twin != name:
            found.wrong.append(f"{name} is the image of {twin}: every voxel is equal.")


def _registration(study: Study, found: _Findings, reference: Image | None, labels: LabelMap | None) -> None:
    """Look at bone and masks, engine, parameters and error model."""
    subject, how = study.subject_files, study.registration.located(study.place)
    if subject.bone_label is not None and labels is not None:
        found.tried(labels.region, subject.bone_label)
    for mask in (subject.bone, subject.tissue):
        if mask is not None and reference is not None:
            found.tried(read_mask, mask, reference.grid)
    engine = found.tried(engine_of, how, labelled=True)
    if engine is None:
        return
    own = how.error_model
    model = error_model_of(engine.name) if own is None else found.tried(read_error_model, own)
    if model is None:
        found.notes.append(f"{engine.name} has no error model: results will have no intervals (`mrstrain accuracy`).")
    elif model.preset != engine.name:
        found.notes.append(
            f"The error model is that of {model.preset}, and {engine.name} will be used: results will have no "
            f"intervals (`mrstrain accuracy --preset {engine.name}` makes one)."
        )


def _simulations(study: Study, found: _Findings, reference: Image | None, sets: Sequence[MaterialSet]) -> None:
    """Report what `simulate` would refuse."""
    given, own = study.plate, towards(study)
    by_direction: dict[tuple[Vector, Vector], list[LoadStep]] = {}
    forced = found.tried(load_steps, study) or {}
    for name, step in forced.items():
        by_direction.setdefault(own.get(name, (given.plate_normal, given.shear_direction)), []).append(step)
    forceless = [name for name in study.loads if forced and name not in forced]
    if forceless:
        found.notes.append(f"{', '.join(forceless)}: no force, so measured and not simulated.")
    loads: list[tuple[Plate, list[LoadStep]]] = []
    for directions, steps in by_direction.items():
        plate = found.tried(Plate, *directions, given.gap_mm, given.taped, given.turns, given.pivot_mm)
        if plate is not None:
            found.tried(check_loads, plate, steps)
            loads.append((plate, steps))
    if study.mesh.file is None:
        _on_labels(study, found, reference, sets)
        return
    mesh = found.tried(mesh_given, study, study.mesh.file)
    if mesh is None:
        return
    if reference is not None:
        found.tried(check_overlap, study.path(study.mesh.file), mesh, reference.grid)
    for one in sets:
        chosen = found.tried(one.for_regions, mesh.regions)
        if chosen is None:
            continue
        for plate, steps in loads:
            found.tried(Problem, mesh, chosen[0], plate, steps, fixed_facets(mesh, study.models.fixed))


def _meshing(study: Study, found: _Findings) -> None:
    """Check that the label map to be meshed has the regions that are named."""
    labels = found.tried(read_labels, *labels_to_mesh(study))
    if labels is not None:
        how = study.mesh
        found.tried(check_meshing, labels, how.edge_mm, how.bones, how.finer)
        found.notes += [
            f"CARE: {name} will be meshed as soft tissue, and is called as a bone is: [mesh] bones leaves it out."
            for name in _soft(study, labels)
            if is_bones_name(name)
        ]


def _on_labels(study: Study, found: _Findings, reference: Image | None, sets: Sequence[MaterialSet]) -> None:
    """Check that each set has a material for every meshed tissue, and that these lie where the images are."""
    fixed = {name.casefold() for name in study.models.fixed}
    unknown = fixed - {"bone", "cut"}
    if unknown:
        found.wrong.append(
            f"[models] fixed: beside the bone's surface the cut may be fixed; got {', '.join(sorted(unknown))}."
        )
    labels = found.tried(read_labels, *labels_to_mesh(study))
    if labels is None:
        return
    if reference is not None and study.mesh.labels is not None:
        there = float(reference.grid.contains(labels.grid.points(labels.labels > 0)).mean())
        if there < _THERE:
            found.wrong.append(
                f"{study.path(study.mesh.labels)}: only {there:.0%} of what it labels lies in the unloaded image. A "
                "mesh has to lie where the images are."
            )
    soft = _soft(study, labels)
    for one in sets:
        found.tried(one.for_regions, soft)
    if "cut" in fixed and "skin" not in {name.casefold() for name in soft}:
        found.wrong.append(
            "[models] fixed: 'cut' needs a tissue called skin in the label map, which tells it from the outer surface."
        )


def _soft(study: Study, labels: LabelMap) -> list[str]:
    """Names of the tissues that are meshed."""
    numbers = np.unique(labels.labels)
    return [name for n, name in labels.names.items() if n != 0 and n in numbers and name not in study.mesh.bones]


def _image(study: Study, given: str | Path) -> Image:
    place = study.path(given)
    if not place.exists():
        raise InputError(f"{place}: there is no such file.")
    return read_image(place, allow_missing=study.images.allow_missing)


def _foreign(study: Study, found: _Findings, labels: LabelMap) -> None:
    """Read every result of another code."""
    files, _ = model_files(list(study.loads), [study.path(p) for p in study.models.results], Reading())
    for of in files.values():
        for file in of:
            found.tried(file.read, labels.grid)
