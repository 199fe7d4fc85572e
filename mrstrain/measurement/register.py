"""`register`: images in, a folder of strain maps and a report out."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dvc.atomic_files import write_json
from dvc.deformation.bordered_spline import Spline
from dvc.deformation.protocol import Deformation
from dvc.errors import InputError, MrstrainError, ParameterError, RegistrationError
from dvc.images.image import Image
from dvc.io.images.read import read_image
from dvc.io.result_folder import PROVENANCE, REPEAT, REPORT
from dvc.measurement.source import Evidence
from dvc.registration.align import AlignOn, without_motion
from dvc.registration.register import GAUSS_NEWTON, refuse_one_image_twice
from dvc.trust.error_model import error_model_of, read_error_model
from dvc.trust.landmarks import read_landmarks
from dvc.trust.quality import NoiseFloor
from dvc.worker import Worker, each_in_workers, usable_cores
from mrstrain.measurement.case import Case
from mrstrain.measurement.engines import settings_of
from mrstrain.measurement.page import write_series_report
from mrstrain.measurement.plan import Plan, Registered, record_of
from mrstrain.measurement.strain import read_any
from mrstrain.records.inputs import (
    case_names,
    make_output,
    read_subject,
    refuse_small_disk,
    refuse_touching_inputs,
)

Told = Callable[[str, str, float], None]
_BYTES_PER_VOXEL = 30  # of one image's results: 22 as measured, 5 with the plate's axes
_BYTES_WITH_BORDERS = 24  # more: transform.h5 then holds displacements


@dataclass(frozen=True, slots=True)
class Series:
    """What a series gave.

    Attributes
    ----------
    out : Path
        Folder of all results; ``report.html`` is in it.
    cases : tuple of Case
        The loads that were registered, in the order given; the repeat scan first, if there is one.
    failures : dict
        Load to the reason why it was not.
    """

    out: Path
    cases: tuple[Case, ...]
    failures: dict[str, str]

    def summary(self) -> list[str]:
        """A few lines for a person."""
        lines = [line for case in self.cases for line in case.summary()]
        lines += [f"{name}: FAILED. {reason}" for name, reason in self.failures.items()]
        return [*lines, f"Report: {self.out / REPORT}"]


def register(
    load0: Path | str,
    loads: Sequence[Path | str],
    *,
    out: Path | str,
    bone: Path | str | None = None,
    bone_label: str | None = None,
    tissue: Path | str | None = None,
    labels: Path | str | None = None,
    names: Path | str | None = None,
    align: AlignOn = "bone",
    engine: str | None = None,
    bending: float | None = None,
    volume: float | None = None,
    borders: bool | None = None,
    preset: str | None = None,
    parameters: Sequence[Path | str] = (),
    allow_unknown_parameters: bool = False,
    chain: bool = False,
    start: Path | str | None = None,
    start_frame: str | None = None,
    repeat: Path | str | None = None,
    landmarks: Path | str | None = None,
    mesh: Path | str | None = None,
    mesh_unit: str = "mm",
    mesh_frame: str = "LPS",
    plate_normal: Sequence[float] | None = None,
    shear_direction: Sequence[float] | None = None,
    error_model: Path | str | None = None,
    twin: bool = False,
    allow_missing: bool = False,
    workers: int | None = None,
    threads: int | None = None,
    seed: int = 1,
    progress: Told | None = None,
) -> Series:
    """Register loaded images to the unloaded one and write displacement, strain, quality and a report.

    Parameters
    ----------
    load0 : path
        Unloaded image (reference configuration).
    loads : paths
        Loaded images. Each gets a folder in ``out`` named after its file.
    out : path
    bone : path, optional
        Mask of the bone to align on, on the unloaded image; or ``bone_label``, its name in ``labels``.
    tissue : path, optional
        Mask of the body, bone included; found by a threshold where it is not given.
    labels, names : path, optional
        Label map of the tissues on the unloaded image and the table of its names, for statistics by region, and for
        ``borders``.
    align : {"bone", "image", "none"}
    engine : {"gauss-newton", "elastix"}, optional
        What finds the non-rigid part: our own, unless a preset or parameter files of elastix are given. ``bending``
        (1/mm) and ``volume`` (1/mm3) fix our own engine's weights, which are otherwise chosen for each pair.
    borders : bool, optional
        Our own engine: strain may jump where the tissues of ``labels`` meet, and the bone stays exactly at rest. By
        default where labels are given; False for a label map that is off by more than a voxel.
    preset : str, optional
        Named parameters of elastix, heel-mr by default; or ``parameters``, files of your own, applied one after the
        other.
    chain : bool
        Start each load from the result of the one before, in the order given.
    start : path, optional
        What any tool has found for a single loaded image, to be refined by our own engine: a transform or displacement
        image, as in `strain`, with ``start_frame`` ("LPS" or "RAS") where a displacement image does not tell it.
    repeat : path, optional
        A second unloaded image; its apparent strain is the noise floor.
    landmarks : path, optional
        CSV of point pairs (x0, y0, z0, x1, y1, z1; LPS mm), for a single loaded image.
    mesh : path, optional
        Displacement and strain are written at its nodes and cells.
    plate_normal, shear_direction : (3,), optional
        LPS. The plate's outward normal (default: inferior) finds the bone's lowest point; with a shear direction,
        strain is written in the plate's axes as well.
    error_model : path, optional
        Error model of the preset or parameters, as `accuracy` writes it; by default the one that comes with the preset.
    twin : bool
        Also register each pair's twin, the unloaded image moved by what was found: its true strain is known, and error
        bars that do not hold there are made wider. Twice the time.
    allow_missing : bool
        Leave NaN or infinite voxels out instead of refusing the image.
    workers, threads : int, optional
        Loads at once, and threads of each; by default all cores are used.
    seed : int
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Returns
    -------
    Series
        A load that fails is named in ``failures``; the others are finished.

    Raises
    ------
    MrstrainError
        For any input that cannot be used, before anything is computed; or if every load failed.
    """
    target = Path(out)
    paths = [Path(p) for p in loads]
    cases = case_names(paths)
    if repeat is not None:
        if REPEAT in cases:
            raise InputError(
                f"A loaded image is called '{REPEAT}', the folder name kept for the repeat scan: rename it."
            )
        cases, paths = [*cases, REPEAT], [*paths, Path(repeat)]
    if not paths:
        raise InputError("Give at least one loaded image.")
    for option, value in (("--landmarks", landmarks), ("--start", start)):
        if value is not None and len(loads) != 1:
            raise InputError(f"{option}: belongs to one loaded image; {len(loads)} are given. Register that one alone.")
    settings = settings_of(
        engine, preset, parameters, bending=bending, volume=volume, borders=borders, labelled=labels is not None,
        allow_unknown=allow_unknown_parameters,
    )  # fmt: skip
    if start_frame is not None and start is None:
        raise ParameterError("--start-frame is the frame of --start, which is not given.")
    if start is not None and settings.gauss_newton is None:
        raise ParameterError(f"--start is for --engine {GAUSS_NEWTON}; elastix begins at results of its own (--chain).")
    files = (load0, *paths, bone, tissue, labels, names, landmarks, start, mesh, error_model)
    given = [Path(p) for p in files if p is not None]
    refuse_touching_inputs(target, cases, given)
    subject = read_subject(
        load0,
        bone=bone,
        bone_label=bone_label,
        tissue=tissue,
        labels=labels,
        names=names,
        mesh=mesh,
        mesh_unit=mesh_unit,
        mesh_frame=mesh_frame,
        plate_normal=plate_normal,
        shear_direction=shear_direction,
        allow_missing=allow_missing,
    )
    if align == "bone" and subject.bone is None:
        raise InputError(
            "Aligning on the bone needs it: give --bone, or --bone-label with --labels, or another --align."
        )
    images = {name: read_image(path, allow_missing=allow_missing) for name, path in zip(cases, paths, strict=True)}
    # Read now: what is wrong with it must not be found after an hour.
    model = None if error_model is None else read_error_model(error_model)
    points = None if landmarks is None else read_landmarks(landmarks)[:2]
    subject = replace(subject, tissue=subject.body())
    held = {"bone": subject.bone, "image": subject.tissue, "none": None}[align]
    begun_at = None if start is None else without_motion(read_any(start, start_frame), held)[0]
    refuse_one_image_twice(
        [(str(path), image) for path, image in zip((load0, *paths), (subject.reference, *images.values()), strict=True)]
    )
    each_voxel = _BYTES_PER_VOXEL + (0 if settings.borders is None else _BYTES_WITH_BORDERS)
    needed = each_voxel * int(np.prod(subject.reference.grid.shape)) * len(cases)
    refuse_small_disk(target, needed, f"the results of {len(cases)} images need", " or fewer loads")
    make_output(target)
    cores = usable_cores()
    at_once = 1 if chain else min(workers or cores, cores, len(cases))
    each = threads or max(1, cores // at_once)
    settings = replace(settings, align_on=align, seed=seed, threads=each)
    model = model or error_model_of(settings.name)
    record = record_of(
        subject,
        {
            "loads": paths[: len(loads)],
            "repeat": paths[len(loads) :],
            "landmarks": [] if landmarks is None else [Path(landmarks)],
            "start": [] if start is None else [Path(start)],
            "error_model": [] if error_model is None else [Path(error_model)],
        },
        settings,
        {
            "chain": chain,
            "twin": twin,
            "start_frame": start_frame,
            "bone_label": bone_label,
            "shear_direction_lps": None if shear_direction is None else list(shear_direction),
            "mesh_unit": mesh_unit,
            "mesh_frame": mesh_frame,
            "allow_missing": allow_missing,
        },
    )
    plan = Plan(subject, settings, Evidence(points, error_model=model), record, twin)
    run = _Run(target, plan, images, begun_at, progress or (lambda *_: None))
    run.all(at_once, chain)
    finished = [run.cases[name] for name in cases if name in run.cases]
    if not finished:
        raise RegistrationError(
            "No load could be registered. " + " ".join(f"{n}: {r}" for n, r in run.failures.items())
        )
    write_json(target / PROVENANCE, record)
    write_series_report(target / REPORT, [case.section for case in finished], run.failures, record)
    return Series(target, tuple(finished), run.failures)


class _Run:
    """The loads of one series: registered in worker processes, each written as soon as it is finished."""

    def __init__(self, out: Path, plan: Plan, images: dict[str, Image], start: Deformation | None, tell: Told) -> None:
        self.out, self.plan, self.images, self.start, self._tell = out, plan, images, start, tell
        self.cases: dict[str, Case] = {}
        self.failures: dict[str, str] = {}
        self._floor: NoiseFloor | None = None
        self._telling, self._writing = threading.Lock(), threading.Lock()
        self._floor_known = threading.Event()
        if REPEAT not in images:
            self._floor_known.set()

    def all(self, at_once: int, chain: bool) -> None:
        last: list[Spline] = []

        def one(name: str, worker: Worker) -> None:
            is_repeat = name == REPEAT
            start = None if is_repeat else last[-1] if chain and last else self.start

            def told(stage: str, fraction: float) -> None:
                self._told(name, stage, fraction)

            try:
                done = self.plan.register(self.images[name], start, worker, told, is_repeat=is_repeat)
                if not is_repeat:
                    last.append(done.found.bspline)
                    self._floor_known.wait()
                self._write(name, done)
            except MrstrainError as error:
                self.failures[name] = str(error)
            finally:
                if is_repeat:
                    self._floor_known.set()

        names = sorted(self.images, key=lambda name: name != REPEAT)  # its floor is waited for
        each_in_workers(names, one, at_once=at_once, threads=self.plan.settings.threads)

    def _write(self, name: str, done: Registered) -> None:
        stage = "strain and figures"
        with self._writing:
            self._told(name, stage, 0.0)
            self.cases[name], floor = self.plan.write(self.out / name, done, self._floor)
            if done.is_repeat:
                self._floor = floor
            self._told(name, stage, 1.0)

    def _told(self, case: str, stage: str, fraction: float) -> None:
        with self._telling:
            self._tell(case, stage, fraction)
