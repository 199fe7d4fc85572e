"""A plate pressed and sheared against a dome of tissue on fixed bone: balance, tape, symmetry, frame, refusals."""

import itertools
import re
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.deformation.strain import StrainField
from dvc.errors import InputError
from dvc.mesh import TetMesh
from fe import LoadState, LoadStep, NeoHooke, Ogden, Plate, Problem, Tolerance, cauchy_stress, region_figures
from fe.mesh_file import where_open
from tests.blocks import block
from tests.fe.solving import Notebook, solved
from tests.fe.test_assembly import needs_ngsolve

FAT, SKIN = Ogden.from_ansys(0.0034, 6.2), NeoHooke.of(0.2)
LAWS = {"skin": SKIN, "fat": FAT}
DOWN, ALONG = [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]
PRESS = [LoadStep("pressed", 2.0)]
SHEARED = LoadStep("sheared", 2.0, 1.0)


def dome(count: tuple[int, int, int] = (4, 6, 6)) -> TetMesh:
    """20 x 20 mm, 10 mm high toward the plate at x = 0, its middle 1.5 mm lower than its rim; bone at x = 10."""
    box = block(count, (10.0, 20.0, 20.0), layers=4, wobble=0.15)
    points = box.points_mm.copy()
    radius = np.hypot(points[:, 1] - 10.0, points[:, 2] - 10.0) / 10.0
    points[:, 0] += 1.5 * radius**2 * (1.0 - points[:, 0] / 10.0)
    fat = np.concatenate([box.regions[f"layer {k}"] for k in (1, 2, 3)])
    return TetMesh(
        points,
        box.cells,
        {"skin": box.regions["layer 0"], "fat": fat},
        {"bone": box.facets["x1"], "skin": box.facets["x0"]},
    )


def press(mesh: TetMesh, loads: list[LoadStep], laws=LAWS, **others) -> list[LoadState]:
    plate = Plate(others.pop("normal", DOWN), others.pop("shear", ALONG), taped=others.pop("taped", True))
    return solved(mesh, laws, plate, loads, **others)


@pytest.fixture(scope="module")
def sheared() -> list[LoadState]:
    return press(dome(), [LoadStep("pressed", 2.0), LoadStep("sheared", 2.0, 1.0), LoadStep("more", 2.0, 2.0)])


def test_the_force_is_the_one_asked_for(sheared: list[LoadState]) -> None:
    for state, force in zip(sheared, ([2, 0, 0], [2, 1, 0], [2, 2, 0]), strict=True):
        assert state.reached == 1.0
        assert state.force_n == pytest.approx(force, abs=1e-3 * np.linalg.norm(force))


def test_one_path_from_load_to_load(sheared: list[LoadState]) -> None:
    start = sheared[0].curve[0]
    assert [*start.displacement_mm, *start.force_n, start.area_mm2] == [0.0] * 7
    for before, after in itertools.pairwise(sheared):
        assert after.curve[0] is before.curve[-1]
        assert (np.diff([at.displacement_mm[1] for at in after.curve]) > 0).all()  # sheared ever further
    assert sheared[1].plate_displacement_mm[1] < sheared[2].plate_displacement_mm[1]
    assert len(sheared[2].on_plate) >= len(sheared[1].on_plate) >= len(sheared[0].on_plate) > 4


def test_taped_nodes_never_slide_and_lie_on_the_plate(sheared: list[LoadState]) -> None:
    mesh = dome()
    bottom = np.unique(mesh.facets["skin"])
    at = mesh.points_mm + sheared[0].u_mm
    on_plate = bottom[np.isclose(at[bottom, 0], at[bottom, 0].min(), atol=1e-9)]
    assert len(on_plate) == len(sheared[0].on_plate)
    moved = (sheared[2].u_mm - sheared[0].u_mm)[on_plate]
    assert np.ptp(moved, axis=0).max() < 1e-9
    assert moved[0] == pytest.approx(sheared[2].plate_displacement_mm - sheared[0].plate_displacement_mm, abs=1e-9)
    assert (at[bottom, 0] > at[on_plate[0], 0] - 1e-9).all()  # nothing is past the plate


def test_bone_does_not_move_and_volume_is_kept(sheared: list[LoadState]) -> None:
    mesh = dome()
    for state in sheared:
        assert np.abs(state.u_mm[np.unique(mesh.facets["bone"])]).max() == 0.0
        J = StrainField.from_gradient(state.gradients).jacobian
        assert (J * mesh.volumes_mm3).sum() == pytest.approx(mesh.volumes_mm3.sum(), rel=1e-3)


def test_another_frame_gives_the_same(sheared: list[LoadState]) -> None:
    turn = Rotation.from_rotvec([0.4, -0.9, 1.3]).as_matrix()
    mesh = dome()
    moved = TetMesh(mesh.points_mm @ turn.T + [3.0, -50.0, 20.0], mesh.cells, mesh.regions, mesh.facets)
    again = press(
        moved, [LoadStep("pressed", 2.0), LoadStep("sheared", 2.0, 1.0)], normal=turn @ DOWN, shear=turn @ ALONG
    )
    for state, turned in zip(sheared, again, strict=False):
        assert np.abs(turned.u_mm @ turn - state.u_mm).max() < 1e-6
        assert np.abs(turn.T @ turned.gradients @ turn - state.gradients).max() < 1e-6


def test_a_mirrored_problem_has_the_mirrored_answer(sheared: list[LoadState]) -> None:
    mesh = dome()
    flip = np.array([1.0, -1.0, 1.0])
    mirrored = TetMesh(mesh.points_mm * flip, mesh.cells[:, [0, 1, 3, 2]], mesh.regions, mesh.facets)
    again = press(mirrored, [LoadStep("pressed", 2.0), LoadStep("sheared", 2.0, 1.0)], shear=[0.0, -1.0, 0.0])
    for state, other in zip(sheared, again, strict=False):
        assert np.abs(other.u_mm * flip - state.u_mm).max() < 1e-6


def test_threads_do_not_change_the_digits_that_matter(sheared: list[LoadState]) -> None:
    again = press(dome(), PRESS, threads=2)
    assert np.abs(again[0].u_mm - sheared[0].u_mm).max() < 1e-9


@pytest.mark.parametrize("library", ["superlu", pytest.param("ngsolve", marks=needs_ngsolve)])
def test_another_library_finds_the_same_state(
    sheared: list[LoadState], library: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fe.linear._fastest", lambda: library)
    again = press(dome(), [LoadStep("pressed", 2.0), LoadStep("sheared", 2.0, 1.0)])
    for state, other in zip(sheared, again, strict=False):
        assert np.abs(other.u_mm - state.u_mm).max() < 1e-6


def nodal_forces(mesh: TetMesh, F: np.ndarray, cauchy_mpa: np.ndarray) -> np.ndarray:
    """What the cells' stress exerts at the nodes, N: the sum of V P grad N over their cells."""
    P = np.linalg.det(F)[:, None, None] * cauchy_mpa @ np.linalg.inv(F).transpose(0, 2, 1)
    corners = mesh.points_mm[mesh.cells]
    slopes = np.linalg.inv(corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
    slopes = np.concatenate([-slopes.sum(axis=1, keepdims=True), slopes], axis=1)
    forces = np.zeros_like(mesh.points_mm)
    np.add.at(forces, mesh.cells, mesh.volumes_mm3[:, None, None] * np.einsum("mij,maj->mai", P, slopes))
    return forces


def test_stress_is_in_balance_at_every_node() -> None:
    mesh = dome((5, 8, 8))
    state = press(mesh, [LoadStep("sheared", 2.0, 1.0)])[0]
    stress = cauchy_stress(state, mesh, LAWS)
    assert np.abs(stress - stress.transpose(0, 2, 1)).max() < 1e-9 * np.abs(stress).max()
    forces, bone = nodal_forces(mesh, np.eye(3) + state.gradients, stress), np.unique(mesh.facets["bone"])
    free = np.setdiff1d(np.arange(len(forces)), np.concatenate([bone, state.on_plate]))
    assert len(free) > 200
    assert np.abs(forces[free]).max() < 1e-4
    assert forces[state.on_plate].sum(axis=0) == pytest.approx([2.0, 1.0, 0.0], abs=2e-3)
    assert forces[bone].sum(axis=0) == pytest.approx([-2.0, -1.0, 0.0], abs=2e-3)


def test_a_plate_without_friction_only_pushes_and_along_its_normal() -> None:
    mesh, soft = dome(), {"skin": FAT, "fat": FAT}
    for taped in (False, True):
        state = press(mesh, PRESS, soft, taped=taped)[0]
        stress = cauchy_stress(state, mesh, soft)
        forces = nodal_forces(mesh, np.eye(3) + state.gradients, stress)[state.on_plate]
        assert len(forces) > 4
        assert forces[:, 0].sum() == pytest.approx(2.0, abs=2e-3)
        across = np.abs(forces[:, 1:]).max()
        if taped:
            assert across > 0.01  # held where it touched
        else:
            assert across < 1e-4
            assert forces[:, 0].min() > -1e-4


def test_without_tape_the_surface_slides() -> None:
    mesh, soft = dome(), {"skin": FAT, "fat": FAT}
    taped, slid = (press(mesh, PRESS, soft, taped=tape)[0] for tape in (True, False))
    assert slid.reached == 1.0
    assert (
        slid.plate_displacement_mm[0] > 1.03 * taped.plate_displacement_mm[0]
    )  # softer without the tape's hold: 5 % here
    assert slid.force_n == pytest.approx([2.0, 0.0, 0.0], abs=2e-3)
    bottom = np.unique(mesh.facets["skin"])
    at = mesh.points_mm[bottom] + slid.u_mm[bottom]
    on_plate = np.isclose(at[:, 0], at[:, 0].min(), atol=1e-9)
    assert np.ptp(slid.u_mm[bottom][on_plate][:, 1]) > 0.1


def test_elements_agree_on_a_fine_mesh() -> None:
    # Linear tetrahedra without a pressure of their own would be several times too stiff here.
    mesh = dome((5, 9, 9))
    travel = {name: press(mesh, PRESS, element=name)[0].plate_displacement_mm[0] for name in ("P1", "MINI", "P2")}
    assert travel["P1"] == pytest.approx(travel["P2"], rel=0.15)
    assert travel["MINI"] == pytest.approx(travel["P2"], rel=0.2)


def test_a_load_too_large_ends_with_the_last_state_in_balance() -> None:
    loads = [LoadStep("pressed", 2.0), LoadStep("far too much", 2.0, 300.0), LoadStep("never", 2.0, 400.0)]
    weak = {"skin": NeoHooke.of(0.067, nu=0.495), "fat": NeoHooke.of(0.01, nu=0.49)}
    states = press(dome((3, 4, 4)), loads, weak)
    assert [state.load.name for state in states] == ["pressed", "far too much"]
    last = states[-1]
    assert 0.0 < last.reached < 1.0
    assert last.force_n == pytest.approx([2.0, 300.0 * last.reached, 0.0], abs=1e-3 * last.force_n[1])
    straight = press(dome((3, 4, 4)), [loads[0], LoadStep("as far", 2.0, float(last.force_n[1]))], weak)[-1]
    assert straight.reached == 1.0
    assert np.abs(straight.u_mm - last.u_mm).max() < 0.1 * np.abs(last.u_mm).max()  # steps differ, so does the tape


def test_balance_alone_does_where_steps_do_not_get_small(sheared: list[LoadState]) -> None:
    (state,) = press(dome(), PRESS, tolerance=Tolerance(1e-4, 0.0))
    assert state.reached == 1.0
    assert np.abs(state.u_mm - sheared[0].u_mm).max() < 1e-3


def test_a_state_that_lingers_near_the_tolerance_is_taken(
    monkeypatch: pytest.MonkeyPatch, sheared: list[LoadState]
) -> None:
    monkeypatch.setattr("fe.newton.BALANCED", 1000)
    heard = Notebook()
    (state,) = press(dome(), PRESS, tolerance=Tolerance(1e-4, 0.0), observer=heard)
    assert state.reached == 1.0
    assert np.abs(state.u_mm - sheared[0].u_mm).max() < 1e-3
    assert any("accepted: 8 within ten times the force tolerance" in line for line in heard.lines)


def test_normal_first_then_shear() -> None:
    alone, after = (press(dome(), loads)[-1] for loads in ([SHEARED], [*PRESS, SHEARED]))
    assert np.abs(alone.u_mm - after.u_mm).max() < 1e-4  # increments on the way are less exact
    assert alone.curve[0].displacement_mm.tolist() == alone.curve[0].force_n.tolist() == [0.0] * 3


@pytest.mark.parametrize("given", [{}, {"normal_n": 1.0, "normal_mm": 1.0}])
def test_a_load_is_a_force_or_a_travel(given: dict) -> None:
    with pytest.raises(InputError, match="either the normal force or the plate displacement"):
        LoadStep("x", **given)
    with pytest.raises(InputError, match="either the shear force or the plate displacement"):
        LoadStep("x", 1.0, 1.0, shear_mm=1.0)


def test_a_plate_from_the_wrong_side_is_refused() -> None:
    with pytest.raises(InputError, match=r"would pass through .* mm of other tissue before it touches the skin"):
        press(dome(), PRESS, normal=[1.0, 0.0, 0.0])


def test_tissue_that_hangs_on_no_bone_is_refused() -> None:
    mesh = dome((3, 4, 4))
    skin = mesh.cells[mesh.regions["skin"]]
    own = np.unique(skin)
    new = np.full(len(mesh.points_mm), -1)
    new[own] = len(mesh.points_mm) + np.arange(len(own))
    cells = mesh.cells.copy()
    cells[mesh.regions["skin"]] = new[skin]
    facets = {"bone": mesh.facets["bone"], "skin": new[mesh.facets["skin"]]}
    apart = TetMesh(np.concatenate([mesh.points_mm, mesh.points_mm[own]]), cells, mesh.regions, facets)
    with pytest.raises(InputError, match="are not connected to a fixed surface"):
        press(apart, PRESS)


def test_a_plate_without_friction_carries_no_shear() -> None:
    with pytest.raises(InputError, match="cannot apply shear"):
        press(dome(), [SHEARED], taped=False)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"loads": [LoadStep("pulled", -1.0)]}, "pulled: the normal force must be above 0 N"),
        ({"loads": []}, "At least one load"),
        ({"laws": {"fat": FAT}}, "Give each region one: skin has none"),
        ({"laws": LAWS | {"bone": FAT}}, "no region 'bone'; it has skin, fat"),
        ({"facets": {"skin": None}}, "no surface set 'bone'"),
        ({"element": "P3"}, "Unknown element 'P3'"),
        ({"normal": [1.0, 0, 0], "shear": [1.0, 0, 0]}, "parallel"),
        (
            {"loads": [LoadStep("kN", 1e9)]},
            r"kN, 1e\+09 N, is a pressure of 2.5e\+06 MPa on all of the skin \(4 cm2\), over 1000 times the shear",
        ),
        ({"loads": [LoadStep("slid", 2.0, -1e9)]}, r"slid, 1e\+09 N, is a pressure of"),
        ({"laws": dict.fromkeys(LAWS, NeoHooke.of(2e-6))}, r"stiffest tissue \(2e-06 MPa\): no tissue withstands it"),
        (
            {"laws": LAWS | {"fat": NeoHooke.of(1e-8)}},
            r"The material of fat has a shear modulus of 0.01 Pa, like a liquid: .* check them\.",
        ),
        ({"loads": [LoadStep("far", normal_mm=95.0)]}, r"far: the plate would move by more than the size of the body"),
        ({"loads": [LoadStep("far", 2.0, shear_mm=-95.0)]}, r"than the size of the body \(20 mm\)"),
    ],
)
def test_what_cannot_be_simulated_is_refused(change: dict, said: str) -> None:
    mesh = dome((2, 2, 2))
    if "facets" in change:
        mesh = TetMesh(mesh.points_mm, mesh.cells, mesh.regions, {"skin": mesh.facets["skin"]})
        change = {}
    loads, laws = change.pop("loads", PRESS), change.pop("laws", LAWS)
    with pytest.raises(InputError, match=said):
        press(mesh, loads, laws, **change)


@pytest.mark.parametrize(
    ("load", "gap_mm", "said"),
    [
        (LoadStep("a", 300.0), 0.0, ""),  # 0.75 MPa
        (LoadStep("a", 800.0), 0.0, "800 N, is a pressure of 2 MPa .* runner's heel .* Is it in mN"),
        (LoadStep("a", 2.0, -800.0), 0.0, "800 N, is a pressure of 2 MPa"),
        (LoadStep("a", 0.05), 0.0, ""),  # 0.125 kPa
        (LoadStep("a", 0.015), 0.0, r"0.015 N, is .* than the weight of 5 mm of tissue. Forces are in N. Is it in kN"),
        (LoadStep("a", 0.015, 2.0), 0.0, ""),
        (LoadStep("a", normal_mm=3.05), 3.0, ""),
        (LoadStep("a", normal_mm=0.005), 0.0, "by 0.005 mm into the tissue, less than a thousandth .* Is it in m"),
        (LoadStep("a", normal_mm=3.005), 3.0, r"by 0.005 mm into the tissue, .* in mm\.$"),
        (LoadStep("a", normal_mm=9.9), 0.0, ""),
        (LoadStep("a", normal_mm=12.0), 3.0, ""),
        (LoadStep("a", normal_mm=12.0), 0.0, "Under a the plate would move by 12 mm .* past the bone, .* 10 mm"),
    ],
)
def test_a_load_that_is_unusual_for_tissue_is_told(load: LoadStep, gap_mm: float, said: str) -> None:
    notes = Problem(dome((2, 2, 2)), LAWS, Plate(DOWN, ALONG, gap_mm=gap_mm), [load]).notes
    assert [bool(re.search(said, note)) for note in notes] == [True] * bool(said)


@pytest.mark.parametrize(("gap_mm", "unit"), [(1e6, ""), (500.0, " Is it in micrometres?")])
def test_a_gap_larger_than_the_body_is_refused(gap_mm: float, unit: str) -> None:
    with pytest.raises(InputError) as told:
        Problem(dome((2, 2, 2)), LAWS, Plate(DOWN, ALONG, gap_mm=gap_mm), PRESS)
    said = f"(--gap-mm), is {gap_mm:g} mm, larger than the body (20 mm). Gaps are in mm.{unit}"
    assert str(told.value).endswith(said)
    assert Problem(dome((2, 2, 2)), LAWS, Plate(DOWN, ALONG, gap_mm=15.0), PRESS)


def test_cells_that_are_there_twice_are_refused() -> None:
    mesh = dome((2, 2, 2))
    again = mesh.cells[[7, 3, 3, 20, 9]][:, [2, 0, 1, 3]]  # in another order
    fat = np.append(mesh.regions["fat"], len(mesh.cells) + np.arange(5))
    twice = TetMesh(mesh.points_mm, np.concatenate([mesh.cells, again]), dict(mesh.regions) | {"fat": fat}, mesh.facets)
    with pytest.raises(InputError, match=r"5 of 53 cells are repeated.* They are cells 48, 49, 50 \.\.\. \(from 0\)"):
        press(twice, PRESS)


def test_cells_that_overlap_or_are_not_connected_are_told() -> None:
    mesh = dome((2, 2, 2))
    assert Problem(mesh, LAWS, Plate(DOWN, ALONG), [LoadStep("a", normal_n=1.0)]).notes == ()
    points, cells = np.concatenate([mesh.points_mm, mesh.points_mm[mesh.cells[7, :2]]]), mesh.cells.copy()
    cells[7, :2] = len(mesh.points_mm) + np.arange(2)
    apart = TetMesh(points, cells, dict(mesh.regions), mesh.facets)
    assert where_open(apart).startswith("2 nodes of the mesh lie where another node lies")
    unused = TetMesh(points, mesh.cells, dict(mesh.regions), mesh.facets)
    assert where_open(unused) == ""
    assert where_open(apart) in Problem(apart, LAWS, Plate(DOWN, ALONG), [LoadStep("a", normal_n=1.0)]).notes


def test_the_plate_travels_its_gap_first(sheared: list[LoadState]) -> None:
    plate = Plate(DOWN, ALONG, gap_mm=2.5)
    state = solved(dome(), LAWS, plate, PRESS)[0]
    assert state.plate_displacement_mm == pytest.approx(
        np.add(sheared[0].plate_displacement_mm, [2.5, 0.0, 0.0]), abs=1e-9
    )
    assert np.abs(state.u_mm - sheared[0].u_mm).max() < 1e-9


def test_a_gap_must_not_be_negative() -> None:
    with pytest.raises(InputError, match="0 mm or more"):
        Plate(DOWN, ALONG, gap_mm=-1.0)


@pytest.mark.full_size
def test_where_stiff_skin_buckles_over_soft_fat_the_way_goes_downhill(monkeypatch: pytest.MonkeyPatch) -> None:
    """A published pair of laws, skin a thousand times as stiff as fat; without the way down a third is reached."""
    soft = {"skin": NeoHooke.of(0.3247, nu=0.495), "fat": NeoHooke.of(0.00029, nu=0.495)}
    loads = [LoadStep("pressed", 10.0)]
    (there,) = press(dome((5, 8, 8)), loads, soft)
    assert there.reached == 1.0
    assert there.force_n == pytest.approx([10.0, 0.0, 0.0], abs=0.01)
    crowded = {row.region: row.crowded_share for row in region_figures(dome((5, 8, 8)), there, soft)}
    assert crowded["skin"] == 0.0
    assert 0.01 < crowded["fat"] < 0.5
    with monkeypatch.context() as clock:  # time is asked before every step, those downhill as well
        clock.setattr("fe.solution.time", SimpleNamespace(monotonic=itertools.count().__next__))
        (cut,) = press(dome((5, 8, 8)), loads, soft, limit_s=60.0)
    assert cut.out_of_time
    assert 0.0 < cut.reached < there.reached
    assert cut.iterations < 0.9 * there.iterations
    monkeypatch.setattr("fe.load_path.descend", lambda *_: None)
    (before,) = press(dome((5, 8, 8)), loads, soft)
    assert before.reached < 0.5


def test_how_much_is_done_is_told_from_the_first_touch_on() -> None:
    heard, at_once = Notebook(), Notebook()
    press(dome(), [*PRESS, SHEARED], observer=heard)
    shares = heard.shares
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert sum(0.0 < share < 0.4 for share in shares) > 2  # on the way of the plate to the first load
    assert any(0.5 < share < 1.0 for share in shares)
    press(dome(), [SHEARED], observer=at_once)  # normal first, and half of it all
    assert sum(0.0 < share < 0.5 for share in at_once.shares) > 2


def test_a_plate_needs_a_surface_that_is_free() -> None:
    with pytest.raises(InputError, match="All nodes of 'skin' are fixed"):
        press(dome(), PRESS, fixed=("bone", "skin"))
