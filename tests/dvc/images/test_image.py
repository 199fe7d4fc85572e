"""What an image, a mask and a label map refuse."""

import numpy as np
import pytest

from dvc import Grid, Image, LabelMap, Mask
from dvc.errors import GeometryError, InputError

GRID = Grid((3, 4, 5), np.ones(3), np.zeros(3))


@pytest.mark.parametrize("values", [np.zeros(GRID.shape), np.ones(GRID.shape, dtype=np.float32)])
def test_a_mask_may_be_zeros_and_ones(values):
    assert Mask(GRID, values).inside.all() == values.any()


def test_grey_values_are_no_mask():
    with pytest.raises(InputError, match="these are grey values"):
        Mask(GRID, np.linspace(0.0, 80.0, 60).reshape(GRID.shape))
    with pytest.raises(InputError, match="these are grey values"):
        Mask(GRID, np.full(GRID.shape, np.nan))


@pytest.mark.parametrize("kind", [Image, Mask, lambda grid, values: LabelMap(grid, values, {})])
def test_another_shape_is_refused(kind):
    with pytest.raises(GeometryError, match=r"\(3, 4, 4\)"):
        kind(GRID, np.zeros((3, 4, 4)))


def test_infinite_values_are_refused():
    with pytest.raises(InputError, match="infinite"):
        Image(GRID, np.full(GRID.shape, np.inf))
