"""Every option is offered by the command line and by the study file, with one default, one check and a help."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from types import NoneType
from typing import Any, Literal, get_args, get_origin

import pytest
import typer
from typer.testing import CliRunner

import mrstrain
from dvc import Settings
from dvc.errors import InputError, ParameterError
from mrstrain.cli.app import app
from mrstrain.cli.options import _plain, takes_options
from mrstrain.options import measurement, modelling
from mrstrain.options.measurement import (
    BoneAndBody,
    Cores,
    EngineOptions,
    ExistingFiles,
    GivenLabels,
    Marks,
    MarksForAuto,
    MeshAndAxes,
    RecordedEngine,
    RecordedFiles,
    RegistrationOptions,
    Running,
    Scans,
    Seeded,
    SubjectFiles,
    Threads,
    in_parallel,
)
from mrstrain.options.model import Options
from mrstrain.options.modelling import (
    ComparisonDirections,
    ComparisonLabels,
    ComparisonOn,
    ComparisonOptions,
    Directions,
    Followed,
    HeelShape,
    Labelling,
    MaterialSets,
    MeshCoordinates,
    Meshing,
    ModelReading,
    PlateOptions,
    SimulationOptions,
)
from mrstrain.studies.file import Study, keys_of, read_study
from mrstrain.studies.plan import plan
from validate.curves import RANGE
from validate.location import LEAST_ML

COMMANDS: dict[str, tuple[type[Options], ...]] = {
    "label": (BoneAndBody, Marks, GivenLabels),
    "register": (SubjectFiles, MarksForAuto, RegistrationOptions, Scans, MeshAndAxes, Running),
    "strain": (ExistingFiles, MeshAndAxes),
    "phantom": (HeelShape,),
    "twin": (ExistingFiles,),
    "mesh": (Labelling, Meshing),
    "simulate": (SimulationOptions, PlateOptions, MeshCoordinates, Cores),
    "converge": (Labelling, Directions, Followed),
    "compare": (ComparisonLabels, ModelReading, ComparisonDirections, ComparisonOn),
    "drive": (MaterialSets, MeshCoordinates),
    "level": (RecordedFiles, RecordedEngine, ModelReading, Seeded),
}
TABLES: dict[type[Options], tuple[str, str]] = {  # table of the study file, and stage that its values reach
    SubjectFiles: ("images", "register Load1"),
    RegistrationOptions: ("registration", "register Load1"),
    EngineOptions: ("registration", "level name Load1"),
    PlateOptions: ("plate", "simulate name"),
    Directions: ("plate", "compare"),  # which takes them in its own model, all of them
    Labelling: ("mesh", "mesh"),
    Meshing: ("mesh", "mesh"),
    MeshCoordinates: ("mesh", "simulate name"),
    SimulationOptions: ("models", "simulate name"),
    MaterialSets: ("models", "drive name"),
    ComparisonOptions: ("compare", "compare"),
}
NOT_IN_A_STUDY = {  # what a study has in its own way
    Scans: "repeat and allow_missing are keys of [images]; a start and landmarks belong to a single load",
    Marks: "marks are keys of [images]",
    MarksForAuto: "marks are keys of [images]",
    GivenLabels: "a label map is corrected or transferred before a study",
    BoneAndBody: "part of SubjectFiles",
    ExistingFiles: "those of [images], as SubjectFiles",
    RecordedFiles: "those of [images], as SubjectFiles",
    RecordedEngine: "that of [registration], as EngineOptions",
    MeshAndAxes: "its directions are the plate's",
    Cores: "told when it is run",
    Threads: "one for each stage",
    Seeded: "the seed is the study's",
    Running: "its seed is the study's",
    ComparisonLabels: "the labels are those of [images]",
    ComparisonDirections: "they are the plate's",
    ComparisonOn: "compared on the first model's mesh",
    Followed: "a study has one mesh",
    HeelShape: "a study has images",
    ModelReading: "model.toml in a model's folder",
}
MODELS = [
    one
    for room in (measurement, modelling)
    for one in vars(room).values()
    if isinstance(one, type) and issubclass(one, Options) and one.__module__ == room.__name__
]
FIELDS = [
    pytest.param(model, field, id=f"{model.__name__}-{field}") for model in MODELS for field in model.model_fields
]


def another(annotation: Any, default: object = None, at: int = 0) -> Any:
    """A value of a field that is not its default."""
    kind = _plain(annotation, [])
    kind = next((one for one in get_args(kind) if one is not NoneType), kind) if NoneType in get_args(kind) else kind
    if get_origin(kind) is Literal:
        return next(choice for choice in get_args(kind) if choice != default)
    if get_origin(kind) is list:
        return (another(get_args(kind)[0]),)
    if get_origin(kind) is tuple:
        return tuple(another(one, at=at) for at, one in enumerate(get_args(kind)))
    chosen = {bool: default is not True, float: 1.25 + at, int: 7, str: "name", Path: Path("file.txt")}
    return chosen[kind]


def words(model: type[Options], field: str, value: Any) -> list[str]:
    """What a person types for a value."""
    name, cli = model.option(field), model.cli(field)
    if isinstance(value, bool):
        return [name] if value != cli.off else [name.replace("--", "--no-")]
    several = value if isinstance(value, tuple) else (value / cli.times,) if cli.times != 1.0 else (value,)
    return [name, *(str(one) for one in several)]


@pytest.mark.parametrize("model", MODELS)
def test_every_model_is_offered_by_a_command_and_by_the_study_file_or_there_is_a_reason(model: type[Options]) -> None:
    assert any(issubclass(one, model) for models in COMMANDS.values() for one in models)
    assert (model in TABLES) != (model in NOT_IN_A_STUDY)


@pytest.mark.parametrize(("command", "models"), COMMANDS.items())
def test_a_command_and_its_function_have_every_field_with_its_default(
    command: str, models: tuple[type[Options], ...]
) -> None:
    offered = {
        option: one
        for one in typer.main.get_command(app).commands[command].params  # type: ignore[attr-defined]
        for option in one.opts
    }
    keywords = inspect.signature(getattr(mrstrain, command)).parameters
    for model in models:
        for field, info in model.model_fields.items():
            option, cli = offered[model.option(field)], model.cli(field)
            assert option.help, field
            if info.is_required():
                assert option.required
                continue
            assert keywords[field].default == info.default
            default = info.default if option.default is None and not info.default else option.default
            if isinstance(info.default, bool):
                default = option.default != cli.off
            elif cli.times != 1.0 and info.default is not None:
                default = option.default * cli.times
            assert (tuple(default) if isinstance(default, list) else default) == info.default, field


@pytest.mark.parametrize(("command", "models"), COMMANDS.items())
def test_help_tells_every_option_with_its_default_and_the_signature_is_plain(
    command: str, models: tuple[type[Options], ...]
) -> None:
    verb = getattr(mrstrain, command)
    signature = str(inspect.signature(verb))
    assert not [word for word in ("Annotated", "FieldInfo", "Validator", "<function", "~") if word in signature]
    own, _, told = verb.__doc__.partition("\nOther Parameters\n----------------\n")
    told, _, raised = told.partition("\n\nRaises\n------\n")
    assert bool(raised) == ("Raises" in verb.with_options.__doc__)
    entries = dict(re.findall(r"^(\w+ : .*)\n((?: {4}.*\n?)+)", told, re.MULTILINE))
    flags = {model.option(field): field for model in models for field in model.model_fields}
    for model in models:
        for field, info in model.model_fields.items():
            (head,) = [head for head in entries if head.startswith(f"{field} : ")]
            usual = (
                "" if info.is_required() else ", optional" if info.default is None else f", default {info.default!r}"
            )
            assert head.endswith(usual)
            meaning = re.sub(r"--[a-z-]+", lambda flag: f"`{flags[flag[0]]}`", info.description or "")
            assert " ".join(entries[head].split()) == " ".join(meaning.split())
    for name, parameter in inspect.signature(verb.with_options).parameters.items():  # models are called by their fields
        if parameter.annotation in models and name not in inspect.signature(verb).parameters:
            assert not re.search(rf"^(.*, )?{name}(, .*)?$", own, re.MULTILINE)


@pytest.mark.parametrize(("model", "field"), FIELDS)
def test_a_value_comes_from_the_command_line_as_it_was_typed(model: type[Options], field: str, monkeypatch) -> None:
    monkeypatch.setattr("mrstrain.cli.options._refuse_missing", lambda *_: None)  # the files are not there
    made: list[Options] = []

    def command(options) -> None:  # type: ignore[no-untyped-def]
        made.append(options)

    command.__annotations__["options"] = model
    program = typer.Typer(rich_markup_mode=None)
    program.command()(takes_options(command))
    info = model.model_fields[field]
    assert info.description
    strains = field == "strains"
    engine = "elastix" if field == "engine" else None  # of those that there are
    value = (0.25, 1.25) if strains else engine or another(info.annotation, info.default)
    given = {name: another(one.annotation) for name, one in model.model_fields.items() if one.is_required()}
    given[field] = value
    done = CliRunner().invoke(program, [word for name, one in given.items() for word in words(model, name, one)])
    assert done.exit_code == 0, done.output
    assert made == [model.of(given)]
    assert getattr(made[0], field) == value != info.default


SUBJECT = {"load0": "Load0.nii.gz", "labels": "tissues.nii.gz", "bone": "bone"}
SET = '[name]\ntitle = "x"\nsource = "x"\n[name.all]\nlaw = "neo-Hooke"\nmu_kpa = 10.0\nnu = 0.49\n'


def study_with(folder: Path, table: str, more: dict[str, object]) -> Study:
    """A study of one load and one set, with more keys in a table."""
    tables: dict[str, dict[str, object]] = {
        "study": {"name": "x"}, "images": dict(SUBJECT), "loads.Load1": {"image": "Load1.nii.gz", "normal_n": 5.0},
        "models": {"sets": ["set.toml"], "drive": True, "level": True},
    }  # fmt: skip
    tables.setdefault(table, {}).update(more)
    text = "\n".join(
        "\n".join([f"[{name}]", *(f"{key} = {toml(value)}" for key, value in of.items())])
        for name, of in tables.items()
    )
    (folder / "study.toml").write_text(text + "\n")
    for name in ("set.toml", "name.toml"):
        (folder / name).write_text(SET)
    return read_study(folder)


def toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return f"[{', '.join(toml(one) for one in value)}]"
    return str(value) if isinstance(value, int | float) else f'"{value}"'


@pytest.mark.parametrize(("model", "field"), [one for one in FIELDS if one.values[0] in TABLES])
def test_a_value_comes_from_the_study_file_to_its_stage(model: type[Options], field: str, tmp_path: Path) -> None:
    table, stage = TABLES[model]
    keys = {name: key for key, name in names_of(table).items()}
    info = model.model_fields[field]
    values = {"strains": (0.25, 1.25), "sets": ("name.toml",), "engine": "elastix"}
    value: Any = values.get(field, another(info.annotation, info.default))
    more = {keys[field]: value / model.cli(field).times if model.cli(field).times != 1.0 else value}
    if table == "mesh":  # keys that say something beside others alone
        more |= {"file": "mesh.vtu"} if model is MeshCoordinates else {"labels": "own.nii.gz"}
    stages = {one.name: one for one in plan(study_with(tmp_path, table, more))}
    got, usual = stages[stage].arguments[field], info.default
    paths = [tmp_path / one for one in (value if isinstance(value, tuple) else (value,)) if isinstance(one, Path)]
    if paths:
        assert ([got] if isinstance(got, Path) else list(got)) == paths
        assert all(path in stages[stage].files for path in paths)
    elif field == "sets":
        assert got == (str(tmp_path / "name.toml"),)
    elif field == "fixed":
        assert got == ("bone", *value)
    elif field != "chain":  # of a study's first load, nothing
        assert (tuple(got) if isinstance(got, list) else got) == value != usual


def names_of(table: str) -> dict[str, str]:
    """Keys of a table of the study file, with the fields that they are."""
    model = Study.model_fields[table].annotation
    assert isinstance(model, type)
    fields = {id(info): name for name, info in model.model_fields.items()}  # type: ignore[attr-defined]
    return {key: fields[id(info)] for key, info in keys_of(model).items()}


@pytest.mark.parametrize(("model", "table"), [(model, table) for model, (table, _) in TABLES.items()])
def test_a_study_file_has_the_same_defaults(model: type[Options], table: str, tmp_path: Path) -> None:
    study = study_with(tmp_path, "study", {})
    own = {"sets", "labels", "bone_label"}  # said in this study; by default no set, and as `align` asks
    for field, info in model.model_fields.items():
        if field not in own:
            assert getattr(getattr(study, table), field) == info.default, field


BAD = [
    (RegistrationOptions, "engine", "ants"), (RegistrationOptions, "align", "skin"),
    (RegistrationOptions, "bending", 0.0), (RegistrationOptions, "volume", -1.0),
    (PlateOptions, "gap_mm", -1.0), (Meshing, "edge_mm", 0.0), (Meshing, "limit_s", 0.0),
    (MeshCoordinates, "mesh_unit", "cm"), (SimulationOptions, "element", "P3"), (SimulationOptions, "limit_s", 0.0),
    (SimulationOptions, "fixed", ("cut", "cut")),
    (ComparisonOptions, "strains", (0.5, 0.2)), (ComparisonOptions, "least_ml", -1.0),
]  # fmt: skip


@pytest.mark.parametrize(("model", "field", "value"), BAD)
def test_one_check_holds_everywhere(model: type[Options], field: str, value: Any, tmp_path: Path) -> None:
    for called in (str, model.option):  # in Python, and on the command line
        with pytest.raises(ParameterError, match=f"^{called(field)}: .*got "):
            model.of({field: value}, called)
    table, _ = TABLES[model]
    key = next(key for key, name in names_of(table).items() if name == field)
    with pytest.raises(InputError, match=rf"\[{table}\] '{key}': .*got "):
        study_with(tmp_path, table, {key: value})


def test_defaults_that_are_those_of_what_computes() -> None:
    assert ComparisonOptions().strains == RANGE
    assert ComparisonOptions().least_ml == LEAST_ML


def test_paths_vectors_and_numbers_may_come_as_numpy_and_text() -> None:
    import numpy as np

    given = MeshAndAxes.of({"plate_normal": np.array([0, 0, -1]), "mesh": "heel.vtu"})
    assert given == MeshAndAxes(plate_normal=(0.0, 0.0, -1.0), mesh=Path("heel.vtu"))
    assert Running.of({"seed": np.int64(3)}).seed == 3
    for wrong in (True, "1", float("nan")):
        with pytest.raises(ParameterError, match="bending: "):
            RegistrationOptions.of({"bending": wrong})
    with pytest.raises(TypeError, match="bendin"):
        mrstrain.register("a", ["b"], out="c", bendin=3.0)


def test_far_too_many_threads_are_refused_and_workers_limited_with_the_number_of_cores(monkeypatch, caplog) -> None:
    for module in ("dvc.threads", "dvc.registration.register", "mrstrain.options.measurement"):
        monkeypatch.setattr(f"{module}.usable_cores", lambda: 2)
    told = CliRunner().invoke(app, ["simulate", "m.vtu", "--load", "a=1", "--threads", "100000", "--out", "out"])
    assert str(told.exception) == "--threads: must be 256 or less (cores of this machine: 2); got 100000."
    with pytest.raises(ParameterError, match=r"must be 1 to 256; got 100000\. This machine has 2 cores\."):
        Settings.of("gauss-newton", threads=100000)
    assert Threads(threads=256).threads == Settings.of("gauss-newton", threads=256).threads == 256
    caplog.clear()
    assert (in_parallel(None), in_parallel(1), in_parallel(2)) == (2, 1, 2)
    assert caplog.messages == []
    caplog.clear()
    assert in_parallel(100000) == 2
    assert caplog.messages == ["workers=100000 exceeds the 2 cores of this machine: at most 2 jobs run in parallel."]
    assert Running(workers=100000).shares(8) == (2, 1)
