"""Strain that jumps where tissues meet: depths below borders, displacements made with them, and what images tell."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.deformation.bspline import BSpline
from dvc.deformation.interface_spline import Interfaces, InterfaceSpline
from dvc.deformation.protocol import Deformation, displacement_on_grid, evaluate_on_grid
from dvc.errors import GeometryError, InputError
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.io.transforms.interface_spline import read_interface_spline, write_interface_spline
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.choice import Choice
from dvc.registration.gauss_newton.fit import Parameters, control_grid, fit
from dvc.registration.gauss_newton.spline_sums import SplineSums
from dvc.registration.gauss_newton.with_interfaces import fit_with_interfaces

NAMES = {1: "bone", 2: "fat", 3: "skin"}
GRID = Grid((34, 32, 30), np.array([1.0, 1.0, 1.2]), np.array([-12.0, 5.0, 3.0]))
NORMAL = np.array([0.48, 0.6, 0.64])  # oblique to every axis of the grid
BONE_MM, SKIN_MM = -8.0, 8.0
REACH_MM = 3.0


def height(points: np.ndarray, grid: Grid = GRID) -> np.ndarray:
    """Distance (mm) along the normal from the grid's middle: bone below -8, skin above 8."""
    return np.asarray((points - grid.centre_mm) @ NORMAL)


def layers(grid: Grid = GRID) -> LabelMap:
    z = height(grid.points(), grid)
    labels = np.where(z < BONE_MM, 1, np.where(z > SKIN_MM, 3, 2))
    return LabelMap(grid, np.where(z > SKIN_MM + 4.0, 0, labels), NAMES)


def borders_of(labels: LabelMap, rest: str | None = "bone") -> Interfaces:
    return Interfaces.of(labels, None if rest is None else labels.region(rest), REACH_MM)


def inner_points(count: int, seed: int = 1) -> np.ndarray:
    random = np.random.default_rng(seed)
    return GRID.points_at(random.uniform(5.0, np.array(GRID.shape) - 6.0, (count, 3)))


@pytest.fixture(scope="module")
def borders() -> Interfaces:
    return borders_of(layers())


def test_what_has_no_label_in_the_body_never_is_the_bone_at_rest():
    """A gap belongs to the tissue beside it; a large part is a tissue of its own; so is all beside a bone alone."""
    labels = layers()
    bone, body = labels.region("bone"), Mask(GRID, np.ones(GRID.shape, dtype=bool))
    values = labels.labels.copy()
    z = height(GRID.points())
    gap, far = (z > BONE_MM) & (z < BONE_MM + 2.0), z > SKIN_MM + 4.0
    values[gap] = 0
    whole, with_gap = (Interfaces.of(replace(labels, labels=v), bone, REACH_MM, body) for v in (labels.labels, values))
    np.testing.assert_array_equal(with_gap.own, whole.own)
    assert set(np.unique(whole.own[far])) == {2, 3}  # the skin, and what lies more than 3 mm outside it
    assert np.count_nonzero(whole.own[far] == 3) > 100
    assert np.unique(Interfaces.of(replace(labels, labels=values), bone, REACH_MM).own[gap]).tolist() == [0, 1]
    alone = Interfaces.of(replace(labels, labels=bone.inside.astype(np.int64)), bone, REACH_MM, body)
    assert np.all((alone.own == alone.rest) == bone.inside)


@pytest.fixture(scope="module")
def spline(borders) -> InterfaceSpline:
    control = control_grid(GRID, np.full(3, 6.0))
    random = np.random.default_rng(2)
    return InterfaceSpline(
        *(BSpline(control, s * random.normal(size=(3, *control.shape))) for s in (1.0, 0.2)), borders
    )


def test_factors_are_those_of_the_distance_from_a_plane(borders):
    """Interfaces made of voxels' faces would be 0.3 mm off, and their normals would be the axes."""
    points = inner_points(4000)
    z = height(points)
    here = z > BONE_MM
    away = np.minimum(np.abs(z - BONE_MM), np.abs(z - SKIN_MM))
    m, psi = np.tanh((z - BONE_MM) / REACH_MM), REACH_MM * np.tanh(away / REACH_MM)
    found = borders.at(points)
    clear = here & (away > 0.3)
    assert np.abs(found[clear, 0, 0] - m[clear]).max() < 0.04
    assert np.abs(found[clear, 1, 0] - (m * psi)[clear]).max() < 0.15
    upward = found[clear & (z > SKIN_MM), 1, 1:]
    direction = upward / np.linalg.norm(upward, axis=1, keepdims=True)
    assert np.degrees(np.arccos(np.clip(direction @ NORMAL, -1.0, 1.0))).max() < 8.0
    assert not found[z < BONE_MM - 0.3].any()


def test_air_is_no_border(borders):
    """Skin ends at a height of 12 mm; its depth goes on growing there."""
    z = np.array([SKIN_MM + 2.0, SKIN_MM + 4.0, SKIN_MM + 5.0])
    psi = borders.at(GRID.centre_mm + z[:, None] * NORMAL)[:, 1, 0]
    np.testing.assert_allclose(psi, REACH_MM * np.tanh((z - SKIN_MM) / REACH_MM), atol=0.15)


def test_factors_at_voxels_are_those_at_their_centres(borders):
    """Also on borders, where each voxel has its own side's gradient; along the axes of an oblique grid."""
    turn = Rotation.from_rotvec([20.0, -10.0, 30.0], degrees=True).as_matrix()
    grid = Grid(GRID.shape, GRID.spacing_mm, GRID.origin_mm, turn)
    oblique, everywhere = borders_of(LabelMap(grid, layers().labels, NAMES)), np.ones(grid.shape, dtype=bool)
    at_voxels = oblique.at_voxels(everywhere)
    at_points = oblique.at(grid.points().reshape(-1, 3)).reshape(*GRID.shape, 2, 4)
    np.testing.assert_allclose(at_voxels[..., 0], at_points[..., 0], atol=1e-9)
    np.testing.assert_allclose(at_voxels[..., 1:] @ turn.T, at_points[..., 1:], atol=1e-9)
    np.testing.assert_array_equal(oblique.at_voxels(everywhere, gradient=False), at_voxels[..., :1])
    some = np.random.default_rng(8).uniform(size=at_voxels[::2, ::3, ::1].shape[:3]) < 0.5
    found = oblique.at_voxels(some, (2, 3, 1))
    np.testing.assert_array_equal(found[some], at_voxels[::2, ::3, ::1][some])
    assert not found[~some].any()


def test_without_bone_nothing_is_held(borders):
    free = borders_of(layers(), rest=None)
    found = free.at(inner_points(300))
    assert (found[:, 0, 0] == 1.0).all()
    assert not found[:, 0, 1:].any()


def test_displacement_alone_is_the_same_and_takes_no_gradient(spline, monkeypatch):
    points = GRID.points().reshape(-1, 3)
    u = spline.evaluate(points)[0]
    monkeypatch.delattr(InterfaceSpline, "evaluate")
    monkeypatch.delattr(BSpline, "evaluate")
    np.testing.assert_array_equal(spline.displacement(points), u)


def test_its_gradient_is_that_of_its_displacement(spline):
    points = inner_points(3000)
    z = height(points)
    points = points[np.minimum(np.abs(z - BONE_MM), np.abs(z - SKIN_MM)) > 0.5]
    _, H = spline.evaluate(points)
    step = 1e-4
    for axis, e in enumerate(np.eye(3)):
        difference = spline.displacement(points + step * e) - spline.displacement(points - step * e)
        np.testing.assert_allclose(H[:, :, axis], difference / (2.0 * step), atol=2e-6)


def test_it_is_continuous_and_its_gradient_jumps_along_the_border(spline):
    across = np.linspace(-0.5, 0.5, 2001)
    along = np.cross(NORMAL, [0.0, 0.0, 1.0])
    for shift in (-2.0, 0.0, 3.0):
        line = GRID.centre_mm + shift * along + (SKIN_MM + across)[:, None] * NORMAL
        u, H = spline.evaluate(line)
        assert np.abs(np.diff(u, axis=0)).max() < 2e-3  # 0.5 um apart
        steps = np.linalg.norm(np.diff(H, axis=0), axis=(1, 2))
        place = int(steps.argmax())
        w = spline.jump.displacement(line[place : place + 1])[0]
        assert steps[place] > 10.0 * np.sort(steps)[-2]
        np.testing.assert_allclose(H[place + 1] - H[place], 2.0 * np.outer(w, NORMAL), atol=0.25 * np.linalg.norm(w))


def test_bone_does_not_move(spline):
    points = inner_points(3000)
    u, H = spline.evaluate(points[height(points) < BONE_MM - 0.3])
    assert len(u) > 100
    assert not u.any()
    assert not H.any()


def test_on_a_grid_it_is_what_it_is_at_points(spline):
    where = np.random.default_rng(3).uniform(size=GRID.shape) < 0.02
    u, H = evaluate_on_grid(spline, GRID, where)
    true_u, true_H = spline.evaluate(GRID.points(where))
    np.testing.assert_allclose(u, true_u, atol=1e-10)
    np.testing.assert_allclose(H, true_H, atol=1e-10)
    assert isinstance(spline, Deformation)


@pytest.mark.parametrize("shift_mm", [0.0, 0.4])
def test_its_displacement_alone_is_found_on_a_grid_without_the_gradient(spline, monkeypatch, shift_mm):
    grid = GRID.moved_by(np.eye(3), np.full(3, shift_mm))
    u = spline.evaluate(grid.points().reshape(-1, 3))[0].reshape(*grid.shape, 3)
    for name in ("evaluate_on_grid", "evaluate"):
        monkeypatch.setattr(InterfaceSpline, name, lambda *_: pytest.fail("the gradient is computed, too"))
    np.testing.assert_allclose(displacement_on_grid(spline, grid, np.float64), u, atol=1e-10)


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 2, 0), (2, 1, 0)])
def test_at_voxels_of_the_interfaces_only_three_coefficients_are_summed(spline, monkeypatch, axes):
    """With axes in another order and direction, and beyond the interfaces' grid: the same numbers as at points."""
    turn = Rotation.from_rotvec([20.0, -10.0, 30.0], degrees=True).as_matrix()
    turned = spline.turned(turn)
    own = turned.borders.grid
    shape, signs = np.array(GRID.shape)[list(axes)] + 4, np.array([1.0, -1.0, 1.0])
    columns = own.direction[:, list(axes)] * signs
    corner = own.centre_mm - columns @ (own.spacing_mm[list(axes)] * (shape - 1) / 2.0)
    grid = Grid(tuple(shape.tolist()), own.spacing_mm[list(axes)], corner, columns)
    where = np.random.default_rng(3).uniform(size=grid.shape) < 0.1
    everywhere = Mask(own, np.ones(own.shape, dtype=bool))
    bone = Mask(own, turned.borders.own == turned.borders.rest)
    of_bone = Interfaces.of(LabelMap(own, everywhere.inside.astype(int), {1: "tissue"}), bone, REACH_MM)
    at = turned.borders.at(grid.points(where))
    with monkeypatch.context() as patch:
        patch.delattr(Interfaces, "at")
        found = turned.borders.on_grid(grid, where)
        patch.delattr(Interfaces, "_depths")
        of_bone.on_grid(grid, where, gradient=False)
    np.testing.assert_allclose(found, at, atol=1e-9)
    assert np.unique(at[:, 0, 0]).size > 100
    between = grid.moved_by(np.eye(3), 0.5 * own.spacing_mm[0] * own.direction[:, 0])
    np.testing.assert_array_equal(turned.borders.on_grid(between, where), turned.borders.at(between.points(where)))
    for near, of in ((grid, turned.borders), (between, turned.borders), (grid, of_bone), (between, of_bone)):
        alone = of.on_grid(near, where, gradient=False)
        np.testing.assert_allclose(alone, of.at(near.points(where))[..., :1], atol=1e-9)
    assert of_bone.of_bone_alone


def test_files_with_the_same_borders_share_them_and_no_others_do(spline, borders, tmp_path):
    """Finding them takes seconds, and one study's loads have them in common."""
    others = {
        "again": borders,
        "reach": replace(borders, reach_mm=2.0 * borders.reach_mm),
        "rest": replace(borders, rest=-1),
        "grid": replace(borders, grid=borders.grid.moved_by(np.eye(3), np.array([1.0, 0.0, 0.0]))),
        "own": borders_of(LabelMap(GRID, np.roll(layers().labels, 1, axis=0), NAMES)),
    }
    write_interface_spline(tmp_path / "first", spline)
    for name, other in others.items():
        write_interface_spline(tmp_path / name, replace(spline, borders=other))
        first = read_interface_spline(tmp_path / "first").borders
        found = read_interface_spline(tmp_path / name).borders
        assert (found is first) == (name == "again")
        assert np.array_equal(found.depth, other.depth)
        assert np.array_equal(found.own, other.own)
        assert (found.rest, found.reach_mm) == (other.rest, other.reach_mm)
        assert np.array_equal(found.grid.origin_mm, other.grid.origin_mm)


def test_a_damaged_file_is_refused(spline, tmp_path):
    path = tmp_path / "first.npz"
    write_interface_spline(path, spline)
    whole = path.read_bytes()
    entry = whole.rindex(b"PK\x01\x02")  # of the last array, in the table at the end
    for at, byte in ((entry + 10, 99), (entry + 8, 1), (len(whole) // 2, whole[len(whole) // 2] ^ 8)):
        path.write_bytes(whole[:at] + bytes([byte]) + whole[at + 1 :])
        with pytest.raises(InputError, match=r"first\.npz: not a displacement with tissue interfaces"):
            read_interface_spline(path)


@pytest.mark.parametrize("number", [-1, 5, 12589])  # a depth for each tissue up to the highest takes forever
def test_a_file_whose_tissues_are_not_numbered_one_after_the_other_is_refused(spline, borders, tmp_path, number):
    own = borders.own.copy()
    own[0, 0, 0] = number
    write_interface_spline(tmp_path / "first.npz", replace(spline, borders=replace(borders, own=own)))
    with pytest.raises(InputError, match=r"first\.npz: .*not numbered from 0 on without gaps"):
        read_interface_spline(tmp_path / "first.npz")


def test_what_does_not_fit_together_is_refused(spline, borders):
    other = control_grid(GRID, np.full(3, 5.0))
    with pytest.raises(GeometryError, match="the same control grid"):
        InterfaceSpline(spline.smooth, BSpline(other, np.zeros((3, *other.shape))), borders)
    labels = layers()
    empty = LabelMap(GRID, np.zeros(GRID.shape, dtype=np.int64), {})
    with pytest.raises(InputError, match="no labelled tissue"):
        Interfaces.of(empty, None, REACH_MM)
    with pytest.raises(InputError, match="above 0"):
        Interfaces.of(labels, None, 0.0)
    aside = Grid(GRID.shape, GRID.spacing_mm, GRID.origin_mm + 50.0)
    with pytest.raises(GeometryError, match="grid of the label map"):
        Interfaces.of(labels, Mask(aside, labels.labels == 1), REACH_MM)


@pytest.fixture(scope="module")
def sums(spline) -> SplineSums:
    control = spline.control
    at, step = control.indices_of(GRID.origin_mm), GRID.spacing_mm / control.spacing_mm
    along = [a + s * np.arange(n) for a, s, n in zip(at, step, GRID.shape, strict=True)]
    inside = np.random.default_rng(4).uniform(size=GRID.shape) < 0.3
    return SplineSums(control, along, inside, spline.borders.at_voxels(inside))


def test_sums_with_factors_are_those_of_the_interface_spline(sums, spline):
    c = np.concatenate([spline.smooth.coefficients_mm, spline.jump.coefficients_mm])
    u, H = sums.evaluate(c)
    true_u, true_H = spline.evaluate_on_grid(GRID, sums.inside)
    np.testing.assert_allclose(u[sums.inside], true_u, atol=1e-9)
    np.testing.assert_allclose(H[sums.inside], true_H, atol=1e-9)
    random = np.random.default_rng(5)
    stress = random.normal(size=(*GRID.shape, 3, 3)) * sums.inside[..., None, None]
    assert np.sum(sums.gathered(stress) * c) == pytest.approx(np.sum(stress * H), rel=1e-10)
    N = np.broadcast_to([2.0, 0.3, 0.0, 1.0, -0.2, 3.0], (*GRID.shape, 6)).copy()
    cof = np.broadcast_to(np.eye(3), (*GRID.shape, 3, 3)).copy()
    volume, shear = random.uniform(size=GRID.shape), random.uniform(size=GRID.shape)
    matrix = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, -0.2], [0.0, -0.2, 3.0]])
    sym = 0.5 * (H + np.swapaxes(H, -1, -2))
    cost = np.einsum("...a,ab,...b", u, matrix, u) + volume * np.trace(H, axis1=-2, axis2=-1) ** 2
    cost = (cost + shear * np.einsum("...ab,...ab", sym, sym))[sums.inside].sum()
    stiffness = (N, cof, volume, shear)
    assert np.sum(c * sums.product(c, stiffness)) == pytest.approx(cost, rel=1e-10)
    assert sums.own_blocks(N, volume, shear)[0].shape == (12, *spline.control.shape)


def texture(points: np.ndarray) -> np.ndarray:
    """A smooth pattern without a period, known everywhere; wavelengths of 4 mm and more."""
    random = np.random.default_rng(8)
    waves = random.normal(size=(60, 3))
    waves *= (2.0 * np.pi / random.uniform(4.0, 15.0, 60) / np.linalg.norm(waves, axis=1))[:, None]
    return np.asarray(3.0 + np.cos(points @ waves.T + random.uniform(0.0, 6.3, 60)).sum(axis=-1) / np.sqrt(60.0))


SHEAR = 0.3


def sheared(points: np.ndarray, skin: float) -> np.ndarray:
    """Fat that shears on bone at rest, and skin above it that shears by a share ``skin`` of that."""
    z = height(points)
    amount = SHEAR * (np.clip(z - BONE_MM, 0.0, SKIN_MM - BONE_MM) + skin * np.maximum(z - SKIN_MM, 0.0))
    return np.asarray(amount[..., None] * np.cross(NORMAL, [0.0, 0.0, 1.0]) / np.hypot(*NORMAL[:2]))


def scanned(skin: float) -> tuple[Image, Image, Mask, LabelMap]:
    """The pair of images with noise, what is compared, and the tissues; the second image's grid is turned."""
    random = np.random.default_rng(6)
    turn = Rotation.from_rotvec([3.0, -2.0, 4.0], degrees=True).as_matrix()
    grid = GRID.moved_by(turn, GRID.centre_mm - turn @ GRID.centre_mm)
    x = grid.points()
    noise = 0.03 * random.standard_normal((2, *GRID.shape))
    fixed = Image(GRID, (texture(GRID.points()) + noise[0]).astype(np.float32))
    # u depends on the height alone, which the motion does not change: the way back is minus the way there
    moving = Image(grid, (texture(x - sheared(x, skin)) + noise[1]).astype(np.float32))
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[3:-3, 3:-3, 3:-3] = True
    return fixed, moving, Mask(GRID, inside), LabelMap(GRID, np.where(layers().labels, layers().labels, 3), NAMES)


KEPT = Parameters(volume=300.0)


@pytest.fixture(scope="module")
def along_stiff_skin() -> tuple[InterfaceSpline, Choice]:
    fixed, moving, body, labels = scanned(skin=0.0)
    return fit_with_interfaces(AlignedPair(fixed, moving, body, body, labels.region("bone"), labels), KEPT)


def shear_errors(found: Deformation, skin: float) -> dict[str, float]:
    """Root mean square of H's error along the shear, by tissue, within 3 mm of a border."""
    deep = np.zeros(GRID.shape, dtype=bool)
    deep[8:-8, 8:-8, 8:-8] = True
    points = GRID.points(deep)
    z = height(points)
    slope = np.where(z < BONE_MM, 0.0, np.where(z < SKIN_MM, SHEAR, skin * SHEAR))
    direction = np.cross(NORMAL, [0.0, 0.0, 1.0]) / np.hypot(*NORMAL[:2])
    error = np.einsum("nab,a,b->n", found.evaluate(points)[1], direction, NORMAL) - slope
    near = np.minimum(np.abs(z - BONE_MM), np.abs(z - SKIN_MM)) < 3.0
    parts = {"bone": z < BONE_MM, "fat": (z > BONE_MM) & (z < SKIN_MM), "skin": z > SKIN_MM}
    return {name: float(np.sqrt(np.mean(error[near & part] ** 2))) for name, part in parts.items()}


def test_strain_that_jumps_is_found_up_to_the_border(along_stiff_skin):
    """One spline: .058 in bone, .059 in fat, .081 in skin; with borders 0, .011, .007."""
    fixed, moving, body, labels = scanned(skin=0.0)
    smooth = shear_errors(fit(AlignedPair(fixed, moving, body, body, labels.region("bone")), KEPT)[0], 0.0)
    sharp = shear_errors(along_stiff_skin[0], 0.0)
    assert sharp["bone"] < 0.002
    assert sharp["fat"] < 0.4 * smooth["fat"]
    assert sharp["skin"] < 0.2 * smooth["skin"]


def test_the_images_tell_whether_the_skin_resists(along_stiff_skin):
    """Where skin does not shear it is made stiff, 300; where it shears as fat does it is not, below 0.1."""
    fixed, moving, body, labels = scanned(skin=1.0)
    pair = AlignedPair(fixed, moving, body, body, labels.region("bone"), labels)
    found, choice = fit_with_interfaces(pair, replace(KEPT, bending=3.0))
    assert choice.weights.rigidity < 1.0
    assert shear_errors(found, 1.0)["skin"] < 0.02
    stiff = along_stiff_skin[1]
    assert stiff.weights.rigidity > 30.0
    assert len(stiff.as_dict()["tried_in_skin"]) >= 3
    assert stiff.rule.startswith("bending chosen by cross-validation")


def test_without_skin_and_bone_and_with_a_fixed_weight():
    fixed, moving, body, labels = scanned(skin=1.0)
    plain = LabelMap(GRID, labels.labels, {1: "bone", 2: "fat", 3: "cartilage"})
    pair = AlignedPair(fixed, moving, body, body, None, plain)
    found, choice = fit_with_interfaces(pair, replace(KEPT, bending=30.0))
    assert choice.weights.bending == 30.0
    assert not choice.tried
    assert not choice.tried_in_skin
    assert found.borders.rest == -1
    assert shear_errors(found, 1.0)["fat"] < 0.05
