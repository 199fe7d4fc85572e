"""Tetrahedral meshes: what is refused, and what is provably safe and mended."""

from __future__ import annotations

import itertools
import logging

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from dvc.errors import GeometryError, InputError
from dvc.mesh import TetMesh

SIDE = 10.0


def block(n: int = 2) -> tuple[np.ndarray, np.ndarray]:
    """A cube of 10 mm, off the origin, cut into 6 n^3 tetrahedra of positive volume."""
    axis = np.linspace(0.0, SIDE, n + 1)
    points = np.array(list(itertools.product(axis, axis, axis))) + np.array([5.0, -20.0, 40.0])
    cells = []
    for corner in itertools.product(range(n), repeat=3):
        for order in itertools.permutations(range(3)):
            path = [np.array(corner)]
            for step in order:
                path.append(path[-1] + np.eye(3, dtype=int)[step])
            cell = [int(np.dot(node, [(n + 1) ** 2, n + 1, 1])) for node in path]
            odd = order in {(0, 2, 1), (1, 0, 2), (2, 1, 0)}
            cells.append([cell[0], cell[1], cell[3], cell[2]] if odd else cell)
    return points, np.array(cells)


def skin(cells: np.ndarray) -> np.ndarray:
    """Two triangles that are faces of the mesh."""
    return cells[:2, :3]


def test_volumes_centroids_and_bounds_of_a_cube() -> None:
    points, cells = block()
    mesh = TetMesh(points, cells)
    np.testing.assert_allclose(mesh.volumes_mm3, SIDE**3 / 48, rtol=1e-12)
    np.testing.assert_allclose(mesh.centroids_mm.mean(axis=0), points.mean(axis=0), rtol=1e-12)
    np.testing.assert_array_equal(mesh.bounds_mm, [[5, -20, 40], [15, -10, 50]])


def test_a_mesh_is_read_only_and_the_callers_arrays_stay_as_they_were() -> None:
    points, cells = block()
    mesh = TetMesh(points, cells, {"fat": [0]}, {"skin": skin(cells)})
    points[0] = 99.0
    assert mesh.points_mm.max() < 60
    for array in (mesh.points_mm, mesh.cells, mesh.regions["fat"], mesh.facets["skin"], mesh.node_ids):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    with pytest.raises(TypeError):
        mesh.regions["fat"] = np.array([1])  # type: ignore[index]


def test_all_cells_counted_the_other_way_round_are_renumbered_and_logged(
    caplog: pytest.LogCaptureFixture,
) -> None:
    points, cells = block()
    mesh = TetMesh(points, cells[:, [1, 0, 2, 3]])
    np.testing.assert_allclose(mesh.volumes_mm3.sum(), SIDE**3, rtol=1e-12)
    assert "48 of 48 tetrahedra have the opposite node order" in caplog.text


@settings(max_examples=25, deadline=None)
@given(st.lists(st.permutations(range(4)), min_size=48, max_size=48))
def test_any_order_of_the_nodes_of_each_cell_gives_the_same_mesh(orders: list[list[int]]) -> None:
    points, cells = block()
    mesh = TetMesh(points, np.take_along_axis(cells, np.array(orders), axis=1))
    np.testing.assert_allclose(mesh.volumes_mm3, SIDE**3 / 48, rtol=1e-12)
    np.testing.assert_array_equal(np.sort(mesh.cells, axis=1), np.sort(cells, axis=1))


@pytest.mark.parametrize("permuted", [False, True])
def test_a_mesh_that_folds_over_itself_is_refused(permuted: bool) -> None:
    points, cells = block()
    middle = 13  # the node in the middle of the cube, pushed out through one of its sides
    points[middle, 0] += 8.0
    if permuted:
        cells[::3] = cells[::3][:, [1, 0, 2, 3]]
    with pytest.raises(GeometryError, match=r"folds over itself: .* inverted \(negative volume\)"):
        TetMesh(points, cells)


def test_degenerate_cells_are_refused_with_their_count_and_the_first() -> None:
    points, cells = block()
    cells[7, 3] = cells[7, 0]
    points[cells[20, 0]] = points[cells[20, 1]]
    with pytest.raises(GeometryError, match=r"of 48 tetrahedra are degenerate.* cell 7, nodes"):
        TetMesh(points, cells)


def test_a_flat_but_sound_cell_is_accepted() -> None:
    flat = [[0, 0, 0], [10, 0, 0], [0, 10, 0], [3, 3, 1e-4]]
    assert TetMesh(flat, [[0, 1, 2, 3]]).volumes_mm3[0] == pytest.approx(1e-2 / 6)


def test_unused_nodes_are_dropped_and_the_others_keep_their_numbers(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, logger="dvc.mesh")
    points, cells = block()
    stuffed = np.insert(points, [0, 9], 500.0, axis=0)  # new nodes 0 and 10
    shift = np.array([1] * 9 + [2] * 18)
    renumbered = cells + shift[cells]
    mesh = TetMesh(stuffed, renumbered, facets={"skin": skin(renumbered)}, node_ids=np.arange(29) * 10)
    np.testing.assert_array_equal(mesh.points_mm, points)
    np.testing.assert_array_equal(mesh.cells, cells)
    np.testing.assert_array_equal(mesh.facets["skin"], skin(cells))
    np.testing.assert_array_equal(mesh.node_ids, np.delete(np.arange(29) * 10, [0, 10]))
    assert "2 of 29 nodes are not in any tetrahedron" in caplog.text


def test_a_unit_that_cannot_be_is_refused_with_the_option_to_use() -> None:
    points, cells = block()
    with pytest.raises(GeometryError, match=r"0.01 mm across.*--mesh-unit m"):
        TetMesh(points / 1000, cells)
    with pytest.raises(GeometryError, match=r"10 m across.*--mesh-unit mm"):
        TetMesh(points * 1000, cells)


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"cells": [[0, 1, 3, 27]]}, InputError, "cells: 1 indices are outside 0 to 26; the first is 27"),
        ({"cells": [[0, 1, 3, -1]]}, InputError, "the first is -1"),
        ({"cells": [[0.0, 1.0, 3.0, 4.0]]}, InputError, "indices must be integers; got float64"),
        ({"cells": [[0, 1, 3]]}, InputError, r"shape \(k, 4\); got \(1, 3\)"),
        ({"cells": np.empty((0, 4), dtype=int)}, InputError, "no tetrahedra"),
        ({"points_mm": np.zeros((27, 2))}, InputError, r"\(n, 3\) array.* got shape \(27, 2\)"),
        ({"points_mm": np.full((27, 3), np.nan)}, GeometryError, "27 of 27 nodes .* first is at index 0"),
        ({"regions": {"fat": [48]}}, InputError, "region 'fat': 1 indices are outside 0 to 47"),
        ({"regions": {"fat": []}}, InputError, "'fat' is empty"),
        ({"facets": {"skin": [[0, 1, 99]]}}, InputError, "facets 'skin': .* the first is 99"),
        ({"node_ids": np.zeros(27, dtype=int)}, InputError, "1 of them different"),
    ],
)
def test_what_makes_no_mesh_is_refused(change: dict[str, object], error: type[Exception], message: str) -> None:
    points, cells = block()
    with pytest.raises(error, match=message):
        TetMesh(**({"points_mm": points, "cells": cells} | change))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"points_mm": "a.vtu"}, r"^Nodes of a mesh must be an \(n, 3\) array of numbers \(could not convert"),
        ({"points_mm": [[0, 0, 0], [1, 1]]}, r"^Nodes of a mesh must be an \(n, 3\) array of numbers \("),
        ({"points_mm": object()}, r"^Nodes of a mesh must be an \(n, 3\) array of numbers \("),
        ({"cells": [[0, 1, 2, 3], [0, 1]]}, "^cells: indices must be an array of integers"),
        ({"regions": ["fat"]}, "^regions must be a dict, each value an array.*; got list"),
        ({"facets": np.array([[0, 1, 2]])}, r"^facets must be a dict, .*; got ndarray of shape \(1, 3\)"),
        ({"node_ids": 5}, r"^node_ids must be .* of the 4 nodes; got shape \(\)"),
        ({"node_ids": [0.5, 1, 2, 3]}, r"^node_ids must be .* of the 4 nodes; got shape \(4,\) of float64"),
        ({"node_ids": ["a", "b", "c", "d"]}, r"^node_ids must be .* of the 4 nodes; got shape \(4,\) of <U1"),
        ({"node_ids": [1, 2, 2, 3]}, r"^node_ids must be .* 4 nodes; got shape \(4,\) of int64, 3 of them different"),
    ],
)  # fmt: skip
def test_what_is_no_mesh_is_refused_by_its_name(change, told):
    given = {"points_mm": [[0, 0, 0], [6, 0, 0], [0, 6, 0], [0, 0, 6]], "cells": [[0, 1, 2, 3]]}
    with pytest.raises(InputError, match=told):
        TetMesh(**{**given, **change})
