"""The report of a study: verdict, models against the measurement, registrations, and how each stage ended."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from dvc.report import Section, Table, write_report
from dvc.verdict import Verdict, worst
from mrstrain.ledger import Record
from mrstrain.page import flat
from mrstrain.pipeline import Outcome
from mrstrain.provenance import provenance, write_json
from mrstrain.studyfile import Study


def write_run_report(
    path: Path,
    study: Study,
    outcomes: Mapping[str, Outcome],
    ahead: Sequence[Section] = (),
) -> None:
    """Write a study's report, one self-contained page, and what it was made from as ``provenance.json`` beside it.

    ``ahead`` are sections that come first.
    """
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
    verdicts = [section.verdict for section in (*registered, *compared[:1]) if section.verdict is not None]
    failed = [f"{o.stage} {o.words.lower()}: {o.reason}" for o in outcomes.values() if o.record is None or o.reason]
    if failed:
        verdicts.append(Verdict("distrust", tuple(failed)))
    record = provenance("run", {}, study.model_dump(mode="json", exclude={"place"}))
    made = {name: o.record for name, o in outcomes.items() if o.record is not None}
    record["inputs"] = {"inputs": _inputs(made)}
    parts = {name: {"made_utc": one.made_utc, **one.made_from} for name, one in made.items()}
    write_json(path.with_name("provenance.json"), record | {"stages": parts})
    write_report(
        path,
        study.study.name,
        _verdict(verdicts),
        [*ahead, *compared, *registered, _stages(outcomes)],
        closing,
        flat(record),
    )


def _inputs(made: Mapping[str, Record]) -> list[dict[str, str]]:
    """Files that the results were made from, with the hashes that they had then."""
    seen = dict.fromkeys((name, sha) for one in made.values() for name, sha in one.made_from.get("files", []))
    return [{"name": name, "sha256": sha} for name, sha in seen]


def _verdict(verdicts: Sequence[Verdict]) -> Verdict | None:
    """The worst of all, saying what a good one is about: the measurement, and not the models."""
    if not verdicts:
        return None
    found = worst(verdicts)
    told = f"The measurement: {len(verdicts)} images are registered soundly. The models are judged below."
    return found if found.reasons else replace(found, reasons=(told,))


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
