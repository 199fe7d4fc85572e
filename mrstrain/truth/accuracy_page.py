"""The page of an accuracy study: the errors at its usual condition first, then every table, folded."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from pathlib import Path
from typing import TypeVar

import numpy as np

from dvc.registration.engines import ENGINES
from dvc.report.alike import listed
from dvc.report.drawing import Drawing
from dvc.report.page import Cell, Picture, Section, Table
from dvc.trust.error_model import POOLED
from mrstrain.measurement.engines import GAUSS_NEWTON
from phantoms import CoverageRow, ErrorRow, FloorRow, ResolutionRow, figures, wavelength_recovered

_R = TypeVar("_R", ErrorRow, ResolutionRow)
_Condition = tuple[str, str, float]
_USUAL = ("0.8", 25.0)
"""Voxel size (mm) and SNR that a page begins with, or the condition of the study that shares most of them."""
_TISSUES = ("fat", "muscle", "skin")
_CONDITION = ("preset", "voxel, mm", "SNR")
_PLACES = {
    "error_by_strain": "true maximum shear strain",
    "error_by_distance_to_bone": "distance to bone, mm",
    "error_by_distance_to_interface": "distance to a border, mm",
}
"""Stems of the files of figures, and what the errors are shown by there; the first stands on the first screen."""
_OF_ANSWER = (
    "Max. shear: maximum shear strain (E₁ − E₃)/2 (Green-Lagrange), no unit. Error: measured minus true, over all "
    "motions with strain (RMSE: root mean square error). Noise floor: max. shear measured between two unloaded images."
)
_OF_ERRORS = (
    "Error: measured minus true maximum shear strain (SD: standard deviation, RMSE: root mean square, p95: 95th "
    "percentile of its magnitude)."
)
_OF_FLOOR = (
    "MAER is the mean over voxels of the mean absolute value of the six strain components; SDER is its standard "
    "deviation over voxels."
)
_OF_LENGTHS = (
    "Wavelengths, to the nearest mm, are interpolated between those of the study (resolution.csv); a dash where even "
    "the longest recovers less, or even the shortest more."
)
HOW_TO_READ = Section(
    "How to read this",
    paragraphs=(
        "Every pair shows a phantom heel whose strain is known at every point. The error is measured minus true: of "
        "the maximum shear strain (E1 - E3)/2 (Green-Lagrange), and of the displacement of tissue relative to its "
        "bone, at one in eight of the heel's voxels.",
        "Motions: still (rigid foot motion only), smooth (a smooth flow), sliding (the fat pad slides between "
        "constrained bone and skin, with a strain discontinuity at both interfaces), Load1 to Load4 (both combined, as "
        "strong as under the forces of the published experiment), attached-Load1 and attached-Load3 (tissue attached "
        "to bone, where its strain is largest), wave-L (shear that varies as a cosine of wavelength L mm). Labels 1 "
        "voxel too large or too small: the registration was given a label map in which bones and skin are so much too "
        "large or too small, or such a mask of the bone.",
        "Spatial resolution is the wavelength at which a given fraction of the strain is recovered. A finer resolution "
        "means more noise, so report both.",
        "Bias and SD in the error model are conditional on the measured shear. They apply to tissue strained and "
        "imaged like these phantoms; scanner distortion and creep during a scan are not included.",
    ),
)


def sections_of(
    errors: Sequence[ErrorRow], floors: Sequence[FloorRow], resolution: Sequence[ResolutionRow],
    coverage: Sequence[CoverageRow], failures: Mapping[str, str], folder: Path, *, doubts: Sequence[str] = (),
) -> list[Section]:  # fmt: skip
    """Sections of the page: the answer, then all else, folded. Their figures are written to a folder.

    ``doubts`` are sentences on the error models, shown in the section on their validation.
    """
    by_condition = {of[0].condition: of for of, _ in _by_condition(errors, floors)}
    pictures = {condition: _pictures(condition, rows, folder) for condition, rows in by_condition.items()}
    answer, others = [], []
    if by_condition:
        usual = _usual(by_condition)
        answer = [_answer(usual, by_condition, floors, tuple(pictures[usual][:1]))]
        pictures[usual] = pictures[usual][1:]
    for rows, still in _by_condition(errors, floors):
        others.append(_condition_section(rows, still, pictures[rows[0].condition]))
    if resolution:
        others.append(_resolution_section(floors, resolution, folder))
    if coverage:
        others.append(replace(_coverage_section(coverage), paragraphs=tuple(doubts)))
    if failures:
        others.append(Section("Failed cases", tables=(Table("Failures", ("case", "reason"), tuple(failures.items())),)))
    return [*answer, *(replace(section, folded=bool(answer)) for section in others)]


def _answer(
    usual: _Condition, by_condition: Mapping[_Condition, Sequence[ErrorRow]], floors: Sequence[FloorRow],
    pictures: tuple[Picture, ...],
) -> Section:  # fmt: skip
    """A sentence, the figure of errors and a row for each tissue at one condition, then a row for each condition."""
    still = {floor.tissue: (floor.shear_p50, floor.shear_p95) for floor in floors if floor.condition == usual}
    errors = {tissue: _over_motions(by_condition[usual], tissue) for tissue in _TISSUES}
    rows = tuple(
        (t, *map(_told, (*errors[t][:2], *still.get(t, (None, None)), errors[t][2])))
        for t in _TISSUES
        if errors[t][0] is not None or t in still
    )
    columns = ("tissue", "error: RMSE", "bias", "noise floor: median", "p95", "displacement error: RMSE, mm")
    preset, voxel, snr = usual
    of_usual = f"Error of the max. shear by tissue: {preset}, voxels of {voxel} mm, SNR {snr:g}"
    tables = [Table(of_usual, columns, rows, _OF_ANSWER)]
    if len(by_condition) > 1:
        tables.insert(0, _compared(by_condition, floors))
    return Section(
        "Error of the maximum shear strain", tables=tuple(tables), pictures=pictures,
        paragraphs=(_sentence(usual, by_condition[usual], floors),), pictures_first=True,
    )  # fmt: skip


def _compared(by_condition: Mapping[_Condition, Sequence[ErrorRow]], floors: Sequence[FloorRow]) -> Table:
    """RMSE and noise floor of each preset at each voxel size and SNR, by tissue."""
    noise = {(floor.condition, floor.tissue): floor.shear_p50 for floor in floors}

    def told(condition: _Condition, tissue: str) -> Cell:
        error, of_noise = _over_motions(by_condition[condition], tissue)[0], noise.get((condition, tissue))
        return _told(error) if error is None or of_noise is None else f"{error:.3f} ({of_noise:.3f})"

    rows = tuple((*one, *(told(one, tissue) for tissue in _TISSUES)) for one in by_condition)
    brackets = "In brackets: noise floor (median), where there is a pair without strain." if noise else ""
    return Table("RMSE of the max. shear by preset, voxel size and SNR", (*_CONDITION, *_TISSUES), rows, brackets)


def answers(errors: Sequence[ErrorRow], floors: Sequence[FloorRow]) -> list[str]:
    """The sentence that a page begins with, and the same for other presets at that voxel size and SNR."""
    conditions = [of[0].condition for of, _ in _by_condition(errors, floors)]
    if not conditions:
        return []
    usual = _usual(conditions)
    beside = [one for one in conditions if one[1:] == usual[1:] and one != usual]
    return [_sentence(one, [r for r in errors if r.condition == one], floors) for one in (usual, *beside)]


def by_motion(errors: Sequence[ErrorRow]) -> list[str]:
    """The RMSE of the max. shear (its bias) in each tissue, a line for each condition and motion."""
    told: dict[tuple[_Condition, str], list[str]] = {}
    for row in errors:
        if row.by == "all" and row.tissue in _TISSUES:
            words = f"{row.tissue} {row.shear_rmse:.3f} ({row.shear_bias:+.3f})"
            told.setdefault((row.condition, motion_of(row)), []).append(words)
    return [
        f"{preset}, {voxel} mm, SNR {snr:g}, {motion}: RMSE of the max. shear (bias): {', '.join(of)}"
        for ((preset, voxel, snr), motion), of in told.items()
    ]


def _usual(conditions: Iterable[_Condition]) -> _Condition:
    """The condition that a page begins with."""
    voxel, snr = _USUAL
    return max(conditions, key=lambda one: (one[0] in ENGINES, one[1] == voxel, one[2] == snr))


def _sentence(condition: _Condition, errors: Sequence[ErrorRow], floors: Sequence[FloorRow]) -> str:
    """The error of each tissue, with its range over motions, and the noise floor at one condition, in one sentence."""
    preset, voxel, snr = condition
    motions = {row.motion for row in errors if row.motion != "still"}
    error = []
    for tissue in _TISSUES:
        mean = _over_motions(errors, tissue)[0]
        if mean is not None:
            each = [_over_motions([row for row in errors if row.motion == one], tissue)[0] for one in motions]
            known = [one for one in each if one is not None]
            spread = f" ({min(known):.3f} to {max(known):.3f})" if len(known) > 1 else ""
            error.append(f"{mean:.3f}{spread} in {tissue}")
    floor = [f"{f.shear_p50:.3f} in {f.tissue}" for f in floors if f.condition == condition and f.tissue in _TISSUES]
    over = f" over {len(motions)} motions, with their range" if len(motions) > 1 else ""
    told = [f"the max. shear has an error (RMSE{over}) of {listed(error)}"] if error else []
    told += [f"the noise floor (median) is {listed(floor)}"] if floor else []
    labels = " (one smooth spline)" if preset == GAUSS_NEWTON else ""
    return f"With {preset}{labels}, voxels of {voxel} mm and SNR {snr:g}, {'; '.join(told)}."


def _over_motions(rows: Sequence[ErrorRow], tissue: str) -> tuple[float | None, float | None, float | None]:
    """RMSE and bias of the max. shear and RMSE of the displacement (mm) in a tissue, over all motions with strain."""
    of = [row for row in rows if row.tissue == tissue and row.by == "all" and row.motion != "still"]
    if not of:
        return None, None, None
    values = np.array([(row.shear_rmse**2, row.shear_bias, row.u_rmse_mm**2) for row in of])
    shear, bias, u = np.average(values, axis=0, weights=[row.samples for row in of])
    return float(np.sqrt(shear)), float(bias), float(np.sqrt(u))


def _by_condition(rows: Sequence[_R], floors: Sequence[FloorRow]) -> Iterator[tuple[list[_R], list[FloorRow]]]:
    """Rows of one condition, and its noise floor."""
    for condition in dict.fromkeys(r.condition for r in rows):
        yield [r for r in rows if r.condition == condition], [f for f in floors if f.condition == condition]


def motion_of(row: ErrorRow) -> str:
    """The motion of errors, with the voxels by which the label map or bone mask was too large or too small."""
    size = "large" if row.labels_off > 0 else "small"
    return row.motion + (f", labels {abs(row.labels_off)} voxel too {size}" if row.labels_off else "")


def _condition_section(errors: Sequence[ErrorRow], floors: Sequence[FloorRow], pictures: Sequence[Picture]) -> Section:
    head = (
        "motion", "tissue", "true max. shear: median", "true max. shear: p95", "error: bias", "error: SD",
        "error: RMSE", "error: p95", "displacement error, mm: RMSE", "displacement error, mm: p95",
    )  # fmt: skip
    values = attrgetter(
        "tissue", "true_p50", "true_p95", "shear_bias", "shear_sd", "shear_rmse", "shear_p95", "u_rmse_mm", "u_p95_mm"
    )
    rows = tuple((motion_of(r), *map(_told, values(r))) for r in errors if r.by == "all")
    tables = [Table("Error by motion and tissue", head, rows, _OF_ERRORS)]
    if floors:
        of_floor = ("tissue", "MAER", "SDER", "apparent max. shear, median", "apparent max. shear, p95")
        floor = attrgetter("tissue", "maer", "sder", "shear_p50", "shear_p95")
        noise = tuple(tuple(map(_told, floor(f))) for f in floors)
        tables.append(Table("Noise floor: apparent strain between two unloaded images", of_floor, noise, _OF_FLOOR))
    preset, voxel, snr = errors[0].condition
    title = f"By motion and tissue: {preset}, voxels of {voxel} mm, SNR {snr:g}"
    return Section(title, tables=tuple(tables), pictures=tuple(pictures), pictures_first=True)


def _pictures(condition: _Condition, errors: Sequence[ErrorRow], folder: Path) -> list[Picture]:
    """Figures of one condition, written to a folder; none of errors in too few samples."""
    preset, voxel, snr = condition
    pictures = []
    for stem, by in _PLACES.items():
        if not (pooled := figures.pooled_errors(errors, by)):
            continue
        columns = (by.replace(", mm", "_mm").replace(" ", "_"), "max_shear_rmse", "max_shear_bias")
        data = dict(zip(("tissue", *columns), zip(*pooled, strict=True), strict=True))
        title = f"Error by {figures.words(by).split(',')[0]}"
        drawing = Drawing.of(title, figures.errors_by_place, pooled, by, data=data)
        where = f"{Path(preset).stem}_{voxel.replace(' ', '')}mm_snr{snr:g}"
        pictures.append(drawing.save(folder / f"{stem}_{where}"))
    return pictures


def _told(cell: Cell) -> Cell:
    """A strain, or a length in mm, to three decimals: what is smaller is of no interest."""
    return round(cell, 3) if isinstance(cell, float) else cell


def _whole_mm(length: float) -> int | None:
    return round(length) if np.isfinite(length) else None


def _coverage_section(rows: Sequence[CoverageRow]) -> Section:
    shares = "voxels", "normal strain", "shear strain", "displacement", "statistics"
    columns = *_CONDITION, "motion", "tissue", "remaining error, mean", *(f"{name}, %" for name in shares)

    def cells(r: CoverageRow) -> tuple[Cell, ...]:
        strains = r.voxels_within, r.normal_strain_within, r.shear_strain_within
        within = *strains, r.displacement_within, r.statistics_within
        return (*r.condition, r.motion, r.tissue, r.left_over, *(100 * share for share in within))

    note = (
        "Leave-one-motion-out validation: the error model is fitted to the other motions and tested on this one. "
        "Columns give the percentage of voxels (max. shear within 1.96 SD), of components of strain and displacement, "
        "or of the tissue's percentiles and volumes (within the intervals that `register` would give) whose true value "
        "lies within its 95 % interval; 95 % is expected."
    )
    table = Table("Coverage of the error model", columns, tuple(cells(row) for row in rows), note)
    return Section("Validation of the error model", tables=(table,))


def _resolution_section(floors: Sequence[FloorRow], rows: Sequence[ResolutionRow], folder: Path) -> Section:
    table_rows = []
    for of_condition, still in _by_condition(rows, floors):
        for tissue in (*_TISSUES, POOLED):
            of_tissue = [row for row in of_condition if row.tissue == tissue]
            lengths = [_whole_mm(wavelength_recovered(of_tissue, fraction)) for fraction in (0.9, 0.5)]
            noise = next(((f.shear_p50, f.maer, f.sder) for f in still if f.tissue == tissue), (None, None, None))
            if of_tissue:
                table_rows.append((*of_condition[0].condition, tissue, *lengths, *noise))
    columns = (*_CONDITION, "tissue", "90 % at, mm", "50 % at, mm", "apparent max. shear, median", "MAER", "SDER")
    drawings = {"resolution": Drawing.of("Spatial resolution", figures.resolution, rows)}
    if known := figures.noise_and_resolution(floors, rows, POOLED):
        names = ("condition", "wavelength_recovered_to_90_percent_mm", "max_shear_without_load")
        data = dict(zip(names, zip(*known, strict=True), strict=True))
        drawing = Drawing.of("Noise against resolution", figures.trade_off, known, POOLED, data=data)
        drawings["noise_and_resolution"] = drawing
    pictures = [drawing.save(folder / stem) for stem, drawing in drawings.items()]
    note = f"{_OF_LENGTHS} {_OF_FLOOR}"
    table = Table("Spatial resolution and noise by tissue", columns, tuple(table_rows), note)
    return Section("Spatial resolution", tables=(table,), pictures=tuple(pictures))
