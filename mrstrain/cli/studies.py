"""The commands of a whole study. They parse, call one function, and print."""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import typer

import mrstrain
from mrstrain.cli.browser import can_open, show
from mrstrain.cli.lines import say
from mrstrain.cli.options import Done, Out, P, Workers, tell

StudyFile = Annotated[Path, typer.Argument(help="The study file, or its folder.")]
NoOpen = Annotated[
    bool,
    typer.Option(
        "--no-open",
        help="Do not open the report in a browser. By default it opens as soon as the first result is ready, if there "
        "is a display.",
        envvar="MRSTRAIN_NO_OPEN",
        rich_help_panel="Output",
    ),
]
Scheduler = Annotated[
    str | None, typer.Option(help="Address of a Dask scheduler, such as tls://node1:8786; see docs/cluster.md.")
]


def _carry_out(work: Callable[P, Done], *given: P.args, **options: P.kwargs) -> None:
    """As `carry_out`, for functions that report the progress of all stages together and what each found, too."""
    from mrstrain.records.progress import live

    with live(of_all=True) as progress:
        done = work(*given, **options, progress=progress)  # type: ignore[arg-type]
    tell(done)


def init(
    folder: Annotated[
        Path, typer.Argument(help="Folder with the images, the label map and, optionally, results of other codes.")
    ],
    name: Annotated[
        str, typer.Option(help="Name of the subject in the report; must not identify a patient.")
    ] = "Subject 01",
    yes: Annotated[
        bool, typer.Option("--yes", help="Ask no questions. Outside a terminal, none are asked anyway.")
    ] = False,
) -> None:
    """Write a commented study file for the images in a folder, and a picture of these images.

    In a terminal, asks for what the files do not contain: the bone, the forces and the plate's directions.
    """
    if yes or not (sys.stdin.isatty() and sys.stdout.isatty()):
        tell(mrstrain.init(folder, name=name))
        return
    from mrstrain.cli.questions import ask

    tell(mrstrain.init(folder, name=name, ask=ask))


def check(study: StudyFile, workers: Workers = None) -> None:
    """Check all inputs of a study at once, and estimate the time, memory and disk space of a run."""
    done = mrstrain.check(study, workers=workers)
    tell(done)
    if done.wrong:
        raise typer.Exit(2)


def run(
    study: StudyFile,
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="Run only these stages, by kind (label, register, mesh, simulate, vary, drive, level, compare) or by "
            "name ('simulate trebbi'). Repeat for several."
        ),
    ] = None,
    force: Annotated[
        list[str] | None, typer.Option(help="Stages to run again, by kind or name. Repeat for several.")
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Skip the additional simulations (one input changed each) from which the input uncertainty of the "
            "models is computed.",
        ),
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only list what would be done.")] = False,
    report_only: Annotated[bool, typer.Option("--report-only", help="Only write the report again.")] = False,
    scheduler: Scheduler = None,
    workers: Workers = None,
    no_open: NoOpen = False,
) -> None:
    """Run a study from its file to its report: register, mesh, simulate, compare. An interrupted run resumes."""
    from mrstrain.studies.run import forecast, report

    given = {"--only": only, "--force": force, "--scheduler": scheduler, "--workers": workers}
    if report_only:
        _refuse_idle("--report-only", given | {"--dry-run": dry_run, "--quick": quick})
        tell(report(study))
    elif dry_run:
        _refuse_idle("--dry-run", {name: given[name] for name in ("--scheduler", "--workers")})
        for name, told in forecast(study, only=only or (), force=force or (), quick=quick).items():
            say(f"{name}: {told}")
    else:
        _carry_out(
            mrstrain.run, study, only=only or (), force=force or (), scheduler=scheduler, workers=workers,
            quick=quick, on_report=None if no_open or not can_open() else show,
        )  # fmt: skip


def _refuse_idle(flag: str, given: Mapping[str, object]) -> None:
    """Refuse options that would change nothing beside one with which nothing runs."""
    idle = [name for name, value in given.items() if value]
    if idle:
        from dvc.errors import ParameterError

        raise ParameterError(
            f"{flag} runs nothing, so {', '.join(idle)} would have no effect. Leave out {flag} or these options."
        )


def cohort(
    studies: Annotated[list[Path], typer.Argument(help="Study files, or their folders.")], out: Out,
    scheduler: Scheduler = None, workers: Workers = None,
) -> None:  # fmt: skip
    """Run the studies of several subjects, and rank the models over all of them in one table and one report."""
    _carry_out(mrstrain.cohort, studies, out=out, scheduler=scheduler, workers=workers)


def demo(
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for the images, the study and its results; created if missing.", rich_help_panel="Output"
        ),
    ] = Path("demo"),
    seed: Annotated[int, typer.Option(min=1, help="Seed of the phantom.")] = 1,
    full: Annotated[
        bool,
        typer.Option(
            "--full",
            help="Full size (about an hour): all seven published material sets on a mesh of about 75,000 cells. The "
            "simulation with friedman ends at its time limit, before the full load.",
        ),
    ] = False,
    workers: Workers = None,
    no_open: NoOpen = False,
) -> None:
    """Run a whole study on a heel phantom with known strain under four loads, and report the error by tissue."""
    from mrstrain.studies.demo import demo as run

    on_report = None if no_open or not can_open() else show
    _carry_out(run, out, seed=seed, full=full, workers=workers, on_report=on_report)
