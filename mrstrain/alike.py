"""What differs between the studies of a cohort, and would make the areas of its subjects unlike."""

from __future__ import annotations

from collections.abc import Sequence

from dvc.errors import InputError
from fe.published import as_toml, material_set
from mrstrain.provenance import file_hash
from mrstrain.studyfile import Study

_KEYS = {
    "registration": (
        "engine", "preset", "parameters", "borders", "bending", "volume", "align", "chain", "error_model",
    ),
    "plate": ("taped", "turns", "gap_mm"),
    "mesh": ("edge_mm", "finer"),
    "models": ("element", "fixed"),
}  # fmt: skip
_FORCES = ("normal_n", "shear_n", "normal_mm", "shear_mm")
_NAMED = 3  # values, and studies to a value, that are named one by one


def refuse_other_laws(studies: Sequence[Study]) -> None:
    """Refuse studies in which one name stands for different laws.

    Raises
    ------
    InputError
        Naming set and studies, or as from `fe.published.material_set`.
    """
    seen: dict[str, tuple[str, str]] = {}
    for study in studies:
        for given in study.models.sets:
            one = material_set(study.set_given(given))
            laws = as_toml(one.name, "", one.laws)
            first, other = seen.setdefault(one.name, (study.study.name, laws))
            if other != laws:
                raise InputError(
                    f"The material set '{one.name}' has other laws in {study.study.name} than in {first}: give each a "
                    "name of its own, or both the same file."
                )


def unlike(studies: Sequence[Study]) -> list[str]:
    """A sentence for each setting in which studies differ, other than subject, place and directions."""
    told: dict[str, dict[str, object]] = {}
    for study in studies:
        for table, keys in _KEYS.items():
            for key in keys:
                told.setdefault(f"[{table}] {key}", {})[study.study.name] = _value(study, table, key)
        for load, of in study.loads.items():
            for key in _FORCES:
                told.setdefault(f"[loads.{load}] {key}", {})[study.study.name] = getattr(of, key)
    return [
        f"Subjects are not measured and simulated alike, {where} differs: {_listed(values)}."
        for where, values in told.items()
        if len(set(values.values())) > 1
    ]


def _value(study: Study, table: str, key: str) -> object:
    """What a study says; of files their names and the beginning of their hashes."""
    value = getattr(getattr(study, table), key)
    if key == "parameters":
        return ", ".join(_file(study, one) for one in value) or None
    return _file(study, value) if key == "error_model" and value is not None else value


def _file(study: Study, given: str) -> str:
    place = study.path(given)
    return f"{place.name} ({file_hash(place)[:8]})"


def _listed(values: dict[str, object]) -> str:
    """Values with the studies that have them; of many numbers their range."""
    by_value: dict[object, list[str]] = {}
    for name, value in values.items():
        by_value.setdefault(value, []).append(name)
    numbers = [value for value in by_value if isinstance(value, float)]
    if len(by_value) > _NAMED and len(numbers) == len(by_value):
        return f"from {min(numbers):g} to {max(numbers):g}"
    return "; ".join(f"{_said(value)} in {_some(names)}" for value, names in by_value.items())


def _said(value: object) -> str:
    return "not given" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _some(names: list[str]) -> str:
    return ", ".join(names[:_NAMED]) + (f" and {len(names) - _NAMED} more" if len(names) > _NAMED else "")
