"""A label map from a segmenter of the user's choice: a command that takes an image and writes a label map."""

from collections.abc import Callable, Sequence
from pathlib import Path

from dvc import fit_mask, read_image, read_labels, write_labels
from dvc.atomic_files import write_json
from dvc.errors import InputError, MrstrainError
from dvc.report.drawing import Drawing
from dvc.report.labels import tissue_slices
from dvc.report.page import Section, Table
from mrstrain.measurement.command import run_command
from mrstrain.measurement.label_files import LabelFiles, Labelled, view_of, volumes_ml
from mrstrain.options.measurement import IMAGE, LABELS, command_parts
from mrstrain.records.provenance import provenance

_HALF_S = 120.0  # how long a command takes is not known
_SHOWN = 3  # last lines of what a command printed


def labelled_by_command(
    load0: Path, command: str, names: Path | None, out: Path, sha256: str = "",
    watch: Callable[[float], None] = lambda _: None,
) -> Labelled:  # fmt: skip
    """Run a command that segments the unloaded image, and write its label map with names, picture and record.

    Parameters
    ----------
    load0 : path
        Unloaded image, in place of ``{image}`` in the command.
    command : str
        The command, run without a shell in the folder of the image. It writes ``{labels}`` (.nii.gz).
    names : path, optional
        Table of the names of the command's labels.
    out : path
        The label map.
    sha256 : str
        Hash of the command, for a record.
    watch : callable, optional
        Called with an estimate of the fraction that is done, 0 to 1, while the command computes.

    Raises
    ------
    MrstrainError
        If the command cannot be run, fails, or writes no label map.
    InputError, GeometryError
        If its label map cannot be read, or does not lie on the image.
    """
    inputs = {"load0": load0} | ({} if names is None else {"names": names})
    files, image = LabelFiles.of(out, [*inputs.values()]), read_image(load0, allow_missing=True)
    watch(0.0)
    with files.alone():
        made = files.beside("_of_command.nii.gz")
        try:
            made.unlink(missing_ok=True)
            _run(command, load0, made, watch)
            labels = fit_mask(read_labels(made, names), image.grid, f"The label map of '{command}'")
        finally:
            made.unlink(missing_ok=True)
        files.remove_probability()  # of an earlier label map
        write_labels(files.labels, labels)
        picture = Drawing.of("Tissues", tissue_slices, view_of(labels), image, labels).save(files.stem)
        write_json(files.beside(".json"), provenance("label", inputs, {"command": command, "sha256": sha256}))
    watch(1.0)
    volumes = volumes_ml(labels)
    told = f"Volumes, mL: {', '.join(f'{name} {volume:.1f}' for name, volume in volumes.items())}"
    table = Table("Volumes", ("tissue", "volume, mL"), tuple(volumes.items()))
    by = f"Made by the command: {command}"
    section = Section("Label map of a segmenter", None, (table,), (picture,), (by,), pictures_first=True)
    return Labelled(
        files.labels, (by, told, f"Label map: {files.labels}"), headline=", ".join(volumes), section=section
    )  # fmt: skip


def _run(command: str, image: Path, labels: Path, watch: Callable[[float], None]) -> None:
    """Run the command with the two files in it."""
    try:
        parts = command_parts(command)
    except ValueError as wrong:
        raise InputError(f"labels_command: {wrong}.") from wrong
    place = image.resolve().parent
    given = [part.replace(IMAGE, str(image.resolve())).replace(LABELS, str(labels.resolve())) for part in parts]
    try:
        code, said = run_command(given, place, lambda spent: watch(spent / (spent + _HALF_S)))
    except OSError as failure:
        what = f"labels_command: {parts[0]} cannot be run ({failure.strerror or failure})"
        raise MrstrainError(f"{what}. Install it, or give its whole path.") from failure
    if code < 0:
        raise MrstrainError(_failed(f"signal {-code} ended it, most often for lack of memory", command, said))
    if code != 0:
        raise MrstrainError(_failed(f"it ended with status {code}", command, said))
    if not labels.is_file():
        raise MrstrainError(_failed(f"it wrote no file in place of {LABELS}", command, said))


def _failed(what: str, command: str, said: str) -> str:
    lines: Sequence[str] = said.strip().splitlines()[-_SHOWN:]
    return "\n".join([f"labels_command: {what}: {command}. Run it by hand to see all that it prints.", *lines])
