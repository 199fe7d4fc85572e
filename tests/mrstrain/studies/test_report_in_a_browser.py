"""The report of a whole study, as a browser shows and prints it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from dvc.report.drawing import png_bytes
from dvc.report.page import Picture, Section, write_report
from dvc.trust.verdict import Verdict
from fe.figures import Slice, slice_sheet
from tests.blocks import block
from tests.browser import CHROMIUM, Tab, browser
from tests.page_checks import BROKEN, CUT_OFF, HEADINGS, PALE, TOO_WIDE, UNFOLD, UNNAMED, WIDTHS, opened
from tests.printed import PAPERS, printed, sheets_of

pytestmark = pytest.mark.skipif(not CHROMIUM, reason="no Chromium is installed")

SPLIT = """[...document.querySelectorAll("main h1, main h2, main h3, main summary, main thead, main figure, main tr")]
  .filter((one) => {
    const style = getComputedStyle(one), row = ["TR", "FIGURE"].includes(one.tagName);
    return (row ? style.breakInside : style.breakAfter) !== "avoid";
  }).map((one) => one.outerHTML.slice(0, 80))"""
"""Headings that a page may end with, and rows and figures that two pages may share."""


INTERVAL = re.compile(r"[-\d.]+ \([-\d.]+ to [-\d.]+\)")


@pytest.fixture(scope="module")
def tab() -> Iterator[Tab]:
    with browser() as one:
        yield one


@pytest.fixture(scope="module")
def report(done):
    return done[0] / "results" / "report.html"


@pytest.mark.parametrize("width", WIDTHS)
def test_the_report_of_a_study_fits_and_its_text_is_legible(tab, report, width):
    opened(tab, report, width)
    assert tab.value("document.querySelector('.verdict').getBoundingClientRect().bottom") < 900
    tab.value(UNFOLD)
    assert tab.value(CUT_OFF) == []
    assert tab.value(PALE) == []
    assert [text for text in tab.value(BROKEN) if INTERVAL.fullmatch(text)] == []
    assert tab.value(TOO_WIDE) <= 0
    assert tab.said == []


def test_tables_of_many_columns_fit_a_laptop_and_a_sheet_of_paper(tab, report):
    """A table that is wider than the sheet would shrink everything on it, to 71 % once."""
    opened(tab, report, 1000)
    tab.value(UNFOLD)
    assert (
        tab.value("Math.max(...[...document.querySelectorAll('.wide thead tr')].map((row) => row.children.length))")
        > 10
    )
    assert tab.value("[...document.querySelectorAll('.wide')].filter((one) => one.scrollWidth > one.clientWidth)") == []
    try:
        tab.call("Emulation.setEmulatedMedia", media="print")
        opened(tab, report, 688)  # of A4, between its margins
        tab.value(UNFOLD)
        assert tab.value(TOO_WIDE) <= 0
    finally:
        tab.call("Emulation.setEmulatedMedia", media="")


def test_a_screen_reader_finds_its_way_through_the_report_of_a_study(tab, report):
    opened(tab, report, 1400)
    tab.value(UNFOLD)
    levels = tab.value(HEADINGS)
    assert (levels[0], levels.count(1)) == (1, 1)
    assert all(below - above <= 1 for above, below in pairwise(levels))
    assert tab.value(UNNAMED) == []


def test_the_report_of_a_study_prints_whole_and_no_page_ends_with_a_heading(tab, report):
    opened(tab, report, 1400)
    pdf = printed(tab)
    assert pdf.startswith(b"%PDF")
    assert tab.value("[...document.querySelectorAll('main details')].every((part) => part.open)")
    figures = sheets_of(pdf, "Figure")
    assert len(figures) > 20
    assert [sheets for sheets in figures if len(sheets) != 1] == []
    tab.call("Emulation.setEmulatedMedia", media="print")
    assert tab.value(SPLIT) == []
    tab.value("document.querySelector('main h2').style.breakAfter = 'auto'")
    assert len(tab.value(SPLIT)) == 1
    tab.call("Emulation.setEmulatedMedia", media="")


@pytest.mark.parametrize("paper", PAPERS)
def test_a_figure_of_many_panels_prints_on_one_sheet_with_its_heading_and_caption(
    tab: Tab, tmp_path: Path, paper: str
) -> None:
    mesh = block((6, 6, 6), (60.0, 60.0, 60.0))
    panels = [Slice(f"model {n}", np.zeros_like(mesh.points_mm), np.full(len(mesh.cells), 0.1 * n)) for n in range(22)]
    png = png_bytes(slice_sheet(mesh, panels, np.eye(3), np.full(3, 30.0)))
    width, height = (int.from_bytes(png[at : at + 4], "big") for at in (16, 20))
    assert height > 2 * width  # scaled to the width of a sheet, it is taller than one
    caption = "Maximum shear strain in a slice, measured and simulated, on the deformed tissue. " * 6
    picture, words = Picture("Location of the strain", caption, png), ("The volume that is compared. " * 60,)
    sections = [Section(f"Load{n}", Verdict("trust"), pictures=(picture,), paragraphs=words[n:]) for n in range(2)]
    path = tmp_path / "report.html"
    write_report(path, "A heel", None, sections, [], {})
    opened(tab, path, 1400)
    pdf = printed(tab, paper)
    figures, headings = sheets_of(pdf, "Figure"), sheets_of(pdf, "H3")
    assert len(figures) == 4  # each with its picture
    assert [len(sheets) for sheets in figures] == [1] * 4
    assert all(heading in figures for heading in headings)
    assert sheets_of(pdf, "H2")[-1] == headings[-1]  # nor does the section's heading stay behind
    assert tab.said == []
    tab.call("Emulation.setEmulatedMedia", media="print")
    assert tab.value("getComputedStyle(document.querySelector('.stack img')).objectFit") == "contain"  # not squeezed
    tab.call("Emulation.setEmulatedMedia", media="")


def test_a_tall_figure_leaves_no_half_of_a_printed_sheet_empty(tab: Tab, tmp_path: Path) -> None:
    """It takes half a sheet at most, so it stands below a quarter of a sheet of text and not on the next sheet."""
    mesh = block((6, 6, 6), (60.0, 60.0, 60.0))
    panels = [Slice(f"model {n}", np.zeros_like(mesh.points_mm), np.full(len(mesh.cells), 0.1 * n)) for n in range(22)]
    picture = Picture("Strain", "Measured.", png_bytes(slice_sheet(mesh, panels, np.eye(3), np.full(3, 30.0))))
    text = Section("Models and loads", paragraphs=("The volume that is compared. " * 25,))
    write_report(tmp_path / "report.html", "A heel", None, [text, Section("Load1", pictures=(picture,))], [], {})
    opened(tab, tmp_path / "report.html", 1400)
    pdf = printed(tab)
    assert sheets_of(pdf, "Figure") == [{1}, {1}]
