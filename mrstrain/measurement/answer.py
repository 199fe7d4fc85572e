"""The first part of a report on measurements: the strain of every load in one slice, and by tissue in a table."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from dvc import Subject
from dvc.measurement.subject import is_bones_name
from dvc.report.page import Section, Table

_NOTE = "Green-Lagrange, (E₁ − E₃)/2, in the unloaded configuration{}."
_INTERVALS = ", with the interval of 95 % coverage in brackets"


def measured_strain(
    measured: Sequence[Section], subject: Subject, folders: Mapping[str, Path], out: Path
) -> list[Section]:
    """The first part of a report, from the sections of the loads; its figure is also written into ``out``.

    ``folders`` are those of the loads' results, by load; empty if there is none, and so nothing to show.
    """
    if not folders:
        return []
    from dvc.measurement.side_by_side import FIGURE, measured_by_load  # it draws, and matplotlib takes half a second

    picture = measured_by_load(subject, folders).save(out / FIGURE)
    table = table_of_loads(measured)
    tables = () if table is None else (table,)
    return [Section("Measured strain", None, tables, (picture,), most_strained(table), pictures_first=True)]


def most_strained(table: Table | None) -> tuple[str, ...]:
    """A sentence on the row of a table of `table_of_loads` with the largest 95th percentile; none without a table."""
    known = [row for row in table.rows if str(row[3])[0].isdigit()] if table is not None else []  # a dash without it
    if not known:
        return ()
    load, tissue, median, high, *_ = max(known, key=lambda row: float(str(row[3]).split()[0]))
    return (
        f"The measured maximum shear strain is largest in {tissue} under {load}: median {median}, "
        f"95th percentile {high}.",
    )


def table_of_loads(measured: Sequence[Section]) -> Table | None:
    """The measured maximum shear strain of each load and soft tissue, from the sections of the loads; None without any.

    Bones have their rows in the sections: they are rigid, and their strain is an error.
    """
    tables = [(section.title, section.summary) for section in measured if section.summary is not None]
    if not tables:
        return None
    rows = tuple((load, *row) for load, of in tables for row in of.rows if not is_bones_name(str(row[0])))
    note = _NOTE.format(_INTERVALS if any(of.note for _, of in tables) else "")
    return Table("Measured maximum shear strain", ("load", *tables[0][1].columns), rows, note)
