"""`accuracy`: error of a registration preset by tissue, position, strain, noise and resolution, on phantoms."""

import hashlib
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

import phantoms
from dvc import engine_named
from dvc.atomic_files import write_csv, write_json
from dvc.errors import InputError, MrstrainError
from dvc.io.result_folder import PROVENANCE, REPORT
from dvc.registration.engines import DEFAULT
from dvc.software import software_key
from dvc.worker import Worker, each_in_workers, usable_cores
from mrstrain.records.inputs import make_output, refuse_small_disk
from mrstrain.records.progress import OnProgress
from mrstrain.records.provenance import provenance
from mrstrain.truth.accuracy_page import write_accuracy_report
from phantoms import AccuracyCase, ErrorSamples, Heel, heel_grid, measure_run, motion_named

MOTIONS = ("still", "smooth", "sliding", "Load1", "Load2", "Load3", "Load4")
WAVES = tuple(f"wave-{length}" for length in (6, 8, 10, 12, 16, 20, 24, 48))
CONDITIONS: tuple[tuple[tuple[float, float, float], float], ...] = (
    ((0.8, 0.8, 0.8), 25.0),
    ((0.8, 0.8, 0.8), 12.0),
    ((0.8, 0.8, 0.8), 50.0),
    ((1.2, 1.2, 1.2), 25.0),
    ((0.8, 0.8, 1.6), 25.0),
)
"""Voxel size (mm) and signal-to-noise ratio of the default study."""
SEEDS = (1, 2)
"""Heels of the default study. Published figures come from 9000 to 9999, on which nothing is ever tuned."""
LABELS_OFF = (0, 1, -1)
"""Voxels by which bones and skin are too large in the label maps, in turn, for the engine that relies on them."""

_MEGABYTES = 5.0  # measured for one run's samples at 0.8 mm


@dataclass(frozen=True, slots=True)
class AccuracyStudy:
    """Result of `accuracy`.

    Attributes
    ----------
    out : Path
        Folder of ``errors.csv``, ``zero_strain.csv``, ``resolution.csv``, ``coverage.csv``, an error model of each
        preset and ``report.html``.
    errors, floors, resolution : tuple of rows
        Rows of the tables.
    failures : dict
        Name of each case without a result, and why.
    """

    out: Path
    errors: tuple[phantoms.ErrorRow, ...]
    floors: tuple[phantoms.FloorRow, ...]
    resolution: tuple[phantoms.ResolutionRow, ...]
    failures: dict[str, str]

    @property
    def complete(self) -> bool:
        """Whether no case failed."""
        return not self.failures

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        lines = [
            f"{r.preset}, {r.voxel_mm} mm, SNR {r.snr:g}, {r.motion}, {r.tissue}: max. shear RMSE "
            f"{r.shear_rmse:.4f}, bias {r.shear_bias:+.4f}; displacement RMSE {r.u_rmse_mm:.3f} mm"
            for r in self.errors
            if r.by == "all" and r.tissue == "fat"
        ]
        lines += [f"{name}: FAILED. {reason}" for name, reason in self.failures.items()]
        return [*lines, f"Report: {self.out / REPORT}"]


def accuracy_cases(
    presets: Sequence[str] = (DEFAULT,),
    conditions: Sequence[tuple[tuple[float, float, float], float]] = CONDITIONS,
    motions: Sequence[str] = (*MOTIONS, *WAVES),
    seeds: Sequence[int] = SEEDS,
) -> list[AccuracyCase]:
    """Every preset with every condition (voxel in mm, SNR), motion and seed; shear waves with the first seed only.

    By default seven motions with two heels each and eight waves, at five conditions: 110 registrations. For an engine
    that needs labels these are exact, too large and too small in turn, and there are no waves, which move bone as they
    move tissue.
    """
    return [
        AccuracyCase(preset, spacing, snr, motion, seed, LABELS_OFF[(m + s) % len(LABELS_OFF)] if labelled else 0)
        for preset, labelled in [(preset, engine_named(preset).needs_labels) for preset in presets]
        for spacing, snr in conditions
        for m, motion in enumerate(motions)
        if not (labelled and motion.startswith("wave-"))
        for s, seed in enumerate(seeds[:1] if motion.startswith("wave-") else seeds)
    ]


def expected_minutes(cases: Sequence[AccuracyCase], workers: int) -> float:
    """Estimated time of the cases with so many ``workers``, minutes."""
    return sum(engine_named(case.preset).cost.phantom_seconds for case in cases) / workers / 60.0


def accuracy(
    out: Path | str,
    *,
    cases: Sequence[AccuracyCase] | None = None,
    workers: int | None = None,
    tell_plan: Callable[[str], None] | None = None,
    progress: OnProgress | None = None,
) -> AccuracyStudy:
    """Measure the error of registration presets on phantoms; an interrupted study resumes.

    Parameters
    ----------
    out : path
        Samples of each run are kept in ``runs`` and used again as long as preset and software (`dvc.software`) are
        unchanged. Tables and report cover all runs found there, so a later call with other cases adds to them.
    cases : sequence of AccuracyCase
        Default: ``accuracy_cases()``.
    workers : int
        Registrations at once, on one thread each; by default one for each core.
    tell_plan : callable, optional
        Called with a sentence before anything runs: number of registrations and estimated time.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError
        Before anything runs: if the voxel size, SNR, motion or preset of a case is invalid, or two parameter files
        share a name, here or with an earlier call.
    OutputError
        If the folder cannot be written to, or the disk has too little room.
    MrstrainError
        If every run failed.
    """
    wanted = list(accuracy_cases() if cases is None else cases)
    if not wanted or len(set(wanted)) < len(wanted):
        raise InputError(
            "An accuracy study needs at least one case, and each only once (an engine that needs labels has "
            "no waves: they move bone)."
        )
    for case in wanted:
        _check(case)
    target = Path(out)
    folder = target / "runs"
    runs = _finished(folder)
    _refuse_one_name_for_two([*(run.case for run in runs.values()), *wanted])
    missing = [case for case in wanted if case.name not in runs]
    refuse_small_disk(target, len(missing) * _MEGABYTES * 1e6 + 20e6, "the study needs", ", or a smaller study")
    make_output(target)
    folder.mkdir(exist_ok=True)
    at_once = max(1, min(workers or usable_cores(), len(missing)))
    if tell_plan is not None:
        tell_plan(
            f"{len(missing)} registrations to do ({len(wanted) - len(missing)} are there already), about "
            f"{expected_minutes(missing, at_once):.0f} minutes with {at_once} at once."
        )
    failures = _measure_all(missing, at_once, folder, runs, progress or (lambda *_: None))
    if not runs:
        raise MrstrainError("No case could be measured. " + " ".join(f"{n}: {r}" for n, r in failures.items()))
    return _write(target, [runs[name] for name in sorted(runs)], failures)


def _finished(folder: Path) -> dict[str, ErrorSamples]:
    """Samples of this and earlier calls, by case, whose preset and software are unchanged."""
    runs: dict[str, ErrorSamples] = {}
    for path in sorted(folder.glob("*.npz")):
        with suppress(MrstrainError):  # the parameter file no longer exists
            if samples := ErrorSamples.read(path, _key):
                runs[samples.case.name] = samples
    return runs


def _refuse_one_name_for_two(cases: Sequence[AccuracyCase]) -> None:
    """Refuse parameter files that share a name: runs and error models are stored under it."""
    named: dict[str, str] = {}
    for case in cases:
        other = named.setdefault(Path(case.preset).stem, case.preset)
        if other != case.preset:
            raise InputError(
                f"{other} and {case.preset} would share the name '{Path(other).stem}' in this study: rename one, or "
                "measure it in another --out."
            )


def _check(case: AccuracyCase) -> None:
    engine_named(case.preset)
    heel_grid(case.spacing_mm)
    if case.wavelength_mm is not None and not case.wavelength_mm >= 2.0 * max(case.spacing_mm):
        raise InputError(f"{case.motion}: a wave needs at least two voxels of {max(case.spacing_mm):g} mm.")
    if not 1.0 <= case.snr <= 1000.0:
        raise InputError(f"The SNR must lie between 1 and 1000; got {case.snr}.")
    motion = motion_named(Heel(case.seed), case.motion)
    if motion is None:
        return
    points = np.random.default_rng(0).uniform([-32, -50, -44], [32, 44, 40], (2000, 3))
    _, H = motion.evaluate(points)
    lowest = float(np.linalg.det(H + np.eye(3)).min())
    if not lowest > 0.0:
        raise InputError(f"The motion '{case.motion}' folds (det F = {lowest:.2f}); no image can show it.")


def _key(case: AccuracyCase) -> str:
    """Hash of what a run depends on besides its case: preset and software."""
    text = engine_named(case.preset).text
    return hashlib.sha256(f"{text}; {software_key('phantoms')}".encode()).hexdigest()


def _measure_all(
    cases: Sequence[AccuracyCase], at_once: int, folder: Path, runs: dict[str, ErrorSamples], progress: OnProgress
) -> dict[str, str]:
    """Measure cases, several at once; each is written and added to ``runs`` as soon as it is finished."""
    computing, reporting = threading.Lock(), threading.Lock()
    failures: dict[str, str] = {}
    fractions: dict[str, float] = {}

    def report(name: str, fraction: float) -> None:
        with reporting:
            fractions[name] = fraction
            # relative to the cases of this call, so that the time left is that of this call
            progress("accuracy", f"{len(cases)} registrations", sum(fractions.values()) / len(cases))

    def measure_one(case: AccuracyCase, worker: Worker) -> None:
        try:
            samples = measure_run(case, worker, computing, lambda fraction: report(case.name, fraction))
            samples.write(folder / f"{case.name}.npz", _key(case))
            runs[case.name] = samples
        except MrstrainError as error:
            failures[case.name] = str(error)
        report(case.name, 1.0)

    each_in_workers(cases, measure_one, at_once=at_once, threads=1)
    return failures


def _write(target: Path, runs: Sequence[ErrorSamples], failures: dict[str, str]) -> AccuracyStudy:
    errors, floors, resolution = (
        tuple(phantoms.error_rows(runs)),
        tuple(phantoms.floor_rows(runs)),
        tuple(phantoms.resolution_rows(runs)),
    )
    study, coverage = AccuracyStudy(target, errors, floors, resolution, failures), phantoms.coverage_rows(runs)
    tables: tuple[tuple[str, type[Any], Sequence[Any]], ...] = (
        ("errors", phantoms.ErrorRow, errors),
        ("zero_strain", phantoms.FloorRow, floors),
        ("resolution", phantoms.ResolutionRow, resolution),
        ("coverage", phantoms.CoverageRow, coverage),
        ("runs", phantoms.RunRow, phantoms.run_rows(runs)),
    )
    for name, kind, rows in tables:
        write_csv(target / f"{name}.csv", [f.name for f in fields(kind)], map(astuple, rows))
    presets = {preset: engine_named(preset).text for preset in dict.fromkeys(r.case.preset for r in runs)}
    for preset, text in presets.items():
        some = [r for r in runs if r.case.preset == preset and r.case.keeps_volume and r.case.wavelength_mm is None]
        if some:
            model = phantoms.fit_error_model(some, text, _source(some))
            model.write(target / f"error_model_{Path(preset).stem}.json")
    seconds = {r.case.name: round(r.seconds, 1) for r in runs}
    parameters = {"cases": list(seconds), "failures": failures, "presets": presets, "seconds_of_registration": seconds}
    record = provenance("accuracy", {}, parameters)
    write_json(target / PROVENANCE, record)
    write_accuracy_report(target / REPORT, errors, floors, resolution, coverage, failures, record)
    return study


def _source(runs: Sequence[ErrorSamples]) -> str:
    """A sentence on the registrations that an error model is fitted to."""
    seeds = sorted({r.case.seed for r in runs})
    motions = ", ".join(dict.fromkeys(r.case.motion for r in runs))
    source = f"{len(runs)} registrations of phantom heels, seeds {seeds}, motions {motions}"
    if any(r.case.labels_off for r in runs):
        off = ", ".join(f"{by:+d}" for by in sorted({r.case.labels_off for r in runs}))
        source += f", bones and skin in label maps too large by {off} voxels"
    return source
