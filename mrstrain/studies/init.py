"""`init`: writes a study file from the files in a folder."""

import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

import jinja2

from dvc import read_image, read_labels, read_mask
from dvc.atomic_files import whole_file, write_whole
from dvc.errors import InputError, OutputError, few
from dvc.file_names import as_typed
from dvc.images.bone_names import is_bones_name
from dvc.io.images.dicom import is_dicom, is_multiframe
from fe import BONE, published_names
from mrstrain.comparison.model_files import ENDINGS
from mrstrain.models.simulate import LOADS
from mrstrain.options.modelling import Directions, Meshing
from mrstrain.records.inputs import IMAGE_ENDINGS, TABLE_ENDINGS, image_stem, named_unloaded
from mrstrain.studies.file import FILE

_AGAIN = re.compile(r"again|repeat|rescan|retest", re.IGNORECASE)
_LOADED = re.compile(
    r"load[ _-]?[1-9]\d*|loaded|(?<![a-z\d.])(?P<force>[1-9]\d+(\.\d+)?)n(?![a-z\d])", re.IGNORECASE
)  # Load1, 140N
_LABELS = re.compile(r"label|tissue|seg", re.IGNORECASE)
_ONE_BONE = re.compile(r"(.*[ _-])?(calcaneus|calcaneum|bone)[ _-]*seg(mentation)?", re.IGNORECASE)
_SEVERAL = re.compile(r"label|tissue|fat|muscle|skin|to[ _-]?mesh", re.IGNORECASE)
_TO_MESH = re.compile(r"to[ _-]?mesh", re.IGNORECASE)
_BONE = re.compile(r"calcaneus|calcaneum|bone|(?<![a-z])calc(?![a-z])", re.IGNORECASE)
_VARIANT = "-as-published"  # suffix of sets with another interpretation of the published parameters
_SOFTEST = "friedman"  # takes hours, so it must be named explicitly
_ROLES = {
    "labels": "the label map", "mesh_labels": "the label map to be meshed", "bone_mask": "the bone",
    "repeat": "the repeat scan", "load": "the load of that name",
}  # fmt: skip
_NO_ROLE = "because its name does not indicate a role"
_NAMES = (
    "Recognised names: Load0, NAME_unloaded or NAME_rest; Load1, NAME_loaded or NAME_140N; NAME_bone; NAME_labels; "
    "Load0-again. "
    "Rename the files, delete study.toml, and run mrstrain init again."
)
_SLICES = "A DICOM series belongs in a folder of its own, such as Load1; then delete study.toml, and run init again."
_LOOKED_AT = 20
_EDGE_OF_A_BODY_MM = 4.0  # where the whole body that the image shows is meshed
PICTURE = "study.png"
_TO_FILL_IN = "# FILL IN"  # of lines in the template


@dataclass(slots=True)
class StudyInputs:
    """Files of a folder by the role that their names suggest; names are relative to the folder."""

    load0: str | None = None
    repeat: str | None = None
    loads: dict[str, str] = field(default_factory=dict)
    labels: str | None = None
    names: str | None = None
    bone_mask: str | None = None
    mesh_labels: str | None = None
    mesh_names: str | None = None
    results: list[str] = field(default_factory=list)
    unused: dict[str, str] = field(default_factory=dict)  # unused images and folders, with the reason
    slices: str = ""  # single DICOM slices beside the images, which are not used


@dataclass(frozen=True, slots=True)
class Answers:
    """What the files of a folder do not tell, as far as it is known; forces in N, directions LPS."""

    bone: str | None = None  # name of its label
    bone_mask: str | None = None  # or the file of a mask of it
    forces: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # normal and shear, by load
    normal: tuple[float, float, float] = Directions().plate_normal  # of the plate, outward
    shear_direction: tuple[float, float, float] = Directions().shear_direction


def force_named(load: str) -> float | None:
    """Normal force, N, in the name of a load, such as heel_140N; None if there is none."""
    forces = [match["force"] for match in _LOADED.finditer(load) if match["force"]]
    return float(forces[0]) if len(forces) == 1 else None


@dataclass(frozen=True, slots=True)
class NewStudy:
    """The study file that `init` wrote, the files that it names, and a picture of them or why there is none."""

    path: Path
    inputs: StudyInputs
    picture: Path | str
    makes_labels: bool = False  # whether the study makes the label map from the image

    def summary(self) -> list[str]:
        """Summary, a few lines: what was found and what is left to do."""
        found = self.inputs
        lines = [f"Load0: {found.load0 or 'NOT FOUND'}", f"Loads: {', '.join(found.loads.values()) or 'NONE FOUND'}"]
        labels = found.labels or (
            "to be made from Load0 and the mask of the bone" if self.makes_labels else "NOT FOUND"
        )
        lines += [f"Labels: {labels}", f"Repeat scan: {found.repeat or 'none'}"]
        lines += [f"Mask of the bone: {found.bone_mask}"] if found.bone_mask else []
        lines += [f"Results of other codes: {', '.join(found.results)}"] if found.results else []
        lines += [f"NOT USED: {name}, {why}" for name, why in found.unused.items()]
        lines += [_NAMES] if _NO_ROLE in found.unused.values() else []
        lines += [f"NOT USED: {found.slices}, single DICOM slices. {_SLICES}"] if found.slices else []
        file = enumerate(self.path.read_text(encoding="utf-8").splitlines(), start=1)
        to_fill_in = [f"    line {number}: {line.removeprefix('# ')}" for number, line in file if _TO_FILL_IN in line]
        todo = " Fill in the following lines, and remove the # at their beginning:" if to_fill_in else ""
        lines += [f"Study file: {self.path}.{todo}", *to_fill_in]
        lines += [] if found.labels or self.makes_labels or not found.loads else self._without_labels()
        seen = (
            "Check the picture of the images found" if isinstance(self.picture, Path) else "Picture of the images found"
        )
        return [*lines, f"{seen}: {self.picture}", f"Next step: mrstrain check {as_typed(self.path.parent)}"]

    def _without_labels(self) -> list[str]:
        """How to go on where the study has neither a label map nor a mask of the bone."""
        place = self.path.parent
        names = self.inputs.load0 or "Load0.nii.gz", *self.inputs.loads.values()
        images = " ".join(as_typed(place / name) for name in names)
        measured = f"mrstrain register {images} --bone BONE.nii.gz --out {as_typed(place / 'results')}"
        return [
            'Without a label map, paint a mask of the bone: with bone_mask and labels = "auto", the study makes the '
            "label map from the image.",
            f"To measure strain without a label map, the mask of the bone alone is sufficient: {measured}",
        ]


Ask = Callable[[StudyInputs, Sequence[str], Path | str], Answers]
"""``ask(inputs, names of the labels, picture or why there is none)`` gives what the files do not tell."""


def init(folder: Path | str, *, name: str = "Subject 01", ask: Ask | None = None) -> NewStudy:
    """Write a commented study file from the files in a folder.

    Parameters
    ----------
    folder : path
        Folder with the images, the label map and its names, and optionally results of other codes in subfolders.
    name : str
        Name of the study in its report. It must not identify a patient, and must be unique in a cohort.
    ask : callable, optional
        ``ask(inputs, names of the labels, picture)`` returns `Answers`: the bone, forces and the directions of the
        plate.

    Raises
    ------
    InputError
        If the folder does not exist or holds slices itself, or two files seem to be the unloaded image.
    OutputError
        If the folder already has a study file.
    """
    place = Path(folder)
    if not place.is_dir():
        raise InputError(f"{place} is not a folder.")
    target = place / FILE
    if target.exists():
        raise OutputError(f"{target} already exists; remove it to write a new one.")
    found = _look(place)
    if found == StudyInputs() and _holds_dicom(place):
        raise InputError(
            f"{place} holds the slices of a DICOM series. Move each series to a folder of its own, such as "
            f"{place / 'Load0'} and {place / 'Load1'}."
        )
    found.slices = few(_slices(place), most=1)
    picture, names = _drawn(place, found, found.bone_mask)
    answers = Answers() if ask is None else ask(found, names, picture)
    if answers.bone_mask:
        picture, _ = _drawn(place, found, answers.bone_mask)
    found.unused.pop(answers.bone_mask or "", None)
    environment = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.policies["json.dumps_kwargs"] = {"ensure_ascii": False}  # TOML has no surrogate pairs
    source = files("mrstrain.studies") / "templates" / "study.toml.j2"
    template = environment.from_string(source.read_text(encoding="utf-8"))
    forces = {load.name: (load.normal_n, load.shear_n) for load in LOADS}
    sets = [name for name in published_names() if not name.endswith(_VARIANT) and name != _SOFTEST]
    bones = _bones(place, found, names, answers.bone or BONE)
    mask = answers.bone_mask or (None if answers.bone else found.bone_mask)
    auto = found.labels is None and mask is not None
    named = {load: force for load in found.loads if (force := force_named(load)) is not None}
    told = {"found": found, "name": name, "answers": answers, "forces": forces, "sets": sets, "bones": bones}
    told |= {"named": named, "edge_mm": _EDGE_OF_A_BODY_MM if auto else Meshing().edge_mm}
    write_whole(target, template.render(told | {"mask": mask, "auto": auto}))
    return NewStudy(target, found, picture, auto)


def _drawn(place: Path, found: StudyInputs, mask: str | None) -> tuple[Path | str, list[str]]:
    """The picture of the images with labels or mask, or why there is none, and the names of the labels."""
    from dvc.report.drawing import png_bytes
    from mrstrain.studies.picture import Labelled, overview

    try:
        if found.load0 is None:
            raise InputError("no unloaded image was found")
        unloaded = read_image(place / found.load0, allow_missing=True)
        labels = (
            None if found.labels is None else read_labels(place / found.labels, found.names and place / found.names)
        )
        others = {load: read_image(place / image, allow_missing=True) for load, image in found.loads.items()}
        names = [] if labels is None else [name for number, name in labels.names.items() if number != 0]
        shown = Labelled.of(unloaded, labels)
        if not shown.regions and mask is not None:
            with suppress(InputError):  # `check` tells what is wrong with it
                shown = Labelled(unloaded, {BONE: read_mask(place / mask, unloaded.grid).inside})
        with whole_file(place / PICTURE) as file:
            file.write_bytes(png_bytes(overview(shown, others)))
    except InputError as error:
        return f"none, {error}", []
    return place / PICTURE, names


def _bones(place: Path, found: StudyInputs, names: Sequence[str], bone: str) -> list[str]:
    """The bone, and the other labels of the map to be meshed that are named like one."""
    if found.mesh_labels is not None:
        try:
            meshed = read_labels(place / found.mesh_labels, found.mesh_names and place / found.mesh_names)
            names = [name for number, name in meshed.names.items() if number != 0]
        except InputError:
            names = []
    return [bone, *(name for name in names if is_bones_name(name) and name != bone)]


def _look(place: Path) -> StudyInputs:
    found = StudyInputs()
    images = sorted(p.name for p in place.iterdir() if p.name.lower().endswith(IMAGE_ENDINGS) and _is_volume(p))
    folders = sorted(p for p in place.iterdir() if p.is_dir())
    images += [p.name for p in folders if _holds_dicom(p)]
    for name in images:
        role = _role(image_stem(name))
        if role == "load":
            taken = found.loads.setdefault(image_stem(name), name)
        elif role is None:
            found.unused[name] = _NO_ROLE
            continue
        else:
            taken = getattr(found, role) or name
            setattr(found, role, taken)
        if taken != name and role == "load0":
            raise InputError(f"{place}: both {taken} and {name} seem to be the unloaded image; rename one.")
        if taken != name:
            found.unused[name] = f"because {taken} is used as {_ROLES[role]}"
    found.names = _table(place, found.labels)
    found.mesh_names = _table(place, found.mesh_labels)
    for inside in folders:
        if inside.name in images:
            continue
        if any((inside / (load + ending)).is_file() for load in found.loads for ending in ENDINGS):
            found.results.append(inside.name)
        elif _role(inside.name) is not None:
            found.unused[inside.name] = "because the folder contains no DICOM image"
    return found


def _is_volume(path: Path) -> bool:
    """Whether a file may be a whole image; a DICOM file may be a single slice."""
    try:
        return path.is_file() and (path.suffix.lower() != ".dcm" or is_multiframe(path))
    except OSError:  # unreadable
        return False


def _slices(folder: Path) -> list[str]:
    """Names of the single DICOM slices in a folder, by the end of their names or the content of the first files."""
    try:
        files = sorted(p for p in folder.iterdir() if p.is_file())
        bare = [p for p in files if not p.suffix][:_LOOKED_AT]  # IM0001
        single = [p for p in files if p.suffix.lower() == ".dcm" and not _is_volume(p)]
        single += [p for p in bare if is_dicom(p) and not is_multiframe(p)]
        return [p.name for p in sorted(single)]
    except OSError:  # unreadable, so of no use
        return []


def _holds_dicom(folder: Path) -> bool:
    """Whether a folder holds DICOM images, by a file name or the content of the first files."""
    try:
        files = sorted(p for p in folder.iterdir() if p.is_file())
        return any(p.suffix.lower() == ".dcm" for p in files) or any(is_dicom(p) for p in files[:_LOOKED_AT])
    except OSError:  # unreadable, so of no use
        return False


def _role(stem: str) -> str | None:
    """Role that the name of an image suggests: a field of `StudyInputs`, or "load"; None if it suggests none."""
    if stem.endswith("_probability"):  # of a label map that `label` made
        return None
    if _ONE_BONE.fullmatch(stem) and not _SEVERAL.search(stem):
        return "bone_mask"
    if _LABELS.search(stem):
        return "mesh_labels" if _TO_MESH.search(stem) else "labels"
    if _BONE.search(stem):
        return "bone_mask"
    again = _AGAIN.search(stem) is not None
    if named_unloaded(stem):
        return "repeat" if again else "load0"
    if _LOADED.search(stem) and not again:
        return "load"
    return "bone_mask" if is_bones_name(stem) else None


def _table(place: Path, image: str | None) -> str | None:
    """The table of label names that has the same file name as a label map."""
    names = [] if image is None else [image_stem(image) + ending for ending in TABLE_ENDINGS]
    return next((name for name in names if (place / name).is_file()), None)
