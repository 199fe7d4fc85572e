"""The same heel in other frames and on other grids: displacement and strain, turned back, are the same."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dvc.deformation.protocol import Deformation, RigidMotion, evaluate_on_grid
from dvc.deformation.strain import StrainField
from dvc.images.image import Grid, Image, Mask
from dvc.io.transforms.elastix_text import parse_parameters
from dvc.registration.elastix.engine import Elastix
from dvc.registration.elastix.presets import Preset
from dvc.registration.gauss_newton.engine import GaussNewton
from dvc.registration.register import Registration, Settings, register
from phantoms import Heel, scan
from tests.quick import QUICK

OURS = Settings(GaussNewton(bending=4.0, volume=300.0))
ELASTIX = Settings(Elastix((Preset("quick", QUICK, parse_parameters(QUICK)),)))

OBLIQUE = RigidMotion(
    Rotation.from_rotvec([12.0, -20.0, 28.0], degrees=True).as_matrix(), np.array([40.0, -90.0, 15.0])
)
"""From the phantom's world to one in which the scanner's table lies askew."""


def stored(grid: Grid, values: np.ndarray, axes: tuple[int, int, int], flips: tuple[int, int, int]) -> tuple:
    """The same voxels in another order: axes are exchanged, then some turned round."""
    order = list(axes)
    turned = np.array(flips, dtype=float)
    last = np.where(turned < 0, np.array(grid.shape)[order] - 1.0, 0.0)
    index = np.zeros(3)
    index[order] = last
    i, j, k = (grid.shape[a] for a in order)
    direction = np.array(grid.direction)[:, order] * turned
    moved = Grid((i, j, k), np.array(grid.spacing_mm)[order], grid.points_at(index), direction)
    return moved, np.ascontiguousarray(values.transpose(order)[tuple(slice(None, None, f) for f in flips)])


@pytest.fixture(scope="module")
def plain(tiny_pair, worker, computed_once) -> dict[str, Registration]:
    pair = tiny_pair
    given = {"bone": pair.bone, "tissue": body(pair), "worker": worker}
    return computed_once(
        "in-its-own-frame",
        lambda: {s.engine.family: register(pair.reference, pair.loaded, settings=s, **given) for s in (OURS, ELASTIX)},
    )


def body(pair) -> Mask:
    return Mask(pair.labels.grid, pair.labels.labels > 0)


def apart(
    one: Deformation, other: Deformation, grid: Grid, where: np.ndarray, world: RigidMotion
) -> tuple[float, float]:
    """Largest differences of u (mm) and of E between a deformation and one in another world, turned back."""
    u, H = evaluate_on_grid(one, grid, where)
    R = world.rotation
    v, K = evaluate_on_grid(other, grid.moved_by(R, world.translation_mm), where)
    back = np.einsum("ji,njk,kl->nil", R, K, R)
    E, same = (StrainField.from_gradient(h).green_lagrange for h in (H, back))
    return float(np.abs(v @ R - u).max()), float(np.abs(same - E).max())


@pytest.mark.parametrize("engine", ["gauss-newton", "elastix"])
def test_an_oblique_frame_changes_nothing(engine, plain, tiny_pair, worker):
    pair = tiny_pair

    def turned(grid: Grid) -> Grid:
        return grid.moved_by(OBLIQUE.rotation, OBLIQUE.translation_mm)

    found = register(
        Image(turned(pair.reference.grid), pair.reference.values),
        Image(turned(pair.loaded.grid), pair.loaded.values),
        bone=Mask(turned(pair.bone.grid), pair.bone.inside),
        tissue=Mask(turned(pair.bone.grid), body(pair).inside),
        settings=plain[engine].settings,
        worker=worker,
    )
    fat = pair.labels.region("fat").inside
    u_mm, strain = apart(plain[engine].displacement, found.displacement, pair.reference.grid, fat, OBLIQUE)
    assert u_mm < 1e-5
    assert strain < 1e-6


@pytest.mark.parametrize(("axes", "flips"), [((0, 1, 2), (-1, -1, 1)), ((1, 2, 0), (1, -1, -1))], ids=["RAS", "PSR"])
def test_voxels_in_another_order_change_nothing(axes, flips, plain, tiny_pair, worker):
    pair = tiny_pair

    def reordered(image: Image | Mask) -> Image | Mask:
        values = image.values if isinstance(image, Image) else image.inside
        grid, kept = stored(image.grid, values, axes, flips)
        return Image(grid, kept) if isinstance(image, Image) else Mask(grid, kept)

    found = register(
        reordered(pair.reference),
        reordered(pair.loaded),
        bone=reordered(pair.bone),
        tissue=reordered(body(pair)),
        settings=OURS,
        worker=worker,
    )
    fat = pair.labels.region("fat").inside
    u_mm, strain = apart(
        plain["gauss-newton"].displacement, found.displacement, pair.reference.grid, fat, RigidMotion.identity()
    )
    assert u_mm < 1e-6
    assert strain < 1e-6


@pytest.mark.full_size
def test_a_loaded_image_of_thicker_slices_gives_nearly_the_same(plain, tiny_pair, worker):
    """Slices of 4 mm instead of 2.3, along another axis, and a field of view that begins elsewhere."""
    pair = tiny_pair
    grid = pair.loaded.grid
    count = int(np.ceil(grid.shape[0] * grid.spacing_mm[0] / 4.0)) + 1
    slices = Grid((count, *grid.shape[1:]), np.array([4.0, 2.5, 2.5]), grid.origin_mm - np.array([1.7, 1.1, 0.6]))
    loaded = scan(Heel(3), slices, pair.deformation, pair.foot_motion, snr=25.0, number=1)
    found = register(pair.reference, loaded, bone=pair.bone, tissue=body(pair), settings=OURS, worker=worker)
    fat = pair.labels.region("fat").inside
    X = pair.reference.grid.points(fat)
    truth = pair.deformation.displacement(X)
    off = [
        float(np.median(np.linalg.norm(one.displacement.displacement(X) - truth, axis=1)))
        for one in (plain["gauss-newton"], found)
    ]
    assert off[0] < 0.35  # .28; .62 without any registration
    assert off[1] < 0.45  # .38
