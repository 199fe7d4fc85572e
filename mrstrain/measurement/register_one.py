"""One loaded image registered by itself: the part of a series that a study gives to a worker of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from dvc.images.tissue import tissue_mask
from dvc.io.images.read import read_image
from dvc.registration.align import AlignOn
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
    chosen = engine_of(engine, preset, parameters, bending=bending, volume=volume, borders=borders, labelled=True)
    settings = Settings(chosen, align, seed, threads)
    model = error_model_of(chosen.name) if error_model is None else read_error_model(error_model)
    floor = None if repeat is None else read_noise_floor(repeat / "quality.json")
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
        made = twin_check(found, subject, start, worker, tell) if twin and not is_repeat else None
    return write_case(out, out.name, subject, found, record, None, floor, is_repeat=is_repeat, model=model, twin=made)
