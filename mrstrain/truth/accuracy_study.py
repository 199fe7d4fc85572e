"""Result of an accuracy study: its tables, an error model of each preset, and a report that says how to read them."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import phantoms
from dvc import engine_named
from dvc.atomic_files import whole_folder, write_csv, write_json
from dvc.io.result_folder import FIGURES, PROVENANCE, REPORT
from dvc.report.page import record_lines, write_report
from mrstrain.measurement.engines import AT_BONE, GAUSS_NEWTON, WITH_LABELS
from mrstrain.records.provenance import provenance
from mrstrain.truth.accuracy_page import HOW_TO_READ, answers, by_motion, sections_of
from phantoms import CoverageRow, ErrorRow, ErrorSamples, FloorRow, ResolutionRow

_HEELS, _STRAINED = 2, 3  # motions with strain, at least, for an error model


@dataclass(frozen=True, slots=True)
class AccuracyStudy:
    """Result of `accuracy`.

    Attributes
    ----------
    out : Path
        Folder of ``errors.csv``, ``zero_strain.csv``, ``resolution.csv``, ``coverage.csv``, an error model of each
        preset, ``figures`` and ``report.html``.
    errors, floors, resolution, coverage : tuple of rows
        Rows of the tables.
    failures : dict
        Name of each case without a result, and why.
    too_few : tuple of str
        A sentence on the engines that were given too few heels or motions for an error model.
    """

    out: Path
    errors: tuple[ErrorRow, ...]
    floors: tuple[FloorRow, ...]
    resolution: tuple[ResolutionRow, ...]
    coverage: tuple[CoverageRow, ...]
    failures: dict[str, str]
    too_few: tuple[str, ...] = ()

    @classmethod
    def of(cls, out: Path, runs: Sequence[ErrorSamples], failures: dict[str, str]) -> Self:
        """Make the tables of all runs, and write them with error models, provenance and a self-contained report."""
        texts = {preset: engine_named(preset).text for preset in dict.fromkeys(r.case.preset for r in runs)}
        # Folders of parameter files may name a patient: only the samples, from which a study goes on, keep them.
        runs = [replace(r, case=replace(r.case, preset=Path(r.case.preset).name)) for r in runs]
        errors, floors = tuple(phantoms.error_rows(runs)), tuple(phantoms.floor_rows(runs))
        resolution, coverage = tuple(phantoms.resolution_rows(runs)), tuple(phantoms.coverage_rows(runs))
        tables: dict[str, tuple[type[Any], Sequence[Any]]] = {
            "errors": (ErrorRow, errors),
            "zero_strain": (FloorRow, floors),
            "resolution": (ResolutionRow, resolution),
            "coverage": (CoverageRow, coverage),
            "runs": (phantoms.RunRow, phantoms.run_rows(runs)),
        }
        for name, (kind, rows) in tables.items():
            write_csv(out / f"{name}.csv", [f.name for f in fields(kind)], map(astuple, rows))
        presets = {Path(preset).name: text for preset, text in texts.items()}
        for preset, text in presets.items():
            some = [r for r in runs if r.case.preset == preset and r.case.keeps_volume and r.case.wavelength_mm is None]
            if some:
                model = phantoms.fit_error_model(some, text, _source(some))
                model.write(out / f"error_model_{Path(preset).stem}.json")
        seconds = {r.case.name: round(r.seconds, 1) for r in runs}
        about = {"cases": list(seconds), "failures": failures, "presets": presets, "seconds_of_registration": seconds}
        record = provenance("accuracy", {}, about)
        write_json(out / PROVENANCE, record)
        few = _too_few(runs)
        study = cls(out, errors, floors, resolution, coverage, failures, few)
        with whole_folder(out / FIGURES) as folder:
            sections = sections_of(errors, floors, resolution, coverage, failures, folder, doubts=few)
        notes = [f"Incomplete: {len(failures)} of {len(runs) + len(failures)} cases failed."] if failures else []
        notes += [*([] if coverage else few), *study.one_spline]
        title, lines = "Accuracy of registration engines", record_lines(record)
        write_report(out / REPORT, title, None, sections, [HOW_TO_READ], lines, notes=notes)
        return study

    @property
    def complete(self) -> bool:
        """Whether no case failed."""
        return not self.failures

    @property
    def one_spline(self) -> list[str]:
        """A sentence if the Gauss-Newton engine was measured, but not as `register` uses it by default."""
        measured = {row.preset for row in (*self.errors, *self.resolution)}
        if GAUSS_NEWTON not in measured or measured & {AT_BONE, WITH_LABELS}:
            return []
        return [
            f"{GAUSS_NEWTON} fits one smooth spline, as `register --no-borders` does. By default, `register` uses "
            f"{AT_BONE}, or {WITH_LABELS} with a label map; measure their error with `--preset`."
        ]

    def summary(self) -> list[str]:
        """Summary, a few lines: the answer of the report first."""
        lines = answers(self.errors, self.floors) + self.one_spline
        lines += by_motion(self.errors)
        lines += [f"{name}: FAILED. {reason}" for name, reason in self.failures.items()]
        return [*lines, *self.too_few, f"Report: {self.out / REPORT}"]


def _too_few(runs: Sequence[ErrorSamples]) -> tuple[str, ...]:
    """A sentence on the engines with too few heels, or motions with strain, for an error model."""
    found: dict[tuple[int, int], list[str]] = {}
    for preset in dict.fromkeys(r.case.preset for r in runs):
        strained = [r.case for r in runs if r.case.preset == preset and r.case.motion != "still"]
        heels, motions = (len({getattr(case, of) for case in strained}) for of in ("seed", "motion"))
        if heels < _HEELS or motions < _STRAINED:
            found.setdefault((heels, motions), []).append(preset)
    return tuple(
        f"{', '.join(presets)}: do not rely on the error model; its intervals may contain far fewer than 95 % of the "
        f"true values (coverage.csv). It needs {_HEELS} heels and {_STRAINED} motions with strain or more; this study "
        f"has {heels} and {motions}."
        for (heels, motions), presets in found.items()
    )


def _source(runs: Sequence[ErrorSamples]) -> str:
    """A sentence on the registrations that an error model is fitted to."""
    seeds = sorted({r.case.seed for r in runs})
    motions = ", ".join(dict.fromkeys(r.case.motion for r in runs))
    source = f"{len(runs)} registrations of phantom heels, seeds {seeds}, motions {motions}"
    if any(r.case.labels_off for r in runs):
        off = ", ".join(f"{by:+d}" for by in sorted({r.case.labels_off for r in runs}))
        source += f", bones and skin in label maps or masks too large by {off} voxels"
    return source
