"""What a command was given, read and checked before anything is computed."""

import logging
import re
import shutil
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from filelock import FileLock, Timeout

from dvc import LabelMap, Subject, fit_mask, read_image, read_labels, read_mask, read_mesh
from dvc.arrays import FloatArray
from dvc.atomic_files import remove_partial
from dvc.errors import InputError, OutputError, few
from dvc.file_names import as_typed, clash, is_utf8, missing, refuse_as_file_name
from dvc.io.images.labels import read_names
from dvc.io.images.write import refuse_overwriting_inputs
from dvc.io.result_folder import QUALITY, REPORT
from dvc.measurement.subject import LabelsFromImage, plate_directions
from dvc.mesh import box_told
from dvc.own_files import read_json
from mrstrain.options.measurement import AUTO, MADE_LABELS, MeshAndAxes, SubjectFiles
from mrstrain.records.log import begin_logs
from mrstrain.records.provenance import file_hash

_log = logging.getLogger(__name__)
_LOCK = ".mrstrain-lock"
_UNLOADED = re.compile(r"load[ _-]?0(?![.\d]*\d)|unloaded|(?<![a-z])no[ _-]?load|baseline", re.IGNORECASE)
_AT_REST = re.compile(r"(?<![a-z])rest(?![a-z])|(?<![a-z\d.])0n(?![a-z\d])", re.IGNORECASE)
_LOADED = re.compile(
    r"load[ _-]?[1-9]|(?<![a-z\d.])[1-9]\d*(\.\d+)?n(?![a-z\d])", re.IGNORECASE
)  # 140N_0N has no shear
_NAMES_BESIDE = (
    "%s: the labels have no names. There is a table of names beside it, %s; to use it, give it as names (--names %s on "
    "the command line)."
)
TABLE_ENDINGS = (".csv", ".txt", ".label", ".ctbl")
WRITTEN = (".nii.gz", ".nii", ".nrrd", ".mha")
"""Formats of label maps that are made."""
IMAGE_ENDINGS = (".nii.gz", ".seg.nrrd", ".nii", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")


def read_subject(
    load0: Path | str, files: SubjectFiles, onto: MeshAndAxes | None = None, *, allow_missing: bool = False
) -> Subject:
    """Read the unloaded image, its masks, labels and mesh; refuse what does not fit together."""
    reference, onto = read_image(load0, allow_missing=allow_missing), onto or MeshAndAxes()
    label_map, mesh = None, None
    if files.labels == AUTO:
        raise InputError("Only register and run make a label map from the image. Make it with `mrstrain label` first.")
    if files.labels is not None:
        label_map = fit_mask(read_given_labels(files.labels, files.names), reference.grid, str(files.labels))
    elif files.names is not None or files.bone_label is not None:
        raise InputError("names and bone_label need a label map (labels).")
    if files.bone is not None and files.bone_label is not None:
        raise InputError(
            "The bone was given twice: use the mask (bone, --bone) or the label (bone_label, --bone-label)."
        )
    bone = None if files.bone is None else read_mask(files.bone, reference.grid)
    if files.bone_label is not None and label_map is not None:
        bone = label_map.region(files.bone_label)
    tissue = None if files.tissue is None else read_mask(files.tissue, reference.grid)
    if onto.mesh is not None:
        mesh = read_mesh(onto.mesh, unit=onto.mesh_unit, frame=onto.mesh_frame)
        if not reference.grid.contains(mesh.points_mm).any():
            own, of_image = box_told(*mesh.bounds_mm), box_told(*reference.grid.bounds_mm())
            raise InputError(
                f"{onto.mesh}: no node is inside the unloaded image. The mesh spans {own} mm; the image {of_image} mm "
                "(LPS). Check mesh_unit and mesh_frame."
            )
    normal, axes = plate_directions(onto.plate_normal, onto.shear_direction)
    given = {role: paths[0] for role, paths in {"load0": [Path(load0)], **files.files, **onto.files}.items()}
    made = None if files.labels is None else made_from_image(files.labels)
    pressed = onto.plate_normal is not None or axes is not None
    return Subject(reference, bone, tissue, label_map, mesh, normal, axes, given, made, pressed)


def read_given_labels(path: Path | str, names: Path | None) -> LabelMap:
    """Read a label map; a note where its labels have no names, and a table of names lies beside it."""
    labels, place = read_labels(path, names), Path(path)
    if names is None and all(name == f"label-{number}" for number, name in labels.names.items()):
        for table in (place.with_name(image_stem(place.name) + ending) for ending in TABLE_ENDINGS):
            with suppress(InputError):  # no table of names
                if table.is_file() and read_names(table).keys() >= labels.names.keys():
                    _log.warning(_NAMES_BESIDE, place, table, as_typed(table))
                    break
    return labels


def made_labels(out: Path) -> tuple[Path, Path]:
    """The label map that is made from the image, in a folder of results, and the table of its names."""
    labels = out / MADE_LABELS
    return labels, labels.with_name(image_stem(labels.name) + ".csv")


def made_from_image(labels: Path) -> LabelsFromImage | None:
    """How a label map that `label` made came out, by the record beside it; None for any other, or one changed since."""
    try:
        record = read_json(labels.with_name(image_stem(labels.name) + ".json"))
        if record["command"] != "label" or record["labels_sha256"] != file_hash(labels):
            return None
        return LabelsFromImage(
            float(record["uncertain" if "uncertain" in record else "unsure"]), tuple(map(str, record["notes"]))
        )
    except (OSError, ValueError, LookupError, TypeError):
        return None


def made_beside(labels: Path) -> tuple[Path, ...]:
    """Files that lie beside a label map that `label` made, and belong to it: its record and its probabilities."""
    stem, ending = image_stem(labels.name), next((e for e in WRITTEN if labels.name.lower().endswith(e)), "")
    endings = ".json", "_probability.json", f"_probability{ending}"
    return tuple(path for ending in endings if (path := labels.with_name(stem + ending)).is_file())


def read_matrix(path: Path) -> FloatArray:
    """Read a 4 x 4 matrix from a text file of four rows; InputError for any other file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # an empty file is refused below
            rows = np.loadtxt(path, encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(missing(path, "file")) from error
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror or error}).") from error
    except ValueError as error:
        raise InputError(
            f"{path}: not a matrix of four rows of four numbers, separated by spaces, with decimal points."
        ) from error
    return matrix_of(rows, str(path))


def matrix_of(rows: object, where: str) -> FloatArray:
    """A homogeneous matrix (4, 4) of rows of numbers; InputError, naming ``where``, for anything else."""
    try:
        matrix = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{where}: not a matrix of four rows of four numbers.") from error
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: the matrix has shape {matrix.shape}; 4 x 4 is needed.")
    if not np.isfinite(matrix).all():
        row, column = np.argwhere(~np.isfinite(matrix))[0] + 1
        raise InputError(f"{where}: the number in row {row}, column {column} of the matrix is not finite.")
    if not np.allclose(matrix[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-9):
        raise InputError(f"{where}: the last row of the matrix must be 0 0 0 1; it is {matrix[3].tolist()}.")
    return matrix


def named_unloaded(name: str) -> bool:
    """Whether an image is named like the unloaded one: Load0, heel_unloaded, heel_rest, baseline, heel_0N."""
    stem = image_stem(name)
    return bool(_UNLOADED.search(stem) or (_AT_REST.search(stem) and not _LOADED.search(stem)))


def swapped_by_name(load0: Path, loads: Sequence[Path]) -> str:
    """A sentence if a loaded image is named like the unloaded one, and the unloaded one is not; empty otherwise."""
    if named_unloaded(load0.name) or not (odd := [path.name for path in loads if named_unloaded(path.name)]):
        return ""
    return (
        f"{odd[0]} is given as a loaded image, but named like the unloaded one. If the images are swapped, strains are "
        f"wrong: the unloaded image comes first, here {load0.name}."
    )


def image_stem(name: str) -> str:
    """A file's name without the ending of its image format, if it has one."""
    return next((name[: -len(ending)] for ending in IMAGE_ENDINGS if name.lower().endswith(ending)), name)


def case_names(loads: Sequence[Path]) -> list[str]:
    """Names of the result folders, from the files' names; InputError if two would be the same, or one is no name."""
    names = [image_stem(path.name) for path in loads]
    for name, path in zip(names, loads, strict=True):
        refuse_as_file_name("load", name, str(path))
    if twice := clash(names):
        raise InputError(
            f"Results folders are named after the loaded images, and two would be named {twice}. Rename the files, or "
            "use different output folders (out)."
        )
    return names


def refuse_touching_inputs(out: Path, case_folders: Sequence[str], inputs: Sequence[Path]) -> None:
    """Refuse an output folder in which a result would replace an input, or the folder that an input lies in."""
    refuse_overwriting_inputs([out / c for c in case_folders] + [out / REPORT], inputs)
    for path in inputs:
        for case in case_folders:
            if (out / case).resolve() in path.resolve().parents:
                raise OutputError(
                    f"{out / case} would be replaced, but it has the input {path}. Choose another folder (out)."
                )


def earlier_results(out: Path, case_folders: Sequence[str]) -> str:
    """A sentence on what an earlier run left in an output folder, replaced or not; empty without results."""
    found = sorted({path.parent.name for path in out.glob(f"*/{QUALITY}")})
    replaced, kept = ([name for name in found if (name in case_folders) == these] for these in (True, False))
    told = [f"Replaced: {few(replaced)}."] if replaced else []
    told += [f"Kept, not part of this run: {few(kept)}."] if kept else []
    return f"{out} holds results of an earlier run. {' '.join(told)}" if told else ""


def refuse_small_disk(out: Path, needed: float, what: str, instead: str = "") -> None:
    """Refuse an output folder, made or not yet made, on a disk with too little room for ``needed`` bytes.

    The message says ``what`` needs them ("the set needs"), and what can be done ``instead`` of choosing another.
    """
    there = next(place for place in (out.resolve(), *out.resolve().parents) if place.exists())
    free = shutil.disk_usage(there).free
    if free < needed:
        raise OutputError(
            f"{out}: {what} about {needed / 1e6:.0f} MB, but the disk has only {free / 1e6:.0f} MB left. Free disk "
            f"space, or choose another folder (out){instead}."
        )


@contextmanager
def alone(out: Path, lock: Path | None = None) -> Iterator[None]:
    """Refuse what another run writes to at the same time: OutputError that names ``out``.

    The ``lock`` is a file, by default in the folder ``out``, that is removed with the block. The operating system
    releases it when the process ends, even by a kill. Files that a killed run had begun to write are removed first.
    """
    place = lock or out / _LOCK
    held = FileLock(place)
    try:
        held.acquire(timeout=0)
    except Timeout as taken:
        raise OutputError(f"{out}: another run writes to it. Wait until it ends, or choose another (out).") from taken
    try:
        for folder in {out, place.parent}:
            remove_partial(folder)
        yield
    finally:
        with suppress(OSError):  # where an open file cannot be removed
            place.unlink()
        held.release()


@contextmanager
def output_folder(out: Path) -> Iterator[None]:
    """Make the output folder as `make_output` does; where an error ends the block, folders made and left empty go."""
    made = [folder for folder in (out, *out.parents) if not folder.exists()]
    make_output(out)
    try:
        yield
    except BaseException:
        with suppress(OSError):  # not empty
            for folder in made:
                folder.rmdir()
        raise


def make_output(out: Path) -> None:
    """Make the output folder, in which the log of a command then begins, and refuse one that cannot be written to."""
    if not is_utf8(out):  # native code that writes into it would end the process
        name = str(out).encode(errors="backslashreplace").decode()
        raise OutputError(f"{name}: the name of the output folder is not UTF-8. Choose another folder (out).")
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".mrstrain-probe"
        try:
            probe.write_bytes(b"0")
        finally:
            probe.unlink(missing_ok=True)  # another run may have probed at the same time
    except OSError as error:
        raise OutputError(
            f"{out}: results cannot be written here ({error.strerror or error}). Choose another folder (out), "
            "change its permissions, or free disk space."
        ) from error
    begin_logs()
