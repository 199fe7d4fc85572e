"""Strain measures against closed forms, and principal values against LAPACK."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import logm, sqrtm
from scipy.spatial.transform import Rotation

from dvc.deformation.strain import StrainField, plate_axes, principal_values
from dvc.errors import InputError

EPS = np.finfo(float).eps
GRADIENTS = arrays(np.float64, (3, 3), elements=st.floats(-0.6, 0.6, allow_subnormal=False))
SEEDS = st.integers(0, 2**32 - 1)


def rotations(count: int, seed: int) -> np.ndarray:
    return Rotation.random(count, random_state=np.random.default_rng(seed)).as_matrix()


def strain_of(H: np.ndarray) -> StrainField:
    return StrainField.from_gradient(np.reshape(H, (-1, 3, 3)))


# --- closed forms ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stretch", [0.4, 0.999999, 1.0, 1.25, 2.0])
def test_uniaxial_stretch(stretch: float) -> None:
    Q = rotations(1, 0)[0]
    strain = strain_of(Q @ np.diag([stretch - 1, 0, 0]) @ Q.T)
    E = (stretch**2 - 1) / 2
    expected = sorted([E, 0.0, 0.0], reverse=True)
    np.testing.assert_allclose(strain.principal[0], expected, rtol=0, atol=4e-16 * max(1, stretch**2))
    assert strain.max_shear[0] == pytest.approx(abs(E) / 2, abs=1e-15)
    assert strain.jacobian[0] == pytest.approx(stretch, abs=1e-15)
    assert strain.volumetric()[0] == pytest.approx(stretch - 1, abs=1e-15)
    assert strain.octahedral_shear()[0] == pytest.approx(2 * np.sqrt(2) / 3 * abs(E), abs=1e-15)
    logarithm = Q.T @ strain.logarithmic()[0] @ Q
    np.testing.assert_allclose(logarithm, np.diag([np.log(stretch), 0, 0]), rtol=0, atol=1e-15)


@pytest.mark.parametrize("gamma", [1e-9, 0.01, 0.3, 2.0])
def test_simple_shear(gamma: float) -> None:
    H = np.zeros((3, 3))
    H[0, 1] = gamma
    strain = strain_of(H)
    E = np.array([[0, gamma / 2, 0], [gamma / 2, gamma**2 / 2, 0], [0, 0, 0]])
    np.testing.assert_allclose(strain.green_lagrange[0], E, rtol=1e-15, atol=0)
    largest_shear = gamma / 2 * np.sqrt(1 + gamma**2 / 4)
    middle = gamma**2 / 4
    assert strain.max_shear[0] == pytest.approx(largest_shear, rel=1e-14)
    expected = [middle + largest_shear, 0.0, middle - largest_shear]
    np.testing.assert_allclose(strain.principal[0], expected, rtol=0, atol=1e-15 * max(1, gamma**2))
    assert strain.jacobian[0] == 1.0


@pytest.mark.parametrize("shear", [1e-12, 1e-9, 1e-6])
def test_small_strains_keep_their_digits(shear: float) -> None:
    """F^T F - I would leave an error of 1e-16, here up to 1e-4 of the strain."""
    H = shear * np.array([[0.3, 1.0, -0.2], [0.1, -0.4, 0.7], [0.9, 0.05, 0.6]])
    strain = strain_of(H)
    exact = (H + H.T + H.T @ H) / 2
    np.testing.assert_allclose(strain.green_lagrange[0], exact, rtol=4 * EPS, atol=0)
    np.testing.assert_allclose(strain.principal[0], np.linalg.eigvalsh(exact)[::-1], rtol=0, atol=8 * EPS * shear)


@given(seed=SEEDS)
@settings(max_examples=50, deadline=None)
def test_rigid_rotation_gives_no_strain(seed: int) -> None:
    R = rotations(20, seed)
    strain = strain_of(R - np.eye(3))
    for values in (strain.green_lagrange, strain.principal, strain.max_shear, strain.volumetric()):
        np.testing.assert_allclose(values, 0.0, rtol=0, atol=8e-15)
    np.testing.assert_allclose(strain.logarithmic(), 0.0, rtol=0, atol=8e-15)


@given(H=GRADIENTS, seed=SEEDS)
@settings(max_examples=100, deadline=None)
def test_objectivity(H: np.ndarray, seed: int) -> None:
    """E(Q F) = E(F): what the observer does leaves strain alone."""
    Q = rotations(1, seed)[0]
    here, there = strain_of(H), strain_of(Q @ (np.eye(3) + H) - np.eye(3))
    for name in ("green_lagrange", "principal", "max_shear", "jacobian"):
        np.testing.assert_allclose(getattr(there, name), getattr(here, name), rtol=0, atol=2e-14)


@given(H=GRADIENTS, seed=SEEDS)
@settings(max_examples=100, deadline=None)
def test_turned_material_has_turned_strain(H: np.ndarray, seed: int) -> None:
    """E(Q H Q^T) = Q E Q^T, and its invariants stay."""
    Q = rotations(1, seed)[0]
    here, there = strain_of(H), strain_of(Q @ H @ Q.T)
    np.testing.assert_allclose(there.components_in(Q), here.green_lagrange, rtol=0, atol=1e-14)
    np.testing.assert_allclose(there.principal, here.principal, rtol=0, atol=1e-14)
    np.testing.assert_allclose(there.octahedral_shear(), here.octahedral_shear(), rtol=0, atol=1e-14)


@given(H=GRADIENTS)
@settings(max_examples=100, deadline=None)
def test_definitions(H: np.ndarray) -> None:
    F = np.eye(3) + H
    strain = strain_of(H)
    E = (F.T @ F - np.eye(3)) / 2
    np.testing.assert_allclose(strain.green_lagrange[0], E, rtol=0, atol=4e-15)
    np.testing.assert_array_equal(strain.green_lagrange[0], strain.green_lagrange[0].T)
    assert strain.jacobian[0] == pytest.approx(np.linalg.det(F), abs=1e-14)
    first, second, third = strain.principal[0]
    assert first >= second >= third
    assert strain.max_shear[0] == (first - third) / 2
    assert strain.octahedral_shear()[0] <= 4 / 3 * np.sqrt(2) * strain.max_shear[0] + 1e-15
    directions = strain.principal_directions()[0]
    np.testing.assert_allclose(directions.T @ directions, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(directions) == pytest.approx(1.0)
    np.testing.assert_allclose((directions * strain.principal[0]) @ directions.T, E, rtol=0, atol=1e-14)


def test_logarithmic_strain_of_general_gradients() -> None:
    H = np.random.default_rng(1).uniform(-0.3, 0.3, size=(20, 3, 3))
    strain = strain_of(H)
    for n, gradient in enumerate(H):
        F = np.eye(3) + gradient
        np.testing.assert_allclose(strain.logarithmic()[n], logm(sqrtm(F.T @ F)), rtol=0, atol=1e-12)
    trace = np.trace(strain.logarithmic(), axis1=1, axis2=2)
    np.testing.assert_allclose(trace, np.log(strain.jacobian), rtol=0, atol=1e-13)


def test_folding_and_collapse() -> None:
    strain = strain_of(np.stack([np.diag([-2.0, 0, 0]), np.diag([-1.0, 0, 0])]))
    assert strain.jacobian.tolist() == [-1.0, 0.0]
    assert strain.valid.all()
    assert np.isfinite(strain.logarithmic()[0]).all()
    assert np.isnan(strain.logarithmic()[1]).all()


def test_missing_is_nan_everywhere_and_nothing_else() -> None:
    H = np.random.default_rng(2).uniform(-0.3, 0.3, size=(5, 3, 3))
    H[1, 2, 0], H[3, 1, 1] = np.nan, np.inf
    strain = strain_of(H)
    assert strain.valid.tolist() == [True, False, True, False, True]
    assert len(strain) == 5
    for values in (
        strain.green_lagrange,
        strain.principal,
        strain.max_shear,
        strain.jacobian,
        strain.volumetric(),
        strain.octahedral_shear(),
        strain.logarithmic(),
        strain.principal_directions(),
        strain.components_in(np.eye(3)),
    ):
        flat = values.reshape(5, -1)
        assert np.isnan(flat[~strain.valid]).all()
        assert np.isfinite(flat[strain.valid]).all()
    none = strain_of(np.full((2, 3, 3), np.nan))
    assert np.isnan(none.logarithmic()).all()
    assert np.isnan(none.principal_directions()).all()
    assert len(StrainField.from_gradient(np.zeros((0, 3, 3)))) == 0


def test_arrays_are_read_only_and_shapes_are_checked() -> None:
    strain = strain_of(np.zeros((3, 3)))
    with pytest.raises(ValueError, match="read-only"):
        strain.green_lagrange[0, 0, 0] = 1.0
    for wrong in (np.zeros((3, 3)), np.zeros((2, 9)), np.zeros((2, 3, 4))):
        with pytest.raises(InputError, match=r"\(n, 3, 3\)"):
            StrainField.from_gradient(wrong)
        with pytest.raises(InputError, match=r"\(n, 3, 3\)"):
            principal_values(wrong)


# --- axes of the plate -------------------------------------------------------------------------------------


@given(seed=SEEDS)
@settings(max_examples=50, deadline=None)
def test_plate_axes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    normal, shear = rng.normal(size=3) * 10.0 ** rng.uniform(-5, 5), rng.normal(size=3)
    axes = plate_axes(normal, shear)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), rtol=0, atol=4e-15)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes[:, 0] @ normal == pytest.approx(np.linalg.norm(normal))
    assert axes[:, 1] @ shear > 0
    assert axes[:, 2] @ shear == pytest.approx(0.0, abs=1e-14)


def test_plate_axes_nearly_parallel_stay_perpendicular() -> None:
    axes = plate_axes([1.0, 1.0, 1.0], [1.0, 1.0, 1.00001])
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), rtol=0, atol=4e-16)


def test_shear_under_a_plate() -> None:
    """Tissue sheared along y under a plate with normal z: E_normal,shear is half the engineering shear."""
    H = np.zeros((3, 3))
    H[1, 2] = 0.2
    E = strain_of(H).components_in(plate_axes([0, 0, 1], [0, 1, 0]))[0]
    assert E[0, 1] == pytest.approx(0.1)
    assert E[0, 0] == pytest.approx(0.02)
    assert E[2, 2] == 0.0


@pytest.mark.parametrize(
    ("normal", "shear", "message"),
    [
        ([0, 0, 0], [1, 0, 0], "normal must be"),
        ([0, 0, 1], [0, 0, np.nan], "shear direction must be"),
        ([0, 0, 1], [0, 1], "shear direction must be"),
        ([0, 0, 1], [0, 0, -3], "parallel"),
        ([1, 2, 3], [1, 2, 3 + 1e-8], "parallel"),
    ],
)
def test_plate_axes_refused(normal: list[float], shear: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        plate_axes(normal, shear)


def test_axes_that_are_not_orthonormal_are_refused() -> None:
    for axes in (np.eye(3) * 1.001, np.ones((3, 3)), np.eye(2)):
        with pytest.raises(InputError, match="perpendicular unit vectors"):
            strain_of(np.zeros((3, 3))).components_in(axes)


# --- principal values --------------------------------------------------------------------------------------

TOLERANCE = 16 * EPS  # of the tensor's norm; LAPACK itself is off by half of that; an arc cosine by 1e8 EPS


def tensors(values: np.ndarray, seed: int) -> np.ndarray:
    Q = rotations(len(values), seed)
    A = (Q * values[:, None, :]) @ Q.transpose(0, 2, 1)
    return (A + A.transpose(0, 2, 1)) / 2


@pytest.mark.parametrize("gap", [None, 0.0, 1e-15, 1e-12, 1e-8, 1e-4])
@pytest.mark.parametrize("pair", [(0, 1), (1, 2), (0, 2)])
@pytest.mark.parametrize("scale", [1e-200, 1e-8, 1.0, 1e200])
def test_principal_values_equal_lapack(gap: float | None, pair: tuple[int, int], scale: float) -> None:
    values = np.random.default_rng(3).uniform(-1.0, 1.0, size=(5000, 3))
    if gap is not None:
        values[:, pair[1]] = values[:, pair[0]] + gap
    A = tensors(values, 4)
    norm = np.abs(A).max(axis=(1, 2))[:, None]
    expected = np.linalg.eigvalsh(A)[:, ::-1]
    found = principal_values(A * scale)
    assert (np.abs(found / scale - expected) / norm).max() < TOLERANCE
    assert (np.diff(found, axis=1) <= 0).all()


def test_nearly_equal_values_are_told_apart() -> None:
    """Two values 1e-12 apart keep their distance to rounding; the arc cosine gives 0 or 1e-8."""
    for gap in (1e-6, 1e-9, 1e-12):
        exact = np.diag([1.0, 1.0 + gap, -0.5])
        found = principal_values(tensors(np.array([[1.0, 1.0 + gap, -0.5]]), 5))[0]
        on_axes = principal_values(exact[None])[0]
        assert found[0] - found[1] == pytest.approx(gap, abs=4e-15)
        assert on_axes[0] - on_axes[1] == pytest.approx(gap, abs=1e-15)


def test_hydrostatic_with_a_tiny_deviator() -> None:
    for size in (1e-6, 1e-10, 1e-14):
        A = np.eye(3) + size * np.diag([3.0, -1.0, 0.5])
        found = principal_values(A[None])[0]
        np.testing.assert_allclose(found, sorted(np.diag(A), reverse=True), rtol=0, atol=2 * EPS)


@pytest.mark.parametrize("value", [0.0, 1.0, -7.0, 1e300, -1e-320, 5e-324])
def test_hydrostatic(value: float) -> None:
    assert principal_values([np.eye(3) * value])[0] == pytest.approx([value] * 3, rel=2 * EPS, abs=0)


def test_invalid_tensors_are_nan_and_alone() -> None:
    A = np.stack([np.eye(3), np.eye(3), np.eye(3)])
    A[1, 0, 2] = np.nan
    A[2, 1, 1] = -np.inf
    found = principal_values(A)
    assert np.isnan(found[1:]).all()
    assert np.isfinite(found[0]).all()
