"""Differences between the studies of a cohort that make the areas of its subjects incomparable."""

from collections.abc import Mapping, Sequence

import numpy as np

from dvc.errors import InputError
from fe import BONE, MaterialSet, material_set
from mrstrain.measurement.engines import engine_of
from mrstrain.options.modelling import MINUTE_S
from mrstrain.records.provenance import file_hash
from mrstrain.studies.file import Study

_ROUNDING = 1e-9  # of material parameters: kPa converted to MPa
_NAMED = 3  # largest number of values, and of studies per value, that are listed
_COMPARED = {
    "registration": ("align", "bending", "volume", "chain", "twin", "allow_unknown_parameters"),
    "plate": ("taped", "turns", "gap_mm"),
    "mesh": ("edge_mm", "finer", "bones"),
    "models": ("element",),
}
"""Keys of the study file whose values are compared; files, names and directions may differ between subjects."""


def refuse_other_laws(studies: Sequence[Study]) -> None:
    """InputError if the same name is used for different material sets; the message names set and studies."""
    seen: dict[str, tuple[str, MaterialSet]] = {}
    for study in studies:
        for given in study.models.sets:
            one = material_set(study.set_given(given))
            first, other = seen.setdefault(one.name, (study.study.name, one))
            if not _same_laws(one, other):
                raise InputError(
                    f"The material set '{one.name}' differs between {study.study.name} and {first}. Rename one of "
                    "them, or use the same file in both studies."
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
    """A sentence for each setting of registration, mesh and solver, and each load and force, that differs."""
    told: dict[str, dict[str, object]] = {}
    for study in studies:
        for key, value in _compared(study).items():
            told.setdefault(key, {})[study.study.name] = value
    return [
        f"Setting differs between subjects: {key} {_listed(values)}. Their areas may not be comparable."
        for key, values in told.items()
        if len(set(values.values())) > 1
    ]


def _compared(study: Study) -> dict[str, object]:
    """The compared settings of a study, by table and key of its file."""
    how, models = study.registration.located(study.place), study.models
    values: dict[str, object] = {"[registration] engine": engine_of(how, labelled=True).name}
    values["[registration] files"] = ", ".join(f"{file.name} {file_hash(file)[:8]}" for file in how.paths)
    for table, keys in _COMPARED.items() if models.sets else [("registration", _COMPARED["registration"])]:
        if table != "mesh" or study.mesh.file is None:
            values |= {f"[{table}] {key}": getattr(getattr(study, table), key) for key in keys}
    if models.sets:
        values["[mesh] file"] = "made elsewhere" if study.mesh.file else "made from the label map"
        values["[models] fixed"] = tuple(sorted({name.casefold() for name in models.fixed} - {BONE}))
        values["[models] limit_minutes"] = (models.limit_s or 0.0) / MINUTE_S
    values["[loads]"] = tuple(sorted(study.loads))
    for name, load in study.loads.items():
        for key in ("normal_n", "normal_mm", "shear_n", "shear_mm"):  # no shear counts as zero shear
            values[f"[loads.{name}] {key}"] = getattr(load, key) or 0.0
    return values


def _listed(values: Mapping[str, object]) -> str:
    """Values with the studies that have them; the range if there are many numbers."""
    by_value: dict[object, list[str]] = {}
    for name, value in values.items():
        by_value.setdefault(value, []).append(name)
    numbers = [value for value in by_value if isinstance(value, float)]
    if len(by_value) > _NAMED and len(numbers) == len(by_value):
        return f"from {min(numbers):g} to {max(numbers):g}"
    shown = [f"{_said(value)} ({_some(names)})" for value, names in by_value.items()]
    return "= " + "; ".join(shown[:_NAMED]) + (f"; and {len(shown) - _NAMED} more" if len(shown) > _NAMED else "")


def _said(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return f"{value:g}" if isinstance(value, float) and value else str(value or "none")


def _some(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
