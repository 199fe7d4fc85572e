"""The surface of a bone is moved to its dark rim, on average, and stays where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation, binary_erosion

from dvc.images.bone_rim import bone_to_rim
from dvc.images.depth import depth_mm
from dvc.images.image import Grid, Image, Mask

GRID = Grid((48, 48, 48), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
FROM_CENTRE = GRID.points().reshape(48, 48, 48, 3) - 23.5
RADIUS = np.linalg.norm(FROM_CENTRE, axis=-1)
BONE, BODY = RADIUS < 15.0, RADIUS < 21.0
EVERYWHERE = np.ones_like(BONE)
LEFT = FROM_CENTRE[..., 0] > 4.0  # has a rim in both images
RIGHT = FROM_CENTRE[..., 0] < -4.0


def ball(rim: np.ndarray, snr: float = 14.0) -> Image:
    """A ball of bone in bright tissue, its outer 1.5 mm dark where ``rim`` says so."""
    values = np.where(BODY, 1.0, 0.0)
    values[BONE & (RADIUS > 13.5) & rim] = 0.15
    noise = np.random.default_rng(0).normal(0.0, 1.0 / snr, values.shape)
    return Image(GRID, np.abs(values + noise).astype(np.float32))


def off_mm(image: Image, mask: np.ndarray, side: np.ndarray) -> float:
    """How far the surface found lies from the true one on one side, root mean square, mm."""
    found = bone_to_rim(image, Mask(GRID, mask), Mask(GRID, BODY))[0].inside
    true = depth_mm(BONE, GRID.spacing_mm)
    error = depth_mm(found, GRID.spacing_mm) - true
    return float(np.sqrt(np.mean(error[(np.abs(true) < 0.5) & side] ** 2)))


@pytest.mark.parametrize("drawn", [BONE, binary_dilation(BONE), binary_erosion(BONE)], ids=["exact", "large", "small"])
@pytest.mark.parametrize("rim", [EVERYWHERE, FROM_CENTRE[..., 0] > 0.0], ids=["all around", "half"])
def test_the_surface_lies_at_the_rim_wherever_the_mask_was_drawn(drawn: np.ndarray, rim: np.ndarray) -> None:
    """A mask that is off by a voxel is off by .8 mm or more."""
    assert off_mm(ball(rim), drawn, LEFT) < 0.3


@pytest.mark.parametrize(
    ("image", "drawn", "least", "most"),
    [
        (ball(EVERYWHERE), BONE, 0.4, 1.0),
        (ball(FROM_CENTRE[..., 0] > 0.0), BONE, 0.2, 0.4),
        (ball(np.zeros_like(BONE)), BONE, 0.0, 0.1),
        (ball(EVERYWHERE), binary_erosion(BONE, iterations=4), 0.0, 0.1),
        (Image(GRID, np.where(BONE, 0.15, ball(EVERYWHERE).values)), binary_erosion(BONE), 0.0, 0.1),
    ],
    ids=["all around", "half", "no rim", "far inside", "all dark"],
)
def test_it_tells_how_much_of_the_surface_shows_a_rim(
    image: Image, drawn: np.ndarray, least: float, most: float
) -> None:
    assert least <= bone_to_rim(image, Mask(GRID, drawn), Mask(GRID, BODY))[1] <= most


def test_a_surface_without_a_rim_stays() -> None:
    """Beside the half that has one, it moves with that; voxel by voxel, it moved by 1 mm."""
    half, none = FROM_CENTRE[..., 0] > 0.0, np.zeros_like(BONE)
    assert off_mm(ball(half), BONE, RIGHT) < 0.15
    assert off_mm(ball(none, snr=8.0), BONE, EVERYWHERE) == 0.0


@pytest.mark.parametrize(
    ("drawn", "at_most_mm"), [(BONE, 0.03), (binary_dilation(BONE), 0.3), (binary_erosion(BONE), 0.2)],
    ids=["exact", "large", "small"],
)  # fmt: skip
@pytest.mark.parametrize("snr", [14.0, 8.0])
def test_on_average_the_rim_moves_a_mask_that_is_off_and_keeps_an_exact_one(
    drawn: np.ndarray, at_most_mm: float, snr: float
) -> None:
    """Moved voxel by voxel, an exact mask is off by .1 mm."""
    assert off_mm(ball(EVERYWHERE, snr), drawn, EVERYWHERE) < at_most_mm


@pytest.mark.parametrize("drawn", [BONE, binary_dilation(BONE), binary_erosion(BONE)], ids=["exact", "large", "small"])
def test_where_no_tissue_is_as_dark_as_the_rim_the_bone_encloses_as_many_voxels_as_it(drawn: np.ndarray) -> None:
    """By the mean distance alone, the curved surface of a large mask lay .18 mm too far inside: 495 voxels too few."""
    found = bone_to_rim(ball(EVERYWHERE), Mask(GRID, drawn), Mask(GRID, BODY), dark=np.zeros_like(BONE))[0].inside
    assert abs(int(found.sum()) - int(BONE.sum())) < 150
    assert np.count_nonzero(found != BONE) < 200


def test_a_mask_that_is_off_in_a_patch_is_moved_there_alone() -> None:
    """By a mean over 6 mm alone, the patch was off by .7 mm."""
    patch = FROM_CENTRE[..., 0] > 0.93 * RADIUS
    drawn = BONE | (binary_dilation(BONE) & patch)
    image = ball(EVERYWHERE)
    assert off_mm(image, drawn, FROM_CENTRE[..., 0] > 0.96 * RADIUS) < 0.4
    assert off_mm(image, drawn, ~patch) < 0.2


def test_a_mask_that_lies_a_voxel_aside_is_moved_back() -> None:
    """It was off by .58 mm."""
    assert off_mm(ball(EVERYWHERE), np.roll(BONE, 1, axis=0), EVERYWHERE) < 0.25


@pytest.mark.parametrize("drawn", [BONE, binary_dilation(BONE), binary_erosion(BONE)], ids=["exact", "large", "small"])
@pytest.mark.parametrize("cosine", [0.95, 0.9])
def test_tendon_at_the_bone_is_not_taken_for_its_rim(drawn: np.ndarray, cosine: float) -> None:
    """A cone as dark as the rim, from the bone to the surface of the body. Voxel by voxel, the bone grew into it."""
    tendon = (FROM_CENTRE[..., 2] > cosine * RADIUS) & BODY
    image = Image(GRID, np.where(tendon & ~BONE, 0.15, ball(EVERYWHERE).values))
    at = tendon & (RADIUS > 12.0)
    assert off_mm(image, drawn, at) < 0.3


def test_on_average_a_surface_far_from_every_rim_stays() -> None:
    large, half, none = binary_dilation(BONE), FROM_CENTRE[..., 0] > 0.0, np.zeros_like(BONE)
    assert off_mm(ball(none, snr=8.0), BONE, EVERYWHERE) == 0.0
    found = bone_to_rim(ball(half), Mask(GRID, large), Mask(GRID, BODY))[0].inside
    assert np.array_equal(found[:10], large[:10])  # 14 mm from the nearest rim
    assert np.count_nonzero(found[24:] ^ BONE[24:]) < 0.4 * np.count_nonzero(large[24:] ^ BONE[24:])


def test_in_thick_slices_the_surface_stays() -> None:
    """In slices of 3 mm, an exact mask lost voxels at the ends of the bone."""
    grid = Grid((48, 48, 16), (1.0, 1.0, 3.0), (0.0, 0.0, 0.0))
    image, bone, body = ball(EVERYWHERE).values[:, :, ::3], binary_dilation(BONE[:, :, ::3]), BODY[:, :, ::3]
    assert np.array_equal(bone_to_rim(Image(grid, image), Mask(grid, bone), Mask(grid, body))[0].inside, bone)


def test_the_mean_is_not_of_the_other_side_of_a_thin_bone() -> None:
    """A plate of 9 mm, drawn a voxel aside: one of its sides has to move out, and the other in."""
    x = FROM_CENTRE[..., 0]
    plate, rim = np.abs(x) < 4.5, (np.abs(x) > 3.0) & (np.abs(x) < 4.5)
    values = np.where(rim, 0.15, 1.0) + np.random.default_rng(0).normal(0.0, 0.05, plate.shape)
    aside = np.roll(plate, 1, axis=0)
    found = bone_to_rim(Image(GRID, values.astype(np.float32)), Mask(GRID, aside), Mask(GRID, EVERYWHERE))[0].inside
    assert np.mean(found != plate) < 0.3 * np.mean(aside != plate)
