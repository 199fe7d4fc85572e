"""The rigid fit on a known texture: exact without noise, on any grid, with gaps; and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.deformation.protocol import RigidMotion
from dvc.errors import InputError, RegistrationError
from dvc.images.image import Grid, Image, Mask
from dvc.registration.rigid_fit import RigidFit, _surrounded
from tests.textures import texture

CENTRE = np.array([2.0, 26.0, 24.0])
_AXES = np.array([[0.0, 0, 1], [-1, 0, 0], [0, 1, 0]])
FINE = Grid((44, 46, 40), np.array([1.0, 1.0, 1.0]), CENTRE - 21.0)
SLICES = Grid((44, 46, 14), np.array([1.0, 1.0, 3.0]), CENTRE - 21.0)
SWAPPED = Grid((46, 40, 44), np.ones(3), CENTRE + np.array([-21.0, 21.0, -21.0]), _AXES)


def turned_by(degrees: list[float], shift_mm: list[float]) -> RigidMotion:
    return RigidMotion.about(CENTRE, Rotation.from_rotvec(degrees, degrees=True).as_matrix(), np.array(shift_mm))


STILL = RigidMotion.identity()
MOTION = turned_by([2.0, -3.0, 4.0], [1.5, -1.0, 0.7])


def seen(grid: Grid, motion: RigidMotion, noise: float = 0.0, seed: int = 1) -> Image:
    values = texture(motion.inverse().apply(grid.points().reshape(-1, 3))).reshape(grid.shape)
    return Image(grid, (values + noise * np.random.default_rng(seed).normal(size=grid.shape)).astype(np.float32))


def ball(grid: Grid, radius_mm: float = 14.0) -> Mask:
    return Mask(grid, np.linalg.norm(grid.points() - CENTRE, axis=-1) < radius_mm)


def off_mm(found: RigidMotion, mask: Mask) -> float:
    X = mask.points()
    return float(np.sqrt(np.mean(np.sum((found.apply(X) - MOTION.apply(X)) ** 2, axis=1))))


@pytest.mark.parametrize(("grid", "within"), [(FINE, 0.005), (SWAPPED, 0.005), (SLICES, 0.05)])
def test_the_motion_is_found_on_any_grid(grid: Grid, within: float) -> None:
    mask = ball(grid)
    fit = RigidFit(seen(grid, STILL), seen(FINE, MOTION), mask, 1)
    assert off_mm(MOTION, mask) == 0.0
    assert off_mm(STILL, mask) > 2.0
    found = fit.whole(STILL)
    assert off_mm(found, mask) < within
    assert max(off_mm(half, mask) for pair in fit.halves(found) for half in pair) < 2.0 * within


def test_an_offset_and_a_gain_that_changes_in_place_do_not_matter() -> None:
    loaded = seen(FINE, MOTION)
    x, y, _ = np.moveaxis((FINE.points() - CENTRE) / 20.0, -1, 0)
    gain = 7.0 * (1.0 + 0.3 * x - 0.2 * y * y + 0.1 * x * y)
    for values in (gain * loaded.values, loaded.values + 0.3, loaded.values - 50.0):
        for bright in (1.0, 2e4):
            images = (Image(FINE, (bright * v).astype(np.float32)) for v in (seen(FINE, STILL).values, values))
            assert off_mm(RigidFit(*images, ball(FINE), 1).whole(STILL), ball(FINE)) < 0.005


LOW = Grid((44, 46, 32), np.ones(3), CENTRE - [21.0, 21.0, 10.0])  # its lowest slice cuts the ball


@pytest.mark.parametrize(("grid", "gaps"), [(FINE, False), (LOW, False), (FINE, True)], ids=["whole", "cut", "gaps"])
def test_noise_does_not_pull(grid: Grid, gaps: bool) -> None:
    """The mean error of 12 draws is as much less than that of one as chance has it (0.29); plain regression: 0.6."""
    mask, errors = ball(grid), []
    for draw in range(12):
        reference, loaded = (
            seen(on, motion, 0.2, 2 * draw + n) for n, (on, motion) in enumerate(((grid, STILL), (FINE, MOTION)))
        )
        if gaps:  # 44 % of what is shown lies beside one
            values = reference.values.copy()
            values[np.random.default_rng(5).random(values.shape) < 0.08] = np.nan
            reference = Image(grid, values)
        found = RigidFit(reference, loaded, mask, 1).whole(MOTION)
        errors.append(found.apply(mask.points()) - MOTION.apply(mask.points()))
    single = float(np.sqrt(np.mean(np.sum(np.array(errors) ** 2, axis=2))))
    mean = float(np.sqrt(np.mean(np.sum(np.mean(errors, axis=0) ** 2, axis=1))))
    assert single < 0.08
    assert mean < 0.45 * single


def test_voxels_at_an_images_end_are_used_where_most_lie_there() -> None:
    for slices, left_out in ((3, False), (8, True)):
        grid = Grid((40, 40, slices), np.ones(3), CENTRE - [20.0, 20.0, 0.5 * slices])
        mask = ball(grid)
        used = _surrounded(seen(grid, STILL), mask)
        assert (used.inside.sum() < mask.inside.sum()) == left_out


def test_what_the_loaded_image_does_not_show_is_left_out() -> None:
    mask, loaded = ball(FINE), seen(FINE, MOTION)
    values = loaded.values.copy()
    hidden = FINE.points()[..., 0] > CENTRE[0] + 4.0
    values[hidden] = np.nan
    fit = RigidFit(seen(FINE, STILL), Image(FINE, values), mask, 1)
    assert off_mm(fit.whole(STILL), mask) < 0.02
    values[FINE.points()[..., 0] > CENTRE[0] - 4.0] = np.nan
    fit = RigidFit(seen(FINE, STILL), Image(FINE, values), mask, 1)
    with pytest.raises(RegistrationError, match="moved out of"):
        fit.whole(STILL)


def test_what_the_unloaded_image_does_not_show_is_left_out_too() -> None:
    mask, reference = ball(FINE), seen(FINE, STILL)
    values = reference.values.copy()
    values[FINE.points()[..., 1] > CENTRE[1] + 4.0] = np.nan
    fit = RigidFit(Image(FINE, values), seen(FINE, MOTION), mask, 1)
    assert off_mm(fit.whole(STILL), mask) < 0.02
    with pytest.raises(InputError, match="Only 0 voxels of the mask"):
        RigidFit(Image(FINE, np.full_like(values, np.nan)), seen(FINE, MOTION), mask, 1)


def test_a_single_slice_is_refused() -> None:
    slice_ = Grid((44, 46, 1), np.ones(3), CENTRE - [21.0, 21.0, 0.0])
    with pytest.raises(InputError, match="single slice"):
        RigidFit(seen(slice_, STILL), seen(FINE, MOTION), ball(slice_), 1)


def test_a_mask_smaller_than_a_block_has_halves_too() -> None:
    mask = ball(FINE, 4.0)
    fit = RigidFit(seen(FINE, STILL), seen(FINE, MOTION), mask, 1)
    assert max(off_mm(half, mask) for pair in fit.halves(MOTION) for half in pair) < 0.05


def test_turned_contrast_is_refused() -> None:
    fit = RigidFit(seen(FINE, STILL), Image(FINE, -seen(FINE, MOTION).values), ball(FINE), 1)
    with pytest.raises(RegistrationError, match="contrast of the loaded image is inverted"):
        fit.whole(MOTION)
