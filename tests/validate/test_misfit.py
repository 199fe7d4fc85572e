"""Slips of a model's displacement that would pass in silence are named, and right models are not."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.deformation.protocol import Affine
from dvc.errors import ExtentError, GeometryError
from dvc.images.image import Grid
from dvc.mesh import TetMesh
from mrstrain.comparison.model_files import ModelFile
from mrstrain.options.modelling import ModelReading
from tests.validate.test_comparison import SIDE, case, cube, error_table, labels, result, sheared
from tests.validate.test_fe_result import written
from validate import Field, MappedFields, compare, displacement_slip, map_fields, misfits


def pressed() -> MappedFields:
    """A block pressed by 0.4 mm along x and sheared by 0.25 mm along y; its cells hardly change their volume."""
    found = map_fields(cube(), labels(), ["bone"], sheared(0.0), {})
    x, y, z = (found.points_mm / SIDE).T
    u = np.stack([-0.4 * x, 0.25 * x + 0.1 * y * x, 0.12 * (z - 0.4) * x], axis=1)
    return replace(found, measured=moved(found, u))


def moved(found: MappedFields, u: np.ndarray) -> Field:
    return Field(u, found.measured.max_shear, found.measured.jacobian)


def told(found: MappedFields, u: np.ndarray) -> str:
    return displacement_slip(replace(found, models={"model": moved(found, u)}), "model")


def test_a_slip_of_axes_frame_or_unit_is_named_under_a_small_load() -> None:
    found = pressed()
    right, weight = found.measured.u_mm, found.volumes_ml / found.volumes_ml.sum()
    rough = right + 0.05 * np.random.default_rng(0).standard_normal(right.shape)
    assert told(found, rough) == ""
    named = 0
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            slipped = rough[:, order] * signs
            words = told(found, slipped)
            cosine = (
                weight
                @ (slipped * right).sum(axis=1)
                / np.sqrt((weight @ (slipped**2).sum(axis=1)) * (weight @ (right**2).sum(axis=1)))
            )
            if cosine < 0.45:
                # taken as it says, the displacement is the measured one again
                axes = words.split("components as ")[1].split(" (")[0].split()
                undone = np.stack([(-1) ** a.startswith("-") * slipped[:, "xyz".index(a[-1])] for a in axes], axis=1)
                assert np.sqrt(weight @ ((undone - right) ** 2).sum(axis=1)) < 0.13, (order, signs, words)
                named += 1
            elif cosine > 0.6:
                assert words == "", (order, signs, words)
    assert named > 30
    assert "components as -x -y z (LPS and RAS exchanged)" in told(found, rough * [-1.0, -1.0, 1.0])
    assert told(found, 1e-3 * rough).endswith("times as large as the measured one (it may be in metres).")
    assert told(found, 1e3 * rough).endswith("(it may be 1000 times too large).")
    swapped = right[:, [1, 0, 2]]
    across = swapped - right * (0.999 * (weight @ (swapped * right).sum(axis=1)) / (weight @ (right**2).sum(axis=1)))
    assert "as given 0.00)" in told(found, across)  # a cosine of -0.0002
    both = told(found, 1e-3 * rough[:, [1, 0, 2]])
    assert "components as y x z" in both
    assert "in metres" in both


@pytest.mark.parametrize("along", [(0.0, 0.0, 3.0), (0.0, 2.0, -2.0), (0.3, 0.0, 0.1)])
@pytest.mark.parametrize("angle", [0.0, 0.1])
def test_a_rigid_motion_in_the_model_is_not_taken_for_other_axes(along: tuple[float, ...], angle: float) -> None:
    found = pressed()
    right, middle = found.measured.u_mm, found.points_mm.mean(axis=0)
    rotation = Rotation.from_rotvec([0.0, 0.0, angle])

    def carried(u: np.ndarray) -> np.ndarray:
        return rotation.apply(found.points_mm + u - middle) + middle + along - found.points_mm

    for stiffness in (0.5, 1.0):
        assert "components as" not in told(found, carried(stiffness * right))
    assert "components as" not in told(found, carried(0.0 * right))
    assert "components as" not in told(replace(found, measured=moved(found, carried(0.0 * right))), right)


def test_a_rigid_motion_across_the_measured_one_is_named() -> None:
    found = pressed()
    assert told(found, found.measured.u_mm + np.array([0.0, 0.0, 1.0])) == (
        "model: the displacement has another direction than the measured one (cosine 0.30), most likely because it "
        "contains a rigid motion; if the bone moves in the model, subtract that motion."
    )


def test_where_little_is_left_beside_a_rigid_motion_both_causes_are_named() -> None:
    found = pressed()
    nearly = np.array([0.0, 0.0, 4.0]) + 0.05 * found.measured.u_mm
    words = told(replace(found, measured=moved(found, nearly)), nearly * [1.0, 1.0, -1.0])
    assert "it contains a rigid motion, or its axes are wrong (as x y -z" in words


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_few_cells_tell_no_rigid_motion_from_axes(count: int) -> None:
    found = pressed()
    measured = np.full_like(found.measured.u_mm, np.nan)
    measured[np.flatnonzero(found.common)[-count:]] = [1.0, 0.0, 0.0]
    shear = np.where(np.isfinite(measured[:, 0]), found.measured.max_shear, np.nan)
    few = replace(found, measured=Field(measured, shear, found.measured.jacobian))
    assert np.count_nonzero(few.common) == count
    words = told(few, np.tile([0.0, 0.0, 1.0], (len(measured), 1)))
    assert "it contains a rigid motion, or its axes are wrong" in words


@pytest.mark.parametrize("factor", [0.15, 0.5, 2.0, 9.0])
def test_a_model_that_is_too_stiff_too_soft_or_wrong_is_no_slip(factor: float) -> None:
    found = pressed()
    right = found.measured.u_mm
    swung = right[:, [1, 0, 2]] * [1.0, 1.0, 0.0] * 0.6 + right * 0.8  # cosine of about 0.5 with the measured one
    for u in (right, right * [1.0, 0.3, 0.3], right * [0.5, 1.5, 1.0], swung):
        assert told(found, factor * u) == ""
    assert told(found, np.zeros_like(right)) == ""


def test_refusals_show_both_boxes(tmp_path) -> None:
    mesh = cube(6)
    aside = replace(result("aside", mesh, sheared(0.1)))
    moved_away = type(mesh)(mesh.points_mm - [9.0, 0.0, 0.0], mesh.cells)
    off = replace(aside, deformation=type(aside.deformation)(moved_away, aside.deformation.u_mm))
    with pytest.raises(GeometryError, match=r"Model: -9 to 11 x 0 to 20 .*tissue: 0.5 to 24 x -3.5 to 24") as told:
        misfits(off, labels(), ["bone"])
    for words in ("(85 % is needed)", "(--model-unit)", "(--model-frame)", "(--to-image)"):
        assert words in str(told.value)
    turned = type(mesh)(mesh.points_mm * [-1.0, -1.0, 1.0], mesh.cells)
    in_ras = replace(aside, deformation=type(aside.deformation)(turned, aside.deformation.u_mm))
    with pytest.raises(GeometryError, match=r"Read as RAS, 100 % would: give its frame \(--model-frame RAS\)"):
        misfits(in_ras, labels(), ["bone"])
    file = ModelFile("heel", written(tmp_path, "vtu")["path"], ModelReading(model_unit="m"))
    grid = Grid((40, 40, 40), np.ones(3), np.array([-10.0, -35.0, 25.0]), np.eye(3))
    with pytest.raises(ExtentError, match=r"too large for a body part.*spans 5000 to 15000") as told:
        file.read(grid)
    assert str(file.path) in str(told.value)


def test_cells_that_are_there_twice_are_told() -> None:
    mesh = cube(4)
    assert not misfits(result("once", mesh, sheared(0.1)), labels(), ["bone"])
    twice = TetMesh(mesh.points_mm, np.concatenate([mesh.cells, mesh.cells[5:10]]), mesh.regions, mesh.facets)
    (odd,) = misfits(result("twice", twice, sheared(0.1)), labels(), ["bone"])
    assert odd.told.startswith(
        f"twice: 5 of its {len(twice.cells)} tetrahedra are repeated (the first is number {len(mesh.cells)}"
    )


@pytest.mark.parametrize(("moved_mm", "level"), [(0.5, None), (3.0, "caution"), (134.0, "distrust")])
def test_a_model_whose_bone_moves_is_told_and_one_that_moves_far_is_not_trusted(
    moved_mm: float, level: str | None
) -> None:
    mesh, at_rest = cube(4), Affine(np.array([[1.0, 0.0, 0.0], [0.4, 1.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
    moved = replace(at_rest, translation_mm=np.array([0.0, 0.0, moved_mm]))
    models = [result("right", mesh, at_rest), result("moved", mesh, moved)]
    odd = misfits(models[1], labels(), ["bone"])
    assert [one.level for one in odd] == [level] * (level is not None)
    done = compare([case("Load1", at_rest, models, error_table(0.0, 0.01))], labels())
    (under,) = done.ranking.statements
    not_trusted = " Do not trust the rank of moved: see the warning on its file."
    if level is None:
        assert done.verdict is None
    else:
        assert done.verdict.level == level
        assert f"Load1: moved: the model moves by {moved_mm:g}" in done.verdict.reasons[0]
    assert under.endswith(not_trusted) == (level == "distrust")
    inner = mesh.cells[(mesh.points_mm[mesh.cells][..., 0] > 4.0).all(axis=1)]  # no bone touches it
    apart = TetMesh(mesh.points_mm, inner, {"fat": np.arange(len(inner))}, {})
    told = [
        one.level for one in misfits(result("apart", apart, moved), labels(), ["bone"]) if "the model moves" in one.told
    ]
    assert told == ["distrust"] * (level == "distrust")
    if level == "distrust":
        assert "unit and frame of the displacements, and that they are in the order of the nodes" in odd[0].told
        several = [case(load, at_rest, models, error_table(0.0, 0.01)) for load in ("Load1", "Load2")]
        assert all(one.endswith(not_trusted) for one in compare(several, labels()).ranking.statements)


@pytest.mark.parametrize("written_as", [str.lower, str.upper, str.title])
def test_tissues_of_a_model_have_the_names_of_labels_in_any_case(written_as) -> None:
    """Abaqus writes names in capitals; tissues that are exchanged are told all the same."""
    mesh = cube()
    fat, skin = mesh.regions["fat"], mesh.regions["skin"]
    right, wrong = (
        TetMesh(mesh.points_mm, mesh.cells, {written_as("fat"): a, written_as("skin"): b}, mesh.facets)
        for a, b in ((fat, skin), (skin, fat))
    )
    assert map_fields(right, labels(), ["bone"], sheared(0.0), {}).tissues == ["fat", "skin"]
    notes = {
        name: [
            told for told in misfits(result(name, one, sheared(0.1)), labels(), ["bone"]) if "same tissue" in str(told)
        ]
        for name, one in (("right", right), ("wrong", wrong))
    }
    assert not notes["right"]
    assert "have the same tissue name in only 0 % of the volume" in str(notes["wrong"])
