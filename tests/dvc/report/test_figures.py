"""What is drawn lies where it should: orientation, scale, missing values, and every figure can be read."""

from __future__ import annotations

import io
from collections.abc import Callable
from itertools import permutations, product

import matplotlib.image
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from dvc.errors import GeometryError, InputError
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.report import figures
from dvc.report.drawing import png_bytes
from dvc.report.sheet import LETTERS, PLANES, UNSEEN, Plane, Sheet, View

pytestmark = pytest.mark.usefixtures("real_pictures")

# Where a point that lies 12 mm off the centre in one direction must appear: (across, down), -1, 0 or 1.
SIDES: dict[str, dict[Plane, tuple[int, int]]] = {
    "L": {"coronal": (1, 0), "axial": (1, 0)},
    "R": {"coronal": (-1, 0), "axial": (-1, 0)},
    "P": {"sagittal": (1, 0), "axial": (0, 1)},
    "A": {"sagittal": (-1, 0), "axial": (0, -1)},
    "S": {"sagittal": (0, -1), "coronal": (0, -1)},
    "I": {"sagittal": (0, 1), "coronal": (0, 1)},
}
STEPS = {"L": (1, 0, 0), "R": (-1, 0, 0), "P": (0, 1, 0), "A": (0, -1, 0), "S": (0, 0, 1), "I": (0, 0, -1)}
CENTRE = np.array([7.0, -30.0, 100.0])


def grid_with(order: tuple[int, ...], signs: tuple[int, ...]) -> Grid:
    """An anisotropic grid around CENTRE, whose axes run along any of the world's."""
    direction = np.zeros((3, 3))
    for axis, (world, sign) in enumerate(zip(order, signs, strict=True)):
        direction[world, axis] = sign
    shape, spacing = (41, 33, 21), np.array([1.0, 1.2, 2.0])
    return Grid(shape, spacing, CENTRE - direction @ (spacing * (np.array(shape) - 1) / 2), direction)


def pixels(figure: Figure) -> np.ndarray:
    return matplotlib.image.imread(io.BytesIO(png_bytes(figure)), format="png")[..., :3]


ALL_AXES = [(o, s) for o in permutations(range(3)) for s in product((1, -1), repeat=3)]


@pytest.mark.parametrize(("order", "signs"), ALL_AXES)
def test_slices_lie_on_the_page_as_radiologists_read_them(order: tuple[int, ...], signs: tuple[int, ...]) -> None:
    grid = grid_with(order, signs)
    view = View.through(grid, CENTRE)
    for letter, planes in SIDES.items():
        blob = np.linalg.norm(grid.points() - (CENTRE + 12.0 * np.array(STEPS[letter])), axis=-1) < 3.0
        for plane in PLANES:
            page = view.cut(blob, plane)
            left, right, bottom, top = view.extent_mm(plane)
            if plane not in planes:
                assert not page.any(), (letter, plane)
                continue
            down, across = (np.argwhere(page).mean(axis=0) + 0.5) / page.shape - 0.5
            wanted = planes[plane]
            offset = (across * abs(right - left), down * abs(top - bottom))  # mm on the page
            np.testing.assert_allclose(offset, np.multiply(wanted, 12.0), atol=1.1, err_msg=f"{letter} {plane}")
            # the letter written at that side is the direction's own
            side = {(-1, 0): 0, (1, 0): 1, (0, -1): 2, (0, 1): 3}[wanted]
            assert LETTERS[plane][side] == letter


@pytest.mark.parametrize(("order", "signs"), ALL_AXES[::7])
def test_a_blob_is_painted_on_its_side_of_the_panel(order: tuple[int, ...], signs: tuple[int, ...]) -> None:
    grid = grid_with(order, signs)
    at = CENTRE + np.array([8.0, 8.0, 8.0])  # left, posterior, superior
    near = np.linalg.norm(grid.points() - at, axis=-1) < 3.0
    view = View.through(grid, at)
    white = np.zeros(grid.shape, dtype=np.float32)
    red = np.where(near, -1.0, 1.0).astype(np.float32)
    png = pixels(figures.jacobian_slices(view, Image(grid, white), red))
    sheet = Sheet(view, [""], bar=True)
    height, width = png.shape[:2]
    pure = (png[..., 0] > 0.95) & (png[..., 1] < 0.1) & (png[..., 2] < 0.1)
    for plane, wanted in {"sagittal": (1, -1), "coronal": (1, -1), "axial": (1, 1)}.items():
        box = sheet.rows[0][plane].get_position()  # type: ignore[index]
        panel = pure[round((1 - box.y1) * height) : round((1 - box.y0) * height), :]
        panel = panel[:, round(box.x0 * width) : round(box.x1 * width)]
        down, across = np.argwhere(panel).mean(axis=0) / panel.shape - 0.5
        assert (np.sign(across), np.sign(down)) == wanted, plane


def test_panels_share_one_physical_scale() -> None:
    view = View.through(grid_with((2, 0, 1), (-1, 1, 1)), CENTRE)
    sheet = Sheet(view, ["above", "below"], bar=True)
    inches = sheet.figure.get_size_inches()
    scales = []
    for row in sheet.rows:
        for plane, axes in row.items():
            box = axes.get_position()
            left, right, bottom, top = view.extent_mm(plane)
            scales += [box.width * inches[0] / (right - left), box.height * inches[1] / abs(top - bottom)]
    np.testing.assert_allclose(scales, scales[0], rtol=1e-9)


def test_oblique_grids_say_so_and_others_tell_the_place() -> None:
    grid = grid_with((0, 1, 2), (1, 1, 1))
    assert View.through(grid, CENTRE).title("axial") == "Axial, z = 100 mm"
    assert View.through(grid, CENTRE).title("coronal") == "Coronal, y = −30 mm"
    tilted = grid.moved_by(Rotation.from_euler("x", 15, degrees=True).as_matrix(), np.zeros(3))
    view = View.through(tilted, tilted.centre_mm)
    assert view.title("axial") == "Axial, along image axes (tilted 15°)"
    assert view.title("sagittal").startswith("Sagittal, x")  # its normal is the axis of the tilt


@pytest.mark.parametrize("side", [-12.0, 12.0])
def test_view_is_cropped_to_the_mask_and_keeps_the_point(side: float) -> None:
    grid = grid_with((0, 1, 2), (1, 1, 1))
    mask = np.linalg.norm(grid.points() - CENTRE, axis=-1) < 5.0
    view = View.through(grid, CENTRE + np.array([side, 0.0, 0.0]), mask, margin_mm=2.0)
    assert view.shown(mask).sum() == mask.sum()
    assert view.box[0].start <= view.index[0] < view.box[0].stop
    assert view.cut(mask, "axial").shape < (grid.shape[1], grid.shape[0])
    with pytest.raises(GeometryError, match="outside the image"):
        View.through(grid, CENTRE + np.array([500.0, 0.0, 0.0]))
    with pytest.raises(GeometryError, match="cannot be shown"):
        view.cut(np.zeros((3, 3, 3)), "axial")


GRID = grid_with((1, 2, 0), (1, -1, 1))
VIEW = View.through(GRID, CENTRE)
RADIUS = np.linalg.norm(GRID.points() - CENTRE, axis=-1)
REFERENCE = Image(GRID, np.where(RADIUS < 15, 100.0 + RADIUS, 5.0).astype(np.float32))
SHEAR = np.where(RADIUS < 15, RADIUS / 30, np.nan).astype(np.float32)
LABELS = LabelMap(GRID, (RADIUS < 15).astype(int) + (RADIUS < 6), {1: "fat <i>$", 2: "bone", 7: "absent"})
MOVED = np.where((RADIUS < 15)[..., None], GRID.points() * 0.0 + [1.0, 2.0, 3.0], np.nan).astype(np.float32)
NOTHING = np.full(GRID.shape, np.nan, dtype=np.float32)

DRAWN: dict[str, Callable[[np.ndarray], Figure]] = {
    "overlay": lambda a: figures.overlay(VIEW, REFERENCE, a, a),
    "checkerboard": lambda a: figures.checkerboard(VIEW, REFERENCE, a, a),
    "strain": lambda a: figures.strain_slices(VIEW, REFERENCE, a, 0.5, LABELS),
    "bare": lambda a: figures.image_slices(VIEW, REFERENCE, a, 0.5, LABELS),
    "jacobian": lambda a: figures.jacobian_slices(VIEW, REFERENCE, a),
    "similarity": lambda a: figures.similarity_slices(VIEW, a, a),
    "curves": lambda a: figures.shear_curves(a, LABELS, noise_floor=0.04),
    "grid": lambda a: figures.deformed_grid(VIEW, a, MOVED, RADIUS < 6),
    "bone": lambda _: figures.bone_slices(REFERENCE, Mask(GRID, RADIUS < 7), Mask(GRID, RADIUS < 6)),
}


@pytest.mark.parametrize("name", DRAWN)
@pytest.mark.parametrize("values", [SHEAR, NOTHING], ids=["values", "nothing known"])
def test_every_figure_is_a_png_of_readable_size_and_repeats(name: str, values: np.ndarray) -> None:
    png = png_bytes(DRAWN[name](values))
    height, width = pixels(DRAWN[name](values)).shape[:2]
    assert 600 <= width <= 1200
    assert 250 <= height <= 1200
    assert len(png) < 1_500_000
    assert png == png_bytes(DRAWN[name](values))
    assert b"matplotlib" not in png.lower()


@pytest.mark.parametrize("draw", [figures.overlay, figures.checkerboard])
def test_what_the_loaded_scan_does_not_show_is_not_drawn_as_dark(draw: Callable[..., Figure]) -> None:
    half = REFERENCE.values.copy()
    half[GRID.points()[..., 0] > CENTRE[0]] = np.nan  # the patient's left
    blue = [
        np.abs(pixels(draw(VIEW, REFERENCE, carried, REFERENCE.values)) - UNSEEN).max(axis=-1) < 0.02
        for carried in (REFERENCE.values, half)
    ]
    assert blue[0].mean() < 0.001
    assert blue[1].mean() > 0.03


def test_overlay_is_grey_where_images_agree_green_or_magenta_where_not() -> None:
    def page(carried: np.ndarray) -> np.ndarray:
        return pixels(figures.overlay(VIEW, REFERENCE, carried, carried))

    def coloured(picture: np.ndarray) -> float:
        return float((np.abs(picture[..., 0] - picture[..., 1]) > 0.3).mean())

    shifted, empty = page(np.roll(REFERENCE.values, 4, axis=0)), page(np.zeros_like(REFERENCE.values))
    assert coloured(page(REFERENCE.values)) < 0.01  # of which the yellow marks
    assert coloured(shifted) > 0.04
    assert (np.abs(shifted[..., 0] - shifted[..., 2]) > 0.3).mean() < 0.01  # red and blue go together
    assert ((empty[..., 1] > 0.6) & (empty[..., 0] < 0.2)).mean() > 0.1  # the unloaded image alone is green


def test_strain_without_a_value_leaves_the_image_plain() -> None:
    def saturated(page: np.ndarray) -> float:
        panels = page[: int(page.shape[0] * 0.8)]  # the colour bar lies below
        return float((panels.max(axis=-1) - panels.min(axis=-1) > 0.15).mean())

    zero = np.zeros(GRID.shape, dtype=np.float32)
    assert saturated(pixels(figures.strain_slices(VIEW, REFERENCE, NOTHING, 0.5))) < 0.01
    assert saturated(pixels(figures.strain_slices(VIEW, REFERENCE, zero, 0.5))) > 0.5


def test_the_bone_has_a_line_for_the_mask_and_one_for_the_surface_that_is_used() -> None:
    def share(given: float, used: float, colour: str) -> float:
        masks = (Mask(GRID, r > RADIUS) for r in (given, used))
        page = pixels(figures.bone_slices(REFERENCE, *masks))
        return float((np.abs(page - np.array(to_rgb(colour))).max(axis=-1) < 0.1).mean())

    orange, blue = "#FFB000", "#56D4FF"
    assert share(9.0, 6.0, blue) > share(9.0, 6.0, orange) > 0.001
    assert share(6.0, 6.0, blue) < 0.2 * share(9.0, 6.0, blue)  # the line of the surface covers that of the mask


def test_a_strain_that_fades_leaves_outlines_and_the_colour_bar() -> None:
    full, bare = (pixels(DRAWN[name](SHEAR)) for name in ("strain", "bare"))
    panels = int(full.shape[0] * 0.8)
    assert (full[panels:] == bare[panels:]).all()
    assert (bare[panels:].max(axis=-1) - bare[panels:].min(axis=-1) > 0.15).any()  # the bar is in colour
    coloured = full.max(axis=-1) - full.min(axis=-1) > 0.15
    assert coloured[:panels].mean() > 0.05
    assert (bare[:panels].max(axis=-1) - bare[:panels].min(axis=-1) > 0.15).mean() < 0.01  # the yellow marks
    white = [(page[:panels].min(axis=-1) > 0.95) for page in (full, bare)]
    plain = pixels(figures.image_slices(VIEW, REFERENCE, SHEAR, 0.5))[:panels].min(axis=-1) > 0.95
    drawn = white[0] & ~plain
    assert drawn.sum() > 100
    assert (white[1] & drawn).sum() > 0.95 * drawn.sum()


def test_folding_is_red_and_a_mere_compression_is_not() -> None:
    def red(jacobian: float) -> int:
        field = np.where(RADIUS < 5, jacobian, 1.0).astype(np.float32)
        page = pixels(figures.jacobian_slices(VIEW, REFERENCE, field))
        return int(((page[..., 0] > 0.95) & (page[..., 1] < 0.1) & (page[..., 2] < 0.1)).sum())

    assert red(0.05) == 0
    assert red(0.0) > 100
    assert red(-0.5) > 100


@settings(max_examples=25, deadline=None)
@given(
    st.tuples(*[st.floats(-4.0, 4.0)] * 3), st.integers(0, len(ALL_AXES) - 1), st.tuples(*[st.floats(-12.0, 12.0)] * 3)
)
def test_material_lines_are_carried_by_the_displacement(
    u: tuple[float, float, float], number: int, angles: tuple[float, float, float]
) -> None:
    turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    grid = grid_with(*ALL_AXES[number]).moved_by(turn, np.zeros(3))
    view = View.through(grid, grid.centre_mm)
    # on the page, across is x or y and up is z of axes turned with the grid: sagittal (y, z), coronal (x, z)
    x, y, z = turn.T @ u
    wanted: dict[Plane, tuple[float, float]] = {"sagittal": (y, z), "coronal": (x, z)}
    for plane, shift in wanted.items():
        straight, moved = (
            np.concatenate(figures.carried_lines(view, plane, np.broadcast_to(v, (*grid.shape, 3))))
            for v in (np.zeros(3), np.array(u))
        )
        np.testing.assert_allclose(moved - straight, np.broadcast_to(shift, moved.shape), atol=1e-9)


def test_material_lines_end_where_there_is_no_result() -> None:
    inside = VIEW.extent_mm("coronal")
    lines = np.concatenate(figures.carried_lines(VIEW, "coronal", MOVED))
    centre = np.array([(inside[0] + inside[1]) / 2, (inside[2] + inside[3]) / 2])
    # the field is defined within 15 mm of the centre and shifts by (1, 3) mm in this plane
    assert np.linalg.norm(lines - centre - [1.0, 3.0], axis=1).max() < 15.5
    assert figures.carried_lines(VIEW, "coronal", np.full((*GRID.shape, 3), np.nan)) == []


def test_arguments_that_cannot_be_drawn_are_refused() -> None:
    with pytest.raises(GeometryError, match="three components"):
        figures.deformed_grid(VIEW, REFERENCE.values, SHEAR, None)
    with pytest.raises(InputError, match="positive"):
        figures.strain_slices(VIEW, REFERENCE, SHEAR, 0.0)
    with pytest.raises(GeometryError, match="cannot be shown"):
        figures.overlay(VIEW, REFERENCE, SHEAR[1:], SHEAR)
