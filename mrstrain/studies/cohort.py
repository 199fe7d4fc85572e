"""`cohort`: runs the studies of many subjects on one cluster, with one table and report for all."""

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np

from dvc.atomic_files import write_csv, write_json
from dvc.errors import InputError, few
from dvc.io.result_folder import PROVENANCE, REPEAT, REPORT
from dvc.own_files import read_rows
from dvc.report.drawing import Drawing
from dvc.report.page import Section, Table, record_lines, write_report
from dvc.trust.verdict import worst
from mrstrain.records.inputs import alone, output_folder
from mrstrain.records.outcome import with_reasons
from mrstrain.records.progress import OnProgress
from mrstrain.records.provenance import provenance
from mrstrain.studies.cohort_differences import refuse_other_laws, unlike
from mrstrain.studies.file import FILE, read_study
from mrstrain.studies.plan import COMPARISON
from mrstrain.studies.run import StudyRun, run_studies
from mrstrain.studies.watch import Follower
from validate import ALL, LEVELLED, NOTHING, CohortRank, over_subjects, rank_over_subjects

_TOTAL = "all loads"
_OVER_SUBJECTS = "normalised_area"


@dataclass(frozen=True, slots=True, eq=False)
class Cohort:
    """Result of `cohort`.

    The folder ``out`` has ``report.html``, ``cohort.csv`` (areas by subject, model and load) and ``ranking.csv``.
    """

    out: Path
    ran: tuple[StudyRun, ...]  # in the order given
    ranking: tuple[CohortRank, ...]  # over all loads, the best match first; empty if no subject has all results
    notes: tuple[str, ...]  # subjects left out, differences between subjects, doubtful registrations

    @property
    def complete(self) -> bool:
        """Whether every study is complete."""
        return all(one.complete for one in self.ran)

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        lines = [f"{one.study.study.name}: incomplete, see {one.study.out}" for one in self.ran if not one.complete]
        if self.ranking:
            lines.append("Normalised area of each model, mean over the subjects and 95 % interval:")
        lines += [
            f"{place}. {s.model}: {100 * s.mean:z.2f} % ({100 * s.low:z.2f} to {100 * s.high:z.2f}), best in "
            f"{s.best_in} of {s.subjects} subjects"
            + ("" if place == 1 or s.differs_from_best else "; not distinguishable from rank 1")
            for place, s in enumerate(self.ranking, start=1)
        ]
        return [*lines, *self.notes, f"Report: {self.out / REPORT}"]


def cohort(
    studies: Sequence[Path | str], *, out: Path | str, scheduler: str | None = None, workers: int | None = None,
    progress: OnProgress | None = None,
) -> Cohort:  # fmt: skip
    """Run the studies of many subjects, and rank the models over them.

    Parameters
    ----------
    studies : sequence of path
        Study files or their folders; each with a unique name.
    out : path
        Gets the report and tables of the cohort; each study keeps its own results.
    scheduler, workers, progress
        As in `mrstrain.run`.

    Raises
    ------
    InputError
        If a study cannot be read, two studies have the same name, a material set has different parameters in two
        studies, or no subject has been compared with a model.
    """
    read = [read_study(place) for place in studies]
    names = [study.study.name for study in read]
    if not read or len(set(names)) < len(names):
        raise InputError(f"A cohort needs studies with different names ([study] name); got {few(names) or 'none'}.")
    target = Path(out)
    ranges = {study.compare.strains for study in read}
    if len(ranges) > 1:
        raise InputError(f"The studies have different ranges of strain ([compare] strains): {few(sorted(ranges))}.")
    refuse_other_laws(read)
    with output_folder(target), alone(target):
        ran = run_studies(read, scheduler=scheduler, workers=workers, follower=Follower(progress))
        files = [Path(place) / FILE if Path(place).is_dir() else Path(place) for place in studies]
        return _ranked(dict(zip(names, ran, strict=True)), target, files)


def _ranked(by_name: Mapping[str, StudyRun], target: Path, files: list[Path]) -> Cohort:
    """Rank the models over the studies that ran, by the studies' names, and write tables, report and provenance."""
    without = {name: why for name, one in by_name.items() if (why := _uncounted(one))}
    areas = {name: _areas(one.study.out) for name, one in by_name.items() if name not in without}
    if not any(areas.values()):
        lines = [line for one in by_name.values() for line in one.summary()]
        raise InputError(with_reasons("No subject was compared with a model.", lines))
    shares, notes = _shares(areas)
    notes = [f"{name} is left out: {why}" for name, why in without.items()] + notes
    notes += unlike([by_name[name].study for name in areas])
    for name in dict.fromkeys(subject for of in shares.values() for subject in of):
        verdicts = by_name[name].verdicts.items()
        if doubtful := [load for load, verdict in verdicts if verdict.level == "distrust" and load != REPEAT]:
            notes.append(
                f"{name}: the registration of {', '.join(doubtful)} has the verdict 'Do not trust'; the areas of this "
                "subject are nevertheless included in the ranking. Correct the registration, or leave the subject out."
            )
    try:
        ranking = rank_over_subjects(shares)
    except InputError as none:
        ranking = ()
        notes.append(str(none))
    first = next(row for rows in areas.values() for row in rows)
    rows_of_all = ([subject, *row.values()] for subject, rows in areas.items() for row in rows)
    write_csv(target / "cohort.csv", ["subject", *first], rows_of_all)
    write_csv(target / "ranking.csv", [f.name for f in fields(CohortRank)], map(astuple, ranking))
    write_json(target / PROVENANCE, record := provenance("cohort", {"studies": files}, {"subjects": list(by_name)}))
    sections = _sections(by_name, shares, ranking, notes, target)
    write_report(target / REPORT, "Models over subjects", None, sections, [], record_lines(record))
    return Cohort(target, tuple(by_name.values()), ranking, tuple(notes))


def _uncounted(one: StudyRun) -> str:
    """Why the areas of a study are not ranked; empty if they are.

    Its table may exist nevertheless, from an earlier run with other inputs, if `compare` was not run this time.
    """
    compared = one.outcomes.get("compare")
    if compared is None:
        return "its study has no model to compare ([models] sets, results)."
    return "" if compared.complete else f"compare {compared.told}"


def _areas(out: Path) -> list[dict[str, str]]:
    """The areas of all soft tissue in the results of a study; InputError for a damaged table."""
    path = out / COMPARISON / "areas.csv"
    try:
        rows = [row for row in read_rows(path) if row["tissue"] == ALL]
        for row in rows:
            _ = row["model"], row["load"], *(float(row[name]) for name in ("ml", "share", "estimate_ml"))
    except (OSError, ValueError, KeyError) as damage:
        raise InputError(
            f"{path}: the table of the comparison is damaged ({damage}). Compare again: mrstrain run --force compare."
        ) from damage
    return rows


def _shares(areas: Mapping[str, Sequence[Mapping[str, str]]]) -> tuple[dict[str, dict[str, float]], list[str]]:
    """Normalised area over all loads, by model and subject; and notes.

    The bias of the measurement is removed if the measurement uncertainty is known in every subject; otherwise all areas
    are as measured.
    """
    own = {
        subject: [row for row in rows if row["model"] != NOTHING and not row["model"].endswith(LEVELLED)]
        for subject, rows in areas.items()
    }
    known = all(not np.isnan(float(row["estimate_ml"])) for rows in own.values() for row in rows)
    shares: dict[str, dict[str, float]] = {}
    loads = {subject: frozenset(row["load"] for row in rows) - {_TOTAL} for subject, rows in own.items()}
    for subject, rows in own.items():
        for row in rows:
            if row["load"] != (_TOTAL if len(loads[subject]) > 1 else next(iter(loads[subject]))):
                continue
            found = float(row["ml"])
            scale = float(row["estimate_ml"]) / found if known and found > 0.0 else 1.0
            shares.setdefault(row["model"], {})[subject] = scale * float(row["share"])
    notes = [] if known else ["The measurement uncertainty is unknown in some subjects, so all areas are as measured."]
    rare = {model: of for model, of in shares.items() if 2 * len(of) < len(areas)}
    notes += [
        f"{model} is not ranked: it has an area over all loads in only {len(of)} of {len(areas)} subjects."
        for model, of in rare.items()
    ]
    shares = {model: of for model, of in shares.items() if model not in rare}
    for subject in areas:
        lacking = [model for model, of in shares.items() if subject not in of]
        if lacking:
            notes.append(
                f"{subject} is not used for the ranking: it has no area over all loads of {', '.join(lacking)}."
            )
    if len(set(loads.values())) > 1:
        told = "; ".join(f"{subject}: {', '.join(sorted(of)) or 'none'}" for subject, of in loads.items())
        notes.append(f"Subjects have different loads, so their areas are not comparable: {told}.")
    return shares, notes


def _sections(
    ran: Mapping[str, StudyRun], shares: Mapping[str, Mapping[str, float]], ranking: Sequence[CohortRank],
    notes: Sequence[str], out: Path,
) -> list[Section]:  # fmt: skip
    """Sections of the report: the models over all subjects, with their figure in ``out``, and each subject's status."""
    order = [s.model for s in ranking] or list(shares)
    ranked = Table(
        "Models over all subjects and loads, best first",
        ("model", "normalised area, mean, %", "95 % interval, lower", "upper", "smallest", "largest",
         "best in (subjects)", "subjects", "difference to rank 1, %", "95 % interval, lower", "upper", "significant"),
        tuple(
            (s.model, 100 * s.mean, 100 * s.low, 100 * s.high, 100 * s.least, 100 * s.greatest, s.best_in,
             s.subjects, 100 * s.behind, 100 * s.behind_low, 100 * s.behind_high,
             "–" if at == 0 else "yes" if s.differs_from_best else "no")
            for at, s in enumerate(ranking)
        ),
        "Normalised area: area between the strain-volume curves, divided by the volume of the tissue and the width of "
        "the range of strain. Intervals of the mean are over subjects (Student's t). Intervals of the paired "
        "difference to rank 1 are simultaneous for all models (Tukey); a difference is significant if its interval "
        "excludes zero.",
    )  # fmt: skip
    by_subject = Table(
        "Normalised area by subject, %", ("subject", *order),
        tuple((name, *(100 * shares[m][name] if name in shares[m] else None for m in order)) for name in ran),
    )  # fmt: skip
    rows = [(subject, model, 100.0 * share) for model in order for subject, share in shares[model].items()]
    data = dict(zip(("subject", "model", "normalised_area_percent"), zip(*rows, strict=True), strict=True))
    drawn = Drawing.of("Distribution over subjects", over_subjects, shares, order, data=data).save(out / _OVER_SUBJECTS)
    sections = [Section("Models", None, (ranked, by_subject), (drawn,), tuple(notes))]
    for name, one in ran.items():
        failed = tuple(f"Incomplete: {outcome}" for outcome in one.outcomes.values() if outcome.record is None)
        verdicts = [verdict.among(load) for load, verdict in one.verdicts.items()]
        sections.append(Section(name, worst(verdicts) if verdicts else None, paragraphs=failed))
    return sections
