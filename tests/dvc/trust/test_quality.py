"""Verdicts: what must be distrusted is, and says why; strain maps leave out what was not measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from dvc.deformation.protocol import Affine, RigidMotion, SampledDisplacement, Within
from dvc.deformation.strain_maps import strain_maps
from dvc.images.image import Grid, Image, Mask
from dvc.images.noise import noise_in_air
from dvc.images.similarity import Windows, brightness_offset, local_correlation
from dvc.report.page import shown
from dvc.trust.assessment import Similarity, assess
from dvc.trust.quality import NoiseFloor, noise_floor

GRID = Grid((24, 20, 16), np.array([1.0, 1.2, 1.5]), np.array([-10.0, 5.0, 0.0]))
WHOLE = Mask(GRID, np.ones(GRID.shape, dtype=bool))
STRETCH = Affine(np.diag([1.2, 1.0, 1.0]), np.zeros(3))
ALIKE = Similarity((0.3, 0.5, 0.9))


def core() -> Mask:
    inside = np.zeros(GRID.shape, dtype=bool)
    inside[6:18, 5:15, 4:12] = True
    return Mask(GRID, inside)


def test_maps_hold_the_closed_form_of_a_stretch_and_nan_elsewhere():
    maps = strain_maps(STRETCH, core())
    kept = core().inside
    np.testing.assert_allclose(maps.green_lagrange[kept][:, 0], (1.2**2 - 1) / 2, rtol=1e-6)
    np.testing.assert_allclose(maps.green_lagrange[kept][:, 1:], 0.0, atol=1e-7)
    np.testing.assert_allclose(maps.max_shear[kept], (1.2**2 - 1) / 4, rtol=1e-6)
    np.testing.assert_allclose(maps.jacobian[kept], 1.2, rtol=1e-6)
    np.testing.assert_array_equal(maps.valid, kept)
    assert np.isnan(maps.max_shear[~kept]).all()
    assert np.isnan(maps.displacement_mm[~kept]).all()


def test_what_leaves_the_loaded_image_is_no_result_and_is_counted():
    maps = strain_maps(STRETCH, WHOLE, seen=lambda x: x[:, 0] < 0.0)
    share = 1.0 - maps.valid.mean()
    quality = assess(maps, WHOLE, None)
    assert quality.undefined_fraction == pytest.approx(share)
    assert 0.3 < share < 0.9
    assert quality.verdict.level == "distrust"
    assert any("the loaded image does not show it" in reason for reason in quality.verdict.reasons)


def test_row_11_folding_is_found_with_its_place_and_not_trusted():
    u = np.zeros((*GRID.shape, 3))
    X = GRID.points()
    middle = GRID.points_at(np.array([12.0, 10.0, 8.0]))
    u[..., 0] = -3.0 * (X[..., 0] - middle[0]) * np.exp(-np.sum((X - middle) ** 2, axis=-1) / 8.0)
    maps = strain_maps(SampledDisplacement(GRID, u), WHOLE)
    quality = assess(maps, WHOLE, None, similarity=Similarity((0.5, 0.7, 0.95)))
    assert quality.folded_voxels > 0
    assert quality.verdict.level == "distrust"
    assert "folds" in quality.verdict.reasons[0]
    np.testing.assert_allclose(quality.lowest_jacobian_at_mm, middle, atol=1.6)
    assert (
        assess(strain_maps(STRETCH, WHOLE), WHOLE, None, similarity=Similarity((0.5, 0.7, 0.95))).verdict.level
        == "trust"
    )


@pytest.mark.parametrize(
    ("similarity", "level"),
    [
        ((0.3, 0.5, 0.9), "trust"),
        ((0.3, 0.5, 0.6), "caution"),
        ((0.3, 0.35, 0.4), "distrust"),
        ((0.3, 0.9, 0.8), "distrust"),
    ],
)
def test_a_poor_or_falling_similarity_costs_trust(similarity, level):
    assert assess(strain_maps(STRETCH, WHOLE), WHOLE, None, similarity=Similarity(similarity)).verdict.level == level


def test_noise_says_how_alike_two_scans_can_be():
    """Of one texture, and of two: the pair's own correlation is what was said, and far below it."""
    grid = Grid((40, 40, 40), (1.0, 1.0, 1.2), (0.0, 0.0, 0.0))
    inside = np.zeros(grid.shape, dtype=bool)
    inside[8:-8, 8:-8, 8:-8] = True
    mask, random = Mask(grid, inside), np.random.default_rng(4)
    one, other = (np.where(inside, 100.0 + 60.0 * np.cos(grid.points()[..., axis]), 0.0) for axis in (0, 1))

    def scan(signal):
        noise = 12.0 * random.standard_normal((2, *grid.shape))
        return Image(grid, np.hypot(signal + noise[0], noise[1]).astype(np.float32))

    first, again, another = scan(one), scan(one), scan(other)
    noise = noise_in_air(first, mask), noise_in_air(again, mask)
    assert noise == pytest.approx((12.0, 12.0), rel=0.02)
    windows = Windows(mask, first.values, again.values)
    most, with_more_noise = windows.most_similarity(
        windows.structure(first.values), windows.structure(again.values), noise
    )
    assert 0.8 < most < 0.97
    assert local_correlation(first, again.values, mask)[1] == pytest.approx(most, abs=0.02)
    assert local_correlation(first, another.values, mask)[1] < with_more_noise - 0.3
    assert noise_in_air(Image(grid, np.where(inside, first.values, 0.0)), mask) is None


@pytest.mark.parametrize(
    ("lacks", "with_more_noise", "level"),
    [(0.04, 0.0, "trust"), (0.07, 0.0, "caution"), (0.2, 0.08, "caution"), (0.2, 0.1, "distrust")],
)
def test_what_noise_does_not_explain_costs_trust(lacks: float, with_more_noise: float, level: str) -> None:
    verdict = assess(
        strain_maps(STRETCH, WHOLE), WHOLE, None,
        similarity=Similarity((0.3, 0.5, 0.7), (0.7 + lacks, 0.7 + with_more_noise)),
    ).verdict  # fmt: skip
    assert verdict.level == level
    assert all("the same subject" in reason for reason in verdict.reasons)


@pytest.mark.parametrize("offset", [0.0, 0.2])
@pytest.mark.parametrize("noise", [0.0, 0.15])
def test_an_offset_is_told_from_a_gain_that_varies(noise: float, offset: float) -> None:
    rng = np.random.default_rng(3)
    grid = Grid((40, 36, 32), (1.6, 1.6, 1.6), (0.0, 0.0, 0.0))
    tissue = 1.0 + 0.3 * np.sign(gaussian_filter(rng.normal(size=grid.shape), 2.0))
    along = np.linspace(-1.0, 1.0, 40)[:, None, None]
    made = (1.0 + 0.3 * along - 0.3 * along**2) * tissue + offset * along + noise * rng.normal(size=grid.shape)
    loaded = made.astype(np.float32)
    reference = Image(grid, (tissue + noise * rng.normal(size=grid.shape)).astype(np.float32))
    mask = Mask(grid, np.ones(grid.shape, dtype=bool))
    found = brightness_offset(reference, loaded, mask, noise)[0]
    assert found == pytest.approx(0.95 * offset / float(np.percentile(loaded, 75)), abs=0.02)
    if noise:  # it lowers the gain, which seems an offset where it is not taken into account
        assert brightness_offset(reference, loaded, mask, 0.0)[0] > found + 0.04
    flat = Image(grid, np.full(grid.shape, 2.0, dtype=np.float32))
    assert np.isnan(brightness_offset(flat, loaded, mask, 0.0)[0])


@pytest.mark.parametrize(
    ("offset", "with_more_noise", "level"),
    [(0.06, 0.2, "trust"), (0.09, 0.2, "distrust"), (0.13, 0.1, "caution"), (np.nan, np.nan, "trust")],
)
def test_an_offset_between_the_images_costs_trust(offset: float, with_more_noise: float, level: str) -> None:
    quality = assess(
        strain_maps(STRETCH, WHOLE), WHOLE, None,
        similarity=Similarity((0.3, 0.5, 0.9), offset=(offset, with_more_noise)),
    )  # fmt: skip
    assert quality.verdict.level == level


@pytest.mark.parametrize(("slice_mm", "level"), [(2.0, "trust"), (4.0, "caution"), (6.0, "distrust")])
def test_thick_slices_cost_trust(slice_mm: float, level: str) -> None:
    grid = Grid((6, 6, 6), (0.8, 0.8, slice_mm), (0.0, 0.0, 0.0))
    whole = Mask(grid, np.ones(grid.shape, dtype=bool))
    verdict = assess(strain_maps(STRETCH, whole), whole, None, similarity=Similarity((0.3, 0.5, 0.9))).verdict
    assert verdict.level == level
    assert all("Slices are" in reason for reason in verdict.reasons)


def test_a_bone_that_moves_costs_trust():
    shifted = strain_maps(RigidMotion(np.eye(3), np.array([0.5, 0.0, 0.0])), WHOLE)
    quality = assess(shifted, WHOLE, core(), similarity=Similarity((0.3, 0.5, 0.9)))
    assert quality.bone_shift_mm == pytest.approx(0.5, rel=1e-6)
    assert quality.verdict.level == "caution"
    at_rest = strain_maps(RigidMotion.identity(), WHOLE)
    for in_bone, level in (((0.0, 0.0), "trust"), ((0.5, 0.0), "caution"), ((0.0, 0.3), "distrust")):
        held = assess(at_rest, WHOLE, core(), similarity=Similarity((0.3, 0.5, 0.9)), in_bone=in_bone)
        assert held.verdict.level == level
        assert (held.bone_shift_mm, held.bone_shear_p95, held.bone_held) == (*in_bone, True)


def test_no_evidence_is_no_trust():
    maps = strain_maps(STRETCH, core())
    assert "No images" in assess(maps, core(), None).verdict.reasons[0]
    elsewhere = np.zeros(GRID.shape, dtype=bool)
    elsewhere[0, 0, 0] = True
    quality = assess(maps, core(), Mask(GRID, elsewhere), similarity=Similarity((0.3, 0.5, 0.9)))
    assert quality.verdict.level == "caution"
    assert "bone has no result" in quality.verdict.reasons[0]
    assert noise_floor(maps, elsewhere) is None


def test_landmarks_count_and_their_absence_is_told():
    errors = np.array([2.5, 3.0, np.nan])
    quality = assess(strain_maps(STRETCH, WHOLE), WHOLE, None, landmark_errors_mm=errors)
    assert quality.verdict.level == "distrust"
    told = quality.as_dict()["landmarks"]
    assert told["undefined"] == 1
    assert told["median_mm"] == pytest.approx(2.75)


def test_noise_floor_is_the_mean_and_spread_of_the_mean_absolute_component():
    maps = strain_maps(STRETCH, WHOLE)
    floor = noise_floor(maps, core().inside)
    assert floor.maer == pytest.approx((1.2**2 - 1) / 2 / 6, rel=1e-6)
    assert floor.sder == pytest.approx(0.0, abs=1e-7)
    assert floor.max_shear_p95 == pytest.approx((1.2**2 - 1) / 4, rel=1e-6)


def test_local_correlation_is_blind_to_a_large_offset():
    random = np.random.default_rng(2)
    one = gaussian_filter(random.normal(size=GRID.shape), 1.0).astype(np.float32)
    other = one + np.float32(0.1) * random.normal(size=GRID.shape).astype(np.float32)
    _, expected = local_correlation(Image(GRID, one), other, core())
    _, far = local_correlation(Image(GRID, one + np.float32(1e3)), other + np.float32(1e3), core())
    assert far == pytest.approx(expected, abs=1e-4)


def test_local_correlation_of_an_image_with_itself_is_one_and_is_blind_to_gain():
    random = np.random.default_rng(1)
    image = Image(GRID, random.normal(size=GRID.shape).astype(np.float32))
    _, pooled = local_correlation(image, 3.0 * image.values + 7.0, core())
    assert pooled == pytest.approx(1.0, abs=1e-4)
    _, turned = local_correlation(image, -image.values, core())
    assert turned == pytest.approx(-1.0, abs=1e-4)
    _, other = local_correlation(image, random.normal(size=GRID.shape).astype(np.float32), core())
    assert abs(other) < 0.2


def test_a_registration_is_undefined_away_from_its_tissue():
    limited = Within(STRETCH, core(), margin_voxels=1)
    inside, beside, far = (
        core().points()[:1],
        GRID.points_at(np.array([[5.0, 6.0, 6.0]])),
        GRID.points_at(np.zeros((1, 3))),
    )
    assert np.isfinite(limited.displacement(inside)).all()
    assert np.isfinite(limited.displacement(beside)).all()
    assert np.isnan(limited.displacement(far)).all()
    u, H = limited.evaluate(np.concatenate([inside, far]))
    assert np.isnan(u[1]).all()
    assert np.isnan(H[1]).all()
    assert np.isfinite(H[0]).all()


@pytest.mark.parametrize(
    ("p95", "says"),
    [
        (0.06004, "0.06004 (95th percentile; limits: 'Use with care' above 0.06, 'Do not trust' above 0.15)"),
        (0.15002, "0.15002 (95th percentile;"),
        (0.0712, "0.071 (95th percentile;"),
    ],
)
def test_a_figure_beyond_its_limit_does_not_read_as_if_it_were_the_limit(p95: float, says: str) -> None:
    floor = NoiseFloor(0.01, 0.01, 0.02, p95, 0.3)
    verdict = assess(strain_maps(STRETCH, WHOLE), WHOLE, None, similarity=ALIKE, floor=floor).verdict
    assert says in verdict.reasons[0]


def test_a_figure_that_is_not_finite_is_not_known() -> None:
    maps, endless = strain_maps(STRETCH, WHOLE), replace(ALIKE, offset=(np.inf, np.inf))
    assert assess(maps, WHOLE, None, similarity=endless).verdict.level == "trust"


def test_tissue_compressed_too_far_is_told_with_its_place_and_where_it_is_seldom_real() -> None:
    maps = strain_maps(STRETCH, WHOLE)
    jacobian = maps.jacobian.copy()
    jacobian[2, 2, 2] = 0.21
    quality = assess(replace(maps, jacobian=jacobian), WHOLE, None, similarity=ALIKE)
    (told,) = quality.verdict.reasons
    place = ", ".join(f"{c:.1f}" for c in quality.lowest_jacobian_at_mm)
    assert "ratio is 0.21" in told
    assert "(limits: 'Use with care' below 0.3, 'Do not trust' below 0)" in told
    assert told.endswith(f"Look there, at LPS ({place}) mm; at the edge of the body it is seldom real.")


def test_a_fold_of_nearly_zero_is_not_called_minus_zero() -> None:
    maps = strain_maps(STRETCH, WHOLE)
    jacobian = maps.jacobian.copy()
    jacobian[2, 2, 2] = -0.0004
    verdict = assess(replace(maps, jacobian=jacobian), WHOLE, None, similarity=ALIKE).verdict
    assert verdict.level == "distrust"
    assert "lowest det F is -0.0004, at" in verdict.reasons[0]
    assert "-0.00 " not in " ".join(verdict.reasons)
    assert shown(-0.0) == "0"
