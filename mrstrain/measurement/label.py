"""`label`: a label map from the image with its bone, marks, or another subject's labels; or one that is corrected."""

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from dvc import (
    Image,
    LabelMap,
    Mask,
    TissueLabels,
    correct_labels,
    label_tissues,
    labels_from,
    read_image,
    read_mask,
    write_labels,
    write_vectors,
)
from dvc.atomic_files import write_json
from dvc.errors import InputError
from dvc.images.bone_names import is_bones_name
from dvc.registration.register import refuse_one_image_twice
from dvc.report.alike import listed
from dvc.report.drawing import Drawing
from dvc.report.labels import label_slices
from dvc.report.page import Section, Table
from mrstrain.measurement.correct import changed_told, corrected
from mrstrain.measurement.label_files import LabelFiles, Labelled, read_made, view_of, volumes_ml
from mrstrain.measurement.strokes import read_marks
from mrstrain.options.door import door
from mrstrain.options.measurement import BoneAndBody, GivenLabels, Marks
from mrstrain.records.durations import TISSUES, labelling
from mrstrain.records.inputs import read_given_labels
from mrstrain.records.progress import OnProgress, expect
from mrstrain.records.provenance import file_hash, provenance
from mrstrain.records.time_left import WRITING


@door
def label(
    load0: Path | str, *, out: Path | str, masks: BoneAndBody, strokes: Marks, drawn: GivenLabels,
    progress: OnProgress | None = None,
) -> Labelled:  # fmt: skip
    """Label skin, fat, muscle and bones of an unloaded image, or correct its label map.

    Parameters
    ----------
    load0 : path
        Unloaded image.
    out : path
        The label map. Beside it are written the names (.csv), a picture (.png, .pdf), a record (.json), and, unless a
        label map that was drawn is corrected, the probability of each tissue (STEM_probability).
    masks, strokes
        The bone, or the mark of one, is required, unless ``labels`` are given; as in `dvc.label_tissues`.
    drawn
        ``labels`` of this image, which are corrected as in `dvc.correct_labels`: near the strokes, or without strokes
        at the boundaries of bones and skin. Or ``labels`` of another subject's image (``from_image``), which are
        transferred as in `dvc.labels_from`.
    progress : callable, optional
        ``progress(case, stage, fraction)``.

    Raises
    ------
    InputError, OutputError
        Before anything is written: if no bone is given or marked, a file cannot be read or does not fit, or an input
        would be overwritten.
    """
    source, whole = Path(load0), partial(progress or (lambda *_: None), "label")
    files, tell = LabelFiles.of(out, (source, *masks.paths, *strokes.paths, *drawn.paths)), partial(whole, TISSUES)
    corrects = drawn.labels is not None and drawn.from_image is None
    if corrects and masks.paths:
        raise InputError(
            "A label map of this image (--labels) holds its bones and body. Give it without masks (--bone, --tissue)."
        )
    began, image, changed = time.perf_counter(), read_image(source), list[str]()
    carried = drawn.from_image is not None
    expect(progress, {"label": labelling(float(np.prod(image.grid.shape)), carried=carried)})
    before = None
    if drawn.labels is not None and corrects:
        before = None if strokes.marks is None else read_made(drawn.labels, drawn.names)
        if before is None:
            again = corrected(source, image, drawn, strokes, files, tell)
            whole(WRITING, 1.0)
            return again
    bone, body = (None if one is None else read_mask(one, image.grid) for one in (masks.bone, masks.tissue))
    marks = None if strokes.marks is None else read_marks(strokes.marks, strokes.mark_names)
    if before is not None:
        near = correct_labels(image, before.labels, marks=marks, probability=before.probability, watch=tell)
        assert near.probability is not None
        made = TissueLabels(near.labels, near.probability, (*before.notes, *near.notes))
        title, changed = "Label map corrected by strokes", [f"{changed_told(near)}."]
    elif drawn.paths:
        made, title = _from_another(image, bone, body, marks, drawn, tell), "Label map made from another subject"
    else:
        made, title = label_tissues(image, bone, body, marks, tell), "Label map made from the image"
    names = tuple(made.labels.names.values())
    inputs = {"load0": source, **{role: of[0] for role, of in (masks.files | strokes.files | drawn.files).items()}}
    found = {"uncertain": made.uncertain, "notes": list(made.notes), "seconds": round(time.perf_counter() - began, 1)}
    whole(WRITING, 0.0)
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
    whole(WRITING, 1.0)
    volumes = volumes_ml(made.labels)
    uncertain = f"{100 * made.uncertain:.0f} % of the voxels have an uncertain label (probability below 90 %)"
    told = f"Volumes, mL: {', '.join(f'{name} {volume:.1f}' for name, volume in volumes.items())}"
    bones = [name for name in volumes if is_bones_name(name)]
    found_bones = f"Bones found: {listed(bones) if bones else 'none'}. A bone that was missed is labelled as fat."
    lines = (
        *changed, told, f"{uncertain}; {files.picture} shows where.", found_bones, *made.notes,
        f"Label map: {files.labels}",
    )  # fmt: skip
    table = Table("Volumes", ("tissue", "volume, mL"), tuple(volumes.items()))
    section = Section(
        title, None, (table,), (picture,), (f"{uncertain}. {found_bones}", *made.notes), pictures_first=True
    )
    return Labelled(files.labels, lines, headline=f"{', '.join(volumes)}; {uncertain}", section=section)


def _from_another(
    image: Image, bone: Mask | None, body: Mask | None, marks: LabelMap | None, drawn: GivenLabels,
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
    assert drawn.from_image is not None
    other, theirs = read_image(drawn.from_image), read_given_labels(drawn.labels, drawn.names)
    refuse_one_image_twice([("The image to label", image), ("the other subject's", other)])
    return labels_from(image, other, theirs, bone, body, marks=marks, watch=tell)
