"""Figures of a comparison that could go wrong unseen, each against its closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import meshio
import nibabel
import numpy as np
import pytest

from dvc.deformation.protocol import Affine
from dvc.deformation.strain import plate_axes
from dvc.images.image import Grid, LabelMap
from mrstrain.comparison.compare import compare
from tests.mrstrain.comparison.test_compare import LOADS, given, rows, with_errors
from tests.validate.test_comparison import SIDE, case, cube, error_table, labels, max_shear, result, sheared
from validate import ALL, Field, agreements, compare_load, map_fields, rank_over_loads, skin_displacement
from validate.agreement import agreement
from validate.figures import slice_panels
from validate.report import draw, lowest_bone_point

X = np.array([1.0, 0.0, 0.0])


def pressed(along: float, across: float) -> Affine:
    """Tissue pressed towards x = 0 and sheared along y, both in proportion to x."""
    matrix = np.eye(3)
    matrix[0, 0], matrix[1, 0] = 1.0 - along, across
    return Affine(matrix, np.zeros(3))


def test_displacement_of_the_skin_is_positive_towards_the_foot_and_volume_change_that_of_the_map() -> None:
    mesh = cube(6)
    model = result("model", mesh, pressed(0.05, -0.1))
    found = map_fields(mesh, labels(), ["bone"], pressed(0.1, 0.05), {"model": model.deformation})
    told = skin_displacement(found, "model", "Load1", model.deformation, pressed(0.1, 0.05), X)
    inside = SIDE - 1.0  # the skin under the plate is looked at 1 mm inside
    assert (told.measured_mm, told.model_mm) == pytest.approx((0.1 * inside, 0.05 * inside))
    assert (told.measured_along_mm, told.model_along_mm) == pytest.approx((0.05 * inside, 0.1 * inside))
    assert (told.measured_volume_change, told.model_volume_change) == pytest.approx((-0.1, -0.05))
    assert told.nodes == 49


def test_volume_change_is_that_of_the_fat_alone() -> None:
    mesh = cube(6)
    model = result("model", mesh, pressed(0.05, 0.0))
    found = map_fields(mesh, labels(), ["bone"], pressed(0.1, 0.0), {"model": model.deformation})
    jacobian = np.where(found.tissue == "fat", 0.93, 0.5)
    found = replace(found, measured=replace(found.measured, jacobian=jacobian))
    told = skin_displacement(found, "model", "Load1", model.deformation, pressed(0.1, 0.0), X)
    assert told.measured_volume_change == pytest.approx(-0.07)


def test_a_graded_field_has_its_means_by_distance_to_bone() -> None:
    found = map_fields(cube(12), labels(), ["bone"], sheared(0.1), {"model": sheared(0.1)})
    distance = found.to_bone_mm
    measured = replace(found.measured, max_shear=0.01 * distance)
    double = Field(found.measured.u_mm, 0.02 * distance + 0.1, found.measured.jacobian)
    by_part = {
        r.part: r
        for r in agreements(replace(found, measured=measured, models={"model": double}), "model", "l")
        if r.quantity == "max_shear"
    }
    for part, middle in (("0 to 3", 1.5), ("3 to 6", 4.5), ("6 to 12", 9.0), ("over 12", 16.0)):
        row = by_part[f"{part} mm from bone"]
        assert row.measured_mean == pytest.approx(0.01 * middle, abs=0.006)
        assert row.model_mean == pytest.approx(2.0 * row.measured_mean + 0.1)
        assert (row.slope, row.intercept) == pytest.approx((2.0, 0.1))
    assert sum(r.cells for p, r in by_part.items() if "from bone" in p) == by_part[ALL].cells


def test_both_limits_of_bland_and_altman_have_their_closed_form() -> None:
    x = np.linspace(0.1, 0.5, 40)
    found = agreement(("m", "l", "max_shear", "fat"), x, x + np.tile([0.01, 0.05], 20), np.ones(40))
    assert found is not None
    assert (found.bias, found.lower, found.upper) == pytest.approx((0.03, 0.03 - 1.96 * 0.02, 0.03 + 1.96 * 0.02))


@pytest.mark.parametrize(("normal", "height"), [((0.0, 0.0, -1.0), 0.0), ((0.0, 0.0, 1.0), 19.0)])
def test_the_lowest_point_of_bone_is_that_of_a_spur_along_the_outward_normal(
    normal: tuple[float, float, float], height: float
) -> None:
    grid = Grid((20, 20, 20), np.ones(3), np.zeros(3), np.eye(3))
    bone = np.zeros(grid.shape, dtype=np.int64)
    bone[4:16, 4:16, 6:14] = 1
    bone[5, 12, :] = 1  # a spur below and above
    bone[18, 18, :] = 2  # another bone, as low
    axes = plate_axes(-np.array(normal), (0.0, -1.0, 0.0))
    found = lowest_bone_point(LabelMap(grid, bone, {1: "calcaneus", 2: "ankle"}), "calcaneus", axes)
    assert found == pytest.approx([5.0, 12.0, height])


@pytest.mark.parametrize(
    ("aside", "words"), [(0.0, "goes through the point of the bone nearest to the plate"), (30.0, "is outside of it")]
)
def test_the_slices_caption_says_where_it_lies(aside: float, words: str) -> None:
    mesh, bone = cube(4), labels()
    model = result("half", mesh, sheared(0.2))
    one = compare_load(case("Load1", sheared(0.4), [model]), bone)
    grid = replace(bone.grid, origin_mm=bone.grid.origin_mm + np.array([0.0, 0.0, aside]))
    pictures, _, _ = draw(replace(one, labels=replace(bone, grid=grid)), ["half"], None, 0.5)
    assert words in pictures["slices"].caption


def test_curves_and_slices_are_drawn_of_each_field_itself() -> None:
    mesh = cube(6)
    gammas = {"half": 0.2, "double": 0.8}
    models = {name: result(name, mesh, sheared(gamma)).deformation for name, gamma in gammas.items()}
    found = map_fields(mesh, labels(), ["bone"], sheared(0.4), models)
    at = np.array([0.5 * max_shear(g) for g in (0.2, 0.6, 1.2, 2.4)])
    for tissue, volume in ((ALL, 8.0), ("fat", 4.0)):
        drawn = found.curves(tissue, at)
        assert list(drawn) == ["measured", *gammas]
        for name, gamma in {"measured": 0.4, **gammas}.items():
            assert drawn[name] == pytest.approx(volume * (max_shear(gamma) > at), abs=1e-9), (tissue, name)
    panels = slice_panels(found, sheared(0.4), {name: model.u_mm for name, model in models.items()})
    for panel, gamma in zip(panels, (0.4, 0.2, 0.8), strict=True):
        assert panel.u_mm == pytest.approx(sheared(gamma).displacement(mesh.points_mm), abs=1e-9)
        assert panel.max_shear == pytest.approx(max_shear(gamma))
    assert [panel.title for panel in panels] == ["measured", *gammas]


FEW = "the measured maximum shear strain exceeds 0.2 in less than 1 % of the tissue"


def test_a_load_that_hardly_strains_does_not_judge_and_a_total_is_a_mean_of_shares() -> None:
    mesh = cube(6)
    results = [result("a", mesh, sheared(0.5)), result("b", mesh, sheared(0.3))]
    weak, strong = (
        compare_load(case(load, sheared(gamma), results, error_table(0.0, 0.001)), labels())
        for load, gamma in (("Load1", 0.38), ("Load2", 0.6))
    )
    assert max_shear(0.38) < 0.2 < max_shear(0.5)
    assert (weak.hardly_strained, strong.hardly_strained) == (True, False)
    ranking = rank_over_loads([weak, strong])
    second, compared, informative = [s for s in ranking.statements if "under Load" in s or s.startswith("Load")]
    assert informative == f"Load1: {FEW}, so the area metric is not informative."
    high = {name: max_shear(gamma) for name, gamma in {"a": 0.5, "b": 0.3, "measured": 0.38}.items()}
    assert compared == (
        f"Load1 (area metric not informative): b predicts {high['b'] / high['measured']:.1f} times the measured strain "
        f"(95th percentile in all soft tissue: {high['b']:.3f} against {high['measured']:.3f} as measured), "
        f"a {high['a'] / high['measured']:.1f} times ({high['a']:.3f})."
    )
    assert second.startswith("Best match under Load2")
    assert ranking.uninformative == ("Load1",)
    fourfold = [result("stiff", mesh, sheared(0.1)), result("soft", mesh, sheared(1.4))]
    for models, tail in (
        (fourfold, "; no better than a model without deformation: soft."),
        (fourfold[1:], ", no better than a model without deformation."),
        (fourfold[:1], ")."),
    ):
        one = compare_load(case("Load1", sheared(0.38), models, error_table(0.0, 0.001)), labels())
        assert rank_over_loads([one]).statements[0].endswith(tail)
    alone = rank_over_loads([weak])
    assert (alone.uninformative, alone.rank("a")) == (("Load1", "all loads"), None)
    areas = {(a.model, a.load): a for one in (weak, strong) for a in one.areas if a.tissue == ALL}
    for row in (*ranking.areas, ranking.nothing):
        parts = [areas[row.model, load] for load in ("Load1", "Load2")]
        assert row.share == pytest.approx(0.5 * (parts[0].share + parts[1].share))
        assert row.ml == pytest.approx(parts[0].ml + parts[1].ml)
    found = areas["b", "Load2"]
    assert found.ml == pytest.approx(8.0 * (max_shear(0.6) - 0.2))
    assert found.share == pytest.approx((max_shear(0.6) - 0.2) / 0.3)


def test_what_is_written_is_what_was_found(study: Path) -> None:
    with_errors(study, 0.01, 0.03)
    mesh = cube(6)
    kept = mesh.cells[mesh.centroids_mm[:, 1] < 10.0]
    (study / "part").mkdir()
    moved = sheared(0.5).displacement(mesh.points_mm)
    meshio.write(study / "part" / "Load1.vtu", meshio.Mesh(mesh.points_mm, [("tetra", kept)], {"u": moved}))
    done = compare(study / "measured" / "Load1", [study / "half", study / "part"], on_image=True, **given(study))
    assert any(note.startswith("Load1: part covers only 50 % of the mesh") for note in done.comparison.notes)
    assert not any("half covers" in note for note in done.comparison.notes)
    (one,) = done.comparison.loads
    written = rows(study / "out" / "curves.csv")
    for tissue, band in one.bands.items():
        for edge, values in (("measured, low", band.low_ml), ("measured, high", band.high_ml)):
            told = [(float(r["max_shear"]), float(r["volume_above_ml"])) for r in written
                    if (r["tissue"], r["field"]) == (tissue, edge)]  # fmt: skip
            at, volume = np.array(told).T
            assert volume == pytest.approx(np.interp(at, band.strains, values), abs=1e-4)
            assert volume.max() > 0.5
    image = nibabel.load(study / "out" / "Load1" / "half_max_shear.nii.gz").get_fdata()
    inside = np.isfinite(image)
    assert inside.sum() > 5000
    assert image[inside] == pytest.approx(max_shear(0.5 * LOADS["Load1"]), abs=1e-3)
    u = nibabel.load(study / "out" / "Load1" / "half_displacement.nii.gz")
    expected = sheared(0.5 * LOADS["Load1"]).displacement(labels().grid.points(inside))
    assert u.get_fdata()[:, :, :, 0][inside] == pytest.approx(expected, abs=1e-4)
    part = nibabel.load(study / "out" / "Load1" / "part_max_shear.nii.gz").get_fdata()
    assert np.isfinite(part).sum() == pytest.approx(0.5 * inside.sum(), rel=0.1)
    assert part[np.isfinite(part)] == pytest.approx(max_shear(0.5), abs=1e-3)
