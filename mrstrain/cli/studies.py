"""The commands of a whole study. They parse, call one function, and print."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import typer

import mrstrain
from mrstrain.cli.options import Done, Out, P, Workers, tell

StudyFile = Annotated[Path, typer.Argument(help="The study file, or its folder.")]
Scheduler = Annotated[
    str | None, typer.Option(help="Address of a Dask scheduler to use, such as tcp://node1:8786; see docs/cluster.md.")
]


def _carry_out(work: Callable[P, Done], *given: P.args, **options: P.kwargs) -> None:
    """As `carry_out`, for functions that report the progress of all stages together, too."""
    from mrstrain.records.progress import live

    with live(of_all=True) as progress:
        done = work(*given, **options, progress=progress)  # type: ignore[arg-type]
    tell(done)


def init(
    folder: Annotated[Path, typer.Argument(help="With images, label map, and perhaps results of other codes.")],
    name: Annotated[str, typer.Option(help="In the report; nothing that names a patient.")] = "Subject 01",
) -> None:
    """Write a study file, with comments, from what a folder holds."""
    tell(mrstrain.init(folder, name=name))


def check(study: StudyFile, workers: Workers = None) -> None:
    """Look at every input of a study: all that is wrong at once, and the time, memory and disk that a run takes."""
    done = mrstrain.check(study, workers=workers)
    tell(done)
    if done.wrong:
        raise typer.Exit(2)


def run(
    study: StudyFile,
    only: Annotated[
        list[str] | None, typer.Option(help="Kind or name of stages to run (register, 'simulate trebbi'); repeat.")
    ] = None,
    force: Annotated[list[str] | None, typer.Option(help="Kind or name of stages to make anew; repeat.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only tell what would be done.")] = False,
    report_only: Annotated[bool, typer.Option("--report-only", help="Only write the report anew.")] = False,
    scheduler: Scheduler = None,
    workers: Workers = None,
) -> None:
    """A study from its file to its report: register, mesh, simulate, compare. Goes on where it stopped."""
    from mrstrain.studies.run import forecast, report

    given = {"--only": only, "--force": force, "--scheduler": scheduler, "--workers": workers}
    if report_only:
        _refuse_idle("--report-only runs nothing", given | {"--dry-run": dry_run})
        tell(report(study))
    elif dry_run:
        _refuse_idle("--dry-run runs nothing", {name: given[name] for name in ("--scheduler", "--workers")})
        for name, told in forecast(study, only=only or (), force=force or ()).items():
            typer.echo(f"{name}: {told}")
    else:
        _carry_out(mrstrain.run, study, only=only or (), force=force or (), scheduler=scheduler, workers=workers)


def _refuse_idle(why: str, given: Mapping[str, object]) -> None:
    """Refuse options that would change nothing."""
    idle = [name for name, value in given.items() if value]
    if idle:
        from dvc.errors import ParameterError

        raise ParameterError(f"{why}: leave out {', '.join(idle)}, or it.")


def cohort(
    studies: Annotated[list[Path], typer.Argument(help="Study files, or their folders.")], out: Out,
    scheduler: Scheduler = None, workers: Workers = None,
) -> None:  # fmt: skip
    """The studies of many subjects on one cluster: one table, one report, and the models ranked over all."""
    _carry_out(mrstrain.cohort, studies, out=out, scheduler=scheduler, workers=workers)


def demo(
    out: Out = Path("demo"),
    seed: Annotated[int, typer.Option(min=1, help="Seed of the phantom.")] = 1,
    full: Annotated[
        bool,
        typer.Option(
            "--full", help="The published size, an hour: seven sets, 75,000 cells; friedman is cut, which it tells."
        ),
    ] = False,
    workers: Workers = None,
) -> None:
    """A heel phantom with known strain under four loads, taken through a whole study: error by tissue, and a report."""
    from mrstrain.studies.demo import demo as run

    _carry_out(run, out, seed=seed, full=full, workers=workers)
