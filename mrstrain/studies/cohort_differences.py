"""What differs between the studies of a cohort, and would make the areas of its subjects unlike."""

from collections.abc import Mapping, Sequence

import numpy as np

from dvc.errors import InputError
from fe import BONE, MaterialSet, material_set
from mrstrain.measurement.engines import engine_of
from mrstrain.options.modelling import MINUTE_S
from mrstrain.records.provenance import file_hash
from mrstrain.studies.file import Study

_ROUNDING = 1e-9  # of a law's numbers: kPa read as MPa
_NAMED = 3  # values, and studies to a value, that are named one by one
_COMPARED = {
    "registration": ("align", "bending", "volume", "chain", "twin", "allow_unknown_parameters"),
    "plate": ("taped", "turns", "gap_mm"),
    "mesh": ("edge_mm", "finer", "bones"),
    "models": ("element",),
}
"""Keys of the study file that are compared as they are; files, names and directions are each subject's own."""


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
    """A sentence for each way to register, mesh and solve, and each load and its force, in which subjects differ."""
    told: dict[str, dict[str, object]] = {}
    for study in studies:
        for key, value in _compared(study).items():
            told.setdefault(key, {})[study.study.name] = value
    return [
        f"Subjects are not measured and simulated alike, {key} differs: {_listed(values)}."
        for key, values in told.items()
        if len(set(values.values())) > 1
    ]


def _compared(study: Study) -> dict[str, object]:
    """What is compared of a study, by table and key of its file."""
    how, models = study.registration.located(study.place), study.models
    values: dict[str, object] = {"[registration] engine": engine_of(how, labelled=True).name}
    values["[registration] files"] = ", ".join(f"{file.name} {file_hash(file)[:8]}" for file in how.paths)
    for table, keys in _COMPARED.items() if models.sets else [("registration", _COMPARED["registration"])]:
        if table != "mesh" or study.mesh.file is None:
            values |= {f"[{table}] {key}": getattr(getattr(study, table), key) for key in keys}
    if models.sets:
        values["[mesh] file"] = "made elsewhere" if study.mesh.file else "made of the label map"
        values["[models] fixed"] = tuple(sorted({name.casefold() for name in models.fixed} - {BONE}))
        values["[models] limit_minutes"] = (models.limit_s or 0.0) / MINUTE_S
    values["[loads]"] = tuple(sorted(study.loads))
    for name, load in study.loads.items():
        for key in ("normal_n", "normal_mm", "shear_n", "shear_mm"):  # no shear is a shear of nothing
            values[f"[loads.{name}] {key}"] = getattr(load, key) or 0.0
    return values


def _listed(values: Mapping[str, object]) -> str:
    """Values with the studies that have them; of many numbers their range."""
    by_value: dict[object, list[str]] = {}
    for name, value in values.items():
        by_value.setdefault(value, []).append(name)
    numbers = [value for value in by_value if isinstance(value, float)]
    if len(by_value) > _NAMED and len(numbers) == len(by_value):
        return f"from {min(numbers):g} to {max(numbers):g}"
    shown = [f"{_said(value)} in {_some(names)}" for value, names in by_value.items()]
    return "; ".join(shown[:_NAMED]) + (f"; and {len(shown) - _NAMED} more" if len(shown) > _NAMED else "")


def _said(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return f"{value:g}" if isinstance(value, float) and value else str(value or "none")


def _some(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
