"""Every example of the gallery runs as it stands, asserts a number and draws its picture; the page shows them all."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest
from matplotlib import pyplot as plt

import fe
import phantoms
from tests.pictures import pale_lines

DOCS = Path(__file__).resolve().parents[1] / "docs"
EXAMPLES = sorted((DOCS / "gallery").glob("*.py"))
SLOW = {"error_bars", "mesh"}  # error bars need voxels of full size, and the mesh is of a heel of its own
MOST_BYTES = 40_000


@pytest.mark.parametrize(
    "example",
    [pytest.param(one, id=one.stem, marks=[pytest.mark.full_size] * (one.stem in SLOW)) for one in EXAMPLES],
)
@pytest.mark.usefixtures("in_this_process")
def test_an_example_draws_its_picture(example, tmp_path, monkeypatch, heel_pair_once, mesh_labels_once) -> None:
    monkeypatch.setattr(phantoms, "heel_pair", heel_pair_once)
    monkeypatch.setattr(fe, "mesh_labels", mesh_labels_once)
    monkeypatch.chdir(tmp_path)
    plt.switch_backend("agg")
    try:
        with plt.rc_context():
            runpy.run_path(str(example))
            assert not [pale for number in plt.get_fignums() for pale in pale_lines(plt.figure(number))]
    finally:
        plt.close("all")
    picture = tmp_path / f"{example.stem}.webp"
    assert picture.read_bytes()[8:12] == b"WEBP"
    assert picture.stat().st_size < MOST_BYTES


def test_examples_draw_in_the_style_of_reports() -> None:
    for example in (one.read_text() for one in EXAMPLES):
        assert ("plt." in example) == ("plt.style.use(dvc.FIGURE_STYLE)" in example)
    assert sum("plt." in one.read_text() for one in EXAMPLES) == 9


def test_the_page_shows_every_example_with_its_picture() -> None:
    assert len(EXAMPLES) == 12
    page = (DOCS / "gallery.md").read_text()
    for example in EXAMPLES:
        assert "\nassert " in example.read_text(), example
        code = example.read_text()
        assert f"\n```python\n{code.rstrip()}\n```\n" in page, f"Copy {example} into docs/gallery.md."
        assert f"(images/gallery/{example.stem}.webp)" in page, example
        assert (DOCS / "images" / "gallery" / f"{example.stem}.webp").stat().st_size < MOST_BYTES


def test_pictures_of_the_site_are_small() -> None:
    sizes = {picture.name: picture.stat().st_size for picture in (DOCS / "images").rglob("*.*")}
    assert sum(sizes.values()) < 1_500_000
    assert max(sizes.values()) < 115_000, sizes
