"""`label`: a label map of the tissues, from the unloaded image and a mask of its bone."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dvc import LabelMap, label_tissues, read_image, read_labels, read_mask, write_labels, write_vectors
from dvc.arrays import FloatArray
from dvc.atomic_files import write_json
from dvc.errors import InputError, OutputError
from dvc.measurement.subject import is_bones_name
from dvc.report.drawing import ENDINGS, Drawing
from dvc.report.labels import label_slices
from dvc.report.page import Section, Table
from dvc.report.sheet import View
from mrstrain.options.door import door
from mrstrain.options.measurement import BoneAndBody, Marks
from mrstrain.records.inputs import alone, image_stem, output_folder
from mrstrain.records.outcome import Outcome
from mrstrain.records.provenance import file_hash, provenance

_WRITTEN = (".nii.gz", ".nii", ".nrrd", ".mha")
_USUAL = {1: "bone", 2: "fat", 3: "muscle", 4: "skin", 5: "tendon"}  # marks without names


@dataclass(frozen=True, slots=True)
class Labelled(Outcome):
    """The label map that was made: what is told of it in a line, and its section of a report."""

    headline: str = field(kw_only=True)
    section: Section = field(kw_only=True)


@door
def label(
    load0: Path | str, *, out: Path | str, masks: BoneAndBody, strokes: Marks,
    watch: Callable[[float], None] | None = None,
) -> Labelled:  # fmt: skip
    """Label skin, fat, muscle and other bones of an unloaded image.

    Parameters
    ----------
    load0 : path
        Unloaded image.
    out : path
        The label map. Beside it are written the names (.csv), the probability of each tissue (STEM_probability), a
        picture (.png, .pdf), and a record (.json).
    masks, strokes
        The bone, or the mark of one, is required; as in `dvc.label_tissues`.
    watch
        As in `dvc.label_tissues`.

    Raises
    ------
    InputError, OutputError
        Before anything is written: if no bone is given or marked, a file cannot be read or does not fit, or an input
        would be overwritten.
    """
    target, source = Path(out), Path(load0)
    ending = next((one for one in _WRITTEN if target.name.lower().endswith(one)), None)
    if ending is None:
        raise InputError(f"The output (out) is the label map and must end in {', '.join(_WRITTEN)}; got {target}.")
    stem = target.with_name(image_stem(target.name))
    beside = [stem.with_name(stem.name + one) for one in (".csv", ".json", "_probability.json", *ENDINGS)]
    probabilities = stem.with_name(f"{stem.name}_probability{ending}")
    for path in (source, *masks.paths, *strokes.paths):
        if path.resolve() in [one.resolve() for one in (target, probabilities, *beside)]:
            raise OutputError(f"{path} is an input and would be overwritten. Choose another output file (out).")
    began, image = time.perf_counter(), read_image(source)
    bone, body = (None if one is None else read_mask(one, image.grid) for one in (masks.bone, masks.tissue))
    marks = None if strokes.marks is None else read_marks(strokes.marks, strokes.mark_names)
    made = label_tissues(image, bone, body, marks, watch or (lambda _: None))
    names = tuple(made.labels.names.values())
    record = provenance(
        "label", {"load0": source, **{role: of[0] for role, of in (masks.files | strokes.files).items()}}, {}
    )
    found = {"unsure": made.unsure, "notes": list(made.notes), "seconds": round(time.perf_counter() - began, 1)}
    with output_folder(target.parent), alone(target, target.with_name(f".{target.name}.lock")):
        write_labels(target, made.labels)
        write_vectors(
            probabilities, image.grid, np.moveaxis(made.probability, 0, -1), names, "probability of each tissue",
            frame="invariant", unit="1",
        )  # fmt: skip
        view = View.through(image.grid, _shown(made.labels), made.labels.labels > 0)
        drawing = Drawing.of("Tissues and their probability", label_slices, view, image, made.labels, made.probability)
        picture = drawing.save(stem)
        write_json(beside[1], record | found | {"labels_sha256": file_hash(target)})
    voxel_ml = image.grid.voxel_volume_mm3 / 1000.0
    counts = {name: np.count_nonzero(made.labels.labels == number) for number, name in made.labels.names.items()}
    volumes = {name: float(count * voxel_ml) for name, count in counts.items()}
    unsure = f"{100 * made.unsure:.0f} % of the voxels are unsure (probability below 90 %)"
    told = f"Volumes, mL: {', '.join(f'{name} {volume:.1f}' for name, volume in volumes.items())}"
    lines = (told, f"{unsure}; {beside[-len(ENDINGS)]} shows where.", *made.notes, f"Label map: {target}")
    table = Table("Volumes", ("tissue", "volume, mL"), tuple(volumes.items()))
    section = Section(
        "Label map made from the image", None, (table,), (picture,), (f"{unsure}.", *made.notes), pictures_first=True
    )
    return Labelled(target, lines, headline=f"{', '.join(volumes)}; {unsure}", section=section)


def read_marks(path: Path, names: Path | None) -> LabelMap:
    """Marks with the names of a table, of the file itself, or the usual ones of their numbers."""
    marks = read_labels(path, names)
    if names is None and all(name == f"label-{number}" for number, name in marks.names.items()):
        if unknown := [number for number in marks.names if number not in _USUAL]:
            usual = ", ".join(f"{number} {name}" for number, name in _USUAL.items())
            raise InputError(
                f"{path}: the marks {unknown} have no name. Give a table of names (mark_names), or use the usual "
                f"numbers: {usual}."
            )
        return replace(marks, names={number: _USUAL[number] for number in marks.names})
    return marks


def _shown(labels: LabelMap) -> FloatArray:
    """The lowest point of the first bone, or of the body if marks left none of it, LPS mm."""
    bones = [number for number, name in labels.names.items() if is_bones_name(name)]
    inside = np.isin(labels.labels, bones[:1])
    points = labels.grid.points(inside if inside.any() else labels.labels > 0)
    return np.asarray(points[np.argmin(points[:, 2])])
