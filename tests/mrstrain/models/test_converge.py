"""What `converge` leaves for `compare`: the solution on the second finest mesh, as the uncertainty of the finest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fe import Limit
from mrstrain.models.converge import Converged, Row, _record_variant
from mrstrain.models.variant_files import variant_folders

NONE = Limit(np.nan, np.nan, 0.1, np.nan)
SHEAR, PLATE = "maximum shear strain of fat, p50", "plate displacement, mm"


def limit(order: float) -> Limit:
    return Limit(0.1, order, 0.0, -0.02)


@pytest.mark.parametrize(
    ("orders", "steps"),
    [
        ({SHEAR: limit(2.0), PLATE: limit(1.0)}, 2.0 * (1.5**2 - 1.0) / 1.25),  # the plate's is another quantity
        ({SHEAR: NONE, PLATE: limit(1.0)}, 2.0 * (1.5 - 1.0) / 3.0),  # no order: the first is assumed, with more doubt
    ],
)
def test_the_second_finest_mesh_is_the_uncertainty_of_the_finest(
    tmp_path: Path, orders: dict[str, Limit], steps: float
) -> None:
    coarse, fine = (tmp_path / f"simulated-{edge}" / "trebbi" for edge in (3, 2))
    for folder in (coarse, fine):
        folder.mkdir(parents=True)
    rows = tuple(Row("Load1", figure, (0.1, 0.1, 0.1), of) for figure, of in orders.items())
    _record_variant(Converged(tmp_path, (3.6, 2.4, 1.6), rows), [tmp_path / "none", coarse, fine])
    (found,) = variant_folders([tmp_path])
    assert (found.place, found.record.model, found.record.input) == (coarse, "trebbi", "mesh")
    assert found.record.steps == pytest.approx(steps)
    assert found.base is not None
    assert found.base.resolve() == fine.resolve()


@pytest.mark.parametrize(
    ("sizes_mm", "fine", "coarse"),
    [((3.6, 2.4, 2.3), 2, 4), ((3.6, 2.3, 2.4), 3, 4)],  # too similar; in thin tissues shorter edges may add no cells
)
def test_a_mesh_that_is_hardly_coarser_is_not_taken(
    tmp_path: Path, sizes_mm: tuple[float, ...], fine: int, coarse: int
) -> None:
    """The difference of two such solutions is scatter, of which the uncertainty would be many times as much."""
    folders = [tmp_path / f"simulated-{edge}" / "trebbi" for edge in (4, 3, 2)]
    for folder in folders:
        folder.mkdir(parents=True)
    rows = (Row("Load1", SHEAR, (0.1, 0.1, 0.1), limit(1.0)),)
    _record_variant(Converged(tmp_path, sizes_mm, rows), folders)
    (found,) = variant_folders([tmp_path])
    assert found.base is not None
    assert (found.place.parent.name, found.base.resolve().parent.name) == (f"simulated-{coarse}", f"simulated-{fine}")
    assert found.record.steps == pytest.approx(2.0 * (3.6 / 2.3 - 1.0) / 1.25)


def test_a_finer_mesh_that_is_added_leaves_one_variant(tmp_path: Path) -> None:
    """`compare` would take the mean of two, one of which is not about the finest mesh."""
    folders = [tmp_path / f"simulated-{edge}" / "trebbi" for edge in (6, 4, 3, 2)]
    for folder in folders:
        folder.mkdir(parents=True)
    rows = (Row("Load1", SHEAR, (0.1, 0.1, 0.1), limit(1.0)),)
    _record_variant(Converged(tmp_path, (5.0, 3.6, 2.4), rows), folders[:3])
    _record_variant(Converged(tmp_path, (5.0, 3.6, 2.4, 1.6), rows), folders)
    (found,) = variant_folders([tmp_path])
    assert found.place == folders[2]
