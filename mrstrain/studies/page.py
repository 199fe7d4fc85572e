"""The report of a study: verdict, comparison of models, registrations, and the status of each stage."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from dvc import Subject, Verdict
from dvc.atomic_files import write_json
from dvc.errors import MrstrainError
from dvc.io.result_folder import PROVENANCE
from dvc.measurement.page import STRAIN
from dvc.measurement.side_by_side import FIGURE, measured_by_load, on_one_scale
from dvc.report.page import (
    MEASUREMENT,
    METHODS,
    WITH_MODELS,
    Cell,
    Picture,
    Section,
    Table,
    record_lines,
    write_report,
)
from dvc.trust.verdict import worst
from mrstrain.comparison.credibility import TITLE as CREDIBILITY
from mrstrain.comparison.methods import methods_of_registrations
from mrstrain.measurement.acquisition import ACQUIRED, acquisition_section, acquisition_sentence
from mrstrain.measurement.answer import MeasuredBeside, told_once
from mrstrain.options.measurement import MeshAndAxes
from mrstrain.options.modelling import Directions
from mrstrain.records.inputs import read_subject
from mrstrain.records.provenance import provenance, without_folders
from mrstrain.studies.answer import answer_of, comparison_in
from mrstrain.studies.credibility import study_credibility
from mrstrain.studies.file import Study
from mrstrain.studies.pipeline import StageOutcome, left_out_of
from mrstrain.studies.plan import COMPARISON, REGISTRATION
from mrstrain.studies.stages import StageResult
from mrstrain.studies.true_error import error_against_truth
from validate.best_model import without_banner

_BY_A_PERSON = {"acquisition", "credibility"}  # tables of the study file with free text
_OF_A_LOAD = "max. shear, median / 95th percentile:"  # in a line of numbers, which a table or picture shows, too
_RELOAD_S = 10  # a browser shows the page anew, while a study runs


def write_run_report(path: Path, study: Study, outcomes: Mapping[str, StageOutcome]) -> None:
    """Write the report of a study, a self-contained page, and ``provenance.json`` next to it."""
    subject = _subject(study)
    of_loads = _of_loads(study, outcomes, subject)
    registered = [replace(section, title=f"Registration of {section.title}") for section in of_loads]
    compared = [section for one in _of_kind(outcomes, "compare") for section in one.result.sections]
    labelled = [section for one in _of_kind(outcomes, "label") for section in one.result.sections]
    closing = [section for one in outcomes.values() for section in one.result.closing]
    if not closing and registered:  # a study without a comparison gets the methods text of the measurement
        folders = _folders(study, outcomes)
        closing = [Section(METHODS, paragraphs=methods_of_registrations(folders) if folders else ())]
    acquired = acquisition_sentence(_folders(study, outcomes), study.acquisition)
    closing = [_with_acquisition(one, acquired) for one in closing if one.title != CREDIBILITY]
    said = study.model_dump(mode="json", include=_BY_A_PERSON)  # free text, which is no path
    files_of = study.model_dump(mode="json", exclude={"place", *_BY_A_PERSON})
    record = provenance("run", {}, without_folders(files_of, study.place) | said)
    records = {name: outcome.record for name, outcome in outcomes.items() if outcome.record is not None}
    # input files of the results, each once, with their hashes at that time
    files = dict.fromkeys((name, sha) for one in records.values() for name, sha in one.made_from.get("files", []))
    record["inputs"] = {"inputs": [{"name": name, "sha256": sha} for name, sha in files]}
    stages = {name: {"made_utc": one.made_utc, **one.made_from} for name, one in records.items()}
    write_json(path.with_name(PROVENANCE), record | {"stages": stages})
    against_truth = error_against_truth(study, outcomes)
    of_each = [section for section in of_loads if section.title in study.loads]
    pictures = [] if compared or subject is None else _side_by_side(study, outcomes, subject)
    verdict = _verdict([s.verdict.among(s.title) for s in of_loads if s.verdict], compared)
    beside = MeasuredBeside.of(_folders(study, outcomes), study.forces)
    comparison = comparison_in(study.out / COMPARISON) if compared else None
    models = None if comparison is None or (verdict and verdict.level == "distrust") else comparison.banner
    answer = answer_of(of_each, [without_banner(one, models) for one in compared[:1]], comparison, pictures)
    short, answer = told_once(answer, verdict, beside)
    scans = acquisition_section(_folders(study, outcomes), study.acquisition)
    acquisition = [] if scans is None else [scans]
    credibility = study_credibility(study, outcomes)
    others = [*against_truth, *compared[1:], *registered, *labelled, *acquisition, *credibility, _stages(outcomes)]
    sections = [*answer, *(replace(section, folded=True) for section in others)]
    judged = WITH_MODELS if any(one.verdict for one in compared[:1]) else MEASUREMENT
    lines, notes = record_lines(record), _incomplete(outcomes)
    write_report(
        path, study.study.name, verdict, sections, closing, lines, judged=judged, answer=short,
        models=models, notes=notes,
    )  # fmt: skip


def _folders(study: Study, outcomes: Mapping[str, StageOutcome]) -> dict[str, Path]:
    """Folder of each load that was measured."""
    measured = [load for load in study.loads if outcomes[f"register {load}"].record is not None]
    return {load: study.out / REGISTRATION / load for load in measured}


def _with_acquisition(section: Section, acquired: str) -> Section:
    """A methods text with this paragraph on the acquisition, which knows the study file, in place of its own."""
    if section.title != METHODS:
        return section
    others = tuple(one for one in section.paragraphs if not one.startswith(ACQUIRED))
    return replace(section, paragraphs=(acquired, *others) if acquired and others else others)


def write_page_in_progress(
    path: Path, study: Study, stages: Sequence[str], outcomes: Mapping[str, StageOutcome],
    under_way: Sequence[str], told: str, *, ended: bool,
) -> None:  # fmt: skip
    """Write what stands at the report's place while a study runs: each stage, and the loads measured so far.

    A browser loads it anew every few seconds, unless the run has ``ended``. It has one picture for each load, so that
    it costs next to nothing.
    """
    rows = [
        (name, outcomes[name].status, outcomes[name].headline) if name in outcomes
        else (name, "under way" if name in under_way else "waiting", "")
        for name in stages
    ]  # fmt: skip
    measured = (outcomes[name] for load in study.loads if (name := f"register {load}") in outcomes)
    of_loads = [section for one in measured for section in one.result.sections]
    pictures = tuple(picture for section in of_loads for picture in _strain(section))
    sections = [
        *told_once(answer_of(of_loads, (), None, pictures), None)[1],
        Section("Progress", None, (Table("Stages", ("stage", "status", "summary"), tuple(rows)),)),
    ]
    write_report(path, study.study.name, None, sections, (), {}, notes=[told], reload_s=None if ended else _RELOAD_S)


def _of_kind(outcomes: Mapping[str, StageOutcome], kind: str) -> list[StageOutcome]:
    return [one for name, one in outcomes.items() if name.split(" ", 1)[0] == kind]


def _strain(section: Section) -> list[Picture]:
    """The picture of a load's strain, called as the load, with the verdict, and without those beneath it."""
    title = section.title if section.verdict is None else f"{section.title}: {section.verdict.words}"
    return [replace(one, title=title, beneath=()) for one in section.pictures if one.title == STRAIN]


def _subject(study: Study) -> Subject | None:
    """What is drawn below the strain; None if one of its files is missing."""
    onto = study.plate.narrowed(Directions)
    try:
        return read_subject(
            study.path(study.images.load0), study.subject_files, MeshAndAxes(**onto.model_dump()),
            allow_missing=study.images.allow_missing,
        )  # fmt: skip
    except (MrstrainError, OSError):
        return None


def _of_loads(study: Study, outcomes: Mapping[str, StageOutcome], subject: Subject | None) -> list[Section]:
    """The sections of the registrations, their pictures of the strain with one colour scale."""
    of = {name: one for name, one in outcomes.items() if name.startswith("register ")}
    sections = [section for one in of.values() for section in one.result.sections]
    if subject is None:
        return sections
    measured = [name.removeprefix("register ") for name, one in of.items() if one.record is not None]
    return on_one_scale(sections, subject, {name: study.out / REGISTRATION / name for name in measured})


def _side_by_side(study: Study, outcomes: Mapping[str, StageOutcome], subject: Subject) -> list[Picture]:
    """The picture of the measured strain of all loads; none if one of its files is missing."""
    measured = _folders(study, outcomes)
    if not measured:
        return []
    try:
        return [measured_by_load(subject, measured).save(study.out / REGISTRATION / FIGURE)]
    except MrstrainError:
        return []


def _verdict(verdicts: Sequence[Verdict], compared: Sequence[Section]) -> Verdict | None:
    """The worst verdict on the registrations and on the inputs of the comparison; None without a registration.

    Stages that failed or were left out are not considered; see `_incomplete`.
    """
    if not verdicts:
        return None
    inputs = [section.verdict for section in compared[:1] if section.verdict is not None]
    verdict = worst([*verdicts, *inputs])
    if verdict.reasons:
        return verdict
    registrations = {1: "The registration", 2: "Both registrations"}.get(
        len(verdicts), f"All {len(verdicts)} registrations"
    )
    models = " The models are judged below, not here." if compared else ""
    return replace(verdict, reasons=(f"{registrations} passed all checks.{models}",))


def _incomplete(outcomes: Mapping[str, StageOutcome]) -> list[str]:
    """Notes on stages without a complete result, and on those that were not requested."""
    alike: dict[str, list[str]] = {}
    for one in outcomes.values():
        if not (one.complete or one.left_out):
            why = one.why.partition("\n")[0].rstrip(".")
            alike.setdefault(f"{one.status.lower()}" + (f" ({why})" if why else ""), []).append(one.stage)
    incomplete = [f"{', '.join(stages)}: {how}" for how, stages in alike.items()]
    return [*([f"Incomplete: {'; '.join(incomplete)}."] if incomplete else []), *left_out_of(outcomes)]


def _result(of: StageResult) -> tuple[str, ...]:
    """A result for the table of stages: its headline; without a section, also its lines but those of single loads."""
    if of.sections and of.headline:
        return (of.headline,)
    lines = [line for line in of.lines if not (of.headline and _OF_A_LOAD in line)]
    return tuple(dict.fromkeys([*([of.headline] if of.headline else []), *lines]))


def _stages(outcomes: Mapping[str, StageOutcome]) -> Section:
    """Status, time and result of each stage; what a section of the report tells stands there, in one line here."""
    first: dict[str, str] = {}  # the stage that tells a reason
    rows: list[tuple[Cell, ...]] = []
    for name, one in outcomes.items():
        told = first.setdefault(one.reason, name)
        reason = f"Same reason as for {told}." if one.reason and told != name else one.reason
        result = _result(one.result)
        seconds = None if one.record is None else one.record.seconds
        rows.append((name, one.status, seconds, "\n".join((reason, *result)).strip()))
    note = "Wall time of the run that made the result: on one core while other stages ran; of compare, on all cores."
    return Section("Stages", None, (Table("Stages", ("stage", "status", "time, s", "summary"), tuple(rows), note),))
