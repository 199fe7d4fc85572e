"""Mixed elements: tables, tangent, patch test, closed forms of homogeneous states, shared equations, both solvers."""

import importlib.util
import math
import os
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import sparse

from fe import Hencky, NeoHooke, Ogden, Tolerance, Yeoh
from fe.assembly import Assembler
from fe.elements import Model, Space, element
from fe.linear import SingularError, Solver, factors, self_test, tell_where_mkl_is
from fe.newton import LEAST_VOLUME, Imposed, equilibrium
from tests.blocks import block

needs_mkl = pytest.mark.skipif(
    importlib.util.find_spec("pypardiso") is None, reason="MKL's PARDISO does not run on this kind of machine"
)
needs_ngsolve = pytest.mark.skipif(importlib.util.find_spec("ngsolve") is None, reason="NGSolve is not installed")
ELEMENTS = ("P1", "MINI", "P2")
DEGREE = {"P1": 1, "MINI": 5, "P2": 2}
SOFT, STIFF = Ogden.from_ansys(0.0034, 6.2), Yeoh.of(0.265, 1.923)


def model_of(name: str, layers: int = 2, count: int = 2) -> Model:
    mesh = block((2 * count, count, count), (8.0, 4.0, 4.0), layers, wobble=0.15)
    laws = {f"layer {k}": (SOFT, STIFF)[k % 2] for k in range(layers)}
    return Model.of(mesh, laws, element(name))


def unknowns(nodes: np.ndarray, *axes: int) -> np.ndarray:
    return (3 * nodes[:, None] + np.array(axes)).ravel()


@pytest.mark.parametrize("name", ELEMENTS)
def test_quadrature_is_exact_to_its_degree(name: str) -> None:
    table = element(name)
    x, y, z = table.pressure[:, 1:].T
    wrong = {}
    for degree in range(DEGREE[name] + 2):
        for i in range(degree + 1):
            for j in range(degree + 1 - i):
                k = degree - i - j
                exact = 6 * math.prod(map(math.factorial, (i, j, k))) / math.factorial(degree + 3)
                wrong[degree] = max(wrong.get(degree, 0.0), abs((table.weights * x**i * y**j * z**k).sum() - exact))
    assert max(wrong[d] for d in range(DEGREE[name] + 1)) < 1e-15
    assert wrong[DEGREE[name] + 1] > 1e-6  # and to no more


@pytest.mark.parametrize("name", ELEMENTS)
def test_the_functions_gradients(name: str) -> None:
    table = element(name)
    share = table.gradients[:, : 4 if name == "MINI" else None]
    assert np.abs(share.sum(axis=1)).max() < 1e-14  # a translation has no gradient
    if name == "P2":  # the function of an edge's middle is 4 b_i b_j
        h, b = 1e-6, table.pressure[0]
        for axis in range(3):
            step = h * np.eye(4)[axis + 1] - h * np.eye(4)[0]
            plus, minus = (4 * c[1] * c[2] for c in (b + step, b - step))
            assert table.gradients[0, 5, axis] == pytest.approx((plus - minus) / (2 * h), abs=1e-8)


def test_pressure_jumps_between_tissues_and_nowhere_else() -> None:
    mesh = block((4, 2, 2), (8.0, 4.0, 4.0), layers=2)
    tissue = np.zeros(len(mesh.cells), dtype=int)
    tissue[mesh.regions["layer 1"]] = 1
    space = Space.on(mesh, "P1", tissue)
    border = int(np.isclose(mesh.points_mm[:, 0], 4.0).sum())
    assert space.pressures == len(mesh.points_mm) + border


@pytest.mark.parametrize("name", ELEMENTS)
@pytest.mark.parametrize("pressed", [0.0, 0.7], ids=["plain", "nearly flat"])
def test_tangent_is_the_derivative_of_the_residual(name: str, pressed: float) -> None:
    model = model_of(name)
    nodes = model.space.nodes_mm
    left, right = (np.flatnonzero(np.isclose(nodes[:, 0], x)) for x in (0.0, 8.0))
    assembler = Assembler(model, unknowns(left, 0, 1, 2), {k: unknowns(right, k) for k in range(3)})
    random = np.random.default_rng(0)
    state = np.zeros(model.unknowns)
    corner = np.unique(model.space.cells[:, :4])
    state[unknowns(corner, 0, 1, 2)] = (0.05, 0.02)[pressed > 0.0] * random.normal(size=3 * len(corner))
    linear = np.arange(len(nodes)) if name == "P2" else corner
    state[unknowns(linear, 0)] -= pressed * nodes[linear, 0]
    state[3 * len(nodes) :] = 0.01 * random.normal(size=model.space.pressures)
    for followers in ({}, {k: unknowns(right[::2], k) for k in range(3)}):
        assembler.share(followers)
        change = random.normal(size=assembler.size)
        change[assembler.idle] = 0.0
        h = 1e-6
        ahead, behind = (assembler.residual(state + s * h * assembler.spread(change))[1] for s in (1, -1))
        upper = np.zeros((assembler.size, assembler.size))
        data = assembler.tangent(state)
        for row in range(assembler.size):
            at = slice(assembler.indptr[row], assembler.indptr[row + 1])
            upper[row, assembler.indices[at]] = data[at]
        whole = upper + np.triu(upper, 1).T
        expected = (ahead - behind) / (2 * h)
        assert np.abs(whole @ change - expected).max() < (1e-8, 1e-6)[pressed > 0.0] * np.abs(expected).max()


@pytest.mark.parametrize("name", ELEMENTS)
def test_a_node_that_moves_and_follows_others_changes_what_a_whole_evaluation_would(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only the cells around it are evaluated, and folded cells leave nothing behind."""
    model = model_of(name, count=4)
    nodes = model.space.nodes_mm
    left, right = (np.flatnonzero(np.isclose(nodes[:, 0], x)) for x in (0.0, 8.0))
    built = (model, unknowns(left, 0, 1, 2), {k: unknowns(right, k) for k in range(3)})
    assembler, evaluated, run = Assembler(*built), [], Assembler._in_chunks
    monkeypatch.setattr(Assembler, "_in_chunks", lambda *given, **how: evaluated.append(given[2]) or run(*given, **how))
    state = np.random.default_rng(0).normal(0.0, 0.01, model.unknowns)
    assembler.residual(state, ahead=True)
    for count, move in ((1, 0.05), (2, -0.05), (3, -50.0), (2, 0.1)):
        followers = {k: unknowns(right[:count], k) for k in range(3)}
        state[unknowns(right[:count], 0)] += move
        fresh = Assembler(*built)
        fresh.share(followers)
        expected = *fresh.residual(state), fresh.tangent(state)
        evaluated.clear()
        assembler.share(followers)
        found = *assembler.residual(state, ahead=True), assembler.tangent(state)
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-12 * np.nanmax(np.abs(other)))
        assert (evaluated[0] is None) == (count == 2 and move > 0.0)  # after folded cells all are evaluated
        assert evaluated[0] is None or len(evaluated[0]) < 0.2 * len(model.space.cells)
        if move < -1.0:
            assert not found[2] > 0.0
        state[unknowns(right[:count], 0)] -= move * (move < -1.0)


@pytest.mark.parametrize("name", ELEMENTS)
def test_patch(name: str) -> None:
    """A uniform deformation of one tissue, its border moved accordingly, is found exactly on a crooked mesh."""
    model = model_of(name, layers=1)
    nodes = model.space.nodes_mm
    corners = np.zeros(len(nodes), dtype=bool)
    corners[np.unique(model.space.cells[:, : 10 if name == "P2" else 4])] = True
    rim = corners & ((nodes <= 1e-9) | (nodes >= np.array([8.0, 4.0, 4.0]) - 1e-9)).any(axis=1)
    F = np.array([[1.2, 0.3, 0.0], [0.0, 0.9, 0.1], [0.05, 0.0, 0.95]])
    F /= np.cbrt(np.linalg.det(F) / 1.0002)
    assembler = Assembler(model, unknowns(np.flatnonzero(rim), 0, 1, 2), {})
    state = np.zeros(model.unknowns)
    for share in (0.5, 1.0):
        gradient = (np.eye(3) + share * (F - np.eye(3))) - np.eye(3)
        state[unknowns(np.flatnonzero(corners), 0, 1, 2)] = (nodes[corners] @ gradient.T).ravel()
        found = equilibrium(
            assembler, Solver(assembler.indptr, assembler.indices), state, Imposed(np.zeros(assembler.size)),
            Tolerance(force=1e-10, step_mm=1e-9, iterations=20),
        )  # fmt: skip
        assert found is not None
        state = found.state.copy()
    gradients = model.gradients(state)
    assert np.abs(gradients - (F - np.eye(3))).max() < 1e-9
    assert model.pressures(state) == pytest.approx(SOFT.bulk_modulus_mpa * 2e-4, rel=1e-5)


@pytest.mark.parametrize("name", ELEMENTS)
@pytest.mark.parametrize("law", [NeoHooke.of(0.05), SOFT, STIFF, Hencky.of(0.3, nu=0.49)], ids=lambda m: m.law)
def test_a_bar_pulled_and_pressed_has_the_laws_closed_form(name: str, law) -> None:
    mesh = block((2, 2, 2), (4.0, 4.0, 4.0), wobble=0.2)
    model = Model.of(mesh, {"layer 0": law}, element(name))
    nodes = model.space.nodes_mm
    flat = [np.flatnonzero(np.isclose(nodes[:, k], 0.0)) for k in range(3)]
    fixed = np.unique(np.concatenate([unknowns(flat[k], k) for k in range(3)]))
    end = np.flatnonzero(np.isclose(nodes[:, 0], 4.0))
    if name == "MINI":
        end = end[end < len(mesh.points_mm)]
    assembler = Assembler(model, fixed, {0: unknowns(end, 0)})
    assembler.share({0: unknowns(end, 0)})
    solver = Solver(assembler.indptr, assembler.indices)
    held = np.array([assembler.own_equations])
    for stretch in (1.3, 0.75):
        state = np.zeros(model.unknowns)
        for part in (0.5, 0.5):
            found = equilibrium(
                assembler, solver, state,
                Imposed(np.zeros(assembler.size), held, np.array([part * 4.0 * (stretch - 1.0)])),
                Tolerance(force=1e-8, step_mm=1e-7, iterations=20),
            )  # fmt: skip
            assert found is not None
            state = found.state
        # exactly: the law with its own compressibility, free at its sides
        F = np.eye(3) + model.gradients(state)
        stress = law.stress(F)
        assert np.abs(stress[:, 1, 1]).max() < 1e-7 * law.bulk_modulus_mpa
        force = found.forces[unknowns(end, 0)].sum()
        assert force == pytest.approx(16.0 * stress[:, 0, 0].mean(), rel=1e-6)
        # and nearly: the incompressible closed form
        if law.nu > 0.499:
            assert force == pytest.approx(16.0 * float(law.nominal_stress([stretch])[0]), rel=5e-3)


def test_no_step_folds_a_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    """A block squeezed to two fifths in one step: whole steps would fold its cells, and shares of them do not."""
    model = model_of("P1", layers=1)
    x = model.space.nodes_mm[:, 0]
    fixed = np.unique(np.concatenate([unknowns(np.flatnonzero(np.isclose(x, end)), 1, 2) for end in (0.0, 8.0)]))
    fixed = np.union1d(fixed, unknowns(np.flatnonzero(np.isclose(x, 0.0)), 0))
    moved = unknowns(np.flatnonzero(np.isclose(x, 8.0)), 0)
    assembler = Assembler(model, fixed, {0: moved})
    assembler.share({0: moved})
    tried, told = [], []
    residual = assembler.residual

    def watched(state: np.ndarray, *, ahead: bool):
        found = residual(state, ahead=ahead)
        tried.append(found[2])
        return found

    monkeypatch.setattr(assembler, "residual", watched)
    found = equilibrium(
        assembler, Solver(assembler.indptr, assembler.indices), np.zeros(model.unknowns),
        Imposed(np.zeros(assembler.size), np.array([assembler.own_equations]), np.array([-4.8])), Tolerance(),
        log=told.append,
    )  # fmt: skip
    made = [float(line.rsplit(" ", 1)[1]) for line in told if "smallest det F" in line]
    assert min(tried) < 0.0
    assert min(made) > LEAST_VOLUME
    assert found is not None
    assert found.state[moved] == pytest.approx(np.full(len(moved), -4.8))


@pytest.mark.parametrize(
    "library", [pytest.param("pardiso", marks=needs_mkl), pytest.param("ngsolve", marks=needs_ngsolve)]
)
def test_every_library_solves_the_same(library: str) -> None:
    model = model_of("P1")
    left = np.flatnonzero(np.isclose(model.space.nodes_mm[:, 0], 0.0))
    right_side = np.flatnonzero(np.isclose(model.space.nodes_mm[:, 0], 8.0))
    assembler = Assembler(model, unknowns(left, 0, 1, 2), {0: unknowns(right_side, 0)})
    assembler.share({0: unknowns(right_side[::2], 0)})
    state = np.random.default_rng(1).normal(0.0, 0.02, model.unknowns)
    data, right = assembler.tangent(state), np.random.default_rng(0).normal(size=assembler.size)
    found = []
    for each in (library, "superlu"):
        solver = factors(assembler.indptr, assembler.indices, library=each)
        solver.factorise(data)
        found.append(solver.solve(right))
        solver.factorise(2.0 * data)  # new values, the same pattern
        assert solver.solve(right) == pytest.approx(0.5 * found[-1], rel=1e-8, abs=1e-10)
        solver.close()
    assert found[0] == pytest.approx(found[1], rel=1e-7, abs=1e-9 * np.abs(found[1]).max())


@pytest.mark.parametrize(
    ("machine", "installed", "expected"),
    [
        ("x86_64", True, "_Pardiso"),
        ("AMD64", True, "_Pardiso"),
        ("arm64", True, "_NGSolve"),
        ("arm64", False, "_SuperLU"),
        ("aarch64", True, "_NGSolve"),
    ],
)
def test_each_machine_has_the_fastest_library_that_runs_there(
    monkeypatch: pytest.MonkeyPatch, machine: str, installed: bool, expected: str
) -> None:
    made: list[str] = []
    for name in ("_Pardiso", "_NGSolve", "_SuperLU"):
        monkeypatch.setattr(f"fe.linear.{name}", lambda *_, name=name: made.append(name))
    monkeypatch.setattr("platform.machine", lambda: machine)
    monkeypatch.setattr("fe.linear.find_spec", lambda name: object() if installed and name == "ngsolve" else None)
    factors(np.array([0, 1]), np.array([0]))
    assert made == [expected]


@needs_mkl
@pytest.mark.parametrize("listed", [True, False])
def test_mkl_is_found_where_its_distribution_says_and_searched_for_where_that_is_wrong(monkeypatch, tmp_path, listed):
    searched: list[str] = []

    def search(name: str) -> str | None:
        searched.append(name)
        return None

    monkeypatch.setattr("pypardiso.pardiso_wrapper.find_library", search)
    monkeypatch.delenv("PYPARDISO_MKL_RT", raising=False)
    if not listed:
        bogus = SimpleNamespace(name="libmkl_rt.so", locate=lambda: tmp_path / "libmkl_rt.so")
        monkeypatch.setattr("fe.linear.files", lambda _: [bogus])
    tell_where_mkl_is.cache_clear()
    try:
        assert self_test().startswith("pardiso solved")
    finally:
        tell_where_mkl_is.cache_clear()
    assert bool(searched) != listed
    assert ("PYPARDISO_MKL_RT" in os.environ) == listed


@pytest.mark.parametrize("library", ["superlu", pytest.param("ngsolve", marks=needs_ngsolve)])
def test_a_library_says_when_a_matrix_is_singular(library: str) -> None:
    model = model_of("P1", layers=1)
    assembler = Assembler(model, np.empty(0, dtype=int), {})
    solver = factors(assembler.indptr, assembler.indices, library=library)

    def solved() -> np.ndarray:
        solver.factorise(np.zeros(len(assembler.indices)))
        return solver.solve(np.ones(assembler.size))

    with pytest.raises(SingularError, match="cannot be factorised"):
        solved()


@needs_mkl
def test_the_place_of_mkl_is_known_before_pypardiso_is_imported_and_searches(monkeypatch) -> None:
    imported = list[bool]()
    monkeypatch.setattr("fe.linear.tell_where_mkl_is", lambda: imported.append("pypardiso" in sys.modules))
    for name in [name for name in sys.modules if name.split(".")[0] == "pypardiso"]:
        monkeypatch.delitem(sys.modules, name)
    factors(np.array([0, 1, 2]), np.array([0, 1]), threads=1, rough=False).close()
    assert imported == [False]


@needs_mkl
def test_single_precision_with_pivots_as_they_come_serves_stiff_skin_on_nearly_incompressible_fat() -> None:
    """Ten thousand times as stiff as it is compressible, displacement and pressure, bent: to 1e-8 in a few steps."""
    model = model_of("P1", count=6)
    left = np.flatnonzero(np.isclose(model.space.nodes_mm[:, 0], 0.0))
    assembler = Assembler(model, unknowns(left, 0, 1, 2), {})
    state = np.random.default_rng(1).normal(0.0, 0.02, model.unknowns)
    data, right = assembler.tangent(state), np.random.default_rng(0).normal(size=assembler.size)
    solver = Solver(assembler.indptr, assembler.indices)
    found = solver.solve(data, right, 1e-8)
    upper = sparse.csr_matrix((data, assembler.indices, assembler.indptr))
    assert np.linalg.norm(upper @ found + sparse.triu(upper, 1).T @ found - right) <= 1e-8 * np.linalg.norm(right)
    assert solver._factors.rough
    assert solver.factorisations == 1
    assert solver.steps <= 6


@needs_mkl
def test_where_single_precision_does_not_do_double_does() -> None:
    """Of numbers that are nothing in single precision."""
    random = np.random.default_rng(3)
    turn, _ = np.linalg.qr(random.normal(size=(60, 60)))
    easy = sparse.csr_matrix(np.triu(turn * np.geomspace(1e-2, 1.0, 60) @ turn.T))
    right = random.normal(size=60)
    for matrix, rough, factorisations in ((easy, True, 1), (1e-60 * easy, False, 2)):
        solver = Solver(matrix.indptr, matrix.indices)
        found = solver.solve(matrix.data, right, 1e-12)
        left = right - (matrix + sparse.triu(matrix, 1).T) @ found
        assert np.abs(left).max() < 1e-6
        assert (solver._factors.rough, solver.factorisations) == (rough, factorisations)


@needs_mkl
def test_after_factorisations_that_failed_comes_a_new_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those in single and in double precision; and the next load begins in single again."""
    matrix = sparse.csr_matrix(np.triu(3.0 * np.eye(40) + np.ones((40, 40))))
    right = np.arange(40.0)
    solver = Solver(matrix.indptr, matrix.indices)
    found = solver.solve(matrix.data, right, 1e-6)

    def fails(*_: object) -> None:
        raise SingularError("no memory")

    with monkeypatch.context() as broken:
        broken.setattr("fe.linear._Pardiso.factorise", fails)
        with pytest.raises(SingularError, match="no memory"):
            solver.solve(-50.0 * matrix.data + np.arange(len(matrix.data)), right, 1e-6)
    assert solver.solve(matrix.data, right, 1e-6) == pytest.approx(found)
    assert not solver._factors.rough
    solver.forget()
    assert solver._factors.rough
    assert solver.solve(matrix.data, right, 1e-6) == pytest.approx(found)


def test_an_old_factorisation_serves_a_matrix_close_to_it() -> None:
    model = model_of("P1", count=3)
    nodes = model.space.nodes_mm
    left = np.flatnonzero(np.isclose(nodes[:, 0], 0.0))
    assembler = Assembler(model, unknowns(left, 0, 1, 2), {})
    state, random = np.zeros(model.unknowns), np.random.default_rng(0)
    solver, exact = (Solver(assembler.indptr, assembler.indices) for _ in range(2))
    right = random.normal(size=assembler.size)
    solver.solve(assembler.tangent(state), right, 1e-6)
    state[: 3 * len(nodes)] = (nodes @ np.diag([0.004, -0.002, -0.002])).ravel()
    data = assembler.tangent(state)
    found = solver.solve(data, right, 1e-5)
    assert (solver.factorisations, exact.factorisations) == (1, 0)
    assert 1 < solver.steps < 10
    expected = exact.solve(data, right, 0.0)
    assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)
    state[: 3 * len(nodes)] = (nodes @ np.diag([0.9, -0.3, -0.2])).ravel()  # far away: it factorises again
    solver.solve(assembler.tangent(state), right, 1e-6)
    assert solver.factorisations == 2
