"""The report of a whole study, as a browser shows and prints it."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from itertools import pairwise

import pytest

from tests.browser import CHROMIUM, Tab, browser
from tests.page_checks import BROKEN, CUT_OFF, HEADINGS, PALE, TOO_WIDE, UNFOLD, UNNAMED, WIDTHS, opened

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


def test_a_screen_reader_finds_its_way_through_the_report_of_a_study(tab, report):
    opened(tab, report, 1400)
    tab.value(UNFOLD)
    levels = tab.value(HEADINGS)
    assert (levels[0], levels.count(1)) == (1, 1)
    assert all(below - above <= 1 for above, below in pairwise(levels))
    assert tab.value(UNNAMED) == []


def test_the_report_of_a_study_prints_whole_and_no_page_ends_with_a_heading(tab, report):
    opened(tab, report, 1400)
    printed = base64.b64decode(tab.call("Page.printToPDF", printBackground=False)["data"])
    assert printed.startswith(b"%PDF")
    assert tab.value("[...document.querySelectorAll('main details')].every((part) => part.open)")
    tab.call("Emulation.setEmulatedMedia", media="print")
    assert tab.value(SPLIT) == []
    tab.value("document.querySelector('main h2').style.breakAfter = 'auto'")
    assert len(tab.value(SPLIT)) == 1
    tab.call("Emulation.setEmulatedMedia", media="")
