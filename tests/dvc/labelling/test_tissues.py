"""Tissues found in images: layers and balls whose place is known, and a heel whose every voxel is."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion, gaussian_filter

from dvc import Grid, Image, Mask, TissueLabels, label_tissues
from dvc.arrays import BoolArray, FloatArray
from dvc.errors import GeometryError, InputError
from dvc.labelling.bones import bones_in
from dvc.labelling.brightness import brighter_share, two_levels
from dvc.labelling.skin import Skin
from phantoms import Heel, heel_grid, labels_of, scan

SPACING = np.array([1.0, 1.0, 1.0])


def dice(a: BoolArray, b: BoolArray) -> float:
    """Overlap of two masks: twice the common volume over the sum of both."""
    return float(2.0 * np.count_nonzero(a & b) / (np.count_nonzero(a) + np.count_nonzero(b)))


def shell(
    thick_mm: FloatArray | float, levels: tuple[float, float] = (300.0, 600.0), spacing_mm: FloatArray = SPACING
) -> Image:
    """A ball of 20 mm under a layer of its own brightness, averaged over voxels, with noise."""
    shape = tuple(int(n) for n in np.round(50.0 / spacing_mm))
    grid = Grid(shape, spacing_mm, -0.5 * spacing_mm * (np.array(shape) - 1) + 0.2)
    fine = Grid(tuple(3 * n for n in shape), spacing_mm / 3.0, grid.origin_mm - spacing_mm / 3.0)
    radius = np.linalg.norm(fine.points(), axis=-1)
    values = np.select([radius < 20.0 - thick_mm, radius < 20.0], [levels[1], levels[0]], 0.0)
    mean = values.reshape(shape[0], 3, shape[1], 3, shape[2], 3).mean(axis=(1, 3, 5))
    return Image(grid, mean + np.random.default_rng(1).normal(0.0, 20.0, mean.shape))


def skin_of(image: Image) -> tuple[Skin | None, FloatArray]:
    """Skin of the ball, and the distance of each voxel from its middle."""
    radius = np.linalg.norm(image.grid.points(), axis=-1)
    return Skin.of(image, Mask(image.grid, radius < 20.0), np.zeros(image.grid.shape, dtype=bool)), radius


@pytest.mark.parametrize(
    ("thick_mm", "spacing_mm"),
    [
        (1.2, (1.0, 1.0, 1.0)),
        (2.0, (1.0, 1.0, 1.0)),
        (3.5, (1.0, 1.0, 1.0)),
        (2.0, (0.8, 0.8, 1.6)),
        (2.0, (2.0, 0.7, 0.7)),
    ],
)
def test_the_thickness_of_a_layer_is_found_to_a_tenth_of_a_millimetre(
    thick_mm: float, spacing_mm: tuple[float, float, float]
) -> None:
    skin, radius = skin_of(shell(thick_mm, spacing_mm=np.array(spacing_mm)))
    assert skin is not None
    at_border = np.abs(radius - (20.0 - thick_mm)) < 0.7
    off = (skin.border_mm - skin.depth_mm - (radius - (20.0 - thick_mm)))[at_border]
    assert np.abs(off.mean()) < 0.1
    assert off.std() < 0.18
    sure = np.abs(radius - (20.0 - thick_mm)) > max(spacing_mm)
    assert np.array_equal(
        skin.probability[sure & (radius < 19.0)] > 0.5, (radius > 20.0 - thick_mm)[sure & (radius < 19.0)]
    )


def test_a_thickness_that_varies_is_followed() -> None:
    fine = np.linspace(-24.8, 24.8, 150)
    thick = 2.0 + 0.02 * fine[None, None, :]  # 1.6 mm below, 2.4 mm above
    skin, radius = skin_of(shell(np.broadcast_to(thick, (150, 150, 150))))
    assert skin is not None
    z = np.broadcast_to(np.linspace(-24.3, 24.7, 50), radius.shape)
    near = (radius > 16.5) & (radius < 18.5)
    slope = np.polyfit(z[near], skin.border_mm[near], 1)[0]
    assert 0.01 < slope < 0.03  # a layer of one thickness has 0


def test_what_has_no_darker_layer_has_no_skin() -> None:
    assert skin_of(shell(2.0, (600.0, 600.0)))[0] is None
    assert skin_of(shell(2.0, (900.0, 600.0)))[0] is None
    assert skin_of(shell(2.0, (400.0, 600.0)))[0] is not None


def test_a_body_that_fills_the_image_shows_no_skin() -> None:
    grid = Grid((24, 24, 24), SPACING, np.zeros(3))
    image = Image(grid, np.random.default_rng(5).normal(600.0, 20.0, grid.shape))
    nothing = np.zeros(grid.shape, dtype=bool)
    assert Skin.of(image, Mask(grid, ~nothing), nothing) is None
    few = nothing.copy()
    few[11:13, 11:13, 11:13] = True
    assert Skin.of(image, Mask(grid, few), ~few) is None


def two_halves(noise: float, step: float = 200.0) -> tuple[FloatArray, BoolArray]:
    values = np.full((40, 40, 40), 400.0)
    bright = np.zeros(values.shape, dtype=bool)
    bright[20:] = True
    values[bright] += step
    return (values + np.random.default_rng(2).normal(0.0, noise, values.shape)).astype(np.float32), bright


def test_two_tissues_are_divided_through_noise_that_a_threshold_does_not_see_through() -> None:
    values, bright = two_halves(noise=120.0)
    where = np.ones(values.shape, dtype=bool)
    levels = two_levels(values, where, SPACING)
    assert levels is not None
    assert (levels.darker, levels.brighter) == pytest.approx((400.0, 600.0), abs=30.0)
    share = brighter_share(values, where, levels, SPACING)
    assert dice(share > 0.5, bright) > 0.99
    assert dice(values > levels.middle, bright) < 0.85
    assert share[bright].min() > 0.3
    assert np.mean(share[30:] > 0.95) > 0.95


def test_one_tissue_is_not_divided() -> None:
    values, _ = two_halves(noise=120.0, step=0.0)
    textured = values + 200.0 * gaussian_filter(np.random.default_rng(3).normal(size=values.shape), 3.0).astype(
        np.float32
    )
    where = np.ones(values.shape, dtype=bool)
    assert two_levels(values, where, SPACING) is None
    assert two_levels(textured, where, SPACING) is None
    assert two_levels(np.zeros_like(values), where, SPACING) is None


def test_marrow_in_a_dark_rim_is_bone_and_the_rim_with_it() -> None:
    grid = Grid((50, 50, 50), SPACING, np.full(3, -24.5))
    radius = np.linalg.norm(grid.points() - [5.0, 0.0, 0.0], axis=-1)
    values = np.where(radius < 8.0, 700.0, np.where(radius < 10.0, 60.0, 600.0))
    hole = (np.abs(grid.points()[..., 1]) < 1.0) & (np.abs(grid.points()[..., 2]) < 1.0) & (grid.points()[..., 0] > 5.0)
    noise = np.random.default_rng(4).normal(0.0, 25.0, values.shape)
    for seen in (values, np.where(hole, 600.0, values)):  # whole, and with a vessel through its rim
        found = bones_in((seen + noise).astype(np.float32), np.ones(grid.shape, dtype=bool), 280.0, SPACING)
        assert dice(found == 1, radius < 10.0) > 0.97
    assert not bones_in((600.0 + noise).astype(np.float32), np.ones(grid.shape, dtype=bool), 280.0, SPACING).any()


def test_a_gap_of_one_thick_slice_in_the_rim_does_not_join_bone_and_soft_tissue() -> None:
    grid = Grid((60, 60, 30), (0.8, 0.8, 1.6), np.zeros(3))
    at = grid.points() - grid.centre_mm
    radius = np.linalg.norm(at, axis=-1)
    values = np.where(radius < 9.0, 700.0, np.where(radius < 11.0, 60.0, 600.0))
    one_slice = (at[..., 2] > 0.0) & (at[..., 2] < 1.6)
    values[one_slice & (np.abs(at[..., 1]) < 4.0) & (at[..., 0] > 0.0) & (radius > 8.0)] = 600.0
    found = bones_in(values.astype(np.float32), np.ones(grid.shape, dtype=bool), 280.0, grid.spacing_mm)
    assert dice(found == 1, radius < 11.0) > 0.95


@pytest.fixture(scope="module")
def labelled(heel_at_rest_once) -> tuple[TissueLabels, FloatArray]:
    """A heel at 1.2 mm, labelled from its bone alone; and its true labels."""
    image, truth = heel_at_rest_once(31, 1.2)
    return label_tissues(image, truth.region("bone")), truth


def test_tissues_of_a_heel(labelled) -> None:
    made, truth = labelled
    assert made.notes == ()
    assert dict(made.labels.names) == {1: "bone", 2: "fat", 3: "muscle", 4: "skin", 5: "other bone"}
    known = {name: truth.region(name).inside for name in truth.names.values()}
    assert dice(made.labels.region("bone").inside, known["bone"]) > 0.998
    assert dice(made.labels.region("fat").inside, known["fat"]) > 0.93
    assert dice(made.labels.region("muscle").inside, known["muscle"] | known["tendon"]) > 0.93
    assert dice(made.labels.region("skin").inside, known["skin"]) > 0.83
    assert dice(made.labels.region("other bone").inside, known["ankle"]) > 0.93


@pytest.mark.parametrize("off", [pytest.param(binary_dilation, marks=pytest.mark.full_size), binary_erosion])
def test_labels_hardly_depend_on_how_large_the_bone_was_drawn(
    labelled, heel_at_rest_once, off: Callable[[BoolArray], BoolArray]
) -> None:
    """If the surface stayed at a mask that is a voxel off, 2.4 and 2.9 % of the labels would be others."""
    (made, truth), (image, _) = labelled, heel_at_rest_once(31, 1.2)
    bone = truth.region("bone")
    mask = Mask(bone.grid, off(bone.inside))
    again = label_tissues(image, mask).labels
    assert dice(mask.inside, bone.inside) < 0.92
    assert dice(again.region("bone").inside, bone.inside) > 0.98
    inside = truth.labels > 0
    assert np.mean(again.labels[inside] == made.labels.labels[inside]) > 0.995
    assert np.array_equal(label_tissues(image, mask, bone_is_exact=True).labels.region("bone").inside, mask.inside)


def test_a_mask_that_is_mirrored_is_told(heel_at_rest_once) -> None:
    """Its surface was moved to edges of the image before the registration judged it."""
    image, truth = heel_at_rest_once(31, 1.2)
    notes = label_tissues(image, Mask(truth.grid, truth.region("bone").inside[::-1])).notes
    assert any("The bone mask may be mirrored" in note for note in notes)


def test_probabilities_are_as_sure_as_they_are_right(labelled) -> None:
    made, truth = labelled
    total = made.probability.sum(axis=0)
    inside = made.labels.labels > 0
    assert total[inside] == pytest.approx(1.0, abs=1e-5)
    assert total[~inside].max() == 0.0
    soft = inside & np.isin(truth.labels, [2, 3, 4]) & np.isin(made.labels.labels, [2, 3, 4])
    sure, right = made.probability.max(axis=0), made.labels.labels == truth.labels
    for low, high in ((0.5, 0.7), (0.7, 0.9), (0.9, 0.99), (0.99, 1.01)):
        some = soft & (sure >= low) & (sure < high)
        assert some.sum() > 1000
        assert right[some].mean() > low - 0.1
    assert right[soft & (sure < 0.7)].mean() < 0.8  # what is called unsure is wrong more often
    assert 0.05 < made.uncertain < 0.3


def test_progress_is_told_to_the_end_and_what_does_not_fit_is_refused() -> None:
    grid = heel_grid(3.2)
    image, told = scan(Heel(31), grid, snr=25.0, number=0), list[float]()
    label_tissues(image, labels_of(Heel(31), grid).region("bone"), watch=told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    far = Grid(grid.shape, grid.spacing_mm, grid.origin_mm + 500.0)
    with pytest.raises(GeometryError, match="inside the image"):
        label_tissues(image, Mask(far, np.ones(grid.shape, dtype=bool)))
    whole = Mask(grid, np.ones(grid.shape, dtype=bool))
    with pytest.raises(InputError, match="no soft tissue"):
        label_tissues(image, whole)


@pytest.mark.parametrize(
    ("seed", "spacing_mm"),
    [
        (3, (1.4, 1.4, 2.4)),
        *(pytest.param(seed, 2.0, marks=pytest.mark.full_size) for seed in (3, 7, 31)),
        *(pytest.param(3, one, marks=pytest.mark.full_size) for one in ((1.0, 1.0, 2.0), (1.2, 1.2, 2.4))),
    ],
)
def test_bones_are_found_in_thick_slices_and_large_voxels(heel_at_rest_once, seed: int, spacing_mm: Any) -> None:
    """By one limit of what is dark, a third of them or less: a rim as wide as a voxel has gaps."""
    image, truth = heel_at_rest_once(seed, spacing_mm)
    made = label_tissues(image, truth.region("bone"))
    assert dice(made.labels.region("other bone").inside, truth.region("ankle").inside) > 0.85


@pytest.mark.parametrize("shell", [220.0, 250.0, 300.0])
def test_fat_in_dim_muscle_is_no_bone_and_a_bone_with_dim_marrow_stays_one(shell: float) -> None:
    """In fat of 600, with muscle of 300 elsewhere: limits 1.2 and 1.3 times as bright as 210 are tried, too."""
    grid = Grid((64, 64, 64), np.ones(3), np.zeros(3))
    values = np.full(grid.shape, 600.0)
    bone, lobule = (np.linalg.norm(grid.points() - centre, axis=-1) for centre in ((18, 32, 32), (44, 32, 32)))
    values[lobule < 10.5], values[bone < 10.0] = shell, 60.0
    values[lobule < 7.5], values[bone < 8.5] = 600.0, 250.0
    values += np.random.default_rng(1).normal(0.0, 20.0, values.shape)
    found = bones_in(values.astype(np.float32), np.ones(grid.shape, dtype=bool), 210.0, grid.spacing_mm)
    assert dice(found > 0, bone < 10.0) > 0.95


@pytest.mark.parametrize(("between", "bones"), [(0.45, 1), (0.75, 0)])
def test_what_a_dark_rim_does_not_enclose_is_no_bone(between: float, bones: int) -> None:
    """A ball in soft tissue, behind a closed layer of 2 mm: as dark as cortical bone, or as a septum."""
    grid = Grid((40, 40, 40), SPACING, np.full(3, -19.5))
    radius = np.linalg.norm(grid.points(), axis=-1)
    values = np.where(np.abs(radius - 9.0) < 1.0, 400.0 * between, 400.0)
    values += np.random.default_rng(1).normal(0.0, 15.0, values.shape)
    everywhere = np.ones(grid.shape, dtype=bool)
    found = bones_in(values.astype(np.float32), everywhere, 0.85 * 400.0, SPACING)
    assert found.max() == bones
    if bones:
        assert dice(found > 0, radius < 10.0) > 0.95
