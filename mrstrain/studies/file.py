"""The study file: one TOML file that names a subject's images, loads, tissues and models. Nothing in it is guessed."""

import difflib
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PrivateAttr, ValidationError, model_validator
from pydantic.fields import FieldInfo

from dvc.errors import InputError
from mrstrain.options import modelling
from mrstrain.options.measurement import Frame, RegistrationOptions, SubjectFiles, Unit
from mrstrain.options.model import Count, Flag, Names, Positive, Real, Vector, reason

FILE = "study.toml"
_MOST_FAULTS = 20
_UNQUOTED = str.maketrans("", "", " \"'")


def _seconds(minutes: float | None) -> float | None:
    return None if minutes is None else modelling.MINUTE_S * minutes


def as_folder(text: str) -> str:
    """A name that becomes a folder, as it is; ValueError where it cannot."""
    unfit = any(c in '/\\:*?"<>|' or not c.isprintable() for c in text)
    if unfit or not text or text != text.strip() or text[0] == ".":
        raise ValueError("a name that becomes a folder: no slash, colon or quotes, and not beginning with a dot")
    return text


Name = Annotated[str, AfterValidator(as_folder)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class About(_Part):
    """The subject's name, as in the report; the folder of the results, below the study file's own; and the seed."""

    name: Annotated[str, Field(min_length=1)]
    out: str = "results"
    seed: Count = 1


class Images(SubjectFiles):
    """The unloaded image and what is known of it; paths from the study file's folder."""

    load0: Path
    """Unloaded image."""
    labels: Path
    """Label map of the tissues on it."""
    bone_label: str | None = Field(default=None, validation_alias="bone")
    """Name of the label to align on, "bone" if it is not said."""
    bone: Path | None = Field(default=None, validation_alias="bone_mask")
    """Or: a mask of it."""
    repeat: Path | None = None
    """A second unloaded image: the noise floor."""
    allow_missing: Flag = False
    """Whether voxels that are NaN or infinite are left out, not refused."""


class Load(_Part):
    """One loaded image, and the plate's forces, N, or in their place its travels, mm; as in `fe.LoadStep`.

    Without either along the normal it is measured and not simulated. Directions, LPS, are those of the plate where none
    are given here.
    """

    image: str
    normal_n: Positive | None = None
    shear_n: Real | None = None
    normal_mm: Positive | None = None
    shear_mm: Real | None = None
    plate_normal: Vector | None = None
    shear_direction: Vector | None = None


class Plate(modelling.PlateOptions):
    """The plate."""

    plate_normal: Vector = Field(default=(0.0, 0.0, -1.0), validation_alias="normal")
    """Its outward normal, away from the foot, LPS."""


class Registering(RegistrationOptions):
    """How images are registered; as the options of `register`."""

    align: Literal["bone", "image"] = "bone"
    """What to align rigidly first."""


class Mesh(modelling.Meshing, modelling.Labelling, modelling.MeshCoordinates):
    """The mesh: made from the label map (or one of its own), or a file."""

    labels: Path | None = None
    """Another label map than that of the images, such as one without toes; with ``names``."""
    limit_s: Annotated[Positive, AfterValidator(_seconds)] = Field(
        default=60.0, validation_alias="limit_minutes", validate_default=True
    )
    """Time after which meshing is given up, minutes in the file."""
    file: Path | None = None
    """A mesh made elsewhere, instead; its lengths in ``unit``, its axes those of ``frame``."""
    mesh_unit: Unit = Field(default="mm", validation_alias="unit")
    """Unit of that mesh's coordinates."""
    mesh_frame: Frame = Field(default="LPS", validation_alias="frame")
    """Frame of that mesh's coordinates."""

    @model_validator(mode="after")
    def _of_a_file(self) -> Self:
        if self.file is None and (self.mesh_unit, self.mesh_frame) != ("mm", "LPS"):
            raise ValueError("unit and frame are those of a mesh made elsewhere, and no 'file' names one")
        return self


class Models(modelling.SimulationOptions):
    """The models that are judged."""

    sets: Names = ()
    """Published material sets to simulate, or files of your own (.toml)."""
    results: Names = ()
    """Folders with results of other codes, a file for each load, as `compare` takes them."""
    drive: Flag = False
    """Also the sets driven by the measured displacement of the outside."""
    level: Flag = False
    """Also every simulated set sent through the measurement."""
    limit_s: Annotated[Positive | None, AfterValidator(_seconds)] = Field(
        default=None, validation_alias="limit_minutes"
    )
    """Time after which a set's path of loads ends at its last equilibrium, minutes in the file."""


class Study(_Part):
    """A whole study: the tables of its file, and the folder of that file, which all paths start from."""

    place: Path
    study: About
    images: Images
    loads: Annotated[dict[Name, Load], Field(min_length=1)]
    plate: Plate = Plate()
    registration: Registering = Registering()
    mesh: Mesh = Mesh()
    models: Models = Models()
    compare: modelling.ComparisonOptions = modelling.ComparisonOptions()
    _lines: dict[tuple[str, str], int] = PrivateAttr(default_factory=dict)

    def at(self, table: str, key: str) -> str:
        """A key of a table, as messages name it: with its line in the file."""
        return _named(self._lines, table, key)[1]

    @property
    def out(self) -> Path:
        """Folder of the results."""
        return self.place / self.study.out

    @property
    def bone(self) -> str | None:
        """Name of the bone's label; None where the whole image is aligned on and none is named."""
        return self.images.bone_label or ("bone" if self.registration.align == "bone" else None)

    @property
    def directions(self) -> dict[str, tuple[Vector, Vector]]:
        """Plate's outward normal and direction of shear under each load, LPS: its own, or those of the plate."""
        return {
            name: (load.plate_normal or self.plate.plate_normal, load.shear_direction or self.plate.shear_direction)
            for name, load in self.loads.items()
        }

    @property
    def subject_files(self) -> SubjectFiles:
        """What is known of the unloaded image; the bone by its mask, or else by its label."""
        files = self.images.narrowed(SubjectFiles).located(self.place)
        return files if files.bone else files.model_copy(update={"bone_label": self.bone})

    def path(self, given: str | Path) -> Path:
        """A path of the file, from the study's folder."""
        return self.place / given

    def optional_path(self, given: str | Path | None) -> Path | None:
        """A path of the file that may be left out, from the study's folder."""
        return None if given is None else self.path(given)

    def set_given(self, name: str) -> str:
        """A material set as `simulate` takes it: a file's path, or a published name."""
        return str(self.path(name)) if name.endswith(".toml") else name


def read_study(path: Path | str | Study) -> Study:
    """Read a study file (or a folder's ``study.toml``); a study that is read already is returned as it is.

    InputError lists everything that is wrong in the file, by line: what is no TOML; or missing values, unknown keys
    with the nearest known one, and values of the wrong kind; or results outside the study's folder.
    """
    if isinstance(path, Study):
        return path
    place = Path(path)
    place = place / FILE if place.is_dir() else place
    try:
        text = place.read_text(encoding="utf-8")
        told = tomllib.loads(text)
    except FileNotFoundError as missing:
        raise InputError(f"{place}: there is no study file; `mrstrain init FOLDER` writes one.") from missing
    except tomllib.TOMLDecodeError as error:
        raise InputError("\n  ".join([f"{place} is no TOML file:", *_faults(text.splitlines())])) from error
    except (OSError, ValueError) as error:
        raise InputError(f"{place} is no TOML file ({error}).") from error
    if "place" in told:
        raise InputError(f"{place}: 'place' is no key of a study file; paths start from the file's own folder.")
    lines = _lines_of(text)
    try:
        study = Study(place=place.resolve().parent, **told)
    except ValidationError as wrong:
        sentences = sorted(_sentence(one, lines) for one in wrong.errors(include_url=False))
        raise InputError("\n  ".join([f"{place}:", *(sentence for _, sentence in sentences)])) from wrong
    study._lines = lines
    if study.place not in study.out.resolve().parents:
        raise InputError(
            f"{place}: [study] out = '{study.study.out}' does not lie below the study's own folder {study.place}; "
            "results stay with their study."
        )
    if "repeat" in study.loads:
        raise InputError(f"{place}: 'repeat' is kept for the repeat scan and cannot name a load.")
    return study


def _faults(lines: list[str]) -> list[str]:
    """The lines that are no TOML, each found with those before left out."""
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
    """Line of each table (its key is "") and key of a study file; behind a # only where it stands nowhere else."""
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
    """Line of a key, or else of its table (0 where neither is in the file), and how messages name it."""
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
        advice = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}."
        return number, f"{at} is no key here; {advice}"
    missing = error["type"] in ("missing", "missing_argument")
    return number, f"{at} is missing." if missing else f"{at}: {reason(error)}."


def keys_of(table: type[BaseModel]) -> dict[str, FieldInfo]:
    """Keys that a table of the study file has, with their fields."""
    fields = {str(info.validation_alias or name): info for name, info in table.model_fields.items()}
    return {key: info for key, info in fields.items() if key != "place"}


def _fields_at(names: Sequence[str]) -> list[str]:
    """Keys of the table at a path through the study's model."""
    if names[:2] == ["mesh", "finer"]:
        return list(modelling.Finer._fields)
    model: Any = Study if not names else Load if names[0] == "loads" else Study.model_fields[names[0]].annotation
    return list(keys_of(model))
