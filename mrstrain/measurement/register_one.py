"""One loaded image registered by itself: the part of a series that a study gives to a worker of its own."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from dvc import Evidence, Settings, read_error_model, read_image
from dvc.io.result_folder import QUALITY, REPEAT, spline_in
from dvc.trust.error_model import error_model_of
from dvc.trust.quality import read_noise_floor
from dvc.worker import Worker
from mrstrain.measurement.case import Case
from mrstrain.measurement.engines import engine_of
from mrstrain.measurement.plan import Plan, record_of
from mrstrain.options.door import door
from mrstrain.options.measurement import MeshAndAxes, RegistrationOptions, Running, SubjectFiles
from mrstrain.options.model import Flag
from mrstrain.records.inputs import read_subject


class InSeries(Running):
    """How the load is registered within its series, and the results that it builds on."""

    repeat: Path | None = None
    """Folder of the repeat scan's results: the noise floor."""
    after: Path | None = None
    """Folder of the load whose result is the start of this one's."""
    allow_missing: Flag = False
    """Leave NaN or infinite voxels out instead of refusing the image."""


@door
def register_one(
    load0: Path,
    load: Path,
    *,
    out: Path,
    subject_files: SubjectFiles,
    registration: RegistrationOptions,
    onto: MeshAndAxes,
    series: InSeries,
    tell: Callable[[str, float], None] = lambda *_: None,
) -> Case:
    """Register one loaded image by itself, as `register` does it in a series.

    A folder ``out`` that is called "repeat" is that of a repeat scan. ``tell(stage, fraction)`` reports progress. Other
    parameters, and errors, are those of `register`.
    """
    how, missing = registration, series.allow_missing
    subject = read_subject(load0, subject_files, onto, allow_missing=missing)
    loaded = read_image(load, allow_missing=missing)
    threads = series.threads or 1
    chosen = engine_of(how, labelled=True)
    settings = Settings(chosen, how.align, series.seed, threads)
    model = error_model_of(chosen.name) if how.error_model is None else read_error_model(how.error_model)
    floor = None if series.repeat is None else read_noise_floor(series.repeat / QUALITY)
    start = None if series.after is None else spline_in(series.after)
    more = {"allow_missing": missing, "bone_label": subject_files.bone_label}
    more["shear_direction_lps"] = onto.plain()["shear_direction"]
    chained = how.model_copy(update={"chain": series.after is not None})
    record = record_of(subject, {"loads": [load]}, settings, chained, more)
    plan = Plan(replace(subject, tissue=subject.body()), settings, Evidence(error_model=model), record, how.twin)
    with Worker(threads) as worker:
        done = plan.register(loaded, start, worker, tell, is_repeat=out.name == REPEAT)
    return plan.write(out, done, floor)[0]
