"""Models of options as options of the command line, and the help that lists them in groups."""

import functools
import inspect
import operator
import re
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, ParamSpec, Protocol, Union, get_args, get_origin, get_type_hints

import typer
from pydantic.fields import FieldInfo
from typer.core import TyperCommand

from dvc.file_names import refuse_missing
from mrstrain.cli.lines import say
from mrstrain.options.door import models_of
from mrstrain.options.measurement import Frame
from mrstrain.options.model import Options, bare

P = ParamSpec("P")
Out = Annotated[
    Path, typer.Option(help="Folder for the results and log.txt; created if missing.", rich_help_panel="Output")
]
FieldFrame = Annotated[
    Frame | None,
    typer.Option(
        help="Coordinate frame of the components of a displacement image, if no JSON file next to it states it.",
        rich_help_panel="Inputs",
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(min=1, help="Number of parallel jobs. Default: one per core.", rich_help_panel="Advanced"),
]

EXAMPLES = {
    command: f"\b\nExample:\n  mrstrain {command} {given}"
    for command, given in {
        "init": "subject01",
        "check": "subject01",
        "run": "subject01",
        "cohort": "subject01 subject02 --out cohort",
        "demo": "--out demo",
        "label": "Load0.nii.gz --bone calcaneus.nii.gz --out tissues.nii.gz",
        "register": "Load0.nii.gz Load1.nii.gz --bone calcaneus.nii.gz --labels auto --out results",
        "strain": "Load0.nii.gz TransformParameters.1.txt --bone calcaneus.nii.gz --out strained",
        "phantom": "--load Load1 --spacing 1.2 --out heel",
        "twin": "Load0.nii.gz results/Load1/transform.h5 --bone calcaneus.nii.gz --out twin",
        "accuracy": "--spacing 1.0 --snr 20 --motion still --motion smooth --out accuracy",
        "mesh": "tissues.nii.gz --names tissues.csv --edge-mm 2 --out heel.vtu",
        "simulate": "heel.vtu --set trebbi --load Load1=115 --out simulated",
        "compare": "results simulated/trebbi --out compared",
        "drive": "heel.vtu results --set trebbi --out driven",
        "level": "results simulated/trebbi --out levelled",
        "converge": "tissues.nii.gz --names tissues.csv --edge-mm 4 --edge-mm 2.6 --edge-mm 1.9 --out converged",
        "fit": "curve.csv --law Ogden --test uniaxial --out fitted",
    }.items()
}
"""The end of a command's help, by command. Files have the names that `mrstrain phantom` gives them."""

_TYPED = "mrstrain.typed"  # where a context of click keeps the command line
_HAS_STUDY_LOG = "demo"
_EMPTY = re.compile(r"--[a-z-]+=")
_NUMBER = re.compile(r"\s*[-+]?[0-9.]+\s*")
_DECIMAL_COMMA = re.compile(r"[-+]?[0-9]+,[0-9]+")
_NO_NUMBER = {"float_parsing": "a number", "int_parsing": "a whole number"}  # of pydantic's errors
_IN_WORDS = {2: "two", 3: "three"}
_WRITTEN = ("out", "draw")  # options with paths of what is written, not read
_ONE_FILE = ("label", "mesh")  # commands that write a file, and others beside it
_GROUPS = ("Arguments", "Options", "Inputs", "Registration", "Model", "Comparison", "Output", "Advanced")


class Done(Protocol):
    """What a function of a command returns; where a part can fail, with ``complete``, whether none did."""

    def summary(self) -> list[str]:
        """Summary, a few lines."""


def carry_out(work: Callable[P, Done], *given: P.args, **options: P.kwargs) -> None:
    """Call a function that takes ``progress``, show it live, then `tell` what was done."""
    import psutil

    from mrstrain.records.progress import live

    age_s = time.time() - psutil.Process().create_time()  # imports, too, take longer on a busy machine
    with live(began=time.monotonic() - max(age_s, 0.0)) as progress:
        done = work(*given, **options, progress=progress)  # type: ignore[arg-type]
    tell(done)


def tell(done: Done) -> None:
    """Print a summary of what was done, and end with status 1 where it is not complete."""
    for line in done.summary():
        say(line)
    if not getattr(done, "complete", True):
        raise typer.Exit(1)


class Grouped(TyperCommand):
    """A command whose help lists its options in groups, which says what a missing argument is, and has a log."""

    def invoke(self, ctx: Any) -> Any:
        """Call the command, with a log beside the results that it writes; where it is, follows what is not complete."""
        out = ctx.params.get("out")
        if out is None or ctx.info_name == _HAS_STUDY_LOG:
            return super().invoke(ctx)
        from mrstrain.records.log import logged

        with logged(Path(out), ["mrstrain", *ctx.meta[_TYPED]], one_file=ctx.info_name in _ONE_FILE) as log:
            try:
                return super().invoke(ctx)
            except typer.Exit as ended:
                status = ended.exit_code
        say(f"Log: {log.place}")
        raise typer.Exit(status)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; an error on a missing argument or option includes its help."""
        ctx.meta[_TYPED] = [ctx.info_name, *args]
        for before, one in pairwise(["", *args]):
            if not one or _EMPTY.fullmatch(one):  # the current folder, otherwise, whose files results may replace
                of = one.removesuffix("=") or before
                what = f"The value of {of}" if of.startswith("-") else "An argument"
                ctx.fail(f"{what} is empty. If you gave a shell variable, it may not be set.")
        typed = tuple(args)  # parsing takes them out
        try:
            return super().parse_args(ctx, args)
        except Exception as error:
            wrong: Any = error
            if told := self._explained(wrong, typed):
                wrong.message = told
            raise

    def _explained(self, wrong: Any, typed: Sequence[str]) -> str:
        """What to say of an error of parsing; empty where what it says will do."""
        kind = type(wrong).__name__  # of click, or of the copy that typer has
        if kind == "MissingParameter":
            return str(wrong.param.help)
        if kind == "BadOptionUsage":  # too few values
            of = next((one for one in self.params if wrong.option_name in one.opts), None)
            value = "".join(re.findall(rf"(?:^|\0){wrong.option_name}[=\0]([^\0]*)", "\0".join(typed))[-1:])
            return "" if of is None else _in_a_row(wrong.option_name, value, of.nargs)
        refused: Sequence[Any] = getattr(wrong.__cause__, "errors", list)()
        if kind != "BadParameter" or not refused or refused[0]["type"] not in _NO_NUMBER:
            return ""
        value = str(refused[0]["input"])
        if _DECIMAL_COMMA.fullmatch(value):
            return f"'{value}' is not a number. Use a decimal point, not a comma: {value.replace(',', '.')}."
        told = _in_a_row(wrong.param.opts[0], value, wrong.param.nargs)
        return told or f"'{value}' is not {_NO_NUMBER[refused[0]['type']]}."

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The words after the command, arguments without the braces that typer puts around them."""
        return [re.sub(r"[{}]", "", piece) for piece in super().collect_usage_pieces(ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write each group under its name."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for one in self.get_params(ctx):
            usual = "Arguments" if one.param_type_name == "argument" else "Options"
            if line := one.get_help_record(ctx):
                name, told = line
                group = getattr(one, "rich_help_panel", None) or usual
                groups.setdefault(group, []).append((_plainly(name), told))
        for name in sorted(groups, key=_GROUPS.index):
            with formatter.section(name):
                formatter.write_dl(groups[name])


def _in_a_row(option: str, value: str, wanted: int) -> str:
    """How to type the numbers of an option that were typed with commas; empty for any other value."""
    numbers = value.split(",")
    if wanted not in _IN_WORDS or len(numbers) != wanted or not all(map(_NUMBER.fullmatch, numbers)):
        return ""
    return f"'{value}' is one value. Type {_IN_WORDS[wanted]} numbers with spaces: {option} {' '.join(numbers)}."


def _plainly(name: str) -> str:
    """Name of an option with the kinds of its values as a person calls them, not as Python does."""
    kinds = {"str": "text", "Path": "path", "path": "path", "int": "number", "float": "number"}
    name = re.sub(r"<list\[(\w+)\]>", r"<\1>", name)
    row = re.sub(r"<([\w,]+)>\.\.\.", lambda found: " ".join(f"<{kind}>" for kind in found[1].split(",")), name)
    return re.sub(r"<(\w+)(?: range)?>", lambda found: f"<{kinds.get(found[1], found[1])}>", row)


def takes_options(command: Callable[..., None]) -> Callable[..., None]:
    """Offer the fields of a command's models as options of the command line, and give it the models made of them."""
    models = models_of(command)
    hints = get_type_hints(command, include_extras=True)

    @functools.wraps(command)
    def flat(context: typer.Context, **given: Any) -> None:
        made = {name: _made(model, given, context) for name, model in models.items()}
        _refuse_missing(given, made.values())
        command(**given, **made)

    own = [
        one.replace(annotation=hints[name], kind=one.KEYWORD_ONLY)
        for name, one in inspect.signature(command).parameters.items()
        if name not in models
    ]
    offered = [_offered(model, field, info) for model in models.values() for field, info in model.model_fields.items()]
    context = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
    parameters = (context, *own, *offered)
    flat.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    flat.__annotations__ = {one.name: one.annotation for one in parameters} | {"return": None}
    return flat


def _refuse_missing(given: Mapping[str, Any], made: Iterable[Options]) -> None:
    """InputError for a file to read that is not there, before what takes long is imported or started."""
    for name, value in given.items():
        for path in value if isinstance(value, list) else [value]:
            if isinstance(path, Path) and name not in _WRITTEN:
                refuse_missing(path)
    for options in made:
        options.refuse_missing()


def _offered(model: type[Options], field: str, info: FieldInfo) -> inspect.Parameter:
    """A field as a parameter that typer makes an option of."""
    cli, metadata = model.cli(field), list(info.metadata)
    kind, default, name = _plain(info.annotation, metadata), info.default, model.option(field)
    if cli.times != 1.0 and default is not None:
        default /= cli.times
    if isinstance(default, tuple) and get_origin(kind) is list:
        default = list(default) or None
    if kind is bool:
        default = default != cli.off
    several = " Repeat for several." if get_origin(kind) is list else ""
    told = " ".join((cli.help or info.description or "").split()) + several
    option = typer.Option(
        *(() if kind == bool | None else (name,)),  # without a name typer offers its negation as well
        help=told,
        show_default="Default: " not in told,
        rich_help_panel=cli.panel or model.panel,
        min=next((least for check in metadata if (least := getattr(check, "ge", None)) is not None), None),
    )
    return inspect.Parameter(
        field,
        inspect.Parameter.KEYWORD_ONLY,
        default=default,
        annotation=Annotated[kind if default is not None else kind | None, option],
    )


def _plain(annotation: Any, metadata: list[Any]) -> Any:
    """A type as typer knows it; the checks that pydantic makes beside it are added to ``metadata``."""
    kind = bare(annotation, metadata)
    if get_origin(kind) in (Union, UnionType):
        return functools.reduce(operator.or_, (_plain(one, metadata) for one in get_args(kind)))
    if isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields"):  # takes its values in a row
        named = get_type_hints(kind, include_extras=True).values()
        return tuple[tuple(bare(one, metadata) for one in named)]  # type: ignore[misc]
    return list[get_args(kind)[0]] if ... in get_args(kind) else kind  # type: ignore[misc]


def _made(model: type[Options], given: dict[str, Any], context: typer.Context) -> Options:
    """The model of what the command line gave, whose fields are taken out of it; only what was typed counts as set."""
    chosen: dict[str, Any] = {}
    for field in model.model_fields:
        value, cli = given.pop(field), model.cli(field)
        source = context.get_parameter_source(field)
        if value is not None and (source is None or source.name != "DEFAULT"):
            chosen[field] = not value if cli.off else value * cli.times if cli.times != 1.0 else value
    return model.of(chosen, model.option)
