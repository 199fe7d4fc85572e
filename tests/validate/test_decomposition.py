"""Image decomposition on fields whose coefficients are known, the band, the acceptance, and the probability."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from tests.blocks import block
from validate import (
    CellGraph,
    Decomposition,
    Reconstruction,
    Representation,
    TissueBasis,
    decompose,
    probability_of_representation,
    representation,
)
from validate.decomposition import MOST_DEGREE

SIDE = 20.0


def cells(n: int = 8) -> CellGraph:
    """A cube of 20 mm whose cells become smaller along x, so that volumes count."""
    made = block((n, n, n), (SIDE, SIDE, SIDE))
    points = made.points_mm.copy()
    points[:, 0] = points[:, 0] ** 2 / SIDE
    return CellGraph.of(replace(made, points_mm=points))


def decomposed(values: np.ndarray, models: dict[str, np.ndarray], graph: CellGraph, u_cal: float) -> Decomposition:
    """With true fields that are all the measured one."""
    return decompose(values, models, graph, u_cal, np.stack([values, values]))


def gram(basis: TissueBasis) -> np.ndarray:
    return basis.functions.T @ (basis.weights[:, None] * basis.functions)


@pytest.mark.parametrize("degree", [0, 1, 3, 6])
def test_functions_are_orthonormal_by_volume_and_as_many_as_polynomials(degree: int) -> None:
    graph = cells()
    basis = TissueBasis.of(graph.points_mm, graph.volumes_ml, degree)
    assert basis.functions.shape[1] == (degree + 1) * (degree + 2) * (degree + 3) // 6
    assert gram(basis) == pytest.approx(np.eye(basis.functions.shape[1]), abs=1e-12)
    if degree:  # equal weights are another product: the test sees the volumes
        assert np.abs(basis.functions.T @ basis.functions / len(graph.volumes_ml) - gram(basis)).max() > 0.05


def test_a_polynomial_is_put_together_again_and_its_coefficients_are_its_mean_and_mean_square() -> None:
    graph = cells()
    x, y, z = graph.points_mm.T / SIDE
    values = 0.2 + 0.3 * x * y - 0.1 * z**2
    basis = TissueBasis.of(graph.points_mm, graph.volumes_ml, 2)
    found = Reconstruction.of(values, basis, graph)
    weights = graph.volumes_ml / graph.volumes_ml.sum()
    assert basis.field(found.coefficients) == pytest.approx(values, abs=1e-12)
    assert found.coefficients[0] == pytest.approx(weights @ values)
    assert (found.coefficients**2).sum() == pytest.approx(weights @ values**2)
    assert (found.residual, found.clusters) == (pytest.approx(0.0, abs=1e-12), 0)
    less = Reconstruction.of(values, TissueBasis.of(graph.points_mm, graph.volumes_ml, 1), graph)
    assert less.residual > 0.005  # of a lower degree it is none


def test_what_the_basis_shows_does_not_depend_on_the_axes() -> None:
    graph, random = cells(), np.random.default_rng(1)
    turn = np.linalg.qr(random.standard_normal((3, 3)))[0]
    values = np.exp(-((graph.points_mm - 8.0) ** 2).sum(axis=1) / 60.0)
    turned = CellGraph(graph.volumes_ml, graph.points_mm @ turn, graph.adjacency)
    first, second = (
        Reconstruction.of(values, TissueBasis.of(g.points_mm, g.volumes_ml, 4), g) for g in (graph, turned)
    )
    assert first.residual == pytest.approx(second.residual, rel=1e-9)
    assert 0.001 < first.residual < 0.1


def test_a_basis_of_many_cells_is_not_held_twice() -> None:
    """At 80,000 cells, a comparison of two loads side by side needed 0.3 GiB more."""
    points = np.random.default_rng(1).uniform(size=(20_000, 3))
    tracemalloc.start()
    basis = TissueBasis.of(points, np.ones(len(points)), MOST_DEGREE)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert basis.scaled.shape[1] == 286
    assert peak < 2.3 * basis.scaled.nbytes


@pytest.mark.parametrize("slab", [False, True])
def test_coefficients_do_not_hang_on_rounding(slab: bool) -> None:
    """The coordinates of a tissue change by a millionth of a nanometre; in a slab, polynomials depend on each other."""
    random = np.random.default_rng(2)
    points = random.normal(size=(900, 3)) * [30.0, 12.0, 0.0 if slab else 8.0]
    volumes, values = random.uniform(0.5, 1.5, 900), 0.2 + 0.01 * points[:, 0] + 0.1 * random.random(900)
    one, other = (
        TissueBasis.of(at, volumes, 3).coefficients(values)
        for at in (points, points + 1e-12 * random.normal(size=points.shape) * (points != 0.0))
    )
    assert other == pytest.approx(one, abs=1e-9)
    assert len(one) == (10 if slab else 20)
    assert one[0] == pytest.approx(np.average(values, weights=volumes))  # the mean, and not less it


def test_on_a_sphere_there_are_as_many_functions_as_spherical_harmonics() -> None:
    """On a thin shell polynomials depend on each other: (p + 1)^2 are left of degree p, and none follows rounding."""
    points = np.random.default_rng(5).standard_normal((3000, 3))
    points *= 30.0 / np.linalg.norm(points, axis=1)[:, None]
    basis = TissueBasis.of(points, np.ones(len(points)), 4)
    assert basis.functions.shape[1] == 25
    assert gram(basis) == pytest.approx(np.eye(25), abs=1e-10)


def test_no_error_of_a_field_changes_a_coefficient_by_more_than_its_root_mean_square() -> None:
    graph, random = cells(), np.random.default_rng(3)
    basis = TissueBasis.of(graph.points_mm, graph.volumes_ml, 4)
    errors = [random.standard_normal(len(graph.volumes_ml)), basis.functions[:, 7], np.ones(len(graph.volumes_ml))]
    for error in errors:
        size = np.sqrt(basis.weights @ error**2)
        assert np.abs(basis.coefficients(error)).max() <= size * (1.0 + 1e-12)
    assert np.abs(basis.coefficients(errors[1])).max() == pytest.approx(1.0)  # and one of its form by just that


def test_as_many_functions_are_taken_as_the_measurement_needs() -> None:
    graph = cells(10)
    x, y, _ = graph.points_mm.T / SIDE
    values = 0.2 + 0.1 * x + 0.4 * (x - 0.5) ** 3 * y
    noise = 0.004 * np.random.default_rng(2).standard_normal(len(values))
    exact, coarse = decomposed(values, {}, graph, 1e-9), decomposed(values + noise, {}, graph, 0.1)
    assert (exact.degree, exact.accepted) == (4, True)
    assert coarse.degree < 4
    noisy = decomposed(values + noise, {}, graph, 0.0041)
    assert noisy.accepted
    assert noisy.measured.residual == pytest.approx(0.004, rel=0.05)
    assert noisy.degree <= 4
    hopeless = decomposed(values + noise, {}, graph, 0.002)
    assert not hopeless.accepted
    assert hopeless.degree == MOST_DEGREE


def test_a_cluster_of_residuals_is_not_accepted_although_their_mean_is_small() -> None:
    """A spot of a hundredth of the tissue, which polynomials miss; scattered over single cells it is no cluster."""
    graph, random = cells(12), np.random.default_rng(4)
    spot = ((graph.points_mm - 15.0) ** 2).sum(axis=1) < 2.4**2
    basis = TissueBasis.of(graph.points_mm, graph.volumes_ml, 2)
    found = Reconstruction.of(0.2 + 0.3 * spot, basis, graph)
    assert found.clusters == 1
    assert found.residual < 0.05
    assert not found.accepted(0.05)
    scattered = np.zeros(len(spot), dtype=bool)
    scattered[random.choice(len(spot), np.count_nonzero(spot), replace=False)] = True
    loose = Reconstruction.of(0.2 + 0.3 * scattered, basis, graph)
    assert loose.clusters == 0
    assert loose.accepted(0.05)


def test_the_guides_band_joins_the_uncertainty_of_measurement_and_reconstruction() -> None:
    some = Decomposition(1, Reconstruction(np.zeros(4), 0.03, 0), {}, 0.04, np.zeros(4), np.full(4, 0.01))
    assert some.guide_band == pytest.approx(0.1)
    assert some.band == pytest.approx(np.full(4, 0.02))
    assert some.accepted
    assert not replace(some, u_cal=0.02).accepted


def test_the_probability_is_the_share_of_errors_within_the_uncertainty() -> None:
    measured = np.array([0.5, -0.2, 0.1, 0.0])
    assert probability_of_representation(measured, measured, 0.0) == 1.0
    small, large = np.array([0.02, -0.03, 0.0, 0.05]), np.array([0.0, 0.4, 0.0, 0.0])
    assert probability_of_representation(measured, measured + small, 0.06) == 1.0
    assert probability_of_representation(measured, measured + large, 0.06) == 0.0
    mixed = probability_of_representation(measured, measured + small + large, 0.06)
    assert mixed == pytest.approx(0.07 / (0.07 + 0.37))
    # errors count by their size: the number of coefficients within would be three of four
    assert mixed != pytest.approx(0.75, abs=0.1)


def test_a_model_off_in_one_mode_is_in_the_guides_band_for_all_others() -> None:
    graph = cells(10)
    basis = TissueBasis.of(graph.points_mm, graph.volumes_ml, 3)
    measured = 0.2 + 0.05 * basis.functions[:, 12]
    models = {"same": measured, "off": measured + 0.1 * basis.functions[:, 5], "near": 1.1 * measured}
    found = decomposed(measured, models, graph, 0.02)
    rows = {name: representation((name, "Load1", "fat"), found) for name in models}
    assert (rows["same"].in_guide_band, rows["same"].guide_probability) == (20, 1.0)
    assert (rows["off"].in_guide_band, rows["off"].guide_probability) == (19, pytest.approx(0.0, abs=1e-9))
    assert rows["near"].in_guide_band == 20  # its mean is off by 0.02, and all within twice 0.02
    assert rows["off"].accepted
    assert not replace(rows["off"], clusters=1).accepted


def test_uncertainty_carried_to_each_coefficient_covers_and_has_the_power_that_the_guides_lacks() -> None:
    """True fields differ by a bias and by white noise, which changes a coefficient by sd / n^(1/2) alone."""
    graph, random = cells(6), np.random.default_rng(6)
    basis = TissueBasis.of(graph.points_mm, graph.volumes_ml, 3)
    mode, sd, bias = 0.05 * basis.functions[:, 12], 0.04, 0.03
    truth = 0.2 + mode
    models = {"true": truth, "other": truth - mode, "biased-levelled": truth + bias, "biased": truth + bias}
    spread = sd * np.sqrt(((basis.functions[:, 3] * basis.weights) ** 2).sum())
    rows: list[Representation] = []
    for _ in range(30):
        measured = truth + bias + sd * random.standard_normal(len(truth))
        truths = measured - bias - sd * random.standard_normal((100, len(truth)))
        found = decompose(measured, models, graph, 0.06, truths)
        assert found.spread[3] == pytest.approx(spread, rel=0.3)
        wide = decompose(measured, models, graph, 0.06, truths, widening=3.0)
        assert wide.spread == pytest.approx(3.0 * found.spread)
        rows += [representation((name, "Load1", "fat"), found) for name in models]
    within = {name: np.mean([r.in_band / r.coefficients for r in rows if r.model == name]) for name in models}
    assert within["true"] == pytest.approx(0.95, abs=0.025)
    assert within["biased-levelled"] == pytest.approx(0.95, abs=0.025)  # the measured field keeps its bias for it
    assert within["biased"] < within["true"] - 0.03  # the mean alone is off
    probable = {name: np.mean([r.probability for r in rows if r.model == name]) for name in models}
    assert probable["other"] < 0.4
    assert probable["true"] > 0.7
    assert all(r.guide_probability == 1.0 for r in rows)  # any model is in its band
