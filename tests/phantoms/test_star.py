"""Resolution, noise and efficiency by a star whose response is known: true, filtered, and shifted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc import GaussNewton, Mask, Settings, register
from dvc.arrays import FloatArray
from dvc.errors import InputError
from phantoms import ShearStar, StarPair, efficiencies, resolved_mm, star_pair, star_rows, tissue_bar

SMALL = (60, 32, 48)


@pytest.fixture(scope="module")
def pair() -> StarPair:
    return star_pair(shape=SMALL, spacing_mm=1.6)


@dataclass(frozen=True)
class Filtered:
    """A star as a Gaussian along its normal shows it: each period is damped by exp(-2 (pi sigma / p)^2)."""

    star: ShearStar
    sigma_mm: float

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        u, H = self.star.evaluate(points_mm)
        kept = np.exp(-2.0 * (np.pi * self.sigma_mm / self.star.period_mm(points_mm)) ** 2)
        return u * kept[:, None], H * kept[:, None, None]

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        return self.evaluate(points_mm)[0]


@dataclass(frozen=True)
class Noisy:
    """No motion but a shift along z, and white noise of displacement and of its gradient."""

    shift_mm: float
    sd_mm: float
    sd_slope: float

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        random, n = np.random.default_rng(1), len(points_mm)
        u = self.sd_mm * random.standard_normal((n, 3)) + [0.0, 0.0, self.shift_mm]
        return u, self.sd_slope * random.standard_normal((n, 3, 3))

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        return self.evaluate(points_mm)[0]


def test_the_bar_is_half_fat_and_half_muscle_with_contrast_and_in_air(pair: StarPair) -> None:
    names = pair.labels.names | {0: "air"}
    tissue = np.vectorize(names.get)(pair.labels.labels)
    assert set(np.unique(tissue)) == {"air", "fat", "muscle"}
    _, y, z = np.moveaxis(pair.labels.grid.points(), -1, 0)
    inside = (y / 21.6) ** 2 + (z / 34.4) ** 2 < 0.95  # 4 mm from the faces of an image of 51 x 77 mm
    assert (tissue[inside & (z < -1.0)] == "fat").all()
    assert (tissue[inside & (z > 1.0)] == "muscle").all()
    assert (tissue[(y / 21.6) ** 2 + (z / 34.4) ** 2 > 1.05] == "air").all()
    for name in ("fat", "muscle"):
        values = pair.reference.values[tissue == name]
        assert values.std() / values.mean() > 0.05
    again = star_pair(shape=SMALL, spacing_mm=1.6)
    assert (again.loaded.values == pair.loaded.values).all()
    points = pair.labels.grid.points()[inside][:100]
    first, second = (tissue_bar(seed, (21.6, 34.4)).intensity_at(points) for seed in (1, 2))
    assert not np.allclose(first, second)


def test_the_loaded_image_is_the_unloaded_one_moved_by_the_star() -> None:
    """Without noise, tissue at X has the signal that it had, at x = X + u; without the motion it has not."""
    pair = star_pair(shape=(48, 32, 48), spacing_mm=0.8, snr=None)
    bar, points = tissue_bar(1, (8.8, 15.2)), pair.labels.grid.points().reshape(-1, 3)[::7]
    before = bar.intensity_at(points)
    seen = (pair.loaded.values - pair.repeat.values).reshape(-1)[::7]
    moved = {sign: bar.intensity_at(points - sign * pair.star.displacement(points)) - before for sign in (1.0, -1.0)}
    agree = {sign: np.corrcoef(seen, of)[0, 1] for sign, of in moved.items()}
    assert agree[1.0] > 0.35  # bias field and point spread differ
    assert agree[-1.0] < 0.0


def test_a_true_star_is_recovered_whole_and_none_by_one_that_sees_no_motion(pair: StarPair) -> None:
    for row in star_rows(pair.star, pair):
        assert (row.displacement, row.strain) == pytest.approx((1.0, 1.0), abs=1e-9)
    for row in star_rows(Noisy(0.0, 0.0, 0.0), pair):
        assert (row.displacement, row.strain) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_resolution_is_where_a_filter_of_known_width_leaves_nine_tenths(pair: StarPair) -> None:
    sigma = 1.5
    true = np.pi * sigma * np.sqrt(2.0 / -np.log(0.9))  # 20.5 mm
    found = efficiencies(Filtered(pair.star, sigma), Noisy(0.0, 0.0, 0.0), pair)
    assert [of.tissue for of in found] == ["fat", "muscle"]
    for of in found:
        assert of.displacement_resolution_mm == pytest.approx(true, rel=0.02)
        assert of.strain_resolution_mm == pytest.approx(true, rel=0.02)
    wider = efficiencies(Filtered(pair.star, 2.0), Noisy(0.0, 0.0, 0.0), pair)
    assert wider[0].displacement_resolution_mm == pytest.approx(true * 2.0 / 1.5, rel=0.02)
    assert np.isnan(efficiencies(Filtered(pair.star, 4.0), Noisy(0.0, 0.0, 0.0), pair)[0].strain_resolution_mm)


def test_noise_and_bias_are_those_of_the_pair_without_motion(pair: StarPair) -> None:
    (fat, _) = efficiencies(Filtered(pair.star, 1.5), Noisy(0.03, 0.05, 0.02), pair)
    assert fat.displacement_bias_mm == pytest.approx(0.03, abs=0.004)
    assert fat.displacement_noise_mm == pytest.approx(0.05, rel=0.05)
    assert fat.strain_bias == pytest.approx(0.0, abs=0.002)
    assert fat.strain_noise == pytest.approx(0.02 / np.sqrt(2.0), rel=0.05)  # E_dn is half of two slopes
    assert fat.of_displacement_mm2 == pytest.approx(fat.displacement_noise_mm * fat.displacement_resolution_mm)
    assert fat.of_strain_mm2 == pytest.approx(fat.strain_noise * fat.strain_resolution_mm**2)


def test_the_resolution_is_that_from_which_on_all_is_recovered() -> None:
    assert resolved_mm([5.0, 10.0, 20.0], [0.2, 0.8, 1.0]) == pytest.approx(15.0)
    noisy = [0.2, 0.6, 0.88, 0.96, 0.89, 0.97, 1.0]  # noise of a few percent does not make 11 mm of 6
    assert resolved_mm([5.0, 7.0, 9.0, 11.0, 13.0, 15.0, 17.0], noisy) == pytest.approx(9.8, abs=0.2)
    assert np.isnan(resolved_mm([5.0, 10.0], [np.nan, 1.0]))
    assert np.isnan(resolved_mm([5.0, 10.0], [0.95, 0.99]))
    assert np.isnan(resolved_mm([5.0, 10.0], [0.5, 0.8]))


@dataclass(frozen=True)
class Turned:
    """A star, and then a rotation about x, which is no strain."""

    star: ShearStar
    degrees: float

    def evaluate(self, points_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
        turn = Rotation.from_euler("x", self.degrees, degrees=True).as_matrix()
        points = np.asarray(points_mm)
        u, H = self.star.evaluate(points)
        return (points + u) @ turn.T - points, turn @ (H + np.eye(3)) - np.eye(3)

    def displacement(self, points_mm: FloatArray) -> FloatArray:
        return self.evaluate(points_mm)[0]


def test_a_rotation_is_no_part_of_the_strain_that_is_recovered(pair: StarPair) -> None:
    """The resolved strain is the component of which the noise is told, and not a slope, which a rotation changes."""
    for row in star_rows(Turned(pair.star, 5.0), pair):
        assert row.strain == pytest.approx(1.0, abs=1e-9)


@pytest.mark.full_size
def test_two_scans_without_motion_are_registered_to_within_a_tenth_of_a_voxel() -> None:
    """Their receive fields differ. In tissue that fills the image, muscle was carried out of it by millimetres."""
    pair = star_pair(shape=(100, 40, 40), spacing_mm=1.2)
    settings = Settings(GaussNewton().keeping_volume(), align_on="none").of_repeat()
    body = Mask(pair.labels.grid, pair.labels.labels > 0)
    still = register(pair.reference, pair.repeat, tissue=body, settings=settings).displacement
    for of in efficiencies(pair.star, still, pair):
        assert abs(of.displacement_bias_mm) < 0.03
        assert 0.005 < of.displacement_noise_mm < 0.12
        assert 0.001 < of.strain_noise < 0.02


def test_a_short_image_has_fewer_periods_and_a_narrow_one_is_refused() -> None:
    pair = star_pair(shape=(30, 32, 48), spacing_mm=1.6)  # 20 voxels along the star, for up to 24 periods
    rows = star_rows(pair.star, pair)
    assert 20 <= len(rows) < 48
    assert [row.displacement for row in rows] == pytest.approx([1.0] * len(rows))
    with pytest.raises(InputError, match="at least 16 mm wide and high"):
        star_pair(shape=(60, 8, 48), spacing_mm=1.6)
