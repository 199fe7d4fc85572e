"""The report of an accuracy study: tables, figures, and how to read them."""

from collections.abc import Iterator, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import TypeVar

from dvc.report.page import Picture, Section, Table, record_lines, write_report
from dvc.trust.error_model import POOLED
from phantoms import CoverageRow, ErrorRow, FloorRow, ResolutionRow, figures, wavelength_recovered

_R = TypeVar("_R", ErrorRow, ResolutionRow)
_CLOSING = (
    Section(
        "How to read this",
        paragraphs=(
            "Every pair is a synthetic heel whose strain is known at every point. The error is measured minus true: of "
            "the maximum shear strain (E1 - E3)/2 (Green-Lagrange), and of the displacement of tissue relative to its "
            "bone, at one in eight of the heel's voxels.",
            "Motions: still (rigid foot motion only), smooth (a smooth flow), sliding (the fat pad slides between "
            "constrained bone and skin, with a strain discontinuity at both interfaces), Load1 to Load4 (both "
            "combined, as strong as under the forces of the published experiment), wave-L (shear that varies as a "
            "cosine of wavelength L mm). Labels +1 or -1: bones and skin are one voxel too large, or too small, in the "
            "label map that the registration was given.",
            "Spatial resolution is the wavelength at which a given fraction of the strain is recovered. Finer "
            "resolution costs noise, so report both together.",
            "Bias and SD in the error model are conditional on the measured shear. They apply to tissue strained and "
            "imaged like these phantoms; scanner distortion and creep during a scan are not included.",
        ),
    ),
)


def write_accuracy_report(
    path: Path,
    errors: Sequence[ErrorRow],
    floors: Sequence[FloorRow],
    resolution: Sequence[ResolutionRow],
    coverage: Sequence[CoverageRow],
    failures: Mapping[str, str],
    record: Mapping[str, object],
) -> None:
    """Write the report of an accuracy study, one self-contained page."""
    sections = [_condition_section(*of_one) for of_one in _by_condition(errors, floors)]
    if resolution:
        sections.append(_resolution_section(floors, resolution))
    if coverage:
        sections.append(_coverage_section(coverage))
    if failures:
        table = Table("Failures", ("case", "reason"), tuple(failures.items()))
        sections.append(Section("Without a result", tables=(table,)))
    write_report(path, "Accuracy of registration presets", None, sections, _CLOSING, record_lines(record))


def _named(row: ResolutionRow | CoverageRow) -> tuple[str, str, float]:
    return row.preset, f"{row.voxel_mm} mm", row.snr


def _by_condition(rows: Sequence[_R], floors: Sequence[FloorRow]) -> Iterator[tuple[list[_R], list[FloorRow]]]:
    """Rows of one condition, and its noise floor."""
    for condition in dict.fromkeys(r.condition for r in rows):
        yield [r for r in rows if r.condition == condition], [f for f in floors if f.condition == condition]


def _condition_section(errors: Sequence[ErrorRow], floors: Sequence[FloorRow]) -> Section:
    head = ("motion", "tissue", "true shear: median", "p95", "error: bias", "SD", "RMSE", "p95", "u, mm: RMSE", "p95")
    values = attrgetter(
        "tissue", "true_p50", "true_p95", "shear_bias", "shear_sd", "shear_rmse", "shear_p95", "u_rmse_mm", "u_p95_mm"
    )
    rows = tuple((_motion(r), *values(r)) for r in errors if r.by == "all")
    tables = [Table("Error by motion and tissue", head, rows)]
    if floors:
        of_floor = ("tissue", "MAER", "SDER", "apparent shear, median", "p95")
        noise = tuple((f.tissue, f.maer, f.sder, f.shear_p50, f.shear_p95) for f in floors)
        tables.append(Table("Noise floor: apparent strain without load", of_floor, noise))
    pictures = tuple(
        Picture.drawn(f"Error by {by.split(',')[0]}", figures.errors_by_place, errors, by)
        for by in ("distance to bone, mm", "distance to a border, mm", "true maximal shear")
    )
    preset, voxel, snr = errors[0].condition
    return Section(f"{preset}, voxels of {voxel} mm, SNR {snr:g}", tables=tuple(tables), pictures=pictures)


def _motion(row: ErrorRow) -> str:
    return f"{row.motion}, labels {row.labels_off:+d}" if row.labels_off else row.motion


def _coverage_section(rows: Sequence[CoverageRow]) -> Section:
    table = Table(
        "Coverage of the error model",
        ("preset", "voxel", "SNR", "motion", "tissue", "voxels, %", "remaining error, mean", "tissue's figures, %"),
        tuple(
            (*_named(r), r.motion, r.tissue, 100 * r.voxels_within, r.left_over, 100 * r.figures_within) for r in rows
        ),
        "Each heel is compared with a model fitted to the other heels under the same motions. Voxels: truth within "
        "1.96 SD, 95 % if the model is right. Figures: percentiles and volumes within the intervals that `register` "
        "would give.",
    )
    return Section("Does the error model hold?", tables=(table,))


def _resolution_section(floors: Sequence[FloorRow], rows: Sequence[ResolutionRow]) -> Section:
    table_rows = []
    for of_condition, still in _by_condition(rows, floors):
        noise = next(((f.shear_p50, f.maer, f.sder) for f in still if f.tissue == POOLED), (None, None, None))
        wavelengths = [wavelength_recovered(of_condition, fraction) for fraction in (0.9, 0.5)]
        table_rows.append((*_named(of_condition[0]), *wavelengths, *noise))
    columns = ("preset", "voxel", "SNR", "90 % at, mm", "50 % at, mm", "apparent shear, median", "MAER", "SDER")
    pictures = [Picture.drawn("Spatial resolution", figures.resolution, rows)]
    if floors:
        pictures.append(Picture.drawn("Noise against resolution", figures.trade_off, floors, rows, POOLED))
    table = Table("Spatial resolution and noise in soft tissue", columns, tuple(table_rows))
    return Section("Spatial resolution", tables=(table,), pictures=tuple(pictures))
