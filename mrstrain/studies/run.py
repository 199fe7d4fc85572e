"""`run`: runs a study from its file to its report; finished stages are not repeated."""

import logging
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from dvc import Verdict
from dvc.errors import InputError, ParameterError, few
from dvc.io.result_folder import REPORT
from dvc.memory import hand_memory_back
from mrstrain.options.measurement import in_parallel, refuse_misspelt_auto
from mrstrain.records.inputs import alone, make_output, refuse_small_disk
from mrstrain.records.log import append, timed
from mrstrain.records.progress import ALL, OnProgress
from mrstrain.records.time_left import Expected, seconds_to_end
from mrstrain.studies.check import wrong_with
from mrstrain.studies.costs import costs, disk_bytes, expected, gib_of, sizes_of
from mrstrain.studies.file import Study, read_study
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.page import write_run_report
from mrstrain.studies.pipeline import Log, Pipeline, StageOutcome, left_out_of, run_all
from mrstrain.studies.plan import KINDS, Stage, plan
from mrstrain.studies.watch import Follower, OnReport, Report, Watch

LOG = "study.log"
_warnings = logging.getLogger("mrstrain.studies")
_NOTHING = ("nothing",)  # no stage may be run


@dataclass(frozen=True, slots=True, eq=False)
class StudyRun:
    """Result of `run`: the study, and the outcome of every stage by its name."""

    study: Study
    outcomes: Mapping[str, StageOutcome]

    @property
    def complete(self) -> bool:
        """Whether every requested stage has a complete result that matches the current study."""
        return all(outcome.complete for outcome in self.outcomes.values() if outcome.requested)

    @property
    def verdicts(self) -> dict[str, Verdict]:
        """Verdict on each registration that has a result, by load."""
        return {
            name.removeprefix("register "): verdict
            for name, outcome in self.outcomes.items()
            if name.startswith("register ")
            for verdict in outcome.result.verdicts
        }

    def summary(self) -> list[str]:
        """Summary, a few lines: incomplete stages, doubtful registrations, the comparison, and log and report files."""
        lines = []
        for name, outcome in self.outcomes.items():
            if outcome.left_out:
                continue
            if not outcome.complete:
                lines += [str(outcome), *(f"    {line}" for line in outcome.result.lines)]
            elif name != "compare":
                doubts = [verdict for verdict in outcome.result.verdicts if verdict.level != "trust"]
                lines += [f"{name}: {verdict.words}. {' '.join(verdict.reasons)}" for verdict in doubts]
        if comparison := self.outcomes.get("compare"):
            lines += comparison.result.lines
        reused = sum(outcome.reused and outcome.record is not None for outcome in self.outcomes.values())
        stages = f"{len(self.outcomes)} stages, {reused} of them reused. Log: {self.study.out / LOG}"
        return [*lines, *left_out_of(self.outcomes), stages, f"Report: {self.study.out / REPORT}"]


def run(
    study: Path | str | Study, *, only: Sequence[str] = (), force: Sequence[str] = (), scheduler: str | None = None,
    workers: int | None = None, quick: bool = False, progress: OnProgress | None = None,
    on_report: OnReport | None = None,
) -> StudyRun:  # fmt: skip
    """Run a study: register, mesh, simulate, compare and report.

    Parameters
    ----------
    study : path or Study
        The study file, or its folder.
    only : sequence of str
        Names or kinds of stages ("register", "simulate trebbi") that may be run; the others are not changed.
    force : sequence of str
        Names or kinds of stages that are run even if they are finished.
    scheduler : str, optional
        Address of a Dask scheduler whose workers have access to the folder of the study; by default the cores of this
        machine are used.
    workers : int, optional
        Number of stages at the same time on this machine; by default one for each core.
    quick : bool
        Skip the variants for the input uncertainty of the models ([uncertainty]); the report says so.
    progress : callable, optional
        ``progress(case, stage, fraction)``.
    on_report : callable, optional
        ``on_report(path)`` is called once, as soon as the report shows a picture that this run has made. The report is
        there from the start, and grows until the run ends.

    Returns
    -------
    StudyRun
        Outcome of every stage; failed stages are also listed in the log and the report.

    Raises
    ------
    InputError
        Before anything is run: if the study cannot be read, a file is missing, or a stage to be run would fail because
        of the study file or the files that it names. (A damaged loaded image makes only its own stage fail.)
    ParameterError
        If both a scheduler and a number of workers are given.
    OutputError
        If another run uses the same folder, or it cannot be written to.
    """
    return run_studies(
        [_chosen(study, quick)], only=only, force=force, scheduler=scheduler, workers=workers,
        follower=Follower(progress, on_report),
    )[0]  # fmt: skip


def _chosen(study: Path | str | Study, quick: bool) -> Study:
    told = read_study(study)
    return told.without_variants() if quick and told.uncertainty.solves else told


def run_studies(
    studies: Sequence[Study], *, only: Sequence[str] = (), force: Sequence[str] = (), scheduler: str | None = None,
    workers: int | None = None, follower: Follower | None = None,
) -> list[StudyRun]:  # fmt: skip
    """Run studies of different names on one cluster, each as in `run`; errors are raised before any of them is run."""
    if scheduler is not None and workers is not None:
        raise ParameterError(
            f"workers={workers} (--workers {workers}) applies to this machine, but the scheduler at {scheduler} has "
            "its own workers. Give only one of the two."
        )
    named = {f"{study.study.name}: " if len(studies) > 1 else "": study for study in studies}
    pipelines, to_do = _planned(named, only, force)
    at_once, follower = in_parallel(workers), follower or Follower()
    reports = {prefix: Report(study, pipelines[prefix], follower.on_report) for prefix, study in named.items()}
    expectations: dict[str, Expected] = {}
    watch = Watch(follower, reports, follower.time_left({}, at_once))

    def pool() -> object:
        from mrstrain.studies.cluster import cluster

        return cluster(watch.told, [study.out for study in studies], scheduler=scheduler, workers=at_once)

    logs: dict[str, Log] = {}
    needed: dict[int, list[float]] = defaultdict(list)  # bytes of the stages that write to each disk
    with ExitStack() as stack:
        for prefix, study in named.items():
            stack.enter_context(_alone(study.out))
            logs[prefix] = log = partial(_log, study.out / LOG)
            stages, left = pipelines[prefix].stages, to_do[prefix]
            log(f"Study '{study.study.name}': {len(stages)} stages, {len(left)} of them to do")
            if left:
                voxels, cells = sizes_of(study)
                of_disk = needed[study.out.stat().st_dev]
                of_disk += [disk_bytes(stage, study, voxels) for stage in left]
                refuse_small_disk(study.out, sum(of_disk), f"the results of {len(of_disk)} stages need")
                of_stages = expected(left, study, voxels, cells)
                expectations |= {prefix + name: one.after(prefix) for name, one in of_stages.items()}
                pipelines[prefix].seconds_to_end = seconds_to_end(of_stages)
                pipelines[prefix].gib = {stage.name: gib_of(stage, study, voxels, cells) for stage in left}
                if scheduler is None:
                    _tell(*costs(study, stages, left, voxels, cells, at_once), log)
        watch.left = follower.time_left(expectations, at_once)
        hand_memory_back()  # of the images that were checked
        with watch.reporting():
            run_all(pipelines, pool, logs, watch.ended)
        runs = [StudyRun(study, pipelines[prefix].in_order()) for prefix, study in named.items()]
        for prefix, one in zip(named, runs, strict=True):
            if follower.on_end is not None:
                follower.on_end(one.study, one.outcomes)
            reports[prefix].whole()
            logs[prefix](f"Report: {one.study.study.out}/{REPORT}")
        watch.tell(ALL, watch.count, 1.0)
    return runs


def _tell(lines: Sequence[str], warnings: Sequence[str], log: Log) -> None:
    """Log the estimates for a run; warnings also go to the logger."""
    for line in lines:
        log(line)
    for warning in warnings:
        log(f"WARNING: {warning}")
        _warnings.warning("WARNING: %s", warning)


def _planned(
    studies: Mapping[str, Study], only: Sequence[str], force: Sequence[str]
) -> tuple[dict[str, Pipeline], dict[str, list[Stage]]]:
    """Pipeline of each study and the stages to do; InputError with all problems if a study cannot be run."""
    planned = {name: plan(study) for name, study in studies.items()}
    for stages in planned.values():
        refuse_unknown(stages, only, force)
    files = dict.fromkeys(path for stages in planned.values() for stage in stages for path in stage.files)
    if missing := [path for path in files if not path.exists()]:
        for study in studies.values():
            refuse_misspelt_auto(study.images.labels, study.place)
        raise InputError("These files of the study do not exist:\n" + "\n".join(f"  {path}" for path in missing))
    pipelines = {
        name: Pipeline(planned[name], Ledger(study.out, study.place), only=only, force=force)
        for name, study in studies.items()
    }
    to_do = {name: pipeline.to_do() for name, pipeline in pipelines.items()}
    # problems that would otherwise make a stage fail hours later
    faults = [f"{one.study.name}: {wrong}" for name, one in studies.items() for wrong in wrong_with(one, to_do[name])]
    if faults:
        raise InputError("The study cannot be run (details: `mrstrain check`):\n  " + "\n  ".join(faults))
    return pipelines, to_do


def report(study: Path | str | Study) -> StudyRun:
    """Rewrite the report of a study from the existing results, without running a stage; InputError without results."""
    study = read_study(study)
    pipeline = Pipeline(plan(study), Ledger(study.out, study.place), only=_NOTHING)
    pipeline.settle()
    outcomes = pipeline.in_order()
    if all(outcome.record is None for outcome in outcomes.values()):
        raise InputError(f"{study.out} has no results yet; run the study first (`mrstrain run`).")
    with _alone(study.out):
        write_run_report(study.out / REPORT, study, outcomes)
    return StudyRun(study, outcomes)


def forecast(
    study: Path | str | Study, *, only: Sequence[str] = (), force: Sequence[str] = (), quick: bool = False
) -> dict[str, str]:
    """What `run` would do with each stage (`Pipeline.forecast`); parameters and errors as in `run`."""
    return _planned({"": _chosen(study, quick)}, only, force)[0][""].forecast()


def refuse_unknown(stages: Sequence[Stage], only: Sequence[str], force: Sequence[str]) -> None:
    """InputError for unknown names of stages, and for forced stages that may not be run."""
    names = [stage.name for stage in stages]
    for name in (*only, *force):
        if name not in (*names, *KINDS):
            kinds = ", ".join(dict.fromkeys(stage.kind for stage in stages))
            raise InputError(
                f"There is no stage or kind of stage '{name}'. Kinds in this study: {kinds}. Stages: {few(names)} "
                "(`mrstrain run --dry-run` lists all)."
            )
    for name in force if only else ():
        forced = [stage for stage in stages if name in (stage.name, stage.kind)]
        if forced and not any({stage.name, stage.kind} & {*only} for stage in forced):
            raise InputError(f"force ({name}) has no effect, because only ({few(only)}) excludes this stage.")


@contextmanager
def _alone(out: Path) -> Iterator[None]:
    """Make the results folder, and refuse it while another run writes to it."""
    make_output(out)
    make_output(out / ".study")
    with alone(out, out / ".study" / "lock"):
        yield


def _log(path: Path, text: str) -> None:
    append(path, timed(text))
