"""`accuracy`: error of a registration preset by tissue, position, strain, noise and resolution, on phantoms."""

import hashlib
import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from dvc import Engine, engine_named
from dvc.errors import InputError, MrstrainError
from dvc.file_names import clash
from dvc.software import software_key
from dvc.worker import Worker, each_in_workers
from mrstrain.measurement.engines import AT_BONE
from mrstrain.options.measurement import in_parallel
from mrstrain.records.durations import REPORT, accuracy_runs, phantom_s
from mrstrain.records.inputs import alone, output_folder, refuse_small_disk
from mrstrain.records.outcome import with_reasons
from mrstrain.records.progress import OnProgress, expect
from mrstrain.truth.accuracy_study import AccuracyStudy
from phantoms import AccuracyCase, ErrorSamples, Heel, heel_grid, measure_run, motion_named

MOTIONS = ("still", "smooth", "sliding", "Load1", "Load2", "Load3", "Load4", "attached-Load1", "attached-Load3")
WAVES = tuple(f"wave-{length}" for length in (6, 8, 10, 12, 16, 20, 24, 48))
CONDITIONS: tuple[tuple[tuple[float, float, float], float], ...] = (
    *(((0.8, 0.8, 0.8), snr) for snr in (25.0, 12.0, 50.0)),
    *((spacing, 25.0) for spacing in ((1.2, 1.2, 1.2), (0.8, 0.8, 1.6))),
)
"""Voxel size (mm) and signal-to-noise ratio of the default study."""
SEEDS = (1, 2)
"""Heels of the default study. Published figures come from 9000 to 9999, on which nothing is ever tuned."""
LABELS_OFF = (0, 1, -1)
"""Voxels by which bones and skin are too large in the label maps, in turn, for an engine that relies on them or on the
bone."""

_CASE = "accuracy"  # of progress
_log = logging.getLogger(__name__)
_MEGABYTES = 8.0  # measured for one run's samples at 0.8 mm


def accuracy_cases(
    presets: Sequence[str] = (AT_BONE,), conditions: Sequence[tuple[tuple[float, float, float], float]] = CONDITIONS,
    motions: Sequence[str] | None = None, seeds: Sequence[int] = SEEDS,
) -> list[AccuracyCase]:  # fmt: skip
    """Every preset with every condition (voxel in mm, SNR), motion and seed; shear waves with the first seed only.

    By default the engine of `register` without labels, with nine motions of two heels each at five conditions: 90
    registrations. For an engine with a rigid bone, its labels or bone masks are exact, too large and too small in turn,
    and waves, which move bone as they move tissue, are left out. Other engines also get eight waves at each condition.

    Raises
    ------
    InputError
        If waves are asked for with an engine that keeps the bone rigid.
    """
    rigid = {preset: _keeps_bone_rigid(engine_named(preset)) for preset in presets}
    if any(rigid.values()) and any(map(_is_wave, motions or ())):
        kept = ", ".join(preset for preset in presets if rigid[preset])
        raise InputError(
            f"Wave motions also deform bone, which {kept} keeps rigid. Leave them out, or use an engine that does not, "
            "such as the preset gauss-newton (--preset gauss-newton)."
        )
    return [
        AccuracyCase(preset, spacing, snr, motion, seed, LABELS_OFF[(m + s) % len(LABELS_OFF)] if rigid[preset] else 0)
        for preset in presets
        for spacing, snr in conditions
        for m, motion in enumerate(motions or (*MOTIONS, *WAVES))
        if not (rigid[preset] and _is_wave(motion))
        for s, seed in enumerate(seeds[:1] if _is_wave(motion) else seeds)
    ]


def _is_wave(motion: str) -> bool:
    return motion.startswith("wave-")


def _keeps_bone_rigid(engine: Engine) -> bool:
    """Whether an engine has the bone as an interface, so that its error depends on where that was drawn."""
    return engine.needs_labels or engine.needs_bone


def expected_minutes(cases: Sequence[AccuracyCase], workers: int) -> float:
    """Estimated time of the cases with so many ``workers``, minutes."""
    voxels_mm3 = [float(np.prod(case.spacing_mm)) for case in cases]
    runs = zip(cases, voxels_mm3, strict=True)
    return sum(phantom_s(engine_named(case.preset).cost, voxel) for case, voxel in runs) / workers / 60.0


def accuracy(
    out: Path | str, *, cases: Sequence[AccuracyCase] | None = None, workers: int | None = None,
    tell_plan: Callable[[str], None] | None = None, progress: OnProgress | None = None,
) -> AccuracyStudy:  # fmt: skip
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
        raise InputError("Give at least one case, and each only once.")
    for case in wanted:
        _check(case)
    target, folder = Path(out), Path(out) / "runs"
    runs = _finished(folder)
    _refuse_one_name_for_two([*(run.case for run in runs.values()), *wanted])
    missing = [case for case in wanted if case.name not in runs]
    refuse_small_disk(target, len(missing) * _MEGABYTES * 1e6 + 20e6, "the study needs", ", or a smaller study")
    at_once = max(1, min(in_parallel(workers), len(missing)))
    if tell_plan is not None:
        minutes = max(expected_minutes(missing, at_once), 1.0) if missing else 0.0
        tell_plan(
            f"Registrations to run: {len(missing)}, {at_once} at a time, about {minutes:.0f} min on idle cores; "
            f"already done: {len(wanted) - len(missing)}."
        )
    with output_folder(folder), alone(target):
        if missing:
            expect(progress, {_CASE: accuracy_runs(_named(missing), 60.0 * expected_minutes(missing, at_once))})
        tell = progress or (lambda *_: None)
        failures = _measure_all(missing, at_once, folder, runs, tell)
        if not runs:
            raise MrstrainError(with_reasons("No case could be measured.", [f"{n}: {r}" for n, r in failures.items()]))
        tell(_CASE, REPORT, 0.0)
        study = AccuracyStudy.of(target, [runs[name] for name in sorted(runs)], failures)
        tell(_CASE, REPORT, 1.0)
        return study


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
    presets = dict.fromkeys(case.preset for case in cases)
    if twice := clash(Path(preset).stem for preset in presets):
        raise InputError(
            f"Two of the parameter files {', '.join(presets)} would have one name in this study, {twice}. Rename one, "
            "or use another folder (out)."
        )


def _check(case: AccuracyCase) -> None:
    engine_named(case.preset)
    heel_grid(case.spacing_mm)
    motion = motion_named(Heel(case.seed), case.motion)
    if case.wavelength_mm is not None and not case.wavelength_mm >= 2.0 * max(case.spacing_mm):
        raise InputError(f"{case.motion}: the wavelength must be at least two voxels of {max(case.spacing_mm):g} mm.")
    if not 1.0 <= case.snr <= 1000.0:
        raise InputError(f"The SNR must be between 1 and 1000; got {case.snr}.")
    points = np.random.default_rng(0).uniform([-32, -50, -44], [32, 44, 40], (2000, 3))
    lowest = 1.0 if motion is None else float(np.linalg.det(motion.evaluate(points)[1] + np.eye(3)).min())
    if not lowest > 0.0:
        raise InputError(f"The motion '{case.motion}' folds (det F = {lowest:.2f}), which is not possible in an image.")


def _key(case: AccuracyCase) -> str:
    """Hash of what a run depends on besides its case: preset and software."""
    return hashlib.sha256(f"{engine_named(case.preset).text}; {software_key('phantoms')}".encode()).hexdigest()


def _named(cases: Sequence[AccuracyCase]) -> str:
    """What is done with cases, in words."""
    return f"{len(cases)} registration{'s' * (len(cases) > 1)}"


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
            progress(_CASE, _named(cases), sum(fractions.values()) / len(cases))

    def measure_one(case: AccuracyCase, worker: Worker) -> None:
        try:
            samples = measure_run(case, worker, computing, lambda fraction: report(case.name, fraction))
            samples.write(folder / f"{case.name}.npz", _key(case))
            runs[case.name] = samples
        except MrstrainError as error:
            failures[case.name] = str(error)
            _log.info("%s failed", case.name, exc_info=error)
        report(case.name, 1.0)

    each_in_workers(cases, measure_one, at_once=at_once, threads=1)
    return failures
