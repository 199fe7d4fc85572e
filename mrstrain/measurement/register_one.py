"""One loaded image registered by itself: the part of a series that a study gives to a worker of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from dvc.io.images.read import read_image
from dvc.io.result_folder import QUALITY, REPEAT, spline_in
from dvc.measurement.source import Evidence
from dvc.registration.align import AlignOn
from dvc.trust.error_model import error_model_of, read_error_model
from dvc.trust.quality import read_noise_floor
from dvc.worker import Worker
from mrstrain.measurement.case import Case
from mrstrain.measurement.engines import settings_of
from mrstrain.measurement.plan import Plan, record_of
from mrstrain.records.inputs import read_subject


def register_one(
    load0: Path,
    load: Path,
    *,
    out: Path,
    labels: Path,
    names: Path | None,
    bone: str | Path | None,
    tissue: Path | None = None,
    align: AlignOn = "bone",
    engine: str | None = None,
    bending: float | None = None,
    volume: float | None = None,
    borders: bool | None = None,
    preset: str | None = None,
    parameters: Sequence[Path] = (),
    error_model: Path | None = None,
    plate_normal: Sequence[float] | None = None,
    shear_direction: Sequence[float] | None = None,
    repeat: Path | None = None,
    after: Path | None = None,
    twin: bool = False,
    allow_missing: bool = False,
    threads: int = 1,
    seed: int = 1,
    tell: Callable[[str, float], None] = lambda *_: None,
) -> Case:
    """Register one loaded image by itself, as `register` does it in a series.

    Parameters
    ----------
    out : path
        Folder of this load's results; one that is called "repeat" is that of a repeat scan.
    bone : str, path or None
        Its name in ``labels``, or a mask; None where the whole image is aligned on.
    repeat : path, optional
        Folder of the repeat scan's results: the noise floor.
    after : path, optional
        Folder of the load whose result is the start of this one's.
    tell : callable, optional
        ``tell(stage, fraction)``.

    Other parameters, and errors, are those of `register`.
    """
    subject = read_subject(
        load0,
        bone=bone if isinstance(bone, Path) else None,
        bone_label=bone if isinstance(bone, str) else None,
        tissue=tissue,
        labels=labels,
        names=names,
        plate_normal=plate_normal,
        shear_direction=shear_direction,
        allow_missing=allow_missing,
    )
    loaded = read_image(load, allow_missing=allow_missing)
    settings = replace(
        settings_of(engine, preset, parameters, bending=bending, volume=volume, borders=borders, labelled=True),
        align_on=align,
        seed=seed,
        threads=threads,
    )
    model = error_model_of(settings.name) if error_model is None else read_error_model(error_model)
    floor = None if repeat is None else read_noise_floor(repeat / QUALITY)
    start = None if after is None else spline_in(after)
    record = record_of(
        subject,
        {"loads": [load], "error_model": [] if error_model is None else [error_model]},
        settings,
        {
            "chain": after is not None,
            "twin": twin,
            "allow_missing": allow_missing,
            "bone_label": bone if isinstance(bone, str) else None,
            "shear_direction_lps": None if shear_direction is None else list(shear_direction),
        },
    )
    plan = Plan(replace(subject, tissue=subject.body()), settings, Evidence(error_model=model), record, twin)
    with Worker(threads) as worker:
        done = plan.register(loaded, start, worker, tell, is_repeat=out.name == REPEAT)
    return plan.write(out, done, floor)[0]
