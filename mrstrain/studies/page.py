"""The report of a study: verdict, models against the measurement, registrations, and how each stage ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from dvc.atomic_files import write_json
from dvc.io.result_folder import PROVENANCE
from dvc.report.page import Section, Table, write_report
from dvc.trust.verdict import Verdict, worst
from mrstrain.comparison.methods import METHODS, methods_of_registrations
from mrstrain.measurement.page import flat
from mrstrain.records.provenance import provenance, without_folders
from mrstrain.studies.file import Study
from mrstrain.studies.ledger import Record
from mrstrain.studies.pipeline import Outcome
from mrstrain.studies.plan import REGISTRATION
from mrstrain.studies.true_error import error_against_truth


def write_run_report(path: Path, study: Study, outcomes: Mapping[str, Outcome]) -> None:
    """Write a study's report, one self-contained page, and what it was made from as ``provenance.json`` beside it."""
    compared: list[Section] = []
    registered: list[Section] = []
    closing: list[Section] = []
    for name, outcome in outcomes.items():
        if outcome.record is None:
            continue
        given = outcome.record.given
        if name.startswith("register "):
            registered += [replace(s, title=f"Registration of {s.title}") for s in given.sections]
        else:
            compared += given.sections
        closing += given.closing
    if not closing and registered:
        closing.append(_methods(study, outcomes))
    record = provenance("run", {}, without_folders(study.model_dump(mode="json", exclude={"place"}), study.place))
    made = {name: o.record for name, o in outcomes.items() if o.record is not None}
    record["inputs"] = {"inputs": _inputs(made)}
    parts = {name: {"made_utc": one.made_utc, **one.made_from} for name, one in made.items()}
    write_json(path.with_name(PROVENANCE), record | {"stages": parts})
    write_report(
        path,
        study.study.name,
        _verdict(registered, compared),
        [*error_against_truth(study, outcomes), *compared, *registered, _stages(outcomes)],
        closing,
        flat(record),
        notes=_lacking(outcomes),
    )


def _inputs(made: Mapping[str, Record]) -> list[dict[str, str]]:
    """Files that the results were made from, with the hashes that they had then."""
    seen = dict.fromkeys((name, sha) for one in made.values() for name, sha in one.made_from.get("files", []))
    return [{"name": name, "sha256": sha} for name, sha in seen]


def _verdict(registered: Sequence[Section], compared: Sequence[Section]) -> Verdict | None:
    """The worst of the registrations', and of what went into the comparison; none where nothing is judged.

    What failed or was left out says nothing about the registrations that are there: `_lacking` tells it.
    """
    judged = [section.verdict for section in registered if section.verdict is not None]
    went_in = [section.verdict for section in compared[:1] if section.verdict is not None]
    if not judged:
        return None
    found = worst([*judged, *(verdict for verdict in went_in if verdict.level != "distrust")])
    if found.reasons:
        return found
    told = "1 image is" if len(judged) == 1 else f"{len(judged)} images are"
    models = " The models are judged below." if compared else ""
    return replace(found, reasons=(f"The measurement: {told} registered soundly.{models}",))


def _lacking(outcomes: Mapping[str, Outcome]) -> list[str]:
    """What a reader would miss: stages that are not whole, and those that were not asked for; a line each."""
    broken = [one for one in outcomes.values() if not (one.whole or one.left_out)]
    left_out = [one.stage for one in outcomes.values() if one.left_out]
    told = []
    for one in broken:
        why = one.reason.partition("\n")[0].removeprefix("Not run: ").rstrip(".")
        told.append(f"{one.stage} {one.words.lower()}" + (f" ({why})" if why else ""))
    lines = [f"Not whole: {'; '.join(told)}."] if told else []
    return [*lines, *([f"Not asked for, and without a result: {', '.join(left_out)}."] if left_out else [])]


def _methods(study: Study, outcomes: Mapping[str, Outcome]) -> Section:
    """Paragraphs on the registrations alone, where no comparison tells how all was done."""
    folders = {load: study.out / REGISTRATION / load for load in study.loads}
    there = {load: at for load, at in folders.items() if outcomes[f"register {load}"].record is not None}
    return Section(METHODS, paragraphs=methods_of_registrations(there) if there else ())


def _stages(outcomes: Mapping[str, Outcome]) -> Section:
    rows = []
    for outcome in outcomes.values():
        record = outcome.record
        told = "\n".join([*([outcome.reason] if outcome.reason else []), *(record.given.lines if record else ())])
        rows.append((outcome.stage, outcome.words, None if record is None else record.seconds, told))
    table = Table(
        "How each stage ended",
        ("stage", "outcome", "seconds", "what it says"),
        tuple(rows),
        "Seconds of the run that made the result, on one core beside other stages.",
    )
    return Section("Stages", None, (table,))
