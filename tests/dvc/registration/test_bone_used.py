"""The bone whose surface an engine has placed, on the voxels of the image as it was given."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.deformation.bspline import BSpline
from dvc.deformation.interface_spline import Interfaces, InterfaceSpline
from dvc.deformation.protocol import RigidMotion
from dvc.images.image import Grid, Image, LabelMap, Mask
from dvc.measurement.judgement import alignment_of
from dvc.registration.align import not_aligned
from dvc.registration.engine import AlignedPair
from dvc.registration.gauss_newton.engine import GaussNewton, GaussNewtonAtBone, GaussNewtonWithInterfaces
from dvc.registration.register import Registration, Settings

SHAPE, SPACING = (60, 48, 54), np.array([1.0, 1.2, 0.9])
OBLIQUE = Rotation.from_rotvec([9.0, -14.0, 20.0], degrees=True).as_matrix()


def registered(
    direction: np.ndarray, settings: Settings, *, smaller_mm: float = 1.0, tissue_from: int = 0
) -> tuple[Registration, np.ndarray]:
    """A pair whose engine takes a bone that is a voxel smaller than the mask; and that bone as it was meant.

    The tissue begins at an index along the first axis, and may leave out a part of the bone.
    """
    grid = Grid(SHAPE, SPACING, (30.0, -20.0, 50.0), direction)
    index = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), axis=-1)
    away = np.linalg.norm((index - [12, 10, 13]) * SPACING / [1.0, 1.0, 0.8], axis=-1)  # in a corner, and no ball
    body, bone, meant = (Mask(grid, away < r) for r in (7.0, 5.0, 5.0 - smaller_mm))
    body = Mask(grid, body.inside & (index[..., 0] >= tissue_from))
    image = Image(grid, np.where(body.inside, 1.0, 0.0).astype(np.float32))
    turn = Rotation.from_matrix(image.toward_lps().grid.direction).as_matrix()

    def turned(scan):
        lps = scan.toward_lps()
        return replace(lps, grid=lps.grid.moved_by(turn.T, np.zeros(3)))

    motion = RigidMotion(np.eye(3), np.zeros(3))
    pair = AlignedPair.of(turned(image), turned(image), motion, turned(body), turned(meant), None).cut()
    assert pair.fixed.grid.shape != SHAPE  # a part of the image
    control = Grid((8, 8, 8), (6.0, 6.0, 6.0), pair.fixed.grid.points_at(np.full(3, -12.0)))
    still = BSpline(control, np.zeros((3, 8, 8, 8)))
    labels = LabelMap(pair.fixed.grid, np.ones(pair.fixed.grid.shape, dtype=int), {1: "tissue"})
    spline = InterfaceSpline(still, still, Interfaces.of(labels, pair.bone, 4.0, pair.body)).turned(turn)
    alignment = not_aligned(image, image, body)
    return Registration(image, image, body, bone, alignment, spline, settings, 0.0, (None, None)), meant.inside


AXES = [np.eye(3)[:, list(order)] * [1.0, -1.0, 1.0] for order in permutations(range(3))]


@pytest.mark.parametrize("direction", [*AXES, OBLIQUE], ids=lambda d: str(np.round(d, 1).tolist()))
def test_it_is_on_the_voxels_of_the_unloaded_image_as_it_is_stored(direction):
    found, meant = registered(np.asarray(direction), Settings(GaussNewtonAtBone()))
    assert found.bone_used is not None
    assert found.bone_used.grid is found.bone.grid
    assert np.array_equal(found.bone_used.inside, meant)


def test_a_bone_that_leaves_the_tissue_has_no_surface_there():
    found, _ = registered(np.eye(3), Settings(GaussNewtonAtBone()), smaller_mm=0.0, tissue_from=11)
    assert np.count_nonzero(found.bone.inside & ~found.tissue.inside) > 50
    assert np.array_equal(found.bone_used.inside, found.bone.inside & found.tissue.inside)
    assert alignment_of(found)["bone_surface_moved_mm"] == [0.0, 0.0]


@pytest.mark.parametrize("engine", [GaussNewton(), GaussNewtonWithInterfaces()])
def test_an_engine_that_places_no_surface_has_none(engine):
    found, _ = registered(np.eye(3), Settings(engine))
    assert found.bone_used is None
