"""`check`: checks every input of a study, reports all problems at once, and estimates the cost of the run."""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ParamSpec, TypeVar

import numpy as np

from dvc import Image, LabelMap, fit_mask, plate_axes, read_error_model, read_image, read_labels, read_mask
from dvc.errors import MrstrainError
from dvc.file_names import as_typed
from dvc.images.bone_names import is_bones_name
from dvc.io.images.labels import read_names
from dvc.io.result_folder import REPEAT
from dvc.labelling.boundaries import correctable
from dvc.labelling.tissues import NAMES
from dvc.measurement.subject import bones_of
from dvc.trust.error_model import error_model_of
from fe import (
    BONE,
    Material,
    MaterialSet,
    Plate,
    check_loads,
    check_meshing,
    fixed_facets,
    material_set,
    problems_of,
)
from mrstrain.measurement.engines import engine_of
from mrstrain.options.measurement import in_parallel, refuse_misspelt_auto
from mrstrain.studies.costs import costs, mesh_given, sizes_of
from mrstrain.studies.credibility import details_not_given
from mrstrain.studies.file import Study, read_study
from mrstrain.studies.ledger import Ledger
from mrstrain.studies.pipeline import Pipeline
from mrstrain.studies.plan import Stage, drawn_to_mesh, load_steps, mesh_place, plan
from mrstrain.studies.results_given import look_at_results
from validate import check_bones, check_overlap, read_thresholds

_T = TypeVar("_T")
_THERE = 0.5  # smallest fraction of the labelled tissue that must lie in the image
_MOST_N = 3000.0  # of a load


_P = ParamSpec("_P")


@dataclass(frozen=True, slots=True)
class Checked:
    """Result of `check`: problems that prevent the study from being run, warnings, notes, and the next step."""

    wrong: tuple[str, ...]
    warnings: tuple[str, ...]
    notes: tuple[str, ...]
    next_step: str = ""  # without a problem

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        errors = [f"ERROR: {one}" for one in self.wrong]
        return [*self.notes, *(f"WARNING: {one}" for one in self.warnings), *(errors or [self._passed])]

    @property
    def _passed(self) -> str:
        """The last line where nothing is wrong."""
        count = len(self.warnings)
        warnings = f", but {count} warning{'s' if count > 1 else ''} above" if count else ""
        return f"No problems found{warnings}." + (f" Next step: {self.next_step}" if self.next_step else "")


def check(study: Path | str, *, workers: int | None = None) -> Checked:
    """Read every input of a study, report all problems, and estimate what a run takes.

    Parameters
    ----------
    study : path
        The study file, or its folder.
    workers : int, optional
        Number of stages at the same time, for the estimates; by default one for each core.

    Raises
    ------
    InputError
        If the study file itself cannot be read.
    """
    told = read_study(study)
    looked = _Look(told, None)
    reference, labels = looked.at_shared()
    looked.at_loaded(reference)
    looked.notes[:0] = looked.grids()
    looked.notes += looked.tried(look_at_results, told, labels, looked.tried) or []
    planned, next_step = looked.tried(plan, told), ""
    if planned is not None and not looked.wrong:  # else only what is wrong counts
        looked.notes += details_not_given(told)
        assumed = told.plate.assumed("change normal in [plate] of the study file")
        if assumed and told.models.sets and not all(load.plate_normal for load in told.loads.values()):
            looked.notes.append(assumed)
        left = Pipeline(planned, Ledger(told.out, told.place)).to_do()
        if left:
            lines, warnings = costs(told, planned, left, *sizes_of(told), in_parallel(workers))
            looked.notes += lines
            looked.warnings += warnings
            next_step = f"mrstrain run {as_typed(study)}"
        else:
            looked.notes.append("All stages are up to date; a run only rewrites the report.")
    return Checked(tuple(looked.wrong), tuple(looked.warnings), tuple(looked.notes), next_step)


def wrong_with(study: Study, stages: Sequence[Stage]) -> tuple[str, ...]:
    """Problems that would make some of these stages fail, except those of loaded images, which affect one load only."""
    looked = _Look(study, stages)
    looked.at_shared()
    return tuple(looked.wrong)


@dataclass(slots=True)
class _Look:
    """Checks the inputs of some stages of a study, or of all (None); collects the results of `Checked`."""

    study: Study
    stages: Sequence[Stage] | None
    wrong: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    on_grid: dict[str, list[str]] = field(default_factory=dict)  # names of images, by their grid in words

    def grids(self) -> list[str]:
        """A line for each grid of images."""
        return [f"{', '.join(names)}: {grid}" for grid, names in self.on_grid.items()]

    def tried(self, read: Callable[_P, _T], *given: _P.args, **options: _P.kwargs) -> _T | None:
        """Result of a function; None if it raises an error, which is recorded once."""
        try:
            return read(*given, **options)
        except (MrstrainError, OSError) as error:
            if str(error) not in self.wrong:
                self.wrong.append(str(error))
            return None

    def tried_at(
        self, table: str, key: str, read: Callable[_P, _T], *given: _P.args, **options: _P.kwargs
    ) -> _T | None:  # fmt: skip
        """As `tried`, for a value whose line in the study file is reported."""
        try:
            return read(*given, **options)
        except MrstrainError as error:
            self.wrong.append(f"{self.study.at(table, key)}: {error}")
            return None

    def asked(self, *names_or_kinds: str) -> bool:
        """Whether a stage of one of these names or kinds is checked."""
        return self.stages is None or any(stage.is_one_of(names_or_kinds) for stage in self.stages)

    def at_shared(self) -> tuple[Image | None, LabelMap | None]:
        """Check everything except loaded images; return the unloaded image, and the labels on its grid."""
        study, asked = self.study, self.asked
        reference = self.tried(self.image, study.images.load0) if asked("label", "register", "level") else None
        if reference is not None:
            self.on_grid.setdefault(str(reference.grid), []).append("Load0")
        labels = self.labels(reference) if asked("label", "register", "level", "compare") else None
        every = asked("simulate", "drive", "compare")
        own = [study.directions[load] for load in study.loads if every or asked(f"register {load}")]
        for normal, shear in dict.fromkeys(own):
            self.tried(plate_axes, -np.asarray(normal), shear)
        self.at_masks(reference)
        if asked("register", "level"):
            self.at_registration(labels)
        if study.models.sets and asked("mesh", "simulate", "drive"):
            drawn = None if study.mesh.file else drawn_to_mesh(study)
            to_mesh = None if drawn is None else self.tried(self.drawn, *drawn)
            if asked("mesh") and to_mesh is not None:
                self.at_meshing(to_mesh)
            if asked("simulate", "drive"):
                self.at_simulations(reference, to_mesh)
        if study.models.level and asked("level") and reference is not None and reference.missing.any():
            self.wrong.append("[models] level = true needs an unloaded image without NaN or infinite voxels.")
        if asked("compare"):
            if labels is not None and (study.models.sets or study.models.results):
                self.tried_at("mesh", "bones", check_bones, labels, bones_of(labels, study.mesh.bones))
            if study.compare.thresholds is not None:
                self.tried(read_thresholds, study.path(study.compare.thresholds))
        return reference, labels

    def image(self, given: str | Path) -> Image:
        """An image of the study."""
        return read_image(self.study.path(given), allow_missing=self.study.images.allow_missing)

    def drawn(self, labels: Path, names: Path | None) -> LabelMap:
        """A label map of the study that is not made from the image."""
        if labels == self.study.path(self.study.images.labels):
            refuse_misspelt_auto(self.study.images.labels, self.study.place)
        return read_labels(labels, names)

    def labels(self, reference: Image | None) -> LabelMap | None:
        """The labels, on the unloaded image's grid; None if they are to be made from the image."""
        if self.study.drawn_labels is None:
            command = self.study.images.labels_command
            self.notes.append(f"Labels: made by the command {command}" if command else "Labels: made from the image")
            self.at_marks(reference)
            table = self.study.optional_path(self.study.images.names)
            names = None if table is None else self.tried(read_names, table)
            if names is not None and self.study.images.bone is None and self.study.bone not in names.values():
                lacking = f"{table} has no label '{self.study.bone}'; it has {', '.join(names.values())}."
                self.wrong.append(f"{self.study.at('images', 'bone')}: {lacking}")
            return None
        labels = self.tried(self.drawn, *self.study.drawn_labels)
        if labels is not None:
            self.notes.append(f"Labels: {', '.join(labels.names.values())}")
            if reference is not None:
                labels = self.tried(fit_mask, labels, reference.grid, str(self.study.images.labels)) or labels
            if self.study.images.correct_labels:
                self.at_correction(labels)
        return labels

    def at_correction(self, labels: LabelMap) -> None:
        """Report if `correct_labels` has no boundary to correct, or only those of bones or only that of skin."""
        there = self.tried_at("images", "correct_labels", correctable, labels)
        for part, name, other in zip(there or (), ("like a bone", "skin"), ("skin", "bones"), strict=False):
            if not part.any():
                self.warnings.append(f"no label is named {name}, so correct_labels corrects only {other}.")

    def at_marks(self, reference: Image | None) -> None:
        """Check the marks for the label map, among which the bone must be if there is no mask of it."""
        from mrstrain.measurement.strokes import read_marks  # it draws, and matplotlib takes half a second

        images = self.study.images.located(self.study.place)
        marks = None if images.marks is None else self.tried(read_marks, images.marks, images.mark_names)
        if marks is None:
            return
        if images.bone is None and self.study.bone is not None:
            self.tried_at("images", "bone", marks.region, self.study.bone)
        if reference is not None:
            self.tried(fit_mask, marks, reference.grid, str(images.marks))

    def at_loaded(self, reference: Image | None) -> None:
        """Check the loaded images and the repeat scan."""
        others: dict[str, str | Path] = {load: one.image for load, one in self.study.loads.items()}
        if self.study.images.repeat is not None:
            others[REPEAT] = self.study.images.repeat
        hashes: dict[str, str] = {}
        for name, other in others.items():
            image = self.tried(self.image, other)
            if image is None:
                continue
            self.on_grid.setdefault(str(image.grid), []).append(name)
            same_grid = reference is not None and reference.grid.same_as(image.grid)
            if reference is not None and same_grid and np.array_equal(reference.values, image.values, equal_nan=True):
                self.wrong.append(f"{name} is identical to the unloaded image (all voxels are equal).")
            twin = hashes.setdefault(hashlib.sha256(image.values.tobytes()).hexdigest(), name)
            if twin != name:
                self.wrong.append(f"{name} is identical to the image of {twin} (all voxels are equal).")

    def at_masks(self, reference: Image | None) -> None:
        """Check the masks of the bone and the body, if the unloaded image is read."""
        images = self.study.images.located(self.study.place)
        for mask in (images.bone, images.tissue):
            if mask is not None and reference is not None:
                self.tried(read_mask, mask, reference.grid)

    def at_registration(self, labels: LabelMap | None) -> None:
        """Check the label of the bone, engine, parameters and error model."""
        subject, how = self.study.subject_files, self.study.registration.located(self.study.place)
        if subject.bone_label is not None and labels is not None:
            self.tried_at("images", "bone", labels.region, subject.bone_label)
        if (engine := self.tried(engine_of, how, labelled=True)) is None:
            return
        own = how.error_model
        model = error_model_of(engine.name) if own is None else self.tried(read_error_model, own)
        if model is None:
            self.notes.append(
                f"{engine.name} has no error model, so results will have no intervals; `mrstrain accuracy` makes one."
            )
        elif model.preset not in engine.may_be:
            self.wrong.append(
                f"{self.study.at('registration', 'error_model')}: this error model is for {model.preset}, but "
                f"{engine.name} will be used; `mrstrain accuracy --preset {as_typed(engine.name)}` makes one for it."
            )

    def at_meshing(self, labels: LabelMap) -> None:
        """Report problems of a label map for `mesh`, and bones that would be meshed."""
        how, bones = self.study.mesh, bones_of(labels, self.study.mesh.bones)
        if bones:
            self.tried(check_meshing, labels, how.edge_mm, bones, how.finer)
        else:
            self.wrong.append(f"{self.study.at('mesh', 'bones')}: {labels.no_region(BONE)}")
        self.soft(labels, warned=True)

    def soft(self, labels: LabelMap | None, warned: bool = False) -> list[str]:
        """Names of the tissues that are meshed, of a label map or (None) of one made from the image."""
        names, bones = list(NAMES.values()), self.study.mesh.bones or tuple(filter(is_bones_name, NAMES.values()))
        if labels is not None:
            there, bones = np.unique(labels.labels), bones_of(labels, self.study.mesh.bones)
            names = [name for n, name in labels.names.items() if n != 0 and n in there]
        soft = [name for name in names if name not in bones]
        if_there = "" if labels is not None else ", if the label map that is made has it,"
        self.warnings += [
            f"{name}{if_there} will be meshed as soft tissue, but has the name of a bone. "
            "If it is one, add it to [mesh] bones."
            for name in soft
            if warned and is_bones_name(name)
        ]
        return soft

    def at_simulations(self, reference: Image | None, labels: LabelMap | None) -> None:
        """Report problems for `simulate`, on a mesh made elsewhere or from these labels."""
        study = self.study
        sets = [self.tried(material_set, study.set_given(name)) for name in study.models.sets]
        chosen = [one for one in sets if one is not None and self.asked(f"simulate {one.name}", f"drive {one.name}")]
        steps = self.tried(load_steps, study) or {}
        if forceless := [name for name in study.loads if steps and name not in steps]:
            lacking = "; ".join(study.at(f"loads.{name}", "normal_n") for name in forceless)
            self.notes.append(
                f"{', '.join(forceless)}: measured but not simulated, because no force is given ({lacking})."
            )
        contact = study.plate.model_dump(exclude={"plate_normal", "shear_direction"})
        made = {name: self.tried(Plate, *study.directions[name], **contact) for name in steps}
        plates = {name: plate for name, plate in made.items() if plate is not None}
        pressed = [steps[name] for name in plates]
        for step in pressed:
            self.tried(check_loads, plates[step.name], [step])
            if step.normal_n is not None and step.normal_n > _MOST_N:
                at = study.at(f"loads.{step.name}", "normal_n")
                self.warnings.append(
                    f"{at}: a force of {step.normal_n:g} N is several times the weight of a person; check its unit."
                )
        if study.mesh.file is None:
            if reference is not None:
                image_mm = float(np.multiply(reference.grid.shape, reference.grid.spacing_mm).max())
                for plate in plates.values():
                    self.tried(plate.check_gap, image_mm)
            self.at_tissues(reference, labels, chosen)
            return
        if (mesh := self.tried(mesh_given, study)) is None:
            return
        if reference is not None:
            self.tried(check_overlap, mesh_place(study), mesh, reference.grid)
        held = fixed_facets(mesh, study.models.fixed)
        for one in chosen:
            laws = self.laws_of(one, mesh.regions)
            if laws is not None and pressed:
                problems = self.tried(problems_of, mesh, laws, plates, pressed, held, study.models.element) or []
                odd = dict.fromkeys(note for each in problems for note in each.notes)
                self.warnings += [note for note in odd if note not in self.warnings]

    def laws_of(self, one: MaterialSet, regions: Iterable[str]) -> Mapping[str, Material] | None:
        """The materials of a set by region, with warnings about odd ones."""
        found = self.tried(one.for_regions, regions)
        if found is None:
            return None
        laws, told = found
        substitutes = one.substitutes(laws)
        self.notes += substitutes
        self.warnings += told[len(substitutes) :]
        return laws

    def at_tissues(self, reference: Image | None, labels: LabelMap | None, sets: Sequence[MaterialSet]) -> None:
        """Check that each set has a material for every meshed tissue, and that the tissues lie in the images."""
        fixed = {name.casefold() for name in self.study.models.fixed}
        if unknown := fixed - {"bone", "cut"}:
            self.wrong.append(
                f"[models] fixed: only 'cut' can be fixed in addition to the bone; got {', '.join(sorted(unknown))}."
            )
        known = drawn_to_mesh(self.study) is None and not self.study.images.labels_command
        if labels is None and not known:
            return
        if labels is not None and reference is not None and self.study.mesh.labels is not None:
            there = float(reference.grid.contains(labels.grid.points(labels.labels > 0)).mean())
            if there < _THERE:
                self.wrong.append(
                    f"{self.study.path(self.study.mesh.labels)}: only {100 * there:.0f} % of the labelled tissue lies "
                    "in the unloaded image. The label map to be meshed must be in the coordinates of the images."
                )
        soft = self.soft(labels, warned=labels is None)
        if labels is None:  # other bones may not be there
            soft = [name for name in soft if not is_bones_name(name)]
        for one in sets:
            self.laws_of(one, soft)
        for region in self.study.uncertainty.stiffness:
            if region not in soft:
                at = self.study.at("uncertainty", "stiffness")
                self.wrong.append(f"{at}: there is no soft tissue '{region}'; there are {', '.join(soft)}.")
        if "cut" in fixed and "skin" not in {name.casefold() for name in soft}:
            self.wrong.append(
                "[models] fixed: 'cut' (the truncation surface) can only be detected if a tissue of the label map is "
                "named skin."
            )
