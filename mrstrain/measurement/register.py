"""`register`: images in, a folder of strain maps and a report out; `register_one` is the part of it in a study."""

import logging
import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from dvc import Deformation, Engine, Evidence, Image, Settings, read_error_model, read_image, read_landmarks
from dvc.errors import InputError, MrstrainError, ParameterError, RegistrationError
from dvc.file_names import as_typed, one_spelling
from dvc.io.result_folder import QUALITY, REPEAT, spline_in
from dvc.registration.align import align as align_images, without_motion
from dvc.registration.engines import DEFAULT
from dvc.registration.register import refuse_one_image_twice
from dvc.report.page import Section
from dvc.trust.quality import NoiseFloor, read_noise_floor
from dvc.worker import Worker, each_in_workers
from mrstrain.measurement.acquisition import scans_record
from mrstrain.measurement.answer import measured_strain
from mrstrain.measurement.auto_labels import check_auto, labelled, next_step
from mrstrain.measurement.case import Case, Series
from mrstrain.measurement.engines import engine_of
from mrstrain.measurement.plan import Plan, record_of
from mrstrain.measurement.strain import read_any
from mrstrain.options.door import door
from mrstrain.options.measurement import (
    AUTO,
    MarksForAuto,
    MeshAndAxes,
    RegistrationOptions,
    Running,
    Scans,
    SubjectFiles,
)
from mrstrain.options.model import Flag
from mrstrain.records.durations import LABELS, REPORT, TISSUES, reading_s, registrations
from mrstrain.records.inputs import (
    alone,
    case_names,
    earlier_results,
    output_folder,
    read_subject,
    refuse_small_disk,
    refuse_touching_inputs,
    swapped_by_name,
)
from mrstrain.records.outcome import with_reasons
from mrstrain.records.progress import NOTE, OnProgress, expect
from mrstrain.records.time_left import FAILED, WRITING

_log = logging.getLogger(__name__)
_BESIDE = ("repeat", "landmarks", "start")  # files that are recorded beside the loads
_BYTES_PER_VOXEL = 35  # of one image's results: 27 as measured, 5 with the plate's axes


@door
def register(
    load0: Path | str, loads: Sequence[Path | str], *, out: Path | str, subject_files: SubjectFiles,
    strokes: MarksForAuto, registration: RegistrationOptions, scans: Scans, onto: MeshAndAxes, running: Running,
    progress: OnProgress | None = None, worker: Worker | None = None,
) -> Series:  # fmt: skip
    """Register loaded images to the unloaded one and write displacement, strain, quality and a report.

    If a load fails, it is listed in ``failures`` and the other loads are completed.

    Parameters
    ----------
    load0 : path
        Unloaded image (reference configuration).
    loads : paths
        Loaded images. Each gets a folder in ``out`` named after its file.
    subject_files, strokes
        With labels "auto", `label` makes the label map first, in the folder ``labels`` of ``out``.
    progress : callable, optional
        ``progress(case, stage, fraction)``.
    worker : Worker, optional
        The process that registers the first load, where it has been started before.

    Raises
    ------
    MrstrainError
        For any input that cannot be used, before anything is computed; or if every load failed.
    """
    target = Path(out)
    drawn = {"drawn_bone": [subject_files.bone]} if subject_files.labels == AUTO and subject_files.bone else {}
    load0, places = Path(load0), _places([Path(p) for p in loads], scans)
    cases, paths = list(places), list(places.values())
    subject_files.refuse_missing()
    chosen = engine_of(registration, labelled=subject_files.labels is not None)
    _check_start(scans, chosen)
    given = [p for of in (subject_files, strokes, registration, scans, onto) for p in of.paths]
    refuse_touching_inputs(target, cases, [load0, *paths, *given])
    align, tell = registration.align, progress or (lambda *_: None)
    if swapped := swapped_by_name(load0, [Path(p) for p in loads]):
        tell(NOTE, swapped, 0.0)
    if subject_files.labels == AUTO:
        check_auto(subject_files, strokes, cases, scans)
    elif strokes.paths:
        raise InputError(
            "`marks` and `mark_names` are for labels auto (--marks, --mark-names, --labels auto on the command line). "
            "To correct a label map with strokes, use `mrstrain label --labels ... --marks ...`."
        )
    elif align == "bone" and subject_files.bone is None and subject_files.bone_label is None:
        if subject_files.labels is not None:
            raise InputError(
                "The images are aligned on a rigid bone, and none is given.\n"
                f"Name the label of the bone in {subject_files.labels.name}, bone_label (--bone-label), or give its "
                "mask, bone (--bone). If the images show no bone, use align image (--align image)."
            )
        raise InputError(
            f"The images are aligned on a rigid bone, and none is given. Segment it on {load0.name} (in a heel, the "
            "calcaneus) in ITK-SNAP or 3D Slicer, and pass the NIfTI file as bone (--bone), or a label map with it "
            "(--labels, --bone-label). If there is no bone, use align image (--align image)."
        )
    at_once, threads = running.shares(1 if registration.chain else len(cases))
    of_labels: tuple[Section, ...] = ()
    with ExitStack() as stack:
        first = worker or stack.enter_context(Worker(threads))
        first.start(align_images.__module__, type(chosen).__module__)
        images = {name: read_image(path, allow_missing=scans.allow_missing) for name, path in places.items()}
        to_label = subject_files.labels == AUTO
        seen = float(np.prod(images[cases[0]].grid.shape))  # about as many voxels as the unloaded image has
        how_long = registrations(cases, chosen.cost, seen, twin=registration.twin, label_first=to_label)
        expect(progress, how_long, at_once, reading_s=sum(reading_s(image.values.size) for image in images.values()))
        # Read now: what is wrong with it must not be found after an hour.
        model = None if registration.error_model is None else read_error_model(registration.error_model)
        if model is not None and model.preset not in chosen.may_be:
            raise InputError(
                f"{registration.error_model}: this error model is for {model.preset}, but the images would be "
                f"registered with {chosen.name}. Make one with `mrstrain accuracy --preset {as_typed(chosen.name)}`, "
                "or choose the engine of this one (engine, borders, preset)."
            )
        points = None if scans.landmarks is None else read_landmarks(scans.landmarks)[:2]
        if to_label:
            _hold(target, stack)
            making = partial(tell, LABELS, TISSUES)
            subject_files, of_labels = labelled(load0, subject_files, strokes, target, making)
        subject = read_subject(load0, subject_files, onto, allow_missing=scans.allow_missing)
        subject = replace(subject, tissue=subject.body())
        # Its rigid motion is found by aligning.
        held = {"bone": subject.bone, "image": subject.tissue, "none": None}[align]
        start = None if scans.start is None else without_motion(read_any(scans.start, scans.start_frame), held)[0]
        scanned = [subject.reference, *images.values()]
        refuse_one_image_twice([(str(path), image) for path, image in zip((load0, *paths), scanned, strict=True)])
        voxels = int(np.prod(subject.reference.grid.shape))
        needed = (_BYTES_PER_VOXEL + chosen.cost.bytes_per_voxel) * voxels * len(cases)
        refuse_small_disk(target, needed, f"the results of {len(cases)} images need", " or fewer loads")
        settings = Settings(chosen, align, running.seed, threads)
        files = {"loads": paths[: len(loads)], **{role: scans.files.get(role, []) for role in _BESIDE}, **strokes.files}
        files |= drawn
        more: dict[str, object] = {"start_frame": scans.start_frame, "bone_label": subject_files.bone_label}
        more |= {"shear_direction_lps": onto.plain()["shear_direction"], "mesh_unit": onto.mesh_unit}
        more |= {"mesh_frame": onto.mesh_frame, "allow_missing": scans.allow_missing}
        scans_of = {name: (place, images[name]) for name, place in places.items()}
        more |= scans_record((load0, subject.reference), scans_of)
        record = record_of(subject, files, settings, registration, more)
        plan = Plan(subject, settings, Evidence(points, error_model=model), record, registration.twin)
        if earlier := earlier_results(target, cases):
            tell(NOTE, earlier, 0.0)
        run = _Run(target, plan, images, start, tell)
        if not of_labels:
            _hold(target, stack)
        run.all(at_once, registration.chain, first)
        finished = run.finished()
    tell(REPORT, WRITING, 0.0)
    from dvc.measurement.side_by_side import on_one_scale  # it draws, and matplotlib takes half a second

    alike = on_one_scale([case.section for case in finished], subject, {case.name: case.folder for case in finished})
    finished = tuple(replace(case, section=section) for case, section in zip(finished, alike, strict=True))
    shown = [case for case in finished if case.name != REPEAT]
    answer = measured_strain([c.section for c in shown], subject, {c.name: c.folder for c in shown}, target)
    edge_mm = float(subject.reference.grid.spacing_mm.max())
    advice = next_step(subject_files, cases, scans, registration, chosen, edge_mm)
    series = Series.of(target, finished, run.failures, run.record, answer, of_labels, advice=advice)
    tell(REPORT, WRITING, 1.0)
    return series


def _hold(out: Path, stack: ExitStack) -> None:
    """Make the output folder, and refuse it to other runs until the stack is closed."""
    stack.enter_context(output_folder(out))
    stack.enter_context(alone(out))


class InSeries(Running):
    """How one load is registered within its series, and the results that it builds on."""

    repeat: Path | None = None
    """Results folder of the repeat scan, for the noise floor."""
    after: Path | None = None
    """Results folder of the load to start from."""
    allow_missing: Flag = False
    """Treat NaN and infinite voxels as missing, instead of rejecting the image."""


@door
def register_one(
    load0: Path, load: Path, *, out: Path, subject_files: SubjectFiles, registration: RegistrationOptions,
    onto: MeshAndAxes, series: InSeries, tell: Callable[[str, float], None] = lambda *_: None,
) -> Case:  # fmt: skip
    """Register one loaded image by itself, as `register` does it in a series, for a study's worker of its own.

    A folder ``out`` that is called "repeat" is that of a repeat scan. ``tell(stage, fraction)`` reports progress. Other
    parameters, and errors, are those of `register`.
    """
    how, missing, threads = registration, series.allow_missing, series.threads or 1
    chosen = engine_of(how, labelled=True)
    with Worker(threads) as worker:
        worker.start(align_images.__module__, type(chosen).__module__)
        subject = read_subject(load0, subject_files, onto, allow_missing=missing)
        loaded = read_image(load, allow_missing=missing)
        settings = Settings(chosen, how.align, series.seed, threads)
        model = None if how.error_model is None else read_error_model(how.error_model)
        floor = None if series.repeat is None else read_noise_floor(series.repeat / QUALITY)
        start = None if series.after is None else spline_in(series.after)
        more: dict[str, object] = {"allow_missing": missing, "bone_label": subject_files.bone_label}
        more["shear_direction_lps"] = onto.plain()["shear_direction"]
        more |= scans_record((load0, subject.reference), {out.name: (load, loaded)})
        chained = how.model_copy(update={"chain": series.after is not None})
        record = record_of(subject, {"loads": [load]}, settings, chained, more)
        plan = Plan(replace(subject, tissue=subject.body()), settings, Evidence(error_model=model), record, how.twin)
        done = plan.register(out.name, loaded, start, worker, tell)
    return plan.write(out, done, floor)[0]


def _places(loads: list[Path], scans: Scans) -> dict[str, Path]:
    """Every image to be registered, by the name of its results' folder; the repeat scan last."""
    if not loads and scans.repeat is None:
        raise InputError("Give at least one loaded image.")
    for name, value in (("landmarks", scans.landmarks), ("start", scans.start)):
        if value is not None and len(loads) != 1:
            raise InputError(f"{name} is for a single loaded image, but {len(loads)} are given. Register it alone.")
    places = dict(zip(case_names(loads), loads, strict=True))
    if scans.repeat is None:
        return places
    if REPEAT in map(one_spelling, places):
        raise InputError(f"A loaded image is named '{REPEAT}', which is reserved for the repeat scan; rename it.")
    return places | {REPEAT: scans.repeat}


def _check_start(scans: Scans, engine: Engine) -> None:
    if scans.start_frame is not None and scans.start is None:
        raise ParameterError("start_frame needs start, which is not given.")
    if scans.start is not None and not engine.starts_anywhere:
        raise ParameterError(
            f"start is only for {DEFAULT}; {engine.family} can only start from its own results (chain)."
        )


class _Run:
    """The loads of one series: registered in worker processes, each written as soon as it is finished."""

    def __init__(
        self, out: Path, plan: Plan, images: dict[str, Image], start: Deformation | None, tell: OnProgress
    ) -> None:
        self.out, self.plan, self.images, self.start, self._tell = out, plan, images, start, tell
        self.cases: dict[str, Case] = {}
        self.record = plan.record  # with the engine that was used, once that is known
        self.errors: dict[str, MrstrainError] = {}
        self._floor: NoiseFloor | None = None
        self._telling, self._writing = threading.Lock(), threading.Lock()
        self._floor_known = threading.Event()
        if REPEAT not in images:
            self._floor_known.set()

    def all(self, at_once: int, chain: bool, first: Worker) -> None:
        last: list[Deformation] = []
        names = sorted(self.images, key=lambda name: name != REPEAT)  # its floor is waited for
        not_begun = set(names)

        def one(name: str, worker: Worker) -> None:
            not_begun.remove(name)
            is_repeat = name == REPEAT
            start = None if is_repeat else last[-1] if chain and last else self.start
            told = partial(self._told, name)
            try:
                done = self.plan.register(name, self.images[name], start, worker, told)
                if not not_begun:
                    threading.Thread(target=worker.close).start()  # its memory is as large as what the maps take now
                if not is_repeat:
                    self.record = self.plan.recorded(done[0])
                    last.append(done[0].displacement)
                    self._floor_known.wait()
                with self._writing:
                    told("strain and figures", 0.0)
                    self.cases[name], floor = self.plan.write(self.out / name, done, self._floor)
                    self._floor = floor if is_repeat else self._floor
                    told("strain and figures", 1.0)
            except MrstrainError as error:
                self.errors[name] = error
                _log.info("%s failed", name, exc_info=error)
                told(FAILED, 1.0)
            finally:
                if is_repeat:
                    self._floor_known.set()

        each_in_workers(names, one, at_once=at_once, threads=self.plan.settings.threads, first=first)

    def finished(self) -> tuple[Case, ...]:
        """The loads that were registered, in the order given; RegistrationError where none was."""
        if not self.cases:
            reasons = [f"{name}: {reason}" for name, reason in self.failures.items()]
            gravest = min(self.errors.values(), key=lambda error: isinstance(error, InputError))
            raise RegistrationError(with_reasons("No load could be registered.", reasons)) from gravest
        return tuple(self.cases[name] for name in self.images if name in self.cases)

    @property
    def failures(self) -> dict[str, str]:
        """Why loads could not be registered."""
        return {name: str(error) for name, error in self.errors.items()}

    def _told(self, case: str, stage: str, fraction: float) -> None:
        with self._telling:
            self._tell(case, stage, fraction)
