"""Labels "auto" of `register`: when a label map can be made from the unloaded image, how, and who should know of it."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from dvc import Engine
from dvc.errors import InputError
from dvc.file_names import one_spelling
from dvc.images.bone_names import BONE
from dvc.io.images.labels import read_names
from dvc.measurement.subject import bones_of
from dvc.report.page import Section
from mrstrain.measurement.engines import GAUSS_NEWTON
from mrstrain.options.measurement import MADE_LABELS, Marks, RegistrationOptions, Scans, SubjectFiles
from mrstrain.records.durations import TISSUES
from mrstrain.records.inputs import made_labels

_FINE_MM = 1.5  # in voxels of 1.2 x 1.2 x 2.4 mm, labels do not lower the error
NEXT_STEP = (
    "Next step: if fat is bright in the unloaded image, add --labels auto, or labels='auto' to mrstrain.register, "
    "which makes a label map from it. On phantom heels (0.8 mm voxels, exact bone mask), this lowers the error of the "
    "max. shear by about a third in fat and skin."
)


def check_auto(files: SubjectFiles, strokes: Marks, cases: Sequence[str], scans: Scans) -> None:
    """InputError if the label map cannot be made from the image."""
    if files.bone is None and strokes.marks is None:
        raise InputError(
            "labels auto also needs the mask of the bone, `bone` (--bone on the command line), or strokes in it, "
            "`marks` (--marks)."
        )
    if files.names is not None:
        raise InputError(
            "`names` is for a label map of your own; it cannot be used with labels auto (on the command line: --names, "
            "--labels auto). For the names of strokes, use `mark_names` (--mark-names)."
        )
    if files.bone_label is not None and (files.bone is not None or strokes.marks is None):
        raise InputError(
            "With labels auto, `bone_label` (--bone-label on the command line) is the name of the strokes in the bone: "
            "give it with `marks` (--marks), and without the mask `bone` (--bone)."
        )
    if strokes.mark_names is not None and strokes.marks is None:
        raise InputError("`mark_names` needs strokes, `marks` (--mark-names and --marks on the command line).")
    if scans.allow_missing:
        raise InputError(
            "labels auto cannot be combined with `allow_missing` (--allow-missing on the command line): the image must "
            "not have missing voxels."
        )
    folder = Path(MADE_LABELS).parts[0]
    if folder in map(one_spelling, cases):
        raise InputError(f"A loaded image is named '{folder}', as the folder of the label map; rename it.")


def labelled(
    load0: Path, files: SubjectFiles, strokes: Marks, out: Path, tell: Callable[[float], None]
) -> tuple[SubjectFiles, tuple[Section, ...]]:
    """Make the label map; the files with it, and its section of the report.

    The bone is then that of the label map, whose surface is at its dark rim, and not its mask.
    """
    from mrstrain.measurement.label import label  # with it come skimage.restoration and scipy.stats: 0.7 s

    labels, names = made_labels(out)
    called = BONE if files.bone is not None else _marked_bone(strokes, files.bone_label)
    tell(0.0)
    told = partial(_of_tissues, tell)
    made = label(load0, out=labels, bone=files.bone, tissue=files.tissue, **dict(strokes), progress=told)
    bone = next((name for name in read_names(names).values() if name.casefold() == called), None)
    update = {"bone": None, "labels": labels, "names": names, "bone_label": bone}
    return files.model_copy(update=update), (made.section,)


def _of_tissues(tell: Callable[[float], None], _: str, stage: str, fraction: float) -> None:
    if stage == TISSUES:
        tell(fraction)


def _marked_bone(strokes: Marks, named: str | None) -> str:
    """Name of the bone on which images are aligned, in small letters: as asked for, or the only one with strokes."""
    from mrstrain.measurement.strokes import read_marks

    assert strokes.marks is not None
    marks = read_marks(strokes.marks, strokes.mark_names)
    if named is not None:
        marks.region(named)
        return named.casefold()
    bones = bones_of(marks)
    if not bones:
        raise InputError(
            f"{strokes.marks}: no stroke is named like a bone. Draw one in the bone on which images are aligned, or "
            "give its mask, `bone` (--bone on the command line)."
        )
    if bones[1:]:
        raise InputError(
            f"{strokes.marks}: there are strokes in several bones: {', '.join(bones)}. Name the one on which images "
            "are aligned as `bone_label` (--bone-label on the command line)."
        )
    return bones[0].casefold()


def next_step(
    files: SubjectFiles, cases: Sequence[str], scans: Scans, how: RegistrationOptions, engine: Engine, edge_mm: float
) -> str | None:
    """What to tell somebody who registers without a label map where one could be made and would lower the error.

    ``edge_mm`` is the longest edge of the unloaded image's voxels.
    """
    if files.labels is not None or how.borders is False or engine.family != GAUSS_NEWTON or edge_mm > _FINE_MM:
        return None
    try:
        check_auto(files, Marks(), cases, scans)
    except InputError:
        return None
    return NEXT_STEP
