"""The report in a real browser: it works under its own policy, which runs nothing but its own scripts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from dvc.images.image import Grid
from dvc.report.page import Picture, Section, Table, Viewer, Volume, write_report
from dvc.trust.verdict import Verdict
from tests.browser import CHROMIUM, Tab, browser
from tests.dvc.report.test_page import png

pytestmark = pytest.mark.skipif(not CHROMIUM, reason="no Chromium is installed")

ATTACK = (
    "</script></title></style><script>top.ran = 1</script>"
    "<img src=x onerror=\"top.ran = 1\">'\"><svg onload='top.ran = 1'>"
)
SLIDERS = 'document.querySelectorAll(".faders input")'


@pytest.fixture(scope="module")
def tab() -> Iterator[Tab]:
    with browser() as one:
        yield one


def page_of(folder: Path, name: str) -> Path:
    """A report with everything that a page can hold, in which every text is the same name."""
    grid = Grid((12, 14, 16), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    values = np.random.default_rng(0).random(grid.shape)
    image, strain = Volume.image(name, grid, values, 1.0), Volume.overlay(name, grid, values, 1.0)
    beneath = (f"unloaded {name}", png()), (f"loaded {name}", png())
    table = Table(name, (name, "value"), ((name, 1.0),), name, ((name, 2.0),))
    verdict = Verdict("distrust", (name,))
    sections = [
        Section(name, verdict, (table,), (Picture(name, name, png(), beneath),), (name,), summary=table),
        Section(name, folded=True, viewers=(Viewer(name, name, image, (strain, strain)),)),
    ]
    path = folder / "report.html"
    write_report(path, name, verdict, sections, [Section(name)], {name: name}, notes=[name])
    return path


def test_a_page_works_under_its_policy(tab: Tab, tmp_path: Path) -> None:
    tab.open(page_of(tmp_path, "Heel"))
    for slider, wanted in ((0, ["0.3", "1"]), (1, ["0.3", "0.3"])):
        tab.value(f"{SLIDERS}[{slider}].value = 30; {SLIDERS}[{slider}].dispatchEvent(new Event('input'))")
        assert (
            tab.value("[...document.querySelectorAll('.over')].map((one) => getComputedStyle(one).opacity)") == wanted
        )
    assert tab.value("getComputedStyle(document.querySelector('nav')).position") == "sticky"
    tab.value("document.querySelector('nav a[href=\"#part-2\"]').click()")
    tab.wait_for("document.getElementById('part-2').open")
    tab.value("document.querySelector('.viewer button').click()")
    tab.wait_for("'state' in document.querySelector('.viewer').dataset")
    assert tab.value("document.querySelector('.viewer').dataset.state") == "shown"
    assert tab.said == []
    values = np.random.default_rng(0).random((12, 14, 16))  # of `page_of`
    held = tab.value("nifti('volume-2').then((bytes) => [...bytes.slice(352)])")
    np.testing.assert_array_equal(held, np.rint(values * 80).ravel(order="F"))


def test_the_viewer_shows_slices_as_the_pictures_do(tab: Tab, tmp_path: Path) -> None:
    """The patient's right on the left of coronal and axial slices, anterior on the left of sagittal ones."""
    tab.open(page_of(tmp_path, "Heel"))
    watched = "niivue.Niivue = class extends niivue.Niivue { constructor(how) { super(how); views.push(this); } }"
    tab.value(f"window.views = []; library().then(() => {{ {watched}; }})")
    tab.value("document.querySelector('.viewer button').click()")
    tab.wait_for("'state' in document.querySelector('.viewer').dataset")
    shown = tab.value("views.map((view) => [view.opts.isRadiologicalConvention, view.opts.sagittalNoseLeft])")
    assert shown == [[True, True]] * 2


def test_a_name_stays_a_name(tab: Tab, tmp_path: Path) -> None:
    tab.open(page_of(tmp_path, ATTACK))
    tab.value("document.querySelector('.viewer button').click()")
    tab.wait_for("'state' in document.querySelector('.viewer').dataset")
    assert tab.value("document.querySelector('.viewer').dataset.state") == "shown"
    assert tab.value("document.title") == tab.value("document.querySelector('h1').textContent") == ATTACK
    assert (
        tab.value("[...document.querySelectorAll('summary h2')].slice(1, 4).map((one) => one.textContent)")
        == [ATTACK] * 3
    )
    assert tab.value("document.querySelector('.overlay').dataset.title") == ATTACK
    assert tab.value("document.querySelectorAll('body svg, img[src=x], [onload], [onerror]').length") == 0
    assert tab.value("typeof top.ran") == "undefined"
    assert tab.said == []


@pytest.mark.parametrize(
    "foreign",
    ["<script>top.ran = 1</script>", '<img src="data:," onerror="top.ran = 1">', "<script src='x.js'></script>"],
)
def test_the_policy_stops_a_script_that_is_not_the_pages_own(tab: Tab, tmp_path: Path, foreign: str) -> None:
    path = page_of(tmp_path, "Heel")
    (tmp_path / "x.js").write_text("top.ran = 1")
    path.write_text(path.read_text().replace("<main>", f"<main>{foreign}"))  # as if a name had not been escaped
    tab.open(path)
    assert tab.value("typeof top.ran") == "undefined"
    assert any("Content Security Policy" in line for line in tab.said)
