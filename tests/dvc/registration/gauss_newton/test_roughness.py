"""Roughness of splines: what costs nothing, what detail costs beside what is long, and where it is let be."""

import numpy as np
import pytest

from dvc import threads
from dvc.images.image import Grid
from dvc.registration.gauss_newton.roughness import Roughness

CONTROL = Grid((10, 11, 12), np.array([3.0, 4.0, 5.0]), np.array([1.0, -2.0, 3.0]))
H = CONTROL.spacing_mm
ALONE = ((1.0, 0.0),)  # nothing on u itself


def coordinates() -> tuple[np.ndarray, ...]:
    """Places of the control points from the first one, mm along the axes."""
    return tuple(h * i for h, i in zip(H, np.indices(CONTROL.shape), strict=True))


def laplacian(c: np.ndarray) -> np.ndarray:
    """By differences written down anew: nothing along an axis on that axis' faces."""
    out = np.zeros_like(c)
    for axis, h in enumerate(H, start=1):
        middle = [slice(None)] * 4
        middle[axis] = slice(1, -1)
        out[tuple(middle)] += np.diff(c, 2, axis=axis) / h**2
    return out


def energy(c: np.ndarray, laplacians: int, here: np.ndarray | float = 1.0) -> float:
    for _ in range(laplacians):
        c = laplacian(c)
    length = H.mean() / np.sqrt(2.0)
    return 0.5 * float((here * c**2).sum() * H.prod() * length ** (4 * laplacians - 4))


@pytest.mark.parametrize("laplacians", [1, 2])
def test_the_product_is_the_gradient_of_the_energy(laplacians):
    rng = np.random.default_rng(1)
    here = rng.uniform(0.2, 3.0, CONTROL.shape)
    rough = Roughness(CONTROL, ALONE, laplacians=laplacians, here=here)
    c, d = rng.normal(size=(2, 3, *CONTROL.shape))
    product = rough.product(c)
    assert 0.5 * np.sum(c * product) == pytest.approx(energy(c, laplacians, here), rel=1e-12)
    assert np.sum(d * product) == pytest.approx(np.sum(c * rough.product(d)), rel=1e-10)
    one = np.zeros_like(c)
    one[1, 5, 5, 6] = 1.0
    even = Roughness(CONTROL, ALONE, laplacians=laplacians)
    assert even.product(one)[1, 5, 5, 6] == pytest.approx(even.diagonals()[0][5, 5, 6], rel=1e-12)


def test_two_splines_cost_the_weighted_sum():
    v, w = np.random.default_rng(2).normal(size=(2, 3, *CONTROL.shape))
    both = Roughness(CONTROL, ((1.0, 0.0), (0.5, 0.02)))
    c = np.concatenate([v, w])
    expected = energy(v, 1) + 0.5 * energy(w, 1) + 0.5 * 0.02 * H.prod() * np.sum(w**2)
    assert 0.5 * np.sum(c * both.product(c)) == pytest.approx(expected, rel=1e-12)


def test_affine_displacements_cost_nothing_and_those_of_elastic_bodies_nothing_but_at_the_faces():
    x, y, z = coordinates()
    affine = np.stack([0.1 * x + 0.2 * z + 3.0, -0.3 * y, x * 0.2 - 0.1 * y])
    # a bar bent by its end, nu = 0.3: in equilibrium, so biharmonic, but not harmonic
    nu, curved = 0.3, 1e-3
    bent = np.stack([-curved * x * y * nu, 0.5 * curved * (z**2 + nu * (x**2 - y**2)), -curved * y * z])
    for laplacians in (1, 2):
        rough = Roughness(CONTROL, ALONE, laplacians=laplacians)
        assert np.abs(rough.product(affine)).max() < 1e-10
    inner = (slice(None), *(slice(2, -2),) * 3)
    assert np.abs(laplacian(laplacian(bent))[inner]).max() < 1e-12
    assert np.abs(laplacian(bent)[inner]).max() > 1e-4
    assert energy(bent, 2) < 0.5 * energy(bent, 1)


def test_twice_counts_as_once_at_four_control_spacings_less_above_and_more_below():
    control = Grid((24, 24, 24), np.full(3, 3.2), np.zeros(3))
    share = {}
    for wavelength in (2, 4, 8, 12):
        i = np.indices(control.shape)[0]
        c = np.zeros((3, *control.shape))
        c[1] = np.cos(2.0 * np.pi * i / wavelength)
        once, twice = (Roughness(control, ALONE, laplacians=n).product(c)[1, 12, 12, 12] for n in (1, 2))
        share[wavelength] = twice / once
    assert share[4] == pytest.approx(1.0, rel=1e-9)
    assert share[2] == pytest.approx(4.0, rel=1e-9)
    assert share[8] < 0.1
    assert share[12] < share[8]


def test_there_is_less_weight_where_a_displacement_was_curved():
    """Waves in one half of the lattice, rest in the other; what lies outside tissue is not seen."""
    control = Grid((40, 12, 12), np.full(3, 3.2), np.zeros(3))
    c = np.zeros((3, *control.shape))
    c[2, :20] = np.sin(np.arange(20.0))[:, None, None]
    c[2, 39] = 100.0
    tissue = np.ones(control.shape)
    tissue[36:] = 0.0
    rough = Roughness(control, ALONE)
    follows = rough.following(c, tissue)
    weight = follows.diagonals()[0] / rough.diagonals()[0]
    assert np.exp(np.log(weight[:36]).mean()) == pytest.approx(1.0, rel=1e-9)
    assert weight[10, 6, 6] < 0.6
    assert weight[30, 6, 6] > 1.8
    assert weight[30, 6, 6] / weight[10, 6, 6] < 8.0  # it stays finite, and is the root of what was found
    # as sharply seen at any size of the displacement; one that is straight changes nothing
    np.testing.assert_allclose(rough.following(7.0 * c, tissue).diagonals()[0], follows.diagonals()[0], rtol=1e-12)
    np.testing.assert_array_equal(rough.following(0.0 * c, tissue).diagonals()[0], rough.diagonals()[0])
    np.testing.assert_array_equal(rough.following(c, 0.0 * tissue).diagonals()[0], rough.diagonals()[0])


def test_what_rounding_leaves_of_a_straight_displacement_is_no_curvature():
    x, y, z = coordinates()
    straight = np.stack([0.1 * x + 0.2 * z + 3.0, -0.3 * y, x * 0.2 - 0.1 * y])
    assert 0.0 < np.abs(laplacian(straight)).max() < 1e-14
    even = Roughness(CONTROL, ALONE)
    found = even.following(straight, np.ones(CONTROL.shape))
    np.testing.assert_array_equal(found.diagonals()[0], even.diagonals()[0])


def test_it_is_the_same_on_any_number_of_threads():
    c = np.random.default_rng(3).normal(size=(6, *CONTROL.shape))
    rough = Roughness(CONTROL, ((1.0, 0.0), (2.0, 0.1)), laplacians=2)
    before = threads.count()
    try:
        found = []
        for count in (1, 2, 3):
            threads.use(count)
            found.append(rough.product(c))
    finally:
        threads.use(before)
    assert all(np.array_equal(each, found[0]) for each in found)
