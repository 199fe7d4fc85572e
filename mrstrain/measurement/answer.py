"""The first part of a report on measurements: the strain of every load in one slice, and by tissue in a table."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dvc import Subject, Verdict
from dvc.errors import InputError
from dvc.images.bone_names import is_bones_name
from dvc.io.result_folder import QUALITY
from dvc.report.alike import alike, listed
from dvc.report.page import LOPSIDED, Cell, Estimate, Section, Table
from dvc.trust.error_model import POOLED
from dvc.trust.quality import NoiseFloor, read_noise_floor

_NOTE = "Green-Lagrange, (E₁ − E₃)/2, in the reference configuration{}."
_TITLE = "Measured maximum shear strain"
_NEARLY = 0.9
_INTERVALS = ", with the interval of 95 % coverage in brackets"


@dataclass(frozen=True, slots=True)
class MeasuredBeside:
    """What is known beside the strain: the forces of each load in words, and the noise floor of a repeat scan."""

    forces: Mapping[str, str] = field(default_factory=dict)
    floor: NoiseFloor | None = None

    @classmethod
    def of(cls, folders: Mapping[str, Path], forces: Mapping[str, str] | None = None) -> "MeasuredBeside":
        """With the noise floor that the loads' results were judged by, which is the same in all ``folders``."""
        for folder in folders.values():
            try:
                return cls(forces or {}, read_noise_floor(folder / QUALITY))
            except InputError:
                continue
        return cls(forces or {})


NOTHING_BESIDE = MeasuredBeside()


def measured_strain(
    measured: Sequence[Section], subject: Subject, folders: Mapping[str, Path], out: Path
) -> list[Section]:
    """The first part of a report, from the sections of the loads; its figure is also written into ``out``.

    ``folders`` are those of the loads' results, by load; empty if there is none. `most_strained` is told by
    the banner of the report, or else by its first paragraph.
    """
    if not folders:
        return []
    from dvc.measurement.side_by_side import FIGURE, measured_by_load  # it draws, and matplotlib takes half a second

    picture = measured_by_load(subject, folders).save(out / FIGURE)
    table = table_of_loads(measured)
    tables = () if table is None else (table,)
    return [Section("Measured strain", None, tables, (picture,), pictures_first=True)]


def most_strained(table: Table | None, beside: MeasuredBeside = NOTHING_BESIDE) -> str:
    """The strain of the most strained tissue of a table of `table_of_loads`, in sentences; empty without a table.

    It is the one with the largest 95th percentile of those whose interval begins within 10 % of the highest beginning:
    a tissue of few voxels may have a larger percentile by chance.
    """
    known = _known(table)
    if not known:
        return ""
    high, (load, tissue, median, *_) = _most(known)
    under = f"{load} ({beside.forces[str(load)]})" if str(load) in beside.forces else str(load)
    of = f"{tissue}, the most strained tissue," if len({row[1] for _, row in known}) > 1 else str(tissue)
    told = f"Maximum shear strain in {of} under {under}: median {median}, 95th percentile {high}"
    told += "." if high.interval is None else ", with 95 % intervals in brackets."
    overlapping = [str(row[1]) for other, row in known if row[0] == load and row[1] != tissue and other.reaches(high)]
    if overlapping and high.interval is not None:
        told += f" The 95th percentile may be as large in {listed(overlapping)}, since the intervals overlap."
    if beside.floor is not None:
        noise = f"{beside.floor.max_shear_p50:.3f} (median) and {beside.floor.max_shear_p95:.3f} (95th percentile)"
        told += f" The noise floor (tissue outside the bone mask, if there is one) is {noise}."
    return told


def told_once(
    sections: Sequence[Section], verdict: Verdict | None, beside: MeasuredBeside = NOTHING_BESIDE
) -> tuple[str, list[Section]]:
    """`most_strained` for the banner of a report, and its sections; or "", and these with it as first paragraph.

    The banner tells no strain that is not to be trusted, and there is none without a verdict. The first section has the
    table of `table_of_loads`; without it, there is nothing to tell.
    """
    first, *others = sections or [Section("")]
    told = most_strained(next((table for table in first.tables if table.title == _TITLE), None), beside)
    if not told or (verdict is not None and verdict.level != "distrust"):
        return told, list(sections)
    return "", [replace(first, paragraphs=(told, *first.paragraphs)), *others]


_Strained = tuple[Estimate, tuple[Cell, ...]]


def _known(table: Table | None) -> list[_Strained]:
    """The 95th percentile of each row of a table of `table_of_loads` that has one, and the row."""
    rows = () if table is None else table.rows
    return [(high, row) for row in rows if isinstance(high := row[3], Estimate) and np.isfinite(high.value)]


def _most(known: Sequence[_Strained]) -> _Strained:
    least = _NEARLY * max(high.least for high, _ in known)
    return max((one for one in known if one[0].least >= least), key=lambda one: one[0].value)


def table_of_loads(measured: Sequence[Section]) -> Table | None:
    """The measured maximum shear strain of each load and soft tissue, from the sections of the loads; None without any.

    Bones have their rows in the sections: they are rigid, and their strain is an error.
    """
    tables = [(section.title, section.summary) for section in measured if section.summary is not None]
    if not tables:
        return None
    rows = tuple((load, *row) for load, of in tables for row in of.rows if not is_bones_name(str(row[0])))
    known = any(of.note for _, of in tables)
    note = _NOTE.format(_INTERVALS if known else "") + f" {LOPSIDED}" * known
    bare = [str(row[1]) for row in rows if isinstance(row[3], Estimate) and row[3].interval is None]
    if known and bare:
        note += f" No interval is known in {' and '.join(dict.fromkeys(bare))}."
    if any(row[1] == POOLED for row in rows):
        note += f" Without a label map, '{POOLED}' is all but the given bone; other bones are in it."
    caveats = [(section.title, section.caveat) for section in measured if section.summary is not None]
    if len({caveat for _, caveat in caveats}) > 1:
        caveats = [("", one) for one in alike(f"{load}: {caveat}" for load, caveat in caveats if caveat)]
    note = " ".join((note, *dict.fromkeys(caveat for _, caveat in caveats if caveat)))
    return Table(_TITLE, ("load", *tables[0][1].columns), rows, note)
