"""What `converge` leaves for `compare`: the solution on the second finest mesh, as the uncertainty of the finest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fe import Limit
from mrstrain.models.converge import Converged, Row, _record_variant
from mrstrain.models.variant_files import variant_folders

NONE = Limit(np.nan, np.nan, 0.1, np.nan)
SHEAR, PLATE = "maximum shear strain of fat, p50", "plate travel, mm"


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
    _record_variant(Converged(tmp_path, (3.6, 2.4, 1.6), rows), coarse, fine)
    (found,) = variant_folders([tmp_path])
    assert (found.place, found.record.model, found.record.input) == (coarse, "trebbi", "mesh")
    assert found.record.steps == pytest.approx(steps)
    assert found.base is not None
    assert found.base.resolve() == fine.resolve()
