"""Files of the models by load, and the settings with which they are read: mesh, unit, frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from dvc import Grid
from dvc.arrays import FloatArray
from dvc.deformation.nodal import OnMesh
from dvc.errors import ExtentError, InputError, few
from dvc.file_names import clash, missing
from dvc.mesh import box_told
from dvc.own_files import parse_toml, read_json
from dvc.tables import refuse_damaged_toml
from mrstrain.models.variant_files import VARIANT, VariantFolder
from mrstrain.options.modelling import ModelReading
from mrstrain.records.inputs import matrix_of, read_matrix
from mrstrain.records.outcome import with_reasons
from validate import FeResult, Variant, check_overlap, read_result
from validate.run_end import early_end
from validate.sensitivity import TAPE

ENDINGS = (".vtu", ".vtk", ".msh", ".frd", ".xplt", ".csv")
SETTINGS = "model.toml"
"""File in the folder of a model with the mesh, unit, frame, to_image and leave_out of this model only."""
_KEYS = ("mesh", "unit", "frame", "to_image", "leave_out")

IN_IMAGE = 'unit = "mm"\nframe = "LPS"\nto_image = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n'
"""Settings of results that are already in the coordinates of the image."""


@dataclass(frozen=True, slots=True, eq=False)
class ModelFile:
    """The result of a model for one load, and the settings with which it is read."""

    name: str
    path: Path
    reading: ModelReading
    to_image: FloatArray | None = None  # as in `validate.read_result`
    variants: tuple["VariantFile", ...] = ()

    @property
    def variant_paths(self) -> tuple[Path, ...]:
        """Files of its variants, and of the solutions with which these are compared."""
        pairs = ((one.varied.path, *(() if one.base is None else (one.base.path,))) for one in self.variants)
        return tuple(dict.fromkeys(path for pair in pairs for path in pair))

    def read(self, grid: Grid) -> FeResult:
        """Read the result, which must lie in the image on this grid; errors as `read_result` and `check_overlap`.

        Its variants are read when they are needed.
        """
        try:
            result = self._read()
        except ExtentError as failure:
            raise ExtentError(f"{failure} The image: {box_told(*grid.bounds_mm())} (LPS mm).") from failure
        check_overlap(self.path, result.mesh, grid)
        reads = {of: of.deformation for one in self.variants if (of := one.base) is not None}  # each base once
        variants = tuple(
            Variant(one.input, one.steps, one.varied.deformation, None if one.base is None else reads[one.base])
            for one in self.variants
        )
        return replace(result, variants=variants) if variants else result

    def deformation(self) -> OnMesh:
        """The deformation alone; errors as `read_result`."""
        return self._read().deformation

    def _read(self) -> FeResult:
        how = self.reading
        return read_result(
            self.name, self.path, mesh=how.model_mesh, unit=how.model_unit, frame=how.model_frame,
            to_image=self.to_image, leave_out=how.leave_out,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class VariantFile:
    """A result with one input changed for one load, and the result with which it is compared; None: the model."""

    input: str
    steps: float
    varied: ModelFile
    base: ModelFile | None


def with_variants(
    files: Mapping[str, Sequence[ModelFile]], folders: Sequence[VariantFolder], usual: ModelReading,
    to_image: FloatArray | None = None,
) -> tuple[dict[str, list[ModelFile]], list[str]]:  # fmt: skip
    """The files of the models by load with those of their variants; and a sentence for each variant that is left out.

    That is a variant that has no file, or whose model is not compared.
    """
    bases: dict[tuple[Path, str], ModelFile] = {}
    known = list(dict.fromkeys(model.name for of in files.values() for model in of))
    notes = [
        f"{one.place}: its {VARIANT} is of the model '{one.record.model}', which is not compared. The "
        f"variant is left out. Compared: {', '.join(known)}."
        for one in folders
        if one.record.model not in known
    ]

    def lacking(place: Path, load: str) -> str:
        """Why a folder has no result of a load that can be used; empty if it has one."""
        chosen, reached = _chosen(place, [load])[1] if place.is_dir() else {}, _outcome(place, "reached")
        if load not in chosen or (reached is not None and reached.get(load, 0.0) < 1.0):
            return f"has no result for {load}"
        end = early_end(chosen[load])
        if end is not None and end.certain and not usual.unfinished:
            return f"is left out for {load}, because the run of {chosen[load]} {end.reason}"
        return ""

    def file(place: Path, model: str, load: str) -> ModelFile:
        return ModelFile(model, _chosen(place, [load])[1][load], *_reading(place, usual, to_image))

    def with_own(model: ModelFile, load: str) -> ModelFile:
        found = []
        for one in (folder for folder in folders if folder.record.model == model.name):
            places = [one.place, *([] if one.base is None else [one.base])]
            if why := next(filter(None, (lacking(place, load) for place in places)), ""):
                if one.record.input != TAPE:  # a load with shear cannot be without tape
                    notes.append(f"{model.name}: the variant of '{one.record.input}' {why}.")
                continue
            base = None
            if one.base is not None:
                base = bases.setdefault((one.base.resolve(), load), file(one.base, model.name, load))
            found.append(VariantFile(one.record.input, one.record.steps, file(one.place, model.name, load), base))
        return replace(model, variants=tuple(found))

    return {load: [with_own(model, load) for model in of] for load, of in files.items()}, notes


def model_files(
    loads: Sequence[str], models: Sequence[Path], usual: ModelReading, to_image: FloatArray | None = None
) -> tuple[dict[str, list[ModelFile]], list[str]]:
    """Files of the models by load, in the order of the models; and a sentence for each missing result."""
    if not models:
        raise InputError("No model is given. A model is a folder with a file for each load, or a single file.")
    files: dict[str, list[ModelFile]] = {load: [] for load in loads}
    notes, taken = list[str](), list[str]()
    for place in models:
        name, chosen = _chosen(place, loads)
        if twice := clash([*taken, name]):
            raise InputError(f"Two models are named {twice}; rename the folder of one of them.")
        reached, stable = _outcome(place, "reached"), _outcome(place, "stable_share")
        if reached == {}:
            notes.append(f"{name}: its simulation has not ended, or reached no load. Run it again.")
            continue
        if not chosen:
            lacking = f"no file of a measured load ({', '.join(loads)}), ending in {', '.join(ENDINGS)}"
            if len(models) == 1:
                raise InputError(f"{place} has {lacking}. Name each file after its load.")
            notes.append(f"{name} has {lacking}; it is left out.")
            continue
        taken.append(name)
        notes += _passed_over(name, chosen)
        reading = _reading(place, usual, to_image)
        notes += [
            f"{name}: its {SETTINGS} says {what} {own}, which is used instead of {given} ({usual.option(option)})."
            for what, option in (("unit", "model_unit"), ("frame", "model_frame"))
            if option in usual.model_fields_set
            and (own := getattr(reading[0], option)) != (given := getattr(usual, option))
        ]
        for load in loads:
            if load not in chosen:
                notes.append(f"{name} has no result for {load}.{_of_no_load(place, loads)}")
            elif reached is not None and reached.get(load, 0.0) < 1.0:
                share = f"{100 * reached.get(load, 0.0):.0f} %"
                notes.append(f"{name} reached only {share} of {load}; this load is not compared.")
            elif (end := early_end(chosen[load])) and end.certain and not usual.unfinished:
                notes.append(
                    f"{name}: the run of {load} {end.reason}; this load is not compared. To compare it anyway, use "
                    "--unfinished, or unfinished = true under [models] in a study file."
                )
            else:
                files[load].append(ModelFile(name, chosen[load], *reading))
                if end:
                    asked = "It is compared because of unfinished" if end.certain else "Check that the load was reached"
                    notes.append(f"{name}: the run of {load} {end.reason}. {asked}.")
                if stable is not None and stable.get(load, 1.0) < 1.0:
                    notes.append(
                        f"{name}, {load}: a material is not stable (Drucker) at the strain reached, in up to "
                        f"{100 * (1.0 - stable[load]):.1f} % of a tissue. The model is compared, but do not trust its "
                        "rank."
                    )
    files = {load: of for load, of in files.items() if of}
    if not files:
        raise InputError(with_reasons("No model has a complete result for a measured load.", notes))
    return files, notes


def _chosen(place: Path, loads: Sequence[str]) -> tuple[str, dict[str, Path]]:
    if place.is_dir():
        files = {
            load: file for load in loads for ending in reversed(ENDINGS) if (file := place / (load + ending)).is_file()
        }
        return place.resolve().name, files
    if not place.is_file():
        kinds = "a model is a folder with a file for each load, or a file"
        raise InputError(missing(place, advice=f"Check the path: {kinds}."))
    if place.stem in loads:
        return place.parent.resolve().name, {place.stem: place}
    if len(loads) > 1:
        raise InputError(
            f"{place}: it is unclear for which load this result is. Name the file after a measured load "
            f"({few(loads, most=4)}), or give the folder of one load as the measurement."
        )
    if place.stem in (_outcome(place, "reached") or ()):
        raise InputError(f"{place} is a simulation of {place.stem}, but the measured load is {loads[0]}.")
    return place.stem, {loads[0]: place}


def _of_no_load(place: Path, loads: Sequence[str]) -> str:
    """A sentence on results in a folder that are named after no measured load; empty without any."""
    files = sorted(place.iterdir()) if place.is_dir() else []
    odd = [file.name for file in files if file.suffix in (".vtu", ".vtk", ".frd", ".xplt") and file.stem not in loads]
    return f" Its {few(odd, most=3)} is named after no measured load ({few(loads, most=4)})." if odd else ""


def _passed_over(name: str, chosen: dict[str, Path]) -> list[str]:
    """A sentence for each load of which another result lies beside the one that is compared."""
    notes = []
    for load, file in chosen.items():
        results = (file.with_name(load + ending) for ending in ENDINGS)
        beside = [other.name for other in results if other != file and other.is_file()]
        if beside:
            others = " and ".join(beside)
            notes.append(f"{name}: {file.name} is compared, {others} is not. To compare it, move it to another folder.")
    return notes


def files_named(place: Path) -> list[Path]:
    """The settings file of a model, if there is one, and the files that it names."""
    try:
        content = _settings(place)
    except InputError:  # reported when the model is read
        content = {}
    named = [SETTINGS, *(content[key] for key in ("mesh", "to_image") if isinstance(content.get(key), str))]
    return [path for name in named if (path := _folder(place) / name).is_file()]


def loads_of(place: Path, has_mesh: bool) -> list[str]:
    """Loads for which the folder of a model has a file: from mrstrain's simulation record, else from file names."""
    if (reached := _outcome(place, "reached")) is not None:
        return [load for load in reached if any((place / (load + ending)).is_file() for ending in ENDINGS)]
    kept = [ending for ending in ENDINGS if ending != ".csv" or has_mesh or (place / SETTINGS).is_file()]
    mesh = _reading(place, ModelReading())[0].model_mesh
    return sorted({p.stem for p in place.iterdir() if p.suffix.lower() in kept and p != mesh})


def _outcome(place: Path, key: str) -> dict[str, float] | None:
    """The fraction "reached" or "stable_share" by load, from mrstrain's simulation record; None without one.

    Empty while a simulation is under way, or if it was killed.
    """
    try:
        outcome = read_json(_folder(place) / "simulation.json")["outcome"]
        return {load: float(of[key]) for load, of in outcome.items()}
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _folder(place: Path) -> Path:
    return place if place.is_dir() else place.parent


def _settings(place: Path) -> dict[str, Any]:
    """The settings of a model; empty if there are none."""
    settings = _folder(place) / SETTINGS
    if not settings.is_file():
        return {}
    try:
        text = settings.read_text(encoding="utf-8-sig")
        content = parse_toml(text)
    except (OSError, ValueError) as error:
        raise InputError(f"{settings} is not a valid TOML file ({error}).") from error
    refuse_damaged_toml(settings, text, content)
    return content


def _reading(
    place: Path, usual: ModelReading, to_image: FloatArray | None = None
) -> tuple[ModelReading, FloatArray | None]:
    """How a model is read: by its own settings, otherwise as ``usual``."""
    folder, content = _folder(place), _settings(place)
    if unknown := sorted(set(content) - {*_KEYS}):
        raise InputError(f"{folder / SETTINGS}: unknown key '{unknown[0]}'; the keys are {', '.join(_KEYS)}.")
    own: dict[str, Any] = {f"model_{key}": str(content[key]) for key in ("unit", "frame") if key in content}
    if "mesh" in content:
        own["model_mesh"] = folder / str(content["mesh"])
    if "leave_out" in content:
        names = content["leave_out"]
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f'{folder / SETTINGS}: leave_out is a list of names of regions, such as ["plate"].')
        own["leave_out"] = tuple(names)
    if "to_image" in content:
        matrix = content["to_image"]
        named = isinstance(matrix, str)
        to_image = read_matrix(folder / matrix) if named else matrix_of(matrix, f"{folder / SETTINGS}, to_image")
    return usual.model_copy(update=own), to_image
