"""How the loads of a subject are measured: one by one, in a series or by a worker of a study."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from dvc import Deformation, Evidence, Image, Measurement, Registration, Settings, Subject, register as register_pair
from dvc.measurement.error_bars import TwinCheck
from dvc.trust.quality import NoiseFloor
from dvc.worker import Worker
from mrstrain.measurement.case import Case
from mrstrain.measurement.twin_check import twin_check
from mrstrain.options.measurement import EngineOptions, RegistrationOptions
from mrstrain.records.provenance import provenance

Tell = Callable[[str, float], None]
_SETTINGS = {*EngineOptions.model_fields, "align", "bending", "volume", "allow_unknown_parameters", "error_model"}
"""Options of a registration that its record has as settings, or by the file's hash."""


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """A registered pair, and the check against its twin, if one was asked for."""

    found: Registration
    twin: TwinCheck | None
    is_repeat: bool


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What all loads of a subject, whose tissue is known, are registered and judged by."""

    subject: Subject
    settings: Settings
    evidence: Evidence  # landmarks and error model
    record: Mapping[str, object]  # provenance
    twin: bool = False  # whether each pair's twin is registered, too

    def register(
        self, loaded: Image, start: Deformation | None, worker: Worker, tell: Tell, *, is_repeat: bool = False
    ) -> Registered:
        """Register a loaded image, or a repeat scan, and the pair's twin."""
        found = register_pair(
            self.subject.reference,
            loaded,
            bone=self.subject.bone,
            tissue=self.subject.tissue,
            labels=self.subject.labels,
            settings=self.settings.of_repeat() if is_repeat else self.settings,
            start=start,
            worker=worker,
            progress=tell,
        )
        wanted = self.twin and not is_repeat
        return Registered(found, twin_check(found, self.subject, start, worker, tell) if wanted else None, is_repeat)

    def write(self, folder: Path, done: Registered, floor: NoiseFloor | None) -> tuple[Case, NoiseFloor | None]:
        """Judge what was registered and write it; return it with the noise floor that it was judged by, or gives."""
        more = Evidence(noise_floor=floor) if done.is_repeat else replace(self.evidence, noise_floor=floor)
        evidence = replace(more, error_model=self.evidence.error_model, twin=done.twin)
        measured = Measurement.from_registration(
            done.found, self.subject, evidence, name=folder.name, is_repeat=done.is_repeat
        )
        return Case.of(measured, folder, self.record), measured.quality.noise_floor


def record_of(
    subject: Subject,
    files: Mapping[str, list[Path]],
    settings: Settings,
    how: RegistrationOptions,
    more: Mapping[str, object],
) -> dict[str, object]:
    """What a registration is made from; ``more`` are parameters beside those of the registration."""
    return provenance(
        "register",
        {**subject.files, **files, "error_model": how.files.get("error_model", [])},
        {
            "align": settings.align_on,
            "seed": settings.seed,
            "threads": settings.threads,
            "plate_normal_lps": subject.plate_normal.tolist(),
            "engine": settings.engine.family,
            **settings.engine.record(),
            **{name: value for name, value in how.plain().items() if name not in _SETTINGS},
            **more,
        },
    )
