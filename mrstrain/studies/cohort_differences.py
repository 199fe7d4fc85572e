"""What differs between the studies of a cohort, and would make the areas of its subjects unlike."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dvc.errors import InputError
from fe import BONE, MaterialSet, material_set
from mrstrain.measurement.engines import engine_of
from mrstrain.options.measurement import EngineOptions
from mrstrain.options.modelling import MINUTE_S
from mrstrain.records.provenance import file_hash
from mrstrain.studies.file import Load, Study

_ROUNDING = 1e-9  # of a law's numbers: kPa read as MPa
_NAMED = 3  # values, and studies to a value, that are named one by one


def refuse_other_laws(studies: Sequence[Study]) -> None:
    """Raise InputError, naming set and studies, where one name stands for different material parameter sets."""
    seen: dict[str, tuple[str, MaterialSet]] = {}
    for study in studies:
        for given in study.models.sets:
            one = material_set(study.set_given(given))
            first, other = seen.setdefault(one.name, (study.study.name, one))
            if not _same_laws(one, other):
                raise InputError(
                    f"The material set '{one.name}' has other laws in {study.study.name} than in {first}: give each a "
                    "name of its own, or both the same file."
                )


def _same_laws(one: MaterialSet, other: MaterialSet) -> bool:
    laws, others = ({tissue.casefold(): law for tissue, law in of.materials.items()} for of in (one, other))
    return laws.keys() == others.keys() and all(
        law.nu == others[tissue].nu
        and law.vector.shape == others[tissue].vector.shape
        and np.allclose(law.vector, others[tissue].vector, rtol=_ROUNDING, atol=0.0)
        for tissue, law in laws.items()
    )


def unlike(studies: Sequence[Study]) -> list[str]:
    """A sentence for each way to register, mesh and solve, and each load and its force, in which subjects differ.

    Files, names and directions are each subject's own.
    """
    told: dict[str, dict[str, str | float]] = {}
    for study in studies:
        name = study.study.name
        told.setdefault("[registration]", {})[name] = _registered(study)
        if study.models.sets:
            for part, how in (("[plate]", _plate(study)), ("[mesh]", _mesh(study)), ("[models]", _solved(study))):
                told.setdefault(part, {})[name] = how
        told.setdefault("[loads]", {})[name] = ", ".join(sorted(study.loads))
        for load, of in study.loads.items():
            for along, value in _pushed(of).items():
                told.setdefault(f"[loads.{load}] {along}", {})[name] = value
    return [
        f"Subjects are not measured and simulated alike, {where} differs: {_listed(values)}."
        for where, values in told.items()
        if len(set(values.values())) > 1
    ]


def _registered(study: Study) -> str:
    how = study.registration.located(study.place)
    said = [engine_of(how, labelled=True).name]
    for name, value in how:
        usual = type(how).model_fields[name].default
        if name == "align":
            said += ["aligned on the image"] if value == "image" else []
        elif isinstance(value, bool):
            said += [name] if value and not usual else []
        elif value != usual and name not in EngineOptions.model_fields and name not in how.files:
            said.append(f"{name} {value:g}" if isinstance(value, float) else f"{name} {value}")
    return " ".join([*said, *(f"{file.name} {file_hash(file)[:8]}" for file in how.paths)])


def _plate(study: Study) -> str:
    plate = study.plate
    held = "taped" if plate.taped else "without friction"
    return f"{held}{', turning' if plate.turns else ''}, {plate.gap_mm:g} mm away"


def _mesh(study: Study) -> str:
    how = study.mesh
    if how.file is not None:
        return "made elsewhere"
    finer = "" if how.finer is None else f", {how.finer.edge_mm:g} mm in {how.finer.region}"
    return f"edges of {how.edge_mm:g} mm{finer} without {', '.join(how.bones)}"


def _solved(study: Study) -> str:
    fixed = sorted({name.casefold() for name in study.models.fixed} - {BONE})
    limit = (study.models.limit_s or 0.0) / MINUTE_S
    return (
        study.models.element
        + (f" with {', '.join(fixed)} fixed" if fixed else "")
        + (f", {limit:g} minutes at the most" if limit else "")
    )


def _pushed(load: Load) -> dict[str, str | float]:
    """Forces (N) and travels (mm) along the normal and across it; no shear is a shear of nothing."""
    told: dict[str, str | float] = {"along the normal": "nothing"}
    if load.normal_n is not None:
        told["along the normal"] = load.normal_n
    elif load.normal_mm is not None:
        told["along the normal"] = f"{load.normal_mm:g} mm"
    told["across it"] = (load.shear_n or 0.0) if load.shear_mm is None else f"{load.shear_mm:g} mm"
    return told


def _listed(values: dict[str, str | float]) -> str:
    """Values with the studies that have them; of many numbers their range."""
    by_value: dict[str | float, list[str]] = {}
    for name, value in values.items():
        by_value.setdefault(value, []).append(name)
    numbers = [value for value in by_value if isinstance(value, float)]
    if len(by_value) > _NAMED and len(numbers) == len(by_value):
        return f"from {min(numbers):g} to {max(numbers):g} N"
    shown = [f"{_said(value)} in {_some(names)}" for value, names in by_value.items()]
    return "; ".join(shown[:_NAMED]) + (f"; and {len(shown) - _NAMED} more" if len(shown) > _NAMED else "")


def _said(value: str | float) -> str:
    return f"{value:g} N" if isinstance(value, float) else value


def _some(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
