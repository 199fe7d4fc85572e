"""The page to draw on in a real browser: strokes come back at the voxels where they were drawn."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from dvc import Grid, Image, read_image, read_labels, write_image, write_mask
from dvc.report.sheet import AXES, PLANES, Plane, View
from dvc.report.strokes import write_strokes_page
from mrstrain import draw_strokes
from mrstrain.cli.app import app
from mrstrain.measurement.strokes import read_marks
from phantoms import Heel, heel_grid, labels_of, scan
from tests.browser import CHROMIUM, Tab, browser
from tests.dvc.report.test_page_in_a_browser import ATTACK

pytestmark = pytest.mark.skipif(not CHROMIUM, reason="no Chromium is installed")

OBLIQUE = Rotation.from_euler("xyz", [20.0, -15.0, 30.0], degrees=True).as_matrix()
TURNED = OBLIQUE @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # axes in another order, and flipped
PATIENT_SIDES = {"sagittal": (1, -2), "coronal": (0, -2), "axial": (0, 1)}  # to the right and down, of L, P, S


@pytest.fixture(scope="module")
def tab() -> Iterator[Tab]:
    with browser() as one:
        yield one


def opened(tab: Tab, page: Path, width: int = 1400) -> None:
    """The page in the browser, its image unpacked, with downloads in the page's folder."""
    tab.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(page.parent))
    tab.call("Emulation.setDeviceMetricsOverride", width=width, height=1000, deviceScaleFactor=1, mobile=False)
    tab.open(page)
    tab.wait_for("document.body.dataset.state === 'ready'")


def choose(tab: Tab, tissue: int, brush_mm: float = 0.5) -> None:
    tab.value(f"document.querySelector('[name=tissue][value=\"{tissue}\"]').click()")
    tab.value(f"$('brush').value = {brush_mm}; $('brush').dispatchEvent(new Event('input'))")


def go(tab: Tab, plane: Plane, number: int) -> None:
    """Show a slice, counted from 0 along the axis closest to L, P or S."""
    slider = f"document.querySelector('[data-plane={plane}]').nextElementSibling.querySelector('input')"
    tab.value(f"{slider}.value = {number + 1}; {slider}.dispatchEvent(new Event('input'))")


def draw(tab: Tab, plane: Plane, *spots: tuple[float, float]) -> None:
    """Press the button at the first spot of a canvas, each a share of its width and height, and move to the others."""
    canvas = f"document.querySelector('[data-plane={plane}]')"
    tab.value(f"{canvas}.scrollIntoView({{block: 'center'}})")
    left, top, wide, tall = tab.value(f"Object.values({canvas}.getBoundingClientRect().toJSON()).slice(0, 4)")
    at = [(left + x * wide, top + y * tall) for x, y in spots]
    events = [("mousePressed", at[0]), *(("mouseMoved", one) for one in at[1:]), ("mouseReleased", at[-1])]
    for what, (x, y) in events:
        tab.call("Input.dispatchMouseEvent", type=what, x=x, y=y, button="left", buttons=1, clickCount=1)


def saved(tab: Tab, folder: Path) -> Path:
    """The file that the page saves when its button is pressed."""
    for old in folder.glob("strokes*.nii.gz"):
        old.unlink()
    tab.value("$('save').click()")
    ends, place = time.monotonic() + 30.0, folder / "strokes.nii.gz"
    while not (place.is_file() and place.stat().st_size > 0):  # it is there before its content
        assert time.monotonic() < ends, f"nothing was saved; the console says {tab.said}"
        time.sleep(0.05)
    return place


def marks_of(tab: Tab) -> np.ndarray:
    """How many voxels have each mark."""
    return np.array(tab.value("[0, 1, 2, 3, 4, 5, 6].map((n) => marks.reduce((sum, one) => sum + (one === n), 0))"))


def brightest(tab: Tab, plane: Plane) -> tuple[int, float, float]:
    """The slice that has the brightest spot, and where it is, as a share of width and height; rims do not count."""
    number, x, y = tab.value(
        f"""(() => {{
          const c = document.querySelector('[data-plane={plane}]');
          const slider = c.nextElementSibling.querySelector('input');
          let most = -1, sum = 0, x = 0, y = 0, slice = 0;
          for (let number = 0; number < slider.max; number++) {{
            slider.value = number + 1; slider.dispatchEvent(new Event('input'));
            const w = c.width, h = c.height, data = c.getContext('2d').getImageData(0, 0, w, h).data;
            for (let n = 0; n < w * h; n++) {{
              const [i, j] = [n % w, Math.floor(n / w)], value = data[4 * n];
              if (value < most || Math.min(i, w - i) < 0.12 * w || Math.min(j, h - j) < 0.12 * h) continue;
              if (value > most) [most, slice, sum, x, y] = [value, number, 0, 0, 0];
              sum++; x += (i + 0.5) / w; y += (j + 0.5) / h;
            }}
          }}
          return [slice, x / sum, y / sum];
        }})()"""
    )
    return int(number), float(x), float(y)


@pytest.mark.parametrize("direction", [np.eye(3), OBLIQUE, TURNED], ids=["straight", "oblique", "turned"])
def test_a_stroke_comes_back_at_the_voxel_where_it_was_drawn(tab: Tab, tmp_path: Path, direction: np.ndarray) -> None:
    grid = Grid((20, 26, 16), (1.0, 0.8, 1.5), (-12.0, 30.0, 7.0), direction)
    to_the_left_back_and_top = np.array([3.0, 3.0, 3.0])
    i, j, k = np.rint(grid.indices_of(grid.centre_mm + to_the_left_back_and_top)).astype(int)
    values = np.random.default_rng(1).uniform(0.0, 0.1, grid.shape)
    values[i, j, k] = values[:2, :2] = 1.0  # a bright edge for the brightness of the page
    write_image(tmp_path / "Load0.nii.gz", Image(grid, values))
    draw_strokes(tmp_path / "Load0.nii.gz", out=tmp_path / "page.html")
    opened(tab, tmp_path / "page.html")
    for tissue, plane in enumerate(PLANES, 1):
        number, x, y = brightest(tab, plane)
        go(tab, plane, number)
        for at, side in zip((x, y), PATIENT_SIDES[plane], strict=True):  # as radiologists see it
            assert (at > 0.5) == (side >= 0)
        choose(tab, tissue)
        draw(tab, plane, (x, y))
        strokes = read_labels(saved(tab, tmp_path))
        assert strokes.grid.same_as(read_image(tmp_path / "Load0.nii.gz").grid, 1e-3)
        assert np.argwhere(strokes.labels).tolist() == [[i, j, k]]
        assert strokes.labels[i, j, k] == tissue
        tab.value("$('undo').click()")
    assert tab.said == []


def test_brush_eraser_undo_and_redo(tab: Tab, tmp_path: Path) -> None:
    grid = Grid((40, 40, 20), (1.0, 1.0, 2.0), (0.0, 0.0, 0.0))
    write_strokes_page(tmp_path / "page.html", "a.nii.gz", Image(grid, np.random.default_rng(2).random(grid.shape)))
    opened(tab, tmp_path / "page.html")
    assert tab.value("$('save').disabled && $('undo').disabled && $('redo').disabled")
    choose(tab, 2, brush_mm=7.5)
    draw(tab, "axial", (0.5125, 0.5125))
    round_one = marks_of(tab)
    assert round_one[2] == sum(x * x + y * y <= 3.75**2 for x in range(-4, 5) for y in range(-4, 5))
    choose(tab, 3, brush_mm=7.5)
    draw(tab, "sagittal", (0.5125, 0.525), (0.9, 0.525), (1.4, 0.525))  # beyond the picture: to its end and no further
    both = marks_of(tab)
    assert both[3] > 3 * 19
    assert both[2] < round_one[2]  # the second stroke lies over the first
    choose(tab, 0, brush_mm=7.5)
    draw(tab, "sagittal", (0.5125, 0.525), (0.95, 0.525))
    assert marks_of(tab)[3] < 0.4 * both[3]
    seen = [marks_of(tab).tolist()]
    for _ in range(3):
        tab.call("Input.dispatchKeyEvent", type="keyDown", key="z", code="KeyZ", modifiers=2)
        seen.append(marks_of(tab).tolist())
    assert seen[1:] == [both.tolist(), round_one.tolist(), [grid.shape[0] * grid.shape[1] * grid.shape[2]] + [0] * 6]
    assert tab.value("$('save').disabled")
    for _ in range(3):
        tab.value("$('redo').click()")
    assert marks_of(tab).tolist() == seen[0]
    saved(tab, tmp_path)
    assert tab.said == []


def test_strokes_that_were_saved_are_opened_again_and_others_refused(tab: Tab, tmp_path: Path) -> None:
    grid = Grid((12, 10, 8), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    image = Image(grid, np.random.default_rng(3).random(grid.shape))
    write_strokes_page(tmp_path / "page.html", ATTACK, image)
    opened(tab, tmp_path / "page.html")
    assert tab.value("document.querySelector('h1').textContent") == f"Draw strokes in {ATTACK}"
    assert tab.value("typeof top.ran") == "undefined"
    choose(tab, 4, 3.0)
    draw(tab, "coronal", (0.4, 0.4), (0.6, 0.6))
    before, place = marks_of(tab).tolist(), saved(tab, tmp_path)
    kept = place.rename(tmp_path / "kept.nii.gz")
    write_strokes_page(tmp_path / "other.html", "b.nii.gz", Image(grid.moved_by(np.eye(3), np.ones(3)), image.values))
    for page, wanted in (("page.html", before), ("other.html", [960] + [0] * 6)):
        opened(tab, tmp_path / page)
        document = tab.call("DOM.getDocument")["root"]["nodeId"]
        node = tab.call("DOM.querySelector", nodeId=document, selector="#file")["nodeId"]
        tab.call("DOM.setFileInputFiles", nodeId=node, files=[str(kept)])
        tab.wait_for("$('told').textContent.includes(%r)" % ("skin" if page == "page.html" else "Nothing was changed"))
        assert marks_of(tab).tolist() == wanted
    assert tab.said == []


def test_strokes_drawn_on_the_page_label_a_heel(tab: Tab, tmp_path: Path) -> None:
    heel, grid = Heel(7), heel_grid(1.6)
    image, truth = scan(heel, grid, snr=25.0, number=0), labels_of(heel, grid)
    write_image(tmp_path / "Load0.nii.gz", image)
    write_mask(tmp_path / "bone.nii.gz", truth.region("bone"))  # whose rim is thinner than these voxels
    said = CliRunner().invoke(app, ["label", str(tmp_path / "Load0.nii.gz"), "--draw", str(tmp_path / "page.html")])
    assert said.exit_code == 0, said.output
    assert "--marks strokes.nii.gz" in said.output
    opened(tab, tmp_path / "page.html", width=900)
    view = View.through(grid, truth.region("bone").points().mean(axis=0))
    for number, (name, plane) in enumerate([("bone", "sagittal"), ("fat", "coronal"), ("muscle", "axial")], 1):
        page = view.cut(truth.region(name).inside, plane)
        row = int(page.sum(axis=1).argmax())
        columns = np.flatnonzero(page[row])
        middle, reach = int(columns[len(columns) // 2]), 2
        ends = [n for n in (middle - reach, middle + reach) if page[row, n]] or [middle]
        go(tab, plane, view.index[AXES[plane][0]])
        choose(tab, number)
        draw(tab, plane, *[((n + 0.5) / page.shape[1], (row + 0.5) / page.shape[0]) for n in ends])
    strokes = read_marks(saved(tab, tmp_path), None)
    assert list(strokes.names.values()) == ["bone", "fat", "muscle"]
    for number, name in strokes.names.items():
        assert truth.region(name).inside[strokes.labels == number].mean() > 0.7
    given = {"bone": tmp_path / "bone.nii.gz", "marks": tmp_path / "strokes.nii.gz", "out": tmp_path / "tissues.nii.gz"}
    options = [part for name, path in given.items() for part in (f"--{name}", str(path))]
    said = CliRunner().invoke(app, ["label", str(tmp_path / "Load0.nii.gz"), *options])
    assert said.exit_code == 0, said.output
    made = read_labels(tmp_path / "tissues.nii.gz", tmp_path / "tissues.csv")
    for number, name in strokes.names.items():
        assert made.region(name).inside[strokes.labels == number].mean() > (0.7 if name == "bone" else 0.999)
    assert tab.said == []


@pytest.mark.full_size
def test_a_page_of_a_large_image_opens(tab: Tab, tmp_path: Path) -> None:
    grid = Grid((200, 200, 200), (0.5, 0.5, 0.5), (0.0, 0.0, 0.0))
    write_strokes_page(
        tmp_path / "page.html", "a.nii.gz", Image(grid, np.random.default_rng(4).normal(size=grid.shape))
    )
    assert (tmp_path / "page.html").stat().st_size < 12e6  # of noise alone, which cannot be compressed
    opened(tab, tmp_path / "page.html")
    choose(tab, 1, 5.0)
    draw(tab, "axial", (0.3, 0.3), (0.6, 0.6))
    assert np.count_nonzero(read_labels(saved(tab, tmp_path)).labels) > 500
    assert tab.said == []
