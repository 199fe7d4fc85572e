"""The report of a study: verdict, models against the measurement, registrations, and how each stage ended."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from dvc import Verdict
from dvc.atomic_files import write_json
from dvc.io.result_folder import PROVENANCE
from dvc.report.page import METHODS, Section, Table, record_lines, write_report
from dvc.trust.verdict import worst
from mrstrain.comparison.methods import methods_of_registrations
from mrstrain.records.provenance import provenance, without_folders
from mrstrain.studies.file import Study
from mrstrain.studies.ledger import StageRecord
from mrstrain.studies.pipeline import StageOutcome
from mrstrain.studies.plan import REGISTRATION
from mrstrain.studies.true_error import error_against_truth


def write_run_report(path: Path, study: Study, outcomes: Mapping[str, StageOutcome]) -> None:
    """Write a study's report, one self-contained page, and ``provenance.json`` beside it."""
    compared: list[Section] = []
    registered: list[Section] = []
    closing: list[Section] = []
    for name, outcome in outcomes.items():
        if outcome.record is None:
            continue
        result = outcome.record.result
        if name.startswith("register "):
            registered += [replace(s, title=f"Registration of {s.title}") for s in result.sections]
        else:
            compared += result.sections
        closing += result.closing
    if not closing and registered:
        closing.append(_methods(study, outcomes))
    record = provenance("run", {}, without_folders(study.model_dump(mode="json", exclude={"place"}), study.place))
    records = {name: outcome.record for name, outcome in outcomes.items() if outcome.record is not None}
    record["inputs"] = {"inputs": _inputs(records)}
    stages = {name: {"made_utc": one.made_utc, **one.made_from} for name, one in records.items()}
    write_json(path.with_name(PROVENANCE), record | {"stages": stages})
    write_report(
        path,
        study.study.name,
        _verdict(registered, compared),
        [*error_against_truth(study, outcomes), *compared, *registered, _stages(outcomes)],
        closing,
        record_lines(record),
        notes=_incomplete(outcomes),
    )


def _inputs(records: Mapping[str, StageRecord]) -> list[dict[str, str]]:
    """Files that the results were made from, each once, with the hashes that they had then."""
    files = dict.fromkeys((name, sha) for one in records.values() for name, sha in one.made_from.get("files", []))
    return [{"name": name, "sha256": sha} for name, sha in files]


def _verdict(registered: Sequence[Section], compared: Sequence[Section]) -> Verdict | None:
    """The worst verdict on the registrations and on the inputs of the comparison; None without a registration.

    Stages that failed or were left out do not count: see `_incomplete`.
    """
    verdicts = [section.verdict for section in registered if section.verdict is not None]
    if not verdicts:
        return None
    inputs = [section.verdict for section in compared[:1] if section.verdict is not None]
    verdict = worst([*verdicts, *(one for one in inputs if one.level != "distrust")])
    if verdict.reasons:
        return verdict
    images = "1 image is" if len(verdicts) == 1 else f"{len(verdicts)} images are"
    models = " The models are judged below." if compared else ""
    return replace(verdict, reasons=(f"The measurement: {images} registered soundly.{models}",))


def _incomplete(outcomes: Mapping[str, StageOutcome]) -> list[str]:
    """Notes on stages without a complete result, and on those that were not requested."""
    incomplete = []
    for one in outcomes.values():
        if not (one.complete or one.left_out):
            why = one.reason.partition("\n")[0].removeprefix("Not run: ").rstrip(".")
            incomplete.append(f"{one.stage} {one.status.lower()}" + (f" ({why})" if why else ""))
    notes = [f"Not whole: {'; '.join(incomplete)}."] if incomplete else []
    left_out = [one.stage for one in outcomes.values() if one.left_out]
    return notes + ([f"Not asked for, and without a result: {', '.join(left_out)}."] if left_out else [])


def _methods(study: Study, outcomes: Mapping[str, StageOutcome]) -> Section:
    """Methods text on the registrations, for a study whose comparison gives none on all stages."""
    folders = {
        load: study.out / REGISTRATION / load for load in study.loads if outcomes[f"register {load}"].record is not None
    }
    return Section(METHODS, paragraphs=methods_of_registrations(folders) if folders else ())


def _stages(outcomes: Mapping[str, StageOutcome]) -> Section:
    rows = []
    for outcome in outcomes.values():
        record = outcome.record
        lines = [*([outcome.reason] if outcome.reason else []), *(record.result.lines if record else ())]
        rows.append((outcome.stage, outcome.status, None if record is None else record.seconds, "\n".join(lines)))
    table = Table(
        "How each stage ended",
        ("stage", "outcome", "seconds", "what it says"),
        tuple(rows),
        "Seconds of the run that made the result, on one core beside other stages.",
    )
    return Section("Stages", None, (table,))
