"""The study file: one TOML file with the images, loads, tissues and models of a subject. Nothing in it is guessed."""

import difflib
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, model_validator
from pydantic.fields import FieldInfo

from dvc.errors import InputError
from dvc.file_names import as_file_name, clash, one_spelling, refuse_path
from dvc.images.bone_names import BONE
from dvc.io.result_folder import REPEAT
from dvc.own_files import parse_toml
from dvc.tables import refuse_damaged_toml
from mrstrain.options import modelling
from mrstrain.options.acquisition import AcquisitionOptions
from mrstrain.options.credibility import CredibilityOptions
from mrstrain.options.measurement import (
    AUTO,
    Frame,
    RegistrationOptions,
    SubjectFiles,
    Unit,
    command_parts,
    is_like_auto,
)
from mrstrain.options.model import Count, Flag, Names, Positive, Real, Vector, reason
from mrstrain.options.uncertainty import Uncertainty
from mrstrain.records.inputs import made_labels

FILE = "study.toml"
_MOST_FAULTS = 20
_UNQUOTED = str.maketrans("", "", " \"'")


def _seconds(minutes: float | None) -> float | None:
    return None if minutes is None else modelling.MINUTE_S * minutes


Name = Annotated[str, AfterValidator(as_file_name)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class About(_Part):
    """Name of the subject in the report, folder of the results (below that of the study file), and random seed."""

    name: Annotated[str, Field(min_length=1)]
    out: str = "results"
    seed: Count = 1


class Images(SubjectFiles):
    """The unloaded image and its masks and labels; paths are relative to the folder of the study file."""

    load0: Path
    """Unloaded image."""
    labels: Path
    """Label map of its tissues; "auto" makes it from the image, with the mask of the bone or marks."""
    marks: Path | None = None
    """With labels = "auto": label map of a few strokes in each tissue."""
    mark_names: Path | None = None
    """Table of the names of the marks."""
    correct_labels: Flag = False
    """Whether the boundaries of bones and skin in the label map move to where the image shows them."""
    labels_command: str | None = None
    """With labels = "auto": the command of a segmenter, which takes {image} and writes {labels}."""
    bone_label: str | None = Field(default=None, validation_alias="bone")
    """Name of the bone's label, for the rigid alignment; by default "bone"."""
    bone: Path | None = Field(default=None, validation_alias="bone_mask")
    """Mask of the bone, instead of the label."""
    repeat: Path | None = None
    """Second unloaded image, which measures the noise floor."""
    allow_missing: Flag = False
    """Whether NaN and infinite voxels are treated as missing, instead of rejecting the image."""

    @model_validator(mode="after")
    def _of_auto(self) -> Self:
        if self.allow_missing and self.correct_labels:
            raise ValueError("'correct_labels' needs an image without missing voxels; leave out allow_missing = true")
        if self.labels != AUTO:
            if self.marks or self.mark_names or self.labels_command:
                hint = f" (did you mean that by '{self.labels}'?)" if is_like_auto(self.labels) else ""
                raise ValueError(f"'marks', 'mark_names' and 'labels_command' are only for labels = \"auto\"{hint}")
        elif self.correct_labels:
            raise ValueError("'correct_labels' is for a label map that was drawn, not for labels = \"auto\"")
        elif self.labels_command is not None:
            if self.marks or self.mark_names:
                raise ValueError("'labels_command' makes the label map, so give it without 'marks' and 'mark_names'")
            command_parts(self.labels_command)
        elif self.bone is None and self.marks is None:
            raise ValueError("labels = \"auto\" needs 'bone_mask', the mask of the bone, or 'marks' with that bone")
        elif self.names is not None:
            raise ValueError("'names' is not for labels = \"auto\", which has names of its own")
        elif self.allow_missing:
            raise ValueError('labels = "auto" needs an image without missing voxels; leave out allow_missing = true')
        return self


class Load(_Part):
    """A loaded image, and the plate's forces, N, or instead its displacements, mm; as in `fe.LoadStep`.

    Without a normal force or displacement, the load is measured but not simulated. Directions, LPS, are by default
    those of the plate.
    """

    image: str
    normal_n: Positive | None = None
    shear_n: Real | None = None
    normal_mm: Positive | None = None
    shear_mm: Real | None = None
    plate_normal: Vector | None = None
    shear_direction: Vector | None = None

    @property
    def in_words(self) -> str:
        """Forces of the plate, or its displacements; empty without any."""
        amounts = ((self.normal_n, "N"), (self.normal_mm, "mm normal"), (self.shear_n, "N shear"),
                   (self.shear_mm, "mm shear"))  # fmt: skip
        return ", ".join(f"{amount:g} {unit}" for amount, unit in amounts if amount)


class Plate(modelling.PlateOptions):
    """The plate."""

    plate_normal: Vector = Field(default=modelling.INFERIOR, validation_alias="normal")
    """Direction from the body to the plate, LPS (x left, y posterior, z superior)."""

    @property
    def is_placed(self) -> bool:
        """Whether the plate lies elsewhere than `init` writes for everyone."""
        return self.plate_normal != modelling.INFERIOR


class Registering(RegistrationOptions):
    """Options of the registration, as those of `register`."""

    align: Literal["bone", "image"] = "bone"
    """What the rigid alignment before the registration uses: the bone or the whole image."""


class Mesh(modelling.Meshing, modelling.Labelling, modelling.MeshCoordinates):
    """The mesh: made from the label map or from another one, or read from a file."""

    labels: Path | None = None
    """Label map to be meshed if it is not that of the images, such as one without toes; with ``names``."""
    limit_s: Annotated[Positive, AfterValidator(_seconds)] = Field(
        default=60.0, validation_alias="limit_minutes", validate_default=True
    )
    """Stop meshing after this time, s; in the file in minutes."""
    file: Path | None = None
    """Mesh made elsewhere, instead; its coordinates are in ``unit`` and ``frame``."""
    mesh_unit: Unit = Field(default="mm", validation_alias="unit")
    """Unit of the coordinates of that mesh."""
    mesh_frame: Frame = Field(default="LPS", validation_alias="frame")
    """Frame of the coordinates of that mesh."""

    @model_validator(mode="after")
    def _of_a_file(self) -> Self:
        if self.file is None and (self.mesh_unit, self.mesh_frame) != ("mm", "LPS"):
            raise ValueError("'unit' and 'frame' are only for a mesh made elsewhere, which 'file' must name")
        return self


class Models(modelling.SimulationOptions):
    """The models that are compared with the measurement."""

    sets: Names = ()
    """Material sets to simulate: published names, or your own files (.toml)."""
    results: Names = ()
    """Folders with results of other codes, with a file for each load, as in `compare`."""
    unfinished: Flag = False
    """Also compare results of FEBio and CalculiX whose run ended early."""
    drive: Flag = False
    """Also simulate the material sets with measured boundary conditions (`drive`)."""
    level: Flag = False
    """Also make the forward-model comparison of every simulated set (`level`)."""
    limit_s: Annotated[Positive | None, AfterValidator(_seconds)] = Field(
        default=None, validation_alias="limit_minutes"
    )
    """End a load path after this time, s, at its last converged increment; in the file in minutes."""


class Study(_Part):
    """A study: the tables of its file, and the folder of that file, to which all paths are relative."""

    place: Path
    study: About
    images: Images
    loads: Annotated[dict[Name, Load], Field(min_length=1)]
    plate: Plate = Plate()
    registration: Registering = Registering()
    mesh: Mesh = Mesh()
    models: Models = Models()
    compare: modelling.ComparisonOptions = modelling.ComparisonOptions()
    acquisition: AcquisitionOptions = AcquisitionOptions()
    credibility: CredibilityOptions = CredibilityOptions()
    uncertainty: Uncertainty = Uncertainty()
    _lines: dict[tuple[str, str], int] = PrivateAttr(default_factory=dict)

    def at(self, table: str, key: str) -> str:
        """A key of a table with its line in the file, for messages."""
        return _named(self._lines, table, key)[1]

    def without_variants(self) -> Self:
        """The same study without the variants for the input uncertainty of the models."""
        return self.model_copy(update={"uncertainty": self.uncertainty.model_copy(update={"quick": True})})

    @property
    def out(self) -> Path:
        """Folder of the results."""
        return self.place / self.study.out

    @property
    def bone(self) -> str | None:
        """Name of the bone's label; None if the whole image is aligned and no bone is named."""
        return self.images.bone_label or ("bone" if self.registration.align == "bone" else None)

    @property
    def directions(self) -> dict[str, tuple[Vector, Vector]]:
        """Direction from the body to the plate, and of shear, for each load, LPS: its own, or those of [plate]."""
        return {
            name: (load.plate_normal or self.plate.plate_normal, load.shear_direction or self.plate.shear_direction)
            for name, load in self.loads.items()
        }

    @property
    def forces(self) -> dict[str, str]:
        """Forces of the plate, or its displacements, of each load that has any, in words."""
        return {name: words for name, load in self.loads.items() if (words := load.in_words)}

    @property
    def makes_labels(self) -> bool:
        """Whether the label map is made or corrected by the image, in the stage "label"."""
        return self.drawn_labels is None or self.images.correct_labels

    @property
    def drawn_labels(self) -> tuple[Path, Path | None] | None:
        """The label map of the unloaded image as it is given, and the table of its names; None if it is to be made."""
        if self.images.labels == AUTO:
            return None
        return self.path(self.images.labels), self.optional_path(self.images.names)

    @property
    def labels(self) -> tuple[Path, Path | None]:
        """The label map of the unloaded image that all stages use, and the table of its names."""
        drawn = self.drawn_labels
        return made_labels(self.out) if drawn is None or self.images.correct_labels else drawn

    @property
    def subject_files(self) -> SubjectFiles:
        """Masks and labels of the unloaded image; the bone by its mask, or else by its label.

        In a label map that is made from the mask of the bone, the surface of the bone is at its dark rim.
        """
        labels, names = self.labels
        files = self.images.narrowed(SubjectFiles).located(self.place)
        update: dict[str, object] = {"labels": labels, "names": names}
        if files.bone is None:
            update["bone_label"] = self.bone
        elif self.drawn_labels is None and self.images.labels_command is None:
            update |= {"bone": None, "bone_label": BONE}
        else:
            update["bone_label"] = None
        return files.model_copy(update=update)

    def given(self, paths: Sequence[Path | None]) -> tuple[Path, ...]:
        """Those of these files that are not made by the stage "label"."""
        made = self.labels if self.makes_labels else ()
        return tuple(path for path in paths if path is not None and path not in made)

    def path(self, given: str | Path) -> Path:
        """A path of the study file, relative to its folder."""
        return self.place / given

    def optional_path(self, given: str | Path | None) -> Path | None:
        """An optional path of the study file, relative to its folder."""
        return None if given is None else self.path(given)

    def set_given(self, name: str) -> str:
        """A material set for `simulate`: the path of a file, or a published name."""
        return str(self.path(name)) if name.endswith(".toml") else name


def read_study(path: Path | str | Study) -> Study:
    """Read a study file (or ``study.toml`` in a folder); a `Study` is returned unchanged.

    InputError lists all errors of the file by line: invalid TOML; missing values, unknown keys (with the closest known
    key) and values of the wrong type; or a results folder outside the folder of the study.
    """
    if isinstance(path, Study):
        return path
    refuse_path(path)
    place = Path(path)
    place = place / FILE if place.is_dir() else place
    try:
        text = place.read_text(encoding="utf-8-sig")
        told = parse_toml(text)
    except FileNotFoundError as missing:
        raise InputError(f"{place}: there is no such study file; `mrstrain init FOLDER` writes one.") from missing
    except tomllib.TOMLDecodeError as error:
        raise InputError("\n  ".join([f"{place} is not valid TOML:", *_faults(text.splitlines())])) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{place} cannot be read as a TOML file ({error}).") from error
    refuse_damaged_toml(place, text, told)
    if "place" in told:
        raise InputError(f"{place}: unknown key 'place'; paths are always relative to the folder of the study file.")
    lines = _lines_of(text)
    try:
        study = Study(place=place.resolve().parent, **told)
    except ValidationError as wrong:
        sentences = sorted(_sentence(one, lines) for one in wrong.errors(include_url=False))
        raise InputError("\n  ".join([f"{place}:", *(sentence for _, sentence in sentences)])) from wrong
    study._lines = lines
    if study.place not in study.out.resolve().parents:
        raise InputError(
            f"{place}: [study] out = '{study.study.out}' is not below the folder of the study ({study.place}). Choose "
            "a folder below it."
        )
    if REPEAT in map(one_spelling, study.loads):
        raise InputError(f"{place}: the name '{REPEAT}' is reserved for the repeat scan; rename this load.")
    if twice := clash(study.loads):
        raise InputError(f"{place}: two loads are named {twice}; rename one of them.")
    return study


def _faults(lines: list[str]) -> list[str]:
    """Errors in the lines that are not valid TOML; each is found with the earlier ones left out."""
    faults = list[str]()
    while len(faults) < _MOST_FAULTS:
        try:
            tomllib.loads("\n".join(lines))
            break
        except tomllib.TOMLDecodeError as error:
            why, _, where = str(error).partition(" (at line ")
            number = int(where.partition(",")[0] or 0)
            if not number or not lines[number - 1]:
                return faults or [str(error)]
            faults.append(f"line {number}: {why}: {lines[number - 1].strip()}")
            lines[number - 1] = ""
    return faults


def _lines_of(text: str) -> dict[tuple[str, str], int]:
    """Line of each table (its key is "") and key of a study file; in a comment only if it occurs nowhere else."""
    lines: dict[tuple[str, str], int] = {}
    table = ""
    for number, line in enumerate(text.splitlines(), start=1):
        if head := re.match(r"[\s#]*\[([^\[\]=]+)\]", line):
            table, key = head[1].translate(_UNQUOTED), ""
            lines.setdefault((table.partition(".")[0], ""), number)
        elif given := re.match(r"[\s#]*([\w-]+)\s*=", line):
            key = given[1]
        else:
            continue
        if not line.lstrip().startswith("#") or (table, key) not in lines:
            lines[table, key] = number
    return lines


def _named(lines: Mapping[tuple[str, str], int], table: str, key: str) -> tuple[int, str]:
    """Line of a key, or else of its table (0 if neither is in the file), and its name in messages."""
    at = table.translate(_UNQUOTED)
    number = lines.get((at, key)) or lines.get((at, "")) or lines.get((key, "")) or 0
    return number, (f"line {number}: " if number else "") + (
        f"[{table}] '{key}'" if table and key else f"[{table}]" if table else f"'{key}'"
    )


def _sentence(error: Mapping[str, Any], lines: Mapping[tuple[str, str], int]) -> tuple[int, str]:
    *tables, key = map(str, error["loc"])
    number, at = _named(lines, ".".join(tables), key)
    if error["type"] in ("extra_forbidden", "unexpected_keyword_argument"):
        known = _fields_at(tables)
        near = difflib.get_close_matches(key, known, 1, 0.5)
        advice = f"did you mean '{near[0]}'?" if near else f"known keys are {', '.join(known)}."
        return number, f"{at} is an unknown key; {advice}"
    missing = error["type"] in ("missing", "missing_argument")
    return number, f"{at} is missing." if missing else f"{at}: {reason(error)}."


def keys_of(table: type[BaseModel]) -> dict[str, FieldInfo]:
    """Keys of a table of the study file, with their fields."""
    fields = {str(info.validation_alias or name): info for name, info in table.model_fields.items()}
    return {key: info for key, info in fields.items() if key != "place"}


def _fields_at(names: Sequence[str]) -> list[str]:
    """Keys of the table at a path through the model of the study."""
    if names[:2] == ["mesh", "finer"]:
        return list(modelling.Finer._fields)
    model: Any = Study if not names else Load if names[0] == "loads" else Study.model_fields[names[0]].annotation
    return list(keys_of(model))
