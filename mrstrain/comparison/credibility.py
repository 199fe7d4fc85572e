"""Evidence of a comparison for a credibility assessment after ASME V&V 40 and FDA, as a section of a report.

The program fills in what it knows and grades nothing: a person states question, context of use, risk and levels.

References
----------
.. [1] ASME V&V 40-2018, Assessing credibility of computational modeling through verification and validation:
   application to medical devices.
.. [2] FDA, Assessing the credibility of computational modeling and simulation in medical device submissions, guidance,
   17 November 2023.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dvc import Verdict
from dvc.report.alike import alike
from dvc.report.page import Section, Table
from fe import Tolerance
from mrstrain.comparison.methods import models_with
from mrstrain.comparison.model_facts import ModelFacts, facts_of, used_for_calibration
from mrstrain.measurement.acquisition import NOT_GIVEN
from mrstrain.options.credibility import CredibilityOptions
from mrstrain.records.provenance import versions
from validate import ALL, NOTHING, Comparison
from validate.curves import range_told
from validate.ranking import OVER_LOADS

TITLE = "Credibility (ASME V&V 40, FDA)"
"""Title of the section of a report."""
_ABOUT = (
    "Evidence in this report for a credibility assessment after ASME V&V 40-2018 and FDA's guidance of 17 November "
    "2023. The program lists what it knows and assigns no level or risk: these are for you to judge. Everything else "
    'comes from [credibility] in the study file; what is missing there is "not given".'
)
CODE = (
    "Order of convergence of displacement and its gradient (closed-form solution, nearly incompressible tissue): P1 "
    "2.01 and 1.01, MINI 2.08 and 1.32, P2 3.08 and 2.01 (documentation, Finite elements: measurements)"
)
"""Figures of the documentation, which a test compares with it."""
COMPARATOR = (
    "RMSE of the measured max. shear on phantoms of known motion, without and with a label map: fat .024 and .015, "
    "muscle .013 and .012, skin .052 and .028 (README)"
)
"""Figures of the documentation, as `CODE`, on what models are compared with."""
MESH_DOUBT = (
    "with 80,000 linear cells, percentiles of the max. shear in a heel's fat lie 3 to 8 % below the limit of finer "
    "meshes (Limitations)"
)
_OF_USE = (
    f"{NOT_GIVEN}: the simulations here are those of the comparison, whose verification and uncertainties are in 4. "
    "They count here only if the context of use is what was compared."
)
_ASSUMED = (
    "Models by mrstrain: isotropic and elastic; tissues bonded to each other; rigid plate; the unloaded image is free "
    "of stress (Limitations)"
)


@dataclass(frozen=True, slots=True)
class Holdings:
    """What was compared: models, verdicts on the registrations by load, and the comparison, if there is one."""

    models: tuple[ModelFacts, ...]
    verdicts: Mapping[str, Verdict | None]
    comparison: Comparison | None = None
    convergence: tuple[str, ...] = ()  # what `converge` found for this label map
    subject: str = ""
    given: CredibilityOptions = field(default_factory=CredibilityOptions)

    @classmethod
    def of(cls, comparison: Comparison, folders: Mapping[str, Path]) -> "Holdings":
        """A comparison without a study, with the folder of each model."""
        return cls(facts_of(folders), comparison.verdicts, comparison)

    def of_kind(self, *kinds: str) -> list[ModelFacts]:
        """Models of some kinds."""
        return [one for one in self.models if one.kind in kinds]


def credibility_section(held: Holdings) -> Section:
    """The section of a report, folded."""
    tables = _risk(held.given), _evidence(held), _calibration(held), _applicability(held), _factors(held)
    return Section(TITLE, None, tables, (), (_ABOUT,), folded=True)


def _told(value: object) -> str:
    return NOT_GIVEN if value is None or value == "" else str(value)


def _by_person(value: object) -> str:
    return f"From the study file: {_told(value)}"


def _names(models: Sequence[ModelFacts]) -> str:
    return ", ".join(one.name for one in models)


def _sentences(*parts: str | None) -> str:
    """Parts as sentences; empty ones are left out."""
    return " ".join(f"{part.rstrip('.')}." for part in parts if part)


def _risk(given: CredibilityOptions) -> Table:
    rows = (
        ("Question of interest", given.question_of_interest), ("Context of use", given.context_of_use),
        ("Quantities of interest", given.quantities_of_interest), ("Model influence", given.model_influence),
        ("Decision consequence", given.decision_consequence), ("Model risk", given.model_risk),
        ("Reason", given.risk_rationale),
    )  # fmt: skip
    return Table(
        "Question, context of use and model risk",
        ("item", "from the study file"),
        tuple((n, _told(v)) for n, v in rows),
    )


def _evidence(held: Holdings) -> Table:
    """FDA's eight categories of evidence."""
    given, others = held.given, held.of_kind("other")
    own = f"mrstrain {versions()['mrstrain']}. {CODE}"
    foreign = f"Code verification of {_names(others)}: {NOT_GIVEN}" if others else ""
    calibrated = used_for_calibration(held.models)
    found = f"{len(calibrated)} found, listed below" if calibrated else "none found in the records"
    by_person = _by_person(given.calibration)
    rows = (
        ("1. Code verification results", _sentences(own, foreign)),
        ("2. Model calibration evidence", _sentences(f"Use of data for calibration: {found}", by_person)),
        ("3. Bench test validation results", _told(given.bench_tests)),
        ("4. In vivo validation results",
         _sentences(_validation(held), COMPARATOR, _calculated(held), _uncertainties(held))),
        ("5. Population-based validation results", _sentences("One subject here", _by_person(given.population))),
        ("6. Emergent model behavior", _told(given.emergent_behaviour)),
        ("7. Model plausibility", _sentences(_plausible(held), _by_person(given.plausibility))),
        ("8. Calculation verification and UQ results using simulations of the context of use", _OF_USE),
    )  # fmt: skip
    note = (
        "Categories of FDA's guidance. A comparison is in vivo evidence only if the subject is living. With a phantom, "
        "it tests the program; with a specimen, it is a bench test. Calculation verification and uncertainties of the "
        "simulations that are compared belong to that comparison."
    )
    return Table("Evidence by category", ("category", "what this report holds"), rows, note)


def _validation(held: Holdings) -> str:
    """Verdicts, the statement over all loads (or those of each load), and the area of each model with its interval."""
    verdicts = "; ".join(f"{load} {verdict.words}" for load, verdict in held.verdicts.items() if verdict is not None)
    of = f"Verdicts on the registrations: {verdicts or NOT_GIVEN}"
    if held.comparison is None:
        return f"{of}. Comparison with models: {NOT_GIVEN}"
    told = held.comparison.ranking.statements
    if told and OVER_LOADS in told[0]:  # the others, of single loads, are elsewhere in the report
        told = told[:1]
    return _sentences(of, *told, _areas(held, held.comparison))


def _areas(held: Holdings, comparison: Comparison) -> str:
    """The area of each model over all loads; models with measured boundary conditions are marked as such."""
    driven = {one.name: " with measured boundary conditions" for one in held.of_kind("driven")}
    areas = [a for a in comparison.ranking.areas if not a.levelled] or [
        a for a in comparison.areas if a.tissue == ALL and a.model != NOTHING and not a.levelled
    ]
    told = ", ".join(f"{a.model}{driven.get(a.model, '')} {_interval(a.best_ml, a.low_ml, a.high_ml)}" for a in areas)
    over = range_told(comparison.strains)
    return f"Area between strain-volume curves ({over}), mL, with its interval of 95 % coverage: {told}" if told else ""


def _interval(value: float, low: float, high: float) -> str:
    return f"{value:.2f} (no interval)" if np.isnan(low) else f"{value:.2f} ({low:.2f} to {high:.2f})"


def _plausible(held: Holdings) -> str:
    return _ASSUMED if held.of_kind("simulated", "driven") else ""


def _calculated(held: Holdings) -> str:
    """Mesh convergence, and whether every load was reached."""
    mesh = " ".join(held.convergence) or f"Mesh convergence: {NOT_GIVEN} (mrstrain converge)"
    linear = [one for one in held.of_kind("simulated") if one.element == "P1"]
    doubt = f"Known of such meshes: {MESH_DOUBT}" if linear and not held.convergence else ""
    return _sentences(mesh, doubt, _solved(held))


def _solved(held: Holdings) -> str:
    """How far the loads were reached."""
    loads = [(one.name, load, part) for one in held.models for load, part in (one.reached or {}).items()]
    if not loads:
        return ""
    short = ", ".join(f"{model} {load} {100 * part:.0f} %" for model, load, part in loads if part < 1.0)
    reached = f"reached in part: {short}" if short else "all loads reached by all models"
    force = f"{100.0 * Tolerance().force:g} % of those on the plate and the fixed nodes"
    most = f"at most {force}, or ten times that if the iteration stagnates"
    return f"Residual forces at the end of a load: {most}; {reached}"


def _uncertainties(held: Holdings) -> str:
    """Which uncertainties are in the intervals of the comparison."""
    if held.comparison is None:
        return f"Uncertainty of the comparison: {NOT_GIVEN}"
    known = any(not np.isnan(area.low_ml) for area in held.comparison.areas)
    by_input, by_mesh = models_with(held.comparison, "u_input"), models_with(held.comparison, "u_num")
    return _sentences(
        f"Measurement uncertainty: {'in the intervals' if known else NOT_GIVEN}",
        f"Input uncertainty: {_in_intervals(by_input)}", f"Error of the mesh: {_in_intervals(by_mesh)}",
    )  # fmt: skip


def _in_intervals(models: Sequence[str]) -> str:
    return f"in the intervals of {', '.join(models)}" if models else NOT_GIVEN


def _calibration(held: Holdings) -> Table:
    rows = used_for_calibration(held.models)
    by_person = ("Elsewhere", "", held.given.calibration) if held.given.calibration else None
    nothing = ("No calibration data in the records of the models", "", "")
    note = (
        "Found in the records of the models. Bones are rigid in the models, and in the measurement their motion is "
        "removed: agreement at the bone is not evidence. Models that were meshed from the label map of the measurement "
        "share its errors."
    )
    columns = ("data", "used for", "no evidence for")
    return Table("Used for calibration", columns, (*rows, *([by_person] if by_person else [])) or (nothing,), note)


def _applicability(held: Holdings) -> Table:
    steps = {step.name: str(step) for one in held.of_kind("simulated") for step in one.steps}
    loads = "; ".join(f"{load} {steps[load]}" if load in steps else load for load in held.verdicts)
    tissues, strains = "", ""
    if held.comparison is not None:
        tissues = ", ".join(dict.fromkeys(a.tissue for a in held.comparison.areas if a.tissue != ALL))
        strains = "max. shear from {:g} to {:g}".format(*held.comparison.strains)
    rows = (
        ("Loads", _told(loads)), ("Tissues", _told(tissues)), ("Range of strain", _told(strains)),
        ("Subject", _told(held.subject)), ("Context of use, and differences", _told(held.given.applicability)),
    )  # fmt: skip
    return Table("Applicability", ("item", "compared here"), rows)


def _factors(held: Holdings) -> Table:
    """The thirteen credibility factors of ASME V&V 40."""
    given, models = held.given, held.of_kind("simulated", "driven")
    laws = "; ".join(f"{one.name}: {', '.join(f'{r} {law}' for r, law in one.laws.items())}" for one in models)
    titles = "; ".join(dict.fromkeys(f"{one.name}: {one.title}" for one in models if one.title))
    meshes = "; ".join(
        dict.fromkeys(f"{one.element}, {one.mesh or 'mesh of another program'}" for one in models if one.element)
    )
    conditions = "; ".join(dict.fromkeys(f"{step.name} {step}" for one in models for step in one.steps))
    known = held.comparison is not None
    loads = f"{len(held.verdicts)} load{'s' if len(held.verdicts) != 1 else ''}"
    compared = "Strain-volume curves, location above thresholds, and cell by cell; see evidence 4"
    rows = (
        ("Software quality assurance", "Tests with each version; versions and hashes of all inputs in the provenance",
         given.level_software_quality),
        ("Numerical code verification", "See evidence 1", given.level_code_verification),
        ("Discretization error", _sentences(meshes, "See evidence 4"), given.level_discretization_error),
        ("Numerical solver error", "See evidence 4", given.level_solver_error),
        ("Use error", "Inputs are checked before a run; whether a second person checked them is not recorded",
         given.level_use_error),
        ("Model form", _told(laws), given.level_model_form),
        ("Model inputs", _sentences(f"Parameters: {_told(titles)}", f"Loads: {_told(conditions)}"),
         given.level_model_inputs),
        ("Test samples", f"One subject{f' ({held.subject})' if held.subject else ''}; see Acquisition and measurement",
         given.level_test_samples),
        ("Test conditions", f"{loads}: {', '.join(held.verdicts)}", given.level_test_conditions),
        ("Equivalency of input parameters", _equivalent(held), given.level_input_equivalency),
        ("Output comparison", compared if known else NOT_GIVEN, given.level_output_comparison),
        ("Relevance of the quantities of interest", "See Quantities of interest, above",
         given.level_relevance_of_quantities),
        ("Relevance of the validation activities to the context of use", "See Applicability, above",
         given.level_relevance_of_validation),
    )  # fmt: skip
    columns = ("factor", "what this report holds", "level (your judgement)")
    return Table("Credibility factors", columns, tuple((*row[:2], _told(row[2])) for row in rows))


def _equivalent(held: Holdings) -> str:
    """Whether models and measurement had the same inputs, as far as the comparison shows."""
    if held.comparison is None:
        return NOT_GIVEN
    verdict = held.comparison.verdict
    reasons = () if verdict is None or verdict.level == "trust" else verdict.reasons
    doubts = " ".join(alike(reason for reason in reasons if ", registration (" not in reason))  # of the models
    doubts = doubts or "no check found another position, unit or frame"
    return f"Models and measurement in one frame, on the same cells. Inputs of the models: {doubts}"
