"""`run`: a study from its file to its report; what is finished is not done again."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from dvc.errors import InputError, OutputError, ParameterError
from dvc.io.result_folder import REPORT
from mrstrain.records.inputs import make_output, refuse_small_disk
from mrstrain.records.progress import ALL
from mrstrain.studies.check import wrong_with
from mrstrain.studies.costs import disk_bytes, seconds_of, sizes_of
from mrstrain.studies.file import Study, read_study
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.page import write_run_report
from mrstrain.studies.pipeline import Outcome, Pipeline, run_all
from mrstrain.studies.plan import KINDS, Stage, plan

Told = Callable[[str, str, float], None]

LOG = "study.log"
_USUAL_VOXELS, _USUAL_CELLS = 2e6, 70e3
_NOTHING = ("nothing",)  # to be run: everything is taken as it is


@dataclass(frozen=True, slots=True, eq=False)
class Ran:
    """What `run` gave.

    Attributes
    ----------
    study : Study
    outcomes : dict
        Of every stage, by its name.
    """

    study: Study
    outcomes: Mapping[str, Outcome]

    @property
    def complete(self) -> bool:
        """Whether every stage that was asked for has a whole result of what the study says now."""
        return all(outcome.whole for outcome in self.outcomes.values() if outcome.asked)

    def summary(self) -> list[str]:
        """A few lines for a person."""
        lines = []
        for name, outcome in self.outcomes.items():
            if outcome.left_out:
                continue
            if not outcome.whole:
                told = () if outcome.record is None else outcome.record.given.lines
                lines += [f"{name}: {outcome.words}. {outcome.reason}".rstrip(), *(f"    {line}" for line in told)]
            elif outcome.record is not None:
                lines += [
                    f"{name}: {section.verdict.words}. {' '.join(section.verdict.reasons)}"
                    for section in outcome.record.given.sections
                    if section.verdict is not None and section.verdict.level != "trust" and name != "compare"
                ]
        compared = self.outcomes.get("compare")
        if compared is not None and compared.record is not None:
            lines += compared.record.given.lines
        left_out = [name for name, outcome in self.outcomes.items() if outcome.left_out]
        if left_out:
            lines.append(f"Not asked for, and without a result: {', '.join(left_out)}.")
        again = sum(outcome.again and outcome.record is not None for outcome in self.outcomes.values())
        return [
            *lines,
            f"{len(self.outcomes)} stages, {again} of them there already. Log: {self.study.out / LOG}",
            f"Report: {self.study.out / REPORT}",
        ]


def run(
    study: Path | str | Study,
    *,
    only: Sequence[str] = (),
    force: Sequence[str] = (),
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Told | None = None,
) -> Ran:
    """Run a study: register, mesh, simulate, compare and report.

    Parameters
    ----------
    study : path or Study
        The study file, or its folder.
    only : sequence of str
        Names or kinds of stages ("register", "simulate trebbi") that may be run; the others are taken as they are.
    force : sequence of str
        Names or kinds of stages that are made anew.
    scheduler : str, optional
        Address of a Dask scheduler whose workers see the study's folder; this machine's cores by default.
    workers : int, optional
        Stages at once on this machine; one for each core by default.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Returns
    -------
    Ran
        With every stage's outcome; a stage that failed is named there, in the log and in the report.

    Raises
    ------
    InputError
        If the study cannot be read, a file is missing, or stages that are to be run would fail by what it says or by
        what is in its files, loaded images left aside; before anything is run.
    ParameterError
        If both a scheduler and a number of workers are given.
    OutputError
        If another run is at work in the same folder, or it cannot be written to.
    """
    told = study if isinstance(study, Study) else read_study(study)
    (ran,) = run_studies([told], only=only, force=force, scheduler=scheduler, workers=workers, progress=progress)
    return ran


def run_studies(
    studies: Sequence[Study],
    *,
    only: Sequence[str] = (),
    force: Sequence[str] = (),
    scheduler: str | None = None,
    workers: int | None = None,
    progress: Told | None = None,
) -> list[Ran]:
    """Run several studies on one cluster, each as `run` does it; what cannot be run is refused before any begins."""
    if scheduler is not None and workers is not None:
        raise ParameterError(
            f"--workers {workers} is for this machine's cores; the scheduler at {scheduler} has workers of its own. "
            "Give one of the two."
        )
    planned = [plan(study) for study in studies]
    for stages in planned:
        refuse_unknown(stages, only, force)
    refuse_missing(planned)
    tell, ended = progress or (lambda *_: None), 0.0
    seconds: dict[str, float] = {}
    stages_told = f"{sum(map(len, planned))} stages"
    prefixes = [f"{study.study.name}: " if len(studies) > 1 else "" for study in studies]
    each = [
        Pipeline(stages, Ledger(study.out, study.place), only=only, force=force)
        for study, stages in zip(studies, planned, strict=True)
    ]
    todo = [pipeline.to_do() for pipeline in each]
    refuse_wrong(studies, todo)
    pipelines = dict(zip(prefixes, each, strict=True))
    lines: dict[str, Callable[[str], None]] = {}

    def line_of(prefix: str, log: Callable[[str], None]) -> Callable[[str], None]:
        def line(text: str) -> None:
            nonlocal ended
            log(text)
            name = prefix + text.split(": ", maxsplit=1)[0]
            if name in seconds:
                ended += seconds[name]
                tell(name, "ended", 1.0)  # one that failed has not told so
                tell(ALL, stages_told, round(ended / sum(seconds.values()), 9))

        return line

    def pool() -> object:
        from mrstrain.studies.cluster import cluster

        return cluster(tell, [study.out for study in studies], scheduler=scheduler, workers=workers)

    on_disk: dict[int, tuple[int, float]] = {}
    with ExitStack() as stack:
        for prefix, study, stages, left in zip(prefixes, studies, planned, todo, strict=True):
            stack.enter_context(_alone(study.out))
            voxels, cells = _sizes(study, left)
            _refuse_small_disk(study, left, voxels, on_disk)
            seconds |= {prefix + stage.name: seconds_of(stage, study, voxels, cells) for stage in left}
            log = stack.enter_context(_log(study.out / LOG))
            log(f"Study '{study.study.name}': {len(stages)} stages, {len(left)} of them to do")
            lines[prefix] = line_of(prefix, log)
        run_all(pipelines, pool, lines)
        tell(ALL, stages_told, 1.0)
        done = []
        for prefix, study in zip(prefixes, studies, strict=True):
            outcomes = pipelines[prefix].in_order()
            write_run_report(study.out / REPORT, study, outcomes)
            lines[prefix](f"Report: {study.study.out}/{REPORT}")
            done.append(Ran(study, outcomes))
    return done


def _sizes(study: Study, left: Sequence[Stage]) -> tuple[float, float]:
    """Sizes that stages which are left depend on, as `sizes_of` tells them."""
    try:
        return sizes_of(study) if left else (0.0, 0.0)
    except (InputError, OSError):
        return _USUAL_VOXELS, _USUAL_CELLS  # the stages that read it say what is wrong with it


def _refuse_small_disk(
    study: Study, left: Sequence[Stage], voxels: float, on_disk: dict[int, tuple[int, float]]
) -> None:
    """Refuse a run whose results would not fit, before any of it is made.

    ``on_disk`` is added to: how many stages, and bytes, the studies so far will write to each disk.
    """
    if not left:
        return
    disk = study.out.stat().st_dev
    stages, needed = on_disk.get(disk, (0, 0.0))
    stages, needed = stages + len(left), needed + sum(disk_bytes(stage, study, voxels) for stage in left)
    on_disk[disk] = stages, needed
    refuse_small_disk(study.out, needed, f"the results of {stages} stages need", "", "[study] out")


def report(study: Path | str | Study) -> Ran:
    """Write a study's report anew from what is there, without running anything.

    Raises
    ------
    InputError
        If no stage has a result.
    """
    told = study if isinstance(study, Study) else read_study(study)
    stages = plan(told)
    pipeline = Pipeline(stages, Ledger(told.out, told.place), only=_NOTHING)
    pipeline.settle()
    outcomes = pipeline.in_order()
    if all(outcome.record is None for outcome in outcomes.values()):
        raise InputError(f"{told.out} has no results yet: `mrstrain run` makes them.")
    with _alone(told.out):
        write_run_report(told.out / REPORT, told, outcomes)
    return Ran(told, outcomes)


def forecast(study: Path | str | Study, *, only: Sequence[str] = (), force: Sequence[str] = ()) -> dict[str, str]:
    """What `run` would do with each stage, as `Pipeline.forecast` tells it; parameters and errors are `run`'s own."""
    told = study if isinstance(study, Study) else read_study(study)
    stages = plan(told)
    refuse_unknown(stages, only, force)
    refuse_missing([stages])
    pipeline = Pipeline(stages, Ledger(told.out, told.place), only=only, force=force)
    refuse_wrong([told], [pipeline.to_do()])
    return pipeline.forecast()


def refuse_unknown(stages: Sequence[Stage], only: Sequence[str], force: Sequence[str]) -> None:
    """Refuse names that no stage and no kind of stage has, and to make anew what is not to be run at all."""
    known = [*(stage.name for stage in stages), *KINDS]
    for name in (*only, *force):
        if name not in known:
            raise InputError(f"No stage is called '{name}'. There are: {', '.join(known)}.")
    for name in force if only else ():
        meant = [stage for stage in stages if name in (stage.name, stage.kind)]
        if meant and not any({stage.name, stage.kind} & {*only} for stage in meant):
            raise InputError(f"--force {name} makes nothing anew: --only {', '.join(only)} leaves it out.")


def refuse_missing(planned: Sequence[Sequence[Stage]]) -> None:
    """Refuse studies whose files are not there, naming every one of all of them."""
    files = dict.fromkeys(path for stages in planned for stage in stages for path in stage.files)
    missing = [path for path in files if not path.exists()]
    if missing:
        raise InputError("These files of the study are not there:\n" + "\n".join(f"  {path}" for path in missing))


def refuse_wrong(studies: Sequence[Study], todo: Sequence[Sequence[Stage]]) -> None:
    """Refuse studies of whose stages to do some would fail, hours later, by what need not be computed to be known."""
    told = {
        study.study.name: wrong
        for study, left in zip(studies, todo, strict=True)
        if left and (wrong := wrong_with(study, left))
    }
    if told:
        lines = [f"{name}: {sentence}" for name, wrong in told.items() for sentence in wrong]
        raise InputError("This cannot be run as it is (`mrstrain check` tells more):\n  " + "\n  ".join(lines))


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Hold the results folder; the system lets go of it when the process ends, however it does."""
    make_output(out)
    folder = out / ".study"
    make_output(folder)
    lock = FileLock(folder / "lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as taken:
        raise OutputError(
            f"{out}: another run is at work here. Wait for its end, or give another [study] out."
        ) from taken
    try:
        yield
    finally:
        lock.release()


@contextmanager
def _log(path: Path) -> Iterator[Callable[[str], None]]:
    """Append lines with their time to a file."""
    logger = logging.Logger(f"mrstrain {path}")
    handler = logging.FileHandler(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)sZ %(message)s", "%Y-%m-%dT%H:%M:%S"))
    handler.formatter.converter = time.gmtime  # type: ignore[union-attr]
    logger.addHandler(handler)
    try:
        yield logger.info
    finally:
        handler.close()
