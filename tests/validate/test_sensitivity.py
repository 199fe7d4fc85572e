"""Input uncertainty of models: changes from variants, draws that loads and models share, and the comparison error."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from dvc.deformation.nodal import OnMesh
from dvc.errors import InputError
from dvc.mesh import TetMesh
from tests.blocks import block
from tests.validate.test_comparison import case, cube, error_table, labels, max_shear, sheared
from validate import ALL, Criteria, FeResult, Variant, area_between, bands, compare_load, rank_over_loads
from validate.comparison_error import ComparisonError, validation_section
from validate.sensitivity import Sensitivity, changes_of

STRAINS = (0.2, 0.8)


def moved(mesh: TetMesh, gamma: float) -> OnMesh:
    return OnMesh(mesh, sheared(gamma).displacement(mesh.points_mm))


def model(name: str, cells: TetMesh, gamma: float, **inputs: float) -> FeResult:
    """A uniform shear, with a variant of one standard uncertainty for each input that changes it."""
    variants = [Variant(of.replace("_", "-"), 1.0, lambda g=gamma + c: moved(cells, g)) for of, c in inputs.items()]
    return FeResult.of(name, moved(cells, gamma), variants)


def test_a_variant_on_the_same_cells_changes_them_one_by_one_also_where_its_nodes_moved() -> None:
    mesh = cube(6)
    points, volumes, everywhere = mesh.centroids_mm, mesh.volumes_mm3 / 1000.0, [np.ones(len(mesh.cells), dtype=bool)]
    bent = replace(mesh, points_mm=mesh.points_mm * [1.02, 1.0, 1.0])
    variants = [
        Variant("force", 2.0, lambda: moved(mesh, 0.6)),
        Variant("labels-skin", -1.0, lambda: moved(bent, 0.5)),
        Variant("stiffness", 1.0, lambda: moved(mesh, 0.5)),
        Variant("stiffness", -1.0, lambda: moved(mesh, 0.7)),  # the mean of both: half of the change
    ]
    found = changes_of(moved(mesh, 0.4), variants, points, volumes, everywhere)
    force, labels_skin = (max_shear(g) - max_shear(0.4) for g in (0.6, 0.5))
    assert found["force"] == pytest.approx(0.5 * force)
    assert found["labels-skin"] == pytest.approx(-labels_skin)
    assert found["stiffness"] == pytest.approx(0.5 * (max_shear(0.5) - max_shear(0.7)))
    # beyond the mesh, the nearest cell counts
    outside = changes_of(moved(mesh, 0.4), variants[:1], points + np.array([50.0, 0.0, 0.0]), volumes, everywhere)
    assert outside["force"] == pytest.approx(0.5 * force)


def ramp(mesh: TetMesh, top: float, scatter: float, seed: int) -> OnMesh:
    """Shear that grows with z, and scatter of the nodes that differs from mesh to mesh."""
    z = mesh.points_mm[:, 2]
    noise = np.random.default_rng(seed).normal(0.0, scatter, len(z))
    return OnMesh(mesh, np.column_stack([np.zeros_like(z), 0.5 * top * z**2 / 20.0 + noise, np.zeros_like(z)]))


def test_between_two_meshes_the_change_is_that_of_the_quantile_and_not_the_scatter_of_cells() -> None:
    fine, coarse = cube(10), cube(7)
    points, volumes = fine.centroids_mm, fine.volumes_mm3 / 1000.0
    tissues = [points[:, 0] < 10.0, points[:, 0] >= 10.0]
    variant = Variant("mesh", 1.0, lambda: ramp(coarse, 0.6, 0.02, 2))
    change = changes_of(ramp(fine, 0.8, 0.02, 1), [variant], points, volumes, tissues)["mesh"]
    # a shear of .2 less at the top, of nothing at the bottom, and about half of that in max. shear strain
    ordered = np.sort(change)
    assert ordered[len(change) // 20] == pytest.approx(max_shear(0.55) - max_shear(0.74), abs=0.03)
    assert np.median(change) == pytest.approx(max_shear(0.3) - max_shear(0.4), abs=0.02)


def test_scatter_of_cells_is_no_change_between_two_meshes_and_is_one_on_the_same_cells() -> None:
    fine, coarse = cube(10), cube(8)
    points, volumes, tissues = fine.centroids_mm, fine.volumes_mm3 / 1000.0, [np.ones(6000, dtype=bool)]

    def rough(mesh: TetMesh, count: int, seed: int) -> OnMesh:
        noise = np.random.default_rng(seed).normal(0.0, 1.0 / count, (len(mesh.points_mm), 3))
        return OnMesh(mesh, sheared(0.8).displacement(mesh.points_mm) + noise)

    def spread(of: OnMesh) -> float:
        variant = Variant("mesh", 1.0, lambda: of)
        return float(changes_of(rough(fine, 10, 1), [variant], points, volumes, tissues)["mesh"].std())

    assert spread(rough(coarse, 8, 2)) < 0.3 * spread(rough(fine, 10, 2))


def test_draws_of_shared_inputs_are_the_same_for_all_models_and_those_of_others_are_not() -> None:
    one = {"force": np.ones(3), "mesh": np.zeros(3)}
    a, b = (Sensitivity.of(name, one, 500, seed=3) for name in ("a", "b"))
    assert a.numbers[:, 0].tolist() == b.numbers[:, 0].tolist()
    assert abs(np.corrcoef(a.numbers[:, 1], b.numbers[:, 1])[0, 1]) < 0.15
    assert Sensitivity.of("a", one, 500, seed=4).numbers[0, 0] != a.numbers[0, 0]
    both = Sensitivity.of("a", {"force": np.full(2, 0.3), "poisson": np.full(2, 0.4)}, 4000, seed=1)
    drawn = np.array([both.drawn(k) for k in range(4000)])
    assert drawn.std(axis=0) == pytest.approx(0.5, rel=0.03)  # added in square
    assert drawn[:, 0].tolist() == drawn[:, 1].tolist()  # and alike in all cells


def test_the_comparison_error_has_its_closed_form_and_is_told_by_load_tissue_and_figure() -> None:
    mesh, table = cube(), error_table(0.02, 0.01, widening=2.0)
    result = model("m", mesh, 0.9, force=0.04, poisson=0.03, mesh=-0.02)
    one = compare_load(case("Load1", sheared(0.8), [result], table), labels(), criteria=Criteria(STRAINS))
    rows = {(e.tissue, e.statistic): e for e in one.errors}
    assert {tissue for tissue, _ in rows} == {ALL, "fat", "skin"}
    median = rows[ALL, "median"]
    assert median.simulated == pytest.approx(max_shear(0.9))
    assert median.measured == pytest.approx(max_shear(0.8) - 0.02, abs=0.003)  # without the bias
    assert median.error == pytest.approx(median.simulated - median.measured)
    # of a uniform shear all figures change as the shear does; the mesh by u_num, the others by u_input
    slope = (max_shear(0.901) - max_shear(0.899)) / 0.002
    assert median.u_num == pytest.approx(0.02 * slope, rel=0.05)
    assert median.u_input == pytest.approx(0.05 * slope, rel=0.05)
    assert median.u_d > 0.0
    assert median.u_val == pytest.approx(np.sqrt(median.u_num**2 + median.u_input**2 + median.u_d**2))
    assert (median.low, median.high) == pytest.approx(
        (median.error - 2 * median.u_val, median.error + 2 * median.u_val)
    )
    assert median.significant
    assert not replace(median, low=median.low - 0.02).significant
    bare = compare_load(
        case("Load1", sheared(0.8), [model("m", mesh, 0.9)], table), labels(), criteria=Criteria(STRAINS)
    )
    alone = next(e for e in bare.errors if (e.tissue, e.statistic) == (ALL, "median"))
    assert np.isnan([alone.u_num, alone.u_input]).all()
    assert alone.u_val == pytest.approx(alone.u_d)
    area = rows[ALL, "area"]
    assert (area.low, area.high) == one.bands[ALL].interval("m")[1:3]
    assert area.u_input == pytest.approx(8.0 * 0.05 * slope, rel=0.1)  # of 8 mL
    assert compare_load(case("Load1", sheared(0.8), [result]), labels()).errors == ()  # of a known measurement only


def ranked(**inputs: float) -> tuple[tuple[float, float], bool]:
    """Interval of the better of two models, and whether it is better for sure; both are off by the same inputs."""
    mesh = cube()
    results = [model("near", mesh, 0.9, **inputs), model("far", mesh, 1.05, **inputs)]
    cases = [case(load, sheared(0.8), results, error_table(0.0, 0.01)) for load in ("Load1", "Load2")]
    ranking = rank_over_loads([compare_load(one, labels(), criteria=Criteria(STRAINS)) for one in cases])
    return (ranking.areas[0].low_ml, ranking.areas[0].high_ml), ranking.not_distinguishable["all loads"] == ()


def test_what_two_models_share_does_not_blur_their_order_and_what_is_their_own_does() -> None:
    (low, high), sure = ranked()
    assert sure
    (shared_low, shared_high), shared_sure = ranked(force=0.06)
    assert shared_low < low < high < shared_high
    assert shared_sure
    assert not ranked(poisson=0.06)[1]


def test_wrong_inputs_are_the_same_under_all_loads() -> None:
    mesh = cube()
    result = model("m", mesh, 1.0, poisson=0.05)
    ones = [
        compare_load(case(load, sheared(0.8), [result], error_table(0.0, 0.002)), labels(), criteria=Criteria(STRAINS))
        for load in ("Load1", "Load2")
    ]
    single, total = (next(a for a in of if a.model == "m" and a.tissue == ALL) for of in
                     (ones[0].areas, rank_over_loads(ones).areas))  # fmt: skip
    # twice as far and not 1.4 times: two loads tell no more of a wrong input than one
    assert total.high_ml - total.estimate_ml == pytest.approx(2.0 * (single.high_ml - single.estimate_ml), rel=0.05)


@pytest.mark.parametrize("told", [True, False], ids=["inputs drawn", "inputs taken as exact"])
def test_intervals_hold_the_area_of_the_model_with_right_inputs_as_often_as_they_say(told: bool) -> None:
    mesh, spread = cube(8), 0.03
    points, volumes = mesh.centroids_mm, mesh.volumes_mm3 / 1000.0
    everywhere = {ALL: np.ones(len(points), dtype=bool)}
    truth = 0.2 + 0.4 * points[:, 0] / 20.0
    right = {"near": truth + 0.03, "far": truth + 0.1, "equal": truth}
    held, random = [], np.random.default_rng(5)
    for seed in range(60):
        off = spread * random.standard_normal()
        models = {name: shear + off for name, shear in right.items()}
        change = {"force": np.full(len(points), spread)}
        given = {name: Sensitivity.of(name, change, 100, seed) for name in models} if told else {}
        noisy = (truth + random.normal(0.0, 0.002) for _ in range(100))
        band = bands(noisy, models, volumes, everywhere, lambda _: 1.0, lambda field: field, sensitivities=given)[ALL]
        for name, shear in right.items():
            low, high = band.interval(name)[1:3]
            held.append(
                low <= area_between(truth, shear, volumes) + 1e-9 and high >= area_between(truth, shear, volumes)
            )
    share = np.mean(held)
    assert share > 0.9 if told else share < 0.5


@pytest.mark.parametrize("steps", [0.0, np.nan])
def test_a_variant_without_its_change_is_refused(steps: float) -> None:
    mesh = block((2, 2, 2), (20.0, 20.0, 20.0))
    with pytest.raises(InputError, match="'force' needs the change of the input in standard uncertainties"):
        Variant("force", steps, lambda: moved(mesh, 0.1))


def test_a_figure_that_the_measurement_does_not_show_is_not_counted_as_a_wrong_model() -> None:
    """The measured median lies beyond the range of the drawn curves: there is no error, so none that is significant."""
    results = [model("m", cube(), 1.25, force=0.04)]
    one = compare_load(
        case("Load1", sheared(1.2), results, error_table(0.0, 0.01)), labels(), criteria=Criteria((0.05, 0.2))
    )
    rows = {e.statistic: e for e in one.errors if e.tissue == ALL}
    unknown = [e for name, e in rows.items() if name in ("median", "p95")]
    assert np.isnan([e.error for e in unknown]).all()
    assert not any(e.significant for e in unknown)
    (section,) = validation_section("Load1", one.errors, ALL)
    above = sum(name.startswith("volume above") for name in rows)
    assert f" of {above} quantities" in section.paragraphs[0]  # those with an error
    assert "D and E are not defined beyond the range of the measured curves: median, p95." in section.paragraphs


def test_a_model_is_called_wrong_only_where_its_mesh_and_inputs_are_known() -> None:
    def error(u_num: float, u_input: float) -> ComparisonError:
        return ComparisonError("m", "Load1", ALL, "median", 0.3, 0.2, 0.1, u_num, u_input, 0.01, 0.01, 0.08, 0.12)

    def said(one: ComparisonError) -> str:
        (section,) = validation_section("Load1", [one], ALL)
        return section.paragraphs[0]

    assert "The model form is the likely cause" in said(error(0.001, 0.002))
    for lacking in (error(np.nan, 0.002), error(0.001, np.nan)):
        assert "wrong" not in said(lacking)
        assert "not given (next lines) may" in said(lacking)
