"""A bone mask that does not lie on the bone."""

from __future__ import annotations

import logging
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.bone_masks import masks
from dvc import fit_mask
from dvc.images.image import Grid, Image, Mask
from dvc.images.tissue import tissue_mask
from dvc.measurement.judgement import Evidence
from dvc.measurement.measurement import Measurement
from dvc.measurement.subject import Subject
from dvc.registration.bone_mask import _gradient, edge_sharpness, mask_doubt, nearest_edges
from dvc.registration.gauss_newton.engine import GaussNewton
from dvc.registration.register import Settings, register
from phantoms import Heel, heel_grid, heel_pair, labels_of, scan


def flipped(mask: Mask, *axes: int) -> Mask:
    return Mask(mask.grid, np.ascontiguousarray(np.flip(mask.inside, axes)))


@pytest.mark.parametrize("pair", ["small_pair", "tiny_pair"])
def test_a_right_mask_raises_no_doubt(pair, request):
    heel = request.getfixturevalue(pair)
    assert mask_doubt(heel.reference, heel.bone, tissue_mask(heel.reference)) == ""


@pytest.mark.parametrize("pair", ["small_pair", "tiny_pair"])
@pytest.mark.parametrize(("axes", "told"), [((1,), "second"), ((2,), "third"), ((0, 1), "first and second")])
def test_a_mirrored_mask_is_told_with_its_axes(pair, axes, told, request):
    heel = request.getfixturevalue(pair)
    doubt = mask_doubt(heel.reference, flipped(heel.bone, *axes), tissue_mask(heel.reference))
    assert f"mirrored along the {told} voxel axis" in doubt


@pytest.fixture(
    scope="module",
    params=[pytest.param(0.8, marks=pytest.mark.full_size), 1.2, (0.8, 0.8, 2.4)],
    ids=["0.8", "1.2", "0.8x0.8x2.4"],
)
def heel_at(request) -> tuple[Image, Mask]:
    """One heel at several voxels, mm, and its bone."""
    heel, grid = Heel(3), heel_grid(request.param)
    return scan(heel, grid, snr=25.0, number=0), labels_of(heel, grid).region("bone")


@pytest.mark.parametrize(
    ("axes", "moved_mm", "told"),
    [
        ((), (0.0, 0.0, 0.0), ""),
        ((), (0.0, 2.4, 0.0), ""),
        ((0,), (0.0, 0.0, 0.0), "first"),
        ((1,), (0.0, 0.0, 0.0), "second"),
        ((2,), (0.0, 0.0, 0.0), "third"),
        ((0, 1), (0.0, 0.0, 0.0), "first and second"),
        ((0, 1), (0.0, 2.4, 0.0), "first and second"),
    ],
)
def test_a_mask_is_judged_alike_at_any_voxels(heel_at, axes, moved_mm, told):
    """With gradients per voxel, a mask mirrored along the first axis raised no doubt where voxels are long."""
    image, bone = heel_at
    steps = np.round(np.array(moved_mm) / bone.grid.spacing_mm).astype(int)
    mask = Mask(bone.grid, np.roll(flipped(bone, *axes).inside, steps, (0, 1, 2)))
    doubt = mask_doubt(image, mask, tissue_mask(image))
    assert (f"mirrored along the {told} voxel axis" in doubt) if told else (doubt == "")


@pytest.mark.parametrize("moved_mm", [(0.0, 4.8, 0.0), (-2.4, 0.0, 2.4), (0.0, -7.2, 2.4), (4.8, 7.2, 0.0)])
def test_a_mask_that_lies_beside_the_bone_is_told_with_the_way_back(heel_at, moved_mm):
    """Its median sharpness may be that of a mask on the bone: at 7.2 and 2.4 mm it is up to 1.3."""
    image, bone = heel_at
    steps = np.round(np.array(moved_mm) / bone.grid.spacing_mm).astype(int)
    mask = Mask(bone.grid, np.roll(bone.inside, steps, (0, 1, 2)))
    doubt = mask_doubt(image, mask, tissue_mask(image))
    (told,) = re.findall(r"The bone mask may be off: moved by \d+ mm \(LPS: (.*)\), its surface would", doubt)
    back = -steps * bone.grid.spacing_mm
    # the nearest edge is found to a voxel
    assert np.abs(np.array([float(step) for step in told.split(", ")]) - back).max() <= bone.grid.spacing_mm.max() + 0.1


@pytest.mark.parametrize(("cortex_mm", "muscle"), [(2.0, 0.5), (4.0, 0.2)])
@pytest.mark.parametrize("noise", [0.02, 0.1])
def test_a_shaft_through_the_image_is_told_across_its_axis_alone(cortex_mm, muscle, noise):
    """Along the axis any shift is as sharp, and the inner edge of a thick cortex is met in every direction."""
    grid, radius_mm = Grid((80, 80, 40), np.ones(3), np.zeros(3)), 14.0 if cortex_mm > 3.0 else 10.0
    x, y, _ = np.indices(grid.shape)
    depth = np.hypot(x - 40.0, y - 40.0)
    signal = np.select([depth < radius_mm - cortex_mm, depth < radius_mm, depth < 34.0], [1.0, 0.05, muscle], 0.0)
    image = Image(grid, signal + np.random.default_rng(1).normal(0.0, noise, grid.shape))
    body, right = Mask(grid, depth < 34.0), depth < radius_mm

    def doubt(*steps: int) -> str:
        return mask_doubt(image, Mask(grid, np.roll(right, steps, (0, 1, 2))), body)

    assert doubt(0, 0, 0) == ""
    if cortex_mm < 3.0:
        assert doubt(1, 1, 0) == ""
        assert "moved by 6 mm (LPS: 0.0, -6.0, 0.0), its surface" in doubt(0, 6, 0)


def test_an_oblique_image_tells_the_way_back_along_the_patients_axes(tiny_pair):
    turn = Rotation.from_euler("xyz", [20.0, -30.0, 40.0], degrees=True).as_matrix()
    grid = tiny_pair.reference.grid.moved_by(turn, np.zeros(3))
    mask = Mask(grid, np.roll(tiny_pair.bone.inside, 2, 1))
    image = Image(grid, tiny_pair.reference.values)
    given, best, shift_mm = nearest_edges(_gradient(image), mask, tissue_mask(image))
    assert best > given
    back = -2.0 * grid.spacing_mm[1] * grid.direction[:, 1]
    assert np.linalg.norm(shift_mm - back) < 1.1 * grid.spacing_mm.max()  # along the voxel axes it is 4 mm from there


@pytest.mark.parametrize("shift_mm", [(3.0, 2.0, 1.0), pytest.param((12.0, 8.0, 10.0), marks=pytest.mark.full_size)])
@pytest.mark.parametrize("turned", [False, True])
def test_a_mask_in_the_other_frame_is_told_wherever_the_image_lies(shift_mm, turned):
    """RAS read as LPS turns a mask about the scanner's origin, which is in the middle of hardly any image."""
    pair = heel_pair(3, load=0.6, shape=(64, 72, 68), spacing_mm=1.6)
    grid = pair.reference.grid
    grid = replace(grid, origin_mm=grid.origin_mm - grid.centre_mm + np.array(shift_mm))
    if turned:
        grid = grid.moved_by(Rotation.from_euler("xyz", [4.0, -3.0, 6.0], degrees=True).as_matrix(), np.zeros(3))
    image, right = Image(grid, pair.reference.values), Mask(grid, pair.bone.inside)
    signs = np.diag([-1.0, -1.0, 1.0])
    box = right.box(2)  # a mask on the image's own grid is refused
    own = grid.part(box)
    own = replace(own, origin_mm=signs @ own.origin_mm, direction=signs @ own.direction)
    wrong = fit_mask(Mask(own, right.inside[box]), grid, "bone mask")
    assert "with the signs of L and P reversed, its surface" in mask_doubt(image, wrong, tissue_mask(image))
    assert mask_doubt(image, right, tissue_mask(image)) == ""


@pytest.mark.parametrize("wrong", ["10 mm beside", "15 mm beside", "3 mm too large", "upper half of the body"])
def test_a_mask_that_follows_no_edge_is_told_and_one_that_is_a_voxel_off_is_not(heel_at, wrong):
    image, bone = heel_at
    body = tissue_mask(image)
    given = masks(bone, body, seed=1)
    for name in ("right", "a voxel too large", "a voxel too small"):
        assert mask_doubt(image, given[name], body) == "", name
    known = not np.isnan(edge_sharpness(image, given[wrong], body))
    told = r"may be off: moved by \d+ mm|follows no edge" if "beside" in wrong else "follows no edge"
    assert bool(re.search(told, mask_doubt(image, given[wrong], body))) == known
    assert known or wrong == "upper half of the body"  # whose surface in thick slices is all near the air


def test_a_thin_body_and_thick_slices_raise_no_doubt(tiny_pair):
    """All of the surface is near the air, or an edge as wide as what it is compared with."""
    image = tiny_pair.reference
    whole = tissue_mask(image)
    assert np.isnan(nearest_edges(_gradient(image), whole, whole)[0])
    assert "may be off" not in mask_doubt(image, whole, whole)
    grid, inside = tiny_pair.reference.grid, tiny_pair.bone.inside
    noise, everywhere = np.random.default_rng(1).normal(100.0, 10.0, grid.shape), np.ones(grid.shape, dtype=bool)
    assert mask_doubt(Image(grid, noise), Mask(grid, inside), Mask(grid, everywhere))
    assert mask_doubt(Image(grid, noise), Mask(grid, inside), Mask(grid, inside)) == ""
    thick = replace(grid, spacing_mm=np.array([2.3, 2.3, 4.0]))
    assert mask_doubt(Image(thick, noise), Mask(thick, inside), Mask(thick, everywhere)) == ""


def test_noise_has_no_edge_and_a_mask_at_the_ends_of_the_image_raises_no_error(tiny_pair):
    grid = tiny_pair.reference.grid
    noise = Image(grid, np.random.default_rng(1).normal(100.0, 10.0, grid.shape).astype(np.float32))
    body = Mask(grid, np.ones(grid.shape, dtype=bool))
    assert "follows no edge" in mask_doubt(noise, tiny_pair.bone, body)
    for part in (np.s_[:5], np.s_[:, -3:], np.s_[:]):
        inside = np.zeros(grid.shape, dtype=bool)
        inside[part] = True
        assert "mirrored" not in mask_doubt(noise, Mask(grid, inside), body)


@pytest.mark.usefixtures("in_this_process")
def test_the_doubt_is_warned_of_and_lowers_the_verdict(tiny_pair, caplog):
    bone, weights = flipped(tiny_pair.bone, 0, 1), GaussNewton(bending=3.0, volume=300.0)
    with caplog.at_level(logging.WARNING):
        found = register(tiny_pair.reference, tiny_pair.loaded, bone=bone, settings=Settings(weights))
    assert "may be mirrored" in found.bone_doubt
    assert found.bone_doubt in caplog.text
    subject = Subject(tiny_pair.reference, bone, found.tissue)
    verdict = Measurement.from_registration(found, subject, Evidence()).verdict
    assert verdict.level != "trust"
    assert found.bone_doubt in verdict.reasons
