"""Motions of closed form: gradient, inverse and strain are exact."""

from __future__ import annotations

import numpy as np
import pytest

from dvc.deformation.protocol import Composed, Motion, RigidMotion
from dvc.deformation.strain import StrainField
from dvc.errors import InputError
from phantoms import Bending, ShearStar, ShearWave, compressed, sheared, stretched

CENTRE = np.array([3.0, -2.0, 5.0])
X, Y, Z = np.eye(3)
TURNED = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
POINTS = np.random.default_rng(2).uniform(-40.0, 40.0, (400, 3))

MOTIONS: dict[str, Motion] = {
    "stretched": stretched(np.array([1.2, 0.9, 1.05]), CENTRE),
    "compressed": compressed(2, 0.7, CENTRE),
    "sheared": sheared(X, Z, 0.4, CENTRE),
    "wave": ShearWave(TURNED[0], TURNED[1], 12.0, 0.5, 0.3),
    "star": ShearStar(CENTRE, TURNED[0], TURNED[1], 0.9, 6.0, 30.0, 60.0),
    "bending": Bending(CENTRE, TURNED[2], TURNED[0], 150.0),
    "straightening": Bending(CENTRE, TURNED[2], TURNED[0], 150.0).inverse(),
    "composed": Composed([ShearWave(X, Y, 20.0, 0.3), RigidMotion(TURNED, CENTRE), compressed(0, 1.1, CENTRE)]),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_gradient_is_the_derivative_of_the_map(name: str) -> None:
    motion, h = MOTIONS[name], 1e-4
    u, H = motion.evaluate(POINTS)
    differences = np.stack(
        [(motion.displacement(POINTS + h * e) - motion.displacement(POINTS - h * e)) / (2 * h) for e in np.eye(3)],
        axis=-1,
    )
    assert isinstance(motion, Motion)
    assert np.abs(H).max() > 0.05
    np.testing.assert_allclose(H, differences, atol=1e-6)
    np.testing.assert_allclose(u, motion.displacement(POINTS), atol=1e-12)


@pytest.mark.parametrize("name", MOTIONS)
def test_inverse_leads_back(name: str) -> None:
    motion = MOTIONS[name]
    u, H = motion.evaluate(POINTS)
    back, H_back = motion.inverse().evaluate(POINTS + u)
    assert np.abs(u).max() > 0.5
    np.testing.assert_allclose(back, -u, atol=1e-9)
    np.testing.assert_allclose((np.eye(3) + H_back) @ (np.eye(3) + H), np.tile(np.eye(3), (len(u), 1, 1)), atol=1e-9)


@pytest.mark.parametrize("name", ["compressed", "sheared", "wave", "star", "bending"])
def test_volume_is_kept(name: str) -> None:
    _, H = MOTIONS[name].evaluate(POINTS)
    np.testing.assert_allclose(np.linalg.det(np.eye(3) + H), 1.0, atol=1e-12)


def test_bent_fibres_have_rivlins_stretches() -> None:
    """Along the block r / R, across it R / r, with r^2 = R^2 + 2 R Z."""
    R = 100.0
    bend = Bending(np.zeros(3), Y, Z, R)
    points = np.array([[0.0, 30.0, 0.0], [5.0, -20.0, 10.0], [0.0, 0.0, -12.0]])
    r = np.sqrt(R * R + 2 * R * points[:, 2])
    field = StrainField.from_gradient(bend.evaluate(points)[1])
    stretches = np.sort(np.stack([r / R, R / r, np.ones(3)], axis=1), axis=1)[:, ::-1]
    np.testing.assert_allclose(field.principal, 0.5 * (stretches**2 - 1), atol=1e-12)
    assert bend.displacement(np.array([[0.0, R * np.pi / 2, 0.0]]))[0] == pytest.approx([0.0, R - R * np.pi / 2, -R])


def test_wave_has_the_strain_that_its_peak_says() -> None:
    wave = ShearWave(X, Z, 10.0, 0.6)
    shear = StrainField.from_gradient(wave.evaluate(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.5]]))[1]).max_shear
    np.testing.assert_allclose(shear, [0.6 * np.sqrt(4 + 0.36) / 4, 0.0], atol=1e-12)


def test_star_has_its_amplitude_on_the_middle_plane_and_its_strain_a_quarter_of_a_period_beside() -> None:
    star = ShearStar(np.zeros(3), X, Y, 0.5, 5.0, 45.0, 80.0)
    s = np.array([-60.0, -40.0, -20.0, 0.0, 40.0, 70.0])
    middle = s[:, None] * X
    period = star.period_mm(middle)
    np.testing.assert_allclose(period, [5.0, 5.0, 15.0, 25.0, 45.0, 45.0])
    np.testing.assert_allclose(star.displacement(middle), np.tile(0.5 * Z, (6, 1)), atol=1e-12)
    beside = star.evaluate(middle + 0.25 * period[:, None] * Y)
    np.testing.assert_allclose(beside[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(beside[1][:, 2, 1], -0.5 * 2.0 * np.pi / period)
    with pytest.raises(InputError, match="positive periods"):
        ShearStar(np.zeros(3), X, Y, 0.5, 0.0, 45.0, 80.0)


def test_undefined_is_missing_and_never_zero() -> None:
    u, H = Bending(np.zeros(3), X, Z, 20.0).evaluate(np.array([[0.0, 0.0, -10.5], [0.0, 0.0, 1.0]]))
    assert np.isnan(u[0]).any()
    assert np.isnan(H[0]).any()
    assert np.isfinite(u[1]).all()


def test_refuses_what_is_no_motion() -> None:
    with pytest.raises(InputError, match="positive factors"):
        stretched(np.array([1.0, -1.0, 1.0]), CENTRE)
    with pytest.raises(InputError, match="positive stretch"):
        compressed(0, 0.0, CENTRE)
    with pytest.raises(InputError, match="perpendicular unit vectors"):
        sheared(X, X + Z, 0.1, CENTRE)
    with pytest.raises(InputError, match="wavelength"):
        ShearWave(X, Y, 0.0, 0.1)
    with pytest.raises(InputError, match="radius"):
        Bending(CENTRE, X, Z, -3.0)
    without = Composed([stretched(np.ones(3), CENTRE), _NoInverse()])
    with pytest.raises(InputError, match="its _NoInverse has no inverse"):
        without.inverse()


class _NoInverse:
    def displacement(self, points_mm: np.ndarray) -> np.ndarray:
        return np.zeros_like(points_mm)

    def evaluate(self, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros_like(points_mm), np.zeros((len(points_mm), 3, 3))
