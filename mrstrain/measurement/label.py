"""`label`: a label map from the unloaded image with its bone, marks, or another subject's labels; or one corrected."""

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from dvc import (
    Image,
    LabelMap,
    Mask,
    TissueLabels,
    label_tissues,
    labels_from,
    read_image,
    read_labels,
    read_mask,
    write_labels,
    write_vectors,
)
from dvc.atomic_files import write_json
from dvc.errors import InputError, few
from dvc.registration.register import refuse_one_image_twice
from dvc.report.drawing import Drawing
from dvc.report.labels import label_slices
from dvc.report.page import Section, Table
from dvc.report.strokes import MARKED
from mrstrain.measurement.correct import corrected
from mrstrain.measurement.label_files import LabelFiles, Labelled, view_of, volumes_ml
from mrstrain.options.door import door
from mrstrain.options.measurement import BoneAndBody, GivenLabels, Marks
from mrstrain.records.provenance import file_hash, provenance


@door
def label(
    load0: Path | str, *, out: Path | str, masks: BoneAndBody, strokes: Marks, drawn: GivenLabels,
    watch: Callable[[float], None] | None = None,
) -> Labelled:  # fmt: skip
    """Label skin, fat, muscle and bones of an unloaded image, or correct the boundaries of its label map.

    Parameters
    ----------
    load0 : path
        Unloaded image.
    out : path
        The label map. Beside it are written the names (.csv), a picture (.png, .pdf), a record (.json), and, unless a
        label map is corrected, the probability of each tissue (STEM_probability).
    masks, strokes
        The bone, or the mark of one, is required, unless ``labels`` are given; as in `dvc.label_tissues`.
    drawn
        Instead, ``labels`` of this image, which are corrected as in `dvc.correct_labels`; or ``labels`` of another
        subject's image (``from_image``), which are transferred as in `dvc.labels_from`.
    watch
        As in `dvc.label_tissues`.

    Raises
    ------
    InputError, OutputError
        Before anything is written: if no bone is given or marked, a file cannot be read or does not fit, or an input
        would be overwritten.
    """
    source, tell = Path(load0), watch or (lambda _: None)
    files = LabelFiles.of(out, (source, *masks.paths, *strokes.paths, *drawn.paths))
    if drawn.labels is not None and drawn.from_image is None:
        if masks.paths or strokes.paths:
            raise InputError("A label map (--labels) is corrected by the image alone: give it without masks or marks.")
        return corrected(source, drawn.labels, drawn.names, files, tell)
    began, image = time.perf_counter(), read_image(source)
    bone, body = (None if one is None else read_mask(one, image.grid) for one in (masks.bone, masks.tissue))
    if drawn.paths:
        made = _from_another(image, bone, body, strokes, drawn, tell)
    else:
        marks = None if strokes.marks is None else read_marks(strokes.marks, strokes.mark_names)
        made = label_tissues(image, bone, body, marks, tell)
    names = tuple(made.labels.names.values())
    inputs = {"load0": source, **{role: of[0] for role, of in (masks.files | strokes.files | drawn.files).items()}}
    found = {"uncertain": made.uncertain, "notes": list(made.notes), "seconds": round(time.perf_counter() - began, 1)}
    with files.alone():
        write_labels(files.labels, made.labels)
        write_vectors(
            files.probability, image.grid, np.moveaxis(made.probability, 0, -1), names, "probability of each tissue",
            frame="invariant", unit="1",
        )  # fmt: skip
        shown = view_of(made.labels), image, made.labels, made.probability
        picture = Drawing.of("Tissues and their probability", label_slices, *shown).save(files.stem)
        record = provenance("label", inputs, {}) | found | {"labels_sha256": file_hash(files.labels)}
        write_json(files.beside(".json"), record)
    volumes = volumes_ml(made.labels)
    uncertain = f"{100 * made.uncertain:.0f} % of the voxels have an uncertain label (probability below 90 %)"
    told = f"Volumes, mL: {', '.join(f'{name} {volume:.1f}' for name, volume in volumes.items())}"
    lines = (told, f"{uncertain}; {files.picture} shows where.", *made.notes, f"Label map: {files.labels}")
    made_from = f"Label map made from {'another subject' if drawn.paths else 'the image'}"
    table = Table("Volumes", ("tissue", "volume, mL"), tuple(volumes.items()))
    section = Section(made_from, None, (table,), (picture,), (f"{uncertain}.", *made.notes), pictures_first=True)
    return Labelled(files.labels, lines, headline=f"{', '.join(volumes)}; {uncertain}", section=section)


def _from_another(
    image: Image, bone: Mask | None, body: Mask | None, strokes: Marks, drawn: GivenLabels,
    tell: Callable[[float], None],
) -> TissueLabels:  # fmt: skip
    """Labels of another subject, transferred to the image."""
    if drawn.labels is None:
        if drawn.from_image is None:
            raise InputError(
                "`names` is for the label map `labels`, which is not given (--names and --labels on the command line). "
                "For the names of strokes, use `mark_names` (--mark-names)."
            )
        raise InputError(
            "`from_image` needs the label map of that image, `labels` (--from and --labels on the command line)."
        )
    if strokes.paths:
        raise InputError(
            "Give marks or another subject's labels, not both. If the labels are wrong somewhere, correct them by hand."
        )
    assert drawn.from_image is not None
    other, theirs = read_image(drawn.from_image), read_labels(drawn.labels, drawn.names)
    refuse_one_image_twice([("The image to label", image), ("the other subject's", other)])
    return labels_from(image, other, theirs, bone, body, tell)


def read_marks(path: Path, names: Path | None) -> LabelMap:
    """Marks with the names of a table, of the file itself, or the usual ones of their numbers."""
    marks = read_labels(path, names)
    if names is None and all(name == f"label-{number}" for number, name in marks.names.items()):
        if unknown := [number for number in marks.names if number not in MARKED]:
            usual = ", ".join(f"{number} {name}" for number, name in MARKED.items())
            raise InputError(
                f"{path}: the marks {few(unknown)} have no name. Give a table of names as mark_names (--mark-names), "
                f"or use the usual numbers: {usual}."
            )
        return replace(marks, names={number: MARKED[number] for number in marks.names})
    return marks
