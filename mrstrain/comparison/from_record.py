"""Options that were given when the strain was measured, and so need not be given again: `compare` and `level`."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from dvc import load_preset, preset_names
from dvc.errors import InputError
from dvc.io.result_folder import ResultFolder
from dvc.registration.engines import DEFAULT
from mrstrain.measurement.engines import ELASTIX, GAUSS_NEWTON
from mrstrain.options.measurement import EngineOptions, SubjectFiles
from mrstrain.options.model import Options
from mrstrain.options.modelling import ComparisonDirections, ComparisonLabels, Directions
from mrstrain.records.inputs import made_from_image
from mrstrain.records.measured_with import MeasuredWith

_F = TypeVar("_F", bound=SubjectFiles)
_E = TypeVar("_E", bound=EngineOptions)


def fill_labels(given: ComparisonLabels, loads: Sequence[ResultFolder]) -> ComparisonLabels:
    """The label map with its names and bones: as given, or those that the loads were measured with.

    Names and bones belong to a label map: beside one that is given, they are not taken from the record. InputError is
    raised if no label map was measured with, or its file is not found as it was.
    """
    if given.labels is not None:
        return given
    record = MeasuredWith.shared(loads, "the label map as labels (--labels)", ("labels", "names", "bone_label"))
    labels = record.file("labels")
    if labels is None:
        raise InputError(
            f"{record.path}: the measurement was made without a label map, and a comparison needs one. Give that of "
            "the unloaded image as labels (--labels)."
        )
    # A label map that was made from the image may have other bones beside that of the alignment.
    bone = record.parameters.get("bone_label") if made_from_image(labels) is None else None
    bones = given.bones or (() if bone is None else (str(bone),))
    return given.model_copy(update={"labels": labels, "names": given.names or record.file("names"), "bones": bones})


def fill_directions(
    given: ComparisonDirections, loads: Sequence[ResultFolder]
) -> tuple[Directions, dict[str, Directions]]:
    """The plate's directions: as given, as measured with, or the usual ones; and those of loads that have others."""
    chosen = {name: vector for name, vector in given if vector is not None}
    if len(chosen) == len(Directions.model_fields):  # no record is needed
        return Directions.of(chosen), {}
    of_load = {load.load: Directions.of(_recorded_directions(load) | chosen) for load in loads}
    first = of_load[loads[0].load]
    return first, {load: of for load, of in of_load.items() if of != first}


def _recorded_directions(load: ResultFolder) -> dict[str, Any]:
    """The plate's directions in the record of a load; records of other tools and older ones may have none."""
    record = MeasuredWith.read(load.folder)
    told = {} if record is None else {name: record.parameters.get(f"{name}_lps") for name in Directions.model_fields}
    return {name: vector for name, vector in told.items() if vector is not None}


def fill_subject(given: _F, record: MeasuredWith) -> _F:
    """What is known of the unloaded image: as given, or as it was measured with; errors as `MeasuredWith.file`."""
    update: dict[str, Any] = {}
    if given.tissue is None:
        update["tissue"] = record.file("tissue")
    if given.labels is None:
        update["labels"], update["names"] = record.file("labels"), given.names or record.file("names")
    if given.bone is None and given.bone_label is None:
        update["bone"] = record.file("bone")
        update["bone_label"] = record.parameters.get("bone_label") if given.labels is None else None
    return given.model_copy(update=update)


def fill_engine(given: _E, record: MeasuredWith, *, labelled: bool) -> _E:
    """The engine of a registration: as given, or that of the measurement; errors as `MeasuredWith.find`.

    InputError where it is ``labelled`` now and the measurement did without labels.
    """
    if given.engine or given.preset or given.parameters:
        return given
    how = record.parameters
    family = how.get("engine")
    if family == ELASTIX:
        return given.model_copy(update=_elastix(record))
    if family == GAUSS_NEWTON and given.borders is None:
        borders = how.get("borders")
        if labelled and "bone_alone" in (borders or {}):
            raise InputError(
                f"{record.path}: in this measurement, strain could be discontinuous only at the surface of the bone. "
                "Leave out the label map (labels), so that the model is measured in the same way."
            )
        if borders is None:
            return given.model_copy(update={"borders": False})
    return given.model_copy(update={"engine": family}) if family not in (None, DEFAULT) else given


def _elastix(record: MeasuredWith) -> dict[str, Any]:
    """Preset or parameter files of a measurement by elastix, whose record has their names and text."""
    stages = record.parameters.get("stages") or []
    names = [stage["name"] for stage in stages]
    if len(names) == 1 and names[0] in preset_names() and load_preset(names[0]).text == stages[0]["text"]:
        return {"preset": names[0]}
    what, instead = "elastix parameter file", "the files to use as parameters (--parameters)"
    return {"parameters": tuple(record.find(s["name"], partial(_has_text, s["text"]), what, instead) for s in stages)}


def _has_text(text: str, place: Path) -> bool:
    return place.is_file() and place.read_bytes().replace(b"\r\n", b"\n") == text.encode()


def taken_from_record(place: Path, *options: tuple[Options, Options], more: Sequence[str] = ()) -> tuple[str, ...]:
    """A line on what was taken from the record of a measurement, as one would type it; none where nothing was.

    Each pair of options is what there was without the record, and with it; ``more`` comes after them as it is.
    """
    words = [
        word
        for before, after in options
        for field, value in after
        if value not in (getattr(before, field), type(after).model_fields[field].default)
        for word in _typed(after, field, value)
    ]
    return (f"From the record of {place}: {' '.join([*words, *more])}",) if more or words else ()


def _typed(options: Options, field: str, value: Any) -> list[str]:
    """A value as a person types it."""
    name = options.option(field)
    if isinstance(value, bool):
        return [name if value else name.replace("--", "--no-", 1)]
    if isinstance(value, tuple) and not isinstance(value[0], float):
        return [f"{name} {one}" for one in value]
    return [f"{name} {' '.join(f'{one:g}' for one in value) if isinstance(value, tuple) else value}"]
