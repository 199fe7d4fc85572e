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
from dvc.report import drawing, figures
from dvc.report.chart import chart, label_axes, legend
from dvc.report.drawing import Drawing, save_figure
from dvc.report.sheet import View
from dvc.report.style import INK, RULE, TISSUES, Look, looks
from tests.pictures import LEAST_CONTRAST, contrast_on_white, pale_lines

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


LOOKS = [Look.numbered(number).colour for number in range(6)]
# Linear RGB as seen without one kind of cones, after Machado, Oliveira and Fernandes (2009), 10.1109/TVCG.2009.113.
CONES = {
    "all": np.eye(3),
    "no red": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "no green": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "no blue": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


def nearest(colours: list[str], cones: str) -> float:
    """Smallest CIE 1976 colour difference of two of them as seen with these cones; 2.3 is just noticeable."""
    rgb = np.array([to_rgb(colour) for colour in colours])
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = np.clip(linear @ np.transpose(CONES[cones]), 0.0, 1.0) @ TO_XYZ.T / TO_XYZ.sum(axis=1)
    x, y, z = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29).T
    lab = np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)
    return float(min(np.linalg.norm(one - other) for one, other in combinations(lab, 2)))


@pytest.mark.parametrize("cones", CONES)
def test_colours_are_distinguishable_with_every_common_kind_of_colour_vision(cones: str) -> None:
    assert nearest(LOOKS, cones) > 16.0
    assert nearest(["#b04040", "#6f8a3a"], "no green") < 16.0 < nearest(["#b04040", "#6f8a3a"], "all")


@pytest.mark.parametrize("cones", CONES)
def test_no_look_is_taken_for_the_measurement_in_black(cones: str) -> None:
    assert nearest([*LOOKS, "black"], cones) > 16.0


def test_lines_of_every_look_can_be_seen_on_white() -> None:
    assert not [colour for colour in (*LOOKS, RULE, INK) if contrast_on_white(colour) < LEAST_CONTRAST]
    assert contrast_on_white("black") == pytest.approx(21.0)
    assert contrast_on_white("#767676") == pytest.approx(4.54, abs=0.01)  # WCAG's own example of what is just legible
    assert contrast_on_white("#E69F00") < LEAST_CONTRAST  # the orange of Okabe and Ito
    assert contrast_on_white("#56B4E9") < LEAST_CONTRAST  # and their sky blue


def test_a_chart_with_a_pale_line_is_found() -> None:
    figure, (axes,) = chart()
    axes.plot([0.0, 1.0], [0.0, 1.0], **looks(["heel"])["heel"].marked)
    axes.axhline(0.5, color=RULE)
    label_axes(axes, "x", "y", "seen")
    assert not pale_lines(figure)
    axes.plot([0.0, 1.0], [1.0, 0.0], color="#E69F00")
    axes.vlines([0.5], 0.0, 1.0, color="black", alpha=0.2)
    assert len(pale_lines(figure)) == 2
    with pytest.raises(AssertionError, match="seen"):
        drawing.png_bytes(figure)
