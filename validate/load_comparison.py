"""One load, measured and simulated by several models: areas, location, agreement and skin displacement."""

import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np

from dvc import Deformation, ErrorTable, LabelMap, Measurement, TetMesh, Verdict, plate_axes
from dvc.arguments import check, check_fields, checked
from dvc.arrays import FloatArray
from dvc.errors import InputError
from dvc.file_names import clash
from dvc.trust.truth_draws import TruthDraws
from validate import location
from validate.agreement import Agreement, SkinDisplacement, agreements, skin_displacement
from validate.comparison_error import ComparisonError, comparison_errors
from validate.curves import DRAWS, RANGE, Area, Band, area_between, bands, check_range
from validate.decomposition import Decomposition, Representation, decompose, representation
from validate.extrapolation import LEVELLED
from validate.fe_result import FeResult
from validate.location import Overlap, Threshold
from validate.mapping import ALL, MappedFields, map_fields
from validate.mavm import ModelForm, model_form
from validate.sensitivity import Sensitivity, changes_of

STRAINED = 0.01
"""Least fraction of a tissue that must be measured above the lower end of the range for an informative area."""

NOTHING = "no deformation"
"""Name of a model that predicts zero strain everywhere: the reference for areas, outside the ranking."""

Fields = tuple[Deformation, Sequence[FeResult]]


@dataclass(frozen=True, slots=True)
class Criteria:
    """Criteria of the comparison.

    Attributes
    ----------
    strains : (low, high)
        Range of maximum shear strain over which strain-volume curves are compared.
    thresholds, least_ml : tuple of Threshold, float
        Maximum shear strains above which clusters are compared, and volume of the smallest cluster that counts, mL.
    seed : int
        Of the true fields drawn from the error model; draws of different loads are independent.

    Raises
    ------
    InputError
        Unless the range increases and lies within 0 to 3, or if the volume is negative.
    """

    strains: tuple[float, float] = RANGE
    thresholds: tuple[Threshold, ...] = field(default_factory=location.read_thresholds)
    least_ml: float = location.LEAST_ML
    seed: int = 1

    def __post_init__(self) -> None:
        check_range(self.strains)
        if self.least_ml < 0.0:
            raise InputError(f"The volume of the smallest cluster must not be negative; got {self.least_ml:g} mL.")


@dataclass(frozen=True, slots=True, eq=False)
class LoadCase:
    """One load: the measurement, and the result of each model.

    Attributes
    ----------
    read : callable
        Returns the measured deformation (tissue relative to its bone, reference configuration, LPS mm) and the results
        of the models. It is called whenever they are needed, so that files can be read again instead of kept in memory.
    axes : (3, 3)
        Of the plate, LPS, the first in the direction of its normal force; see `dvc.plate_axes`. By default the plate
        presses in superior and shears in anterior direction.
    error, verdict : ErrorTable, Verdict, or None
        Error of the measured maximum shear strain, and the verdict on the registration. Without the error, results have
        no intervals and no difference is significant.
    aligned_on : str
        What was aligned rigidly: "bone", "image" or "none"; empty if unknown.
    image : path or None
        The registered loaded image, shown in the viewer of the report.
    without_intervals : tuple of str
        Tissues for which the measurement has no intervals, although its error is known; nor has the comparison.
    """

    load: str
    read: Callable[[], Fields]
    axes: FloatArray = field(default_factory=lambda: plate_axes((0.0, 0.0, 1.0), (0.0, -1.0, 0.0)))
    error: ErrorTable | None = None
    verdict: Verdict | None = None
    aligned_on: str = ""
    image: Path | None = None
    without_intervals: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_fields(self)

    @classmethod
    @checked
    def of(
        cls, load: str, measured: Deformation | Measurement, results: Sequence[FeResult],
        error: ErrorTable | None = None,
    ) -> Self:  # fmt: skip
        """A load whose fields are in memory; set the other attributes with `dataclasses.replace`.

        Parameters
        ----------
        measured : Deformation or Measurement
            Of tissue relative to its bone, reference configuration, LPS mm. A `Measurement` also gives its error, its
            verdict, its rigid alignment, and the plate's axes if a shear direction was given.
        results : sequence of FeResult
            One for each model (`FeResult.of`, `read_result`).
        error : ErrorTable, optional
            Error of the measured maximum shear strain; replaces that of the measurement.
        """
        if not isinstance(measured, Measurement):
            return cls(load, partial(_given, measured, results), error=error)
        known, axes = measured.error_bars.uncertainty, None if measured.source is None else measured.source.subject.axes
        error = known.table if error is None and known is not None else error
        on, read = str(measured.alignment.get("on", "")), partial(_given, measured.deformation, results)
        gaps = dict.fromkeys(i.region for i in measured.error_bars.intervals if np.isnan(i.low))
        case = cls(load, read, error=error, verdict=measured.verdict, aligned_on=on, without_intervals=tuple(gaps))
        # Those of a subject begin with the direction from the body to the plate, these with that of its force.
        return case if axes is None else replace(case, axes=plate_axes(-axes[:, 0], axes[:, 1]))

    def fields(self) -> Fields:
        """The measured deformation and the results; InputError without a model, or if two models have the same name."""
        measured, results = self.read()
        check(f"{self.load}: results", results, Sequence[FeResult])
        if not results:
            raise InputError(f"{self.load}: there is no model to compare.")
        if twice := clash([NOTHING, *(result.name for result in results)]):
            raise InputError(f"{self.load}: two models are named {twice}; rename one of them.")
        return measured, results


def _given(measured: Deformation, results: Sequence[FeResult]) -> Fields:
    return measured, results


@dataclass(frozen=True, slots=True, eq=False)
class LoadComparison:
    """Models compared with the measurement of one load.

    Attributes
    ----------
    labels, bones : LabelMap, tuple of str
        Labels of the unloaded image, and those that are bone.
    areas : tuple of Area
        By model and tissue, with all soft tissue first. Those of `NOTHING` are last.
    model_forms : tuple of ModelForm
        Modified area validation metric, by model and tissue.
    bands, decompositions : mapping of tissue to Band, to Decomposition
        Empty where the measurement uncertainty is unknown. Each tissue is decomposed separately, since strain is
        discontinuous at interfaces.
    errors : tuple of ComparisonError
        Comparison error of each figure, with its uncertainties; empty if the measurement uncertainty is unknown.
    """

    case: LoadCase
    labels: LabelMap
    bones: tuple[str, ...]
    criteria: Criteria
    fields: MappedFields
    areas: tuple[Area, ...]
    overlaps: tuple[Overlap, ...]
    agreements: tuple[Agreement, ...]
    skin: tuple[SkinDisplacement, ...]
    model_forms: tuple[ModelForm, ...]
    bands: Mapping[str, Band]
    decompositions: Mapping[str, Decomposition]
    errors: tuple[ComparisonError, ...] = ()

    @property
    def representations(self) -> tuple[Representation, ...]:
        """How well each model, and `NOTHING`, represents the measured strain of each tissue."""
        of = self.decompositions.items()
        return tuple(representation((name, self.load, tissue), by) for tissue, by in of for name in by.models)

    @property
    def load(self) -> str:
        """Name of the load."""
        return self.case.load

    @property
    def hardly_strained(self) -> bool:
        """Whether less than 1 % of the tissue is measured above the lower end of the range."""
        where = self.fields.common
        volumes = self.fields.volumes_ml[where]
        above = volumes[self.fields.measured.max_shear[where] > self.criteria.strains[0]].sum()
        return bool(above < STRAINED * volumes.sum())

    def ranked(self) -> list[Area]:
        """Areas of the ranked models in all soft tissue, smallest first, by the estimate if there is one.

        Levelled models are not ranked, since no bias is removed from their areas. `NOTHING` is not ranked either.
        """
        models = (a for a in self.areas if a.tissue == ALL and a.model != NOTHING and not a.levelled)
        return sorted(models, key=lambda a: a.best_ml)

    @property
    def nothing(self) -> Area:
        """Area of `NOTHING` in all soft tissue."""
        return next(a for a in self.areas if (a.model, a.tissue) == (NOTHING, ALL))


@checked
def compare_load(
    case: LoadCase, labels: LabelMap, bones: Sequence[str] = ("bone",), *,
    mesh: TetMesh | None = None, criteria: Criteria | None = None,
) -> LoadComparison:  # fmt: skip
    """Compare models with the measurement of one load, at the centroids of the cells of one mesh.

    Parameters as in `validate.compare`, errors as in `validate.map_fields`.
    """
    by = criteria or Criteria()
    measured, results = case.fields()
    models = {result.name: result.deformation for result in results}
    fields = map_fields(mesh if mesh is not None else results[0].mesh, labels, bones, measured, models)
    truths: list[FloatArray] = []
    if not bones:
        case = replace(case, error=None)  # it is known by distance to bone
    uncertain = {} if case.error is None else _sensitivities(fields, results, by)
    known = {} if case.error is None else _bands(fields, case, case.error, by, truths, uncertain)
    normal, cells = -case.axes[:, 0], location.CellGraph.of(fields.mesh)
    levels = [threshold.max_shear for threshold in by.thresholds]
    return LoadComparison(
        case, labels, tuple(bones), by, fields,
        areas=tuple(_areas(fields, case.load, known, by)),
        overlaps=tuple(_overlaps(fields, case, by, truths, cells)),
        agreements=tuple(row for name in models for row in agreements(fields, name, case.load)),
        skin=tuple(skin_displacement(fields, name, case.load, of, measured, normal) for name, of in models.items()),
        model_forms=tuple(_model_forms(fields, case.load)),
        bands=known,
        decompositions={} if case.error is None else _decompositions(fields, case, case.error, np.array(truths), cells),
        errors=tuple(comparison_errors(case.load, fields, known, uncertain, levels, by.strains)),
    )  # fmt: skip


def _sensitivities(fields: MappedFields, results: Sequence[FeResult], by: Criteria) -> dict[str, Sensitivity]:
    """Sensitivity of each model that has variants, in the common cells."""
    common = fields.common
    points, volumes = fields.points_mm[common], fields.volumes_ml[common]
    tissues = [cells[common] for name, cells in fields.parts.items() if name != ALL]
    return {
        one.name: Sensitivity.of(
            one.name, changes_of(one.deformation, one.variants, points, volumes, tissues), DRAWS, by.seed
        )
        for one in results
        if one.variants and not one.name.endswith(LEVELLED)
    }


def _areas(fields: MappedFields, load: str, known: Mapping[str, Band], by: Criteria) -> Iterator[Area]:
    for name, shear in _shears(fields).items():
        for tissue, where in fields.parts.items():
            volumes = fields.volumes_ml[where]
            area = area_between(fields.measured.max_shear[where], shear[where], volumes, by.strains)
            normalised = area / volumes.sum() / (by.strains[1] - by.strains[0])
            # a levelled model has the bias of the measurement itself, so none is removed
            estimated = known[tissue].interval(name) if tissue in known and not name.endswith(LEVELLED) else ()
            yield Area(name, load, tissue, area, normalised, *estimated)


def _model_forms(fields: MappedFields, load: str) -> Iterator[ModelForm]:
    for name, shear in _shears(fields).items():
        for tissue, where in fields.parts.items():
            measured, volumes = fields.measured.max_shear[where], fields.volumes_ml[where]
            yield model_form((name, load, tissue), measured, shear[where], volumes)


def _decompositions(
    fields: MappedFields, case: LoadCase, error: ErrorTable, truths: FloatArray, cells: location.CellGraph
) -> dict[str, Decomposition]:
    """Each tissue's fields in coefficients; ``truths`` (m, n) in the common cells."""
    made = {}
    for tissue, where in fields.parts.items():
        if tissue in (ALL, *case.without_intervals):
            continue
        measured, models = fields.measured.max_shear[where], {n: of[where] for n, of in _shears(fields).items()}
        bias, sd = error.expected(tissue.lower(), measured, fields.to_bone_mm[where].astype(np.float32))
        u_cal = float(np.sqrt(np.average(bias**2 + sd**2, weights=fields.volumes_ml[where])))
        drawn = truths[:, where[fields.common]]
        made[tissue] = decompose(measured, models, cells.part(where), u_cal, drawn, error.factor_of(tissue))
    return made


def _overlaps(
    fields: MappedFields, case: LoadCase, by: Criteria, truths: Sequence[FloatArray], cells: location.CellGraph
) -> Sequence[Overlap]:
    common = fields.common
    measured = np.where(common, fields.measured.max_shear, -1.0)
    simulated = {name: np.where(common, model.max_shear, -1.0) for name, model in fields.models.items()}
    rows = [
        location.overlap(name, case.load, threshold.max_shear, measured, shear, cells, by.least_ml)
        for name, shear in simulated.items()
        for threshold in by.thresholds
    ]
    if case.error is None:
        return rows
    shears = {name: shear[common] for name, shear in simulated.items()}
    return location.with_intervals(rows, truths, shears, cells.part(common), by.least_ml, case.error.factor)


def _shears(fields: MappedFields) -> dict[str, FloatArray]:
    """Maximum shear strain of each model, and of `NOTHING`."""
    return {name: of.max_shear for name, of in fields.models.items()} | {NOTHING: np.zeros(len(fields.points_mm))}


def _bands(
    fields: MappedFields, case: LoadCase, error: ErrorTable, by: Criteria, first: list[FloatArray],
    uncertain: Mapping[str, Sensitivity],
) -> dict[str, Band]:  # fmt: skip
    """Bands by tissue; the ``first`` true fields drawn for them are kept for the intervals of location."""
    common, seed = fields.common, zlib.crc32(case.load.encode()) + by.seed
    shear, tissues = fields.measured.max_shear[common], [str(t).lower() for t in fields.tissue[common]]
    draws = TruthDraws(fields.points_mm[common], shear, tissues, fields.to_bone_mm[common], error, seed)

    def truths() -> Iterator[FloatArray]:
        for _ in range(DRAWS):
            truth = draws.drawn()
            if len(first) < location.LOCATION_DRAWS:
                first.append(truth.astype(np.float32))
            yield truth

    models = {name: shear[common] for name, shear in _shears(fields).items()}
    inside = {name: where[common] for name, where in fields.parts.items() if name not in case.without_intervals}
    volumes = fields.volumes_ml[common]
    return bands(truths(), models, volumes, inside, error.factor_of, draws.narrowed, by.strains, uncertain)
