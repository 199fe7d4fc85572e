"""Result of an accuracy study: its tables, an error model of each preset, and a report that says how to read them."""

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, fields, replace
from operator import attrgetter
from pathlib import Path
from typing import Any, Self, TypeVar

import phantoms
from dvc import engine_named
from dvc.atomic_files import whole_folder, write_csv, write_json
from dvc.io.result_folder import FIGURES, PROVENANCE, REPORT
from dvc.report.drawing import Drawing
from dvc.report.page import Cell, Section, Table, record_lines, write_report
from dvc.trust.error_model import POOLED
from mrstrain.records.provenance import provenance
from phantoms import CoverageRow, ErrorRow, ErrorSamples, FloorRow, ResolutionRow, figures, wavelength_recovered

_R = TypeVar("_R", ErrorRow, ResolutionRow)
_CONDITION = ("preset", "voxel, mm", "SNR")
_PLACES = {
    "error_by_distance_to_bone": "distance to bone, mm",
    "error_by_distance_to_interface": "distance to a border, mm",
    "error_by_strain": "true maximum shear strain",
}
"""Stems of the files of figures, and what the errors are shown by there."""
_HOW_TO_READ = (
    "Every pair is a synthetic heel whose strain is known at every point. The error is measured minus true: of the "
    "maximum shear strain (E1 - E3)/2 (Green-Lagrange), and of the displacement of tissue relative to its bone, at one"
    " in eight of the heel's voxels.",
    "Motions: still (rigid foot motion only), smooth (a smooth flow), sliding (the fat pad slides between constrained "
    "bone and skin, with a strain discontinuity at both interfaces), Load1 to Load4 (both combined, as strong as under"
    " the forces of the published experiment), wave-L (shear that varies as a cosine of wavelength L mm). Labels +1 or"
    " -1: bones and skin are one voxel too large, or too small, in the label map that the registration was given.",
    "Spatial resolution is the wavelength at which a given fraction of the strain is recovered. A finer resolution "
    "means more noise, so report both.",
    "Bias and SD in the error model are conditional on the measured shear. They apply to tissue strained and imaged "
    "like these phantoms; scanner distortion and creep during a scan are not included.",
)


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
    """

    out: Path
    errors: tuple[ErrorRow, ...]
    floors: tuple[FloorRow, ...]
    resolution: tuple[ResolutionRow, ...]
    coverage: tuple[CoverageRow, ...]
    failures: dict[str, str]

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
        study = cls(out, errors, floors, resolution, coverage, failures)
        title, closing = "Accuracy of registration presets", (Section("How to read this", paragraphs=_HOW_TO_READ),)
        with whole_folder(out / FIGURES) as folder:
            sections = study._sections(folder)
        write_report(out / REPORT, title, None, sections, closing, record_lines(record))
        return study

    @property
    def complete(self) -> bool:
        """Whether no case failed."""
        return not self.failures

    def summary(self) -> list[str]:
        """Summary, a few lines."""
        lines = [
            f"{r.preset}, {r.voxel_mm} mm, SNR {r.snr:g}, {r.motion}, {r.tissue}: max. shear RMSE "
            f"{r.shear_rmse:.4f}, bias {r.shear_bias:+.4f}; displacement RMSE {r.u_rmse_mm:.3f} mm"
            for r in self.errors
            if r.by == "all" and r.tissue == "fat"
        ]
        lines += [f"{name}: FAILED. {reason}" for name, reason in self.failures.items()]
        return [*lines, f"Report: {self.out / REPORT}"]

    def _sections(self, folder: Path) -> list[Section]:
        """The report's sections; their figures are written to a folder."""
        sections = [_condition_section(*of_one, folder) for of_one in _by_condition(self.errors, self.floors)]
        if self.resolution:
            sections.append(_resolution_section(self.floors, self.resolution, folder))
        if self.coverage:
            sections.append(_coverage_section(self.coverage))
        if self.failures:
            table = Table("Failures", ("case", "reason"), tuple(self.failures.items()))
            sections.append(Section("Failed cases", tables=(table,)))
        return sections


def _source(runs: Sequence[ErrorSamples]) -> str:
    """A sentence on the registrations that an error model is fitted to."""
    seeds = sorted({r.case.seed for r in runs})
    motions = ", ".join(dict.fromkeys(r.case.motion for r in runs))
    source = f"{len(runs)} registrations of phantom heels, seeds {seeds}, motions {motions}"
    if any(r.case.labels_off for r in runs):
        off = ", ".join(f"{by:+d}" for by in sorted({r.case.labels_off for r in runs}))
        source += f", bones and skin in label maps too large by {off} voxels"
    return source


_OF_ERRORS = (
    "Error: measured minus true maximum shear strain (SD: standard deviation, RMSE: root mean square, p95: 95th "
    "percentile of its magnitude). u: displacement; its error in mm."
)
_OF_FLOOR = (
    "MAER is the mean over voxels of the mean absolute value of the six strain components; SDER is its standard "
    "deviation over voxels."
)


def _by_condition(rows: Sequence[_R], floors: Sequence[FloorRow]) -> Iterator[tuple[list[_R], list[FloorRow]]]:
    """Rows of one condition, and its noise floor."""
    for condition in dict.fromkeys(r.condition for r in rows):
        yield [r for r in rows if r.condition == condition], [f for f in floors if f.condition == condition]


def _condition_section(errors: Sequence[ErrorRow], floors: Sequence[FloorRow], folder: Path) -> Section:
    head = ("motion", "tissue", "true shear: median", "p95", "error: bias", "SD", "RMSE", "p95", "u, mm: RMSE", "p95")
    values = attrgetter(
        "tissue", "true_p50", "true_p95", "shear_bias", "shear_sd", "shear_rmse", "shear_p95", "u_rmse_mm", "u_p95_mm"
    )
    labels = {off: f", labels {off:+d}" if off else "" for off in {r.labels_off for r in errors}}
    rows = tuple((r.motion + labels[r.labels_off], *map(_told, values(r))) for r in errors if r.by == "all")
    tables = [Table("Error by motion and tissue", head, rows, _OF_ERRORS)]
    if floors:
        of_floor = ("tissue", "MAER", "SDER", "apparent shear, median", "p95")
        floor = attrgetter("tissue", "maer", "sder", "shear_p50", "shear_p95")
        noise = tuple(tuple(map(_told, floor(f))) for f in floors)
        tables.append(Table("Noise floor: apparent strain between two unloaded scans", of_floor, noise, _OF_FLOOR))
    preset, voxel, snr = errors[0].condition
    pictures = []
    for stem, by in _PLACES.items():
        pooled = figures.pooled_errors(errors, by)
        columns = (by.replace(", mm", "_mm").replace(" ", "_"), "max_shear_rmse", "max_shear_bias")
        data = dict(zip(("tissue", *columns), zip(*pooled, strict=True) if pooled else ((),) * 4, strict=True))
        title = f"Error by {figures.words(by).split(',')[0]}"
        drawing = Drawing.of(title, figures.errors_by_place, pooled, by, data=data)
        where = f"{Path(preset).stem}_{voxel.replace(' ', '')}mm_snr{snr:g}"
        pictures.append(drawing.save(folder / f"{stem}_{where}"))
    return Section(f"{preset}, voxels of {voxel} mm, SNR {snr:g}", tables=tuple(tables), pictures=tuple(pictures))


def _told(cell: Cell) -> Cell:
    """A strain, or a length in mm, to three decimals: what is smaller is of no interest."""
    return round(cell, 3) if isinstance(cell, float) else cell


def _coverage_section(rows: Sequence[CoverageRow]) -> Section:
    table = Table(
        "Coverage of the error model",
        (*_CONDITION, "motion", "tissue", "voxels covered, %", "remaining error, mean", "figures covered, %"),
        tuple(
            (*r.condition, r.motion, r.tissue, 100 * r.voxels_within, r.left_over, 100 * r.figures_within) for r in rows
        ),
        "Each heel is compared with a model fitted to the other heels under the same motions. Voxels covered: truth "
        "within 1.96 SD; 95 % if the model is correct. Figures covered: percentiles and volumes of the tissue within "
        "the intervals that `register` would give.",
    )
    return Section("Validation of the error model", tables=(table,))


def _resolution_section(floors: Sequence[FloorRow], rows: Sequence[ResolutionRow], folder: Path) -> Section:
    table_rows = []
    for of_condition, still in _by_condition(rows, floors):
        noise = next(((f.shear_p50, f.maer, f.sder) for f in still if f.tissue == POOLED), (None, None, None))
        wavelengths = [wavelength_recovered(of_condition, fraction) for fraction in (0.9, 0.5)]
        table_rows.append((*of_condition[0].condition, *wavelengths, *noise))
    columns = (*_CONDITION, "90 % at, mm", "50 % at, mm", "apparent shear, median", "MAER", "SDER")
    drawings = {"resolution": Drawing.of("Spatial resolution", figures.resolution, rows)}
    if known := figures.noise_and_resolution(floors, rows, POOLED):
        names = ("condition", "wavelength_recovered_to_90_percent_mm", "max_shear_without_load")
        data = dict(zip(names, zip(*known, strict=True), strict=True))
        drawing = Drawing.of("Noise against resolution", figures.trade_off, known, POOLED, data=data)
        drawings["noise_and_resolution"] = drawing
    pictures = [drawing.save(folder / stem) for stem, drawing in drawings.items()]
    table = Table("Spatial resolution and noise in soft tissue", columns, tuple(table_rows), _OF_FLOOR)
    return Section("Spatial resolution", tables=(table,), pictures=tuple(pictures))
