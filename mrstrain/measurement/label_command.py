"""A label map from a segmenter of the user's choice: a command that takes an image and writes a label map."""

import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from dvc import fit_mask, read_image, read_labels, write_labels
from dvc.atomic_files import write_json
from dvc.errors import InputError, MrstrainError
from dvc.report.drawing import Drawing
from dvc.report.labels import tissue_slices
from dvc.report.page import Section, Table
from mrstrain.measurement.label_files import LabelFiles, Labelled, view_of, volumes_ml
from mrstrain.options.measurement import IMAGE, LABELS, command_parts
from mrstrain.records.provenance import provenance

_SHOWN = 3  # last lines of what a command printed


def labelled_by_command(
    load0: Path, command: str, names: Path | None, out: Path, watch: Callable[[float], None] = lambda _: None
) -> Labelled:
    """Run a command that segments the unloaded image, and write its label map with names, picture and record.

    Parameters
    ----------
    load0 : path
        Unloaded image, in place of ``{image}`` in the command.
    command : str
        It is run without a shell, in the folder of the image; what it writes to ``{labels}`` (.nii.gz) is read.
    names : path, optional
        Table of the names of the command's labels.
    out : path
        The label map.

    Raises
    ------
    MrstrainError
        If the command cannot be run, fails, or writes no label map.
    InputError, GeometryError
        If its label map cannot be read, or does not lie on the image.
    """
    files, image = (
        LabelFiles.of(out, [path for path in (load0, names) if path is not None]),
        read_image(load0, allow_missing=True),
    )
    watch(0.0)
    with files.alone():
        made = files.beside("_of_command.nii.gz")
        try:
            _run(command, load0, made)
            labels = fit_mask(read_labels(made, names), image.grid, f"The label map of '{command}'")
        finally:
            made.unlink(missing_ok=True)
        write_labels(files.labels, labels)
        picture = Drawing.of("Tissues", tissue_slices, view_of(labels), image, labels).save(files.stem)
        inputs = {"load0": load0} | ({} if names is None else {"names": names})
        write_json(files.beside(".json"), provenance("label", inputs, {"command": command}))
    watch(1.0)
    volumes = volumes_ml(labels)
    told = f"Volumes, mL: {', '.join(f'{name} {volume:.1f}' for name, volume in volumes.items())}"
    table = Table("Volumes", ("tissue", "volume, mL"), tuple(volumes.items()))
    by = f"Made by the command: {command}"
    section = Section("Label map of a segmenter", None, (table,), (picture,), (by,), pictures_first=True)
    return Labelled(
        files.labels, (by, told, f"Label map: {files.labels}"), headline=", ".join(volumes), section=section
    )  # fmt: skip


def _run(command: str, image: Path, labels: Path) -> None:
    """Run the command with the two files in it."""
    try:
        parts = command_parts(command)
    except ValueError as wrong:
        raise InputError(f"labels_command: {wrong}.") from wrong
    place = image.resolve().parent
    given = [part.replace(IMAGE, str(image.resolve())).replace(LABELS, str(labels.resolve())) for part in parts]
    try:
        done = subprocess.run(given, cwd=place, capture_output=True, text=True, errors="replace", check=False)
    except OSError as failure:
        what = f"labels_command: {parts[0]} cannot be run ({failure.strerror or failure})"
        raise MrstrainError(f"{what}. Install it, or give its whole path.") from failure
    if done.returncode != 0:
        raise MrstrainError(_failed(f"it ended with status {done.returncode}", command, done.stderr or done.stdout))
    if not labels.is_file():
        raise MrstrainError(_failed(f"it wrote no file in place of {LABELS}", command, done.stderr or done.stdout))


def _failed(what: str, command: str, said: str) -> str:
    lines: Sequence[str] = said.strip().splitlines()[-_SHOWN:]
    return "\n".join([f"labels_command: {what}: {command}. Run it by hand to see all that it prints.", *lines])
