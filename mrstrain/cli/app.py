"""The command line. It parses, calls one function, and prints; heavy imports wait until a command runs."""

import atexit
import ctypes
import gc
import logging
import os
import signal
import sys
from contextlib import suppress
from functools import partial
from importlib import import_module
from typing import Annotated

import typer

from mrstrain.cli import measurement, models, studies
from mrstrain.cli.lines import say
from mrstrain.cli.options import EXAMPLES, Grouped
from mrstrain.cli.wrapping import wrapped

_GREETING = """\
mrstrain measures strain inside soft tissue from pairs of MR images, and compares finite-element
models with it.

  mrstrain demo       see it work: a heel phantom, from images to report, in a few minutes
  mrstrain init       set up a study with your own images and models; mrstrain run then computes it
  mrstrain register   measure strain between two of your images, unloaded and loaded, without a study

mrstrain --help lists all commands, and mrstrain COMMAND --help the options of one."""
_M_ARENA_MAX = -8  # of glibc's malloc.h
_TOLD_TO_END = 128 + signal.SIGINT, 128 + signal.SIGTERM  # exit status

app = typer.Typer(
    name="mrstrain",
    help="Measure strain inside soft tissue from pairs of MR images, and compare finite-element models with it.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"max_content_width": 100},  # of help, in a terminal that is as wide
)


def _version(asked: bool) -> None:
    if asked:
        from mrstrain import __version__

        typer.echo(f"mrstrain {__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        typer.echo(_GREETING)


for _command in (
    studies.init, studies.check, studies.run, studies.cohort, studies.demo, measurement.label, measurement.register,
    measurement.strain, measurement.phantom, measurement.twin, measurement.accuracy, models.mesh, models.simulate,
    models.compare, models.drive, models.level, models.converge, models.fit,
):  # fmt: skip
    # The list of commands has the whole first paragraph of each, not as much of it as fits on a line.
    _first = " ".join((_command.__doc__ or "").split("\n\n")[0].split())
    app.command(cls=Grouped, short_help=_first, epilog=EXAMPLES[_command.__name__])(_command)


@app.command()
def doctor() -> None:
    """Check whether this machine can run mrstrain."""
    from mrstrain.records.doctor import examine

    def trial(what: str, module: str) -> str:
        from dvc.worker import Worker

        with Worker(threads=1) as worker:
            return str(worker.run(f"trying {what}", import_module(module).self_test))

    tried = {
        "registration": "dvc.registration.self_test", "itk-elastix": "dvc.registration.elastix.run",
        "pytetwild": "fe.meshing", "sparse solver": "fe.linear",
    }  # fmt: skip
    findings = examine(trials={what: partial(trial, what, module) for what, module in tried.items()})
    for finding in findings:
        say(f"{'ok  ' if finding.ok else 'FAIL'} {finding.what}: {finding.detail}")
        if not finding.ok and finding.advice:
            say(f"     {finding.advice}")
    if not all(f.ok for f in findings):
        raise typer.Exit(1)


def main() -> None:
    """Entry point: errors made on purpose are printed as sentences, with exit status 2."""
    shown = logging.StreamHandler()
    shown.setLevel(logging.WARNING)  # all else is for the log of a command
    logging.basicConfig(format="%(message)s", level=logging.WARNING, handlers=[shown])
    _share_arenas()
    _leave_out_unusable_settings()
    # What removes the semaphores of processes that an interrupt ended need not tell of them.
    os.environ.setdefault("PYTHONWARNINGS", "ignore:resource_tracker:UserWarning")
    # Being told to end is like an interrupt: what was started ends too, and nothing half-written stays.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    if (closed := getattr(signal, "SIGHUP", None)) and signal.getsignal(closed) == signal.SIG_DFL:  # not under nohup
        signal.signal(closed, _closed)
    signal.signal(signal.SIGINT, _interrupted)
    atexit.register(gc.freeze)  # half a second of collecting what ends with the process anyway
    try:
        app()
    except Exception as error:
        try:
            from dvc.errors import MrstrainError
            from mrstrain.records.outcome import lack_of_machine, wrong_path

            message = str(error) if isinstance(error, MrstrainError) else lack_of_machine(error) or wrong_path(error)
        except (MemoryError, SystemError, ImportError):  # for want of memory to load these
            message = "The memory ran out. Free memory or use fewer --workers."
        if not message:
            raise
        _stop("\n".join([message, *getattr(error, "__notes__", ())]))  # such as where the log is
    except SystemExit as ended:
        if ended.code in _TOLD_TO_END:  # threads that still compute would be waited for
            atexit._run_exitfuncs()
            sys.stdout.flush()
            os._exit(int(ended.code))
        raise


def _interrupted(*_: object) -> None:
    """Say so before anything is taken down; a second interrupt ends the process at once."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    typer.echo("\nStopping...", err=True)
    raise KeyboardInterrupt


def _closed(*_: object) -> None:
    """End like SIGTERM where the terminal is closed; what is still said goes nowhere, as writing to it would fail."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    sys.exit(128 + signal.SIGTERM)


def _leave_out_unusable_settings() -> None:
    """Remove settings of the environment with which matplotlib and numba cannot be imported."""
    os.environ.pop("MPLBACKEND", None)  # figures are written to files, for which no backend is needed
    threads = os.environ.get("NUMBA_NUM_THREADS", "").strip()
    if threads.removeprefix("-").isdecimal() and int(threads) < 1:
        del os.environ["NUMBA_NUM_THREADS"]


def _share_arenas() -> None:
    """Let glibc's threads share two arenas of memory: with one for each, freed memory stays where no other finds it."""
    with suppress(OSError, AttributeError, TypeError):  # another C library
        ctypes.CDLL(None).mallopt(_M_ARENA_MAX, 2)


def _stop(message: str) -> None:
    typer.echo(wrapped(f"mrstrain: {message}"), err=True)
    sys.exit(2)
