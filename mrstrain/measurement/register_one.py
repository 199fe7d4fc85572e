"""One loaded image registered by itself: the part of a series that a study gives to a worker of its own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dvc.images.tissue import tissue_mask
from dvc.io.images.read import read_image
from dvc.registration.register import Settings
from dvc.registration.register import register as register_pair
from dvc.trust.error_model import error_model_of, read_error_model
from dvc.trust.quality import read_noise_floor
from dvc.worker import Worker
from mrstrain.measurement.engines import engine_of
from mrstrain.measurement.measured_folder import spline_in
from mrstrain.measurement.register import REPEAT, record_of
from mrstrain.measurement.results import Case, write_case
from mrstrain.measurement.twin_check import twin_check
from mrstrain.options.door import door
from mrstrain.options.measurement import MeshAndAxes, RegistrationOptions, Running, SubjectFiles
from mrstrain.records.inputs import read_subject


@door
def register_one(
    load0: Path,
    load: Path,
    *,
    out: Path,
    subject_files: SubjectFiles,
    registration: RegistrationOptions,
    onto: MeshAndAxes,
    running: Running,
    repeat: Path | None = None,
    after: Path | None = None,
    allow_missing: bool = False,
    tell: Callable[[str, float], None] = lambda *_: None,
) -> Case:
    """Register one loaded image by itself, as `register` does it in a series.

    Parameters
    ----------
    out : path
        Folder of this load's results; one that is called "repeat" is that of a repeat scan.
    repeat : path, optional
        Folder of the repeat scan's results: the noise floor.
    after : path, optional
        Folder of the load whose result is the start of this one's.
    tell : callable, optional
        ``tell(stage, fraction)``.

    Other parameters, and errors, are those of `register`.
    """
    subject = read_subject(load0, subject_files, onto, allow_missing=allow_missing)
    loaded = read_image(load, allow_missing=allow_missing)
    how = registration
    threads = running.threads or 1
    chosen = engine_of(how, labelled=True)
    settings = Settings(chosen, how.align, running.seed, threads)
    model = error_model_of(chosen.name) if how.error_model is None else read_error_model(how.error_model)
    floor = None if repeat is None else read_noise_floor(repeat / "quality.json")
    start = None if after is None else spline_in(after)
    record = record_of(
        subject,
        {"loads": [load]},
        settings,
        how.model_copy(update={"chain": after is not None}),
        {
            "allow_missing": allow_missing,
            "bone_label": subject_files.bone_label,
            "shear_direction_lps": onto.plain()["shear_direction"],
        },
    )
    body = subject.tissue or tissue_mask(subject.reference)
    is_repeat = out.name == REPEAT
    with Worker(threads) as worker:
        found = register_pair(
            subject.reference,
            loaded,
            bone=subject.bone,
            tissue=body,
            labels=subject.labels,
            settings=settings.of_repeat() if is_repeat else settings,
            start=start,
            worker=worker,
            progress=tell,
        )
        made = twin_check(found, subject, start, worker, tell) if how.twin and not is_repeat else None
    return write_case(out, out.name, subject, found, record, None, floor, is_repeat=is_repeat, model=model, twin=made)
