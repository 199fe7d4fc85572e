"""A study as stages: what each makes, from which files and numbers, and which others it waits for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dvc.errors import InputError
from dvc.io.result_folder import REPEAT
from fe import BONE, LoadStep, material_set
from mrstrain.comparison.drive import ENDING
from mrstrain.comparison.model_files import files_named
from mrstrain.options.measurement import EngineOptions
from mrstrain.options.model import Vector
from mrstrain.options.modelling import Directions, MeshCoordinates, Meshing, PlateOptions, SimulationOptions
from mrstrain.studies.file import Study, as_folder
from validate import LEVELLED

KINDS = ("register", "mesh", "simulate", "drive", "level", "compare")
"""Kinds of stages, in the order in which they come."""

REGISTRATION, MODELS, COMPARISON, MESH = "registration", "models", "comparison", "mesh/mesh.vtu"


@dataclass(frozen=True, slots=True)
class Stage:
    """One piece of work: a call of the function of its kind in `mrstrain.studies.stages`.

    ``some`` maps an argument to stages at least one of which it needs, and ``perhaps`` to stages that it can do
    without; the argument lists the value that stands beside each stage that succeeded.
    """

    name: str  # its kind and object: "register Load1"
    arguments: Mapping[str, Any]  # plain values
    files: tuple[Path, ...]  # what it reads that no other stage makes, by content
    gives: tuple[Path, ...]  # everything that it makes: removed before it is made again
    after: tuple[str, ...] = ()  # stages that it cannot do without
    some: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    perhaps: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """One of KINDS."""
        return self.name.split(" ", 1)[0]

    @property
    def goes_on(self) -> bool:
        """Whether it finds by itself what it did before it was cut, and takes of that only what still holds."""
        return self.kind == "simulate"

    @property
    def before(self) -> tuple[str, ...]:
        """Every stage that it waits for."""
        chosen = (name for of in (*self.some.values(), *self.perhaps.values()) for name in of)
        return tuple(dict.fromkeys((*self.after, *chosen)))


def plan(study: Study) -> tuple[Stage, ...]:
    """The stages of a study, each after those that it waits for.

    InputError is raised if two material sets or models would share a folder, a load that is simulated has no force, or
    a forward-model comparison has no bone.
    """
    stages = _registrations(study)
    loads = tuple(study.loads)
    measured = {f"register {load}": load for load in loads}
    models: dict[str, str] = {}
    if study.models.sets:
        meshed = _mesh(study)
        stages += meshed
        for one in study.models.sets:
            simulated = _simulation(study, one, tuple(stage.name for stage in meshed))
            folder = simulated.gives[0]
            if str(folder) in models.values():
                raise InputError(f"[models] two sets are called '{folder.name}'; each needs a name of its own.")
            stages.append(simulated)
            models[simulated.name] = str(folder)
            if study.models.drive:
                stages.append(_driven(study, one, folder.name, tuple(stage.name for stage in meshed), measured))
                models[stages[-1].name] = str(stages[-1].gives[0])
            if study.models.level:
                for load in load_steps(study):
                    stages.append(_levelled(study, folder, load))
                    models[stages[-1].name] = str(folder) + LEVELLED
    if models or study.models.results:
        stages.append(_comparison(study, measured, models))
    _refuse_mixing(study, stages)
    return tuple(stages)


def _refuse_mixing(study: Study, stages: Sequence[Stage]) -> None:
    """Refuse results outside the results' folder or in one another's, and inputs in it: they would be replaced."""
    out = study.out.resolve()
    made: dict[Path, str] = {}
    for stage in stages:
        for place in stage.gives:
            real = place.resolve()
            if out not in real.parents:
                raise InputError(f"{stage.name} would write to {real}, which is not below the results {out}.")
            near = [other for other in made if other == real or other in real.parents or real in other.parents]
            if near:
                raise InputError(f"{stage.name} and {made[near[0]]} would both write to {real}: rename one.")
            made[real] = stage.name
        for path in stage.files:
            real = path.resolve()
            if real == out or out in real.parents or real in out.parents:
                raise InputError(
                    f"{path} is an input and lies in the folder of the results ({out}), or that in it: results would "
                    "replace it. Move it, or give another [study] out."
                )


def _registrations(study: Study) -> list[Stage]:
    images = study.images
    how, subject = study.registration.located(study.place), study.subject_files
    load0 = study.path(images.load0)
    shared: dict[str, Any] = {
        "load0": str(load0), **subject.plain(), **how.plain(), **_directions(study),
        "allow_missing": images.allow_missing, "seed": study.study.seed, "threads": 1,
    }  # fmt: skip
    files = (load0, *subject.paths, *how.paths)
    folder, own_directions = study.out / REGISTRATION, towards(study)

    def one(load: str, image: str | Path, repeat: bool, after: str | None) -> Stage:
        place = study.path(image)
        more: dict[str, Any] = {
            "load": str(place), "out": str(folder / load), "after": None if after is None else str(folder / after),
            "chain": after is not None, "twin": how.twin and load != REPEAT,
        }  # fmt: skip
        if load in own_directions:
            more["plate_normal"], more["shear_direction"] = own_directions[load]
        waits = () if after is None else (f"register {after}",)
        floor = {"repeat": {f"register {REPEAT}": str(folder / REPEAT)} if repeat else {}}
        return Stage(f"register {load}", shared | more, (*files, place), (folder / load,), waits, {}, floor)

    stages = [] if images.repeat is None else [one(REPEAT, images.repeat, False, None)]
    last: str | None = None
    for name, load in study.loads.items():
        stages.append(one(name, load.image, images.repeat is not None, last if how.chain else None))
        last = name
    return stages


def _directions(study: Study) -> dict[str, Vector]:
    return study.plate.narrowed(Directions).model_dump()


def mesh_place(study: Study) -> Path:
    """The mesh on which sets are simulated: one made here, or a file."""
    return study.out / MESH if study.mesh.file is None else study.path(study.mesh.file)


def labels_to_mesh(study: Study) -> tuple[Path, Path | None]:
    """The label map that is meshed, and the table of its names."""
    of = study.mesh if study.mesh.labels else study.images
    return study.path(of.labels or ""), study.optional_path(of.names)


def _mesh(study: Study) -> list[Stage]:
    if study.mesh.file is not None:
        return []
    labels, names = labels_to_mesh(study)
    arguments = {
        "out": str(study.out / MESH), "labels": str(labels), **study.mesh.narrowed(Meshing).plain(),
        "names": None if names is None else str(names), "bones": study.mesh.bones,
    }  # fmt: skip
    files = (labels,) if names is None else (labels, names)
    return [Stage("mesh", arguments, files, ((study.out / MESH).parent,))]


def _own(study: Study, one: str) -> tuple[Path, ...]:
    own = [study.path(one)] if one.endswith(".toml") else []
    if study.mesh.file is None:
        return tuple(own)
    mesh = study.path(study.mesh.file)
    return (*own, mesh, *(p for p in (mesh.with_suffix(".json"),) if p.is_file()))  # names of regions stand beside it


def _simulation(study: Study, one: str, meshed: tuple[str, ...]) -> Stage:
    name = material_set(study.set_given(one)).name
    try:
        as_folder(name)
    except ValueError as wrong:
        raise InputError(f"The material set '{name}' of {one} needs {wrong}.") from wrong
    steps = load_steps(study)
    arguments = {
        "out": str(study.out / MODELS), "mesh": str(mesh_place(study)), **study.mesh.narrowed(MeshCoordinates).plain(),
        **study.models.narrowed(SimulationOptions).plain(), **study.plate.narrowed(PlateOptions).model_dump(),
        "sets": (study.set_given(one),), "fixed": tuple(dict.fromkeys((BONE, *study.models.fixed))),
        "loads": [asdict(step) for step in steps.values()],
        "towards": {name: of for name, of in towards(study).items() if name in steps},
    }  # fmt: skip
    return Stage(f"simulate {name}", arguments, _own(study, one), (study.out / MODELS / name,), meshed)


def towards(study: Study) -> dict[str, tuple[Vector, Vector]]:
    """Plate's normal and direction of shear of the loads that go in directions of their own."""
    plate = study.plate
    return {
        name: (load.plate_normal or plate.plate_normal, load.shear_direction or plate.shear_direction)
        for name, load in study.loads.items()
        if load.plate_normal is not None or load.shear_direction is not None
    }


def load_steps(study: Study) -> dict[str, LoadStep]:
    """The loads that are simulated: those with a force or a plate displacement along the normal.

    InputError is raised if a load has only a shear, or force and displacement along one axis, or no load has any.
    """
    steps = {}
    for name, load in study.loads.items():
        if (load.normal_n, load.normal_mm) == (None, None):
            if (load.shear_n, load.shear_mm) != (None, None):
                raise InputError(f"[loads.{name}] normal_n is missing: a plate that shears has to press.")
            continue
        steps[name] = LoadStep(name, load.normal_n, load.shear_n, load.normal_mm, load.shear_mm)
    if not steps:
        first = next(iter(study.loads))
        raise InputError(f"[loads.{first}] normal_n is missing: no load has a force to simulate [models] sets under.")
    return steps


def _driven(study: Study, one: str, name: str, meshed: tuple[str, ...], measured: Mapping[str, str]) -> Stage:
    arguments = {
        "out": str(study.out / MODELS), "mesh": str(mesh_place(study)), "dvc": str(study.out / REGISTRATION),
        "sets": (study.set_given(one),), **study.mesh.narrowed(MeshCoordinates).plain(),
    }  # fmt: skip
    gives = (study.out / MODELS / (name + ENDING),)
    return Stage(f"drive {name}", arguments, _own(study, one), gives, meshed, {"loads": measured})


def _levelled(study: Study, folder: Path, load: str) -> Stage:
    if study.bone is None and study.images.bone is None:
        raise InputError("[models] level = true needs a bone, where models are at rest: [images] bone, or bone_mask.")
    engine, subject = study.registration.located(study.place).narrowed(EngineOptions), study.subject_files
    load0 = study.path(study.images.load0)
    arguments = {
        "load0": str(load0), **subject.plain(), **engine.plain(), "seed": study.study.seed,
        "out": str(study.out / MODELS), "model": str(folder), "load": load,
    }  # fmt: skip
    gives = (folder.with_name(folder.name + LEVELLED) / f"{load}.vtu",)
    own = (load0, *subject.paths, *engine.paths)
    return Stage(f"level {folder.name} {load}", arguments, own, gives, (f"simulate {folder.name}",))


def _comparison(study: Study, measured: Mapping[str, str], models: Mapping[str, str]) -> Stage:
    how = study.compare.located(study.place)
    labels = study.path(study.images.labels)
    names = study.optional_path(study.images.names)
    elsewhere = [study.path(place) for place in study.models.results]
    taken = {Path(place).name for place in models.values()}
    twice = [place.name for place in elsewhere if place.name in taken]
    if twice:
        raise InputError(f"[models] a folder of results and a set are both called '{twice[0]}': rename the folder.")
    arguments = {
        "dvc": str(study.out / REGISTRATION), "out": str(study.out / COMPARISON), "labels": str(labels),
        "names": None if names is None else str(names), "bones": study.mesh.bones,
        **_directions(study), "towards": towards(study), **how.plain(),
        "elsewhere": [str(place) for place in elsewhere],
    }  # fmt: skip
    named = [file for place in elsewhere if place.exists() for file in files_named(place)]
    files = [p for p in (labels, names, *how.paths, *elsewhere, *named) if p is not None]
    some: dict[str, Mapping[str, str]] = {"loads": measured}
    if models:
        some["models"] = models
    return Stage("compare", arguments, tuple(files), (study.out / COMPARISON,), (), some)
