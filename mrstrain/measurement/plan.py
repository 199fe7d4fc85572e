"""How the loads of a subject are measured, in a series or by a worker of a study, and checked by their twins."""

import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from threading import Thread

import numpy as np

import dvc
from dvc import Deformation, Evidence, Image, Registration, Settings, Subject
from dvc.errors import MrstrainError
from dvc.io.result_folder import REPEAT
from dvc.measurement.error_bars import TwinCheck
from dvc.measurement.judgement import maps_of
from dvc.trust.quality import NoiseFloor
from dvc.worker import Worker
from mrstrain.measurement.acquisition import noise_record
from mrstrain.measurement.case import Case
from mrstrain.options.measurement import EngineOptions, RegistrationOptions
from mrstrain.records.provenance import provenance
from phantoms import Acquisition, synthetic_warp

Tell = Callable[[str, float], None]
_Files = Mapping[str, Path | list[Path]]
_SETTINGS = {*EngineOptions.model_fields, "align", "bending", "volume", "allow_unknown_parameters", "error_model"}
"""Options of a registration that its record has as settings, or by the file's hash."""
_FOLDED = 1e-3
_log = logging.getLogger(__name__)


Registered = tuple[Registration, TwinCheck | None]
"""A registered pair, and the check against its twin, if one was asked for."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What all loads of a subject, whose tissue is known, are registered and judged by."""

    subject: Subject
    settings: Settings
    evidence: Evidence  # landmarks and error model
    record: Mapping[str, object]  # provenance
    twin: bool = False  # whether each pair's twin is registered, too

    def register(self, name: str, loaded: Image, start: Deformation | None, worker: Worker, tell: Tell) -> Registered:
        """Register a loaded image, or the repeat scan if its ``name`` is "repeat", and the pair's twin."""
        drawing = Thread(target=_load_what_draws, daemon=True)

        def told(stage: str, fraction: float) -> None:
            if fraction > 0.0 and drawing.ident is None:  # from now on the worker computes, and is not kept waiting
                with suppress(RuntimeError):  # no memory for a thread: imported where it is needed
                    drawing.start()
            tell(stage, fraction)

        is_repeat = name == REPEAT
        of, how = self.subject, self.settings.of_repeat() if is_repeat else self.settings
        found = dvc.register(
            of.reference, loaded, bone=of.bone, tissue=of.tissue, labels=of.labels, settings=how, start=start,
            worker=worker, progress=told,
        )  # fmt: skip
        twin = _twin_check(found, of, start, worker, tell) if self.twin and not is_repeat else None
        return found, twin

    def write(self, folder: Path, done: Registered, floor: NoiseFloor | None) -> tuple[Case, NoiseFloor | None]:
        """Judge what was registered and write it; return it with the noise floor that it was judged by, or gives."""
        (found, twin), is_repeat = done, folder.name == REPEAT
        more = Evidence(noise_floor=floor) if is_repeat else replace(self.evidence, noise_floor=floor)
        evidence = replace(more, error_model=self.evidence.error_model, twin=twin)
        measured = dvc.Measurement.from_registration(
            found, self.subject, evidence, name=folder.name, is_repeat=is_repeat
        )
        record = {**self.recorded(found), **noise_record(measured)}
        return Case.of(measured, folder, record), measured.quality.noise_floor

    def recorded(self, found: dvc.Registration) -> dict[str, object]:
        """The record with the engine that was used, which may not be the one asked for."""
        asked: Mapping[str, object] = self.record["parameters"]  # type: ignore[assignment]
        return {**self.record, "parameters": {**asked, **found.settings.engine.record()}}


def _load_what_draws() -> None:
    """Import all that a measurement takes, and what writes its figures as PDF, which matplotlib imports only then.

    What there is no memory for is told where it is needed, and not by this thread.
    """
    with suppress(ImportError, MemoryError):
        _ = dvc.Measurement
        import_module("matplotlib.backends.backend_pdf")


def record_of(
    subject: Subject, files: _Files, settings: Settings, how: RegistrationOptions, more: Mapping[str, object]
) -> dict[str, object]:
    """What a registration is made from; ``more`` are parameters beside those of the registration."""
    parameters = {
        "align": settings.align_on, "seed": settings.seed, "threads": settings.threads,
        "plate_normal_lps": subject.plate_normal.tolist(), "engine": settings.engine.family,
        "labels_from_image": None if subject.from_image is None else asdict(subject.from_image),
        **settings.engine.record(), **{name: of for name, of in how.plain().items() if name not in _SETTINGS}, **more,
    }  # fmt: skip
    given: _Files = {**subject.files, **files, "error_model": how.files.get("error_model", [])}
    return provenance("register", given, parameters)


def _twin_check(
    found: Registration, subject: Subject, start: Deformation | None, worker: Worker, tell: Tell
) -> TwinCheck:
    """Warp the unloaded image by a pair's measured motion, draw its noise anew, and register it as the pair was.

    The measured strain is the true one of this twin, which lies on the loaded image's grid and is as noisy as the
    noisier of the two images.
    """
    tell("making the synthetic warp", 0.0)
    near, tissue = found.alignment.motion, found.tissue
    try:
        acquisition = Acquisition(found.settings.seed, found.loaded.grid, noise_factor=_noisier(found))
        twin = synthetic_warp(found.reference, tissue, found.total, acquisition, near=near, beyond_missing=True).image
        tell("making the synthetic warp", 1.0)
        again = dvc.register(
            found.reference, twin, bone=subject.bone, tissue=tissue, labels=subject.labels, settings=found.settings,
            start=start, worker=worker, progress=lambda stage, fraction: tell(f"synthetic warp: {stage}", fraction),
        )  # fmt: skip
    except MrstrainError as reason:
        _log.info("The synthetic warp failed", exc_info=reason)
        return TwinCheck(None, str(reason))
    maps = maps_of(again)
    folded = float(np.mean(maps.jacobian[tissue.inside] <= 0.0))
    if folded > _FOLDED:
        return TwinCheck(None, f"Its registration folds in {100 * folded:.1f} % of the tissue, so it cannot be used.")
    return TwinCheck(maps.max_shear)


def _noisier(found: Registration) -> float:
    """How many times noisier the loaded image is than the unloaded one, for its signal; at least 1."""
    reference, loaded = found.noise
    return 1.0 if loaded is None else max(1.0, reference.snr / loaded.snr)
