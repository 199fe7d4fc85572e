"""A figure's files: a PDF with its font, without a date, small; a table of what is drawn; and one look for one name."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
import zlib
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib import rcParams
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure

from dvc.errors import OutputError
from dvc.images.image import Grid, Image, LabelMap
from dvc.report import figures
from dvc.report.chart import chart, label_axes, legend
from dvc.report.drawing import Drawing, save_figure
from dvc.report.sheet import View
from dvc.report.style import TISSUES, Look, looks

pytestmark = pytest.mark.usefixtures("real_pictures")


def curve() -> Figure:
    """A curve."""
    figure, (axes,) = chart()
    axes.plot([0.0, 1.0], [2.0, -3.0], label="heel", **looks(["heel"])["heel"].marked)
    label_axes(axes, "maximum shear strain (E₁ − E₃)/2, no unit", "volume, mL", "a − b")
    legend(axes)
    return figure


def slices() -> Figure:
    """A page of noise, 160 x 160 voxels in each of three slices."""
    grid = Grid((160, 160, 160), (0.8, 0.8, 0.8), (0.0, 0.0, 0.0))
    noise = np.random.default_rng(3).uniform(0.0, 1.0, grid.shape).astype(np.float32)
    view = View.through(grid, grid.centre_mm)
    return figures.strain_slices(view, Image(grid, noise), np.where(noise > 0.5, noise, np.nan), 0.5)


def test_a_pdf_holds_its_truetype_font_once_and_no_date(tmp_path: Path) -> None:
    save_figure(tmp_path / "curve.of.Load1", curve())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["curve.of.Load1.pdf", "curve.of.Load1.png"]
    pdf = (tmp_path / "curve.of.Load1.pdf").read_bytes()
    assert pdf.count(b"/FontFile2") == 1  # TrueType, and signs beyond Latin do not need a second one
    assert b"/Type3" not in pdf
    assert b"+mrstrainSans" in pdf
    assert not re.search(rb"CreationDate|ModDate|/Producer|matplotlib", pdf)
    assert rcParams["pdf.fonttype"] == 3  # as it was for everybody else


def test_a_legend_that_takes_long_on_a_busy_machine_warns_of_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """matplotlib warns of a place that it chose for longer than a second, unless it was told to choose."""
    times = iter(range(0, 1000, 60))
    monkeypatch.setattr("matplotlib.legend.time", SimpleNamespace(perf_counter=lambda: float(next(times))))
    save_figure(tmp_path / "curve", curve())
    assert next(times) > 60  # it was asked for the time


def test_letters_that_the_font_lacks_come_from_another(tmp_path: Path) -> None:
    figure = curve()
    figure.axes[0].set_title("Пятка")
    save_figure(tmp_path / "curve", figure)
    assert b"+DejaVuSans" in (tmp_path / "curve.pdf").read_bytes()


def test_equal_figures_give_equal_files_in_every_process(tmp_path: Path) -> None:
    save_figure(tmp_path / "here", curve())
    code = (
        "from pathlib import Path; from tests.dvc.report.test_drawing import curve, save_figure\n"
        f"save_figure(Path({str(tmp_path)!r}) / 'there', curve())"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[3])
    for ending in ("png", "pdf"):
        assert (tmp_path / f"here.{ending}").read_bytes() == (tmp_path / f"there.{ending}").read_bytes()


def test_images_keep_their_own_voxels_in_a_pdf_which_stays_small(tmp_path: Path) -> None:
    save_figure(tmp_path / "slices", slices())
    pdf = (tmp_path / "slices.pdf").read_bytes()
    assert len(pdf) < 500_000
    assert pdf.count(b"/Width 160 ") >= 6  # an image and a map in each plane
    assert max(int(width) for width in re.findall(rb"/Width (\d+)", pdf)) == 256  # the colour bar


def test_lines_stay_lines_and_text_stays_text(tmp_path: Path) -> None:
    save_figure(tmp_path / "curve", curve())
    pdf = (tmp_path / "curve.pdf").read_bytes()
    assert b"/Subtype /Image" not in pdf
    streams = [
        zlib.decompress(s) for s in re.findall(rb"/FlateDecode.*?stream\r?\n(.*?)\r?\nendstream", pdf, re.DOTALL)
    ]
    assert any(b" Tf" in s and b" l\n" in s for s in streams)


def test_data_are_written_beside_it(tmp_path: Path) -> None:
    data = {"region": ["fat", "skin"], "volume_above_ml": np.array([1.5, 2.25])}
    picture = Drawing.of("Title", curve, note="and more", data=data).save(tmp_path / "a")
    assert picture.caption == "A curve. and more"
    assert picture.png == (tmp_path / "a.png").read_bytes()
    with (tmp_path / "a.csv").open(newline="") as file:
        assert list(csv.reader(file)) == [["region", "volume_above_ml"], ["fat", "1.5"], ["skin", "2.25"]]
    with pytest.raises(OutputError, match="cannot be written"):
        save_figure(tmp_path / "nowhere" / "a", curve())


def test_the_table_of_the_curves_is_the_volume_above_each_strain() -> None:
    grid = Grid((10, 10, 10), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    shear = np.linspace(0.0, 0.6, 1000, dtype=np.float32).reshape(grid.shape)
    labels = LabelMap(grid, np.ones(grid.shape, dtype=int), {1: "fat", 2: "absent"})
    ((name, (at, above)),) = figures.strain_volume(shear, labels).items()
    assert name == "fat"
    assert at[[0, 20, -1]].tolist() == pytest.approx([0.0, 0.1, 0.6])
    wanted = [np.count_nonzero(shear > strain) / 1000.0 for strain in at]
    np.testing.assert_allclose(above, wanted, atol=1.1e-3)


def test_a_name_looks_the_same_everywhere_and_no_two_alike() -> None:
    many = looks([f"thing {letter}" for letter in "abcdefghijklmnopqrstuvwx"])
    assert len({(look.colour, look.dashes) for look in many.values()}) == 24
    assert looks(["fat", "heel pad"], TISSUES)["fat"] == looks(["Skin", "Fat"], TISSUES)["Fat"]
    assert looks(["Load3", "Load1"])["Load3"] == looks(["Load2", "Load3"])["Load3"]
    assert looks(["mine", "other"])["mine"] == looks(["mine"])["mine"]
    assert len(looks(map(str, range(60)))) == 60  # they begin anew


def _seen_by_a_deuteranope(colour: str) -> np.ndarray:
    """CIELAB-like lightness and hue after Viénot, Brettel and Mollon (1999): red and green fall together."""
    rgb = np.array(to_rgb(colour)) ** 2.2
    to_lms = np.array([[17.8824, 43.5161, 4.11935], [3.45565, 27.1554, 3.86714], [0.0299566, 0.184309, 1.46709]])
    blind = np.array([[1.0, 0.0, 0.0], [0.494207, 0.0, 1.24827], [0.0, 0.0, 1.0]])
    seen = np.linalg.inv(to_lms) @ blind @ to_lms @ rgb
    return np.asarray(np.clip(seen, 0.0, 1.0) ** (1 / 2.2))


def test_colours_are_told_apart_without_green_cones() -> None:
    colours = [Look.numbered(number).colour for number in range(6)]
    apart = [np.linalg.norm(np.subtract(*map(_seen_by_a_deuteranope, pair))) for pair in combinations(colours, 2)]
    assert min(apart) > 0.12
    red_green = np.linalg.norm(np.subtract(*map(_seen_by_a_deuteranope, ("#b04040", "#6f8a3a"))))
    assert red_green < 0.12  # the measure sees what it should
