"""Laws: stress is the energy's derivative and the tangent the stress', closed forms, objectivity, stability."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from dvc.errors import InputError
from fe import MODES, Hencky, Material, NeoHooke, Ogden, Yeoh

LAWS: dict[str, Material] = {
    "neo-Hooke": NeoHooke.of(0.1),
    "Isihara": Yeoh.of(0.265, 1.923),
    "Yeoh": Yeoh.of(0.005, 0.069, 1.967),
    "Hencky": Hencky.of(0.3859, nu=0.49),
    "Ogden": Ogden.from_ansys(0.0034, 6.2),
    "Ogden-2": Ogden.of([0.1, 0.05], [2.3, -4.0], nu=0.45),
}
STEP = 1e-6
by_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())


def gradients() -> np.ndarray:
    """Random ones with det F over 0.3, and those with two or three equal stretches, exactly and nearly."""
    F = np.eye(3) + 0.4 * np.random.default_rng(0).uniform(-1, 1, (200, 3, 3))
    special = [
        np.eye(3),
        1.1 * np.eye(3),
        np.diag([1.2, 1.2, 0.8]),
        np.diag([1.2, 1.2 + 1e-7, 0.8]),
        np.diag([1.2, 1.2 + 1e-4, 0.8]),
    ]
    return np.concatenate([F[np.linalg.det(F) > 0.3], special])


def central_difference(of, F: np.ndarray) -> np.ndarray:
    """d of(F) / dF: the last two axes are those of F."""
    found = []
    for i in range(3):
        for j in range(3):
            step = np.zeros((3, 3))
            step[i, j] = STEP
            found.append((of(F + step) - of(F - step)) / (2 * STEP))
    return np.moveaxis(np.array(found), 0, -1).reshape(*found[0].shape, 3, 3)


@by_law
def test_stress_is_the_derivative_of_the_energy(law: Material) -> None:
    F = gradients()
    stress = law.stress(F)
    assert np.abs(central_difference(law.energy, F) - stress).max() < 2e-9 * np.abs(stress).max()


@by_law
def test_tangent_is_the_derivative_of_the_stress_and_symmetric(law: Material) -> None:
    F = gradients()
    tangent = law.tangent(F)
    assert np.abs(central_difference(law.stress, F) - tangent).max() < 2e-9 * np.abs(tangent).max()
    assert np.abs(tangent - tangent.transpose(0, 3, 4, 1, 2)).max() < 1e-12 * np.abs(tangent).max()


@by_law
def test_small_strain_is_hookes_law(law: Material) -> None:
    mu, bulk = law.shear_modulus_mpa, law.bulk_modulus_mpa
    identity = np.eye(3)
    expected = mu * (np.einsum("ik,jl->ijkl", identity, identity) + np.einsum("il,jk->ijkl", identity, identity)) + (
        bulk - 2 / 3 * mu
    ) * np.einsum("ij,kl->ijkl", identity, identity)
    assert np.abs(law.tangent(identity[None])[0] - expected).max() < 1e-12 * bulk
    assert np.abs(law.stress(identity[None])).max() < 1e-15 * bulk
    assert law.nu == pytest.approx((3 * bulk - 2 * mu) / (2 * (3 * bulk + mu)), rel=1e-12)


@by_law
@given(st.lists(st.floats(-3, 3), min_size=9, max_size=9), st.lists(st.floats(-1, 1), min_size=4, max_size=4))
@settings(max_examples=25, deadline=None)
def test_the_frame_does_not_matter(law: Material, numbers: list[float], quaternion: list[float]) -> None:
    F = np.eye(3) + 0.1 * np.reshape(numbers, (3, 3))
    q = np.add(quaternion, [1.5, 0, 0, 0])
    w, x, y, z = q / np.linalg.norm(q)
    Q = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    if np.linalg.det(F) < 0.3:
        return
    plain, turned, fibre = law.stress(np.array([F, Q @ F, F @ Q]))
    size = np.abs(plain).max() + law.bulk_modulus_mpa
    assert np.abs(turned - Q @ plain).max() < 1e-11 * size  # objective
    assert np.abs(fibre - plain @ Q).max() < 1e-11 * size  # isotropic


def test_closed_forms_of_the_incompressible_tests() -> None:
    stretch = np.array([0.6, 0.9, 1.0, 1.3, 1.8])
    i1 = stretch**2 + 2 / stretch
    slope = 0.265 + 2 * 1.923 * (i1 - 3)
    assert Yeoh.of(0.265, 1.923).nominal_stress(stretch) == pytest.approx(
        2 * slope * (stretch - stretch**-2), rel=1e-12, abs=1e-14
    )
    mu, alpha = 0.0034, 6.2  # ANSYS: W = mu / alpha sum (l^alpha - 1)
    fat = Ogden.from_ansys(mu, alpha)
    assert fat.nominal_stress(stretch) == pytest.approx(
        mu * (stretch ** (alpha - 1) - stretch ** (-alpha / 2 - 1)), rel=1e-12, abs=1e-14
    )
    assert fat.nominal_stress(stretch, "equibiaxial") == pytest.approx(
        mu * (stretch ** (alpha - 1) - stretch ** (-2 * alpha - 1)), rel=1e-12, abs=1e-14
    )
    assert fat.nominal_stress(stretch, "pure shear") == pytest.approx(
        mu * (stretch ** (alpha - 1) - stretch ** (-alpha - 1)), rel=1e-12, abs=1e-14
    )
    assert Hencky.of(0.2).nominal_stress(stretch) == pytest.approx(
        3 * 0.2 * np.log(stretch) / stretch, rel=1e-12, abs=1e-14
    )


@pytest.mark.parametrize("mode", MODES)
def test_nominal_stress_is_that_of_the_full_law_with_free_sides(mode: str) -> None:
    law = Ogden.of([0.1, 0.05], [2.3, -4.0])
    stretches = 1.4 ** np.array(MODES[mode])
    stress = law.stress(np.diag(stretches)[None])[0]
    pressure = stress[2, 2] * stretches[2]  # the third axis is free
    assert law.nominal_stress([1.4], mode)[0] == pytest.approx(stress[0, 0] - pressure / stretches[0], rel=1e-10)


def test_the_same_numbers_in_three_programs() -> None:
    # The energies as each program's manual writes them, at one isochoric state.
    stretches = np.array([1.5, 0.9, 1 / (1.5 * 0.9)])
    power = np.sum(stretches**6.2 - 1)
    energies = {"from_ansys": 0.0034 / 6.2 * power, "from_abaqus": 2 * 0.0034 / 6.2**2 * power}
    for made, energy in energies.items():
        law = getattr(Ogden, made)(mu_mpa=0.0034, alpha=6.2)
        assert law.energy(np.diag(stretches)[None])[0] == pytest.approx(energy, rel=1e-12)
    febio = Ogden.from_febio(c_mpa=0.0034, m=6.2)
    assert febio.energy(np.diag(stretches)[None])[0] == pytest.approx(0.0034 / 6.2**2 * power, rel=1e-12)


def test_a_law_that_loses_stability_says_where() -> None:
    # 3 C10 + ... : in tension of Yeoh's law with C20 < 0 the stress of a bar peaks, and Drucker's condition ends there.
    law = Yeoh.of(0.1, -0.02)
    low, high = law.stable_range("uniaxial")
    assert 0.2 < low < 1.0 < high < 5.0
    strain = np.log(np.linspace(1.0, 5.0, 4001))
    true_stress = np.exp(strain) * law.nominal_stress(np.exp(strain))
    peak = np.exp(strain[np.argmax(true_stress)])
    assert high <= peak * 1.001  # no later than where a uniaxial test itself shows it
    inside, outside = (np.diag([s, s**-0.5, s**-0.5]) for s in (0.99 * high, 1.01 * high))
    assert law.is_stable(np.array([np.eye(3), inside, outside, -np.eye(3)])).tolist() == [True, True, False, False]


def test_folded_gradients_have_no_stress() -> None:
    assert np.isnan(NeoHooke.of(0.1).stress(np.diag([-1.0, 1.0, 1.0])[None])).all()


def test_a_gradient_on_its_last_legs_gives_no_number_and_no_crash() -> None:
    flat = np.diag([1e-200, 1.0, 1.0])[None]  # its square has no digits left
    assert not np.isfinite(NeoHooke.of(0.1).stress(flat)).all()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: NeoHooke.of(0.1, nu=0.5), "Poisson's ratio must be between 0 and 0.49999; got 0.5"),
        (lambda: NeoHooke.of(0.1, nu=-0.1), "Poisson's ratio"),
        (lambda: NeoHooke.of(-0.1), "shear modulus must be positive; it is -100 kPa"),
        (lambda: Yeoh.of(0.0, 1.0), "shear modulus must be positive"),
        (lambda: NeoHooke.of(float("nan")), "finite"),
        (lambda: Ogden.of([0.1, 0.2], [3.0]), "2 moduli and 1 exponents"),
        (lambda: Ogden.from_ansys(0.01, [6.0, -2.0]), "1 moduli and 2 exponents"),
        (lambda: Ogden.of(0.1, 0.0), "exponent of 0"),
        (lambda: NeoHooke.of(0.1).nominal_stress([1.0], "biaxial"), "Unknown test 'biaxial'"),
        (lambda: NeoHooke.of(0.1).nominal_stress([-1.0]), "positive"),
        (lambda: NeoHooke.of(0.1).stress(np.eye(3)), "shape"),
    ],
)
def test_numbers_that_cannot_be(make, said: str) -> None:
    with pytest.raises(InputError, match=said):
        make()
