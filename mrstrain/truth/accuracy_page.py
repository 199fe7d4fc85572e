"""The page of an accuracy study: its tables and figures, and how to read them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from dvc.report.page import Picture, Section, Table, caption_of, write_report
from dvc.trust.error_model import POOLED
from mrstrain.measurement.page import flat
from phantoms import figures
from phantoms.error_model import CoverageRow
from phantoms.error_tables import ErrorRow, FloorRow, ResolutionRow, wavelength_recovered

_CLOSING = (
    Section(
        "How to read this",
        paragraphs=(
            "Every pair is a synthetic heel of which the strain is known at every point. Error is found minus true, of "
            "the maximal shear (E1 - E3)/2 of the Green-Lagrange strain and of the displacement of tissue relative to "
            "its bone, at one in eight of the heel's voxels.",
            "Motions: still (foot moved, no strain), smooth (a flow without jumps of strain), sliding (the fat pad "
            "slides inside bone and skin at rest: strain jumps at both borders), Load1 to Load4 (both together, as "
            "strong as the forces of the published experiment), wave-L (shear that varies as a cosine of wavelength L "
            "mm). Labels +1 or -1: in the label map that the registration was given bones and skin are too large, or "
            "too small, by so many voxels.",
            "Spatial resolution is the wavelength of which a share of the strain is recovered. A smaller wavelength is "
            "bought with more noise: give both, or none.",
            "SD and bias in the error model are given the shear that was found. They hold for tissue strained and "
            "imaged like these phantoms: neither scanner distortion nor creep during a scan is in them.",
        ),
    ),
)


def write_study_report(
    path: Path,
    errors: Sequence[ErrorRow],
    floors: Sequence[FloorRow],
    resolution: Sequence[ResolutionRow],
    coverage: Sequence[CoverageRow],
    failures: dict[str, str],
    record: Mapping[str, object],
) -> None:
    """Write the page, one self-contained file."""
    sections = _sections(errors, floors, resolution, coverage, failures)
    write_report(path, "Accuracy of registration presets", None, sections, _CLOSING, flat(record))


def _sections(
    errors: Sequence[ErrorRow],
    floors: Sequence[FloorRow],
    resolution: Sequence[ResolutionRow],
    coverage: Sequence[CoverageRow],
    failures: dict[str, str],
) -> list[Section]:
    sections = []
    for preset, voxel, snr in dict.fromkeys((r.preset, r.voxel_mm, r.snr) for r in errors):
        rows = [r for r in errors if (r.preset, r.voxel_mm, r.snr) == (preset, voxel, snr)]
        table = Table(
            "Error by motion and tissue",
            ("motion", "tissue", "true shear: median", "p95", "error: bias", "SD", "RMSE", "p95", "u, mm: RMSE", "p95"),
            tuple(
                (
                    _motion(r), r.tissue, r.true_p50, r.true_p95, r.shear_bias, r.shear_sd, r.shear_rmse, r.shear_p95,
                    r.u_rmse_mm, r.u_p95_mm,
                )
                for r in rows
                if r.by == "all"
            ),
        )  # fmt: skip
        pictures = tuple(
            Picture(
                f"Error by {by.split(',')[0]}", caption_of(figures.errors_by_place), figures.errors_by_place(rows, by)
            )
            for by in ("distance to bone, mm", "distance to a border, mm", "true maximal shear")
        )
        zero = [f for f in floors if (f.preset, f.voxel_mm, f.snr) == (preset, voxel, snr)]
        floor = Table(
            "Without strain",
            ("tissue", "MAER", "SDER", "apparent shear, median", "p95"),
            tuple((f.tissue, f.maer, f.sder, f.shear_p50, f.shear_p95) for f in zero),
        )
        tables = (table, floor) if zero else (table,)
        sections.append(Section(f"{preset}, voxels of {voxel} mm, SNR {snr:g}", tables=tables, pictures=pictures))
    if resolution:
        sections.append(_resolution_section(floors, resolution))
    if coverage:
        sections.append(_coverage_section(coverage))
    if failures:
        rows_of = tuple((name, reason) for name, reason in failures.items())
        sections.append(Section("Without a result", tables=(Table("Failures", ("case", "reason"), rows_of),)))
    return sections


def _motion(row: ErrorRow) -> str:
    return f"{row.motion}, labels {row.labels_off:+d}" if row.labels_off else row.motion


def _coverage_section(rows: Sequence[CoverageRow]) -> Section:
    table = Table(
        "How often the truth was where the error model says",
        ("preset", "voxel", "SNR", "motion", "tissue", "voxels, %", "error left over, mean", "tissue's figures, %"),
        tuple(
            (
                r.preset,
                f"{r.voxel_mm} mm",
                r.snr,
                r.motion,
                r.tissue,
                100 * r.voxels_within,
                r.left_over,
                100 * r.figures_within,
            )
            for r in rows
        ),
        "Each heel is judged by a model fitted to the others under the same motions. Voxels: truth within 1.96 SD, "
        "95 % if the model is right. Figures: percentiles and volumes within the intervals that `register` "
        "would give.",
    )
    return Section("Does the error model hold?", tables=(table,))


def _resolution_section(floors: Sequence[FloorRow], rows: Sequence[ResolutionRow]) -> Section:
    told = []
    for preset, voxel, snr in dict.fromkeys((r.preset, r.voxel_mm, r.snr) for r in rows):
        mine = [r for r in rows if (r.preset, r.voxel_mm, r.snr) == (preset, voxel, snr)]
        zero = [f for f in floors if (f.preset, f.voxel_mm, f.snr, f.tissue) == (preset, voxel, snr, POOLED)]
        told.append(
            (
                preset,
                f"{voxel} mm",
                snr,
                wavelength_recovered(mine, 0.9),
                wavelength_recovered(mine, 0.5),
                zero[0].shear_p50 if zero else None,
                zero[0].maer if zero else None,
                zero[0].sder if zero else None,
            )
        )
    columns = ("preset", "voxel", "SNR", "90 % at, mm", "50 % at, mm", "apparent shear, median", "MAER", "SDER")
    pictures = [Picture("Spatial resolution", caption_of(figures.resolution), figures.resolution(rows))]
    if floors:
        pictures.append(
            Picture("Noise against resolution", caption_of(figures.trade_off), figures.trade_off(floors, rows, POOLED))
        )
    table = Table("Spatial resolution and noise in soft tissue", columns, tuple(told))
    return Section("Spatial resolution", tables=(table,), pictures=tuple(pictures))
