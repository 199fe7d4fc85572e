"""A stage in a process of its own, which gives all of its memory back at its end and may die alone."""

import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock

from dvc.atomic_files import write_whole
from dvc.errors import MrstrainError, OutputError, WorkerError
from dvc.memory import is_lack_of_memory
from dvc.threads import on_one_core, usable_cores
from dvc.worker import Worker, in_this_process
from mrstrain.records.outcome import lack_of_machine
from mrstrain.studies import stages
from mrstrain.studies.stages import StageResult, Tell

Outcome = StageResult | WorkerError | str
"""The result of a stage; how a process of it died; or why it failed."""
_SOLVES = ("simulate", "vary", "drive")  # stages that do nothing but compute on one thread
_WITHOUT_OTHERS = ("label", "compare")  # the first and the last stage of a study, which have all cores to themselves
_TELL_EVERY_S = 1.0
_A_FAULT = "This is an error in mrstrain; please report it:\n"


def run_stage(
    name: str, function: str, arguments: Mapping[str, Any], lock: str, tell: Tell, *, alone: bool = False
) -> Outcome:
    """Run a stage under its lock; its errors are returned.

    ``function`` is one of `mrstrain.studies.stages`. With ``alone``, it uses one core.
    """
    threads = usable_cores() if function in _WITHOUT_OTHERS and not alone else 1
    try:
        with tempfile.TemporaryDirectory(prefix="mrstrain-") as folder, Worker(threads) as process:
            news = Path(folder) / "news"

            def watch() -> None:
                with suppress(OSError):  # there is none yet
                    what, _, fraction = news.read_text(encoding="utf-8").rpartition("\n")
                    tell(what, float(fraction))

            return process.run(f"running {name}", _child, function, dict(arguments), lock, alone, news, watch=watch)
    except Exception as error:
        return _failure(error)


def _child(function: str, arguments: Mapping[str, Any], lock: str, alone: bool, news: Path) -> Outcome:
    """Run a stage in this process, which is its own; its progress is written to the file ``news``."""
    told_at = -_TELL_EVERY_S

    def tell(what: str, fraction: float) -> None:
        nonlocal told_at
        now = time.monotonic()
        if fraction >= 1.0 or now - told_at >= _TELL_EVERY_S:
            told_at = now
            with suppress(OutputError):  # a full disk, or the file is being read: the stage goes on
                write_whole(news, f"{what}\n{float(fraction)}")

    with in_this_process() if function in _SOLVES else nullcontext():
        return outcome_of(function, arguments, lock, tell, alone=alone)


def outcome_of(function: str, arguments: Mapping[str, Any], lock: str, tell: Tell, *, alone: bool) -> Outcome:
    """Run a stage in this process; parameters as in `run_stage`."""
    stage: Callable[..., StageResult] = getattr(stages, function)
    try:
        with FileLock(lock), on_one_core() if alone else nullcontext():
            return stage(tell, **arguments)
    except Exception as error:
        return _failure(error)


def _failure(error: Exception) -> WorkerError | str:
    """How a process died, or what a stage that failed tells."""
    if isinstance(error, MrstrainError):
        return WorkerError(str(error)) if isinstance(error, WorkerError) else str(error)
    lack = lack_of_machine(error)
    return WorkerError(lack) if is_lack_of_memory(error) else lack or _A_FAULT + traceback.format_exc()
