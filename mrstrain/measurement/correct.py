"""A drawn label map, with the boundaries of its bones and skin where the image shows them; a part of `label`."""

import time
from collections.abc import Callable
from pathlib import Path

from dvc import correct_labels, fit_mask, read_image, read_labels, write_labels
from dvc.atomic_files import write_json
from dvc.report.drawing import Drawing
from dvc.report.labels import changed_slices
from dvc.report.page import Section, Table
from mrstrain.measurement.label_files import LabelFiles, Labelled, view_of
from mrstrain.records.provenance import provenance


def corrected(
    load0: Path, labels: Path, names: Path | None, files: LabelFiles, watch: Callable[[float], None]
) -> Labelled:
    """Correct a label map (`dvc.correct_labels`), and write it with its names, picture and record."""
    began, image = time.perf_counter(), read_image(load0)
    given = fit_mask(read_labels(labels, names), image.grid, str(labels))
    made = correct_labels(image, given, watch)
    inputs = {"load0": load0, "labels": labels} | ({} if names is None else {"names": names})
    record = provenance("label", inputs, {})
    moved = {name: {"mean_mm": mean, "rms_mm": rms} for name, (mean, rms) in made.moved_mm.items()}
    found = {"changed": made.changed, "moved": moved, "notes": list(made.notes)}
    with files.alone():
        files.remove_probability()  # of an earlier label map
        write_labels(files.labels, made.labels)
        shown = view_of(made.labels), image, given, made.labels
        picture = Drawing.of("Corrected label map", changed_slices, *shown).save(files.stem)
        write_json(files.beside(".json"), record | found | {"seconds": round(time.perf_counter() - began, 1)})
    told = f"{100 * made.changed:.1f} % of the voxels have another label"
    borders = tuple((name, mean, rms) for name, (mean, rms) in made.moved_mm.items())
    listed = "; ".join(f"{name} {mean:+.2f} (rms {rms:.2f})" for name, mean, rms in borders)
    outward = "Boundaries moved outward by, mm (skin: became thicker by)"
    lines = (f"{told}; {files.picture} shows them.", f"{outward}: {listed}", *made.notes)
    table = Table("How far boundaries moved", ("boundary of", "mean, mm", "rms, mm"), borders, f"{outward}.")
    section = Section(
        "Corrected label map", None, (table,), (picture,), (f"{told}.", *made.notes), pictures_first=True
    )  # fmt: skip
    return Labelled(files.labels, (*lines, f"Label map: {files.labels}"), headline=told, section=section)
