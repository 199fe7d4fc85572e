"""The study file: one TOML file that names a subject's images, loads, tissues and models. Nothing in it is guessed."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError, model_validator
from pydantic.fields import FieldInfo

from dvc.errors import InputError
from validate import RANGE, check_range

FILE = "study.toml"

Real = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Whole = Annotated[int, Strict()]
Flag = Annotated[bool, Strict()]
Vector = tuple[Real, Real, Real]


def as_folder(text: str) -> str:
    """A name that becomes a folder, as it is; ValueError where it cannot."""
    if (
        not text
        or text != text.strip()
        or any(c in '/\\:*?"<>|' or not c.isprintable() for c in text)
        or text[0] == "."
    ):
        raise ValueError("a name that becomes a folder: no slash, colon or quotes, and not beginning with a dot")
    return text


def _new(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(set(names)) < len(names):
        raise ValueError("each only once")
    return names


def _rising(strains: tuple[float, float]) -> tuple[float, float]:
    try:
        check_range(strains)
    except InputError as wrong:
        raise ValueError(str(wrong)) from wrong
    return strains


Name = Annotated[str, AfterValidator(as_folder)]
Names = Annotated[tuple[str, ...], AfterValidator(_new)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class About(_Part):
    """What the study is called, and where its results go.

    Attributes
    ----------
    name : str
        Of the subject; in the report.
    out : str
        Folder of the results, below the study file's own.
    seed : int
        Of every random number.
    """

    name: Annotated[str, Field(min_length=1)]
    out: str = "results"
    seed: Annotated[Whole, Field(ge=1)] = 1


class Images(_Part):
    """The unloaded image and what is known of it; paths from the study file's folder.

    Attributes
    ----------
    load0 : str
        Unloaded image.
    labels, names : str
        Label map of the tissues on it, and the table of its names.
    bone : str, optional
        Name of the label to align on, "bone" if it is not said; or ``bone_mask``, a mask of it.
    repeat : str, optional
        A second unloaded image: the noise floor.
    tissue : str, optional
        Mask of the body, bone included.
    allow_missing : bool
        Whether voxels that are NaN or infinite are left out, not refused.
    """

    load0: str
    labels: str
    names: str | None = None
    bone: str | None = None
    bone_mask: str | None = None
    repeat: str | None = None
    tissue: str | None = None
    allow_missing: Flag = False


class Load(_Part):
    """One loaded image, and the plate's forces, N, or in their place its travels, mm; as in `fe.LoadStep`.

    Without either along the normal it is measured and not simulated. Directions, LPS, are those of the plate where none
    are given here.
    """

    image: str
    normal_n: Annotated[Real, Field(gt=0.0)] | None = None
    shear_n: Real | None = None
    normal_mm: Annotated[Real, Field(gt=0.0)] | None = None
    shear_mm: Real | None = None
    plate_normal: Vector | None = None
    shear_direction: Vector | None = None


class PlateOf(_Part):
    """The plate: outward normal (away from the foot) and direction of the shear force on the tissue, LPS."""

    normal: Vector = (0.0, 0.0, -1.0)
    shear_direction: Vector = (0.0, -1.0, 0.0)
    taped: Flag = True
    turns: Flag = False
    pivot_mm: Vector | None = None
    gap_mm: Annotated[Real, Field(ge=0.0)] = 0.0


class Registering(_Part):
    """How images are registered; as the options of `register`."""

    engine: Literal["gauss-newton", "elastix"] | None = None
    borders: Flag | None = None
    bending: Annotated[Real, Field(gt=0.0)] | None = None
    volume: Annotated[Real, Field(ge=0.0)] | None = None
    preset: str | None = None
    parameters: tuple[str, ...] = ()
    chain: Flag = False
    align: Literal["bone", "image"] = "bone"
    error_model: str | None = None
    twin: Flag = False


class Finer(_Part):
    """Another length of edges in one tissue."""

    region: str
    edge_mm: Annotated[Real, Field(gt=0.0)]


class Meshing(_Part):
    """The mesh: made from the label map (or one of its own), or a file.

    Attributes
    ----------
    edge_mm : float
    labels, names : str, optional
        Another label map than that of the images, such as one without toes.
    bones : tuple of str
        Labels that are cut out, and whose surface is fixed; slices go through the lowest point of the first.
    finer : Finer, optional
    limit_minutes : float
        Time after which meshing is given up.
    file : str, optional
        A mesh made elsewhere, instead; its lengths in ``unit``, its axes those of ``frame``.
    """

    edge_mm: Annotated[Real, Field(gt=0.0)] = 2.0
    labels: str | None = None
    names: str | None = None
    bones: Annotated[Names, Field(min_length=1)] = ("bone",)
    finer: Finer | None = None
    limit_minutes: Annotated[Real, Field(gt=0.0)] = 60.0
    file: str | None = None
    unit: Literal["mm", "m"] = "mm"
    frame: Literal["LPS", "RAS"] = "LPS"

    @model_validator(mode="after")
    def _of_a_file(self) -> Meshing:
        if self.file is None and (self.unit, self.frame) != ("mm", "LPS"):
            raise ValueError("unit and frame are those of a mesh made elsewhere, and no 'file' names one")
        return self


class Models(_Part):
    """The models that are judged.

    Attributes
    ----------
    sets : tuple of str
        Published material sets to simulate, or files of your own (.toml).
    results : tuple of str
        Folders with results of other codes, a file for each load, as `compare` takes them.
    element : {"P1", "MINI", "P2"}
    fixed : tuple of str
        Surfaces that do not move, beside the bone's.
    drive : bool
        Also the sets driven by the measured displacement of the outside.
    level : bool
        Also every simulated set sent through the measurement.
    decks : bool
        Also write each load as decks for CalculiX and FEBio.
    limit_minutes : float, optional
        Time after which a set's path of loads ends at its last equilibrium.
    """

    sets: Names = ()
    results: Names = ()
    element: Literal["P1", "MINI", "P2"] = "P1"
    fixed: Names = ()
    drive: Flag = False
    level: Flag = False
    decks: Flag = False
    limit_minutes: Annotated[Real, Field(gt=0.0)] | None = None


class Comparing(_Part):
    """How models are compared with the measurement; as the options of `compare`."""

    strains: Annotated[tuple[Real, Real], AfterValidator(_rising)] = RANGE
    thresholds: str | None = None
    least_ml: Annotated[Real, Field(ge=0.0)] = 0.1


class Study(_Part):
    """A whole study, as its file tells it.

    Attributes
    ----------
    place : Path
        Folder of the study file, which all paths start from.
    study, images, loads, plate, registration, mesh, models, compare
        The file's tables.
    """

    place: Path
    study: About
    images: Images
    loads: Annotated[dict[Name, Load], Field(min_length=1)]
    plate: PlateOf = PlateOf()
    registration: Registering = Registering()
    mesh: Meshing = Meshing()
    models: Models = Models()
    compare: Comparing = Comparing()

    @property
    def out(self) -> Path:
        """Folder of the results."""
        return self.place / self.study.out

    @property
    def bone(self) -> str | None:
        """Name of the bone's label; None where the whole image is aligned on and none is named."""
        return self.images.bone or ("bone" if self.registration.align == "bone" else None)

    def path(self, given: str) -> Path:
        """A path of the file, from the study's folder."""
        return self.place / given

    def set_given(self, name: str) -> str:
        """A material set as `simulate` takes it: a file's path, or a published name."""
        return str(self.path(name)) if name.endswith(".toml") else name


def read_study(path: Path | str) -> Study:
    """Read a study file (or a folder's ``study.toml``).

    Raises
    ------
    InputError
        If there is none, or with everything that is wrong in it: unknown keys with the nearest known one, values of
        the wrong kind, results outside the study's folder.
    """
    place = Path(path)
    place = place / FILE if place.is_dir() else place
    try:
        told = tomllib.loads(place.read_text(encoding="utf-8"))
    except FileNotFoundError as missing:
        raise InputError(f"{place}: there is no study file; `mrstrain init FOLDER` writes one.") from missing
    except (OSError, ValueError) as error:
        raise InputError(f"{place} is no TOML file ({error}).") from error
    if "place" in told:
        raise InputError(f"{place}: 'place' is no key of a study file; paths start from the file's own folder.")
    try:
        study = Study(place=place.resolve().parent, **told)
    except ValidationError as wrong:
        sentences = "\n".join(f"  {_sentence(one, told)}" for one in wrong.errors(include_url=False))
        raise InputError(f"{place}:\n{sentences}") from wrong
    home = study.place
    if home not in study.out.resolve().parents:
        raise InputError(
            f"{place}: [study] out = '{study.study.out}' does not lie below the study's own folder {home}; results "
            "stay with their study."
        )
    reserved = {"repeat"} & set(study.loads)
    if reserved:
        raise InputError(f"{place}: 'repeat' is kept for the repeat scan and cannot name a load.")
    return study


def _sentence(error: Any, told: Mapping[str, Any]) -> str:
    at: Sequence[str | int] = error["loc"]
    names = [str(part) for part in at]
    table = f"[{'.'.join(names[:-1])}] " if len(names) > 1 else ""
    if error["type"] == "extra_forbidden":
        known = list(_fields_at(names[:-1]))
        near = difflib.get_close_matches(names[-1], known, 1, 0.5)
        advice = f"did you mean '{near[0]}'?" if near else f"known are {', '.join(known)}."
        return f"{table}'{names[-1]}' is no key here; {advice}"
    if error["type"] == "missing":
        return f"{table}'{names[-1]}' is missing."
    got = error["input"]
    return f"{table}'{names[-1]}': {error['msg'].removeprefix('Value error, ')}; got {got!r}."


def _fields_at(names: Sequence[str]) -> list[str]:
    """Keys of the table at a path through the study's model."""
    model: Any = Study
    for name in names:
        fields: dict[str, FieldInfo] = getattr(model, "model_fields", {})
        model = Load if model is None or name not in fields else _model_of(fields[name].annotation)
    return [key for key in model.model_fields if key != "place"]


def _model_of(annotation: Any) -> Any:
    """The model that a field holds; None for a table of models by name (the loads)."""
    for kind in (annotation, *getattr(annotation, "__args__", ())):
        if isinstance(kind, type) and issubclass(kind, _Part) and kind is not Load:
            return kind
    return None
