"""A drawn label map, corrected near strokes, or by the image at the boundaries of bones and skin; a part of `label`."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from dvc import Image, correct_labels, fit_mask, write_labels
from dvc.atomic_files import write_json
from dvc.labelling.boundaries import CorrectedLabels
from dvc.report.drawing import Drawing
from dvc.report.labels import changed_slices
from dvc.report.page import Section, Table
from mrstrain.measurement.label_files import LabelFiles, Labelled, view_of, volumes_ml
from mrstrain.measurement.strokes import read_marks
from mrstrain.options.measurement import GivenLabels, Marks
from mrstrain.records.inputs import read_given_labels
from mrstrain.records.provenance import provenance

_LEAST_SHARE = 0.001  # told as one: the number of voxels says more where a stroke corrects a few


def corrected(
    load0: Path, image: Image, drawn: GivenLabels, strokes: Marks, files: LabelFiles, watch: Callable[[float], None]
) -> Labelled:
    """Correct a label map (`dvc.correct_labels`), and write it with its names, picture and record."""
    began = time.perf_counter()
    assert drawn.labels is not None
    given = fit_mask(read_given_labels(drawn.labels, drawn.names), image.grid, str(drawn.labels))
    marks = None if strokes.marks is None else read_marks(strokes.marks, strokes.mark_names)
    made = correct_labels(image, given, marks=marks, watch=watch)
    inputs = {"load0": load0, **{role: of[0] for role, of in (drawn.files | strokes.files).items()}}
    record = provenance("label", inputs, {})
    moved = {name: {"mean_mm": mean, "rms_mm": rms} for name, (mean, rms) in made.moved_mm.items()}
    found = {"changed": made.changed, "moved": moved, "notes": list(made.notes)}
    with files.alone():
        files.remove_probability()  # of an earlier label map
        write_labels(files.labels, made.labels)
        shown = view_of(made.labels), image, given, made.labels
        picture = Drawing.of("Corrected label map", changed_slices, *shown).save(files.stem)
        write_json(files.beside(".json"), record | found | {"seconds": round(time.perf_counter() - began, 1)})
    told, (how, table) = changed_told(made), _volumes(made) if marks is not None else _moved(made)
    lines = (f"{told}; {files.picture} shows them.", how, *made.notes, f"Label map: {files.labels}")
    section = Section(
        "Corrected label map", None, (table,), (picture,), (f"{told}.", *made.notes), pictures_first=True
    )  # fmt: skip
    return Labelled(files.labels, lines, headline=told, section=section)


def changed_told(made: CorrectedLabels) -> str:
    """How much of a label map was changed, in a line."""
    voxels = round(made.changed * np.count_nonzero(made.labels.labels))
    some = f"{100 * made.changed:.1f} % of the voxels" if made.changed >= _LEAST_SHARE else f"{voxels} voxel"
    plural = "s" * (made.changed < _LEAST_SHARE and voxels != 1)
    return f"{some}{plural} relabelled"


def _moved(made: CorrectedLabels) -> tuple[str, Table]:
    """How far boundaries moved, as a line and as a table."""
    borders = tuple((name, mean, rms) for name, (mean, rms) in made.moved_mm.items())
    listed = "; ".join(f"{name} {mean:+.2f} (rms {rms:.2f})" for name, mean, rms in borders)
    outward = "Boundaries moved outward by, mm (skin: became thicker by)"
    table = Table("How far boundaries moved", ("boundary of", "mean, mm", "rms, mm"), borders, f"{outward}.")
    return f"{outward}: {listed}", table


def _volumes(made: CorrectedLabels) -> tuple[str, Table]:
    """Volumes of the tissues, as a line and as a table."""
    volumes = volumes_ml(made.labels)
    line = f"Volumes, mL: {', '.join(f'{name} {volume:.1f}' for name, volume in volumes.items())}"
    return line, Table("Volumes", ("tissue", "volume, mL"), tuple(volumes.items()))
