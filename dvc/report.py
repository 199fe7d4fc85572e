"""The building blocks of a report page: verdicts, tables and figures in one self-contained HTML file."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import jinja2
import numpy as np

from dvc.regions import write_whole
from dvc.verdict import Verdict

Cell = str | float | int | None


@dataclass(frozen=True, slots=True)
class Picture:
    """A figure with what it shows and how to read it."""

    title: str
    caption: str
    png: bytes

    @property
    def data(self) -> str:
        """The picture for an ``img`` element."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()


@dataclass(frozen=True, slots=True)
class Table:
    """Rows under named columns; numbers are shown to three or four digits, missing ones as a dash."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""


@dataclass(frozen=True, slots=True)
class Section:
    """A part of a report with its own verdict, or without one."""

    title: str
    verdict: Verdict | None = None
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    paragraphs: tuple[str, ...] = ()


def shown(value: Cell) -> str:
    """A table cell as people read it.

    Examples
    --------
    >>> [shown(v) for v in (0.123456, 1234.5, 12, float("nan"), None, "fat")]
    ['0.1235', '1234', '12', '–', '–', 'fat']
    """
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "–"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"
    return str(value)


def write_report(
    path: Path,
    title: str,
    verdict: Verdict,
    sections: Sequence[Section],
    closing: Sequence[Section],
    provenance: Mapping[str, str],
) -> None:
    """Write a report: verdict first, then the sections, the closing ones, and where it all came from.

    One HTML file without scripts and without anything to fetch; all text is escaped.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["shown"] = shown
    template = environment.from_string((files("dvc") / "templates" / "report.html.j2").read_text(encoding="utf-8"))
    page = template.render(
        title=title,
        verdict=verdict,
        sections=list(sections),
        closing=list(closing),
        provenance=dict(provenance),
    )
    write_whole(path, page)
