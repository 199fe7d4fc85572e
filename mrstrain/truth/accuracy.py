"""`accuracy`: the error of a preset, by tissue, place, strain, noise and resolution, on phantoms of known strain."""

from __future__ import annotations

import csv
import hashlib
import io
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from dvc.atomic_files import write_json, write_whole
from dvc.errors import InputError, MrstrainError
from dvc.io.result_folder import PROVENANCE, REPORT
from dvc.registration.register import AT_BORDERS, GAUSS_NEWTON, Settings
from dvc.software import software_key
from dvc.worker import Worker, each_in_workers, usable_cores
from mrstrain.records.inputs import make_output, refuse_small_disk
from mrstrain.records.provenance import provenance
from mrstrain.truth.accuracy_page import write_study_report
from phantoms.accuracy_run import Case, Samples, measure, motion_named
from phantoms.anatomy import Heel
from phantoms.error_model import CoverageRow, coverage_rows, fit_error_model
from phantoms.error_tables import (
    ErrorRow,
    FloorRow,
    ResolutionRow,
    RunRow,
    error_rows,
    floor_rows,
    resolution_rows,
    run_rows,
)
from phantoms.heel import heel_grid

Told = Callable[[str, str, float], None]

MOTIONS = ("still", "smooth", "sliding", "Load1", "Load2", "Load3", "Load4")
WAVES = tuple(f"wave-{length}" for length in (6, 8, 10, 12, 16, 20, 24, 48))
CONDITIONS: tuple[tuple[tuple[float, float, float], float], ...] = (
    ((0.8, 0.8, 0.8), 25.0),
    ((0.8, 0.8, 0.8), 12.0),
    ((0.8, 0.8, 0.8), 50.0),
    ((1.2, 1.2, 1.2), 25.0),
    ((0.8, 0.8, 1.6), 25.0),
)
"""Voxel (mm) and signal-to-noise ratio of the default study."""
SEEDS = (1, 2)
"""Published figures come from 9000 to 9999, on which nothing is ever tuned."""
LABELS_OFF = (0, 1, -1)
"""By how many voxels bones and skin are too large in label maps, in turn, where the engine believes them."""

_SECONDS = 30.0  # of one run on one core, as measured, half of it to make and to score the pair
_BORDERS_SECONDS = 52.0  # with borders of tissues
_ELASTIX_SECONDS = 75.0  # as measured: 3,500 iterations, whatever the voxel
_MEGABYTES = 5.0  # of one run's samples, as measured at 0.8 mm


@dataclass(frozen=True, slots=True)
class Study:
    """What a study gave.

    Attributes
    ----------
    out : Path
        With ``errors.csv``, ``zero_strain.csv``, ``resolution.csv``, ``coverage.csv``, an error model of each preset
        and ``report.html``.
    errors, floors, resolution : tuple of rows
        As in the tables.
    failures : dict
        Case to the reason why it has no result.
    """

    out: Path
    errors: tuple[ErrorRow, ...]
    floors: tuple[FloorRow, ...]
    resolution: tuple[ResolutionRow, ...]
    failures: dict[str, str]

    def summary(self) -> list[str]:
        """A few lines for a person."""
        lines = [
            f"{r.preset}, {r.voxel_mm} mm, SNR {r.snr:g}, {r.motion}, {r.tissue}: maximal shear RMSE "
            f"{r.shear_rmse:.4f}, bias {r.shear_bias:+.4f}; displacement RMSE {r.u_rmse_mm:.3f} mm"
            for r in self.errors
            if r.by == "all" and r.tissue == "fat"
        ]
        lines += [f"{name}: FAILED. {reason}" for name, reason in self.failures.items()]
        return [*lines, f"Report: {self.out / REPORT}"]


def cases_of(
    presets: Sequence[str] = (GAUSS_NEWTON,),
    conditions: Sequence[tuple[tuple[float, float, float], float]] = CONDITIONS,
    motions: Sequence[str] = (*MOTIONS, *WAVES),
    seeds: Sequence[int] = SEEDS,
) -> list[Case]:
    """Every preset with every condition (voxel in mm, SNR), motion and seed; waves with the first seed alone.

    By default seven motions with two heels each and eight waves, at five conditions: 110 registrations. With borders of
    tissues label maps are exact, too large and too small in turn, and there are no waves, which move bone as they move
    tissue.
    """
    return [
        Case(preset, spacing, snr, motion, seed, LABELS_OFF[(m + s) % len(LABELS_OFF)] if preset == AT_BORDERS else 0)
        for preset in presets
        for spacing, snr in conditions
        for m, motion in enumerate(motions)
        if not (preset == AT_BORDERS and motion.startswith("wave-"))
        for s, seed in enumerate(seeds[:1] if motion.startswith("wave-") else seeds)
    ]


def expected_minutes(cases: Sequence[Case], workers: int) -> float:
    """About how long registrations take, so many at once."""
    own = {GAUSS_NEWTON: _SECONDS, AT_BORDERS: _BORDERS_SECONDS}
    return sum(own.get(case.preset, _ELASTIX_SECONDS) for case in cases) / workers / 60.0


def accuracy(
    out: Path | str,
    *,
    cases: Sequence[Case] | None = None,
    workers: int | None = None,
    tell_plan: Callable[[str], None] | None = None,
    progress: Told | None = None,
) -> Study:
    """Measure the error of registration presets on phantoms; a study that was broken off goes on where it stopped.

    Parameters
    ----------
    out : path
        Each run's samples are kept in ``runs``, and used again while preset and software (`dvc.software`) are the
        same. Tables and page are of all that lies there: a later call with other cases adds to them.
    cases : sequence of Case
        The default of `cases_of` where not given.
    workers : int
        Registrations at once, on one thread each; by default one for each core.
    tell_plan : callable, optional
        Gets a sentence before anything runs: how many registrations, and about how long.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Returns
    -------
    Study

    Raises
    ------
    InputError
        For a case that cannot be: voxel, noise, motion or preset; for two parameter files of one name, here or in an
        earlier call. Before anything runs.
    OutputError
        If the folder cannot be written to, or the disk has too little room.
    MrstrainError
        If every run failed.
    """
    wanted = list(cases_of() if cases is None else cases)
    if not wanted or len(set(wanted)) < len(wanted):
        raise InputError(
            f"A study needs at least one case, and each only once (none is {AT_BORDERS} with a wave, which moves bone)."
        )
    for case in wanted:
        _check(case)
    target = Path(out)
    runs = target / "runs"
    found = _finished(runs)
    _refuse_one_name_for_two([*(samples.case for samples in found.values()), *wanted])
    left = [case for case in wanted if case.name not in found]
    refuse_small_disk(target, len(left) * _MEGABYTES * 1e6 + 20e6, "the study needs", ", or a smaller study")
    make_output(target)
    runs.mkdir(exist_ok=True)
    at_once = max(1, min(workers or usable_cores(), len(left)))
    if tell_plan is not None:
        tell_plan(
            f"{len(left)} registrations to do ({len(wanted) - len(left)} are there already), about "
            f"{expected_minutes(left, at_once):.0f} minutes with {at_once} at once."
        )
    failures = _run_all(left, at_once, runs, found, progress or (lambda *_: None))
    if not found:
        raise MrstrainError("No case could be measured. " + " ".join(f"{n}: {r}" for n, r in failures.items()))
    return _write(target, [found[name] for name in sorted(found)], failures)


def _finished(folder: Path) -> dict[str, Samples]:
    """Runs of this and of earlier calls that are as they would be made now."""
    found: dict[str, Samples] = {}
    for path in sorted(folder.glob("*.npz")):
        try:
            samples = Samples.read(path, _key)
        except MrstrainError:  # its preset is gone
            continue
        if samples is not None:
            found[samples.case.name] = samples
    return found


def _refuse_one_name_for_two(cases: Sequence[Case]) -> None:
    """Runs and error models are kept under the preset's or file's name: one of two would pass for the other."""
    named: dict[str, str] = {}
    for case in cases:
        other = named.setdefault(Path(case.preset).stem, case.preset)
        if other != case.preset:
            raise InputError(
                f"{other} and {case.preset} would share the name '{Path(other).stem}' in this study: rename one, or "
                "judge it in another --out."
            )


def _check(case: Case) -> None:
    for preset in Settings.of(case.preset).presets:
        if "BSplineTransform" not in preset.transform:
            raise InputError(
                f"{preset.name} finds no B-spline ({preset.transform}); a study judges non-rigid registration."
            )
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


def _key(case: Case) -> str:
    """What a run's result depends on beside its case."""
    text = Settings.of(case.preset).text
    return hashlib.sha256(f"{text}; {software_key('phantoms')}".encode()).hexdigest()


def _run_all(
    cases: Sequence[Case], at_once: int, folder: Path, found: dict[str, Samples], tell: Told
) -> dict[str, str]:
    """Measure cases, several at once; each is written as soon as it is there."""
    making, telling = threading.Lock(), threading.Lock()
    failures: dict[str, str] = {}
    under_way: dict[str, float] = {}

    def told(name: str, fraction: float) -> None:
        with telling:
            under_way[name] = fraction
            # of those to do now, so that the time left is that of this session
            tell("accuracy", f"{len(cases)} registrations", sum(under_way.values()) / len(cases))

    def one(case: Case, worker: Worker) -> None:
        try:
            samples = measure(case, worker, making, lambda fraction: told(case.name, fraction))
            samples.write(folder / f"{case.name}.npz", _key(case))
            found[case.name] = samples
        except MrstrainError as error:
            failures[case.name] = str(error)
        told(case.name, 1.0)

    each_in_workers(cases, one, at_once=at_once, threads=1)
    return failures


def _write(target: Path, runs: Sequence[Samples], failures: dict[str, str]) -> Study:
    errors, floors, resolution = error_rows(runs), floor_rows(runs), resolution_rows(runs)
    coverage = coverage_rows(runs)
    for name, rows, kind in (
        ("errors", errors, ErrorRow),
        ("zero_strain", floors, FloorRow),
        ("resolution", resolution, ResolutionRow),
        ("coverage", coverage, CoverageRow),
        ("runs", run_rows(runs), RunRow),
    ):
        _write_csv(target / f"{name}.csv", [f.name for f in fields(kind)], [asdict(row) for row in rows])
    presets = list(dict.fromkeys(r.case.preset for r in runs))
    for preset in presets:
        some = [r for r in runs if r.case.preset == preset and r.case.keeps_volume]
        if any(r.case.wavelength_mm is None for r in some):
            plain = [r for r in some if r.case.wavelength_mm is None]
            seeds = sorted({r.case.seed for r in plain})
            motions = ", ".join(dict.fromkeys(r.case.motion for r in plain))
            source = f"{len(plain)} registrations of phantom heels, seeds {seeds}, motions {motions}"
            if any(r.case.labels_off for r in plain):
                off = ", ".join(f"{by:+d}" for by in sorted({r.case.labels_off for r in plain}))
                source += f", bones and skin in label maps too large by {off} voxels"
            fit_error_model(some, Settings.of(preset).text, source).write(
                target / f"error_model_{Path(preset).stem}.json"
            )
    record = provenance(
        "accuracy",
        {},
        {
            "cases": [r.case.name for r in runs],
            "failures": dict(failures),
            "presets": {p: Settings.of(p).text for p in presets},
            "seconds_of_registration": {r.case.name: round(r.seconds, 1) for r in runs},
        },
    )
    write_json(target / PROVENANCE, record)
    write_study_report(target / REPORT, errors, floors, resolution, coverage, failures, record)
    return Study(target, tuple(errors), tuple(floors), tuple(resolution), failures)


def _write_csv(path: Path, columns: Sequence[str], rows: Sequence[dict[str, object]]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    write_whole(path, text.getvalue())
