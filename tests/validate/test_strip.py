"""The first picture of a report: each field's own strain, in one slice of the image, whatever the image's axes."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as Pixels

from dvc.images.image import Grid, LabelMap
from dvc.report.drawing import png_bytes
from dvc.report.strips import MEASURED, Strip, strain_by_load
from tests.validate.test_comparison import case, cube, labels, max_shear, result, sheared
from validate import compare_load
from validate.strip import strip_of

pytestmark = pytest.mark.usefixtures("real_pictures")

GAMMAS = {"half": 0.2, "double": 0.8}
POINT = np.array([5.0, 10.0, 12.0])


def turned(given: LabelMap) -> LabelMap:
    """The same label map stored with its axes in another order, one of them backward."""
    grid = given.grid
    direction = np.stack([grid.direction[:, 2], grid.direction[:, 0], -grid.direction[:, 1]], axis=1)
    origin = grid.points_at(np.array([0.0, grid.shape[1] - 1.0, 0.0]))
    shape = grid.shape[2], grid.shape[0], grid.shape[1]
    return LabelMap(Grid(shape, grid.spacing_mm[[2, 0, 1]], origin, direction),
                    given.labels.transpose(2, 0, 1)[:, :, ::-1], given.names)  # fmt: skip


def strip(load: str, gamma: float, given: LabelMap) -> Strip:
    mesh = cube(4)
    models = [result(name, mesh, sheared(of)) for name, of in GAMMAS.items()]
    one = compare_load(case(load, sheared(gamma), models), given)
    return strip_of(one, sheared(gamma), models, POINT)


@pytest.mark.parametrize("given", [labels(), turned(labels())], ids=["LPS", "other axes"])
def test_each_page_has_its_own_fields_strain_in_soft_tissue_alone(given: LabelMap) -> None:
    shown = strip("Load1", 0.4, given)
    # The plate lies across x and shears along y, so the slice is across z: axial, x over y.
    assert (shown.plane, shown.image.shape) == ("axial", (28, 28))
    x = np.arange(28) - 3.5  # columns
    soft = np.broadcast_to(x >= 0.0, (28, 28))
    page = shown.max_shear[MEASURED]
    np.testing.assert_array_equal(np.isfinite(page), soft)
    np.testing.assert_allclose(page[soft], max_shear(0.4), rtol=1e-5)
    for name, gamma in GAMMAS.items():
        model = shown.max_shear[name]
        assert 0.4 < np.isfinite(model).mean() < soft.mean()  # in its own mesh, which is smaller than the image
        np.testing.assert_allclose(model[np.isfinite(model)], max_shear(gamma), rtol=1e-4)
    body, bone = shown.outlines
    assert body.all()
    np.testing.assert_array_equal(bone, ~soft)
    assert shown.image[bone].min() > shown.image[soft].max()  # the label map, since there is no image


def test_measured_stands_above_the_model_and_the_loads_side_by_side() -> None:
    strips = [strip(load, gamma, labels()) for load, gamma in (("Load1", 0.05), ("Load2", 0.9))]
    pixels = np.asarray(
        Pixels.open(io.BytesIO(png_bytes(strain_by_load(strips, (MEASURED, "half"), 0.5)))).convert("RGB"), dtype=float
    )
    height, width = pixels.shape[:2]
    rows, columns = (int(0.25 * height), int(0.62 * height)), (int(0.52 * width), int(0.84 * width))
    green = np.array([[pixels[row, column, 1] for column in columns] for row in rows])
    # viridis grows brighter in green with strain: little, much, and the model's own under both loads
    assert green[0, 0] < green[1, 0] < green[0, 1]
    assert green[1, 0] == pytest.approx(green[1, 1], abs=3.0)


def test_a_load_without_the_model_says_so() -> None:
    strips = [strip(load, 0.4, labels()) for load in ("Load1", "Load2")]
    without = replace(strips[1], max_shear={MEASURED: strips[1].max_shear[MEASURED]})
    both, one = (
        png_bytes(strain_by_load([strips[0], second], (MEASURED, "half"), 0.5)) for second in (strips[1], without)
    )
    assert both != one
