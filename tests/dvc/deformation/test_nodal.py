"""Displacements on a mesh: exact where linear, undefined outside, the same as a search over every cell."""

import numpy as np
import pytest

from dvc.deformation.nodal import Locator, OnMesh
from dvc.deformation.protocol import Deformation, evaluate_on_grid
from dvc.errors import InputError
from dvc.images.image import Grid
from tests.blocks import block

MESH = block((7, 5, 4), (14.0, 10.0, 8.0), wobble=0.25)


def test_every_point_is_found_in_the_cell_that_holds_it() -> None:
    points = np.random.default_rng(1).uniform(-1.0, 15.0, (3000, 3))
    cells, at = Locator(MESH).find(points)
    inside = ((points >= 0) & (points <= [14.0, 10.0, 8.0])).all(axis=1)
    assert np.array_equal(cells >= 0, inside)
    corners = MESH.points_mm[MESH.cells[cells[inside]]]
    weights = np.column_stack([1 - at[inside].sum(axis=1), at[inside]])
    assert np.abs(np.einsum("na,nai->ni", weights, corners) - points[inside]).max() < 1e-12
    assert weights.min() >= -1e-9


def test_nodes_and_corners_belong_to_the_mesh() -> None:
    cells, _ = Locator(MESH).find(MESH.points_mm)
    assert (cells >= 0).all()


def test_a_linear_field_comes_back_exactly() -> None:
    H = np.array([[0.1, 0.2, 0.0], [0.0, -0.1, 0.05], [0.3, 0.0, 0.02]])
    field = OnMesh(MESH, MESH.points_mm @ H.T + 1.0)
    assert isinstance(field, Deformation)
    points = np.random.default_rng(2).uniform([0, 0, 0], [14, 10, 8], (500, 3))
    u, gradient = field.evaluate(points)
    assert np.abs(u - points @ H.T - 1.0).max() < 1e-12
    assert np.abs(gradient - H).max() < 1e-12


def test_outside_is_not_defined() -> None:
    field = OnMesh(MESH, np.zeros_like(MESH.points_mm))
    u, H = field.evaluate(np.array([[-0.01, 5.0, 4.0], [1e6, 0.0, 0.0], [np.nan, 1.0, 1.0], [5.0, 5.0, 4.0]]))
    assert np.isnan(u[:3]).all()
    assert np.isnan(H[:3]).all()
    assert np.isfinite(u[3]).all()


def test_over_a_grid_the_volume_is_the_meshs() -> None:
    grid = Grid((40, 40, 40), (0.5, 0.5, 0.5), (-2.0, -2.0, -2.0))
    u, _ = evaluate_on_grid(OnMesh(MESH, np.ones_like(MESH.points_mm)), grid)
    assert np.count_nonzero(np.isfinite(u[:, 0])) == 29 * 21 * 17  # nodes of the grid on and in the block


def test_a_displacement_for_every_node() -> None:
    with pytest.raises(InputError, match="three finite numbers for each"):
        OnMesh(MESH, np.zeros((4, 3)))
    broken = np.zeros_like(MESH.points_mm)
    broken[3, 1] = np.nan
    with pytest.raises(InputError, match="1 values that are not finite"):
        OnMesh(MESH, broken)
