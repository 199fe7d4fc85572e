"""The credibility section of a study's report: what its stages found, and what its study file gives."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from dvc import Verdict
from dvc.errors import InputError
from dvc.io.images.scan_parameters import read_scan_parameters
from dvc.report.page import Section
from mrstrain.comparison.credibility import Holdings, credibility_section
from mrstrain.comparison.model_facts import facts_of
from mrstrain.options.acquisition import AcquisitionOptions
from mrstrain.options.credibility import CredibilityOptions
from mrstrain.records.provenance import file_hash, read_record
from mrstrain.studies.file import Study
from mrstrain.studies.pipeline import StageOutcome
from mrstrain.studies.plan import COMPARISON, labels_to_mesh, plan
from validate import Comparison

_FILES = ("convergence.json", "*/convergence.json", "*/*/convergence.json")


def study_credibility(study: Study, outcomes: Mapping[str, StageOutcome]) -> list[Section]:
    """The section, if the study has models."""
    if not (study.models.sets or study.models.results):
        return []
    done = [stage for stage in plan(study) if (one := outcomes.get(stage.name)) and one.record is not None]
    folders = {stage.gives[0].name: stage.gives[0] for stage in done if stage.kind in ("simulate", "drive")}
    folders |= {stage.gives[0].parent.name: stage.gives[0].parent for stage in done if stage.kind == "level"}
    folders |= {Path(place).name: study.path(place) for place in study.models.results}
    held = Holdings(
        facts_of(folders), _verdicts(study, outcomes),
        _comparison(study) if any(stage.kind == "compare" for stage in done) else None, convergence_of(study),
        study.study.name, study.credibility,
    )  # fmt: skip
    return [credibility_section(held)]


def details_not_given(study: Study) -> list[str]:
    """A sentence on how many keys of [acquisition] and [credibility] are not given, none of which is required."""
    of_scan = read_scan_parameters(study.path(study.images.load0)).known()
    told = of_scan | study.acquisition.model_dump(exclude_none=True) | study.credibility.model_dump(exclude_none=True)
    keys = {"acquisition": AcquisitionOptions.model_fields, "credibility": CredibilityOptions.model_fields}
    lacking = {table: sum(name not in told for name in names) for table, names in keys.items()}
    counts = [f"{count} of {len(keys[table])} in [{table}]" for table, count in lacking.items() if count]
    if not counts:
        return []
    by_init = "A study file written by `mrstrain init` lists the keys."
    return [f"Optional details of the report that are not given: {', '.join(counts)}. {by_init}"]


def _verdicts(study: Study, outcomes: Mapping[str, StageOutcome]) -> dict[str, Verdict | None]:
    """Verdict on the registration of each load; None without a result."""
    of_loads = {load: outcomes.get(f"register {load}") for load in study.loads}
    return {load: next(iter(one.result.verdicts), None) if one else None for load, one in of_loads.items()}


def _comparison(study: Study) -> Comparison | None:
    try:
        return Comparison.read(study.out / COMPARISON)
    except InputError:
        return None


def convergence_of(study: Study) -> tuple[str, ...]:
    """What `converge` found on the label map that is meshed, a sentence for each run in the folder of the study."""
    labels = labels_to_mesh(study)[0]
    places = sorted(path for pattern in _FILES for path in study.place.glob(pattern))
    if not places or not labels.is_file():
        return ()
    digest = file_hash(labels)
    return tuple(told for path in places if (told := _converged(read_record(path), digest)))


def _converged(record: Mapping[str, Any], labels: str) -> str:
    """A sentence on a run of `converge`; empty for one on other labels, or a record that cannot be used."""
    try:
        if labels not in [file["sha256"] for file in record["inputs"]["labels"]]:
            return ""
        largest: dict[str, float | None] = {}
        for row in record["rows"]:
            quantity, error = str(row.get("quantity", row.get("figure"))), row["limit"]["error"]  # older records
            known = largest.setdefault(quantity, error)
            larger = None not in (known, error) and abs(error) > abs(known or 0.0)
            largest[quantity] = error if error is None or larger else known
        sizes = ", ".join(f"{size:.2f}" for size in record["sizes_mm"])
        errors = "; ".join(f"{f} {'no limit found' if e is None else f'{100 * e:+.1f} %'}" for f, e in largest.items())
        material = record["parameters"]["material"]
    except (LookupError, TypeError, ValueError, AttributeError):
        return ""
    return f"Mesh convergence of {material}, cells of {sizes} mm, largest error of the finest mesh: {errors}."
