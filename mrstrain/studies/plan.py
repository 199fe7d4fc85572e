"""The stages of a study: inputs, outputs and dependencies of each."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dvc.errors import InputError
from dvc.file_names import clash
from dvc.io.result_folder import REPEAT
from fe import BONE, LoadStep, material_set
from mrstrain.comparison.drive import ENDING
from mrstrain.comparison.model_files import files_named
from mrstrain.options.measurement import EngineOptions, command_parts
from mrstrain.options.modelling import Directions, MeshCoordinates, Meshing, PlateOptions, SimulationOptions
from mrstrain.records.inputs import made_beside
from mrstrain.studies.file import Study
from validate import LEVELLED

KINDS = ("label", "register", "mesh", "simulate", "vary", "drive", "level", "compare")
"""Kinds of stages, in their order."""

REGISTRATION, MODELS, COMPARISON, MESH = "registration", "models", "comparison", "mesh/mesh.vtu"
VARIANTS, COARSE_MESH, COARSE = "variants", "mesh-coarse/mesh.vtu", "mesh coarse"


@dataclass(frozen=True, slots=True)
class Stage:
    """A unit of work: a call of the function of its kind in `mrstrain.studies.stages`.

    ``some`` maps an argument to stages of which at least one is needed, ``perhaps`` to optional stages. The argument is
    the list of the values of those stages that succeeded.
    """

    name: str  # its kind and object: "register Load1"
    arguments: Mapping[str, Any]  # plain values and paths
    files: tuple[Path, ...]  # input files that no other stage makes, compared by content
    gives: tuple[Path, ...]  # everything that it writes; removed before it is run again
    after: tuple[str, ...] = ()  # stages that it requires
    some: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    perhaps: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def kind(self) -> str:
        """One of KINDS."""
        return self.name.split(" ", 1)[0]

    def is_one_of(self, chosen: Sequence[str]) -> bool:
        """Whether its name or its kind is among those chosen."""
        return self.name in chosen or self.kind in chosen

    @property
    def goes_on(self) -> bool:
        """Whether it resumes after an interruption by itself, using only results that are still valid."""
        return self.kind in ("simulate", "vary")

    @property
    def before(self) -> tuple[str, ...]:
        """Every stage that it waits for."""
        chosen = (name for of in (*self.some.values(), *self.perhaps.values()) for name in of)
        return tuple(dict.fromkeys((*self.after, *chosen)))


def plan(study: Study) -> tuple[Stage, ...]:
    """The stages of a study, in the order of their dependencies.

    InputError if two material sets or models would share a folder, a simulated load has no force, or a forward-model
    comparison has no bone.
    """
    stages = [*_labelling(study), *_registrations(study)]
    measured = {f"register {load}": load for load in study.loads}
    models: dict[str, Path] = {}
    variants: dict[str, Path] = {}
    if study.models.sets and study.mesh.file is None:
        stages.append(_mesh(study))
        if coarser(study):
            stages.append(_mesh(study, study.uncertainty.mesh))
    for one in study.models.sets:
        own = [_simulation(study, one)]
        folder = own[0].gives[0]
        if study.uncertainty.solves:
            own.append(_variation(study, own[0]))
            variants[own[-1].name] = own[-1].gives[0]
        if study.models.drive:
            driven, dvc = study.out / MODELS / (folder.name + ENDING), {"dvc": study.out / REGISTRATION}
            own.append(_on_mesh(study, f"drive {folder.name}", one, driven, dvc, {"loads": measured}))
        earlier = dict.fromkeys(place.name for place in models.values())
        if twice := clash([*earlier, *(stage.gives[0].name for stage in own if stage.kind != "vary")]):
            raise InputError(f"[models] sets: two material sets are named {twice}; rename one.")
        models |= {stage.name: stage.gives[0] for stage in own if stage.kind != "vary"}
        if study.models.level:
            own += [_levelled(study, folder, load) for load in load_steps(study)]
            models |= {stage.name: stage.gives[0].parent for stage in own if stage.kind == "level"}
        stages += own
    if models or study.models.results:
        stages.append(_comparison(study, measured, models, variants))
    _refuse_mixing(study, stages)
    return tuple(stages)


def _refuse_mixing(study: Study, stages: Sequence[Stage]) -> None:
    """InputError if a result would be outside the results folder or in that of another stage, or overwrite an input."""
    out = study.out.resolve()
    made: dict[Path, str] = {}
    for stage in stages:
        for real in (place.resolve() for place in stage.gives):
            if out not in real.parents:
                raise InputError(f"{stage.name} would write to {real}, which is not below the results folder {out}.")
            near = [name for other, name in made.items() if _one_in_the_other(real, other)]
            if near:
                raise InputError(f"{stage.name} and {near[0]} would both write to {real}; rename one of them.")
            made[real] = stage.name
        for path in stage.files:
            if _one_in_the_other(path.resolve(), out):
                raise InputError(
                    f"{path} is an input, and results in {out} could overwrite it. Move the input, or choose another "
                    "results folder ([study] out)."
                )


def _one_in_the_other(one: Path, other: Path) -> bool:
    return one.is_relative_to(other) or other.is_relative_to(one)


def _labelling(study: Study) -> list[Stage]:
    """The stage that makes the label map from the image, if one is to be made."""
    if not study.makes_labels:
        return []
    images = study.images.located(study.place)
    masks = {name: getattr(images, name) for name in ("bone", "tissue", "marks", "mark_names")}
    labels, files = study.labels[0], [images.load0, *masks.values()]
    if study.drawn_labels is not None:
        masks = dict(zip(("labels", "names"), study.drawn_labels, strict=True))
        files = [images.load0, *study.drawn_labels]
    elif images.labels_command is not None:
        command, place = images.labels_command, images.load0.parent
        # A command may begin with a path, whose folders do not count: its hash tells one from another.
        digest = hashlib.sha256(command.encode()).hexdigest()
        masks = {"command": command, "sha256": digest, "names": images.names}
        named = [file for part in command_parts(command) if (file := place / part).is_file()]
        files = [images.load0, images.names, *named]
    return [Stage("label", {"load0": images.load0, **masks, "out": labels}, study.given(files), (labels.parent,))]


def _labelled(study: Study) -> tuple[str, ...]:
    """The stage that a stage which reads the label map waits for."""
    return ("label",) if study.makes_labels else ()


def _registrations(study: Study) -> list[Stage]:
    images, how, subject = study.images, study.registration.located(study.place), study.subject_files
    load0, folder = study.path(images.load0), study.out / REGISTRATION
    shared = {
        "load0": load0, **subject.model_dump(), **how.model_dump(), "allow_missing": images.allow_missing,
        "seed": study.study.seed, "threads": 1,
    }  # fmt: skip
    places = {} if images.repeat is None else {REPEAT: study.path(images.repeat)}
    places |= {name: study.path(load.image) for name, load in study.loads.items()}
    stages: list[Stage] = []
    last: str | None = None
    for load, place in places.items():
        normal, shear = study.directions.get(load, (study.plate.plate_normal, study.plate.shear_direction))
        own = {
            "load": place, "out": folder / load, "after": None if last is None else folder / last,
            "chain": last is not None, "twin": how.twin and load != REPEAT, "plate_normal": normal,
            "shear_direction": shear,
        }  # fmt: skip
        floor = {f"register {REPEAT}": folder / REPEAT} if load != REPEAT and images.repeat is not None else {}
        stages.append(
            Stage(
                f"register {load}", shared | own, study.given([load0, *subject.paths, *how.paths, place]),
                (folder / load,), (*_labelled(study), *(() if last is None else (f"register {last}",))),
                perhaps={"repeat": floor},
            )
        )  # fmt: skip
        last = load if how.chain and load != REPEAT else None
    return stages


def mesh_place(study: Study) -> Path:
    """The mesh for the simulations: made by the stage "mesh", or a given file."""
    return study.out / MESH if study.mesh.file is None else study.path(study.mesh.file)


def drawn_to_mesh(study: Study) -> tuple[Path, Path | None] | None:
    """The label map that is meshed, before it is corrected, with its names; None if it is to be made."""
    return study.drawn_labels if study.mesh.labels is None else labels_to_mesh(study)


def labels_to_mesh(study: Study) -> tuple[Path, Path | None]:
    """The label map that is meshed, and the table of its names."""
    if study.mesh.labels is None:
        return study.labels
    return study.path(study.mesh.labels), study.optional_path(study.mesh.names)


def coarser(study: Study) -> bool:
    """Whether a coarser mesh is made for the variants; a given mesh has none."""
    return study.uncertainty.solves and bool(study.uncertainty.mesh) and study.mesh.file is None


def _mesh(study: Study, ratio: float | None = None) -> Stage:
    """The stage that makes the mesh, or one with edges that are longer by a ratio."""
    labels, names = labels_to_mesh(study)
    out = study.out / (MESH if ratio is None else COARSE_MESH)
    arguments = {
        "out": out, "labels": labels, "names": names, "bones": study.mesh.bones,
        **study.mesh.narrowed(Meshing).model_dump(),
    } | ({} if ratio is None else {"ratio": ratio})  # fmt: skip
    after = _labelled(study) if study.mesh.labels is None else ()
    return Stage("mesh" if ratio is None else COARSE, arguments, study.given([labels, names]), (out.parent,), after)


def _variation(study: Study, simulation: Stage) -> Stage:
    """The stage that solves a material set with one input changed, by the stage that simulates it."""
    (folder,) = simulation.gives
    coarse = study.out / COARSE_MESH if coarser(study) else None
    spread = study.uncertainty.model_dump(exclude={"variants", "quick"})
    labels, names = labels_to_mesh(study)
    out = study.out / VARIANTS / folder.name
    own = {
        "out": out, "base": folder, "coarse": coarse, "labels": labels, "names": names,
        "uncertainty": spread,
    }  # fmt: skip
    after = dict.fromkeys((*simulation.after, *((COARSE,) if coarse else (simulation.name,)), *_labelled(study)))
    beside = made_beside(labels) if study.given([labels]) else ()
    files = (*simulation.files, *study.given([labels, names]), *beside)
    return Stage(f"vary {folder.name}", {**simulation.arguments, **own}, files, (out,), tuple(after))


def _on_mesh(
    study: Study, name: str, one: str, folder: Path, arguments: Mapping[str, Any], some: Mapping[str, Any]
) -> Stage:
    """A stage that simulates a material set on the mesh."""
    files = [study.path(one)] if one.endswith(".toml") else []
    if study.mesh.file is not None:
        mesh = mesh_place(study)
        files += [mesh, *(p for p in (mesh.with_suffix(".json"),) if p.is_file())]  # with the names of its regions
    shared = {
        "out": study.out / MODELS, "mesh": mesh_place(study), **study.mesh.narrowed(MeshCoordinates).model_dump(),
        "sets": (study.set_given(one),),
    }  # fmt: skip
    after = ("mesh",) if study.mesh.file is None else ()
    return Stage(name, {**arguments, **shared}, tuple(files), (folder,), after, some)


def _simulation(study: Study, one: str) -> Stage:
    name = material_set(study.set_given(one)).name
    steps = load_steps(study)
    arguments = {
        **study.models.narrowed(SimulationOptions).model_dump(), **study.plate.narrowed(PlateOptions).model_dump(),
        "fixed": tuple(dict.fromkeys((BONE, *study.models.fixed))), "loads": [asdict(step) for step in steps.values()],
        "towards": {name: study.directions[name] for name in steps},
    }  # fmt: skip
    return _on_mesh(study, f"simulate {name}", one, study.out / MODELS / name, arguments, {})


def load_steps(study: Study) -> dict[str, LoadStep]:
    """The simulated loads: those with a force or a plate displacement along the normal.

    InputError if a load has only a shear, or both a force and a displacement along one axis, or if no load has any.
    """
    steps, lacking = {}, list[str]()
    for name, load in study.loads.items():
        if (load.normal_n, load.normal_mm) != (None, None):
            steps[name] = LoadStep(name, load.normal_n, load.shear_n, load.normal_mm, load.shear_mm)
        elif (load.shear_n, load.shear_mm) != (None, None):
            lacking.append(name)
    if steps and not lacking:
        return steps
    places = [study.at(f"loads.{name}", "normal_n") for name in lacking or study.loads]
    told = (
        "Shear needs a normal force or plate displacement as well. Give normal_n (N) or normal_mm (mm) in these lines:"
        if lacking
        else "No load has a normal force or plate displacement, so nothing can be simulated. Give normal_n (N) or "
        "normal_mm (mm) in at least one of these lines, or remove `sets` from [models] to measure only:"
    )
    raise InputError("\n  ".join([told, *places]))


def _levelled(study: Study, folder: Path, load: str) -> Stage:
    if study.bone is None and study.images.bone is None:
        raise InputError("[models] level = true needs a rigid bone: give bone or bone_mask in [images].")
    engine, subject = study.registration.located(study.place).narrowed(EngineOptions), study.subject_files
    load0 = study.path(study.images.load0)
    arguments = {
        "load0": load0, **subject.model_dump(), **engine.model_dump(), "seed": study.study.seed,
        "out": study.out / MODELS, "model": folder, "load": load,
    }  # fmt: skip
    gives = (folder.with_name(folder.name + LEVELLED) / f"{load}.vtu",)
    own = study.given([load0, *subject.paths, *engine.paths])
    after = (*_labelled(study), f"simulate {folder.name}")
    return Stage(f"level {folder.name} {load}", arguments, own, gives, after)


def _comparison(
    study: Study, measured: Mapping[str, str], models: Mapping[str, Path], variants: Mapping[str, Path]
) -> Stage:  # fmt: skip
    how = study.compare.located(study.place)
    labels, names = study.labels
    elsewhere = [study.path(place) for place in study.models.results]
    simulated = dict.fromkeys(place.name for place in models.values())
    if twice := clash([*simulated, *(place.name for place in elsewhere)]):
        raise InputError(f"[models] results: a folder and another model are named {twice}; rename the folder.")
    arguments = {
        "dvc": study.out / REGISTRATION, "out": study.out / COMPARISON, "labels": labels, "names": names,
        "bones": study.mesh.bones, **study.plate.narrowed(Directions).model_dump(), "towards": study.directions,
        **how.model_dump(), "elsewhere": elsewhere,
    }  # fmt: skip
    given = [study.path(place) for place in study.uncertainty.variants]
    arguments |= {"variants_elsewhere": given} if given else {}
    arguments |= {"quick": True} if study.uncertainty.quick else {}
    arguments |= {"unfinished": True} if study.models.unfinished else {}
    named = [file for place in elsewhere if place.exists() for file in files_named(place)]
    files = study.given([labels, names, *how.paths, *elsewhere, *named, *given])
    some = {"loads": measured} | ({"models": models} if models else {})
    perhaps = {"variants": variants} if variants else {}
    return Stage("compare", arguments, files, (study.out / COMPARISON,), _labelled(study), some, perhaps)
