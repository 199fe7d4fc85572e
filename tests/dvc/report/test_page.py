"""The report page: complete by itself, escaped, verdict first, and readable in its numbers."""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import re
from collections.abc import Sequence
from html.parser import HTMLParser
from pathlib import Path

import nibabel
import numpy as np
import pytest
from matplotlib.axes import Axes
from PIL import Image as Pixels
from scipy.ndimage import gaussian_filter

from dvc.errors import InputError, OutputError
from dvc.images.image import Grid, LabelMap
from dvc.report import page
from dvc.report.alike import alike
from dvc.report.chart import chart
from dvc.report.drawing import png_bytes
from dvc.report.figures import shear_curves
from dvc.report.page import Picture, Section, Table, Viewer, Volume, shown, write_report
from dvc.report.style import TISSUES, looks
from dvc.trust.verdict import Verdict, worst

pytestmark = pytest.mark.usefixtures("real_pictures")

ATTACK = "<script>alert('x')</script><img src=x onerror=y>\"&"
TRUST, FOLDS = Verdict("trust"), Verdict("distrust", (f"It folds {ATTACK}.",))


def png() -> bytes:
    grid = Grid((2, 2, 2), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    labels = LabelMap(grid, np.ones(grid.shape, dtype=int), {1: "fat"})
    return png_bytes(shear_curves(np.full(grid.shape, 0.1, dtype=np.float32), labels))


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
        if tag not in {"meta", "img", "input"}:
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
    assert page.all("script") == [{}]  # the page's own
    assert len(page.all("img")) == 1
    assert not any(key.startswith("on") for _, attributes in page.tags for key in attributes)
    places = 15  # each place above, of which the title and the section's title are told more than once
    assert "".join(page.text).count(ATTACK) >= places


def test_nothing_is_fetched(html: str) -> None:
    page = Page(html)
    without_pictures = re.sub(r"(base64,|sha256-)[A-Za-z0-9+/=]+", "", html)  # nor the hashes of the policy
    assert not re.search(r"https?:|//|@import|url\(", without_pictures)
    for _, attributes in page.tags:
        for key in ("src", "href"):
            value = attributes.get(key)
            assert value is None or value.startswith(("data:image/webp;base64,", "#"))


def policy_of(html: str) -> dict[str, list[str]]:
    """What a page's content security policy allows, by directive."""
    (policy,) = [a["content"] for a in Page(html).all("meta") if a.get("http-equiv") == "Content-Security-Policy"]
    parts = [part.split() for part in str(policy).split("; ")]
    assert html.index("Content-Security-Policy") < min(html.index(tag) for tag in ("<script", "<style", "<body"))
    return {name: allowed for name, *allowed in parts}


def hashed(content: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()}'"


def test_the_policy_names_the_pages_own_scripts_and_style_by_their_hashes(html: str) -> None:
    scripts, styles = (re.findall(f"<{tag}>(.*?)</{tag}>", html, re.S) for tag in ("script", "style"))
    assert policy_of(html) == {
        "default-src": ["'none'"], "base-uri": ["'none'"], "form-action": ["'none'"], "img-src": ["data:"],
        "style-src": [hashed(styles[0])], "script-src": [hashed(scripts[0])],
    }  # fmt: skip
    assert (len(scripts), len(styles)) == (1, 1)
    assert not any("style" in attributes for _, attributes in Page(html).tags)


def test_links_of_the_contents_lead_to_the_parts(html: str) -> None:
    page = Page(html)
    ids = [str(a["id"]) for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    links = [str(a["href"]) for a in page.all("a")]
    assert len(links) == 4  # two sections, one that closes, and provenance
    assert {link[1:] for link in links} <= set(ids)


def test_verdict_stands_before_all_else_and_in_words(html: str) -> None:
    body = html[html.index("<main>") :]
    assert body.index('class="verdict distrust"') < body.index("<details")
    assert "<strong>Measurement: Do not trust</strong>" in body
    assert '<span class="pill trust">Trust</span>' in body
    contents = html[html.index("<nav") : html.index("</nav>")]
    assert "Do not trust" in contents
    assert "Trust</span>" not in contents.replace("Do not trust", "")  # what is sound needs no mark there


def test_a_verdict_without_reasons_says_once_what_it_means(tmp_path: Path) -> None:
    for verdict in (TRUST, FOLDS):
        write_report(tmp_path / "r.html", "A heel", verdict, [], (), {}, answer="The strain is 0.2 <b>.")
        banner = (tmp_path / "r.html").read_text().split("<h1>")[1]
        assert ("<p>The strain is 0.2 &lt;b&gt;.</p>" in banner) == (verdict is TRUST)
    write_report(tmp_path / "r.html", "A heel", TRUST, [Section("Load1", TRUST)], (), {})
    page = (tmp_path / "r.html").read_text()
    assert page.count('class="verdict trust"') == page.count("All checks passed. The verdict does not") == 1
    assert page.count('<span class="pill trust">Trust</span>') == 1


def test_reasons_of_the_only_load_are_told_once_and_of_several_loads_with_each(tmp_path: Path) -> None:
    def page(*sections: Section) -> str:
        write_report(tmp_path / "r.html", "A heel", worst(s.verdict for s in sections if s.verdict), sections, (), {})
        return (tmp_path / "r.html").read_text()

    doubtful = Verdict("caution", ("Slices are 4 mm apart.",))
    alone = page(Section("Load1", doubtful))
    assert alone.count("Slices are 4 mm apart.") == alone.count('<span class="pill caution">') == 1
    both = page(Section("Load1", doubtful), Section("Load2", Verdict("distrust", ("Fat folds.",))))
    assert both.count("Slices are 4 mm apart.") == 1


def test_a_reason_of_several_loads_is_told_once_with_their_names(tmp_path: Path) -> None:
    thick, far = "Slices are 4 mm apart.", "soft: the displacement is 0.001 times as large as the measured one."
    of_loads = [Verdict("caution", (thick,)).among(load) for load in ("Load1", "Load2")]
    of_model = Verdict("caution", (f"Load1: {far}", f"Load2: {far}", "Fat: Load1 and Load2 overlap."))
    whole = worst([*of_loads, of_model])
    write_report(tmp_path / "r.html", "A heel", whole, [Section("Models", of_model), Section("Load1")], (), {})
    page = (tmp_path / "r.html").read_text()
    assert f"Load1, Load2, registration (Use with care): {thick}" in page
    assert f"Load1, Load2: {far}" in page
    assert page.count(thick) == page.count(far) == page.count("Fat: Load1 and Load2 overlap.") == 1
    assert alike(("Load1: A.", "Load2: B.", "No load.")) == ("Load1: A.", "Load2: B.", "No load.")


def test_a_picture_follows_the_first_two_sentences_of_the_answer(tmp_path: Path) -> None:
    words, picture = ("One.", "Two.", "Three."), Picture("Strain", "", png())
    table = Table("Numbers", ("load",), (("Load1",),))
    first = Section("Answer", None, (table,), (picture,), words, pictures_first=True)
    write_report(tmp_path / "r.html", "A heel", None, [first], (), {})
    page = (tmp_path / "r.html").read_text()
    places = [page.index(of) for of in ("<p>One.", "<p>Two.", "<figure>", "<p>Three.", "<h3>Numbers")]
    assert places == sorted(places)
    assert page.count("<p>Two.") == page.count("<p>Three.") == 1


def test_what_closes_a_report_and_what_is_folded_is_opened_by_the_reader(tmp_path: Path) -> None:
    sections = [Section("Load1"), Section("Load1, cell by cell", folded=True)]
    write_report(tmp_path / "r.html", "A heel", None, sections, [Section("How to read this")], {"command": "register"})
    page = (tmp_path / "r.html").read_text()
    parts = {str(a["id"]): "open" in a for a in Page(page).all("details")}
    assert parts == {"contents": True, "part-1": True, "part-2": False, "closing-1": False, "provenance": False}
    assert "refresh" not in page
    write_report(tmp_path / "r.html", "A heel", None, sections, (), {}, reload_s=10)  # in progress
    page = (tmp_path / "r.html").read_text()
    assert [a["id"] for a in Page(page).all("details")] == ["contents", "part-1", "part-2"]
    assert [a["content"] for a in Page(page).all("meta") if a.get("http-equiv") == "refresh"] == ["10"]


def test_a_picture_on_the_page_is_smaller_than_its_file_and_looks_the_same() -> None:
    shades = np.linspace(0, 255, 300 * 400).reshape(300, 400, 1) + np.random.default_rng(0).normal(0, 20, (300, 400, 1))
    file = io.BytesIO()
    Pixels.fromarray(np.clip(np.repeat(shades, 3, -1), 0, 255).astype(np.uint8)).save(file, "PNG")
    for png_file, near in ((file.getvalue(), 12.0), (png(), 2.0)):
        small = base64.b64decode(Picture("t", "c", png_file).small.removeprefix("data:image/webp;base64,"))
        assert len(small) < 0.7 * len(png_file)
        one, other = (np.asarray(Pixels.open(io.BytesIO(b)).convert("RGB"), float) for b in (png_file, small))
        assert np.sqrt(np.mean((one - other) ** 2)) <= near


def test_a_mark_of_few_pixels_keeps_its_colour_in_a_chart() -> None:
    """Between lines of many shades it took the colour of one of them, another model's."""
    figure, panels = chart(2, page_wide=True)
    drawn_on(panels)
    marks = {"#ff00ff": (255, 0, 255), "#bb8800": (187, 136, 0)}
    for axes, colour in zip(panels, marks, strict=True):
        axes.plot([0.5], [90.0], "o", color=colour, ms=2)
    png_file = png_bytes(figure)
    small = base64.b64decode(Picture("t", "c", png_file).small.removeprefix("data:image/webp;base64,"))
    one, other = (np.asarray(Pixels.open(io.BytesIO(b)).convert("RGB"), float) for b in (png_file, small))
    for colour in marks.values():
        there = np.abs(one - colour).max(axis=-1) < 3
        assert there.any()
        assert np.abs(other[there] - colour).max() < 25


def unpacked(data: str) -> nibabel.Nifti1Image:
    """A volume as a page holds it, its differences added up as the viewer does."""
    held = nibabel.Nifti1Image.from_bytes(gzip.decompress(base64.b64decode(data)))
    flat = held.dataobj.get_unscaled().astype(np.uint8).ravel(order="F")
    rows = np.append(flat, np.zeros(-flat.size % held.shape[0], np.uint8)).reshape(-1, held.shape[0])
    steps = np.cumsum(rows, axis=0, dtype=np.uint8).ravel()[: flat.size].reshape(held.shape, order="F")
    return nibabel.Nifti1Image(steps * held.dataobj.slope, held.affine)


def chart_png() -> bytes:
    figure, panels = chart(2, page_wide=True)
    drawn_on(panels)
    return png_bytes(figure)


def drawn_on(panels: Sequence[Axes]) -> None:
    for axes in panels:
        for name, look in looks(["bone", "fat", "muscle", "skin", "tendon"], TISSUES).items():
            axes.plot(np.linspace(0.0, 1.0, 400), np.random.default_rng(len(name)).random(400).cumsum(), **look.line)


def test_a_report_of_four_loads_and_six_models_has_room() -> None:
    """Its kinds of picture and volume, each as large as it may be for a report of less than 7 MB."""
    curves = len(Picture("Curves", "c", chart_png()).small)
    i, j, k = np.indices((81, 130, 115)) / 20.0
    body = (i - 2.0) ** 2 + (j - 3.2) ** 2 + (k - 2.9) ** 2 < 4.8
    grid = Grid(body.shape, (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    noise = np.random.default_rng(0).normal(0.0, 0.04, (2, *body.shape))
    image = np.hypot(np.where(body, 0.6 + 0.3 * np.sin(i * j), 0.0) + noise[0], noise[1])
    smooth = gaussian_filter(noise[0], 5.0)
    strain = np.where(body, 0.2 + 0.06 * smooth / smooth.std(), np.nan)
    sizes = len(Volume.image("i", grid, image, 1.0).data), len(Volume.overlay("s", grid, strain, 0.55).data)
    assert (curves < 25_000, sizes[0] < 400_000, sizes[1] < 145_000) == (True, True, True), (curves, sizes)


def test_a_volume_is_held_once_for_all_its_viewers(tmp_path: Path) -> None:
    grid = Grid((4, 5, 6), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    values = np.arange(120.0).reshape(4, 5, 6)
    image, strain = Volume.image("image", grid, values, 119.0), Volume.overlay("measured", grid, values, 119.0)
    sections = [Section(load, viewers=(Viewer("Viewer", "c", image, (strain,)),)) for load in ("Load1", "Load2")]
    write_report(tmp_path / "r.html", "A heel", None, sections, [], {})
    page = (tmp_path / "r.html").read_text()
    assert (page.count(image.data), page.count(strain.data)) == (1, 1)
    assert len(re.findall(r'class="overlay" data-volume="volume-2"', page)) == 2
    np.testing.assert_allclose(unpacked(strain.data).get_fdata(), values, atol=0.5 * 119.0 / 80 + 1e-6)
    np.testing.assert_allclose(
        unpacked(image.data).get_fdata()[values > 12.4], values[values > 12.4], atol=0.5 * 119.0 / 24 + 1e-6
    )
    assert not unpacked(image.data).get_fdata()[values < 12.3].any()  # the noise of the air
    library = gzip.decompress(base64.b64decode(re.search(r'id="niivue">([^<]+)<', page)[1]))
    assert b"Niivue" in library
    page_scripts = re.findall("<script>(.*?)</script>", page, re.S)
    allowed = [hashed(one) for one in (*page_scripts, library.decode())]
    assert policy_of(page)["script-src"] == [*allowed, "'wasm-unsafe-eval'"]
    assert len(page) < 1_500_000


def test_pictures_have_a_text_and_their_size(html: str) -> None:
    (image,) = Page(html).all("img")
    assert image["alt"] == f"{ATTACK}, Curves {ATTACK}: How to read {ATTACK}."
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


def test_numbers_of_a_column_have_digits_alike(tmp_path: Path) -> None:
    rows = (("trebbi", 2.0, 22.2, 3), ("zwam", 3.83, 300.0, 12), ("akrami", 0.0, None, 1), ("none", 0.5, 9.49, 0))
    table = Table("Areas", ("model", "area, mL", "weight", "voxels"), rows, apart=(("perfect", 1.0, 4.0, 2),))
    assert [row[1] for row in table.texts] == ["2.00", "3.83", "0", "0.50", "1.00"]
    assert [row[2] for row in table.texts] == ["22.2", "300", "–", "9.49", "4.00"]
    assert [row[3] for row in table.texts] == ["3", "12", "1", "0", "2"]
    write_report(tmp_path / "r.html", "A heel", TRUST, [Section("Load1", TRUST, (table,))], [], {})
    cells = re.findall('<td class="number">([^<]*)</td>', (tmp_path / "r.html").read_text(encoding="utf-8"))
    assert cells[:3] == ["2.00", "22.2", "3"]
    assert cells[-3:] == ["1.00", "4.00", "2"]
    assert Table("t", ("a", "b"), (("rms", 0.5), ("motion", "2 mm"))).texts == [("rms", "0.5"), ("motion", "2 mm")]
    assert Table("t", ("a", "b"), ()).texts == []


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


def test_a_picture_beneath_several_is_stored_once(tmp_path: Path) -> None:
    own = [picture_of(np.full((60, 80), shade)) for shade in (40, 90)]
    unloaded = ("unloaded", picture_of(np.full((60, 80), 200)))
    sections = [
        Section(load, pictures=(Picture("Strain", "c", png(), (unloaded, ("registered", one))),))
        for load, one in zip(("Load1", "Load2"), own, strict=True)
    ]
    write_report(tmp_path / "r.html", "A heel", None, sections, [], {})
    page = Page((tmp_path / "r.html").read_text())
    beneath = {a["alt"]: a for a in page.all("img") if "Strain" not in str(a["alt"])}
    plain = ": the same slices of the image, without colours."
    assert beneath[f"Load2, unloaded{plain}"]["data-copy"] == beneath[f"Load1, unloaded{plain}"]["id"]
    assert "src" not in beneath[f"Load2, unloaded{plain}"]
    stored = [a["src"] for a in page.all("img") if "src" in a]
    assert len({a["src"] for a in beneath.values() if "src" in a}) == 3
    assert len(stored) == 5


def picture_of(shades: np.ndarray) -> bytes:
    """A grey picture as a PNG file's bytes."""
    file = io.BytesIO()
    Pixels.fromarray(shades.astype(np.uint8)).save(file, "PNG")
    return file.getvalue()


def test_a_picture_fades_to_those_beneath_it(tmp_path: Path) -> None:
    below = ("unloaded", png()), ("loaded, registered", png())
    pictures = (Picture("Strain", "c", png(), below), Picture("Curves", "c", png()))
    write_report(tmp_path / "r.html", "A heel", None, [Section("Load1", pictures=pictures)], [], {})
    page = Page((tmp_path / "r.html").read_text())
    images = [(a["alt"], a.get("class"), a.get("style")) for a in page.all("img")]
    assert images == [
        ("Load1, unloaded: the same slices of the image, without colours.", None, None),
        ("Load1, loaded, registered: the same slices of the image, without colours.", "over faded", None),
        ("Load1, Strain: c.", "over", None), ("Load1, Curves: c.", None, None),
    ]  # fmt: skip
    assert [(a["type"], a["value"]) for a in page.all("input")] == [("range", "0"), ("range", "100")]


@pytest.mark.parametrize("failure", [KeyError("WEBP"), ValueError("encoding error 1")])
def test_an_encoder_without_memory_is_a_lack_of_memory(failure, monkeypatch) -> None:
    """Pillow tells of it like this, and a command ended in a traceback."""

    def failing(*_: object, **__: object) -> None:
        raise failure

    monkeypatch.setattr(Pixels.Image, "save", failing)
    with pytest.raises(MemoryError, match="could not be encoded"):
        page._webp(Pixels.new("RGB", (2, 2)))


def test_a_picture_that_is_too_large_is_no_lack_of_memory() -> None:
    with pytest.raises(ValueError, match="encoding error 5"):  # a WebP image has at most 16383 pixels along an edge
        page._webp(Pixels.new("RGB", (20_000, 1)))
