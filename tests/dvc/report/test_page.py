"""The report page: complete by itself, escaped, verdict first, and readable in its numbers."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from dvc.errors import InputError, OutputError
from dvc.images.image import Grid, LabelMap
from dvc.report.figures import shear_curves
from dvc.report.page import Picture, Section, Table, shown, write_report
from dvc.trust.verdict import Verdict

ATTACK = "<script>alert('x')</script><img src=x onerror=y>\"&"
TRUST, FOLDS = Verdict("trust"), Verdict("distrust", (f"It folds {ATTACK}.",))


def png() -> bytes:
    grid = Grid((2, 2, 2), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    labels = LabelMap(grid, np.ones(grid.shape, dtype=int), {1: "fat"})
    return shear_curves(np.full(grid.shape, 0.1, dtype=np.float32), labels)


class Page(HTMLParser):
    """Tags with their attributes, the text, and whether every tag is closed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []
        self.open: list[str] = []
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in {"meta", "img"}:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture
def html(tmp_path: Path) -> str:
    table = Table(
        f"Figures {ATTACK}",
        ("figure", "value", "unit"),
        ((f"shift {ATTACK}", 0.123456, "mm"), ("missing", float("nan"), "1"), ("none", None, "1")),
        f"A note {ATTACK}",
    )
    sections = [
        Section(ATTACK, FOLDS, (table,), (Picture(f"Curves {ATTACK}", f"How to read {ATTACK}", png()),), (ATTACK,)),
        Section("Load2 #1", TRUST),
    ]
    path = tmp_path / "report.html"
    closing = [Section(f"Definitions {ATTACK}")]
    write_report(path, f"A heel {ATTACK}", FOLDS, sections, closing, {f"seed {ATTACK}": f"1 {ATTACK}"})
    assert [p.name for p in tmp_path.iterdir()] == ["report.html"]
    return path.read_text(encoding="utf-8")


def test_names_are_escaped_everywhere(html: str) -> None:
    page = Page(html)
    assert page.open == []
    assert not page.all("script")
    assert len(page.all("img")) == 1
    assert not any(key.startswith("on") for _, attributes in page.tags for key in attributes)
    places = 15  # each place above, of which the title, the section's title and its reason are told more than once
    assert "".join(page.text).count(ATTACK) >= places


def test_nothing_is_fetched(html: str) -> None:
    page = Page(html)
    without_pictures = re.sub(r"base64,[A-Za-z0-9+/=]+", "", html)
    assert not re.search(r"https?:|//|@import|url\(", without_pictures)
    for _, attributes in page.tags:
        for key in ("src", "href"):
            value = attributes.get(key)
            assert value is None or value.startswith(("data:image/png;base64,", "#"))
    policy = [a["content"] for a in page.all("meta") if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]


def test_links_of_the_contents_lead_to_the_parts(html: str) -> None:
    page = Page(html)
    ids = [str(a["id"]) for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    links = [str(a["href"]) for a in page.all("a")]
    assert len(links) == 2
    assert {link[1:] for link in links} <= set(ids)


def test_verdict_stands_before_all_else_and_in_words(html: str) -> None:
    body = html[html.index("<main>") :]
    assert body.index('class="verdict distrust"') < body.index("<section")
    assert "Do not trust" in body
    assert '<span class="pill trust">Trust</span>' in body


def test_pictures_have_a_text_and_their_size(html: str) -> None:
    (image,) = Page(html).all("img")
    assert str(image["alt"]).startswith("Curves")
    assert image["width"] == "941"  # 9.8 inches of 96 CSS pixels


def test_missing_numbers_are_dashes_and_columns_of_numbers_flush_right(html: str) -> None:
    assert html.count('<td class="number">–</td>') == 2
    assert '<td class="number">0.123</td>' in html
    assert not re.search(r"\bnan\b", html)
    assert Table("t", ("a", "b", "c"), (("x", 1.0, None), ("y", None, "z"))).numeric == (False, True, False)
    assert Table("t", ("a", "b"), ()).numeric == (False, False)


@pytest.mark.parametrize(
    ("value", "wanted"),
    [(np.float64(0.000123456), "0.000123"), (np.float32("nan"), "–"), (123456.7, "123457"), (-2.5, "-2.5"), (0, "0")],
)
def test_numbers_have_sensible_digits(value: float, wanted: str) -> None:
    assert shown(value) == wanted


def test_one_load_needs_no_contents_and_none_is_possible(tmp_path: Path) -> None:
    for sections in ([Section("Load1", TRUST)], []):
        write_report(tmp_path / "r.html", "A heel", TRUST, sections, [], {})
        assert "Contents" not in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_what_cannot_be_shown_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a PNG"):
        Picture("t", "c", b"GIF89a")
    with pytest.raises(InputError, match="Row 1"):
        Table("t", ("a", "b"), (("x", 1), ("y",)))
    with pytest.raises(OutputError, match="nowhere"):
        write_report(tmp_path / "nowhere" / "r.html", "t", TRUST, [], [], {})
    assert list(tmp_path.iterdir()) == []
