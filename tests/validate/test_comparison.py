"""Curves, location and agreement against closed forms; fields mapped to one mesh; what the measurement cannot tell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dvc.deformation.nodal import OnMesh
from dvc.deformation.protocol import Affine
from dvc.deformation.strain import plate_axes
from dvc.errors import InputError
from dvc.images.image import Grid, LabelMap
from dvc.mesh import TetMesh
from dvc.trust.error_model import POOLED, ErrorTable
from dvc.trust.truth_draws import TruthDraws
from tests.blocks import block
from validate import (
    ALL,
    CellGraph,
    Criteria,
    FeResult,
    LoadCase,
    LoadComparison,
    Threshold,
    area_between,
    bands,
    compare_load,
    map_fields,
    overlap,
    rank_over_loads,
    read_thresholds,
)
from validate.agreement import agreement, skin_on_plate
from validate.location import with_intervals

SIDE = 20.0


def cube(n: int = 8) -> TetMesh:
    """A cube of 20 mm, its lower half fat and its upper half skin; bone lies below it (x < 0)."""
    made = block((n, n, n), (SIDE, SIDE, SIDE), layers=2)
    tissues = {"fat": made.regions["layer 0"], "skin": made.regions["layer 1"]}
    return TetMesh(made.points_mm, made.cells, tissues, made.facets)


def labels() -> LabelMap:
    """Bone where x < 0, fat up to 10 mm, skin beyond; voxels of 1 mm, 4 mm around the cube."""
    grid = Grid((28, 28, 28), np.ones(3), np.full(3, -3.5), np.eye(3))
    x = grid.points().reshape(*grid.shape, 3)[..., 0]
    return LabelMap(grid, np.where(x < 0.0, 3, np.where(x < 10.0, 1, 2)), {1: "fat", 2: "skin", 3: "bone"})


def sheared(gamma: float) -> Affine:
    """Simple shear of z along y."""
    matrix = np.eye(3)
    matrix[1, 2] = gamma
    return Affine(matrix, np.zeros(3))


def max_shear(gamma: float) -> float:
    """(E1 - E3) / 2 of simple shear: E has gamma / 2 off the diagonal and gamma^2 / 2 on it."""
    return 0.5 * float(np.hypot(gamma, gamma**2 / 2.0))


def result(name: str, mesh: TetMesh, affine: Affine) -> FeResult:
    return FeResult(name, Path(name), OnMesh(mesh, affine.displacement(mesh.points_mm)))


def test_area_between_curves_of_uniform_strains_has_its_closed_form() -> None:
    shear = (np.arange(200_000) + 0.5) / 200_000  # V(s) = 1 - s, for a volume of 1
    volumes = np.full(len(shear), 1.0 / len(shear))
    assert area_between(shear, shear, volumes) == 0.0
    # twice the strain: V(s) = 1 - s / 2, so the area is the integral of s / 2 from 0.2 to 0.5
    assert area_between(2.0 * shear, shear, volumes) == pytest.approx((0.25 - 0.04) / 4.0, rel=1e-4)
    assert area_between(shear, 2.0 * shear, volumes, (0.0, 1.0)) == pytest.approx(0.25, rel=1e-4)
    # place does not matter, volume does
    assert area_between(shear[::-1], shear, volumes) == pytest.approx(0.0, abs=1e-12)
    assert area_between(2.0 * shear, shear, 3.0 * volumes) == pytest.approx(3.0 * 0.0525, rel=1e-4)
    # of two cells, 1 and 3 mL, the small one goes from 0.3 to 0.4
    apart = area_between(np.array([0.3, 0.6]), np.array([0.4, 0.6]), np.array([1.0, 3.0]))
    assert apart == pytest.approx(0.1, rel=1e-9)


def test_a_spot_that_is_moved_is_found_as_far_away() -> None:
    mesh = cube(16)
    points, cells = mesh.centroids_mm, CellGraph.of(mesh)

    def spot(at: tuple[float, float, float]) -> np.ndarray:
        return 0.6 * np.exp(-((points - at) ** 2).sum(axis=1) / (2.0 * 3.0**2))

    still = overlap("m", "l", 0.3, spot((10, 10, 8)), spot((10, 10, 8)), cells, 0.01)
    assert (still.dice, still.centroids_mm, still.hausdorff95_mm) == (1.0, 0.0, 0.0)
    moved = overlap("m", "l", 0.3, spot((10, 10, 8)), spot((10, 10, 12)), cells, 0.01)
    assert moved.centroids_mm == pytest.approx(4.0, abs=0.15)
    assert moved.largest_mm == pytest.approx(4.0, abs=0.15)
    assert 2.5 < moved.hausdorff95_mm < 4.2
    radius = 3.0 * np.sqrt(2.0 * np.log(2.0))  # where the spot falls to 0.3
    assert moved.measured_ml == pytest.approx(4.0 / 3.0 * np.pi * radius**3 / 1000.0, rel=0.06)
    h = radius - 2.0  # two spheres 4 mm apart share two caps of this height
    shared = 2.0 * np.pi * h**2 * (3.0 * radius - h) / 3.0
    assert moved.dice == pytest.approx(shared / (4.0 / 3.0 * np.pi * radius**3), abs=0.06)


def test_clusters_are_connected_and_large_enough() -> None:
    mesh = cube(12)
    points, cells = mesh.centroids_mm, CellGraph.of(mesh)
    shear = np.where(points[:, 0] < 4.0, 0.5, np.where(points[:, 0] > 14.0, 0.7, 0.1))
    found = cells.clusters(shear > 0.3, shear)
    assert [round(c.mean_shear, 9) for c in found] == [0.7, 0.5]
    assert found[0].volume_ml > found[1].volume_ml > 1.0
    least = 1.01 * found[1].volume_ml
    larger = cells.clusters(shear > 0.3, shear, least_ml=least)
    assert [c.volume_ml for c in larger] == [found[0].volume_ml]
    assert cells.clusters(shear > 0.9, shear) == []


def test_a_speck_far_away_moves_nothing_and_clusters_tell_their_mean() -> None:
    mesh = cube(12)
    points, cells = mesh.centroids_mm, CellGraph.of(mesh)
    slab = points[:, 0] < 5.0
    measured = np.where(slab, 0.4 + 0.04 * points[:, 0], 0.1)
    model = np.where(points[:, 0] < 20.0 / 3.0, 0.5, 0.1)
    clean = overlap("m", "l", 0.3, measured, model, cells)
    # by volume a linear field has the mean of its middle
    assert clean.measured_mean == pytest.approx(0.5, abs=1e-9)
    assert clean.model_mean == pytest.approx(0.5)
    assert (clean.measured_ml, clean.model_ml) == pytest.approx((2.0, 8.0 / 3.0))
    assert clean.dice == pytest.approx(2.0 * 2.0 / (2.0 + 8.0 / 3.0))
    assert clean.centroids_mm == pytest.approx(5.0 / 6.0)
    far = measured.copy()
    far[np.argmax(points[:, 0])] = 2.9
    assert repr(overlap("m", "l", 0.3, far, model, cells)) == repr(clean)  # from Python 3.13 on, NaN is not equal
    assert overlap("m", "l", 0.3, far, model, cells, 0.0) != clean
    told = with_intervals([clean], [far] * 4, {"m": model}, cells, 0.1, 1.0)[0]
    assert (told.dice_low, told.dice_high) == pytest.approx((clean.dice, clean.dice))
    assert told.measured_high_ml == pytest.approx(2.0)
    none = overlap("m", "l", 3.0, measured, model, cells)
    assert np.isnan(none.measured_mean)


def test_agreement_has_its_closed_forms() -> None:
    random = np.random.default_rng(0)
    x, noise = random.normal(0.3, 0.1, 100_000), random.normal(0.0, 0.05, 100_000)
    found = agreement(("m", "l", "max_shear", "fat"), x, 0.8 * x + 0.1 + noise, np.ones(len(x)))
    assert found is not None
    assert found.slope == pytest.approx(0.8, abs=0.005)
    assert found.intercept == pytest.approx(0.1, abs=0.002)
    assert found.r2 == pytest.approx(0.0064 / (0.0064 + 0.0025), abs=0.005)
    assert found.bias == pytest.approx(0.04, abs=0.001)
    spread = np.sqrt(0.02**2 + 0.05**2)
    assert found.upper - found.bias == pytest.approx(1.96 * spread, rel=0.01)
    assert found.rmse == pytest.approx(np.hypot(0.04, spread), rel=0.01)
    assert found.concordance == pytest.approx(2 * 0.8 * 0.01 / (0.01 + 0.0064 + 0.0025 + 0.0016), abs=0.005)
    # a cell of twice the volume counts as two cells
    twice = agreement(("m", "l", "max_shear", "fat"), x[:20], x[20:40], np.repeat([1.0, 2.0], 10))
    listed = agreement(
        ("m", "l", "max_shear", "fat"),
        np.concatenate([x[:20], x[10:20]]),
        np.concatenate([x[20:40], x[30:40]]),
        np.ones(30),
    )
    assert twice is not None
    assert listed is not None
    assert (twice.slope, twice.rmse) == pytest.approx((listed.slope, listed.rmse))


def test_fields_are_compared_at_the_same_points_by_tissue_and_distance() -> None:
    mesh = cube()
    found = map_fields(mesh, labels(), ["bone"], sheared(0.4), {"half": sheared(0.2)})
    assert found.measured.max_shear == pytest.approx(max_shear(0.4))
    assert found.models["half"].max_shear == pytest.approx(max_shear(0.2))
    assert found.volumes_ml.sum() == pytest.approx(8.0)
    assert found.volumes_ml[found.tissue == "fat"].sum() == pytest.approx(4.0)
    assert found.to_bone_mm == pytest.approx(found.points_mm[:, 0], abs=0.75)
    # what a model does not reach is left out for all, and counted
    part = TetMesh(mesh.points_mm, mesh.cells[mesh.centroids_mm[:, 1] < 10.0])
    small = OnMesh(part, sheared(0.2).displacement(part.points_mm))
    some = map_fields(mesh, labels(), ["bone"], sheared(0.4), {"whole": sheared(0.2), "part": small})
    assert some.coverage()["part"] == pytest.approx(4.0, rel=0.1)
    assert some.coverage()["common"] == some.coverage()["part"]
    with pytest.raises(InputError, match="no label 'calcaneus'"):
        map_fields(mesh, labels(), ["calcaneus"], sheared(0.4), {})


def test_equal_fields_have_no_difference_and_axis_slips_show() -> None:
    mesh = cube()
    truth = Affine(np.array([[1.1, 0.0, 0.0], [0.3, 0.95, 0.1], [0.0, 0.2, 0.97]]), np.array([0.5, -1.0, 2.0]))
    swapped = Affine(truth.matrix[[1, 0, 2]][:, [1, 0, 2]], truth.translation_mm[[1, 0, 2]])
    turned = Affine(np.diag([-1.0, -1.0, 1.0]) @ truth.matrix @ np.diag([-1.0, -1.0, 1.0]), -truth.translation_mm)
    results = [result("equal", mesh, truth), result("swapped", mesh, swapped), result("turned", mesh, turned)]
    one = compare_load(case("Load1", truth, results), labels())
    area = {a.model: a.ml for a in one.areas if a.tissue == ALL}
    assert area["equal"] == pytest.approx(0.0, abs=1e-9)
    rows = {(a.model, a.quantity): a for a in one.agreements if a.part == ALL}
    assert rows["equal", "max_shear"].rmse == pytest.approx(0.0, abs=1e-9)
    assert rows["equal", "u_mm"].rmse == pytest.approx(0.0, abs=1e-9)
    # a wrong order of axes or a wrong frame leaves the principal strains as they are: displacement tells
    for name in ("swapped", "turned"):
        assert rows[name, "u_mm"].rmse > 1.0
    assert all(o.dice == 1.0 for o in one.overlaps if o.model == "equal" and o.measured_ml > 0.0)


def case(load: str, measured: Affine, results: list[FeResult], error: ErrorTable | None = None) -> LoadCase:
    """A load under a plate that lies across x."""
    axes = plate_axes((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    return replace(LoadCase.of(load, measured, results, error), axes=axes)


def error_table(bias: float, sd: float, widening: float = 1.0) -> ErrorTable:
    cells = {POOLED: np.stack([np.full((1, 2), bias), np.full((1, 2), sd)])}
    return ErrorTable(np.ones(3), 25.0, np.array([0.0, 1.0]), np.zeros(1), cells, (cells,), 4.0, widening)


def test_draws_have_the_tables_bias_deviation_and_correlation() -> None:
    mesh = cube(12)
    points = mesh.centroids_mm
    draws = TruthDraws(
        points, np.full(len(points), 0.5), ["fat"] * len(points), np.ones(len(points)), error_table(0.1, 0.05)
    )
    many = np.array([draws.drawn() for _ in range(300)])
    assert many.mean() == pytest.approx(0.4, abs=0.005)
    assert many.std() == pytest.approx(0.05, rel=0.05)
    noise = many - 0.4
    near = np.linalg.norm(points - points[0], axis=1)
    correlation = (noise * noise[:, :1]).mean(axis=0) / 0.05**2
    assert correlation[(near > 3.5) & (near < 4.5)].mean() == pytest.approx(np.exp(-1.0), abs=0.1)
    assert abs(correlation[near > 12.0].mean()) < 0.1


def test_intervals_of_areas_hold_the_truth_and_noise_is_called_so() -> None:
    mesh = cube(10)
    points, volumes = mesh.centroids_mm, mesh.volumes_mm3 / 1000.0
    everywhere = {ALL: np.ones(len(points), dtype=bool)}
    truth = 0.2 + 0.4 * points[:, 0] / SIDE
    models = {"near": truth + 0.02, "as near": truth - 0.021, "far": truth + 0.1}
    true_area = {name: area_between(truth, field, volumes) for name, field in models.items()}
    held, told, held_by_equal = [], [], []
    models["equal"] = truth
    for seed in range(20):  # intervals that hold 70 % would be noticed in 29 of 30 tests
        tissue, distance = ["fat"] * len(points), np.ones(len(points))
        # found = truth + bias + noise; draws take bias and noise away again
        noise = (
            0.5
            - TruthDraws(
                points, np.full(len(points), 0.5), tissue, distance, error_table(0.0, 0.04), 100 + seed
            ).drawn()
        )
        draws = TruthDraws(points, truth + 0.01 + noise, tissue, distance, error_table(0.01, 0.04), seed)
        band = bands((draws.drawn() for _ in range(200)), models, volumes, everywhere, lambda _: 1.3, draws.narrowed)[
            ALL
        ]
        _, low, high, _ = band.interval("far")
        held_by_equal.append(band.interval("equal")[1] == 0.0)
        held.append(low <= true_area["far"] <= high)
        told.append(
            (band.surely_below("near", "far"), band.surely_below("near", "as near"), band.surely_below("far", "near"))
        )
    assert np.mean(held) > 0.85
    assert np.mean(held_by_equal) > 0.9  # a perfect model's interval begins at 0
    seen, noisy, wrong = np.mean(told, axis=0)
    assert seen > 0.9
    assert noisy < 0.2
    assert wrong == 0.0


SPREADS = {
    "concentrated": lambda share: np.full(len(share), 0.35),
    "narrow": lambda share: 0.33 + 0.04 * share,
    "ramp": lambda share: 0.2 + 0.4 * share,
    "exponential": lambda share: -0.25 * np.log(1.0 - 0.999 * share),
}


@pytest.mark.parametrize("spread", SPREADS)
def test_a_perfect_model_is_not_ruled_out_however_strain_is_spread(spread: str) -> None:
    mesh = cube(10)
    points, volumes = mesh.centroids_mm, mesh.volumes_mm3 / 1000.0
    truth = SPREADS[spread](np.argsort(np.argsort(points @ [1.0, 1e-3, 1e-6])) / len(points))
    models = {"equal": truth, "off": truth - 0.12}
    true = area_between(truth, models["off"], volumes)
    tissue, distance, everywhere = ["fat"] * len(points), np.ones(len(points)), {ALL: np.ones(len(points), dtype=bool)}
    flat, held, from_zero = np.full(len(points), 0.5), [], []
    for seed in range(8):
        noise = 0.5 - TruthDraws(points, flat, tissue, distance, error_table(0.0, 0.04), 100 + seed).drawn()
        draws = TruthDraws(points, truth + noise, tissue, distance, error_table(0.0, 0.04), seed)
        band = bands((draws.drawn() for _ in range(100)), models, volumes, everywhere, lambda _: 1.3, draws.narrowed)[
            ALL
        ]
        held.append(band.interval("equal")[1] == 0.0)
        low, high = band.interval("off")[1:3]
        from_zero.append(low == 0.0 or not low <= true <= high)
    assert np.mean(held) > 0.85
    assert np.mean(from_zero) < 0.25  # and a wrong model still is told to be wrong, by as much as it is


def test_models_behind_the_nearest_that_noise_cannot_order_are_named_too() -> None:
    mesh, strains = cube(5), (0.2, 0.8)
    # measured .431; one model below it and one above it by the same .117, which noise alone puts in order
    results = [result(name, mesh, sheared(gamma)) for name, gamma in (("below", 0.6), ("right", 0.79), ("above", 0.98))]

    def compared(sd: float) -> list[LoadComparison]:
        cases = [case(load, sheared(0.8), results, error_table(0.0, sd)) for load in ("Load1", "Load2")]
        return [compare_load(one, labels(), criteria=Criteria(strains)) for one in cases]

    ranking = rank_over_loads(compared(0.02))
    first, second, third = (a.model for a in ranking.areas)
    assert (first, {second, third}) == ("right", {"below", "above"})
    for statement in ranking.statements:
        best, area = statement.split(" Area", 1)
        assert best.endswith("(area metric): right, significantly better than every other.")
        assert ("between its strain-volume curve" in area) == ("over all loads" in best)
    assert f"{ranking.nothing.best_ml:.2f} mL a model without deformation." in ranking.statements[0]
    assert ranking.not_distinguishable["all loads"] == ((second, third),)
    for load in ("Load1", "Load2"):
        assert [set(pair) for pair in ranking.not_distinguishable[load]] == [{"below", "above"}]
    assert [ranking.rank(name) for name in (first, second, third, "nobody")] == [(1, 1), (2, 3), (2, 3), None]
    # a measurement that knows nothing tells none apart, and a sure one tells all
    assert [rank_over_loads(compared(5.0)).rank(name) for name in ("right", "below")] == [(1, 3), (1, 3)]
    sure = rank_over_loads(compared(1e-4))
    assert sure.not_distinguishable["all loads"] == ()
    assert sorted(sure.rank(name) for name in ("right", "below", "above")) == [(1, 1), (2, 2), (3, 3)]


def test_intervals_of_location_hold_the_truth_and_a_perfect_model_is_not_ruled_out() -> None:
    mesh = cube(10)
    points, cells = mesh.centroids_mm, CellGraph.of(mesh)

    def spot(x: float) -> np.ndarray:
        return 0.1 + 0.5 * np.exp(-((points - [x, 10.0, 10.0]) ** 2).sum(axis=1) / (2.0 * 5.0**2))

    truth, models = spot(8.0), {"equal": spot(8.0), "apart": spot(13.0)}
    tissue, distance = ["fat"] * len(points), np.ones(len(points))
    flat = np.full(len(points), 0.5)
    ideal = overlap("apart", "l", 0.35, truth, models["apart"], cells)
    held: list[tuple[bool, ...]] = []
    for seed in range(25):
        noise = 0.5 - TruthDraws(points, flat, tissue, distance, error_table(0.0, 0.03), 100 + seed).drawn()
        draws = TruthDraws(points, truth + 0.02 + noise, tissue, distance, error_table(0.02, 0.03), seed)
        found = [overlap(n, "l", 0.35, truth + 0.02 + noise, m, cells) for n, m in models.items()]
        equal, apart = with_intervals(found, [draws.drawn() for _ in range(60)], models, cells, 0.1, 1.3)
        assert (equal.model, apart.model) == ("equal", "apart")
        held.append(
            (
                apart.measured_low_ml <= ideal.measured_ml <= apart.measured_high_ml,
                apart.dice_low <= ideal.dice <= apart.dice_high < 0.8,
                0.0 < apart.centroids_low_mm <= ideal.centroids_mm <= apart.centroids_high_mm,
                0.0 < apart.hausdorff95_low_mm <= ideal.hausdorff95_mm <= apart.hausdorff95_high_mm,
                equal.dice_high == 1.0 and equal.centroids_low_mm == equal.hausdorff95_low_mm == 0.0,
            )
        )
    assert (np.mean(held, axis=0) > 0.85).all(), np.mean(held, axis=0)
    # a truth without tissue above the threshold has no place: fewer than half of the draws are not told
    none, _ = with_intervals(found, [truth, *[0.1 * truth] * 9], models, cells, 0.1, 1.0)
    assert np.isnan(none.centroids_low_mm)
    assert none.measured_low_ml == 0.0


def test_the_skin_on_the_plate_is_found_from_the_deformed_shape() -> None:
    mesh = cube(6)
    points = mesh.points_mm
    # pressed flat from x = 20 down to 17, more in the middle of a bulging surface
    bulge = 2.0 * (1.0 - ((points[:, 1] - 10.0) ** 2 + (points[:, 2] - 10.0) ** 2) / 200.0) * (points[:, 0] / SIDE)
    shaped = TetMesh(points + bulge[:, None] * [1.0, 0.0, 0.0], mesh.cells, mesh.regions, mesh.facets)
    u = np.zeros_like(points)
    over = shaped.points_mm[:, 0] > 20.5
    u[over, 0] = 20.5 - shaped.points_mm[over, 0]
    nodes = skin_on_plate(OnMesh(shaped, u), np.array([1.0, 0.0, 0.0]))
    assert set(np.flatnonzero(over & (points[:, 0] == SIDE))) <= set(nodes)
    assert (shaped.points_mm + u)[nodes, 0].min() > 20.2


def test_a_biased_measurement_ranks_by_what_lies_behind_it() -> None:
    mesh = cube(8)
    volumes = mesh.volumes_mm3 / 1000.0
    truth = 0.2 + 0.4 * mesh.centroids_mm[:, 0] / SIDE
    # found .07 below the truth: a model that copies what was found is nearer to it, and further from the truth
    draws = TruthDraws(
        mesh.centroids_mm, truth - 0.07, ["fat"] * len(truth), np.ones(len(truth)), error_table(-0.07, 0.02)
    )
    models = {"copy": truth - 0.07, "right": truth}
    everywhere = {ALL: np.ones(len(truth), dtype=bool)}
    band = bands((draws.drawn() for _ in range(200)), models, volumes, everywhere, lambda _: 1.0, draws.narrowed)[ALL]
    assert area_between(truth - 0.07, models["copy"], volumes) < area_between(truth - 0.07, truth, volumes)
    assert band.interval("right")[0] < band.interval("copy")[0]
    assert band.surely_below("right", "copy")


def test_thresholds_are_a_table_with_sources(tmp_path) -> None:
    assert all(t.source for t in read_thresholds())
    own = tmp_path / "mine.csv"
    own.write_text("max_shear,source\n0.4,a paper\n")
    assert read_thresholds(own) == (Threshold(0.4, "a paper"),)
    for text in ("max_shear\n0.4\n", "max_shear,source\n-1,x\n", "max_shear,source\n", "max_shear,source\nnan,x\n"):
        own.write_text(text)
        with pytest.raises(InputError, match="thresholds"):
            read_thresholds(own)
