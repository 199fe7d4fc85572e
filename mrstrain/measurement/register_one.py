"""One loaded image registered by itself: the part of a series that a study gives to a worker of its own."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from dvc import Evidence, Settings, read_image
from dvc.io.result_folder import QUALITY, REPEAT, spline_in
from dvc.trust.error_model import error_model_of, read_error_model
from dvc.trust.quality import read_noise_floor
from dvc.worker import Worker
from mrstrain.measurement.case import Case
from mrstrain.measurement.engines import engine_of
from mrstrain.measurement.plan import Plan, record_of
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

    out: Folder of this load's results; one that is called "repeat" is that of a repeat scan.
    repeat: Folder of the repeat scan's results: the noise floor.
    after: Folder of the load whose result is the start of this one's.
    tell: ``tell(stage, fraction)``.
    """
    subject = read_subject(load0, subject_files, onto, allow_missing=allow_missing)
    loaded = read_image(load, allow_missing=allow_missing)
    how = registration
    threads = running.threads or 1
    chosen = engine_of(how, labelled=True)
    settings = Settings(chosen, how.align, running.seed, threads)
    model = error_model_of(chosen.name) if how.error_model is None else read_error_model(how.error_model)
    floor = None if repeat is None else read_noise_floor(repeat / QUALITY)
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
    plan = Plan(replace(subject, tissue=subject.body()), settings, Evidence(error_model=model), record, how.twin)
    with Worker(threads) as worker:
        done = plan.register(loaded, start, worker, tell, is_repeat=out.name == REPEAT)
    return plan.write(out, done, floor)[0]
